"""Vertex elimination: the tangents that a program computes, chosen for few operations.

A chain of linear operations on a tangent equals one product with the product of the factors. This product is the same
in all tangent directions. A vertex is eliminated if all directions together then need no more operations than before.
The search is greedy: it need not find the fewest operations.
"""

from collections.abc import Callable, Iterable

import numpy as np

from diffabs.compiler.autodiff.linear import FACTOR_ONE, Algebra, Factor, Sum, Vertex, changes_in_step, sum_cost
from diffabs.compiler.ir import Graph, Node, UpdateLevel


class Elimination:
    """The linear graph of one tangent direction of a program, reduced for several directions.

    Attributes:
        graph: Graph of the factors.
        many: Number of tangent directions.
        algebra: Operations on sums of tangents.
        vertices: Tangents to compute, by the id of their node; without those that are inputs.
        readers: For each tangent, inputs included, the ids of the vertices that read it.
        required: Ids of the tangents that must remain: nonlinear operations read them, or they are results.
        levels: For each tangent, inputs included, how often its value changes.
        any_factor: Placeholder in counts of operations, for a factor whose value does not matter.
    """

    def __init__(self, graph: Graph, many: int, dtype: np.dtype):
        """Create an empty linear graph."""
        self.graph = graph
        self.many = many
        self.algebra: Algebra = Algebra(graph, dtype)
        self.vertices: dict[int, Vertex] = {}
        self.readers: dict[int, set[int]] = {}
        self.required: set[int] = set()
        self.levels: dict[int, UpdateLevel] = {}
        self.any_factor: Node = graph.input(dtype, UpdateLevel.STEP, "any factor")

    def add_input(self, node: int, level: UpdateLevel) -> None:
        """Add a tangent that is an input: `node` is its id, `level` tells how often its value changes."""
        self.levels[node] = level
        self.readers[node] = set()

    def add_operation(self, node: Node, moves: Callable[[Node], bool], value: Callable[[Node], Node]) -> None:
        """Add the tangent that an operation computes; its operands must be there already.

        `moves` says whether a tangent can be nonzero; `value` gives the factor graph's node of any other node.
        """
        new = self.vertices[node.id] = self.algebra.vertex(node, moves, value)
        self.readers[node.id] = set()
        reads = {x for sum in new.sums() for x in sum} | set(new.reads)
        self.required.update(new.reads)
        for x in reads:
            self.readers[x].add(node.id)
        factors = [f.number.level for sum in new.sums() for f in sum.values() if f.number is not None]
        factors += [new.condition.level] if new.condition is not None else []
        self.levels[node.id] = max([UpdateLevel.UNIFORM, *factors, *(self.levels[x] for x in reads)])
        # A nonlinear operation also changes as often as its operands that are no tangents.
        if new.reads and any(not moves(x) for x in node.args):
            self.levels[node.id] = max([self.levels[node.id], *(value(x).level for x in node.args if not moves(x))])

    # costs ------------------------------------------------------------------------------------------------------------

    def _cost(self, vertex: Vertex) -> int:
        """Return the number of operations of a vertex in all directions.

        A selection selects between tangents or between factors, whichever is cheaper and possible.
        """
        cost = self.many * (sum(map(sum_cost, vertex.sums())) + (vertex.condition is not None))
        return min(cost, self._factor_selection_cost(vertex)) if self._can_select_factors(vertex) else cost

    def _can_select_factors(self, vertex: Vertex) -> bool:
        """Return whether a vertex is a selection that may select between factors instead of tangents.

        The factor 0 does not remove a NaN or infinity in the branch not taken. So a tangent in one branch only must be
        an input that is constant over the steps. Other tangents may diverge within a step.
        """
        once = set(vertex.sum) ^ set(vertex.true_sum)
        return vertex.condition is not None and all(
            x not in self.vertices and self.levels[x] < UpdateLevel.STEP for x in once
        )

    def _factor_selection_cost(self, vertex: Vertex) -> int:
        """Return the number of operations of a selection in all directions if it selects between factors."""
        keys = set(vertex.sum) | set(vertex.true_sum)
        selected = [x for x in keys if vertex.sum.get(x) != vertex.true_sum.get(x)]
        # One term with the factor 1 starts the sum and needs no operation.
        units = any(x not in selected and vertex.sum[x].number is None for x in keys)
        return self.many * (len(keys) - units) + len(selected)

    def _saving_without(self, key: int, inner: Sum) -> int:
        """Return the operations saved, less those on new factors, if the readers of a vertex use its sum `inner`
        instead.
        """
        spared = self.many * sum_cost(inner)
        for reader in self.readers[key]:
            old = self.vertices[reader]
            new, more = [], 0
            for outer in old.sums():
                merged, products = self._substituted_sum(outer, key, inner) if key in outer else (outer, 0)
                new.append(merged)
                more += products
            spared += self._cost(old) - self._cost(Vertex(new[0], old.condition, *new[1:])) - more
        return spared

    def _substituted_sum(self, outer: Sum, key: int, inner: Sum) -> tuple[Sum, int]:
        """Return `outer` with `inner` in place of the tangent `key`, and the number of extra operations on factors.

        New factors of the result are placeholders: only their number matters here.
        """
        factor, more = outer[key], 0
        merged = {x: term for x, term in outer.items() if x != key}
        for x, term in inner.items():
            many = sum(map(changes_in_step, (factor, term)))
            if x in merged:
                more += many > 0 or changes_in_step(merged[x])
                merged[x] = Factor(False, self.any_factor)
            else:
                more += many == 2
                merged[x] = (
                    term if factor.number is None else factor if term.number is None else Factor(False, self.any_factor)
                )
        return merged, more

    # elimination ------------------------------------------------------------------------------------------------------

    def reduce(self, roots: Iterable[int]) -> None:
        """Eliminate each vertex that changes with each step, if this does not raise the number of operations.

        The results, whose ids are `roots`, and all tangents in `required` remain.
        """
        self.required.update(roots)
        # An elimination changes the costs of its neighbours, so passes repeat until one removes nothing.
        shrinking = True
        while shrinking:
            before = len(self.vertices)
            # From the results back: an eliminated vertex passes its sum to readers that are already reduced.
            for key in sorted(self.vertices, reverse=True):
                self._try_to_eliminate(key)
            shrinking = len(self.vertices) < before

    def _try_to_eliminate(self, key: int) -> None:
        """Eliminate a vertex or turn its selection into a sum, if this does not raise the number of operations."""
        vertex = self.vertices[key]
        # Nonlinear operations stay. Work outside the steps is not worth a reduction.
        if vertex.reads or self.levels[key] < UpdateLevel.STEP:
            return
        if not self.readers[key] and key not in self.required:
            self._replace_by_sum(key, {})
            self._eliminate(key)
            return
        if key not in self.required and self._merge_selection(key):
            return
        new_sum, before = vertex.sum, self._cost(vertex)
        if vertex.condition is not None:
            if not self._can_select_factors(vertex):
                return
            new_sum = self.algebra.select_factors(vertex)
        spared = before - (self._factor_selection_cost(vertex) if vertex.condition is not None else before)
        if key not in self.required and spared + self._saving_without(key, new_sum) >= 0:
            self._replace_by_sum(key, new_sum)
            self._eliminate(key)
        elif vertex.condition is not None and spared >= 0:
            self._replace_by_sum(key, new_sum)

    def _merge_selection(self, key: int) -> bool:
        """Merge a selection between one tangent and 0 into its readers, and return whether that was possible.

        All readers must be selections between that tangent, this vertex and 0.
        """
        vertex = self.vertices[key]
        tangent_sum = vertex.sum or vertex.true_sum
        if vertex.condition is None or len(tangent_sum) != 1 or (vertex.sum and vertex.true_sum):
            return False
        whole = {key: FACTOR_ONE}
        readers = [self.vertices[reader] for reader in self.readers[key]]
        if any(
            r.condition is None or any(side and side not in (tangent_sum, whole) for side in r.sums()) for r in readers
        ):
            return False
        # A reader then is this tangent or 0, so one condition, made of both selections, is enough for it.
        sides = (self.graph.const(bool(side)) for side in vertex.sums())
        active = self.graph.select(vertex.condition, *sides)
        for reader in readers:
            assert reader.condition is not None
            on = (active if side == whole else self.graph.const(bool(side)) for side in reader.sums())
            reader.condition, reader.sum, reader.true_sum = self.graph.select(reader.condition, *on), {}, tangent_sum
        (x,) = tangent_sum
        self.readers[x] |= self.readers.pop(key)
        self.readers[x].discard(key)
        del self.vertices[key]
        return True

    def _replace_by_sum(self, key: int, new_sum: Sum) -> None:
        """Make a vertex the sum `new_sum`, and remove it from the readers of operands that it no longer has."""
        old = self.vertices[key]
        self.vertices[key] = Vertex(new_sum)
        for x in {x for sum in old.sums() for x in sum} - set(new_sum):
            self.readers[x].discard(key)

    def _eliminate(self, key: int) -> None:
        """Remove a vertex that is a sum: substitute it into each reader."""
        inner = self.vertices[key]
        for reader in self.readers.pop(key):
            vertex = self.vertices[reader]
            if key in vertex.sum:
                vertex.sum = self.algebra.substitute(vertex.sum, key, inner.sum)
            if key in vertex.true_sum:
                vertex.true_sum = self.algebra.substitute(vertex.true_sum, key, inner.sum)
            # Terms may cancel in the merged sum, so operands are added to or removed from the reader lists.
            now = {x for sum in vertex.sums() for x in sum}
            for x in inner.sum:
                (self.readers[x].add if x in now else self.readers[x].discard)(reader)
        del self.vertices[key]
        for x in inner.sum:
            self.readers[x].discard(key)
