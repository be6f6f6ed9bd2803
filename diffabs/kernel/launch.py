"""Execution of JAX functions of one lane as native code for many lanes, each until its own end."""

import ctypes
import functools
import pathlib
import threading
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from diffabs.core.process import core_count
from diffabs.core.types import PyTree, Scalar
from diffabs.kernel import binding, compilers, cpp, gpu, program

MAX_STEP_LINES = 10_000  # lines of a step; a larger program gets fewer vectors a block, or compiling takes too long
VECTORS_PER_BLOCK = 4
LIBRARY_NAME_PREFIX = "diffabs_kernel_"
_lock = threading.Lock()
_loaded: dict[str, PyTree] = {}


def run_lanes(
    renew: Callable[[PyTree, PyTree], PyTree],
    step: Callable[[PyTree, PyTree], PyTree],
    running: Callable[[PyTree, PyTree], PyTree],
    lane: PyTree,
    carry: PyTree,
    *,
    steps: int,
    rounds: int,
    read: PyTree = None,
    wanted: PyTree = None,
) -> PyTree:
    """Return the carry of n lanes after all have ended (pytree, leading axis n), with the structure of `carry`.

    A round is one call of `renew` and then `steps` calls of `step`. After every `rounds` rounds, `running` decides
    whether the lane goes on. So every lane computes at least `rounds` * `steps` steps, even if `running` is false for
    its initial carry. A lane that never ends keeps the call from returning.

    The function works under jit and vmap, with forward-mode derivatives. Arrays that the functions close over are the
    same for all lanes.

    Args:
        renew: Function of one lane, (lane, carry) -> carry, called before every `steps` steps.
        step: Function of one lane, (lane, carry) -> carry. In a lane that has ended, it must change nothing that
            matters.
        running: Function of one lane, (lane, carry) -> boolean: True if the lane continues.
        lane: Pytree of each lane's constants, (n, ...) each.
        carry: Pytree of each lane's initial values, (n, ...) each. Its real numbers share one type, float32 or float64.
        steps: Calls of `step` after each call of `renew`.
        rounds: Rounds between two calls of `running`.
        read: Pytree of booleans like `carry`: arrays whose values matter afterwards, None for all. An array that
            influences none of these, nor `running`, may be returned with its initial values.
        wanted: Pytree of booleans like `carry`: arrays whose derivatives matter afterwards, None for all. The
            derivatives of an array that influences none of these may be returned as zero.

    Raises:
        Unsupported: A function uses an operation without a lowering rule, has too many operations, or the carry mixes
            real types.
        NoCompiler: There is no compiler for the processor or GPU, or it does not compile the program.
        ValueError: Reverse mode or a second derivative is requested.
    """
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

    def numbers(which: PyTree) -> tuple[int, ...] | None:
        return None if which is None else tuple(i for i, on in enumerate(jax.tree.leaves(which)) if on)

    # Drop the traced arrays: this object outlives the trace, and a tracer must not leak. They are arguments instead.
    lanes = binding.LanePrograms(functions._replace(uniform=[]), launch, numbers(wanted), numbers(read))
    found = binding.bind_lanes(lanes, given)
    return tree.unflatten(
        [jax.random.wrap_key_data(x) if is_key(leaf) else x for x, leaf in zip(found, leaves, strict=True)]
    )


def _launch_lanes(
    made: program.ScalarProgram, before: list[PyTree], carry: list[PyTree], shape: cpp.LaunchShape
) -> list[PyTree]:
    """Return the final carry of all lanes; `before` holds the uniform arrays and the arrays of the lanes."""
    first, results = len(before), [jax.ShapeDtypeStruct(x.shape, x.dtype) for x in carry]
    if gpu.find_gpu():
        return gpu.call_kernel(made, shape, [*before, *carry], results)
    call = jax.ffi.ffi_call(
        build_target(made, shape),
        results,
        # The carry is updated in place, because result i shares its buffer with the argument.
        input_output_aliases={first + i: i for i in range(len(carry))},
    )
    return list(call(*before, *carry, threads=np.int64(thread_count())))


def build_target(made: program.ScalarProgram, shape: cpp.LaunchShape) -> str:
    """Compile a program for the processor, if necessary, and return its name as an FFI target of XLA.

    Args:
        made: Operations and results.
        shape: Loop structure of the launch; a large program or one with tangents gets fewer `vectors`.

    Raises:
        NoCompiler: No compiler works, or the library does not load.
    """
    # Tangents are independent of each other too and hide latency, so they replace vectors of the block.
    shape = shape._replace(vectors=max(1, shape.vectors // max(1, made.tangents)))
    source = cpp.emit_cpp(made, shape)
    while cpp.count_operations(source) * shape.vectors > MAX_STEP_LINES and shape.vectors > 1:
        shape = shape._replace(vectors=shape.vectors // 2)
        source = cpp.emit_cpp(made, shape)
    return register_library(compilers.build_library(source))


def describe_kernel_build() -> dict[str, str]:
    """Return a dictionary with "compiler", "flags" and "processor" of the back end for JAX's default device.

    With a program's text, they determine a kernel's numbers to the last bit.

    Raises:
        NoCompiler: There is no compiler for the processor or GPU.
    """
    return gpu.describe_gpu_compiler() if gpu.find_gpu() else compilers.describe_compiler()


def register_library(path: pathlib.Path) -> str:
    """Register a library with XLA and return its name there.

    Args:
        path: File of the library.

    Raises:
        NoCompiler: The library does not load.
    """
    name = f"{LIBRARY_NAME_PREFIX}{path.stem[:32]}"
    with _lock:
        if name not in _loaded:
            try:
                handler = ctypes.CDLL(str(path)).diffabs_kernel
            except (OSError, AttributeError) as error:  # such as in a folder without execution rights
                raise compilers.NoCompiler(f"{path.parent}: {error}") from None
            # The table keeps the handler alive: XLA holds only its address.
            jax.ffi.register_ffi_target(name, jax.ffi.pycapsule(handler), platform="cpu")
            _loaded[name] = handler, path
    return name


def library_names() -> list[str]:
    """Return the XLA names of all libraries that this process has registered."""
    return list(_loaded)


def library_path(name: str) -> pathlib.Path:
    """Return the file of a registered library.

    Args:
        name: Name of the library in XLA.

    Raises:
        KeyError: No library of this name is registered.
    """
    return _loaded[name][1]


def thread_count() -> int:
    """Return the number of threads for a launch: all cores, whatever the number of JAX's CPU devices."""
    # Launches on several devices at once share the cores: a thread takes its next lane when it has time.
    return core_count()


def _lane_type(x: Scalar) -> Scalar:
    """Return shape and type of one lane of an array."""
    return jax.ShapeDtypeStruct(jnp.shape(x)[1:], x.dtype)


def unwrap_key(x: Scalar) -> Scalar:
    """Return random keys as their words (uint32, one more axis), and anything else as a JAX array.

    Args:
        x: Array or random keys.
    """
    if is_key(x):
        return jax.random.key_data(x)
    return x if isinstance(x, jax.Array) else jnp.asarray(x)


def is_key(x: Scalar) -> bool:
    """Return whether an array holds random keys.

    Args:
        x: Array or random keys.
    """
    return hasattr(x, "dtype") and jnp.issubdtype(x.dtype, jax.dtypes.prng_key)
