"""Derivatives of functions of one lane, forward: a program of the values, and of several tangents of each number.

The program is that of `jax.jvp` of the functions, traced for one tangent of everything that could have one. In its
graph it is then seen what has: what begins with one, and what that leads to from step to step. Of each there are as
many as are asked for; the other tangents are zero, and so is everything that follows from them alone."""

from collections.abc import Iterable
from typing import Any, NamedTuple

import jax
import jax.extend.core as jex

from diffabs.kernel.copies import copy_of, following, rebuilt
from diffabs.kernel.graph import Graph, Level, Node, real
from diffabs.kernel.program import Function, Functions, Place, Program, checked, live, translated

LEVELS = (Level.UNIFORM, Level.LANE, Level.STEP)
ASKED = "running"  # the function that has no tangents: a truth
Moving = dict[Level, tuple[int, ...]]  # the arrays, of each level, that have tangents


class Key(NamedTuple):
    """An array: of which level it was when the functions were traced, its number there; or its tangents."""

    level: Level
    number: int
    tangent: bool


class Derivative(NamedTuple):
    """A program in which the arrays of each level are followed by their tangents, one each: of those that `could` have
    them. Which `do`: of the carry more than what begins with one."""

    program: Program
    could: Moving
    do: Moving


def derivative(functions: Functions, begins: Moving, wanted: Iterable[int] | None = None) -> Derivative:
    """Return the derivative of functions where these arrays have tangents to begin with; `wanted`: arrays of the carry
    whose tangents matter in the end, None for all. Raises Unsupported."""
    could = begins | {Level.STEP: tuple(i for i, x in enumerate(functions.types[Level.STEP]) if real(x.dtype))}
    program = translated(_pushed(functions, could))
    reached = _reached(program, functions, could, begins)
    if wanted is not None:
        needed = _needed(program, functions, could, set(wanted))
        reached = tuple(i for i in reached if i in needed)
    return Derivative(program, could, begins | {Level.STEP: reached})


def plain(functions: Functions) -> Derivative:
    """Return the functions without tangents. Raises Unsupported."""
    none: Moving = dict.fromkeys(LEVELS, ())
    return Derivative(translated(functions), none, none)


def arranged(functions: Functions, do: Moving, as_lanes: frozenset[int]) -> dict[Level, list[Key]]:
    """Return the arrays of a program, of each level, in their order; `as_lanes` are those that were the same for all
    lanes when the functions were traced, and now are not."""
    found: dict[Level, list[Key]] = {level: [] for level in LEVELS}
    for tangent in (False, True):
        for level in LEVELS:
            for i in do[level] if tangent else range(len(functions.types[level])):
                moved = level == Level.UNIFORM and i in as_lanes
                found[Level.LANE if moved else level].append(Key(level, i, tangent))
    return found


def spread(functions: Functions, one: Derivative, many: int, as_lanes: frozenset[int] = frozenset()) -> Program:
    """Return a derivative as a program of so many tangents of each array that has one, (many, ...) each. Raises
    Unsupported for one of too many operations."""
    graph, old = Graph(), one.program
    inputs: dict[Place, Node] = {}
    given: dict[int, list[Node]] = {}
    sizes: dict[Level, list[int]] = {level: [] for level in LEVELS}
    for level, keys in arranged(functions, one.do, as_lanes).items():
        for array, key in enumerate(keys):
            number = _number(functions, one, key)
            size, copies = old.sizes[key.level][number], many if key.tangent else 1
            for k in range(copies):
                for entry in range(size):
                    node, place = old.inputs[Place(key.level, number, entry)], Place(level, array, k * size + entry)
                    inputs[place] = graph.input(node.dtype, level, place)
                    given.setdefault(node.id, []).append(inputs[place])
            sizes[level].append(size * copies)
    slopes = {node.id for place, node in old.inputs.items() if place.array >= len(functions.types[place.level])}
    ends = {name: _results(functions, one, name) for name in old.results}
    roots = [node for arrays in ends.values() for nodes, _ in arrays for node in nodes]
    new = rebuilt(graph, roots, given, slopes, (many, old.dtype))
    results = {
        name: [copy_of(new[x.id], k) for nodes, moves in arrays for k in range(many if moves else 1) for x in nodes]
        for name, arrays in ends.items()
    }
    return checked(Program(inputs, results, functions.uniform, sizes, old.dtype, many), len(graph.nodes))


def _number(functions: Functions, one: Derivative, key: Key) -> int:
    """The number of an array in the program of one tangent."""
    first = len(functions.types[key.level])
    return first + one.could[key.level].index(key.number) if key.tangent else key.number


