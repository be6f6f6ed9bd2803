"""Chunks computed by the workers of a Dask cluster: one on this machine, or one that is there.

A worker compiles a study once and computes one chunk at a time on one device; start one worker for each device.
Chunks come back as the bytes of their files, so workers need no common disk, and only this process writes. A chunk
whose worker dies is given to another one.

Dask sends programs, by pickle: its scheduler and workers must be machines that trust each other."""

import asyncio
import contextlib
import dataclasses
import logging
import os
import pathlib
import signal
import tempfile
import time
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache
from typing import Any

import jax
import numpy as np
from distributed import Client, KilledWorker, LocalCluster, Security, as_completed
from distributed.comm.core import connect

from diffabs.core import files, provenance
from diffabs.kernel import launch
from diffabs.sweep.engines import DECISIVE_PACKAGES, ComputedChunk, encode_computed_chunk
from diffabs.sweep.manifest import Seals, describe_owner
from diffabs.sweep.runner import Runner
from diffabs.sweep.store import SweepError, describe_differences
from diffabs.sweep.study import Study

CHUNKS_PER_THREAD = 2  # chunks in hand for each thread of the workers
MAX_CHUNK_RETRIES = (
    5  # times that a chunk may be given up by the scheduler, each after four workers died with it in hand
)
TIMEOUT_SECONDS = 10.0  # s for a scheduler to answer
LOOPBACK_ADDRESS = "127.0.0.1"
MAX_MESSAGE_CHARACTERS = 200  # characters of what Dask says
POLL_SECONDS = 0.05  # s between looks at what is finished; workers have their next chunk in hand meanwhile


class Dask:
    """An engine: the cluster of a scheduler (tcp://host:port), or `workers` processes on this machine."""

    def __init__(self, scheduler: str | None = None, workers: int | None = None):
        """As many workers as there are processors if not given."""
        self.scheduler, self.workers = scheduler, workers or os.cpu_count() or 1

    def run(
        self, study: Study, chunks: Sequence[int], stopping: Callable[[], bool]
    ) -> Generator[ComputedChunk, None, None]:
        """As they are finished. Raises SweepError for a scheduler that does not answer, has no workers, or has some
        with other versions; and for a chunk that all workers die of."""
        with self._client() as client:
            _check_workers(client, study.engine)
            yield from _compute_chunks(client, _convert_to_numpy(study), chunks, stopping)

    @contextlib.contextmanager
    def _client(self) -> Iterator[Client]:
        with contextlib.ExitStack() as opened:
            opened.enter_context(_silence_dask_logs())
            if self.scheduler is None:
                where: Any = opened.enter_context(_start_workers(self.workers))
            else:
                where = self.scheduler
            try:
                if where is self.scheduler:
                    _probe_scheduler(where)
                client = opened.enter_context(Client(where, timeout=TIMEOUT_SECONDS))
            except (OSError, TypeError, ValueError) as error:  # TypeError: tls without certificates
                why = str(error).splitlines()[0] if str(error) else f"no answer within {TIMEOUT_SECONDS:g} s"
                raise SweepError(f"the scheduler at {where} cannot be reached: {why}") from None
            yield client


@contextlib.contextmanager
def _silence_dask_logs() -> Iterator[None]:
    """Without what Dask logs on stderr, a traceback where a scheduler goes away: what concerns the caller is raised."""
    handlers = {handler: handler.level for handler in logging.getLogger("distributed").handlers}
    try:
        for handler in handlers:
            handler.setLevel(logging.CRITICAL)
        yield
    finally:
        for handler, level in handlers.items():
            handler.setLevel(level)


@contextlib.contextmanager
def _start_workers(workers: int) -> Iterator[Any]:
    """Workers on this machine, whom nobody else reaches: pages and ports of all of them are on the loopback interface.
    Raises SweepError where they do not start."""
    with contextlib.ExitStack() as opened:
        scratch = pathlib.Path(opened.enter_context(tempfile.TemporaryDirectory(prefix="diffabs-dask-")))
        opened.enter_context(files.temporary_path(scratch))
        try:
            cluster = LocalCluster(
                n_workers=workers,
                threads_per_worker=1,
                host=LOOPBACK_ADDRESS,
                dashboard_address=f"{LOOPBACK_ADDRESS}:0",
                worker_dashboard_address=f"{LOOPBACK_ADDRESS}:0",
                local_directory=str(scratch),
                silence_logs=logging.CRITICAL,
                preload=[__name__],
            )
        except Exception as error:  # Dask says so in several ways
            why = " ".join(str(error).split())[:MAX_MESSAGE_CHARACTERS] or type(error).__name__
            raise SweepError(f"the workers could not be started on this machine: {why}") from None
        yield opened.enter_context(cluster)


