"""How long this process has compiled: by XLA, which tells, and by compilers of other languages, which are counted here.

Compiling within compiling, and several threads at once, count once: it is the time in which anything was compiled."""

import contextlib
import threading
import time
from collections.abc import Iterator
from typing import Any

import jax.monitoring

COMPILE_EVENT = "/jax/core/compile/"  # how events of JAX begin that are about compiling, tracing included


class Stopwatch:
    """Spans of time [s], that may overlap, as one length."""

    def __init__(self) -> None:
        """Nothing was measured."""
        self._spans: list[tuple[float, float]] = []  # apart from each other, in order
        self._lock = threading.Lock()

    def add(self, start: float, end: float) -> None:
        """Count a span that has just ended."""
        with self._lock:
            while self._spans and self._spans[-1][1] >= start:
                earlier, later = self._spans.pop()
                start, end = min(start, earlier), max(end, later)
            self._spans.append((start, end))

    def seconds(self, since: float = 0.0) -> float:
        """Return how long all spans are, from an instant on."""
        with self._lock:
            return sum(max(end - max(start, since), 0.0) for start, end in self._spans)


_compiling = Stopwatch()
_listening = False


def count_compilations() -> None:
    """Count from now on what JAX compiles."""
    global _listening
    if not _listening:
        _listening = True
        jax.monitoring.register_event_duration_secs_listener(_add_duration)


def _add_duration(event: str, duration_secs: float, **more: Any) -> None:
    del more
    if event.startswith(COMPILE_EVENT):
        now = time.monotonic()
        _compiling.add(now - duration_secs, now)


@contextlib.contextmanager
def count_as_compiling() -> Iterator[None]:
    """Count what happens within as compiling."""
    start = time.monotonic()
    try:
        yield
    finally:
        _compiling.add(start, time.monotonic())


def compile_time_since(since: float = 0.0) -> float:
    """Return for how long [s] something was compiled from an instant of `time.monotonic` on; what has not ended yet is
    not in it."""
    return _compiling.seconds(since)
