"""Derivatives of functions of one lane, forward: a program of the values, and of several tangents of each number.

The program is that of `jax.jvp` of the functions, traced for one tangent of everything that could have one. In its
graph it is then seen what has: what begins with one, and what that leads to from step to step. Of each there are as
many as are asked for; the other tangents are zero, and so is everything that follows from them alone."""

from collections.abc import Iterable
from typing import Any, NamedTuple

import jax
import jax.extend.core as jex

from diffabs.kernel.graph import Graph, Node, UpdateLevel, is_real
from diffabs.kernel.program import (
    InputPlace,
    ScalarProgram,
    TracedFunction,
    TracedFunctions,
    check_size,
    live_nodes,
    lower_functions,
)
from diffabs.kernel.replicate import dependents, replicate_nodes, tangent_copy

INPUT_LEVELS = (UpdateLevel.UNIFORM, UpdateLevel.LANE, UpdateLevel.STEP)
RUNNING_FUNCTION = "running"  # the function that has no tangents: a truth
TangentArrays = dict[UpdateLevel, tuple[int, ...]]  # the arrays, of each level, that have tangents


class ArrayKey(NamedTuple):
    """An array: of which level it was when the functions were traced, its number there; or its tangents."""

    level: UpdateLevel
    number: int
    tangent: bool


class DerivativeProgram(NamedTuple):
    """A program in which the arrays of each level are followed by their tangents, one each: of those that `could` have
    them. Which `do`: of the carry more than what begins with one."""

    program: ScalarProgram
    differentiable: TangentArrays
    moved_arrays: TangentArrays


def differentiate_functions(
    functions: TracedFunctions, seeded: TangentArrays, outputs_needed: Iterable[int] | None = None
) -> DerivativeProgram:
    """Return the derivative of functions where these arrays have tangents to begin with; `wanted`: arrays of the carry
    whose tangents matter in the end, None for all. Raises Unsupported."""
    differentiable = seeded | {
        UpdateLevel.STEP: tuple(i for i, x in enumerate(functions.types[UpdateLevel.STEP]) if is_real(x.dtype))
    }
    program = lower_functions(_jvp_functions(functions, differentiable))
    reached = _reached_arrays(program, functions, differentiable, seeded)
    if outputs_needed is not None:
        needed = _needed_arrays(program, functions, differentiable, set(outputs_needed))
        reached = tuple(i for i in reached if i in needed)
    return DerivativeProgram(program, differentiable, seeded | {UpdateLevel.STEP: reached})


def lower_without_tangents(functions: TracedFunctions) -> DerivativeProgram:
    """Return the functions without tangents. Raises Unsupported."""
    none: TangentArrays = dict.fromkeys(INPUT_LEVELS, ())
    return DerivativeProgram(lower_functions(functions), none, none)


def arrange_arrays(
    functions: TracedFunctions, moved_arrays: TangentArrays, per_lane_uniforms: frozenset[int]
) -> dict[UpdateLevel, list[ArrayKey]]:
    """Return the arrays of a program, of each level, in their order; `as_lanes` are those that were the same for all
    lanes when the functions were traced, and now are not."""
    found: dict[UpdateLevel, list[ArrayKey]] = {level: [] for level in INPUT_LEVELS}
    for tangent in (False, True):
        for level in INPUT_LEVELS:
            for i in moved_arrays[level] if tangent else range(len(functions.types[level])):
                moved = level == UpdateLevel.UNIFORM and i in per_lane_uniforms
                found[UpdateLevel.LANE if moved else level].append(ArrayKey(level, i, tangent))
    return found


def replicate_tangents(
    functions: TracedFunctions, one: DerivativeProgram, many: int, per_lane_uniforms: frozenset[int] = frozenset()
) -> ScalarProgram:
    """Return a derivative as a program of so many tangents of each array that has one, (many, ...) each. Raises
    Unsupported for one of too many operations."""
    graph, old = Graph(), one.program
    inputs: dict[InputPlace, Node] = {}
    given: dict[int, list[Node]] = {}
    sizes: dict[UpdateLevel, list[int]] = {level: [] for level in INPUT_LEVELS}
    for level, keys in arrange_arrays(functions, one.moved_arrays, per_lane_uniforms).items():
        for array, key in enumerate(keys):
            number = _number(functions, one, key)
            size, copies = old.sizes[key.level][number], many if key.tangent else 1
            for k in range(copies):
                for entry in range(size):
                    node, place = (
                        old.inputs[InputPlace(key.level, number, entry)],
                        InputPlace(level, array, k * size + entry),
                    )
                    inputs[place] = graph.input(node.dtype, level, place)
                    given.setdefault(node.id, []).append(inputs[place])
            sizes[level].append(size * copies)
    slopes = {node.id for place, node in old.inputs.items() if place.array >= len(functions.types[place.level])}
    ends = {name: _results(functions, one, name) for name in old.results}
    roots = [node for arrays in ends.values() for nodes, _ in arrays for node in nodes]
    new = replicate_nodes(graph, roots, given, slopes, (many, old.dtype))
    results = {
        name: [
            tangent_copy(new[x.id], k) for nodes, moves in arrays for k in range(many if moves else 1) for x in nodes
        ]
        for name, arrays in ends.items()
    }
    return check_size(ScalarProgram(inputs, results, functions.uniform, sizes, old.dtype, many), len(graph.nodes))


def _number(functions: TracedFunctions, one: DerivativeProgram, key: ArrayKey) -> int:
    """The number of an array in the program of one tangent."""
    first = len(functions.types[key.level])
    return first + one.differentiable[key.level].index(key.number) if key.tangent else key.number


