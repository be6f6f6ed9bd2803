"""Who computes the chunks: the devices of this process, or a Dask cluster (`cluster`)."""

import itertools
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple, Protocol

import jax
import numpy as np

from diffabs.sweep.manifest import DECISIVE_PACKAGES as DECISIVE_PACKAGES
from diffabs.sweep.manifest import Seals, describe_owner
from diffabs.sweep.runner import Columns, Runner
from diffabs.sweep.seal import Seal, encode_chunk
from diffabs.sweep.study import Study


class ComputedChunk(NamedTuple):
    """A chunk: the bytes of its file, how many lanes it has, and how many of them failed, diverged and were refused."""

    chunk: int
    data: bytes
    lanes: int
    failed: int
    diverged: int
    refused: int = 0


class Engine(Protocol):
    """Computes chunks in any order."""

    def run(
        self, study: Study, chunks: Sequence[int], stopping: Callable[[], bool]
    ) -> Generator[ComputedChunk, None, None]:
        """Every chunk once; ends early, after what it has begun, when `stopping()`, and without giving that when it is
        closed."""
        ...


class Local:
    """All devices of this process, a chunk on each at a time. Of P processes (`jax.distributed`), each takes every P-th
    chunk."""

    def __init__(self, devices: Sequence[Any] | None = None):
        """All local ones if not given."""
        self.devices = list(devices or jax.local_devices())

    def run(
        self, study: Study, chunks: Sequence[int], stopping: Callable[[], bool]
    ) -> Generator[ComputedChunk, None, None]:
        """In order. While chunks are counted, encoded and written, the next ones run."""
        runner, seals = Runner(study, self.devices), Seals(describe_owner(study))
        rest = group_items(chunks[jax.process_index() :: jax.process_count()], len(self.devices))
        with ThreadPoolExecutor(1) as beside:
            together = next(rest, None)
            coming = beside.submit(runner.run, together) if together else None
            while together and coming:
                here, found = together, coming.result()
                together = None if stopping() else next(rest, None)
                coming = beside.submit(runner.run, together) if together else None
                for chunk, columns in zip(here, found, strict=True):
                    yield encode_computed_chunk(study, seals.of(chunk), columns)


def encode_computed_chunk(study: Study, seal: Seal, columns: Columns) -> ComputedChunk:
    """A chunk's columns, counted and encoded."""
    failed = has_failed(study, columns)
    counts = (
        len(failed),
        int(failed.sum()),
        int(np.sum(columns["diverged"] & is_accepted(columns["refused"]))),
        int(np.sum(~is_accepted(columns["refused"]))),
    )
    return ComputedChunk(seal.chunk, encode_chunk(columns, seal, study.units()), *counts)


def is_accepted(refused: Any) -> np.ndarray:
    """Lanes that were run, of the reasons why not (lanes,)."""
    return np.asarray(refused).astype(str) == ""


def has_failed(study: Study, columns: Any) -> np.ndarray:
    """Lanes that were run and diverged, ended as they should not, or left a bound of the study (lanes,)."""
    failed = np.asarray(columns["diverged"]) | has_wrong_end(columns["stopped"], study.success)
    failed = np.any(
        [failed, *(np.asarray(columns[name]) > bound for name, bound in study.failure_bounds.items())], axis=0
    )
    return failed & is_accepted(columns["refused"])


def has_wrong_end(stopped: Any, success: bool) -> np.ndarray:
    """Return which lanes (lanes,) ended as they should not: without reaching a stop that is a `success`, or at one that
    is not."""
    return np.asarray(stopped) != success


def describe_wrong_end(success: bool) -> str:
    """Return what is said of those lanes."""
    return "not stopped" if success else "stopped"


def group_items(items: Sequence[int], size: int) -> Iterator[list[int]]:
    """Lists of `size`, the last one shorter."""
    rest = iter(items)
    while batch := list(itertools.islice(rest, size)):
        yield batch
