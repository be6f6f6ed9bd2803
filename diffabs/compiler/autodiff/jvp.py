"""Forward-mode derivatives of functions of one lane: a program of the values and of several tangent directions.

`differentiate_functions` lowers `jax.jvp` of the functions, with one tangent for each seeded array and each real array
of the carry. Reachability in its graph then shows which arrays of the carry have a tangent that can be nonzero and that
influences a wanted result. `replicate_tangents` writes these tangents once for each direction. All others are zero.
"""

from collections.abc import Iterable
from typing import NamedTuple

import jax
import jax.extend.core as jex

from diffabs.compiler.autodiff.replicate import dependents, replicate_nodes, tangent_copy
from diffabs.compiler.ir import Graph, Node, UpdateLevel, is_real, live_nodes
from diffabs.compiler.program import RUNNING_FUNCTION, InputPlace, ScalarProgram, check_size, lower_functions
from diffabs.compiler.trace import TracedFunction, TracedFunctions
from diffabs.core.types import PyTree

INPUT_LEVELS = (UpdateLevel.UNIFORM, UpdateLevel.LANE, UpdateLevel.STEP)
TangentArrays = dict[UpdateLevel, tuple[int, ...]]  # indices of arrays that have a tangent, by level


class ArrayKey(NamedTuple):
    """The identity of an array or of its tangents.

    Attributes:
        level: Level of the array when the functions were traced.
        number: Index of the array in that level.
        tangent: True for the tangents of the array, False for its values.
    """

    level: UpdateLevel
    number: int
    tangent: bool


class DerivativeProgram(NamedTuple):
    """A program with one tangent direction. In each level, its arrays are all values and then the tangents.

    Attributes:
        program: Operations and results.
        differentiable: Indices of the arrays that have a tangent in `program`, by level.
        moved_arrays: Indices of the arrays whose tangents the launched program keeps, by level: in the carry those that
            can be nonzero and influence a wanted array, in the other levels the seeded ones.
    """

    program: ScalarProgram
    differentiable: TangentArrays
    moved_arrays: TangentArrays


def differentiate_functions(
    functions: TracedFunctions, seeded: TangentArrays, outputs_needed: Iterable[int] | None = None
) -> DerivativeProgram:
    """Return the program of the functions' values and one tangent direction.

    Only the arrays in `seeded` have initial tangents that can be nonzero, and only the tangents of the carry's arrays
    in `outputs_needed` matter at the end, None for all.
    """
    differentiable = seeded | {
        UpdateLevel.STEP: tuple(i for i, x in enumerate(functions.types[UpdateLevel.STEP]) if is_real(x.dtype))
    }
    program = lower_functions(_jvp_functions(functions, differentiable))
    reached = _reached_arrays(program, functions, differentiable, seeded)
    if outputs_needed is not None:
        needed = _needed_arrays(program, functions, differentiable, set(outputs_needed))
        # A tangent that no wanted result needs counts as zero: the launched program has no operation for it.
        reached = tuple(i for i in reached if i in needed)
    return DerivativeProgram(program, differentiable, seeded | {UpdateLevel.STEP: reached})


def arrange_arrays(
    functions: TracedFunctions, moved_arrays: TangentArrays, per_lane_uniforms: frozenset[int]
) -> dict[UpdateLevel, list[ArrayKey]]:
    """Return the keys of the launched program's arrays by level, in their order: values, then tangents.

    A uniform array in `per_lane_uniforms`, to which vmap has given a value per lane, belongs to the level LANE, and so
    do its tangents.
    """
    keys_by_level: dict[UpdateLevel, list[ArrayKey]] = {level: [] for level in INPUT_LEVELS}
    for tangent in (False, True):
        for level in INPUT_LEVELS:
            for i in moved_arrays[level] if tangent else range(len(functions.types[level])):
                moved = level == UpdateLevel.UNIFORM and i in per_lane_uniforms
                keys_by_level[UpdateLevel.LANE if moved else level].append(ArrayKey(level, i, tangent))
    return keys_by_level


