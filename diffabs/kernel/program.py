"""A few functions of one lane, lane and carry to carry, traced into one program of single numbers.

What the functions close over is the same for all lanes, and comes in from outside: new numbers are no new program."""

import dataclasses
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np

from diffabs.kernel import arrays, draws, elementwise, indexing, nested
from diffabs.kernel.graph import Array, Graph, Node, UpdateLevel, is_real
from diffabs.kernel.primitives import Unsupported, constant_array, lower_jaxpr

RULE_MODULES = (arrays, draws, elementwise, indexing, nested)  # which they register
MAX_OPERATIONS = 60_000  # operations of a step; a compiler would take minutes


class InputPlace(NamedTuple):
    """Where an input comes from: the number of an array, of those of its level, and the entry in it of one lane."""

    level: UpdateLevel
    array: int
    entry: int


@dataclasses.dataclass(frozen=True)
class ScalarProgram:
    """inputs: numbers of the carry, of the lanes, and uniform ones, by place; results: for each function by name its
    outputs, number by number; uniform: arrays that all lanes share; sizes: how many numbers of a lane the arrays of
    each level have; dtype: of the real numbers; tangents: how many there are of each number that has one"""

    inputs: dict[InputPlace, Node]
    results: dict[str, list[Node]]
    uniform: list[Any]
    sizes: dict[UpdateLevel, list[int]]
    dtype: np.dtype
    tangents: int = 0

    def carried(self) -> list[Node]:
        """The numbers of the carry, in their order."""
        return [node for place, node in self.inputs.items() if place.level == UpdateLevel.STEP]


class TracedFunction(NamedTuple):
    """A function of one lane as a jaxpr of lane and carry, which closes over arrays of `Functions.uniform`, by their
    numbers, and then over known constants."""

    jaxpr: Any
    closed: tuple[int, ...]
    constants: tuple[Any, ...] = ()


class TracedFunctions(NamedTuple):
    """Functions by name; the types of what they are of, array by array: what is the same for all lanes, lane, carry;
    and the arrays of the first, which may be traced."""

    each: dict[str, TracedFunction]
    types: dict[UpdateLevel, list[Any]]
    uniform: list[Any]


def trace_functions(functions: dict[str, Callable[[Any, Any], Any]], lane: Any, carry: Any) -> TracedFunctions:
    """Return functions of (lane, carry), of pytrees of these shapes, as jaxprs."""
    uniform: list[Any] = []
    numbers: dict[int, int] = {}
    each: dict[str, TracedFunction] = {}
    for name, function in functions.items():
        closed = jax.make_jaxpr(function)(lane, carry)
        for x in closed.consts:
            if id(x) not in numbers:
                numbers[id(x)] = len(uniform)
                uniform.append(x)
        each[name] = TracedFunction(closed.jaxpr, tuple(numbers[id(x)] for x in closed.consts))
    types = {
        UpdateLevel.UNIFORM: uniform,
        UpdateLevel.LANE: jax.tree.leaves(lane),
        UpdateLevel.STEP: jax.tree.leaves(carry),
    }
    return TracedFunctions(each, {level: [_type(x) for x in xs] for level, xs in types.items()}, uniform)


def build_program(functions: dict[str, Callable[[Any, Any], Any]], lane: Any, carry: Any) -> ScalarProgram:
    """Return the program of functions of (lane, carry), of pytrees of these shapes. Raises Unsupported."""
    return lower_functions(trace_functions(functions, lane, carry))


def lower_functions(functions: TracedFunctions) -> ScalarProgram:
    """Return the program of functions. Raises Unsupported."""
    graph, inputs = Graph(), {}
    sizes: dict[UpdateLevel, list[int]] = {level: [] for level in functions.types}

    def taken(aval: Any, level: UpdateLevel) -> Array:
        shape, dtype = draws.key_shape(aval)
        array, out = len(sizes[level]), np.empty(shape, object)
        for entry, at in enumerate(np.ndindex(shape)):
            place = InputPlace(level, array, entry)
            inputs[place] = out[at] = graph.input(dtype, level, place)
        sizes[level].append(out.size)
        return out

    given = {level: [taken(aval, level) for aval in avals] for level, avals in functions.types.items()}
    results: dict[str, list[Node]] = {}
    for name, (jaxpr, closed, constants) in functions.each.items():
        shared = [given[UpdateLevel.UNIFORM][i] for i in closed] + [constant_array(graph, x) for x in constants]
        outs = lower_jaxpr(graph, jaxpr, shared, [*given[UpdateLevel.LANE], *given[UpdateLevel.STEP]])
        results[name] = [node for array in outs for node in array.flat]
    found = ScalarProgram(inputs, results, functions.uniform, sizes, _real_type(inputs))
    return check_size(found, len(graph.nodes))


