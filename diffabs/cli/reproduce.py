"""The command `reproduce`: all results of a paper. It draws figures, and needs the extras `plot` and `report`."""

import pathlib
from functools import partial
from typing import TYPE_CHECKING, Annotated

import typer

from diffabs.cli import console, progress, report, show, targets
from diffabs.core.types import JsonObject
from diffabs.host import documents, provenance
from diffabs.host import values as readers

if TYPE_CHECKING:
    from diffabs.papers import Reproduction


def reproduce(
    name: Annotated[
        str,
        typer.Argument(
            help="A paper: slip-lmi, slip-estimator, arm-balance, or all. Or lab-rig: the rig, measured. Or literature:"
            " other people's programs."
        ),
    ] = "all",
    out: Annotated[pathlib.Path, typer.Option(help="Folder for the results, one folder per paper.")] = pathlib.Path(
        "out"
    ),
    data: Annotated[
        pathlib.Path | None,
        typer.Option(metavar="FOLDER", help="For lab-rig: finer readings of both experiments than the packaged ones."),
    ] = None,
    as_json: console.Json = False,
) -> None:
    """Reproduce a paper's results.

    It writes all figures and summary.json. It shows which numbers agree with the paper, and the refuted claims."""
    with console.end_on_errors():
        console.need_matplotlib()
        console.need_extra("report")
        from diffabs.papers import PAPERS, REPRODUCTIONS, compact

        if name != "all" and name not in REPRODUCTIONS:
            names = (*REPRODUCTIONS, "all")
            raise readers.unknown_name_error(f"there is no paper {readers.format_given(name)}", name, names)
        if data is not None and name != "lab-rig":
            console.fail(f"--data {data}: only lab-rig reads measurements")
        if data is not None and not data.is_dir():
            console.fail(f"--data {data}: there is no such folder")
        whole = out / report.DEFAULT_NAME if name == "all" else None
        if whole:
            report.check_target(whole)
        results: JsonObject = {}
        try:
            for paper in PAPERS if name == "all" else (name,):
                with targets.new_target_folder(out / paper) as folder:
                    reproduction = REPRODUCTIONS[paper] if data is None else partial(REPRODUCTIONS[paper], data=data)
                    results[paper] = _reproduce_with_progress(paper, reproduction, folder)
                # The results are in place: a report that cannot be written does not cost them.
                report.write_report_file([out / paper], out / paper / report.DEFAULT_NAME)
                if not as_json:
                    show.show_paper(compact(results[paper]), out / paper)
            if whole:
                folders = [out / paper for paper in results]
                report.write_report_file(folders, whole, f"{len(results)} papers, reproduced")
        except KeyboardInterrupt:
            if not results:
                raise
            console.say(f"interrupted: finished are {', '.join(str(out / paper) for paper in results)}")
            raise typer.Exit(console.INTERRUPTED) from None
        if whole:
            console.say(f"report of all papers: {whole}")
        if as_json:
            values = {"out": str(out), "papers": results, "versions": provenance.versions()}
            show.as_json(documents.stamp("papers", values))


def _reproduce_with_progress(name: str, reproduction: "Reproduction", folder: pathlib.Path) -> JsonObject:
    """Return the summary of a paper; its steps are shown beside the spinner, or on a line each."""
    spins, steps = console.is_animated(), [progress.COMPILING]

    def step(sentence: str) -> None:
        steps.append(sentence.removeprefix(f"{name}: "))
        if not spins:
            console.say(sentence)

    return console.run_with_progress(
        lambda: reproduction(folder, step), f"reproducing {name}", (lambda: steps[-1]) if spins else None
    )
