"""Reverse-mode derivatives of functions of one lane: the transpose of the part of a step that has derivatives.

A step changes the carry, and `replay` repeats its differentiable part from the numbers that a log has of it. The
transposed replay takes the cotangents of the carry from the end of a step to its start. It adds the contributions of
this step to the sums of the other arrays' cotangents.
"""

from typing import Any, NamedTuple

import jax
import jax.extend.core as jex
import jax.numpy as jnp

from diffabs.compiler.autodiff.jvp import INPUT_LEVELS, ArrayKey, TangentArrays, arrange_arrays
from diffabs.compiler.ir import Node, UpdateLevel, live_nodes
from diffabs.compiler.listing import count_by_level
from diffabs.compiler.program import InputPlace, ScalarProgram, check_size, keep_read, lower_functions
from diffabs.compiler.trace import TracedFunction, TracedFunctions

MAX_SWEEP_OPERATIONS = 12_000  # of one program in each step


class Sweeps(NamedTuple):
    """The programs of a launch in reverse mode.

    Attributes:
        ahead: Program of the values, whose steps are logged.
        back: Program of the transposed replay. Its carry has the arrays of `ahead`, read from the log, then the
            cotangents of the moved ones, and then the sums for the moved arrays of the lanes and the uniform ones.
        flag: Index of the carry's array that says if the last step has a replay.
        changed: Indices of the carry's arrays that the log has from the start of a step; those of others are from its
            end.
    """

    ahead: ScalarProgram
    back: ScalarProgram
    flag: int
    changed: frozenset[int]


def pair_sweeps(ahead: ScalarProgram, back: ScalarProgram, flag: int, changed: frozenset[int]) -> Sweeps:
    """Return the sweeps of two programs, without updates that the log does not read; the arguments are its fields.

    A program for which a C++ compiler takes minutes raises Unsupported.
    """
    logged = read_carry(back, len(ahead.sizes[UpdateLevel.STEP]))
    ahead = keep_read(ahead, {flag, *(place.array for place, _ in logged)})
    for program in (ahead, back):
        check_size(program, count_by_level(program)["step"], MAX_SWEEP_OPERATIONS)
    return Sweeps(ahead, back, flag, changed)


def moved_keys(moved: TangentArrays) -> list[ArrayKey]:
    """Return the arrays with a cotangent, in the order of the results: the carry, the lanes, the uniform ones."""
    return [ArrayKey(level, i, True) for level in reversed(INPUT_LEVELS) for i in moved[level]]


def changed_arrays(functions: TracedFunctions, replay: TracedFunction) -> frozenset[int]:
    """Return the indices of the carry's arrays that a function changes."""
    carry = replay.jaxpr.invars[len(functions.types[UpdateLevel.LANE]) :]
    return frozenset(
        i for i, pair in enumerate(zip(carry, replay.jaxpr.outvars, strict=True)) if pair[0] is not pair[1]
    )


def read_carry(back: ScalarProgram, count: int) -> list[tuple[InputPlace, Node]]:
    """Return the numbers of the first `count` arrays of the carry that the transposed replay reads."""
    results = [x for x, old in zip(back.results["step"], back.carry_inputs(), strict=True) if x is not old]
    nodes = [node for node in live_nodes(results) if node.op == "input" and node.level == UpdateLevel.STEP]
    return [(node.attr, node) for node in nodes if node.attr.array < count]


def trace_transpose(functions: TracedFunctions, replay: TracedFunction, moved: TangentArrays) -> jex.ClosedJaxpr:
    """Return the transposed replay as a jaxpr.

    Its arguments are the arrays of all levels in their order, then cotangents and sums (`moved_keys`). Its results are
    new cotangents and sums.
    """
    types = {ArrayKey(level, i, False): x for level in INPUT_LEVELS for i, x in enumerate(functions.types[level])}
    sources = [key._replace(tangent=False) for key in moved_keys(moved)]
    ends = moved[UpdateLevel.STEP]

    def pull(*arguments: Any) -> list[Any]:
        values, slopes = dict(zip(types, arguments, strict=False)), arguments[len(types) :]

        def repeat(moving: list[Any]) -> list[Any]:
            new = values | dict(zip(sources, moving, strict=True))
            shared = [new[ArrayKey(UpdateLevel.UNIFORM, i, False)] for i in replay.closed]
            outs = jex.jaxpr_as_fun(jex.ClosedJaxpr(replay.jaxpr, shared))(
                *(x for key, x in new.items() if key.level != UpdateLevel.UNIFORM)
            )
            return [outs[i] for i in ends]

        (parts,) = jax.vjp(repeat, [values[key] for key in sources])[1](list(slopes[: len(ends)]))
        return [*parts[: len(ends)], *map(jnp.add, slopes[len(ends) :], parts[len(ends) :])]

    return jax.make_jaxpr(pull)(*types.values(), *(types[key] for key in sources))


def lower_transpose(
    functions: TracedFunctions, closed: jex.ClosedJaxpr, moved: TangentArrays, per_lane_uniforms: frozenset[int]
) -> ScalarProgram:
    """Return the program of a traced transposed replay, the function `step` of the carry in `Sweeps.back`.

    `per_lane_uniforms` is as in `arrange_arrays`.
    """
    order = arrange_arrays(functions, {level: () for level in INPUT_LEVELS}, per_lane_uniforms)
    keys = [ArrayKey(level, i, False) for level in INPUT_LEVELS for i in range(len(functions.types[level]))]
    inputs = dict(zip(keys, closed.jaxpr.invars, strict=False))
    further = closed.jaxpr.invars[len(keys) :]
    arrays = {level: [inputs[key] for key in order[level]] for level in INPUT_LEVELS}
    carry = arrays[UpdateLevel.STEP]
    jaxpr = closed.jaxpr.replace(
        constvars=[*arrays[UpdateLevel.UNIFORM], *closed.jaxpr.constvars],
        invars=[*arrays[UpdateLevel.LANE], *carry, *further],
        outvars=[*carry, *closed.jaxpr.outvars],
    )
    types = {level: [x.aval for x in xs] for level, xs in (arrays | {UpdateLevel.STEP: [*carry, *further]}).items()}
    step = TracedFunction(jaxpr, tuple(range(len(arrays[UpdateLevel.UNIFORM]))), tuple(closed.consts))
    return lower_functions(TracedFunctions({"step": step}, types, [], {}))
