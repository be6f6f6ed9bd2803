"""JAX functions of one lane, (lane, carry) to carry, traced and lowered to one program of single numbers.

Values that the functions close over are inputs, the same for all lanes. So new values need no new compilation.
"""

import dataclasses
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np

from diffabs.core.types import PyTree, Scalar
from diffabs.kernel import arrays, draws, elementwise, indexing, nested
from diffabs.kernel.graph import Array, Graph, Node, UpdateLevel, is_real
from diffabs.kernel.primitives import Unsupported, constant_array, lower_jaxpr

RULE_MODULES = (arrays, draws, elementwise, indexing, nested)  # imported because each registers its rules
RUNNING_FUNCTION = "running"  # name of the function that says whether a lane goes on
MAX_OPERATIONS = 60_000  # nodes of a program; a compiler takes minutes for more


class InputPlace(NamedTuple):
    """The origin of an input.

    Attributes:
        level: Rate of change of the array.
        array: Index of the array among those of its level.
        entry: Index of the number within one lane's flat array.
    """

    level: UpdateLevel
    array: int
    entry: int


@dataclasses.dataclass(frozen=True)
class ScalarProgram:
    """A program of single numbers.

    Attributes:
        inputs: Nodes of the carry, the lanes and the uniform arrays, by place.
        results: For each function, by name, its outputs as single numbers.
        uniform: Arrays that all lanes share.
        sizes: For each level, the sizes of its arrays in one lane.
        dtype: Type of the real numbers.
        tangents: Number of tangent directions in a program of `replicate_tangents`, else 0.
    """

    inputs: dict[InputPlace, Node]
    results: dict[str, list[Node]]
    uniform: list[PyTree]
    sizes: dict[UpdateLevel, list[int]]
    dtype: np.dtype
    tangents: int = 0

    def carry_inputs(self) -> list[Node]:
        """Return the input nodes of the carry, array by array and entry by entry."""
        return [node for place, node in self.inputs.items() if place.level == UpdateLevel.STEP]


class TracedFunction(NamedTuple):
    """A function of one lane as a jaxpr of the arrays of lane and carry.

    Attributes:
        jaxpr: Jaxpr; its constvars are first the uniform arrays, then constants.
        closed: Indices of the arrays in `TracedFunctions.uniform` that the function closes over.
        constants: Further constants that it closes over.
    """

    jaxpr: Any
    closed: tuple[int, ...]
    constants: tuple[PyTree, ...] = ()


class TracedFunctions(NamedTuple):
    """Traced functions of one lane with the arrays they share.

    Attributes:
        each: Functions by name.
        types: Shapes and types of the arrays of each level: uniform, lane, carry.
        uniform: The uniform arrays, which may be tracers.
    """

    each: dict[str, TracedFunction]
    types: dict[UpdateLevel, list[PyTree]]
    uniform: list[PyTree]


def trace_functions(
    functions: dict[str, Callable[[PyTree, PyTree], PyTree]], lane: PyTree, carry: PyTree
) -> TracedFunctions:
    """Return functions of (lane, carry) as jaxprs, with the arrays that they close over.

    Args:
        functions: Functions by name.
        lane: Pytree with shapes and types of a lane's constants, without the axis of lanes.
        carry: Pytree with shapes and types of a lane's carry, without the axis of lanes.
    """
    uniform: list[PyTree] = []
    numbers: dict[int, int] = {}
    each: dict[str, TracedFunction] = {}
    for name, function in functions.items():
        closed = jax.make_jaxpr(function)(lane, carry)
        for x in closed.consts:
            # Functions that close over the same array share one input. Equal values in two arrays stay two inputs.
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


def build_program(
    functions: dict[str, Callable[[PyTree, PyTree], PyTree]], lane: PyTree, carry: PyTree
) -> ScalarProgram:
    """Trace functions of (lane, carry) and return their program of single numbers.

    Args:
        functions: Functions by name.
        lane: Pytree with shapes and types of a lane's constants, without the axis of lanes.
        carry: Pytree with shapes and types of a lane's carry, without the axis of lanes.

    Raises:
        Unsupported: As in `lower_functions`.
    """
    return lower_functions(trace_functions(functions, lane, carry))


def lower_functions(functions: TracedFunctions) -> ScalarProgram:
    """Return the program of single numbers of traced functions.

    Args:
        functions: Traced functions.

    Raises:
        Unsupported: A function uses an operation without a lowering rule, there are too many operations, or the carry's
            real numbers do not share one type, float32 or float64.
    """
    graph, inputs = Graph(), {}
    sizes: dict[UpdateLevel, list[int]] = {level: [] for level in functions.types}

    def take_inputs(aval: Any, level: UpdateLevel) -> Array:
        shape, dtype = draws.key_shape(aval)
        array, out = len(sizes[level]), np.empty(shape, object)
        for entry, at in enumerate(np.ndindex(shape)):
            place = InputPlace(level, array, entry)
            inputs[place] = out[at] = graph.input(dtype, level, place)
        sizes[level].append(out.size)
        return out

    given = {level: [take_inputs(aval, level) for aval in avals] for level, avals in functions.types.items()}
    results: dict[str, list[Node]] = {}
    for name, (jaxpr, closed, constants) in functions.each.items():
        shared = [given[UpdateLevel.UNIFORM][i] for i in closed] + [constant_array(graph, x) for x in constants]
        outs = lower_jaxpr(graph, jaxpr, shared, [*given[UpdateLevel.LANE], *given[UpdateLevel.STEP]])
        results[name] = [node for array in outs for node in array.flat]
    found = ScalarProgram(inputs, results, functions.uniform, sizes, _real_type(inputs))
    return check_size(found, len(graph.nodes))


