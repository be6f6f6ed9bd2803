"""Execution of a sweep in a folder, from its start or after an interruption."""

import contextlib
import pathlib
import time
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import jax
import numpy as np
from jax.experimental import multihost_utils

from diffabs.core.types import PyTree, Scalar, Table
from diffabs.runtime import provenance, stopwatch
from diffabs.simulate.drive.engine import log_xla_reason
from diffabs.sweep.engines import Engine, Local
from diffabs.sweep.manifest import Seals, describe_owner
from diffabs.sweep.results import Results
from diffabs.sweep.runner import find_study_objection
from diffabs.sweep.selection import choose_study_engine
from diffabs.sweep.store import Store, SweepError
from diffabs.sweep.study import Study

CHUNK_PRESENT, CHUNK_MISSING, CHUNK_UNKNOWN = 0, 1, 2  # states of a chunk


class SweepProgress(NamedTuple):
    """Progress of a sweep.

    Attributes:
        samples: Number of finished samples, those of earlier calls included.
        total: Number of samples of the sweep.
        here: Number of samples that this call has finished.
        seconds: Time of this call [s]; the time to compile is left out where `stopwatch.listen` was called.
        failed: Number of failed runs of this call.
        diverged: Number of diverged runs of this call.
        damaged: Numbers of the damaged chunks, which are computed again.
        refused: Number of samples of this call that were not run.
    """

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
        """Samples of this call per second."""
        return self.here / self.seconds if self.seconds > 0 else 0.0


def sweep(
    study: Study,
    out: str | pathlib.Path,
    *,
    resume: bool = False,
    on: Engine | None = None,
    progress: Callable[[SweepProgress], None] | None = None,
    stopping: Callable[[], bool] = lambda: False,
    source: Table | None = None,
) -> Results:
    """Compute every chunk of a study that the folder lacks, and return the results.

    Several processes (`jax.distributed.initialize`) may call this with the same study and a folder on a common disk.
    The first process holds the lock and writes the manifest. Each computes and writes its share, and all return the
    whole table. A process that fails raises its error after the others have finished their shares.

    Args:
        study: Study to run. For its engine "auto", the log says once why XLA makes the runs, if it does.
        out: Folder for the results; it is created.
        resume: Continue with a folder that already contains chunks of this study.
        on: Engine that computes the chunks; None is every device of this process.
        progress: Function that is called with the progress at the start and after every chunk.
        stopping: Function that is called after every chunk; True ends the run, and `resume` continues it later.
        source: Notes for the manifest, such as name and text of the scenario.

    Raises:
        ValueError: The study cannot be run, or not by its engine.
        SweepError: The folder contains something else, is in use, or cannot be written; or another process died.
        OSError: The disk is full. Finished chunks stay, and `resume` continues.
    """
    study, why_xla = choose_study_engine(study.check(), out, resume=resume, remote=getattr(on, "remote", False))
    if why_xla:
        log_xla_reason(why_xla)
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
def _begin_sweep(store: Store, study: Study, resume: bool, source: Table) -> Iterator[tuple[list[int], list[int]]]:
    """Yield the missing chunks, and the damaged ones among them.

    The first process holds the folder's lock until every process is done.
    """
    found, damaged = np.full(study.chunks, CHUNK_UNKNOWN, np.int8), []
    with contextlib.ExitStack() as held:
        try:
            if jax.process_index() == 0:
                held.enter_context(store.lock())
                notes = {**provenance.source_commit(), "source": dict(source), "units": study.units()}
                manifest = {**describe_owner(study), **notes}
                store.begin(manifest, resume=resume)
                whole, damaged = store.scan(Seals(manifest))
                found[:] = np.where(np.isin(np.arange(study.chunks), list(whole)), CHUNK_PRESENT, CHUNK_MISSING)
        finally:  # also after an error, because the other processes wait for this broadcast
            found = _synchronise(multihost_utils.broadcast_one_to_all, found)
        if CHUNK_UNKNOWN in found:
            raise SweepError(f"{store.folder}: the first process could not begin, and says why")
        try:
            yield np.flatnonzero(found == CHUNK_MISSING).tolist(), damaged
        except Exception:  # leaving at once would abort the processes that still compute
            _synchronise(multihost_utils.sync_global_devices, "chunks")
            raise
        _synchronise(multihost_utils.sync_global_devices, "chunks")


def _synchronise(meet: Callable[[PyTree], PyTree], what: Any) -> Scalar:
    """Meet all other processes and return the result; a single process returns `what`.

    Raises:
        SweepError: A process has died.
    """
    if jax.process_count() == 1:
        return what
    try:
        return meet(what)
    except jax.errors.JaxRuntimeError as error:
        raise SweepError("another process died; finished chunks stay; --resume continues the sweep") from error


class _ProgressCounter:
    """A counter of finished runs that reports each change."""

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
