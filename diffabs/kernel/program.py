"""A few functions of one lane, lane and carry to carry, traced into one program of single numbers.

What the functions close over is the same for all lanes, and comes in from outside: new numbers are no new program."""

import dataclasses
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np

from diffabs.kernel import arrays, draws, elementwise, indexing, nested
from diffabs.kernel.graph import Array, Graph, Level, Node, real
from diffabs.kernel.primitives import Unsupported, known, translate

RULES = (arrays, draws, elementwise, indexing, nested)  # which they register
LARGEST = 60_000  # operations of a step; a compiler would take minutes


class Place(NamedTuple):
    """Where an input comes from: the number of an array, of those of its level, and the entry in it of one lane."""

    level: Level
    array: int
    entry: int


@dataclasses.dataclass(frozen=True)
class Program:
    """inputs: numbers of the carry, of the lanes, and uniform ones, by place; results: for each function by name its
    outputs, number by number; uniform: arrays that all lanes share; sizes: how many numbers of a lane the arrays of
    each level have; dtype: of the real numbers; tangents: how many there are of each number that has one"""

    inputs: dict[Place, Node]
    results: dict[str, list[Node]]
    uniform: list[Any]
    sizes: dict[Level, list[int]]
    dtype: np.dtype
    tangents: int = 0

    def carried(self) -> list[Node]:
        """The numbers of the carry, in their order."""
        return [node for place, node in self.inputs.items() if place.level == Level.STEP]


class Function(NamedTuple):
    """A function of one lane as a jaxpr of lane and carry, which closes over arrays of `Functions.uniform`, by their
    numbers, and then over known constants."""

    jaxpr: Any
    closed: tuple[int, ...]
    constants: tuple[Any, ...] = ()


class Functions(NamedTuple):
    """Functions by name; the types of what they are of, array by array: what is the same for all lanes, lane, carry;
    and the arrays of the first, which may be traced."""

    each: dict[str, Function]
    types: dict[Level, list[Any]]
    uniform: list[Any]


def traced(functions: dict[str, Callable[[Any, Any], Any]], lane: Any, carry: Any) -> Functions:
    """Return functions of (lane, carry), of pytrees of these shapes, as jaxprs."""
    uniform: list[Any] = []
    numbers: dict[int, int] = {}
    each: dict[str, Function] = {}
    for name, function in functions.items():
        closed = jax.make_jaxpr(function)(lane, carry)
        for x in closed.consts:
            if id(x) not in numbers:
                numbers[id(x)] = len(uniform)
                uniform.append(x)
        each[name] = Function(closed.jaxpr, tuple(numbers[id(x)] for x in closed.consts))
    types = {Level.UNIFORM: uniform, Level.LANE: jax.tree.leaves(lane), Level.STEP: jax.tree.leaves(carry)}
    return Functions(each, {level: [_type(x) for x in xs] for level, xs in types.items()}, uniform)


def build(functions: dict[str, Callable[[Any, Any], Any]], lane: Any, carry: Any) -> Program:
    """Return the program of functions of (lane, carry), of pytrees of these shapes. Raises Unsupported."""
    return translated(traced(functions, lane, carry))


def translated(functions: Functions) -> Program:
    """Return the program of functions. Raises Unsupported."""
    graph, inputs = Graph(), {}
    sizes: dict[Level, list[int]] = {level: [] for level in functions.types}

    def taken(aval: Any, level: Level) -> Array:
        shape, dtype = draws.key_shape(aval)
        array, out = len(sizes[level]), np.empty(shape, object)
        for entry, at in enumerate(np.ndindex(shape)):
            place = Place(level, array, entry)
            inputs[place] = out[at] = graph.input(dtype, level, place)
        sizes[level].append(out.size)
        return out

    given = {level: [taken(aval, level) for aval in avals] for level, avals in functions.types.items()}
    results: dict[str, list[Node]] = {}
    for name, (jaxpr, closed, constants) in functions.each.items():
        shared = [given[Level.UNIFORM][i] for i in closed] + [known(graph, x) for x in constants]
        outs = translate(graph, jaxpr, shared, [*given[Level.LANE], *given[Level.STEP]])
        results[name] = [node for array in outs for node in array.flat]
    found = Program(inputs, results, functions.uniform, sizes, _real_type(inputs))
    return checked(found, len(graph.nodes))


def checked(program: Program, operations: int) -> Program:
    """Return the program. Raises Unsupported for one of too many operations."""
    if operations > LARGEST:
        raise Unsupported("step", f"of {operations} operations; {LARGEST} are the most")
    return program


def _real_type(inputs: dict[Place, Node]) -> np.dtype:
    """The type of the real numbers of the carry. Raises Unsupported for several."""
    kinds = {np.dtype(node.dtype) for place, node in inputs.items() if place.level == Level.STEP and real(node.dtype)}
    if len(kinds) != 1 or not kinds <= {np.dtype(np.float32), np.dtype(np.float64)}:
        raise Unsupported("carry", f"of the types {', '.join(sorted(map(str, kinds))) or 'without a real number'}")
    return kinds.pop()


def _type(x: Any) -> Any:
    """Of one lane's program, so not on which devices it lies."""
    aval = x if isinstance(x, jax.ShapeDtypeStruct) else jax.typeof(x)
    return jax.ShapeDtypeStruct(aval.shape, aval.dtype, weak_type=getattr(aval, "weak_type", False))


def live(roots: Sequence[Node]) -> list[Node]:
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

    def __init__(self, gates: list[Node], yes: "Block", no: "Block"):
        """Of gates of one number."""
        self.gates, self.yes, self.no = gates, yes, no
        self.which = gates[0].args[0]

    @property
    def size(self) -> int:
        """How many operations lie in it."""
        return self.yes.size + self.no.size + len(self.gates)


class Block:
    """Operations in their order; a branch stands where its first gate does."""

    def __init__(self, outer: "Block | None" = None):
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


def ordered(roots: Sequence[Node], level: Level) -> Block:
    """Return the operations of a level that the roots need, each in the innermost branch that needs it."""
    nodes = [node for node in live(roots) if node.level == level and node.op not in ("input", "const")]
    gates: dict[int, list[Node]] = {}
    for node in nodes:
        if node.op == "gate":
            gates.setdefault(node.attr.number, []).append(node)
    outermost, used = Block(), dict[int, Block]()

    def use(node: Node, block: Block) -> None:
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
            branch = Branch(group, Block(block), Block(block))
            block.items[group[0].id] = branch
            use(branch.which, block)
            for gate in group:
                use(gate.args[1], branch.no)
                use(gate.args[2], branch.yes)
    return outermost


def _common(a: Block, b: Block) -> Block:
    while a is not b:
        a, b = (a.outer, b) if a.depth >= b.depth else (a, b.outer)  # pyright: ignore[reportAssignmentType]
    return a
