"""Which engine makes many runs: XLA, or a program of this machine (`native`), which is loaded where it is asked for."""

import functools
import logging
from collections.abc import Callable
from typing import Any

from diffabs.simulate.solution import Run

ENGINES = ("auto", "xla", "kernel")
log = logging.getLogger("diffabs")


class EngineError(ValueError):
    """What stands against the engine that is asked for."""

    @classmethod
    def of(cls, line: Any) -> "EngineError":
        """Return the error that says so of a kernel."""
        return cls(f"engine = 'kernel' is not possible: {line}")


def by_engine(engine: str, native: Callable[[], Run], otherwise: Callable[[], Run], why_not: str = "") -> Run:
    """Return `native()`, or `otherwise()` as the engine says: "kernel" means what it says, "auto" the first if that can
    be, and tells the log once why it cannot. Raises ValueError for another name, or for what stands against "kernel".

    why_not: what is known already to stand against it"""
    if engine not in ENGINES:
        raise ValueError(f"engine = {engine!r} is unknown; there is {', '.join(ENGINES)}")
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
    tell(why_not)
    return otherwise()


def described(engine: str) -> dict[str, str]:
    """Return what a result says of the engine that made it: its name, and what decides the bits of a kernel."""
    if engine != "kernel":
        return {"name": engine}
    from diffabs.kernel import launch

    return {"name": engine} | launch.described()


@functools.cache
def tell(why_not: str) -> None:
    """Say in the log why XLA does what was left to be decided, once."""
    log.warning("runs are made by XLA, not by a kernel: %s", why_not)
