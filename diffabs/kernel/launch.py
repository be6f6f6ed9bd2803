"""Run functions of one lane as native code, for many lanes, each until it is over: a function as any other of JAX."""

import ctypes
import functools
import os
import pathlib
import threading
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from diffabs.kernel import binding, compilers, cpp, program

LINES = 10_000  # of a step; the blocks of a larger program are of fewer vectors, or compiling takes long
VECTORS = 4
_lock = threading.Lock()
_loaded: dict[str, Any] = {}


def run_lanes(
    renew: Callable[[Any, Any], Any],
    step: Callable[[Any, Any], Any],
    running: Callable[[Any, Any], Any],
    lane: Any,
    carry: Any,
    *,
    steps: int,
    rounds: int,
) -> Any:
    """Return the carry (pytree, n lanes first) of lanes that are all over.

    renew, step: functions of one lane, (lane, carry) -> carry; `renew` is called before every so many `steps`
    running: (lane, carry) -> whether it goes on; asked after so many `rounds` of these. Until then `step` must do
        nothing that matters in a lane that is over
    lane: what is a lane's own, (n, ...) each; what the functions close over is the same for all

    Works under jit and vmap, with derivatives forward. Raises Unsupported for an operation that has no rule, NoCompiler
    where there is none, ValueError for reverse mode."""
    compilers.compiler()
    functions = program.traced(
        {"renew": renew, "step": step, "running": running}, jax.tree.map(_one, lane), jax.tree.map(_one, carry)
    )
    leaves, tree = jax.tree.flatten(carry)
    given = [_data(x) for x in (*functions.uniform, *jax.tree.leaves(lane), *leaves)]
    launch = functools.partial(_launched, shape=cpp.Shape(VECTORS, steps, rounds))
    lanes = binding.Lanes(functions._replace(uniform=[]), launch)
    found = binding.bound(lanes, given)
    return tree.unflatten([_like(x, leaf) for x, leaf in zip(found, leaves, strict=True)])


def _launched(made: program.Program, before: list[Any], carry: list[Any], shape: cpp.Shape) -> list[Any]:
    """The carry of lanes that are all over; `before`: what is the same for all lanes, and what is a lane's own."""
    first = len(before)
    call = jax.ffi.ffi_call(
        target(made, shape),
        [jax.ShapeDtypeStruct(x.shape, x.dtype) for x in carry],
        input_output_aliases={first + i: i for i in range(len(carry))},
    )
    return list(call(*before, *carry, threads=np.int64(_threads())))


def target(made: program.Program, shape: cpp.Shape) -> str:
    """Return the name under which XLA knows a program; compiled, if it was not before. Raises NoCompiler."""
    many = 1 + max(made.tangents.values(), default=0)
    shape = shape._replace(vectors=max(1, shape.vectors // many))  # tangents, too, do not wait for each other
    source = cpp.text(made, shape)
    while cpp.operations(source) * shape.vectors > LINES and shape.vectors > 1:
        shape = shape._replace(vectors=shape.vectors // 2)
        source = cpp.text(made, shape)
    return _registered(source)


def _registered(source: str) -> str:
    """The name under which XLA knows the library of a text."""
    path = compilers.library(source)
    name = f"diffabs_kernel_{path.stem[:32]}"
    with _lock:
        if name not in _loaded:
            handler = _handler(path)
            jax.ffi.register_ffi_target(name, jax.ffi.pycapsule(handler), platform="cpu")
            _loaded[name] = handler
    return name


def _handler(path: pathlib.Path) -> Any:
    """Raises NoCompiler for a library that this process cannot load: a folder from which nothing may be run."""
    try:
        return ctypes.CDLL(str(path)).diffabs_kernel
    except (OSError, AttributeError) as error:
        raise compilers.NoCompiler(f"{path.parent}: {error}") from None


def _threads() -> int:
    """Processors that this process may use, shared by the devices, each of which may run lanes at the same time."""
    return max(1, _processors() // max(1, jax.local_device_count("cpu")))


@functools.cache
def _processors() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _one(x: Any) -> Any:
    """A lane of an array."""
    return jax.ShapeDtypeStruct(jnp.shape(x)[1:], x.dtype)


def _data(x: Any) -> Any:
    """An array, of a key its words."""
    return jax.random.key_data(x) if _is_key(x) else jnp.asarray(x)


def _like(x: Any, leaf: Any) -> Any:
    return jax.random.wrap_key_data(x) if _is_key(leaf) else x


def _is_key(x: Any) -> bool:
    return hasattr(x, "dtype") and jnp.issubdtype(x.dtype, jax.dtypes.prng_key)
