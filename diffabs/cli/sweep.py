"""The command `sweep`: a Monte-Carlo study into a folder, with statistics.

It needs the extra `sweep`, and for Dask the extra `cluster`. Modules that need them are imported only when the command
runs.
"""

import contextlib
import dataclasses
import functools
import pathlib
import sys
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Annotated

import jax
import typer

from diffabs.cli import console, progress, report, show, show_samples, sweep_files, sweep_options
from diffabs.cli import engine as engines
from diffabs.core.types import PyTree
from diffabs.engine.drive.engine import EngineError
from diffabs.host import files
from diffabs.scenario import section_sweep
from diffabs.scenario.scenario import Scenario, dump
from diffabs.uncertainty.sweep.sampling import MAX_UINT32

if TYPE_CHECKING:
    from diffabs.uncertainty.sweep import Results, Study
    from diffabs.uncertainty.sweep import SweepProgress as Told


def sweep(
    scenario: console.ScenarioName,
    out: Annotated[
        pathlib.Path | None, typer.Option(metavar="DIR", help="Folder of the sweep; default: out/sweep-NAME.")
    ] = None,
    changes: console.Changes = None,
    samples: Annotated[int | None, typer.Option(help="Number of samples; the same as --set sweep.samples=N.")] = None,
    seed: Annotated[int | None, typer.Option(help="Seed of the samples; the same as --set sweep.seed=N.")] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Continue the sweep in the folder.")] = False,
    engine: engines.Engine = "auto",
    on: Annotated[str, typer.Option(help="Place of the runs: local or dask.")] = "local",
    scheduler: Annotated[
        str | None, typer.Option(metavar="ADDRESS", help="Address of a Dask scheduler, tcp://host:port.")
    ] = None,
    workers: Annotated[int | None, typer.Option(help="Number of Dask workers on this machine.")] = None,
    devices: Annotated[int | None, typer.Option(help="Number of CPU devices of this process.")] = None,
    keep: Annotated[
        str | None, typer.Option(metavar="N,N,...", help="Samples whose trajectories are kept (zarr).")
    ] = None,
    figures: Annotated[bool, typer.Option("--figures", help=f"Draw figures into DIR/{sweep_files.FIGURES}.")] = False,
    as_json: console.Json = False,
) -> None:
    """Run a scenario for many samples, and show statistics.

    Parameters vary as [sweep.over] says. Statistics have confidence intervals."""
    with console.end_on_errors():
        console.need_extra("sweep")
        sweep_options.check_place(on, scheduler, workers, devices)
        if figures:
            console.need_matplotlib()
            console.need_extra("report")
        if samples is not None and not 1 <= samples <= MAX_UINT32:
            console.fail(f"--samples {samples} is outside [1, {MAX_UINT32}]")
        if devices:
            jax.config.update("jax_num_cpu_devices", devices)
        if out:
            _check_free(out, resume)  # before anything is compiled
        from diffabs.uncertainty.sweep.checking import accuracy_warnings
        from diffabs.uncertainty.sweep.selection import choose_study_engine

        setup = console.load_scenario(
            scenario, console.add_option_overrides(changes, "sweep", samples=samples, seed=seed)
        )
        if not out:
            out = pathlib.Path("out") / f"sweep-{setup.name}"
            _check_free(out, resume)
        show_samples.say_unused_seed(setup)
        if figures:
            report.check_target(out / report.DEFAULT_NAME)
        study = dataclasses.replace(section_sweep.build_study(setup), engine=engine).check()
        study = engines.choose_engine(
            lambda: choose_study_engine(study, out, resume=resume, remote=scheduler is not None)
        )
        numbers = sweep_options.read_sample_numbers(keep, study.samples)
        for number in numbers:
            study.accepted_lane(number)  # raises for a refused sample
        with _explain_resume(out, resume):
            results = _run(study, setup, out, resume, lambda: sweep_options.build_place(on, scheduler, workers))
            show_samples.warn_of_strays(results)
            if not results.complete:
                raise KeyboardInterrupt
            check = setup.sweep.check
            result = console.run_with_progress(
                lambda: sweep_files.write_statistics(results, study, out, check), "computing statistics"
            )
            show_result = functools.partial(show.show_result, as_json, show_samples.show_sweep, result, setup)
            with console.show_before_errors(show_result):
                console.run_with_progress(
                    lambda: sweep_files.write_files(result, results, study, out, numbers, figures),
                    "writing the results",
                )
        show_result()
        for line in accuracy_warnings(result["accuracy"]) if result["accuracy"] else ():
            console.say(f"warning: {line}")
        if result["refused"]["count"] == result["samples"]:
            why = next(iter(result["refused"]["reasons"]))
            console.fail(f"{setup.name}: no sample could be run: {why}", console.FAILED)


@contextlib.contextmanager
def _explain_resume(out: pathlib.Path, resume: bool) -> Iterator[None]:
    """Add the way to resume to the messages of a full disk, a failed kernel and Ctrl-C."""
    try:
        yield
    except (OSError, EngineError) as error:
        line = files.describe_error(error) if isinstance(error, OSError) else str(error)
        console.fail(f"{' '.join(line.split())}; finished chunks are kept; --resume continues", console.FAILED)
    except KeyboardInterrupt:
        if not any((out / "chunks").glob("*.parquet")):
            raise
        line = f"interrupted: finished chunks are in {out}; continue with:"
        console.say_command(line, ["diffabs", *sys.argv[1:], *([] if resume else ["--resume"])])
        raise typer.Exit(console.INTERRUPTED) from None


def _check_free(out: pathlib.Path, resume: bool) -> None:
    """Raise SweepError if a new sweep cannot begin in the folder."""
    from diffabs.uncertainty.sweep.store import Store

    if not resume:
        Store(out).check_free()


def _run(study: "Study", scenario: Scenario, out: pathlib.Path, resume: bool, on: Callable[[], PyTree]) -> "Results":
    """Return the results. Raises KeyboardInterrupt after Ctrl-C: at once, or after the current chunks."""
    far = [progress.WorkProgress(progress.COMPILING)]
    ending = console.InterruptibleEnd("the chunks in hand")

    def report_progress(at: "Told") -> None:
        if at.damaged and not at.here:
            console.say(at.describe_damage())
        far[0] = progress.WorkProgress(at.describe_count(), at.samples, at.total)

    def run() -> "Results":
        from diffabs.uncertainty.sweep import sweep as run

        source = {"scenario": dump(scenario), "name": scenario.name}
        return run(study, out, resume=resume, on=on(), progress=report_progress, stopping=ending, source=source)

    return console.run_with_progress(run, f"sweeping {scenario.name}", lambda: far[0], ending)