def replicate_tangents(
    functions: TracedFunctions,
    derivative: DerivativeProgram,
    many: int,
    per_lane_uniforms: frozenset[int] = frozenset(),
) -> ScalarProgram:
    """Return the program with `many` tangent directions; the tangents of an array have the shape (many, ...).

    `replicate_nodes` eliminates tangents, so that the program has few operations. `per_lane_uniforms` is as in
    `arrange_arrays`.
    """
    graph, old = Graph(), derivative.program
    inputs: dict[InputPlace, Node] = {}
    input_copies: dict[int, list[Node]] = {}
    sizes: dict[UpdateLevel, list[int]] = {level: [] for level in INPUT_LEVELS}
    for level, keys in arrange_arrays(functions, derivative.moved_arrays, per_lane_uniforms).items():
        for array, key in enumerate(keys):
            number = _array_index(functions, derivative.differentiable, key)
            size, copies = old.sizes[key.level][number], many if key.tangent else 1
            for k in range(copies):
                for entry in range(size):
                    node, place = (
                        old.inputs[InputPlace(key.level, number, entry)],
                        InputPlace(level, array, k * size + entry),
                    )
                    # A uniform array that is now an array of lanes changes its level here, not the functions.
                    inputs[place] = graph.input(node.dtype, level, place)
                    input_copies.setdefault(node.id, []).append(inputs[place])
            sizes[level].append(size * copies)
    # In each level the tangents follow the values, so their array numbers start at the number of values.
    slopes = {node.id for place, node in old.inputs.items() if place.array >= len(functions.types[place.level])}
    # The results of each function, array by array: nodes of the program of one tangent, and whether they are tangents.
    ends: dict[str, list[tuple[list[Node], bool]]] = {}
    for name, nodes in old.results.items():
        if name == RUNNING_FUNCTION:
            ends[name] = [(nodes, False)]
            continue
        arrays = _results_by_array(old, name)
        moving = [
            _array_index(functions, derivative.differentiable, ArrayKey(UpdateLevel.STEP, i, True))
            for i in derivative.moved_arrays[UpdateLevel.STEP]
        ]
        values = arrays[: len(functions.types[UpdateLevel.STEP])]
        ends[name] = [(x, False) for x in values] + [(arrays[i], True) for i in moving]
    roots = [node for arrays in ends.values() for nodes, _ in arrays for node in nodes]
    new = replicate_nodes(graph, roots, input_copies, slopes, (many, old.dtype))
    results = {
        name: [
            tangent_copy(new[x.id], k) for nodes, moves in arrays for k in range(many if moves else 1) for x in nodes
        ]
        for name, arrays in ends.items()
    }
    return check_size(ScalarProgram(inputs, results, sizes, old.dtype, many), len(graph.nodes))


def _array_index(functions: TracedFunctions, differentiable: TangentArrays, key: ArrayKey) -> int:
    """Return the index of an array among those of its level in the program with one tangent."""
    first = len(functions.types[key.level])
    return first + differentiable[key.level].index(key.number) if key.tangent else key.number


def _results_by_array(program: ScalarProgram, name: str) -> list[list[Node]]:
    """Return the results of `renew` or `step` (`name`), grouped by array of the carry."""
    nodes = iter(program.results[name])
    return [[next(nodes) for _ in range(size)] for size in program.sizes[UpdateLevel.STEP]]


def _reached_arrays(
    program: ScalarProgram, functions: TracedFunctions, differentiable: TangentArrays, seeded: TangentArrays
) -> tuple[int, ...]:
    """Return the indices of the carry's arrays whose tangents can be nonzero at the start or after some step."""
    ends = _tangent_results(program, functions, differentiable)
    nodes = live_nodes([node for nodes in ends.values() for node in nodes])
    # A fixed point: arrays that one step reaches may reach more arrays in the next.
    moved_arrays = seeded
    while True:
        starts = {
            (level, _array_index(functions, differentiable, ArrayKey(level, i, True)))
            for level in INPUT_LEVELS
            for i in moved_arrays[level]
        }
        moving = dependents(nodes, {node.id for p, node in program.inputs.items() if (p.level, p.array) in starts})
        reached = tuple(
            i for i, nodes in ends.items() if i in moved_arrays[UpdateLevel.STEP] or any(x.id in moving for x in nodes)
        )
        if reached == moved_arrays[UpdateLevel.STEP]:
            return reached
        moved_arrays = moved_arrays | {UpdateLevel.STEP: reached}


