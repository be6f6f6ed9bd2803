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

from diffabs.kernel import binding, compilers, cpp, gpu, program

MAX_STEP_LINES = 10_000  # of a step; the blocks of a larger program are of fewer vectors, or compiling takes long
VECTORS_PER_BLOCK = 4
LIBRARY_NAME_PREFIX = "diffabs_kernel_"  # begins the names of libraries
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
    wanted: Any = None,
) -> Any:
    """Return the carry (pytree, n lanes first) of lanes that are all over.

    renew, step: functions of one lane, (lane, carry) -> carry; `renew` is called before every so many `steps`
    running: (lane, carry) -> whether it goes on; asked after so many `rounds` of these. Until then `step` must do
        nothing that matters in a lane that is over
    lane: what is a lane's own, (n, ...) each; what the functions close over is the same for all
    wanted: truths as the carry, of which derivatives are asked for afterwards: those of the rest are zero; None for all

    Works under jit and vmap, with derivatives forward. Raises Unsupported for an operation that has no rule, NoCompiler
    where there is none, ValueError for reverse mode."""
    if not gpu.find_gpu():
        compilers.find_compiler()
    functions = program.trace_functions(
        {"renew": renew, "step": step, "running": running},
        jax.tree.map(_lane_type, lane),
        jax.tree.map(_lane_type, carry),
    )
    leaves, tree = jax.tree.flatten(carry)
    given = [unwrap_key(x) for x in (*functions.uniform, *jax.tree.leaves(lane), *leaves)]
    launch = functools.partial(_launch_lanes, shape=cpp.LaunchShape(VECTORS_PER_BLOCK, steps, rounds))
    which = None if wanted is None else tuple(i for i, on in enumerate(jax.tree.leaves(wanted)) if on)
    lanes = binding.LanePrograms(functions._replace(uniform=[]), launch, which)
    found = binding.bind_lanes(lanes, given)
    return tree.unflatten([_like(x, leaf) for x, leaf in zip(found, leaves, strict=True)])


def _launch_lanes(
    made: program.ScalarProgram, before: list[Any], carry: list[Any], shape: cpp.LaunchShape
) -> list[Any]:
    """The carry of lanes that are all over; `before`: what is the same for all lanes, and what is a lane's own."""
    first, results = len(before), [jax.ShapeDtypeStruct(x.shape, x.dtype) for x in carry]
    if gpu.find_gpu():
        return gpu.call_kernel(made, shape, [*before, *carry], results)
    call = jax.ffi.ffi_call(
        build_target(made, shape),
        results,
        input_output_aliases={first + i: i for i in range(len(carry))},
    )
    return list(call(*before, *carry, threads=np.int64(thread_count())))


def build_target(made: program.ScalarProgram, shape: cpp.LaunchShape) -> str:
    """Return the name under which XLA knows a program; compiled, if it was not before. Raises NoCompiler."""
    shape = shape._replace(vectors=max(1, shape.vectors // max(1, made.tangents)))  # tangents do not wait, either
    source = cpp.emit_cpp(made, shape)
    while cpp.count_operations(source) * shape.vectors > MAX_STEP_LINES and shape.vectors > 1:
        shape = shape._replace(vectors=shape.vectors // 2)
        source = cpp.emit_cpp(made, shape)
    return register_library(compilers.build_library(source))


def describe_kernel_build() -> dict[str, str]:
    """Return what decides the bits of a kernel besides its text: compiler, flags, processor. Raises NoCompiler."""
    return gpu.describe_gpu_compiler() if gpu.find_gpu() else compilers.describe_compiler()


def register_library(path: pathlib.Path) -> str:
    """Return the name under which XLA knows a library from now on. Raises NoCompiler for one that is not there."""
    name = f"{LIBRARY_NAME_PREFIX}{path.stem[:32]}"
    with _lock:
        if name not in _loaded:
            handler = _handler(path)
            jax.ffi.register_ffi_target(name, jax.ffi.pycapsule(handler), platform="cpu")
            _loaded[name] = handler, path
    return name


def library_names() -> list[str]:
    """Return the names under which XLA knows libraries."""
    return list(_loaded)


def library_path(name: str) -> pathlib.Path:
    """Return the library of a name."""
    return _loaded[name][1]


def _handler(path: pathlib.Path) -> Any:
    """Raises NoCompiler for a library that this process cannot load: a folder from which nothing may be run."""
    try:
        return ctypes.CDLL(str(path)).diffabs_kernel
    except (OSError, AttributeError) as error:
        raise compilers.NoCompiler(f"{path.parent}: {error}") from None


def thread_count() -> int:
    """Return how many processors a device may use: those of this process, shared by all that run at the same time."""
    return max(1, _processors() // max(1, jax.local_device_count("cpu")))


@functools.cache
def _processors() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _lane_type(x: Any) -> Any:
    """A lane of an array."""
    return jax.ShapeDtypeStruct(jnp.shape(x)[1:], x.dtype)


def unwrap_key(x: Any) -> Any:
    """Return an array, of a key its words."""
    if is_key(x):
        return jax.random.key_data(x)
    return x if isinstance(x, jax.Array) else jnp.asarray(x)


def _like(x: Any, leaf: Any) -> Any:
    return jax.random.wrap_key_data(x) if is_key(leaf) else x


def is_key(x: Any) -> bool:
    """Return whether these are keys."""
    return hasattr(x, "dtype") and jnp.issubdtype(x.dtype, jax.dtypes.prng_key)
