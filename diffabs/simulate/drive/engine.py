"""Selection of the engine of a batch: XLA, or a program of this machine (`kernel`), imported only on request."""

import functools
import logging
import os
from collections.abc import Callable
from typing import Any

from jax._src.xla_bridge import backends_are_initialized  # JAX has no public function that does not start the backends

from diffabs.simulate.types import Run

REQUESTABLE_ENGINES = ("auto", "xla", "kernel")
log = logging.getLogger("diffabs")
_forked_process = 0  # id of the first process that forked while XLA's threads ran; 0 without one


def _before_fork() -> None:
    global _forked_process
    if not _forked_process and backends_are_initialized():
        _forked_process = os.getpid()


if hasattr(os, "register_at_fork"):  # not on Windows, which has no fork
    os.register_at_fork(before=_before_fork)


def check_process() -> None:
    """Raise an error in a process that was forked after JAX had started.

    XLA's threads stay in the parent process. A kernel would wait for them forever.

    Raises:
        RuntimeError: The process was forked after JAX had started.
    """
    if _forked_process not in (0, os.getpid()):
        raise RuntimeError("no kernel runs after os.fork: XLA's threads stay in the parent; start processes by `spawn`")


class EngineError(ValueError):
    """The requested engine is not possible."""

    @classmethod
    def of(cls, line: Any) -> "EngineError":
        """Return the error for a kernel that is impossible for the reason `line`."""
        return cls(f"engine = 'kernel' is not possible: {line}")


def run_with_engine(engine: str, native: Callable[[], Run], otherwise: Callable[[], Run], why_not: str = "") -> Run:
    """Return the run of an engine; "auto" uses the kernel if possible, and otherwise XLA with one log message.

    Args:
        engine: "kernel", "xla" or "auto".
        native: Function that runs the kernel.
        otherwise: Function that runs XLA.
        why_not: Reason against a kernel that is already known, or "".

    Raises:
        ValueError: The name of the engine is unknown.
        EngineError: Engine "kernel" is requested but not possible.
    """
    if engine not in REQUESTABLE_ENGINES:
        raise ValueError(f"engine = {engine!r} is unknown; there is {', '.join(REQUESTABLE_ENGINES)}")
    if engine == "xla":
        return otherwise()
    if not why_not:
        # A local import: `import diffabs` must not need the kernel package.
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
    """Return the name of the engine of a result and, for a kernel, the properties that determine the bits of the
    result.

    Args:
        engine: Name of the engine.
    """
    if engine != "kernel":
        return {"name": engine}
    from diffabs.kernel import launch

    return {"name": engine} | launch.describe_kernel_build()


@functools.cache
def log_xla_reason(why_not: str) -> None:
    """Log the reason for XLA under engine "auto", once for each reason.

    Args:
        why_not: Reason against a kernel.
    """
    log.warning("runs are made by XLA, not by a kernel: %s", why_not)
