"""The JAX primitives `run_lanes` and `pull_lanes`: rules for jit, vmap and derivatives of a kernel launch.

The primitive's parameters are `lanes` (the programs), `seeds` (arrays with an initial tangent), `many` (tangent
directions) and `as_lanes` (uniform arrays with a value per lane). Its arguments are the values and then the initial
tangents, its results those of `LanePrograms.result_keys`.

`pull_lanes` is the transpose of `run_lanes`. Its arguments are the values and the cotangents of the carry at the end,
its results the cotangents of the seeds, one for each lane.

vmap adds lanes: a uniform array that differs within the batch becomes an array of each lane. If only tangents are
batched, as in `jax.jacfwd`, the lanes stay and the batch becomes more tangent directions. Only this module uses JAX's
interfaces for new primitives.
"""

import functools
import math
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.extend.core as jex
import jax.numpy as jnp
from jax.interpreters import ad, batching, mlir
from jax.interpreters import partial_eval as pe

from diffabs.compiler.autodiff.jvp import ArrayKey, arrange_arrays
from diffabs.compiler.autodiff.transpose import moved_keys
from diffabs.compiler.ir import UpdateLevel, is_real
from diffabs.compiler.lane_programs import LanePrograms, Seeds
from diffabs.core.types import Array, PyTree, Scalar

MAX_TANGENTS_PER_LAUNCH = 8  # directions; more take several launches
NO_REVERSE_MODE = (
    "a kernel has no reverse mode: forward mode (jax.jvp, jax.jacfwd) has its derivatives, engine = 'xla' both"
)


run_lanes_primitive = jex.Primitive("run_lanes")
pull_lanes_primitive = jex.Primitive("pull_lanes")
run_lanes_primitive.multiple_results = pull_lanes_primitive.multiple_results = True


def bind_lanes(lanes: LanePrograms, arrays: Sequence[PyTree]) -> list[PyTree]:
    """Call the primitive without tangents; return the carry's arrays after all lanes have ended, in leaf order.

    The arrays are the uniform ones, then those of the lanes, then the carry; random keys as their words (uint32).
    """
    return run_lanes_primitive.bind(*arrays, lanes=lanes, seeds=None, many=0, as_lanes=frozenset())


def _compile_call(primitive: jex.Primitive, *arrays: Array, **how: Any) -> list[PyTree]:
    # The primitives have lowerings but no eager evaluation, so a call outside jit compiles as well.
    return jax.jit(functools.partial(primitive.bind, **how))(*arrays)


for _primitive in (run_lanes_primitive, pull_lanes_primitive):
    _primitive.def_impl(functools.partial(_compile_call, _primitive))


@run_lanes_primitive.def_abstract_eval
def _shapes(*arrays: PyTree, lanes: LanePrograms, seeds: Seeds, many: int, as_lanes: frozenset[int]) -> list[PyTree]:
    """Return the shapes and types of the results: (lanes, ...) of values, (lanes, many, ...) of tangents."""
    carry = arrays[len(lanes.value_keys) - len(lanes.functions.types[UpdateLevel.STEP]) : len(lanes.value_keys)]

    def shape(key: ArrayKey) -> Any:
        x = carry[key.number]
        # Results have fixed types, also where the initial carry is weakly typed.
        return x.update(shape=(x.shape[0], many, *x.shape[1:])) if key.tangent else x.update(weak_type=False)

    return [shape(key) for key in lanes.result_keys(seeds)]


def _launch_in_parts(
    *arrays: Array, lanes: LanePrograms, seeds: Seeds, many: int, as_lanes: frozenset[int]
) -> list[PyTree]:
    """Return the primitive's results from as few launches as MAX_TANGENTS_PER_LAUNCH allows.

    All launches have the same number of directions; zero tangents fill the last one.
    """
    keys = [*lanes.value_keys, *lanes.seed_keys(seeds)]
    launches = max(1, math.ceil(many / MAX_TANGENTS_PER_LAUNCH))
    # Groups of one size share one compiled program. The padding tangents are zero and are cut off at the end.
    each = math.ceil(many / launches)
    arrays_by_key = dict(zip(keys, arrays, strict=True))
    if not many:
        return _launch_once(lanes, seeds, 0, as_lanes, arrays_by_key)

    def part(first: int) -> list[PyTree]:
        """Return the results of the launch for `each` directions from `first` on."""

        def cut(key: ArrayKey, x: Array) -> Array:
            # Tangents of arrays of lanes are (lanes, tangents, ...), of uniform arrays (tangents, ...).
            axis = 0 if key.level == UpdateLevel.UNIFORM and key.number not in as_lanes else 1
            lacking = max(0, first + each - many)
            wide = [(0, lacking if i == axis else 0) for i in range(x.ndim)]
            return jax.lax.slice_in_dim(jnp.pad(x, wide), first, first + each, axis=axis)

        some = {key: cut(key, x) if key.tangent else x for key, x in arrays_by_key.items()}
        return _launch_once(lanes, seeds, each, as_lanes, some)

    parts = [part(first) for first in range(0, each * launches, each)]
    return [
        jnp.concatenate([outs[i] for outs in parts], 1)[:, :many] if key.tangent else parts[0][i]
        for i, key in enumerate(lanes.result_keys(seeds))
    ]