def _results(functions: TracedFunctions, one: DerivativeProgram, name: str) -> list[tuple[list[Node], bool]]:
    """What a function of the program of several tangents returns, array by array: those that it has of one tangent, and
    whether they are tangents."""
    if name == RUNNING_FUNCTION:
        return [(one.program.results[name], False)]
    arrays = _arrays(functions, one, name)
    slopes = [
        arrays[_number(functions, one, ArrayKey(UpdateLevel.STEP, i, True))] for i in one.moved_arrays[UpdateLevel.STEP]
    ]
    values = arrays[: len(functions.types[UpdateLevel.STEP])]
    return [(nodes, False) for nodes in values] + [(nodes, True) for nodes in slopes]


def _arrays(functions: TracedFunctions, one: DerivativeProgram, name: str) -> list[list[Node]]:
    """The results of a function that changes the carry, array by array."""
    rest = iter(one.program.results[name])
    return [[next(rest) for _ in range(size)] for size in one.program.sizes[UpdateLevel.STEP]]


def _reached_arrays(
    program: ScalarProgram, functions: TracedFunctions, differentiable: TangentArrays, seeded: TangentArrays
) -> tuple[int, ...]:
    """The arrays of the carry that have tangents in the end."""
    one, ends = (
        DerivativeProgram(program, differentiable, differentiable),
        _tangent_results(program, functions, differentiable),
    )
    nodes = live_nodes([node for nodes in ends.values() for node in nodes])
    moved_arrays = seeded
    while True:
        starts = {
            (level, _number(functions, one, ArrayKey(level, i, True)))
            for level in INPUT_LEVELS
            for i in moved_arrays[level]
        }
        found = dependents(nodes, {node.id for p, node in program.inputs.items() if (p.level, p.array) in starts})
        reached = tuple(
            i for i, nodes in ends.items() if i in moved_arrays[UpdateLevel.STEP] or any(x.id in found for x in nodes)
        )
        if reached == moved_arrays[UpdateLevel.STEP]:
            return reached
        moved_arrays = moved_arrays | {UpdateLevel.STEP: reached}


def _needed_arrays(
    program: ScalarProgram, functions: TracedFunctions, differentiable: TangentArrays, outputs_needed: set[int]
) -> set[int]:
    """The arrays of the carry whose tangents lead to those that are wanted."""
    ends, found = _tangent_results(program, functions, differentiable), set(outputs_needed)
    first = len(functions.types[UpdateLevel.STEP])
    numbers = {first + at: i for at, i in enumerate(differentiable[UpdateLevel.STEP])}
    left = [i for i in outputs_needed if i in ends]
    while left:
        read = [n.attr for n in live_nodes(ends[left.pop()]) if n.op == "input" and n.attr.level == UpdateLevel.STEP]
        new = {numbers[place.array] for place in read if place.array >= first} - found
        found |= new
        left += new
    return found


def _tangent_results(
    program: ScalarProgram, functions: TracedFunctions, differentiable: TangentArrays
) -> dict[int, list[Node]]:
    """What becomes of the tangents of each array of the carry."""
    one = DerivativeProgram(program, differentiable, differentiable)
    arrays = [_arrays(functions, one, name) for name in program.results if name != RUNNING_FUNCTION]
    return {
        i: [node for each in arrays for node in each[_number(functions, one, ArrayKey(UpdateLevel.STEP, i, True))]]
        for i in differentiable[UpdateLevel.STEP]
    }


def _jvp_functions(functions: TracedFunctions, differentiable: TangentArrays) -> TracedFunctions:
    """The functions of values and tangents: of each level its arrays, then tangents of those that could have one."""
    types = {level: [*all, *(all[i] for i in differentiable[level])] for level, all in functions.types.items()}
    uniform = len(types[UpdateLevel.UNIFORM])
    each: dict[str, TracedFunction] = {}
    for name, function in functions.each.items():
        push = _jvp_function(functions, function, differentiable, name != RUNNING_FUNCTION)
        closed = jax.make_jaxpr(push)(*(x for level in INPUT_LEVELS for x in types[level]))
        shared, rest = closed.jaxpr.invars[:uniform], closed.jaxpr.invars[uniform:]
        jaxpr = closed.jaxpr.replace(constvars=[*shared, *closed.jaxpr.constvars], invars=rest)
        each[name] = TracedFunction(jaxpr, tuple(range(uniform)), tuple(closed.consts))
    return TracedFunctions(each, types, functions.uniform)


def _jvp_function(
    functions: TracedFunctions, function: TracedFunction, differentiable: TangentArrays, moves: bool
) -> Any:
    def called(arrays: dict[UpdateLevel, list[Any]]) -> list[Any]:
        shared = [*(arrays[UpdateLevel.UNIFORM][i] for i in function.closed), *function.constants]
        closed = jex.ClosedJaxpr(function.jaxpr, shared)
        return jex.jaxpr_as_fun(closed)(*arrays[UpdateLevel.LANE], *arrays[UpdateLevel.STEP])

    def push(*given: Any) -> list[Any]:
        rest, arrays, slopes = iter(given), {}, {}
        for level in INPUT_LEVELS:
            arrays[level] = [next(rest) for _ in functions.types[level]]
            slopes[level] = [next(rest) for _ in differentiable[level]]
        if not moves:
            return called(arrays)

        def moved(moving: dict[UpdateLevel, list[Any]]) -> list[Any]:
            now = {level: list(xs) for level, xs in arrays.items()}
            for level in INPUT_LEVELS:
                for i, x in zip(differentiable[level], moving[level], strict=True):
                    now[level][i] = x
            return called(now)

        moving = {level: [arrays[level][i] for i in differentiable[level]] for level in INPUT_LEVELS}
        values, tangents = jax.jvp(moved, (moving,), (slopes,))
        return [*values, *(tangents[i] for i in differentiable[UpdateLevel.STEP])]

    return push
