"""A device as single operations on single numbers, for any language to write down.

They are made from the jaxprs of what the loop itself does, by the rules of package `kernel`, so no part needs a rule
for a language."""

import re
from typing import Any

import jax
import numpy as np

from diffabs.export.device import Device
from diffabs.kernel.graph import Array, Graph, Level, Node
from diffabs.kernel.primitives import known, translate
from diffabs.kernel.program import RULES, live

assert RULES is not None  # registered where they are imported

MEMORY, INPUTS = "s", "in"  # where an input of the graph is, the first word of its `attr`


class Lowered:
    """A device whose memory and inputs are numbers with names. By name: `inputs` and `state`, as they come in; `begun`,
    the memory before the first sample; `after`, what a sample makes of it; `moving`, what it becomes by itself, `moves`
    times a sample, with the counter `place`; then the `command`. What a command depends on, now or later, is `kept` of
    the memory and `read` of the inputs.

    Raises Unsupported for an operation that has no rule."""

    def __init__(self, found: Device):
        """Trace start, step and move."""
        self.device = found
        graph = Graph()
        self.inputs = named(found.input, graph, INPUTS, lambda path: path.removeprefix("measured."))
        self.state = named(found.state, graph, MEMORY, _flat)
        given = filled(found.input, self.inputs)
        started = outputs(graph, found.start, found.input, given)
        held, both = filled(found.state, self.state), (found.state, found.input)
        *after, self.command = outputs(graph, lambda both: found.step(*both), both, [*held, *given])
        self.place = graph.input(np.int64, Level.UNIFORM, ("", "i"))
        moved: list[Node] = []
        if found.moves:
            place, count = np.full((), self.place, object), jax.ShapeDtypeStruct((), np.int64)
            moved = outputs(graph, lambda both: found.move(*both), (found.state, count), [*held, place])
        moving = dict(zip([*self.state][len(after) :], moved, strict=bool(moved)))
        self.after = dict(zip(self.state, after, strict=False)) | moving
        self.kept = self._kept()
        self.moving = {name: node for name, node in moving.items() if name in self.kept}
        self.begun = {name: node for name, node in zip(self.state, started, strict=True) if name in self.kept}
        self.stored = {name: self.after[name] for name in self.kept if name in self.after and name not in moving}
        roots = [self.command, *(self.after[name] for name in self.kept if name in self.after), *self.begun.values()]
        seen = {node.id for node in live(roots)}
        self.read = [name for name, node in self.inputs.items() if node.id in seen]
        self.memory = {self.state[name].id: name for name in self.kept}

    def _kept(self) -> list[str]:
        """What of memory the command depends on, from one sample to the next."""
        kept: set[str] = set()
        roots = [self.command]
        while True:
            needed = {node.id for node in live(roots)}
            more = {name for name, node in self.state.items() if node.id in needed} - kept
            if not more:
                break
            kept |= more
            roots = [self.command, *(self.after[name] for name in kept if name in self.after)]
        return [name for name in self.state if name in kept]


def named(shape: Any, graph: Graph, where: str, flat: Any) -> dict[str, Node]:
    """Return a number for each entry of a pytree of shapes, by its path."""
    found: dict[str, Node] = {}
    for path, leaf in jax.tree_util.tree_leaves_with_path(shape):
        words = [str(getattr(key, "name", getattr(key, "key", getattr(key, "idx", key)))) for key in path]
        for at in np.ndindex(leaf.shape):
            name = flat(".".join([*words, *map(str, at)]))
            found[name] = graph.input(leaf.dtype, Level.UNIFORM, (where, name))
    return found


def filled(shape: Any, nodes: dict[str, Node]) -> list[Array]:
    """Return the numbers as arrays of the shapes of a pytree's leaves."""
    left, arrays = iter(nodes.values()), []
    for leaf in jax.tree.leaves(shape):
        out = np.empty(leaf.shape, object)
        for at in np.ndindex(leaf.shape):
            out[at] = next(left)
        arrays.append(out)
    return arrays


def outputs(graph: Graph, function: Any, shape: Any, inputs: list[Array]) -> list[Node]:
    """Return what a function returns, number by number; what it closes over is known."""
    closed = jax.make_jaxpr(function)(shape)
    constants = [known(graph, np.asarray(x)) for x in closed.consts]
    return [node for array in translate(graph, closed.jaxpr, constants, inputs) for node in array.flat]


def _flat(path: str) -> str:
    """A path in the memory without what says nothing to a reader."""
    return re.sub(r"\.(flow|held)(?=\.|$)", "", path)