mlir.register_lowering(run_lanes_primitive, mlir.lower_fun(_launch_in_parts, multiple_results=True))


@pull_lanes_primitive.def_abstract_eval
def _pulled_shapes(*arrays: PyTree, lanes: LanePrograms, seeds: Seeds, as_lanes: frozenset[int]) -> list[PyTree]:
    """Return the shapes and types of the cotangents of the seeds, (lanes, ...) also those of uniform arrays."""
    del as_lanes
    like, types = arrays[len(lanes.value_keys)], [lanes.functions.types[level][i] for level, i in seeds or ()]
    return [like.update(shape=(like.shape[0], *x.shape), dtype=x.dtype, weak_type=False) for x in types]


def _launch_sweeps(*arrays: Array, lanes: LanePrograms, seeds: Seeds, as_lanes: frozenset[int]) -> list[PyTree]:
    """Return the results of `pull_lanes`: the cotangents of the seeds in each lane."""
    values, ends = arrays[: len(lanes.value_keys)], arrays[len(lanes.value_keys) :]
    arrays_by_key = dict(zip(lanes.value_keys, values, strict=True))
    order = arrange_arrays(lanes.functions, lanes.derivative(None).moved_arrays, as_lanes)
    before = [arrays_by_key[key] for level in UpdateLevel if level in order for key in order[level]]
    moved, kinds = moved_keys(lanes.derivative(seeds).moved_arrays), lanes.functions.types
    # Sums begin at zero. A number of the initial carry that moves no result has no cotangent in the program: zero.
    zeros = {
        key: jnp.zeros((len(ends[0]), *kinds[key.level][key.number].shape), kinds[key.level][key.number].dtype)
        for key in lanes.seed_keys(seeds)
    }
    moved_arrays = [*ends, *(zeros[key] for key in moved[len(ends) :])]
    pulled = lanes.launch(lanes.sweeps(seeds, as_lanes), before, moved_arrays)
    results = zeros | dict(zip(moved, pulled, strict=True))
    return [results[key] for key in zeros]


mlir.register_lowering(pull_lanes_primitive, mlir.lower_fun(_launch_sweeps, multiple_results=True))


def build_launches(program: Any) -> None:
    """Build the kernels that a jaxpr calls, so that an error appears before XLA compiles it."""
    launches = {run_lanes_primitive: _launch_in_parts, pull_lanes_primitive: _launch_sweeps}
    for equation in program.eqns:
        if equation.primitive in launches:
            types = [jax.ShapeDtypeStruct(x.aval.shape, x.aval.dtype) for x in equation.invars]
            jax.eval_shape(functools.partial(launches[equation.primitive], **equation.params), *types)
    for inner in jex.subjaxprs(program):
        build_launches(inner)


def _launch_once(
    lanes: LanePrograms, seeds: Seeds, many: int, as_lanes: frozenset[int], arrays_by_key: dict[ArrayKey, PyTree]
) -> list[PyTree]:
    """Return the results of one launch; initial tangents of the carry that are not in `arrays_by_key` are zero."""

    def array(key: ArrayKey) -> PyTree:
        if key in arrays_by_key:
            return arrays_by_key[key]
        x = arrays_by_key[key._replace(tangent=False)]
        return jnp.zeros((x.shape[0], many, *x.shape[1:]), x.dtype)

    order = arrange_arrays(lanes.functions, lanes.derivative(seeds).moved_arrays, as_lanes)
    carry = [array(key) for key in order[UpdateLevel.STEP]]
    before = [array(key) for level in (UpdateLevel.UNIFORM, UpdateLevel.LANE) for key in order[level]]
    return lanes.launch(lanes.program(seeds, many, as_lanes), before, carry)


