"""Compilation of programs that run once: compiling them takes most of their time.

A function called with numbers is compiled with options for a faster compilation. Inside jit, and so under vmap and
grad, the surrounding program decides the options.
"""

import functools
import os
from collections.abc import Callable, Iterable
from typing import Any, TypeVar

import jax
import jax.extend.core as jex
from jax.core import Tracer

from diffabs.core.types import PyTree

F = TypeVar("F", bound=Callable)

# JAX 0.10: the older emitters give the same numbers as the newer ones in half the compilation time. Later versions of
# JAX do not have this option. A program is split into 32 parts for parallel compilation, and each part has a cost: a
# split into 4 parts takes a tenth less time.
SAME_RESULT_OPTIONS: dict[str, PyTree] = (
    {"xla_cpu_use_fusion_emitters": False} if jax.__version_info__ < (0, 11) else {}
)
if SAME_RESULT_OPTIONS and "codegen_split_count" not in os.environ.get("XLA_FLAGS", ""):
    SAME_RESULT_OPTIONS["xla_cpu_parallel_codegen_split_count"] = 4
QUICK_COMPILE_OPTIONS: dict[str, PyTree] = {
    **SAME_RESULT_OPTIONS,
    "xla_backend_optimization_level": 0,
}  # results differ by rounding


def compile_once(static: Iterable[str] | int = (), options: dict[str, PyTree] | None = None) -> Callable[[F], F]:
    """Return a decorator like `jax.jit`, for a function that usually runs only once for each shape of its arguments.

    A call with concrete numbers or arrays compiles with XLA's `options`, a call under jit, grad or vmap without them.
    `static` has the names of static arguments, which callers pass by name, or the number of leading ones.
    """
    leading, names = (static, ()) if isinstance(static, int) else (0, tuple(static))
    fixed: dict[str, PyTree] = {"static_argnums": tuple(range(leading)), "static_argnames": names}

    def decorate(function: F) -> F:
        plain: Any = jax.jit(function, **fixed)
        quick: Any = jax.jit(function, **fixed, compiler_options=options) if options else plain

        @functools.wraps(function)
        def call(*args: PyTree, **more: Any) -> Any:
            return (plain if is_traced(args, more) else quick)(*args, **more)

        call._cache_size = lambda: plain._cache_size() + quick._cache_size()  # pyright: ignore
        return call  # pyright: ignore[reportReturnType]

    return decorate


def is_traced(*trees: object) -> bool:
    """Return whether a jit trace is under way, or a leaf of the trees is a tracer, as under grad and vmap."""
    return _is_tracing() or any(isinstance(x, Tracer) for x in jax.tree.leaves(trees))


def _is_tracing() -> bool:
    state = jex.get_opaque_trace_state(convention="nnx")
    if state in _states_without_trace:
        return False
    # Under jit, device_put of a constant is staged and returns a tracer.
    tracing = isinstance(jax.device_put(0), Tracer)
    if not tracing and not _states_without_trace:
        _states_without_trace.append(state)
    return tracing


# The first state in which no trace was under way. Its comparison costs a hundredth of `device_put`. It is not known at
# import, which must not start JAX: a process may fork before.
_states_without_trace: list[PyTree] = []
