"""Run a sweep into a folder, or go on with one."""

import contextlib
import pathlib
import time
from collections.abc import Callable, Iterator, Mapping
from typing import Any, NamedTuple

import jax
import numpy as np
from jax.experimental import multihost_utils

from diffabs.core import provenance, stopwatch
from diffabs.sweep.engines import Engine, Local
from diffabs.sweep.manifest import Seals, describe_owner
from diffabs.sweep.results import Results
from diffabs.sweep.runner import find_study_objection
from diffabs.sweep.store import Store, SweepError
from diffabs.sweep.study import Study

CHUNK_PRESENT, CHUNK_MISSING, CHUNK_UNKNOWN = 0, 1, 2  # a chunk


class SweepProgress(NamedTuple):
    """How far a sweep is: samples that are done, of how many, those that this run has done in how many seconds
    (compiling left out, where `stopwatch.listen` counts it), and how many of these failed, diverged and were refused;
    `damaged`: chunks found damaged that are computed again."""

    samples: int
    total: int
    here: int
    seconds: float
    failed: int
    diverged: int
    damaged: tuple[int, ...]
    refused: int = 0

    @property
    def rate(self) -> float:
        """Runs per second."""
        return self.here / self.seconds if self.seconds > 0 else 0.0


def sweep(
    study: Study,
    out: str | pathlib.Path,
    *,
    resume: bool = False,
    on: Engine | None = None,
    progress: Callable[[SweepProgress], None] | None = None,
    stopping: Callable[[], bool] = lambda: False,
    source: Mapping[str, Any] | None = None,
) -> Results:
    """Compute every chunk of a study that the folder does not have yet, and return the results.

    Of several processes (`jax.distributed.initialize`) that all call this with the same study and a folder on a common
    disk, the first has the lock and the manifest, each computes and writes its share, and all return the whole. One
    that fails says so after the others have finished theirs.

    out: the folder; it is made
    resume: go on with a folder that has chunks of this study already
    on: who computes; None is every device of this process
    progress: told after every chunk how many runs are done
    stopping: asked after every chunk; True ends the run, and `resume` goes on later
    source: put into the manifest, for whoever reads it

    Raises:
        ValueError: a study that cannot be run, or not by its engine.
        SweepError: a folder that holds something else, is in use, or cannot be written; another process died.
        OSError: a full disk; what is there stays, and `resume` goes on.
    """
    study.check()
    if study.engine != "xla" and (line := find_study_objection(study)):
        raise ValueError(line)
    store = Store(pathlib.Path(out))
    with _begin_sweep(store, study, resume, source or {}) as (missing, damaged):
        counter = _ProgressCounter(study, missing, tuple(damaged), progress)
        if missing:
            with contextlib.closing((on or Local()).run(study, missing, stopping)) as finished:
                for done in finished:
                    store.write(done.chunk, done.data)
                    counter.add(done)
    return Results(store.folder)


@contextlib.contextmanager
def _begin_sweep(
    store: Store, study: Study, resume: bool, source: Mapping[str, Any]
) -> Iterator[tuple[list[int], list[int]]]:
    """The chunks that are missing, and those of them that were damaged. Until every process is done, the first one has
    the folder's lock."""
    found, damaged = np.full(study.chunks, CHUNK_UNKNOWN, np.int8), []
    with contextlib.ExitStack() as held:
        try:
            if jax.process_index() == 0:
                held.enter_context(store.locked())
                notes = {**provenance.commit(), "source": dict(source), "units": study.units()}
                manifest = {**describe_owner(study), **notes}
                store.begin(manifest, resume=resume)
                whole, damaged = store.scan(Seals(manifest))
                found[:] = np.where(np.isin(np.arange(study.chunks), list(whole)), CHUNK_PRESENT, CHUNK_MISSING)
        finally:  # whatever happened: the others wait for this
            found = _synchronise(multihost_utils.broadcast_one_to_all, found)
        if CHUNK_UNKNOWN in found:
            raise SweepError(f"{store.folder}: the first process could not begin, and says why")
        try:
            yield np.flatnonzero(found == CHUNK_MISSING).tolist(), damaged
        except Exception:  # a process that left at once would take those with it that still compute
            _synchronise(multihost_utils.sync_global_devices, "chunks")
            raise
        _synchronise(multihost_utils.sync_global_devices, "chunks")


def _synchronise(meet: Callable[[Any], Any], what: Any) -> Any:
    """What all processes do at the same time; nothing where there is but one. Raises SweepError if one has died."""
    if jax.process_count() == 1:
        return what
    try:
        return meet(what)
    except jax.errors.JaxRuntimeError as error:
        raise SweepError("another process died; finished chunks stay, and resume goes on") from error


class _ProgressCounter:
    """Counts what is done, and tells."""

    def __init__(self, study: Study, missing: list[int], damaged: tuple[int, ...], told: Any):
        self.total, self.told, self.damaged = study.samples, told, damaged
        self.before = study.samples - sum(b - a for a, b in map(study.bounds, missing))
        self.here = self.failed = self.diverged = self.refused = 0
        self.begun = time.monotonic()
        self.tell()

    def add(self, done: Any) -> None:
        self.here += done.lanes
        self.failed += done.failed
        self.diverged += done.diverged
        self.refused += done.refused
        self.tell()

    def tell(self) -> None:
        if self.told:
            seconds = time.monotonic() - self.begun - stopwatch.compile_time_since(self.begun)
            counts = (self.before + self.here, self.total, self.here, seconds, self.failed, self.diverged)
            self.told(SweepProgress(*counts, self.damaged, self.refused))
