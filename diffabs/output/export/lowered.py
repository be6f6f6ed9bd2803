"""A controller as operations on single numbers, in a form that every target language can write.

The operations come from the jaxprs of the loop's own functions, by the rules of package `compiler`. So a part needs no
code for any language.
"""

import re
from collections.abc import Callable

import jax
import numpy as np

from diffabs.compiler.ir import Graph, Node, NodeArray, UpdateLevel, live_nodes
from diffabs.compiler.lower.labels import Labelled, source_label
from diffabs.compiler.lower.rules import constant_array, lower_jaxpr
from diffabs.core.types import PyTree
from diffabs.output.export.device import ComputerProgram, NotExported

MEMORY, INPUTS, NUMBERS = "s", "in", "p"  # origins of the graph's inputs, the first entry of a node's `attr`


class Lowered:
    """A controller whose memory, inputs and parameters are numbers with names.

    Attributes:
        device: The computer's part of the loop.
        inputs, numbers, state: Input nodes of measurements, parameters and memory, by name.
        values: Initial values of the parameters, by name.
        begun: Nodes of the memory before the first sample, by name.
        after: Nodes of the memory after a sample, by name.
        moving: Nodes of the reference's memory after one simulation step, by name; they repeat `moves` times a sample.
        place: Node of the counter of these steps.
        held: Boolean node: the sample cannot be used.
        memory: Names of the memory that a command or `held` depends on, at once or later, and those of the commands.
        read: Names of the inputs that this memory or `held` depends on.
        used: Names of the parameters that this memory or `held` depends on.
        stored: Nodes of the memory after a sample for the names in `memory`, without `moving`.
    """

    def __init__(self, device: ComputerProgram):
        """Trace and lower start, step and move."""
        self.device = device
        graph = Labelled()
        self.inputs: dict[str, Node] = number_leaves(
            device.input, graph, INPUTS, lambda path: path.removeprefix("measured.")
        )
        self.numbers: dict[str, Node] = number_leaves(
            device.parts, graph, NUMBERS, lambda path: path.removeprefix("controller.")
        )
        self.state: dict[str, Node] = number_leaves(device.state, graph, MEMORY, name_memory)
        values = [float(x) for leaf in jax.tree.leaves(device.parts) for x in np.asarray(leaf, float).flat]
        self.values: dict[str, float] = dict(zip(self.numbers, values, strict=True))
        inputs, parts = fill_shapes(device.input, self.inputs), fill_shapes(device.parts, self.numbers)
        started = trace_outputs(
            graph, lambda both: device.start(*both), (device.parts, device.input), [*parts, *inputs]
        )
        held = fill_shapes(device.state, self.state)
        shapes = (device.parts, device.state, device.input)
        *after, self.held = trace_outputs(graph, lambda all: device.step(*all), shapes, [*parts, *held, *inputs])
        self.place: Node = graph.input(np.int64, UpdateLevel.UNIFORM, ("", "i"))
        moved: list[Node] = []
        if device.moves:
            place, count = np.full((), self.place, object), jax.ShapeDtypeStruct((), np.int64)
            shapes = (device.parts, device.state, count)
            moved = trace_outputs(graph, lambda all: device.move(*all), shapes, [*parts, *held, place])
        # The reference's memory comes last in the state, and only `move` changes it.
        moving = dict(zip([*self.state][len(after) :], moved, strict=bool(moved)))
        self.after: dict[str, Node] = dict(zip(self.state, after, strict=False)) | moving
        self.memory: list[str] = self._find_memory()
        self.moving: dict[str, Node] = {name: node for name, node in moving.items() if name in self.memory}
        self.begun: dict[str, Node] = {
            name: node for name, node in zip(self.state, started, strict=True) if name in self.memory
        }
        self.stored: dict[str, Node] = {
            name: self.after[name] for name in self.memory if name in self.after and name not in moving
        }
        roots = [self.held, *(self.after[name] for name in self.memory if name in self.after), *self.begun.values()]
        live = {node.id for node in live_nodes(roots)}
        self.read: list[str] = [name for name, node in self.inputs.items() if node.id in live]
        self.used: list[str] = [name for name, node in self.numbers.items() if node.id in live]

    def _find_memory(self) -> list[str]:
        """Return the names of the memory that the commands depend on, from one sample to the next."""
        names = set(self.device.commands)
        while True:
            roots = [self.held, *(self.after[name] for name in names if name in self.after)]
            needed = {node.id for node in live_nodes(roots)}
            # A fixed point: memory that a command reads depends on further memory one sample earlier.
            more = {name for name, node in self.state.items() if node.id in needed} - names
            if not more:
                break
            names |= more
        return [name for name in self.state if name in names]


def name_memory(path: str) -> str:
    """Return a name for a number of the memory: the field names flow and held tell a reader nothing."""
    return path if path.startswith("command") else re.sub(r"\.(flow|held)(?=\.|$)", "", path)


def _holds_parts(where: str, after: object) -> bool:
    """Return whether a field holds parts by name, whose paths lack the field; `after` is the next key of a path."""
    return where == NUMBERS and isinstance(after, jax.tree_util.DictKey)


def number_leaves(shape: object, graph: Graph, where: str, flat: PyTree) -> dict[str, Node]:
    """Return an input node for each number in a pytree's leaves, by name.

    Args:
        where: Origin of the inputs, the first entry of a node's `attr`.
        flat: Function path -> name; a path such as measured.slip or gain.0. A number whose name another one has is
            called by its path.
    """
    nodes: dict[str, Node] = {}
    for path, leaf in jax.tree_util.tree_leaves_with_path(shape):
        keys = [key for key, after in zip(path, [*path[1:], None], strict=True) if not _holds_parts(where, after)]
        words = [str(getattr(key, "name", getattr(key, "key", getattr(key, "idx", key)))) for key in keys]
        for at in np.ndindex(leaf.shape):
            full = ".".join([*words, *map(str, at)])
            name = flat(full) if flat(full) not in nodes else full
            if name in nodes:
                raise NotExported(f"two numbers are called {name}: rename a field of one of their parts")
            nodes[name] = graph.input(leaf.dtype, UpdateLevel.UNIFORM, (where, name))
    return nodes


def fill_shapes(shape: object, nodes: dict[str, Node]) -> list[NodeArray]:
    """Return a pytree's leaves as arrays of nodes, filled in order.

    Args:
        nodes: Nodes in the order of the leaves' entries, one for each number.
    """
    remaining, arrays = iter(nodes.values()), []
    for leaf in jax.tree.leaves(shape):
        out = np.empty(leaf.shape, object)
        for at in np.ndindex(leaf.shape):
            out[at] = next(remaining)
        arrays.append(out)
    return arrays


def trace_outputs(
    graph: Labelled, function: Callable[..., PyTree], shape: object, inputs: list[NodeArray]
) -> list[Node]:
    """Return the results of a function as one list of nodes, leaf by leaf and entry by entry.

    Arrays that the function closes over become constants.
    """
    closed = jax.make_jaxpr(function)(shape)
    graph.labels = {id(eqn): source_label(eqn) for eqn in closed.jaxpr.eqns}
    constants = [constant_array(graph, np.asarray(x)) for x in closed.consts]
    return [node for array in lower_jaxpr(graph, closed.jaxpr, constants, inputs) for node in array.flat]
