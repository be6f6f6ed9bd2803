"""Selection of the engine of a concrete batch: XLA, or a program of this machine (`kernel`). `deferred` selects that
of traced runs.

The default engine is "auto": a kernel where one can make the runs, and XLA otherwise. A kernel has its first result
about as early as XLA if its C++ compiler has to run, and earlier otherwise (`docs/performance.md`). So "auto" does not
depend on the number of runs.
"""

import functools
import logging
import os
from collections.abc import Callable, Hashable
from typing import Any, TypeVar

import jax
from jax._src.xla_bridge import backends_are_initialized  # JAX has no public function that does not start the backends

from diffabs.host.process import default_platform

T = TypeVar("T")
REQUESTABLE_ENGINES = ("auto", "xla", "kernel")
ENGINE_VARIABLE = "DIFFABS_ENGINE"  # environment variable: the engine that "auto" stands for, "xla" or "kernel"
log = logging.getLogger("diffabs")
_refused: dict[Hashable, str] = {}  # reason against a kernel, by `_describe_structure`
_forked_process = 0  # id of the first process that forked while XLA's threads ran; 0 without one


def _before_fork() -> None:
    global _forked_process
    if not _forked_process and backends_are_initialized():
        _forked_process = os.getpid()


if hasattr(os, "register_at_fork"):  # not on Windows, which has no fork
    os.register_at_fork(before=_before_fork)


def is_forked() -> bool:
    """Return whether this process was forked after JAX had started: a kernel would wait for XLA's threads forever."""
    return _forked_process not in (0, os.getpid())


def check_process() -> None:
    """Raise a RuntimeError in a process in which no kernel runs (`is_forked`)."""
    if is_forked():
        raise RuntimeError("no kernel runs after os.fork: XLA's threads stay in the parent; start processes by `spawn`")


class EngineError(ValueError):
    """The requested engine is not possible."""

    @classmethod
    def of(cls, line: object) -> "EngineError":
        """Return the error for a kernel that is impossible for the reason `line`."""
        return cls(f"engine = 'kernel' is not possible: {line}")


def resolve_request(engine: str) -> str:
    """Return the engine that a request means: itself, or that of $DIFFABS_ENGINE for "auto" if it is set."""
    if engine not in REQUESTABLE_ENGINES:
        raise ValueError(f"engine = {engine!r} is unknown; there is {', '.join(REQUESTABLE_ENGINES)}")
    if engine != "auto":
        return engine
    meant = os.environ.get(ENGINE_VARIABLE) or engine
    if meant not in REQUESTABLE_ENGINES:
        raise ValueError(f"{ENGINE_VARIABLE} = {meant!r} is unknown; there is {', '.join(REQUESTABLE_ENGINES)}")
    return meant


def default_engine() -> str:
    """Return the engine that "auto" means: that of $DIFFABS_ENGINE if it is set; a kernel is never required."""
    return "xla" if resolve_request("auto") == "xla" else "auto"


def _describe_structure(data: object) -> Hashable:
    """Return what decides whether a kernel is possible: structure and shapes of the data, platform, asked compiler."""
    from diffabs.compiler.runtime.toolchain import COMPILER

    def describe(x: Any) -> Hashable:
        if hasattr(x, "dtype"):
            return x.shape, x.dtype
        return type(x) if isinstance(x, bool | int | float) else repr(x)  # a solver is a leaf

    leaves, structure = jax.tree.flatten(data)
    return structure, tuple(map(describe, leaves)), default_platform(), os.environ.get(COMPILER)


def run_with_engine(
    engine: str,
    native: Callable[[], T],
    otherwise: Callable[[], T],
    data: object,
    why_not: str = "",
    why_xla: str = "",
) -> T:
    """Return the result of an engine; "auto" uses the kernel if possible, and otherwise XLA.

    If a kernel is impossible, "auto" does not try again for data of the same structure. The trial takes longer than
    many a batch. `native` runs the kernel and `otherwise` XLA. `why_not` is a reason against a kernel that is already
    known, and `why_xla` one for which "auto" does not try it.
    """
    if engine == "xla":
        return otherwise()
    if engine == "auto" and (why_not or why_xla):
        log_own_choice(why_not or why_xla)
        return otherwise()
    structure = _describe_structure(data) if engine == "auto" else None
    why_not = why_not or _refused.get(structure, "")
    if not why_not:
        # A local import: `import diffabs` must not need the kernel package.
        from diffabs.compiler.lower.rules import Unsupported
        from diffabs.compiler.runtime.toolchain import NoCompiler

        try:
            run = native()
        except (Unsupported, NoCompiler) as error:
            why_not = str(error)
        else:
            log_kernel()
            return run
    if engine == "kernel":
        raise EngineError.of(why_not)
    _refused[structure] = why_not
    log_xla_reason(why_not)
    return otherwise()


def describe_engine(engine: str) -> dict[str, str]:
    """Return the name of the engine of a result and, for a kernel, what determines the bits of the result."""
    if engine != "kernel":
        return {"name": engine}
    from diffabs.compiler import pipeline

    return {"name": engine} | pipeline.describe_kernel_build()


# Once for each reason: a kernel is impossible, or the call is of a kind that XLA serves.
log_xla_reason = functools.cache(functools.partial(log.warning, "runs are made by XLA, not by a kernel: %s"))
log_own_choice = functools.cache(functools.partial(log.info, "runs are made by XLA: %s"))


@functools.cache
def log_kernel() -> None:
    """Log once that runs are made by a kernel, and the compiler that made it."""
    log.info("runs are made by a kernel (%s)", describe_engine("kernel")["compiler"])
