"""A program of single numbers, lowered from traced functions of one lane."""

import dataclasses
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from diffabs.compiler.ir import Graph, Node, NodeArray, UpdateLevel, is_real, live_nodes
from diffabs.compiler.lower.random import key_shape
from diffabs.compiler.lower.rules import Unsupported, constant_array, lower_jaxpr
from diffabs.compiler.trace import TracedFunctions

RUNNING_FUNCTION = "running"  # name of the function that says whether a lane goes on
LOWERED_TYPES = ("bool", "int32", "int64", "uint32", "uint64", "float32", "float64")
MAX_OPERATIONS = 60_000  # nodes of a program; a compiler takes minutes for more


class InputPlace(NamedTuple):
    """The array and the entry that an input has its value from.

    Attributes:
        level: Level of the array: UNIFORM, LANE, or STEP for the carry.
        array: Index of the array among those of its level.
        entry: Index in the flattened array of one lane.
    """

    level: UpdateLevel
    array: int
    entry: int


@dataclasses.dataclass(frozen=True)
class ScalarProgram:
    """A program of single numbers.

    Attributes:
        inputs: Input nodes by place; in each level array by array, entry by entry.
        results: Output nodes by the name of the function. `renew` and `step` have one for each input of the carry.
        sizes: For each level, the number of entries of each array in one lane.
        dtype: Type of the real numbers.
        tangents: Number of tangent directions in a program of `replicate_tangents`, else 0.
    """

    inputs: dict[InputPlace, Node]
    results: dict[str, list[Node]]
    sizes: dict[UpdateLevel, list[int]]
    dtype: np.dtype
    tangents: int = 0

    def carry_inputs(self) -> list[Node]:
        """Return the input nodes of the carry, array by array and entry by entry."""
        return [node for place, node in self.inputs.items() if place.level == UpdateLevel.STEP]


def lower_functions(functions: TracedFunctions) -> ScalarProgram:
    """Return the program of single numbers of traced functions, or raise Unsupported for what a program cannot hold."""
    graph, inputs = Graph(), {}
    sizes: dict[UpdateLevel, list[int]] = {level: [] for level in functions.types}

    def take_inputs(aval: object, level: UpdateLevel) -> NodeArray:
        """Return the next array of a level as an array of new input nodes."""
        shape, dtype = key_shape(aval)
        array, out = len(sizes[level]), np.empty(shape, object)
        for entry, at in enumerate(np.ndindex(shape)):
            place = InputPlace(level, array, entry)
            inputs[place] = out[at] = graph.input(dtype, level, place)
        sizes[level].append(out.size)
        return out

    input_nodes = {level: [take_inputs(aval, level) for aval in avals] for level, avals in functions.types.items()}
    results: dict[str, list[Node]] = {}
    for name, (jaxpr, closed, constants) in functions.each.items():
        shared = [input_nodes[UpdateLevel.UNIFORM][i] for i in closed] + [constant_array(graph, x) for x in constants]
        outs = lower_jaxpr(graph, jaxpr, shared, [*input_nodes[UpdateLevel.LANE], *input_nodes[UpdateLevel.STEP]])
        results[name] = [node for array in outs for node in array.flat]
    for node in live_nodes([node for nodes in results.values() for node in nodes]):
        if node.dtype.name not in LOWERED_TYPES:
            raise Unsupported(node.op, f"on numbers of the type {node.dtype}")
    program = ScalarProgram(inputs, results, sizes, _real_type(inputs))
    return check_size(program, len(graph.nodes))


def check_size(program: ScalarProgram, operations: int, limit: int = MAX_OPERATIONS) -> ScalarProgram:
    """Return the program unchanged, or raise Unsupported if it has more than `limit` operations."""
    if operations > limit:
        raise Unsupported("step", f"of {operations} operations; {limit} are the most")
    return program


def keep_read(program: ScalarProgram, arrays: Iterable[int]) -> ScalarProgram:
    """Return the program without updates of the carry that never influence `running` or the given arrays.

    The result of such an update becomes its input, so the number keeps its initial value.
    """
    updates = [nodes for name, nodes in program.results.items() if name != RUNNING_FUNCTION]
    carried, final_arrays = program.carry_inputs(), set(arrays)
    number = {node.id: i for i, node in enumerate(carried)}
    read = {number[node.id] for node in carried if node.attr.array in final_arrays}
    pending = [*program.results[RUNNING_FUNCTION], *(nodes[i] for nodes in updates for i in read)]
    visited: set[int] = set()
    while pending:
        node = pending.pop()
        if node.id not in visited:
            visited.add(node.id)
            pending += node.args
            # A number that some result reads is a result itself, since the next step reads it.
            if (i := number.get(node.id)) is not None and i not in read:
                read.add(i)
                pending += [nodes[i] for nodes in updates]
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
