"""Who computes the chunks: the devices of this process, or a Dask cluster (`cluster`)."""

import itertools
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple, Protocol

import jax
import numpy as np

from diffabs.sweep.manifest import DECISIVE as DECISIVE
from diffabs.sweep.manifest import Seals, described
from diffabs.sweep.runner import Columns, Runner
from diffabs.sweep.seal import Seal, encoded
from diffabs.sweep.study import Study


class Done(NamedTuple):
    """A chunk: the bytes of its file, how many lanes it has, and how many of them failed, diverged and were refused."""

    chunk: int
    data: bytes
    lanes: int
    failed: int
    diverged: int
    refused: int = 0


class Engine(Protocol):
    """Computes chunks in any order."""

    def run(self, study: Study, chunks: Sequence[int], stopping: Callable[[], bool]) -> Generator[Done, None, None]:
        """Every chunk once; ends early, after what it has begun, when `stopping()`, and at once when it is closed."""
        ...


class Local:
    """All devices of this process, a chunk on each at a time. Of P processes (`jax.distributed`), each takes every P-th
    chunk."""

    def __init__(self, devices: Sequence[Any] | None = None):
        """All local ones if not given."""
        self.devices = list(devices or jax.local_devices())

    def run(self, study: Study, chunks: Sequence[int], stopping: Callable[[], bool]) -> Generator[Done, None, None]:
        """In order."""
        runner, seals = Runner(study, self.devices), Seals(described(study))
        for together in batched(chunks[jax.process_index() :: jax.process_count()], len(self.devices)):
            for chunk, columns in zip(together, runner.run(together), strict=True):
                yield done(study, seals.of(chunk), columns)
            if stopping():
                return


def done(study: Study, seal: Seal, columns: Columns) -> Done:
    """A chunk's columns, counted and encoded."""
    failed = failures(study, columns)
    counts = (
        len(failed),
        int(failed.sum()),
        int(np.sum(columns["diverged"] & accepted(columns["refused"]))),
        int(np.sum(~accepted(columns["refused"]))),
    )
    return Done(seal.chunk, encoded(columns, seal), *counts)


def accepted(refused: Any) -> np.ndarray:
    """Lanes that were run, of the reasons why not (lanes,)."""
    return np.asarray(refused).astype(str) == ""


def failures(study: Study, columns: Any) -> np.ndarray:
    """Lanes that were run and diverged, did not stop, locked, or left a bound of the study (lanes,)."""
    failed = np.asarray(columns["diverged"]) | missed(columns["stopped"], columns)
    bounds = failing({"objectives": study.objectives, "failures": study.failures})
    failed = np.any([failed, *(np.asarray(columns[name]) > bound for name, bound in bounds.items())], axis=0)
    return failed & accepted(columns["refused"])


def failing(study: Mapping[str, Any]) -> dict[str, float]:
    """Bounds of metrics, beyond which a lane has failed: those of the study, a wheel that locks, a fall."""
    always = {name: 0.0 for name in ("locked_time", "fell") if name in study["objectives"]}
    return {**always, **study["failures"]}


def missed(stopped: Any, names: Iterable[str]) -> np.ndarray:
    """Which lanes did not reach their stop, a failure; but where a fall is measured, the stop is the fall."""
    return np.zeros(np.shape(stopped), bool) if "fell" in names else ~np.asarray(stopped)


def batched(items: Sequence[int], size: int) -> Iterator[list[int]]:
    """Lists of `size`, the last one shorter."""
    rest = iter(items)
    while batch := list(itertools.islice(rest, size)):
        yield batch