def _results(functions: Functions, one: Derivative, name: str) -> list[tuple[list[Node], bool]]:
    """What a function of the program of several tangents returns, array by array: those that it has of one tangent, and
    whether they are tangents."""
    if name == ASKED:
        return [(one.program.results[name], False)]
    arrays = _arrays(functions, one, name)
    slopes = [arrays[_number(functions, one, Key(Level.STEP, i, True))] for i in one.do[Level.STEP]]
    values = arrays[: len(functions.types[Level.STEP])]
    return [(nodes, False) for nodes in values] + [(nodes, True) for nodes in slopes]


def _arrays(functions: Functions, one: Derivative, name: str) -> list[list[Node]]:
    """The results of a function that changes the carry, array by array."""
    rest = iter(one.program.results[name])
    return [[next(rest) for _ in range(size)] for size in one.program.sizes[Level.STEP]]


def _reached(program: Program, functions: Functions, could: Moving, begins: Moving) -> tuple[int, ...]:
    """The arrays of the carry that have tangents in the end."""
    one, ends = Derivative(program, could, could), _ends(program, functions, could)
    nodes = live([node for nodes in ends.values() for node in nodes])
    do = begins
    while True:
        starts = {(level, _number(functions, one, Key(level, i, True))) for level in LEVELS for i in do[level]}
        found = following(nodes, {node.id for p, node in program.inputs.items() if (p.level, p.array) in starts})
        reached = tuple(i for i, nodes in ends.items() if i in do[Level.STEP] or any(x.id in found for x in nodes))
        if reached == do[Level.STEP]:
            return reached
        do = do | {Level.STEP: reached}


def _needed(program: Program, functions: Functions, could: Moving, wanted: set[int]) -> set[int]:
    """The arrays of the carry whose tangents lead to those that are wanted."""
    ends, found = _ends(program, functions, could), set(wanted)
    first = len(functions.types[Level.STEP])
    numbers = {first + at: i for at, i in enumerate(could[Level.STEP])}
    left = [i for i in wanted if i in ends]
    while left:
        read = [n.attr for n in live(ends[left.pop()]) if n.op == "input" and n.attr.level == Level.STEP]
        new = {numbers[place.array] for place in read if place.array >= first} - found
        found |= new
        left += new
    return found


def _ends(program: Program, functions: Functions, could: Moving) -> dict[int, list[Node]]:
    """What becomes of the tangents of each array of the carry."""
    one = Derivative(program, could, could)
    arrays = [_arrays(functions, one, name) for name in program.results if name != ASKED]
    return {
        i: [node for each in arrays for node in each[_number(functions, one, Key(Level.STEP, i, True))]]
        for i in could[Level.STEP]
    }


def _pushed(functions: Functions, could: Moving) -> Functions:
    """The functions of values and tangents: of each level its arrays, then tangents of those that could have one."""
    types = {level: [*all, *(all[i] for i in could[level])] for level, all in functions.types.items()}
    uniform = len(types[Level.UNIFORM])
    each: dict[str, Function] = {}
    for name, function in functions.each.items():
        push = _push(functions, function, could, name != ASKED)
        closed = jax.make_jaxpr(push)(*(x for level in LEVELS for x in types[level]))
        shared, rest = closed.jaxpr.invars[:uniform], closed.jaxpr.invars[uniform:]
        jaxpr = closed.jaxpr.replace(constvars=[*shared, *closed.jaxpr.constvars], invars=rest)
        each[name] = Function(jaxpr, tuple(range(uniform)), tuple(closed.consts))
    return Functions(each, types, functions.uniform)


def _push(functions: Functions, function: Function, could: Moving, moves: bool) -> Any:
    def called(arrays: dict[Level, list[Any]]) -> list[Any]:
        shared = [*(arrays[Level.UNIFORM][i] for i in function.closed), *function.constants]
        closed = jex.ClosedJaxpr(function.jaxpr, shared)
        return jex.jaxpr_as_fun(closed)(*arrays[Level.LANE], *arrays[Level.STEP])

    def push(*given: Any) -> list[Any]:
        rest, arrays, slopes = iter(given), {}, {}
        for level in LEVELS:
            arrays[level] = [next(rest) for _ in functions.types[level]]
            slopes[level] = [next(rest) for _ in could[level]]
        if not moves:
            return called(arrays)

        def moved(moving: dict[Level, list[Any]]) -> list[Any]:
            now = {level: list(xs) for level, xs in arrays.items()}
            for level in LEVELS:
                for i, x in zip(could[level], moving[level], strict=True):
                    now[level][i] = x
            return called(now)

        moving = {level: [arrays[level][i] for i in could[level]] for level in LEVELS}
        values, tangents = jax.jvp(moved, (moving,), (slopes,))
        return [*values, *(tangents[i] for i in could[Level.STEP])]

    return push
