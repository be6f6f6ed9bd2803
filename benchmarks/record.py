"""What benchmarks have in common: times taken in turn, and a file with the machine and the versions."""

import json
import os
import pathlib
import platform
import statistics
import time
from collections.abc import Callable, Iterable, Mapping
from typing import Any

from diffabs.host import provenance

OUT = pathlib.Path("out/benchmarks")


def timed(call: Callable[[], Any]) -> float:
    """Return the seconds that a call takes."""
    begun = time.perf_counter()
    call()
    return time.perf_counter() - begun


def in_turn(takers: Mapping[Any, Callable[[], float]], rounds: int) -> dict[Any, list[float]]:
    """Return the seconds of each taker, one of each round: all are asked once in every round, so that whatever else
    the machine does is shared. A ratio of two is the median of those within a round, see `ratio`."""
    taken: dict[Any, list[float]] = {name: [] for name in takers}
    for _ in range(rounds):
        for name, take in takers.items():
            taken[name].append(take())
    return taken


def ratio(above: list[float], below: list[float]) -> float:
    """Return the median of the ratios within a round."""
    return statistics.median(a / b for a, b in zip(above, below, strict=True))


def best(points: Iterable[dict[str, Any]], accuracy: float) -> dict[str, Any] | None:
    """Return the first of points, coarse to fine, whose "error" is at most `accuracy`; else the most accurate."""
    points = list(points)
    good = (point for point in points if point["error"] <= accuracy)
    return next(good, min(points, key=lambda point: point["error"], default=None))


def written(
    name: str, record: Mapping[str, Any], out: pathlib.Path | None = None, packages: Iterable[str] = ("jaxlib", "numpy")
) -> pathlib.Path:
    """Write a record with the machine and the versions of diffabs, JAX and `packages`; return where."""
    path = out or OUT / f"{name}.json"
    path.parent.mkdir(parents=True, exist_ok=True)
    machine = {"processor": processor(), "system": platform.system(), "cores": os.cpu_count(), "load": load()}
    versions = {**provenance.describe_platform(*packages), **provenance.source_commit()}
    text = json.dumps({**record, "machine": machine, "versions": versions}, indent=2) + "\n"
    path.write_text(text, encoding="utf-8")
    return path


def load() -> tuple[float, float, float] | None:
    """Return how many processes wanted to run, in the last 1, 5 and 15 minutes, where the system tells."""
    return os.getloadavg() if hasattr(os, "getloadavg") else None


def processor() -> str:
    """Return the processor's name, or the machine's kind where the system does not tell."""
    cpu = pathlib.Path("/proc/cpuinfo")
    lines = cpu.read_text().splitlines() if cpu.exists() else []
    return next((line.partition(":")[2].strip() for line in lines if line.startswith("model name")), platform.machine())
