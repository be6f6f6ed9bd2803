"""Computation of chunks by the workers of a Dask cluster, started on this machine or already running.

A worker compiles a study once and computes one chunk at a time on one device. Start one worker for each device. Chunks
return as the bytes of their files. So workers need no common disk, and only this process writes. If a worker dies,
another one gets its chunk.

Dask sends programs by pickle: scheduler and workers must be machines that trust each other.
"""

import asyncio
import contextlib
import dataclasses
import logging
import pathlib
import signal
import tempfile
import time
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax
import numpy as np
from distributed import Client, KilledWorker, LocalCluster, Security, as_completed, get_worker
from distributed.comm.core import connect

from diffabs.compiler import pipeline
from diffabs.core.types import JsonObject, PyTree, Scalar
from diffabs.host import files, provenance
from diffabs.host.process import core_count, default_devices
from diffabs.host.values import read_whole
from diffabs.uncertainty.sweep.engines import DECISIVE_PACKAGES, ComputedChunk, encode_computed_chunk
from diffabs.uncertainty.sweep.manifest import Seals, describe_owner
from diffabs.uncertainty.sweep.runner import Runner
from diffabs.uncertainty.sweep.seal import Seal
from diffabs.uncertainty.sweep.store import SweepError, describe_differences
from diffabs.uncertainty.sweep.study import Study

CHUNKS_PER_THREAD = 2  # chunks in progress or waiting for each thread of the workers
MAX_CHUNK_RETRIES = 5  # retries of a chunk that the scheduler gives up; it does so after four workers died with it
TIMEOUT_SECONDS = 10.0  # time for a scheduler to answer [s]
MAX_WORKERS = 2**16  # worker processes on this machine
LOOPBACK_ADDRESS = "127.0.0.1"
MAX_MESSAGE_CHARACTERS = 200  # characters of a message of Dask
POLL_SECONDS = 0.05  # time between checks for finished chunks [s]; workers already have their next chunk


class Dask:
    """An engine that computes chunks on a Dask cluster.

    Attributes:
        scheduler: Address of a scheduler, tcp://host:port; None starts workers on this machine.
        workers: Number of worker processes on this machine.
    """

    def __init__(self, scheduler: str | None = None, workers: int | None = None):
        """Set the cluster: `scheduler`, or else `workers` processes here, by default one for each core."""
        self.scheduler = scheduler
        self.workers: int = core_count() if workers is None else read_whole(workers, 1, MAX_WORKERS, "workers")

    @property
    def remote(self) -> bool:
        """Whether other machines may compute the chunks."""
        return self.scheduler is not None

    def run(
        self, study: Study, chunks: Sequence[int], stopping: Callable[[], bool]
    ) -> Generator[ComputedChunk, None, None]:
        """Yield the `chunks` of a `study` in the order in which they finish, until `stopping()` is true.

        Raises:
            SweepError: The scheduler does not answer, has no workers, or has workers with other versions; or the
                workers of one chunk die again and again.
        """
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
    """Hide Dask's log on stderr, including tracebacks when a scheduler disappears. Errors for the caller are raised."""
    handlers = {handler: handler.level for handler in logging.getLogger("distributed").handlers}
    try:
        for handler in handlers:
            handler.setLevel(logging.CRITICAL)
        yield
    finally:
        for handler, level in handlers.items():
            handler.setLevel(level)


@contextlib.contextmanager
def _start_workers(workers: int) -> Iterator[PyTree]:
    """Start workers on this machine, with all pages and ports on the loopback interface."""
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
        except Exception as error:  # Dask raises several types
            why = " ".join(str(error).split())[:MAX_MESSAGE_CHARACTERS] or type(error).__name__
            raise SweepError(f"the workers could not be started on this machine: {why}") from None
        yield opened.enter_context(cluster)


