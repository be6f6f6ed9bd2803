"""Programs that run once: compiling them is what they cost.

XLA is told to compile faster where a function is called with numbers. Inside jit, and so under vmap and grad, what
surrounds it decides."""

import functools
import os
from collections.abc import Callable, Iterable
from typing import Any, TypeVar

import jax
from jax.core import Tracer

F = TypeVar("F", bound=Callable)

# JAX 0.10: its older emitters make the same numbers as the newer ones in half the time; later JAX has no such option.
# Of a program's 32 parts, which cores may compile at the same time, each costs: four take a tenth less time.
SAME_RESULT_OPTIONS: dict[str, Any] = {"xla_cpu_use_fusion_emitters": False} if jax.__version_info__ < (0, 11) else {}
if SAME_RESULT_OPTIONS and "codegen_split_count" not in os.environ.get("XLA_FLAGS", ""):
    SAME_RESULT_OPTIONS["xla_cpu_parallel_codegen_split_count"] = 4
QUICK_COMPILE_OPTIONS: dict[str, Any] = {
    **SAME_RESULT_OPTIONS,
    "xla_backend_optimization_level": 0,
}  # rounds differently


def compile_once(static: Iterable[str] | int = (), options: dict[str, Any] | None = None) -> Callable[[F], F]:
    """Return the decorator `jax.jit` for a function that is mostly called with numbers, once for each of its shapes.

    static: names of static arguments, by which they are given, or the number of leading ones
    options: of XLA (`SAME_RESULT_OPTIONS`, `QUICK_COMPILE_OPTIONS`), which apply where nothing is traced"""
    leading, names = (static, ()) if isinstance(static, int) else (0, tuple(static))
    fixed: dict[str, Any] = {"static_argnums": tuple(range(leading)), "static_argnames": names}

    def decorate(function: F) -> F:
        plain: Any = jax.jit(function, **fixed)
        quick: Any = jax.jit(function, **fixed, compiler_options=options) if options else plain

        @functools.wraps(function)
        def call(*args: Any, **more: Any) -> Any:
            return (plain if is_traced(args, more) else quick)(*args, **more)

        call._cache_size = lambda: plain._cache_size() + quick._cache_size()  # pyright: ignore
        return call  # pyright: ignore[reportReturnType]

    return decorate


def is_traced(*trees: Any) -> bool:
    """Return whether a trace is under way (jit), or these are no numbers yet (also grad, vmap): options are for a whole
    program, and of what is no number nothing can be asked."""
    return isinstance(jax.device_put(0), Tracer) or any(isinstance(x, Tracer) for x in jax.tree.leaves(trees))
