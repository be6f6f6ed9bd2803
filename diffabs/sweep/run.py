"""Run a sweep into a folder, or go on with one."""

import pathlib
import time
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from diffabs import provenance
from diffabs.sweep.engines import DECISIVE, Engine, Local
from diffabs.sweep.results import Results
from diffabs.sweep.store import Store
from diffabs.sweep.study import Study


class Progress(NamedTuple):
    """How far a sweep is: samples that are done, of how many, those that this run has done in how many seconds, and
    how many of these failed and diverged; `damaged`: chunks that were found damaged and are computed again."""

    samples: int
    total: int
    here: int
    seconds: float
    failed: int
    diverged: int
    damaged: tuple[int, ...]

    @property
    def rate(self) -> float:
        """Runs per second."""
        return self.here / self.seconds if self.seconds > 0 else 0.0


def sweep(
    study: Study,
    out: str | pathlib.Path,
    *,
    resume: bool = False,
    engine: Engine | None = None,
    progress: Callable[[Progress], None] | None = None,
    stopping: Callable[[], bool] = lambda: False,
    source: Mapping[str, Any] | None = None,
) -> Results:
    """Compute every chunk that the folder does not have yet, and open it.

    stopping: asked after every chunk; True ends the run, and `resume` goes on later
    source: put into the manifest, for whoever reads it

    Raises:
        ValueError: a study that cannot be run.
        SweepError: a folder that holds something else, is in use, or cannot be written.
        OSError: a full disk; what is there stays, and `resume` goes on.
    """
    study.check()
    store = Store(pathlib.Path(out))
    with store.locked():
        described = {"study": study.table(), "versions": provenance.versions(*DECISIVE), **provenance.commit()}
        store.begin({**described, "source": dict(source or {})}, resume=resume)
        whole, damaged = store.scan()
        missing = [chunk for chunk in range(study.chunks) if chunk not in whole]
        tally = _Tally(study, missing, tuple(damaged), progress)
        for done in (engine or Local()).run(study, missing, stopping):
            store.write(done.chunk, done.data)
            tally.add(done)
    return Results(store.folder)


class _Tally:
    """Counts what is done, and tells."""

    def __init__(self, study: Study, missing: list[int], damaged: tuple[int, ...], told: Any):
        self.total, self.told, self.damaged = study.samples, told, damaged
        self.before = study.samples - sum(b - a for a, b in map(study.bounds, missing))
        self.here = self.failed = self.diverged = 0
        self.begun = time.monotonic()
        self.tell()

    def add(self, done: Any) -> None:
        self.here += done.lanes
        self.failed += done.failed
        self.diverged += done.diverged
        self.tell()

    def tell(self) -> None:
        if self.told:
            seconds = time.monotonic() - self.begun
            counts = (self.before + self.here, self.total, self.here, seconds, self.failed, self.diverged)
            self.told(Progress(*counts, self.damaged))