def dask_setup(_: object) -> None:
    """Ignore Ctrl-C in a new worker, where Dask calls this: only the process in the terminal handles it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def _probe_scheduler(scheduler: str) -> None:
    """Connect to a scheduler and disconnect.

    A client that does not reach its scheduler would leave a thread behind, which can block the next client.
    """

    async def call() -> None:
        comm = await connect(scheduler, timeout=TIMEOUT_SECONDS, **Security().get_connection_args("client"))
        comm.abort()

    async def patient() -> None:
        await asyncio.wait_for(call(), TIMEOUT_SECONDS + 1)  # `connect` has no timeout for the handshake

    with ThreadPoolExecutor(1) as apart:  # the thread of a notebook already runs an event loop
        apart.submit(lambda: asyncio.run(patient())).result()


def _check_workers(client: Client, engine: str) -> None:
    try:
        client.wait_for_workers(1, timeout=TIMEOUT_SECONDS)
    except TimeoutError:
        raise SweepError(f"the scheduler has no worker within {TIMEOUT_SECONDS:g} s") from None
    own_versions = _result_versions(engine)
    try:
        answers: Any = client.run(_result_versions, engine)
    except Exception as error:  # Dask raises any type for a worker without diffabs
        raise SweepError(f"a worker cannot say its versions: {(str(error) or repr(error)).splitlines()[0]}") from None
    for worker, worker_versions in answers.items():
        _check_worker(worker, worker_versions, own_versions)


def _check_worker(worker: str, worker_versions: JsonObject, own_versions: JsonObject) -> None:
    for line in describe_differences(worker_versions, own_versions):
        raise SweepError(f"worker {worker}: {line}; results would not be those of one run")


def _result_versions(engine: str) -> dict[str, str]:
    """Return the versions here that can change a bit of the results. A kernel adds its compiler and processor."""
    return provenance.describe_platform(*DECISIVE_PACKAGES) | (
        pipeline.describe_kernel_build() if engine == "kernel" else {}
    )


def _compute_chunks(
    client: Client, study: Study, chunks: Sequence[int], stopping: Callable[[], bool]
) -> Iterator[ComputedChunk]:
    """Yield chunks as they finish, with at most CHUNKS_PER_THREAD chunks for each worker thread in progress."""
    pending, deaths, finished = iter(chunks), dict.fromkeys(chunks, 0), as_completed()
    seals, versions = Seals(describe_owner(study)), _result_versions(study.engine)
    inside: dict[PyTree, int] = {}

    def give(chunk: int) -> None:
        # `pure=False` makes a new key, so that the result of another client is not reused.
        future = client.submit(compute_chunk, study, seals.of(chunk), versions, pure=False)
        inside[future] = chunk
        finished.add(future)

    def fill() -> None:
        threads: Any = client.nthreads()
        free_slots = CHUNKS_PER_THREAD * max(1, sum(threads.values())) - len(inside)
        for chunk in [c for _, c in zip(range(free_slots), pending, strict=False)]:
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


def _wait_for_chunk(client: Client, finished: as_completed, stopping: Callable[[], bool]) -> bool:
    """Wait for the next chunk and return True, or False if none will come: Ctrl-C in a terminal also ends workers."""
    while not finished.has_ready():
        if stopping() and not client.nthreads():
            return False
        time.sleep(POLL_SECONDS)
    return True


def _convert_to_numpy(study: Study) -> Study:
    """Return the study with NumPy arrays: a process with float32 as default would halve the digits of JAX arrays."""

    def plain(x: Scalar) -> np.ndarray | float | int:
        return np.asarray(x) if isinstance(x, jax.Array) else x

    # One by one: `tree.map` over the dictionaries would sort their keys, and so change the order of the columns.
    objectives = {name: jax.tree.map(plain, part) for name, part in study.objectives.items()}
    parts = {path: {name: jax.tree.map(plain, part) for name, part in by.items()} for path, by in study.parts.items()}
    return dataclasses.replace(study, loop=jax.tree.map(plain, study.loop), parts=parts, objectives=objectives)


def compute_chunk(study: Study, seal: Seal, versions: JsonObject) -> ComputedChunk:
    """Return one chunk, computed on a worker, after a check of its versions: it may have joined later than others."""
    _check_worker(get_worker().address, _result_versions(study.engine), versions)
    return encode_computed_chunk(study, seal, Runner(study, default_devices()[:1]).run([seal.chunk])[0])