def check_size(program: ScalarProgram, operations: int) -> ScalarProgram:
    """Return the program. Raises Unsupported for one of too many operations."""
    if operations > MAX_OPERATIONS:
        raise Unsupported("step", f"of {operations} operations; {MAX_OPERATIONS} are the most")
    return program


def _real_type(inputs: dict[InputPlace, Node]) -> np.dtype:
    """The type of the real numbers of the carry. Raises Unsupported for several."""
    kinds = {
        np.dtype(node.dtype)
        for place, node in inputs.items()
        if place.level == UpdateLevel.STEP and is_real(node.dtype)
    }
    if len(kinds) != 1 or not kinds <= {np.dtype(np.float32), np.dtype(np.float64)}:
        raise Unsupported("carry", f"of the types {', '.join(sorted(map(str, kinds))) or 'without a real number'}")
    return kinds.pop()


def _type(x: Any) -> Any:
    """Of one lane's program, so not on which devices it lies."""
    aval = x if isinstance(x, jax.ShapeDtypeStruct) else jax.typeof(x)
    return jax.ShapeDtypeStruct(aval.shape, aval.dtype, weak_type=getattr(aval, "weak_type", False))


def live_nodes(roots: Sequence[Node]) -> list[Node]:
    """Return the nodes on which these depend, themselves included, arguments first."""
    found: dict[int, Node] = {}
    left = list(roots)
    while left:
        node = left.pop()
        if node.id not in found:
            found[node.id] = node
            left.extend(node.args)
    return [found[i] for i in sorted(found)]


class Branch:
    """A conditional in the order of a program: what is worked out in either case, and the gates that select."""

    def __init__(self, gates: list[Node], yes: "ScheduleBlock", no: "ScheduleBlock"):
        """Of gates of one number."""
        self.gates, self.yes, self.no = gates, yes, no
        self.which = gates[0].args[0]

    @property
    def size(self) -> int:
        """How many operations lie in it."""
        return self.yes.size + self.no.size + len(self.gates)


class ScheduleBlock:
    """Operations in their order; a branch stands where its first gate does."""

    def __init__(self, outer: "ScheduleBlock | None" = None):
        """Within another one, or outermost."""
        self.outer, self.depth = outer, (outer.depth + 1 if outer else 0)
        self.items: dict[int, Node | Branch] = {}

    @property
    def size(self) -> int:
        """How many operations lie in it and its branches."""
        return sum(item.size if isinstance(item, Branch) else 1 for item in self.items.values())

    def __iter__(self) -> Iterator[Node | Branch]:
        """Operations and branches, arguments first."""
        return (self.items[i] for i in sorted(self.items))


def schedule_nodes(roots: Sequence[Node], level: UpdateLevel) -> ScheduleBlock:
    """Return the operations of a level that the roots need, each in the innermost branch that needs it."""
    nodes = [node for node in live_nodes(roots) if node.level == level and node.op not in ("input", "const")]
    gates: dict[int, list[Node]] = {}
    for node in nodes:
        if node.op == "gate":
            gates.setdefault(node.attr.number, []).append(node)
    outermost, used = ScheduleBlock(), dict[int, ScheduleBlock]()

    def use(node: Node, block: ScheduleBlock) -> None:
        used[node.id] = _common(used[node.id], block) if node.id in used else block

    for root in roots:
        use(root, outermost)
    for node in reversed(nodes):
        if node.op != "gate":
            used[node.id].items[node.id] = node
            for arg in node.args:
                use(arg, used[node.id])
        elif (group := gates[node.attr.number])[-1] is node:
            block = used[node.id]
            for gate in group[:-1]:
                block = _common(block, used[gate.id])
            branch = Branch(group, ScheduleBlock(block), ScheduleBlock(block))
            block.items[group[0].id] = branch
            use(branch.which, block)
            for gate in group:
                use(gate.args[1], branch.no)
                use(gate.args[2], branch.yes)
    return outermost


def _common(a: ScheduleBlock, b: ScheduleBlock) -> ScheduleBlock:
    while a is not b:
        a, b = (a.outer, b) if a.depth >= b.depth else (a, b.outer)  # pyright: ignore[reportAssignmentType]
    return a
