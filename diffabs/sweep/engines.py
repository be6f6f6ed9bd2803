"""Who computes the chunks: the devices of this process, or a Dask cluster (`cluster`)."""

import itertools
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
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
        """Every chunk once; ends early, after what it has begun, when `stopping()`, and without giving that when it is
        closed."""
        ...


class Local:
    """All devices of this process, a chunk on each at a time. Of P processes (`jax.distributed`), each takes every P-th
    chunk."""

    def __init__(self, devices: Sequence[Any] | None = None):
        """All local ones if not given."""
        self.devices = list(devices or jax.local_devices())

    def run(self, study: Study, chunks: Sequence[int], stopping: Callable[[], bool]) -> Generator[Done, None, None]:
        """In order. While chunks are counted, encoded and written, the next ones run."""
        runner, seals = Runner(study, self.devices), Seals(described(study))
        rest = batched(chunks[jax.process_index() :: jax.process_count()], len(self.devices))
        with ThreadPoolExecutor(1) as beside:
            together = next(rest, None)
            coming = beside.submit(runner.run, together) if together else None
            while together and coming:
                here, found = together, coming.result()
                together = None if stopping() else next(rest, None)
                coming = beside.submit(runner.run, together) if together else None
                for chunk, columns in zip(here, found, strict=True):
                    yield done(study, seals.of(chunk), columns)


def done(study: Study, seal: Seal, columns: Columns) -> Done:
    """A chunk's columns, counted and encoded."""
    failed = failures(study, columns)
    counts = (
        len(failed),
        int(failed.sum()),
        int(np.sum(columns["diverged"] & accepted(columns["refused"]))),
        int(np.sum(~accepted(columns["refused"]))),
    )
    return Done(seal.chunk, encoded(columns, seal, study.units()), *counts)


def accepted(refused: Any) -> np.ndarray:
    """Lanes that were run, of the reasons why not (lanes,)."""
    return np.asarray(refused).astype(str) == ""


def failures(study: Study, columns: Any) -> np.ndarray:
    """Lanes that were run and diverged, ended as they should not, or left a bound of the study (lanes,)."""
    failed = np.asarray(columns["diverged"]) | missed(columns["stopped"], study.success)
    failed = np.any([failed, *(np.asarray(columns[name]) > bound for name, bound in study.bounded.items())], axis=0)
    return failed & accepted(columns["refused"])


def missed(stopped: Any, success: bool) -> np.ndarray:
    """Return which lanes (lanes,) ended as they should not: without reaching a stop that is a `success`, or at one that
    is not."""
    return np.asarray(stopped) != success


def missing(success: bool) -> str:
    """Return what is said of those lanes."""
    return "not stopped" if success else "stopped"


def batched(items: Sequence[int], size: int) -> Iterator[list[int]]:
    """Lists of `size`, the last one shorter."""
    rest = iter(items)
    while batch := list(itertools.islice(rest, size)):
        yield batch
