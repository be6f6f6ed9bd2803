"""The command `reproduce`: a paper's whole result. It draws, and needs the extra `diffabs[plot]`."""

import pathlib
import time
from typing import TYPE_CHECKING, Annotated, Any

import typer

from diffabs.cli import console, show
from diffabs.core import provenance, values

if TYPE_CHECKING:
    from diffabs.papers import Reproduction


def reproduce(
    name: Annotated[str, typer.Argument(help="slip-lmi, slip-estimator, arm-balance, or all.")] = "all",
    out: Annotated[pathlib.Path, typer.Option(help="Folder for the results, one folder per paper.")] = pathlib.Path(
        "out"
    ),
    as_json: console.Json = False,
) -> None:
    """A paper's whole result: figures, summary.json, and in short what agrees with it and what is refuted."""
    with console.guarded():
        console.need_matplotlib()
        from diffabs.papers import PAPERS, compact

        if name != "all" and name not in PAPERS:
            raise values.unknown(f"there is no paper {values.shown(name)}", name, (*PAPERS, "all"))
        results: dict[str, Any] = {}
        try:
            for paper in PAPERS if name == "all" else (name,):
                with console.new_folder(out / paper) as folder:
                    results[paper] = _reproduced(paper, PAPERS[paper], folder)
                if not as_json:
                    show.paper(compact(results[paper]), out / paper)
        except KeyboardInterrupt:
            if not results:
                raise
            console.say(f"interrupted: whole are {', '.join(str(out / paper) for paper in results)}")
            raise typer.Exit(console.INTERRUPTED) from None
        if as_json:
            show.as_json({"out": str(out), "papers": results, "versions": provenance.versions()})


def _reproduced(name: str, reproduction: "Reproduction", folder: pathlib.Path) -> dict[str, Any]:
    """The summary of a paper. Its steps are told beside the spinner, or in a line each where there is none."""
    spins, steps, begun = console.animated(), ["starting"], time.monotonic()

    def step(sentence: str) -> None:
        steps.append(sentence.removeprefix(f"{name}: "))
        if not spins:
            console.say(sentence)

    def detail() -> str:
        return f"{time.monotonic() - begun:.0f} s: {steps[-1]}"

    return console.waited(lambda: reproduction(folder, step), f"reproducing {name}", detail if spins else None)