def _needed_arrays(
    program: ScalarProgram, functions: TracedFunctions, differentiable: TangentArrays, outputs_needed: set[int]
) -> set[int]:
    """Return the indices of the carry's arrays whose tangents influence one of `outputs_needed` in any later step."""
    ends, needed = _tangent_results(program, functions, differentiable), set(outputs_needed)
    first = len(functions.types[UpdateLevel.STEP])
    numbers = {first + at: i for at, i in enumerate(differentiable[UpdateLevel.STEP])}
    pending = [i for i in outputs_needed if i in ends]
    while pending:
        read = [n.attr for n in live_nodes(ends[pending.pop()]) if n.op == "input" and n.attr.level == UpdateLevel.STEP]
        new = {numbers[place.array] for place in read if place.array >= first} - needed
        needed |= new
        pending += new
    return needed


def _tangent_results(
    program: ScalarProgram, functions: TracedFunctions, differentiable: TangentArrays
) -> dict[int, list[Node]]:
    """Return the tangents that `renew` and `step` assign to each differentiable array of the carry, by its index."""
    arrays = [_results_by_array(program, name) for name in program.results if name != RUNNING_FUNCTION]
    first = len(functions.types[UpdateLevel.STEP])
    tangents = enumerate(differentiable[UpdateLevel.STEP], first)
    return {i: [node for each in arrays for node in each[place]] for place, i in tangents}


def _jvp_functions(functions: TracedFunctions, differentiable: TangentArrays) -> TracedFunctions:
    """Return the functions of values and one tangent direction.

    In each level, the tangents of the differentiable arrays follow all values. `running` returns its value alone.
    """
    types = {level: [*all, *(all[i] for i in differentiable[level])] for level, all in functions.types.items()}
    uniform = len(types[UpdateLevel.UNIFORM])
    each: dict[str, TracedFunction] = {}
    for name, function in functions.each.items():
        derivative = _jvp_function(functions, function, differentiable, name != RUNNING_FUNCTION)
        closed = jax.make_jaxpr(derivative)(*(x for level in INPUT_LEVELS for x in types[level]))
        shared, lane_and_carry = closed.jaxpr.invars[:uniform], closed.jaxpr.invars[uniform:]
        # The uniform inputs become constvars, as in a traced function: `lower_functions` passes them by number.
        jaxpr = closed.jaxpr.replace(constvars=[*shared, *closed.jaxpr.constvars], invars=lane_and_carry)
        each[name] = TracedFunction(jaxpr, tuple(range(uniform)), tuple(closed.consts))
    return TracedFunctions(each, types, functions.uniform, functions.names)


def _jvp_function(
    functions: TracedFunctions, function: TracedFunction, differentiable: TangentArrays, with_tangents: bool
) -> PyTree:
    """Return a function of all values and tangents that returns values and, if `with_tangents`, their tangents.

    Its arguments are, for each level, all values and then the tangents of the differentiable arrays.
    """

    def evaluate(arrays: dict[UpdateLevel, list[PyTree]]) -> list[PyTree]:
        shared = [*(arrays[UpdateLevel.UNIFORM][i] for i in function.closed), *function.constants]
        closed = jex.ClosedJaxpr(function.jaxpr, shared)
        return jex.jaxpr_as_fun(closed)(*arrays[UpdateLevel.LANE], *arrays[UpdateLevel.STEP])

    def compute(*arguments: PyTree) -> list[PyTree]:
        remaining, arrays, slopes = iter(arguments), {}, {}
        for level in INPUT_LEVELS:
            arrays[level] = [next(remaining) for _ in functions.types[level]]
            slopes[level] = [next(remaining) for _ in differentiable[level]]
        if not with_tangents:
            return evaluate(arrays)

        def evaluate_at(moving: dict[UpdateLevel, list[PyTree]]) -> list[PyTree]:
            now = {level: list(xs) for level, xs in arrays.items()}
            for level in INPUT_LEVELS:
                for i, x in zip(differentiable[level], moving[level], strict=True):
                    now[level][i] = x
            return evaluate(now)

        moving = {level: [arrays[level][i] for i in differentiable[level]] for level in INPUT_LEVELS}
        values, tangents = jax.jvp(evaluate_at, (moving,), (slopes,))
        return [*values, *(tangents[i] for i in differentiable[UpdateLevel.STEP])]

    return compute
