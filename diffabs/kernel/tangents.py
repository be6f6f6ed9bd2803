"""Derivatives of functions of one lane, forward: a program of the values, and of several tangents of each number.

The program is that of `jax.jvp` of the functions, traced for one tangent of everything that could have one. In its
graph it is then seen what has: what begins with one, and what that leads to from step to step. Of each there are as
many as are asked for; the other tangents are zero, and so is everything that follows from them alone."""

from collections.abc import Iterable
from typing import Any, NamedTuple

import jax
import jax.extend.core as jex

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


def derivative(functions: Functions, begins: Moving) -> Derivative:
    """Return the derivative of functions where these arrays have tangents to begin with. Raises Unsupported."""
    could = begins | {Level.STEP: tuple(i for i, x in enumerate(functions.types[Level.STEP]) if real(x.dtype))}
    program = translated(_pushed(functions, could))
    return Derivative(program, could, begins | {Level.STEP: _reached(program, functions, could, begins)})


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
    new: dict[int, list[Node]] = {}
    sizes: dict[Level, list[int]] = {level: [] for level in LEVELS}
    for level, keys in arranged(functions, one.do, as_lanes).items():
        for array, key in enumerate(keys):
            number = _number(functions, one, key)
            size, copies = old.sizes[key.level][number], many if key.tangent else 1
            for k in range(copies):
                for entry in range(size):
                    node, place = old.inputs[Place(key.level, number, entry)], Place(level, array, k * size + entry)
                    inputs[place] = graph.input(node.dtype, level, place)
                    new.setdefault(node.id, []).append(inputs[place])
            sizes[level].append(size * copies)
    _rebuild(graph, functions, old, new)
    results = {name: [new[node.id][0] for node in nodes] for name, nodes in old.results.items() if name == ASKED}
    for name in (name for name in old.results if name != ASKED):
        arrays = _arrays(functions, one, name)
        values = [new[node.id][0] for nodes in arrays[: len(functions.types[Level.STEP])] for node in nodes]
        slopes = [arrays[_number(functions, one, Key(Level.STEP, i, True))] for i in one.do[Level.STEP]]
        results[name] = values + [_copy(new[x.id], k) for nodes in slopes for k in range(many) for x in nodes]
    copies = {node.id: k for nodes in new.values() if len(nodes) > 1 for k, node in enumerate(nodes)}
    return checked(Program(inputs, results, functions.uniform, sizes, old.dtype, copies), len(graph.nodes))


def _number(functions: Functions, one: Derivative, key: Key) -> int:
    """The number of an array in the program of one tangent."""
    first = len(functions.types[key.level])
    return first + one.could[key.level].index(key.number) if key.tangent else key.number


def _arrays(functions: Functions, one: Derivative, name: str) -> list[list[Node]]:
    """The results of a function that changes the carry, array by array."""
    rest = iter(one.program.results[name])
    return [[next(rest) for _ in range(size)] for size in one.program.sizes[Level.STEP]]


def _copy(nodes: list[Node], k: int) -> Node:
    return nodes[k if len(nodes) > 1 else 0]


def _rebuild(graph: Graph, functions: Functions, old: Program, new: dict[int, list[Node]]) -> None:
    """Put beside each node what becomes of it, as stands there beside inputs: itself, one for each tangent, or zero."""
    nodes = live([node for results in old.results.values() for node in results])
    slopes = {node.id for place, node in old.inputs.items() if place.array >= len(functions.types[place.level])}
    moving = _following(nodes, {i for i in slopes if i in new})
    slopes = _following(nodes, slopes)
    for node in nodes:
        if node.id in moving and node.op != "input":
            copies = range(max(len(new[x.id]) for x in node.args))
            new[node.id] = [_again(graph, node, [_copy(new[x.id], k) for x in node.args], slopes) for k in copies]
        elif node.id in slopes and node.id not in moving:
            new[node.id] = [graph.const(0, node.dtype)]
        elif node.op != "input":
            new[node.id] = [graph.again(node, [new[x.id][0] for x in node.args])]


def _again(graph: Graph, node: Node, args: list[Node], slopes: set[int]) -> Node:
    """The same of a tangent; all that are divided by a number share its inverse."""
    if node.op == "div" and node.args[1].id not in slopes:
        return graph.op("mul", args[0], graph.op("div", graph.const(1, node.dtype), args[1]))
    return graph.again(node, args)


def _following(nodes: Iterable[Node], first: set[int]) -> set[int]:
    """What is made of these, themselves included; nodes with arguments first."""
    found = set(first)
    found.update(node.id for node in nodes if any(x.id in found for x in node.args))
    return found


def _reached(program: Program, functions: Functions, could: Moving, begins: Moving) -> tuple[int, ...]:
    """The arrays of the carry that have tangents in the end."""
    one = Derivative(program, could, could)
    names = [name for name in program.results if name != ASKED]
    ends = {
        i: [
            node
            for name in names
            for node in _arrays(functions, one, name)[_number(functions, one, Key(Level.STEP, i, True))]
        ]
        for i in could[Level.STEP]
    }
    nodes = live([node for nodes in ends.values() for node in nodes])
    do = begins
    while True:
        starts = {(level, _number(functions, one, Key(level, i, True))) for level in LEVELS for i in do[level]}
        found = _following(nodes, {node.id for p, node in program.inputs.items() if (p.level, p.array) in starts})
        reached = tuple(i for i, nodes in ends.items() if i in do[Level.STEP] or any(x.id in found for x in nodes))
        if reached == do[Level.STEP]:
            return reached
        do = do | {Level.STEP: reached}


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
