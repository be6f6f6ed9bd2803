"""The command `sweep`: a Monte-Carlo study into a folder, with statistics.

It needs the extra `diffabs[sweep]`, and for Dask `diffabs[cluster]`; what needs them is imported when it runs."""

import contextlib
import dataclasses
import json
import pathlib
import shlex
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from typing import TYPE_CHECKING, Annotated, Any

import jax
import jax.numpy as jnp
import typer
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

from diffabs import console, show, variation
from diffabs.catalogue import ScenarioError, unit_of, unknown
from diffabs.pytree import elements
from diffabs.scenario import Scenario, dump, loads

if TYPE_CHECKING:
    from diffabs.sweep import Progress as Told
    from diffabs.sweep import Results, Study

ENGINES = ("local", "dask")
AGAIN = 10.0  # s between lines where there is no terminal
AWAKE = 0.1  # s between looks for Ctrl-C
SUMMARY, FIGURES = "summary.json", "figures"


def sweep(
    scenario: console.ScenarioName,
    out: Annotated[pathlib.Path, typer.Option(metavar="DIR", help="Folder of the sweep.")],
    changes: console.Changes = None,
    samples: Annotated[int | None, typer.Option(help="The same as --set sweep.samples=N.")] = None,
    seed: Annotated[int | None, typer.Option(help="The same as --set sweep.seed=N.")] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Go on with the sweep that is in the folder.")] = False,
    engine: Annotated[str, typer.Option(help="local or dask.")] = "local",
    scheduler: Annotated[
        str | None, typer.Option(metavar="ADDRESS", help="Of a Dask scheduler, tcp://host:port.")
    ] = None,
    workers: Annotated[int | None, typer.Option(min=1, help="Dask workers on this machine.")] = None,
    devices: Annotated[int | None, typer.Option(min=1, help="CPU devices of this process.")] = None,
    keep: Annotated[
        str | None, typer.Option(metavar="N,N,...", help="Samples whose trajectories are kept (zarr).")
    ] = None,
    figures: Annotated[bool, typer.Option("--figures", help=f"Draw into DIR/{FIGURES}.")] = False,
    as_json: console.Json = False,
) -> None:
    """Run a scenario for many values of what [sweep.over] varies, and show statistics with confidence intervals."""
    with console.guarded(), reported():
        _check_options(engine, scheduler, workers, devices, figures)
        if samples is not None and samples < 1:
            console.fail(f"--samples {samples} is not positive")
        if devices:
            jax.config.update("jax_num_cpu_devices", devices)
        given = {"samples": samples, "seed": seed}
        changes = [*(changes or ()), *(f"sweep.{k}={v}" for k, v in given.items() if v is not None)]
        chosen = console.loaded(scenario, changes)
        study = variation.study(chosen)
        kept = _numbers(keep, study.samples)
        with _continued():
            found = _run(study, chosen, out, resume, _engine(engine, scheduler, workers))
            if not found.complete:
                again = shlex.join([*sys.argv[1:], *([] if resume else ["--resume"])])
                console.say(f"interrupted: finished chunks are in {out}; go on with: diffabs {again}")
                raise typer.Exit(console.INTERRUPTED)
            result = console.waited(lambda: _result(found, study, out, kept, figures), "computing statistics")
        show.as_json(result) if as_json else show.swept(result, chosen)


def sample(folder: pathlib.Path, number: int) -> tuple[Scenario, jax.Array]:
    """A sample of a sweep as a scenario, and the key of its noise. Raises SweepError or ValueError."""
    console.need_extra("sweep", "filelock", "pyarrow", "scipy", "zarr")
    from diffabs.sweep.store import SweepError, read_manifest

    source = read_manifest(folder)["source"]
    if "scenario" not in source:
        raise SweepError(f"{folder} was not swept from a scenario; Study.lane({number}) is this sample")
    chosen = loads(source["scenario"].encode(), source["name"], f"{folder}", integrated=False)
    study = variation.study(chosen)
    if not 0 <= number < study.samples:
        console.fail(f"--sample {number} is outside [0, {study.samples - 1}]")
    loop, key = study.lane(number)
    loop = jax.tree.map(lambda x: jnp.asarray(x, study.dtype), loop)
    return dataclasses.replace(chosen, name=f"{chosen.name}, sample {number}", title="", loop=loop), key


@contextlib.contextmanager
def reported() -> Iterator[None]:
    """A sweep that cannot be started or read is bad input."""
    try:
        yield
    except ValueError as error:
        if isinstance(error, ScenarioError) or type(error).__name__ != "SweepError":
            raise
        console.fail(str(error))


@contextlib.contextmanager
def _continued() -> Iterator[None]:
    """A full disk says how to go on."""
    try:
        yield
    except OSError as error:
        console.fail(f"{' '.join(str(error).split())}; finished chunks stay, --resume goes on", console.FAILED)


