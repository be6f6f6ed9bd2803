"""Options of the command `sweep`: the place of the runs, and the samples whose trajectories are kept."""

import os
from typing import Any

from diffabs.cli import console
from diffabs.host.values import unknown_name_error

PLACES = ("local", "dask")


def check_place(on: str, scheduler: str | None, workers: int | None, devices: int | None) -> None:
    """Check the place of the runs, and the options that only one place has."""
    if on not in PLACES:
        raise unknown_name_error(f"--on {on} is unknown", on, PLACES)
    if on == "dask":
        console.need_extra("cluster")
    for option, value, needed in (
        ("--scheduler", scheduler, "dask"),
        ("--workers", workers, "dask"),
        ("--devices", devices, "local"),
    ):
        if value is not None and on != needed:
            console.fail(f"{option} {value} needs --on {needed}")
    limit = max(8, 2 * (os.cpu_count() or 1))
    for option, value in (("--workers", workers), ("--devices", devices)):
        if value is not None and not 1 <= value <= limit:
            why = ": more than twice the processors only cost memory" if value > limit else ""
            console.fail(f"{option} {value} is outside [1, {limit}]{why}")
    if scheduler and workers:
        console.fail(f"--workers {workers}: the scheduler at {scheduler} has its own workers")


def build_place(name: str, scheduler: str | None, workers: int | None) -> Any:
    """Return the computer of the runs."""
    from diffabs.uncertainty.sweep.engines import Local

    if name == "local":
        return Local()
    from diffabs.uncertainty.sweep.cluster import Dask

    return Dask(scheduler, workers)


def read_sample_numbers(keep: str | None, samples: int) -> list[int]:
    """Return the sample numbers of --keep. Raises typer.Exit."""
    try:
        numbers = [int(text) for text in keep.split(",")] if keep else []
    except ValueError:
        console.fail(f"--keep {keep} is no list of sample numbers N,N,...")
    wrong = [n for n in numbers if not 0 <= n < samples]
    if wrong:
        console.fail(f"--keep {wrong[0]} is outside [0, {samples - 1}]")
    return numbers
