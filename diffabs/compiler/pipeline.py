"""Native code for JAX functions of one lane (one simulation run), which runs many lanes, each until its own end.

A call of `run_lanes` takes these steps:

    trace      trace.trace_functions                 a jaxpr for each function
    lower      program.lower_functions               operations on single numbers (`ir`), by the rules of `lower`
    bind       runtime.jax_primitive.bind_lanes      a call of the JAX primitive `run_lanes`

When JAX differentiates this primitive:

    jvp        autodiff.jvp.differentiate_functions  a program with one tangent direction

When JAX transposes it:

    transpose  autodiff.transpose.trace_transpose    the transposed replay of a step (`LanePrograms.sweeps`)

When JAX compiles it:

    eliminate  autodiff.jvp.replicate_tangents       all tangent directions, with few operations (`autodiff.eliminate`)
               program.keep_read                     without updates of the carry that nothing reads
    schedule   schedule.schedule_nodes               operations inside the conditionals that need them
    emit       emit.cpp, emit.sweeps, emit.cuda      text, one function for each of the functions; calls `schedule`
    build      runtime.cpu.build_target, runtime.gpu a library or GPU code, from the cache if possible

`operations.OPERATIONS` has a row for each operation: its value for constants, and its text in each language.
`diffabs compile SCENARIO --show PASS` prints a program after a pass.
"""

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from diffabs.compiler.autodiff.transpose import Sweeps
from diffabs.compiler.emit.cpp import LaunchShape
from diffabs.compiler.lane_programs import LanePrograms
from diffabs.compiler.program import ScalarProgram
from diffabs.compiler.runtime import cpu, gpu, toolchain
from diffabs.compiler.runtime.jax_primitive import bind_lanes
from diffabs.compiler.trace import trace_functions
from diffabs.core.types import Array, PyTree, Scalar

VECTORS_PER_BLOCK = 4


def run_lanes(
    renew: Callable[[PyTree, PyTree], PyTree],
    step: Callable[[PyTree, PyTree], PyTree],
    running: Callable[[PyTree, PyTree], PyTree],
    lane: object,
    carry: object,
    *,
    steps: int,
    rounds: int,
    read: object = None,
    tangents_read: object = None,
    replay: tuple[Callable[[PyTree, PyTree], PyTree], PyTree] | None = None,
) -> PyTree:
    """Return the carry of n lanes after all have ended (pytree, leading axis n), with the structure of `carry`.

    A round is one call of `renew` and then `steps` calls of `step`. After every `rounds` rounds, `running` decides
    whether the lane goes on. So every lane computes at least `rounds` * `steps` steps, even if `running` is false for
    its initial carry. A lane that never ends keeps the call from returning.

    The function works under jit and vmap, with forward-mode derivatives, and with reverse mode if there is a `replay`
    (on a processor). Arrays that the functions close over are the same for all lanes.

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
        tangents_read: Pytree of booleans like `carry`: arrays whose derivatives matter afterwards, None for all. The
            derivatives of an array that influences none of these may be returned as zero.
        replay: Function of one lane, (lane, carry) -> carry, and a pytree like `carry` with True for one boolean array.
            Where this array is True after a step, the function repeats the step: it takes the arrays that it changes
            from before the step, and the others from after it. It must hold all derivatives of a step: those of
            `renew` are zero, and arrays that it does not change have none.

    Raises:
        Unsupported: A function uses an operation without a lowering rule, has too many operations, or the carry mixes
            real types.
        NoCompiler: There is no compiler for the processor or GPU, or it does not compile the program.
        ValueError: A second derivative is requested, or reverse mode without a `replay`.
    """
    if not gpu.find_gpu():
        toolchain.find_compiler()
    functions = trace_functions(
        {"renew": renew, "step": step, "running": running} | ({"replay": replay[0]} if replay else {}),
        jax.tree.map(_lane_type, lane),
        jax.tree.map(_lane_type, carry),
    )
    leaves, tree = jax.tree.flatten(carry)
    arguments = [unwrap_key(x) for x in (*functions.uniform, *jax.tree.leaves(lane), *leaves)]
    launch = functools.partial(_launch_lanes, shape=LaunchShape(VECTORS_PER_BLOCK, steps, rounds))

    def true_leaves(mask: object) -> tuple[int, ...] | None:
        return None if mask is None else tuple(i for i, on in enumerate(jax.tree.leaves(mask)) if on)

    # Drop the traced arrays: this object outlives the trace, and a tracer must not leak. They are arguments instead.
    part = None
    if replay and not gpu.find_gpu():
        part = functions.each["replay"], jax.tree.leaves(replay[1]).index(True)
    functions = functions._replace(
        uniform=[], each={name: functions.each[name] for name in ("renew", "step", "running")}
    )
    lanes = LanePrograms(functions, launch, true_leaves(tangents_read), true_leaves(read), part)
    results = bind_lanes(lanes, arguments)
    return tree.unflatten(
        [jax.random.wrap_key_data(x) if is_key(leaf) else x for x, leaf in zip(results, leaves, strict=True)]
    )


def _launch_lanes(
    program: ScalarProgram | Sweeps, before: list[PyTree], carry: list[PyTree], shape: LaunchShape
) -> list[PyTree]:
    """Build a program and return the carry after all lanes have ended, as an operation of XLA.

    `before` holds the uniform arrays and then the arrays of the lanes; in reverse mode then the carry, and `carry` the
    cotangents and sums.
    """
    first, results = len(before), [jax.ShapeDtypeStruct(x.shape, x.dtype) for x in carry]
    if gpu.find_gpu():
        assert isinstance(program, ScalarProgram)
        return gpu.call_kernel(program, shape, [*before, *carry], results)
    call = jax.ffi.ffi_call(
        cpu.build_target(program, shape),
        results,
        # The carry is updated in place, because result i shares its buffer with the argument.
        input_output_aliases={first + i: i for i in range(len(carry))},
    )
    return list(call(*before, *carry, threads=np.int64(cpu.thread_count())))


def describe_kernel_build() -> dict[str, str]:
    """Return what `describe_compiler` returns, of the back end for JAX's default device."""
    device = gpu.find_gpu()
    return device.describe() if device else toolchain.describe_compiler()


def _lane_type(x: Array) -> jax.ShapeDtypeStruct:
    """Return shape and type of an array without its first axis, the axis of lanes."""
    return jax.ShapeDtypeStruct(jnp.shape(x)[1:], x.dtype)


def unwrap_key(x: Array) -> Scalar:
    """Return random keys as their words (uint32, one more axis), and anything else as a JAX array."""
    if is_key(x):
        return jax.random.key_data(x)
    return x if isinstance(x, jax.Array) else jnp.asarray(x)


def is_key(x: Array) -> bool:
    """Return whether an array holds random keys."""
    return hasattr(x, "dtype") and jnp.issubdtype(x.dtype, jax.dtypes.prng_key)