def _check_options(engine: str, scheduler: str | None, workers: int | None, devices: int | None, figures: bool) -> None:
    console.need_extra("sweep", "filelock", "pyarrow", "scipy", "zarr")
    if engine not in ENGINES:
        raise unknown(f"--engine {engine} is unknown", engine, ENGINES)
    if engine == "dask":
        console.need_extra("cluster", "distributed")
    for option, value, needed in (
        ("--scheduler", scheduler, "dask"),
        ("--workers", workers, "dask"),
        ("--devices", devices, "local"),
    ):
        if value is not None and engine != needed:
            console.fail(f"{option} {value} needs --engine {needed}")
    if scheduler and workers:
        console.fail(f"--workers {workers}: the scheduler at {scheduler} has its own workers")
    if figures:
        console.need_matplotlib()


def _numbers(keep: str | None, samples: int) -> list[int]:
    """Sample numbers of an option. Raises typer.Exit."""
    try:
        numbers = [int(text) for text in keep.split(",")] if keep else []
    except ValueError:
        console.fail(f"--keep {keep} is no list of sample numbers N,N,...")
    wrong = [n for n in numbers if not 0 <= n < samples]
    if wrong:
        console.fail(f"--keep {wrong[0]} is outside [0, {samples - 1}]")
    return numbers


def _engine(name: str, scheduler: str | None, workers: int | None) -> Any:
    from diffabs.sweep.engines import Local

    if name == "local":
        return Local()
    from diffabs.sweep.cluster import Dask

    return Dask(scheduler, workers)


def _run(study: "Study", chosen: Scenario, out: pathlib.Path, resume: bool, engine: Any) -> "Results":
    from diffabs.sweep import sweep as run

    source = {"scenario": dump(chosen), "name": chosen.name}
    with _interruptible() as stopping, _watched() as told:
        return _aside(
            lambda: run(study, out, resume=resume, engine=engine, progress=told, stopping=stopping, source=source)
        )


def _aside(work: Callable[[], "Results"]) -> "Results":
    """The result of `work` in a thread of its own, because Ctrl-C cannot interrupt compiled code in the main one.
    Raises what it raises."""
    result: Future[Results] = Future()

    def run() -> None:
        try:
            result.set_result(work())
        except BaseException as error:
            result.set_exception(error)

    thread = threading.Thread(target=run, name=console.WORKER, daemon=True)
    thread.start()
    while thread.is_alive():
        thread.join(AWAKE)  # the system may give a signal to another thread; Python handles it when this one wakes
    return result.result()


@contextlib.contextmanager
def _interruptible() -> Iterator[Callable[[], bool]]:
    """Whether Ctrl-C was pressed: once finishes the chunks in hand, twice interrupts."""
    pressed = []

    def press(*_: Any) -> None:
        pressed.append(True)
        signal.signal(signal.SIGINT, before)
        console.say("interrupted: finishing the chunks in hand (Ctrl-C again: at once)")

    before = signal.signal(signal.SIGINT, press)
    try:
        yield lambda: bool(pressed)
    finally:
        signal.signal(signal.SIGINT, before)


@contextlib.contextmanager
def _watched() -> Iterator[Callable[["Told"], None]]:
    """A bar on a terminal; elsewhere a line every few seconds."""
    error = Console(stderr=True)
    bar = Progress(
        BarColumn(),
        TextColumn("{task.completed:,.0f} of {task.total:,.0f}  {task.fields[line]}"),
        TimeRemainingColumn(),
        console=error,
        disable=not error.is_terminal,
    )
    due = [time.monotonic() + AGAIN]
    with bar:
        task = bar.add_task("", total=None, line="")

        def told(at: "Told") -> None:
            if at.damaged and not at.here:
                console.say(f"damaged, computed again: chunk{'s' if len(at.damaged) > 1 else ''} {_listed(at.damaged)}")
            line = f"{at.rate:,.0f}/s, {at.failed:,} failed, {at.diverged:,} diverged"
            bar.update(task, completed=at.samples, total=at.total, line=line)
            if not error.is_terminal and time.monotonic() > due[0]:
                left = (at.total - at.samples) / at.rate if at.rate else float("inf")
                console.say(f"{at.samples:,} of {at.total:,}: {line}, {left:,.0f} s left")
                due[0] = time.monotonic() + AGAIN

        yield told


def _listed(numbers: tuple[int, ...]) -> str:
    return ", ".join(map(str, numbers[:8])) + (f" and {len(numbers) - 8} more" if len(numbers) > 8 else "")


def _result(found: "Results", study: "Study", out: pathlib.Path, kept: list[int], figures: bool) -> dict[str, Any]:
    """The JSON document, which is also written into the folder."""
    from diffabs.sweep.store import write_whole
    from diffabs.sweep.summary import summary
    from diffabs.sweep.trajectories import keep

    result = {"out": str(out), **summary(found), "files": {}}
    if kept:
        result["files"]["trajectories"] = str(keep(study, out, kept))
    if figures:
        from diffabs.plot_sweep import draw

        folder = out / FIGURES
        folder.mkdir(exist_ok=True)
        units = {path: spec.unit for path, spec in elements(study.loop).items()}
        units |= {name: unit_of(objective) for name, objective in study.objectives.items()}
        result["files"]["figures"] = [str(path) for path in draw(found, result, folder, units)]
    document = json.dumps(show.finite(result), indent=1, allow_nan=False)
    write_whole(out / SUMMARY, document.encode())
    return result
