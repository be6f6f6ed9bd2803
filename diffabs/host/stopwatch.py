"""The compilation time of this process: by XLA, as JAX reports it, and by compilers of other languages, timed here.

Nested compilations and simultaneous threads count once: the time is that of the union of all spans.
"""

import contextlib
import threading
import time
from collections.abc import Iterator

import jax.monitoring

COMPILE_EVENT = "/jax/core/compile/"  # prefix of JAX's events about compilation, including tracing


class Stopwatch:
    """The total length of time spans [s] that may overlap."""

    def __init__(self) -> None:
        """Create a stopwatch without spans."""
        self._spans: list[tuple[float, float]] = []  # disjoint, in increasing order
        self._lock = threading.Lock()

    def add(self, start: float, end: float) -> None:
        """Add a span from `start` to `end` [s]. Calls must come in the order of their ends."""
        with self._lock:
            # Spans are added in the order of their ends, so only the last ones can overlap the new span.
            while self._spans and self._spans[-1][1] >= start:
                earlier, later = self._spans.pop()
                start, end = min(start, earlier), max(end, later)
            self._spans.append((start, end))

    def seconds(self, since: float = 0.0) -> float:
        """Return the length [s] of the union of all spans, without their time before the instant `since` [s]."""
        with self._lock:
            return sum(max(end - max(start, since), 0.0) for start, end in self._spans)


_compiling = Stopwatch()
_listening = False


def count_compilations() -> None:
    """Count the time of JAX's compilations, tracing included, from now on."""
    global _listening
    if not _listening:
        _listening = True
        jax.monitoring.register_event_duration_secs_listener(_add_duration)


def _add_duration(event: str, duration_secs: float, **more: object) -> None:
    del more
    if event.startswith(COMPILE_EVENT):
        now = time.monotonic()
        _compiling.add(now - duration_secs, now)


@contextlib.contextmanager
def count_as_compiling() -> Iterator[None]:
    """Count the duration of the context as compilation."""
    start = time.monotonic()
    try:
        yield
    finally:
        _compiling.add(start, time.monotonic())


def compile_time_since(since: float = 0.0) -> float:
    """Return the compilation time [s] since an instant of `time.monotonic`, without compilations that have not ended.

    It covers the compilations of JAX only after `count_compilations`.
    """
    return _compiling.seconds(since)
