"""A device as single operations on single numbers, for any language to write down.

They are made from the jaxprs of what the loop itself does, by the rules of package `kernel`, so no part needs a rule
for a language."""

import re
from typing import Any

import jax
import numpy as np

from diffabs.export.device import ComputerProgram
from diffabs.export.labels import Labelled, source_label
from diffabs.kernel.graph import Array, Graph, Node, UpdateLevel
from diffabs.kernel.primitives import constant_array, lower_jaxpr
from diffabs.kernel.program import RULE_MODULES, live_nodes

assert RULE_MODULES is not None  # registered where they are imported

MEMORY, INPUTS, NUMBERS = "s", "in", "p"  # where an input of the graph is, the first word of its `attr`


class Lowered:
    """A device whose memory, inputs and parameters are numbers with names. By name: `inputs`, `numbers` and `state`, as
    they come in; `begun`, the memory before the first sample; `after`, what a sample makes of it; `moving`, what it
    becomes by itself, `moves` times a sample, with the counter `place`; then the `command`, and whether it is `held`.
    What a command depends on, now or later, is `kept` of the memory, `read` of the inputs and `used` of the parameters.

    Raises Unsupported for an operation that has no rule."""

    def __init__(self, found: ComputerProgram):
        """Trace start, step and move."""
        self.device = found
        graph = Labelled()
        self.inputs = number_leaves(found.input, graph, INPUTS, lambda path: path.removeprefix("measured."))
        self.numbers = number_leaves(found.parts, graph, NUMBERS, lambda path: path.removeprefix("controller."))
        self.state = number_leaves(found.state, graph, MEMORY, _short_path)
        self.values = dict(zip(self.numbers, _numbers_of(found.parts), strict=True))
        given, parts = fill_shapes(found.input, self.inputs), fill_shapes(found.parts, self.numbers)
        started = trace_outputs(graph, lambda both: found.start(*both), (found.parts, found.input), [*parts, *given])
        held = fill_shapes(found.state, self.state)
        shapes = (found.parts, found.state, found.input)
        *after, self.held = trace_outputs(graph, lambda all: found.step(*all), shapes, [*parts, *held, *given])
        self.place = graph.input(np.int64, UpdateLevel.UNIFORM, ("", "i"))
        moved: list[Node] = []
        if found.moves:
            place, count = np.full((), self.place, object), jax.ShapeDtypeStruct((), np.int64)
            shapes = (found.parts, found.state, count)
            moved = trace_outputs(graph, lambda all: found.move(*all), shapes, [*parts, *held, place])
        moving = dict(zip([*self.state][len(after) :], moved, strict=bool(moved)))
        self.after = dict(zip(self.state, after, strict=False)) | moving
        self.command = self.after["command"]
        self.kept = self._kept()
        self.moving = {name: node for name, node in moving.items() if name in self.kept}
        self.begun = {name: node for name, node in zip(self.state, started, strict=True) if name in self.kept}
        self.stored = {name: self.after[name] for name in self.kept if name in self.after and name not in moving}
        roots = [self.held, *(self.after[name] for name in self.kept if name in self.after), *self.begun.values()]
        seen = {node.id for node in live_nodes(roots)}
        self.read = [name for name, node in self.inputs.items() if node.id in seen]
        self.used = [name for name, node in self.numbers.items() if node.id in seen]

    def _kept(self) -> list[str]:
        """What of memory the command depends on, from one sample to the next."""
        kept = {"command"}
        roots = [self.command, self.held]
        while True:
            needed = {node.id for node in live_nodes(roots)}
            more = {name for name, node in self.state.items() if node.id in needed} - kept
            if not more:
                break
            kept |= more
            roots = [self.command, self.held, *(self.after[name] for name in kept if name in self.after)]
        return [name for name in self.state if name in kept]


def number_leaves(shape: Any, graph: Graph, where: str, flat: Any) -> dict[str, Node]:
    """Return a number for each entry of a pytree of shapes, by its path."""
    found: dict[str, Node] = {}
    for path, leaf in jax.tree_util.tree_leaves_with_path(shape):
        words = [str(getattr(key, "name", getattr(key, "key", getattr(key, "idx", key)))) for key in path]
        for at in np.ndindex(leaf.shape):
            name = flat(".".join([*words, *map(str, at)]))
            found[name] = graph.input(leaf.dtype, UpdateLevel.UNIFORM, (where, name))
    return found


def fill_shapes(shape: Any, nodes: dict[str, Node]) -> list[Array]:
    """Return the numbers as arrays of the shapes of a pytree's leaves."""
    left, arrays = iter(nodes.values()), []
    for leaf in jax.tree.leaves(shape):
        out = np.empty(leaf.shape, object)
        for at in np.ndindex(leaf.shape):
            out[at] = next(left)
        arrays.append(out)
    return arrays


def trace_outputs(graph: Labelled, function: Any, shape: Any, inputs: list[Array]) -> list[Node]:
    """Return what a function returns, number by number; what it closes over is known."""
    closed = jax.make_jaxpr(function)(shape)
    graph.labels = {id(eqn): source_label(eqn) for eqn in closed.jaxpr.eqns}
    constants = [constant_array(graph, np.asarray(x)) for x in closed.consts]
    return [node for array in lower_jaxpr(graph, closed.jaxpr, constants, inputs) for node in array.flat]


def _numbers_of(parts: Any) -> list[float]:
    """The numbers of parts, one by one, in the order of `named`."""
    return [float(x) for leaf in jax.tree.leaves(parts) for x in np.asarray(leaf, float).flat]


def _short_path(path: str) -> str:
    """A path in the memory without what says nothing to a reader."""
    return re.sub(r"\.(flow|held)(?=\.|$)", "", path)