def dask_setup(_: Any) -> None:
    """What Dask runs in each worker that this process starts: Ctrl-C in a terminal is for this process alone."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def _probe_scheduler(scheduler: str) -> None:
    """Connect, and no more: a client that does not reach its scheduler leaves a thread behind which can block the next.
    Raises OSError, TypeError or ValueError; a TimeoutError also where something listens that is no scheduler."""

    async def call() -> None:
        comm = await connect(scheduler, timeout=TIMEOUT_SECONDS, **Security().get_connection_args("client"))
        comm.abort()

    async def patient() -> None:
        await asyncio.wait_for(call(), TIMEOUT_SECONDS + 1)  # `connect` itself waits for ever for the first words

    with ThreadPoolExecutor(1) as apart:  # a notebook's thread runs a loop already
        apart.submit(lambda: asyncio.run(patient())).result()


def _check_workers(client: Client, engine: str) -> None:
    try:
        client.wait_for_workers(1, timeout=TIMEOUT_SECONDS)
    except TimeoutError:
        raise SweepError(f"the scheduler has no worker within {TIMEOUT_SECONDS:g} s") from None
    here = _result_versions(engine)
    try:
        answers: Any = client.run(_result_versions, engine)
    except Exception as error:  # that is all Dask says of a worker without diffabs
        raise SweepError(f"a worker cannot say its versions: {str(error).splitlines()[0]}") from None
    for worker, there in answers.items():
        for line in describe_differences(there, here):
            raise SweepError(f"worker {worker}: {line}; results would not be those of one run")


def _result_versions(engine: str) -> dict[str, str]:
    """What can change a bit of the results, here: versions; of a kernel, the compiler and the processor."""
    return provenance.describe_platform(*DECISIVE_PACKAGES) | (
        launch.describe_kernel_build() if engine == "kernel" else {}
    )


def _compute_chunks(
    client: Client, study: Study, chunks: Sequence[int], stopping: Callable[[], bool]
) -> Iterator[ComputedChunk]:
    """Never more in hand than the workers need."""
    rest, deaths, finished = iter(chunks), dict.fromkeys(chunks, 0), as_completed()
    inside: dict[Any, int] = {}

    def give(chunk: int) -> None:
        future = client.submit(
            compute_chunk, study, chunk, pure=False
        )  # a key of its own, as other clients have theirs
        inside[future] = chunk
        finished.add(future)

    def fill() -> None:
        threads: Any = client.nthreads()
        free_slots = CHUNKS_PER_THREAD * max(1, sum(threads.values())) - len(inside)
        for chunk in [c for _, c in zip(range(free_slots), rest, strict=False)]:
            give(chunk)

    fill()
    while inside and _wait_for_chunk(client, finished, stopping):
        future = next(finished)
        chunk = inside.pop(future)
        try:
            yield future.result()
        except KilledWorker:
            deaths[chunk] += 1
            if deaths[chunk] > MAX_CHUNK_RETRIES:
                raise SweepError(f"chunk {chunk}: its workers died {deaths[chunk]} times") from None
            give(chunk)
        if not stopping():
            fill()


def _wait_for_chunk(client: Client, finished: Any, stopping: Callable[[], bool]) -> bool:
    """Wait for the next chunk. False where none will come: Ctrl-C in a terminal ends the workers, too, and not all of
    them come back."""
    while not finished.has_ready():
        if stopping() and not client.nthreads():
            return False
        time.sleep(POLL_SECONDS)
    return True


def _convert_to_numpy(study: Study) -> Study:
    """Without arrays of JAX: a process whose default is float32 would read them with half of their digits."""

    def plain(x: Any) -> Any:
        return np.asarray(x) if isinstance(x, jax.Array) else x

    # One by one: `tree.map` would sort them, and with them the columns.
    objectives = {name: jax.tree.map(plain, one) for name, one in study.objectives.items()}
    parts = {path: {name: jax.tree.map(plain, one) for name, one in by.items()} for path, by in study.parts.items()}
    return dataclasses.replace(study, loop=jax.tree.map(plain, study.loop), parts=parts, objectives=objectives)


def compute_chunk(study: Study, chunk: int) -> ComputedChunk:
    """A chunk, on a worker."""
    runner, seals = _prepare_runner(_StudyKey(study))
    return encode_computed_chunk(study, seals.of(chunk), runner.run([chunk])[0])


class _StudyKey:
    """Studies that were sent twice are one."""

    def __init__(self, study: Study):
        self.study, self.name = study, repr(study.table())

    def __hash__(self) -> int:
        return hash(self.name)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _StudyKey) and self.name == other.name


@lru_cache(maxsize=2)
def _prepare_runner(same: _StudyKey) -> tuple[Runner, Seals]:
    return Runner(same.study, jax.local_devices()[:1]), Seals(describe_owner(same.study))
