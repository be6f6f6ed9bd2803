"""Execution of a sweep in a folder, from its start or after an interruption."""

import contextlib
import pathlib
import time
from collections.abc import Callable, Iterator
from typing import NamedTuple

import jax

from diffabs.core.jax_flags import default_flags
from diffabs.core.kinds import format_value
from diffabs.core.types import Table
from diffabs.engine.drive.engine import log_xla_reason
from diffabs.host import provenance, stopwatch
from diffabs.host.interactive import ProgressLine, report_to
from diffabs.loop.closed_loop import Loop
from diffabs.uncertainty.sweep.engines import Engine, Local
from diffabs.uncertainty.sweep.manifest import Seals, describe_owner, read_notes
from diffabs.uncertainty.sweep.results import Results
from diffabs.uncertainty.sweep.selection import choose_study_engine
from diffabs.uncertainty.sweep.store import Store
from diffabs.uncertainty.sweep.study import Study


class SweepProgress(NamedTuple):
    """Progress of a sweep, in samples; each is one run, or is refused without a run.

    Attributes:
        samples: Number of finished samples, those of earlier calls included.
        total: Number of samples of the sweep.
        here: Number of samples that this call has finished.
        seconds: Time of this call [s], without the time to compile if `stopwatch.count_compilations` was called before.
        failed: Number of failed runs of this call, diverged ones included.
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

    def __str__(self) -> str:
        """Return the progress in a few words, with the time."""
        failed = f", {self.failed} failed" if self.failed else ""
        return f"sweep: {self.samples:,} of {self.total:,} samples{failed}, {self.seconds:.0f} s"

    def describe_count(self) -> str:
        """Return the numbers of samples and the rate on one line; before the first chunk, that it is compiling."""
        words = f"{self.samples:,} of {self.total:,}"
        if not self.here:
            return f"{words}, compiling" if self.samples < self.total else words
        words += f": {self.rate:,.0f}/s, {self.failed:,} failed ({self.diverged:,} diverged)"
        return f"{words}, {self.refused:,} refused" if self.refused else words

    def describe_damage(self) -> str:
        """Return which chunks are damaged and computed again, on one line."""
        count = len(self.damaged)
        first = ", ".join(map(str, self.damaged[:8])) + (f" and {count - 8} more" if count > 8 else "")
        return f"damaged, computed again: chunk{'s' if count > 1 else ''} {first}"

    @property
    def rate(self) -> float:
        """Samples of this call per second."""
        return self.here / self.seconds if self.seconds > 0 else 0.0


@default_flags()
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
    """Compute the missing chunks of a study, and return the results.

    A chunk is up to `Study.chunk` samples, which are computed together and written as one file. One process sweeps into
    a folder, and holds its lock. Several machines compute the chunks with `on=Dask(...)`. If `stopping` ends the sweep,
    the results lack the other chunks, and `Results.complete` is false.

    Args:
        study: Study to run. `study.engine`, XLA or a kernel, makes the runs. For "auto", the log says once why XLA
            makes them, if it does.
        out: Folder for the results; it is created.
        resume: Continue with a folder that already contains chunks of this study. Damaged ones are deleted and computed
            again.
        on: Devices or cluster that compute the chunks, `Local` or `Dask`; None is every device of this process.
        progress: Function that is called with the progress at the start and after every chunk. None shows a line in a
            notebook and in an interactive session.
        stopping: Function that is called before more chunks begin, which may be several at a time. After True none
            begins, and those in progress are written. `resume` continues later.
        source: Texts for the manifest, by name, such as the scenario.

    Raises:
        ValueError: `study` is no Study, or cannot be run; a note of `source` is no text; or JAX runs in several
            processes.
        SweepError: The folder contains something else, is in use, or cannot be written; or no kernel can make the runs.
        OSError: The disk is full. Finished chunks stay, and `resume` continues.

    See also:
        `sweep.Study`: What is computed.
        `sweep.Space`: Distributions of parameters.
        `sweep.Results`: The tables.
        `run_batch`: A batch in memory.
        `reliability.failure_probability`: Probabilities too small for a count.

    Notes:
        The mean of n samples has the standard error

            s/sqrt(n),   s^2 = sum (m_i - mean)^2/(n - 1)

        if the design draws them independently. Scrambled Sobol and Latin hypercube designs often have a smaller one.
        Intervals of means are asymmetric, as the samples are. Source: P. Hall, On the removal of skewness by
        transformation, J. R. Stat. Soc. B 54 (1992). A chunk's file contains its checksum in its name, and one program
        computes every chunk, so that an interrupted and an uninterrupted sweep are equal to the bit.

    Examples:
        >>> import tempfile
        >>> import diffabs as d
        >>> from diffabs import controllers, objectives, stops, sweep
        >>> parts = {"initial": d.BrakeStart(speed=10.0, slip=1.0), "stop": stops.SpeedReached(speed=5.0)}
        >>> loop = d.braking(controller=controllers.ConstantTorque(torque=500.0), **parts)  # a locked wheel
        >>> space = sweep.Space({"initial.speed": sweep.Normal(10.0, 0.5, low=6.0, high=14.0)})
        >>> metrics = {"stop_time": objectives.StopTime()}
        >>> study = sweep.Study(loop, space, samples=256, solver=d.FixedStep(5e-3, 6.0), objectives=metrics)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     times = sweep.sweep(study, folder).column("stop_time")
        >>> print(f"{times.mean():.2f} s, at most {times.max():.1f} s")
        0.67 s, at most 0.9 s
    """
    if jax.process_count() > 1:
        raise ValueError("sweep runs in one process; several machines: on=Dask(...)")
    notes = read_notes(source or {}, "source")
    if not isinstance(study, Study):
        kind = type(study).__name__ if isinstance(study, Loop) else format_value(study)
        raise ValueError(f"study = {kind} is no Study; Study(loop=..., space=..., samples=..., solver=...) makes one")
    store, study = Store(pathlib.Path(out)), study.check()
    if not resume:
        store.check_free()  # before a kernel is compiled
    study, why_xla = choose_study_engine(study, out, resume=resume, remote=getattr(on, "remote", False))
    if why_xla:
        log_xla_reason(why_xla)
    with _begin_sweep(store, study, resume, notes) as (missing, damaged), ProgressLine() as shown:
        tell, begun = report_to(shown, progress, str) or (lambda _: None), time.monotonic()
        before = study.samples - sum(b - a for a, b in map(study.bounds, missing))
        at = SweepProgress(before, study.samples, 0, 0.0, 0, 0, tuple(damaged))
        tell(at)
        if missing:
            with contextlib.closing((on or Local()).run(study, missing, stopping)) as finished:
                for computed in finished:
                    store.write(computed.chunk, computed.data)
                    at = at._replace(
                        samples=at.samples + computed.lanes,
                        here=at.here + computed.lanes,
                        seconds=time.monotonic() - begun - stopwatch.compile_time_since(begun),
                        failed=at.failed + computed.failed,
                        diverged=at.diverged + computed.diverged,
                        refused=at.refused + computed.refused,
                    )
                    tell(at)
    return Results(store.folder)


@contextlib.contextmanager
def _begin_sweep(store: Store, study: Study, resume: bool, source: Table) -> Iterator[tuple[list[int], list[int]]]:
    """Hold the folder's lock, and yield the missing chunks, and the damaged ones among them."""
    notes = {**provenance.source_commit(), "source": source, "units": study.units()}
    manifest = {**describe_owner(study), **notes}
    with store.lock():
        store.begin(manifest, resume=resume)
        whole, damaged = store.scan(Seals(manifest))
        yield [chunk for chunk in range(study.chunks) if chunk not in whole], damaged