def check_size(program: ScalarProgram, operations: int) -> ScalarProgram:
    """Return the program unchanged, or raise if it is too large.

    Args:
        program: Program to return.
        operations: Number of nodes in its graph, inputs and constants included.

    Raises:
        Unsupported: `operations` is greater than MAX_OPERATIONS.
    """
    if operations > MAX_OPERATIONS:
        raise Unsupported("step", f"of {operations} operations; {MAX_OPERATIONS} are the most")
    return program


def keep_read(program: ScalarProgram, arrays: Iterable[int]) -> ScalarProgram:
    """Return the program without the results that never influence `running` or the given arrays of the carry.

    These numbers stay as they are in the initial carry.

    Args:
        program: Program of functions that update the carry, and `running`.
        arrays: Indices of the carry's arrays whose values matter at the end.
    """
    updates = [nodes for name, nodes in program.results.items() if name != RUNNING_FUNCTION]
    carried, chosen = program.carry_inputs(), set(arrays)
    number = {node.id: i for i, node in enumerate(carried)}
    read = {number[node.id] for node in carried if node.attr.array in chosen}
    left = [*program.results[RUNNING_FUNCTION], *(nodes[i] for nodes in updates for i in read)]
    seen: set[int] = set()
    while left:
        node = left.pop()
        if node.id not in seen:
            seen.add(node.id)
            left += node.args
            # A number that some result reads is a result itself, since the next step reads it.
            if (i := number.get(node.id)) is not None and i not in read:
                read.add(i)
                left += [nodes[i] for nodes in updates]
    results = {
        name: nodes if name == RUNNING_FUNCTION else [node if i in read else carried[i] for i, node in enumerate(nodes)]
        for name, nodes in program.results.items()
    }
    return dataclasses.replace(program, results=results)


def _real_type(inputs: dict[InputPlace, Node]) -> np.dtype:
    """Return the type of the carry's real numbers; raise Unsupported unless it is the only one, of 32 or 64 bits."""
    kinds = {
        np.dtype(node.dtype)
        for place, node in inputs.items()
        if place.level == UpdateLevel.STEP and is_real(node.dtype)
    }
    if len(kinds) != 1 or not kinds <= {np.dtype(np.float32), np.dtype(np.float64)}:
        raise Unsupported("carry", f"of the types {', '.join(sorted(map(str, kinds))) or 'without a real number'}")
    return kinds.pop()


def _type(x: Scalar) -> Scalar:
    """Return shape and type of an array without its sharding, because the program is for one lane."""
    aval = x if isinstance(x, jax.ShapeDtypeStruct) else jax.typeof(x)
    return jax.ShapeDtypeStruct(aval.shape, aval.dtype, weak_type=getattr(aval, "weak_type", False))


def live_nodes(roots: Sequence[Node]) -> list[Node]:
    """Return the roots and all nodes that they depend on, without duplicates, operands first.

    Args:
        roots: Nodes.
    """
    found: dict[int, Node] = {}
    left = list(roots)
    while left:
        node = left.pop()
        if node.id not in found:
            found[node.id] = node
            left.extend(node.args)
    # Node ids grow from operands to results, so sorting is a topological order.
    return [found[i] for i in sorted(found)]


class Branch:
    """A conditional in a schedule.

    Attributes:
        gates: Selections of the conditional's results.
        yes: Operations that only the true branch needs.
        no: Operations that only the false branch needs.
        which: Boolean node of the condition.
    """

    def __init__(self, gates: list[Node], yes: "ScheduleBlock", no: "ScheduleBlock"):
        """Create the conditional of `gates`, which share one number, with the blocks `yes` and `no`."""
        self.gates, self.yes, self.no = gates, yes, no
        self.which = gates[0].args[0]

    @property
    def size(self) -> int:
        """Number of operations in both branches, gates included."""
        return self.yes.size + self.no.size + len(self.gates)


class ScheduleBlock:
    """Operations in their order; a branch stands in the place of its first gate."""

    def __init__(self, outer: "ScheduleBlock | None" = None):
        """Create an empty block inside the block `outer`, or an outermost block."""
        self.outer, self.depth = outer, (outer.depth + 1 if outer else 0)
        self.items: dict[int, Node | Branch] = {}

    @property
    def size(self) -> int:
        """Number of operations in the block and its branches."""
        return sum(item.size if isinstance(item, Branch) else 1 for item in self.items.values())

    def nodes(self) -> Iterator[Node]:
        """Yield the operations of the block and of its branches, gates included, in any order."""
        for item in self.items.values():
            if isinstance(item, Branch):
                yield from item.gates
                yield from (*item.yes.nodes(), *item.no.nodes())
            else:
                yield item

    def __iter__(self) -> Iterator[Node | Branch]:
        """Yield operations and branches, operands first."""
        return (self.items[i] for i in sorted(self.items))


def schedule_nodes(roots: Sequence[Node], level: UpdateLevel) -> ScheduleBlock:
    """Return a level's operations that the roots need, nested in the branches of conditionals.

    Each operation lies in the innermost branch that contains all its readers.

    Args:
        roots: Nodes to compute.
        level: Level of the operations.
    """
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
    # Readers first: when a node is placed, the blocks of all its readers are known.
    for node in reversed(nodes):
        if node.op != "gate":
            used[node.id].items[node.id] = node
            for arg in node.args:
                use(arg, used[node.id])
        elif (group := gates[node.attr.number])[-1] is node:
            block = used[node.id]
            # The gates of a conditional are created in a row, so here the readers of all of them are placed.
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
    """Return the innermost block that contains both blocks."""
    while a is not b:
        a, b = (a.outer, b) if a.depth >= b.depth else (a, b.outer)  # pyright: ignore[reportAssignmentType]
    return a
