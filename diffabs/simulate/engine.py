"""Which engine makes many runs: XLA, or a program of this machine (`native`), which is loaded where it is asked for."""

import functools
import logging
import os
from collections.abc import Callable
from typing import Any

from jax._src.xla_bridge import backends_are_initialized  # no public function says so without starting them

from diffabs.simulate.solution import Run

REQUESTABLE_ENGINES = ("auto", "xla", "kernel")
log = logging.getLogger("diffabs")
_forked_process = 0  # id of the first process that forked while XLA's threads ran; 0 if there is none


def _before_fork() -> None:
    global _forked_process
    if not _forked_process and backends_are_initialized():
        _forked_process = os.getpid()


if hasattr(os, "register_at_fork"):  # not on Windows, which has no fork
    os.register_at_fork(before=_before_fork)


def check_process() -> None:
    """Raise RuntimeError in a process that was forked after JAX had started. XLA's threads stay in the parent; a kernel
    would wait for them for ever."""
    if _forked_process not in (0, os.getpid()):
        raise RuntimeError("no kernel runs after os.fork: XLA's threads stay in the parent; start processes by `spawn`")


class EngineError(ValueError):
    """What stands against the engine that is asked for."""

    @classmethod
    def of(cls, line: Any) -> "EngineError":
        """Return the error that a kernel is not possible, with this reason."""
        return cls(f"engine = 'kernel' is not possible: {line}")


def run_with_engine(engine: str, native: Callable[[], Run], otherwise: Callable[[], Run], why_not: str = "") -> Run:
    """Return the run of an engine: "kernel" by `native()`, "xla" by `otherwise()`. "auto" takes the kernel where one is
    possible, and else tells the log once why not. Raises ValueError for another name, and EngineError where a kernel
    that is asked for is not possible.

    why_not: a reason against a kernel that is known already"""
    if engine not in REQUESTABLE_ENGINES:
        raise ValueError(f"engine = {engine!r} is unknown; there is {', '.join(REQUESTABLE_ENGINES)}")
    if engine == "xla":
        return otherwise()
    if not why_not:
        from diffabs.kernel.compilers import NoCompiler
        from diffabs.kernel.primitives import Unsupported

        try:
            return native()
        except (Unsupported, NoCompiler) as error:
            why_not = str(error)
    if engine == "kernel":
        raise EngineError.of(why_not)
    log_xla_reason(why_not)
    return otherwise()


def describe_engine(engine: str) -> dict[str, str]:
    """Return what a result says of the engine that made it: its name, and what decides the bits of a kernel."""
    if engine != "kernel":
        return {"name": engine}
    from diffabs.kernel import launch

    return {"name": engine} | launch.describe_kernel_build()


@functools.cache
def log_xla_reason(why_not: str) -> None:
    """Log why "auto" takes XLA, once for each reason."""
    log.warning("runs are made by XLA, not by a kernel: %s", why_not)