def _jvp_rule(
    arrays: Sequence[PyTree],
    slopes: Sequence[PyTree],
    *,
    lanes: LanePrograms,
    seeds: Seeds,
    many: int,
    as_lanes: frozenset[int],
) -> tuple[list[PyTree], list[PyTree]]:
    if seeds is not None:
        raise ValueError("a kernel has no second derivatives; engine = 'xla' has")
    # Integers and truths have tangents of type float0 in JAX. They carry no derivative.
    moving = [type(x) is not ad.Zero and is_real(jax.typeof(x).dtype) for x in slopes]
    seeds = tuple((key.level, key.number) for key, on in zip(lanes.value_keys, moving, strict=True) if on)
    if not seeds:
        outs = run_lanes_primitive.bind(*arrays, lanes=lanes, seeds=None, many=0, as_lanes=as_lanes)
        return outs, [_zero_tangent(x) for x in outs]

    # Build the derivative here: JAX 0.12 forbids tracing inside the abstract evaluation, where `result_keys` needs it.
    lanes.derivative(seeds)

    def add_direction_axis(key: ArrayKey, x: Scalar) -> Array:
        return jnp.expand_dims(x, 0 if key.level == UpdateLevel.UNIFORM and key.number not in as_lanes else 1)

    seed_tangents = [
        add_direction_axis(key, x) for key, x, on in zip(lanes.value_keys, slopes, moving, strict=True) if on
    ]
    outs = run_lanes_primitive.bind(*arrays, *seed_tangents, lanes=lanes, seeds=seeds, many=1, as_lanes=as_lanes)
    values = outs[: len(lanes.functions.types[UpdateLevel.STEP])]
    results = [_zero_tangent(x) for x in values]
    for key, x in zip(lanes.result_keys(seeds)[len(values) :], outs[len(values) :], strict=True):
        results[key.number] = x[:, 0]
    return values, results


ad.primitive_jvps[run_lanes_primitive] = _jvp_rule
ad.primitive_jvps[pull_lanes_primitive] = functools.partial(_jvp_rule, many=1)  # refuses: a pull has seeds


def _zero_tangent(x: Scalar) -> ad.Zero:
    return ad.Zero(jax.typeof(x).to_tangent_aval())


def _batching_rule(
    arrays: Sequence[PyTree],
    axes: Sequence[PyTree],
    *,
    lanes: LanePrograms,
    seeds: Seeds,
    many: int,
    as_lanes: frozenset[int],
) -> tuple[list[Array], Sequence[int | None]]:
    """Return the results for a batch, and their batch axes.

    The batch axis is merged into the axis of directions if only tangents are batched, else into the axis of lanes.
    """
    values = len(lanes.value_keys)
    size = next(x.shape[axis] for x, axis in zip(arrays, axes, strict=True) if axis is not None)
    how = {"lanes": lanes, "seeds": seeds}
    # Only the seed tangents are batched, as in `jax.jacfwd`: the values run once, with size*many tangents.
    if all(axis is None for axis in axes[:values]):
        more = []
        # Merge the batch axis in front of the tangent axis, which stands behind the lane axis if there is one.
        for key, x, axis in zip(lanes.seed_keys(seeds), arrays[values:], axes[values:], strict=True):
            at = 0 if key.level == UpdateLevel.UNIFORM and key.number not in as_lanes else 1
            x = jnp.broadcast_to(x, (size, *x.shape)) if axis is None else jnp.moveaxis(x, axis, 0)
            x = jnp.moveaxis(x, 0, at)
            more.append(x.reshape(*x.shape[:at], size * many, *x.shape[at + 2 :]))
        outs = run_lanes_primitive.bind(*arrays[:values], *more, **how, many=size * many, as_lanes=as_lanes)
        results = [
            x.reshape(x.shape[0], size, many, *x.shape[2:]) if key.tangent else x
            for key, x in zip(lanes.result_keys(seeds), outs, strict=True)
        ]
        return results, [1 if key.tangent else None for key in lanes.result_keys(seeds)]

    keys = [*lanes.value_keys, *lanes.seed_keys(seeds)]
    arguments, batched_uniforms, split = _merge_into_lanes(lanes, keys, as_lanes, arrays, axes)
    outs = run_lanes_primitive.bind(*arguments, **how, many=many, as_lanes=as_lanes | batched_uniforms)
    return [split(x) for x in outs], [0] * len(outs)


batching.primitive_batchers[run_lanes_primitive] = _batching_rule


