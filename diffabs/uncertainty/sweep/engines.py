"""Engines that compute the chunks of a sweep: the devices of this process here, a Dask cluster in `cluster`."""

from collections.abc import Callable, Generator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple, Protocol

import numpy as np

from diffabs.core.types import PyTree
from diffabs.host.process import core_count, default_devices
from diffabs.uncertainty.sweep.manifest import DECISIVE_PACKAGES as DECISIVE_PACKAGES
from diffabs.uncertainty.sweep.manifest import Seals, describe_owner
from diffabs.uncertainty.sweep.runner import Columns, Runner
from diffabs.uncertainty.sweep.seal import Seal, encode_chunk
from diffabs.uncertainty.sweep.study import Study, failure_masks, is_accepted


class ComputedChunk(NamedTuple):
    """A finished chunk.

    Attributes:
        chunk: Number of the chunk.
        data: Bytes of its file.
        lanes: Number of samples, those that were not run included.
        failed: Number of failed runs, diverged ones included.
        diverged: Number of diverged runs.
        refused: Number of samples that were not run.
    """

    chunk: int
    data: bytes
    lanes: int
    failed: int
    diverged: int
    refused: int = 0


class Engine(Protocol):
    """A computer of chunks, in any order.

    An engine whose chunks may be computed on other machines has the attribute `remote = True`: XLA then makes the runs
    of a study with the engine "auto".
    """

    def run(
        self, study: Study, chunks: Sequence[int], stopping: Callable[[], bool]
    ) -> Generator[ComputedChunk, None, None]:
        """Yield each of the `chunks` of a `study` once.

        `stopping()` is called before more chunks begin. After it returns true, no new chunk begins, and the chunks in
        progress are still yielded. If the generator is closed, they are discarded.
        """
        ...


class Local:
    """An engine that runs one chunk at a time on each device of this process.

    XLA computes a chunk on one core, so a processor then gets as many chunks at a time as it has cores. A kernel uses
    all cores for one chunk.
    """

    def __init__(self, devices: Sequence[PyTree] | None = None):
        """Set the `devices`; by default all local ones."""
        self.devices: list[PyTree] | None = list(devices) if devices else None

    def places(self, study: Study) -> list[PyTree]:
        """Return the devices of the chunks that run at a time, one for each; a processor appears once for each core.

        Args:
            study: Study of the sweep, with engine "xla" or "kernel".
        """
        if self.devices is not None:
            return self.devices
        devices = default_devices()
        alone = study.engine == "kernel" or any(device.platform != "cpu" for device in devices)
        return devices * (1 if alone else max(1, core_count() // len(devices)))

    def run(
        self, study: Study, chunks: Sequence[int], stopping: Callable[[], bool]
    ) -> Generator[ComputedChunk, None, None]:
        """Yield the `chunks` of a `study` in order, until `stopping()` is true.

        The next chunks run while one is encoded.
        """
        places = self.places(study)
        runner, seals = Runner(study, places), Seals(describe_owner(study))
        groups = iter([chunks[k : k + len(places)] for k in range(0, len(chunks), len(places))])
        with ThreadPoolExecutor(1) as beside:
            together = next(groups, None)
            coming = beside.submit(runner.run, together) if together else None
            while together and coming:
                group, group_columns = together, coming.result()
                together = None if stopping() else next(groups, None)
                coming = beside.submit(runner.run, together) if together else None
                for chunk, columns in zip(group, group_columns, strict=True):
                    yield encode_computed_chunk(study, seals.of(chunk), columns)


def encode_computed_chunk(study: Study, seal: Seal, columns: Columns) -> ComputedChunk:
    """Return a chunk with its encoded columns and its counts."""
    kinds = failure_masks(columns.__getitem__, study.failure_bounds, study.success)
    failed, accepted = np.any(list(kinds.values()), axis=0), is_accepted(columns["refused"])
    counts = len(failed), int(failed.sum()), int(np.sum(columns["diverged"] & accepted)), int(np.sum(~accepted))
    return ComputedChunk(seal.chunk, encode_chunk(columns, seal, study.units()), *counts)