def _pull_batching_rule(
    arrays: Sequence[PyTree], axes: Sequence[PyTree], *, lanes: LanePrograms, seeds: Seeds, as_lanes: frozenset[int]
) -> tuple[list[Array], Sequence[int | None]]:
    """Return the results for a batch, whose axis is merged into the axis of lanes, and their batch axes."""
    keys = [*lanes.value_keys, *(key for key in lanes.result_keys(seeds) if key.tangent)]
    arguments, batched_uniforms, split = _merge_into_lanes(lanes, keys, as_lanes, arrays, axes)
    outs = pull_lanes_primitive.bind(*arguments, lanes=lanes, seeds=seeds, as_lanes=as_lanes | batched_uniforms)
    return [split(x) for x in outs], [0] * len(outs)


batching.primitive_batchers[pull_lanes_primitive] = _pull_batching_rule


def _merge_into_lanes(
    lanes: LanePrograms,
    keys: list[ArrayKey],
    as_lanes: frozenset[int],
    arrays: Sequence[PyTree],
    axes: Sequence[PyTree],
) -> tuple[list[Array], set[int], Callable[[Array], Array]]:
    """Return the arrays of a batch with its axis merged into that of lanes.

    Also return the numbers of the uniform arrays that differ within it, and the function that splits a result again.
    """
    values = len(lanes.value_keys)
    size = next(x.shape[axis] for x, axis in zip(arrays, axes, strict=True) if axis is not None)
    batched_uniforms = {
        k.number for k, axis in zip(keys, axes, strict=True) if k.level == UpdateLevel.UNIFORM and axis is not None
    }
    # The last of the values is an array of the carry, so it always has a lane axis.
    count = arrays[values - 1].shape[1 if axes[values - 1] == 0 else 0]
    arguments = []
    # Merge the batch axis in front of the lane axis.
    for key, x, axis in zip(keys, arrays, axes, strict=True):
        shared = key.level == UpdateLevel.UNIFORM and key.number not in as_lanes
        # A uniform array that is not batched stays as given. A batched one is repeated for every lane.
        if not shared or key.number in batched_uniforms:
            x = jnp.broadcast_to(x, (size, *x.shape)) if axis is None else jnp.moveaxis(x, axis, 0)
            if shared:
                x = jnp.broadcast_to(x[:, None], (size, count, *x.shape[1:]))
            x = x.reshape(size * count, *x.shape[2:])  # not -1: an array may be empty
        arguments.append(x)
    return arguments, batched_uniforms, lambda x: x.reshape(size, count, *x.shape[1:])


def _linearize(trace: Any, *tracers: Any, lanes: LanePrograms, **how: Any) -> Sequence[Any]:
    """Return the results for known values and unknown tangents: known values, and tangents to be transposed.

    JAX asks for it in `jax.grad`, `jax.vjp` and `jax.linearize`.
    """
    if lanes.replay is None:
        raise ValueError(NO_REVERSE_MODE)
    known_values = [tracer.pval.get_known() for tracer in tracers]
    values = known_values[: len(lanes.value_keys)]
    outs = trace.default_process_primitive(run_lanes_primitive, tracers, {"lanes": lanes, **how})
    if any(x is None for x in values) or all(x is not None for x in known_values):
        return outs
    lanes.sweeps(how["seeds"], how["as_lanes"])  # an error appears before JAX transposes
    results = run_lanes_primitive.bind(*values, lanes=lanes, seeds=None, many=0, as_lanes=how["as_lanes"])
    return [*map(trace.to_jaxpr_tracer, results), *outs[len(results) :]]


def _transpose(
    cotangents: Sequence[PyTree],
    *arrays: PyTree,
    lanes: LanePrograms,
    seeds: Seeds,
    many: int,
    as_lanes: frozenset[int],
) -> list[PyTree]:
    """Return the cotangents of the initial tangents; each direction is a lane of its own."""
    values, tangents = arrays[: len(lanes.value_keys)], arrays[len(lanes.value_keys) :]
    ends = [ad.instantiate_zeros(x) for x in cotangents[len(lanes.functions.types[UpdateLevel.STEP]) :]]

    def pull(*ends: Array) -> list[PyTree]:
        return pull_lanes_primitive.bind(*values, *ends, lanes=lanes, seeds=seeds, as_lanes=as_lanes)

    results: list[PyTree] = [None] * len(values)
    pulled = jax.vmap(pull, in_axes=1, out_axes=1)(*ends)
    for key, tangent, x in zip(lanes.seed_keys(seeds), tangents, pulled, strict=True):
        shared = key.level == UpdateLevel.UNIFORM and key.number not in as_lanes
        total = jnp.sum(x, 0) if shared else x
        results.append(total if ad.is_undefined_primal(tangent) else None)
    return results


pe.custom_partial_eval_rules[run_lanes_primitive] = _linearize
ad.primitive_transposes[run_lanes_primitive] = _transpose
