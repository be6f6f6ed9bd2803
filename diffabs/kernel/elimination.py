"""Which tangents are worked out: those with which the rest are the fewest operations.

A chain of operations on a tangent is one product with the product of its factors, the same for all tangents. So
vertices are eliminated from the graph of one tangent wherever so many tangents cost less without them."""

from collections.abc import Callable, Iterable

import numpy as np

from diffabs.kernel.graph import Graph, Node, UpdateLevel
from diffabs.kernel.linear import UNIT_FACTOR, Algebra, Factor, Sum, Vertex, changes_in_step, count_terms


class Elimination:
    """The tangents of a program, made fewer."""

    def __init__(self, graph: Graph, many: int, dtype: np.dtype):
        """For so many tangents of each number; factors are nodes of this graph."""
        self.graph, self.many, self.algebra = graph, many, Algebra(graph, dtype)
        self.vertices: dict[int, Vertex] = {}
        self.readers: dict[int, set[int]] = {}
        self.kept: set[int] = set()  # as they are read by name
        self.levels: dict[int, UpdateLevel] = {}
        self.any_factor = graph.input(dtype, UpdateLevel.STEP, "any factor")

    def begin(self, node: int, level: UpdateLevel) -> None:
        """Add a tangent that is given."""
        self.levels[node] = level
        self.readers[node] = set()

    def add(self, node: Node, moves: Callable[[Node], bool], value: Callable[[Node], Node]) -> None:
        """Add an operation on tangents; `value`: what a number is that is none."""
        new = self.vertices[node.id] = self.algebra.vertex(node, moves, value)
        self.readers[node.id] = set()
        reads = {x for sum in new.sums() for x in sum} | set(new.reads)
        self.kept.update(new.reads)
        for x in reads:
            self.readers[x].add(node.id)
        factors = [f.number.level for sum in new.sums() for f in sum.values() if f.number is not None]
        factors += [new.which.level] if new.which is not None else []
        self.levels[node.id] = max([UpdateLevel.UNIFORM, *factors, *(self.levels[x] for x in reads)])
        if new.reads and any(not moves(x) for x in node.args):
            self.levels[node.id] = max([self.levels[node.id], *(value(x).level for x in node.args if not moves(x))])

    # costs ------------------------------------------------------------------------------------------------------------

    def _cost(self, vertex: Vertex) -> int:
        """Operations for all tangents, as it is or with a choice of factors."""
        cost = self.many * (sum(map(count_terms, vertex.sums())) + (vertex.which is not None))
        return min(cost, self._factor_choice_cost(vertex)) if self._can_choose_factors(vertex) else cost

    def _can_choose_factors(self, vertex: Vertex) -> bool:
        """Whether factors may be chosen in place of tangents. A tangent that is not chosen, and no number, must not
        matter: 0 times it would. Only what is given to the steps is a number for certain: a try may lead anywhere."""
        once = set(vertex.sum) ^ set(vertex.others)
        return vertex.which is not None and all(
            x not in self.vertices and self.levels[x] < UpdateLevel.STEP for x in once
        )

    def _factor_choice_cost(self, vertex: Vertex) -> int:
        keys = set(vertex.sum) | set(vertex.others)
        chosen = [x for x in keys if vertex.sum.get(x) != vertex.others.get(x)]
        units = any(x not in chosen and vertex.sum[x].number is None for x in keys)
        return self.many * (len(keys) - units) + len(chosen)

    def _saving_without(self, key: int, inner: Sum) -> int:
        """How many operations are spared without a vertex that is this sum."""
        spared = self.many * count_terms(inner)
        for reader in self.readers[key]:
            old = self.vertices[reader]
            new, more = [], 0
            for outer in old.sums():
                merged, products = self._substituted_sum(outer, key, inner) if key in outer else (outer, 0)
                new.append(merged)
                more += products
            spared += self._cost(old) - self._cost(Vertex(new[0], old.which, *new[1:])) - more
        return spared

    def _substituted_sum(self, outer: Sum, key: int, inner: Sum) -> tuple[Sum, int]:
        """A sum with another one in the place of a vertex, whose factors are not worked out; operations on these."""
        factor, more = outer[key], 0
        found = {x: one for x, one in outer.items() if x != key}
        for x, one in inner.items():
            many = sum(map(changes_in_step, (factor, one)))
            if x in found:
                more += many > 0 or changes_in_step(found[x])
                found[x] = Factor(False, self.any_factor)
            else:
                more += many == 2
                found[x] = (
                    one if factor.number is None else factor if one.number is None else Factor(False, self.any_factor)
                )
        return found, more

    # which are eliminated ---------------------------------------------------------------------------------------------

    def reduce(self, roots: Iterable[int]) -> None:
        """Eliminate what costs more than it spares."""
        self.kept.update(roots)
        left = True
        while left:
            before = len(self.vertices)
            for key in sorted(self.vertices, reverse=True):
                self._try(key)
            left = len(self.vertices) < before

    def _try(self, key: int) -> None:
        vertex = self.vertices[key]
        if vertex.reads or self.levels[key] < UpdateLevel.STEP:
            return
        if not self.readers[key] and key not in self.kept:
            self._replace_by_sum(key, {})
            self._eliminate(key)
            return
        if key not in self.kept and self._join_choices(key):
            return
        decided, before = vertex.sum, self._cost(vertex)
        if vertex.which is not None:
            if not self._can_choose_factors(vertex):
                return
            decided = self.algebra.decided(vertex)
        spared = before - (self._factor_choice_cost(vertex) if vertex.which is not None else before)
        if key not in self.kept and spared + self._saving_without(key, decided) >= 0:
            self._replace_by_sum(key, decided)
            self._eliminate(key)
        elif vertex.which is not None and spared >= 0:
            self._replace_by_sum(key, decided)

    def _join_choices(self, key: int) -> bool:
        """Whether a choice of one thing or nothing was made one with those by which alone it is read."""
        vertex = self.vertices[key]
        one = vertex.sum or vertex.others
        if vertex.which is None or len(one) != 1 or (vertex.sum and vertex.others):
            return False
        whole = {key: UNIT_FACTOR}
        readers = [self.vertices[reader] for reader in self.readers[key]]
        if any(r.which is None or any(side and side not in (one, whole) for side in r.sums()) for r in readers):
            return False
        sides = (self.graph.const(bool(side)) for side in vertex.sums())
        taken = self.graph.select(vertex.which, *sides)
        for reader in readers:
            assert reader.which is not None
            on = (taken if side == whole else self.graph.const(bool(side)) for side in reader.sums())
            reader.which, reader.sum, reader.others = self.graph.select(reader.which, *on), {}, one
        (x,) = one
        self.readers[x] |= self.readers.pop(key)
        self.readers[x].discard(key)
        del self.vertices[key]
        return True

    def _replace_by_sum(self, key: int, decided: Sum) -> None:
        old = self.vertices[key]
        self.vertices[key] = Vertex(decided)
        for x in {x for sum in old.sums() for x in sum} - set(decided):
            self.readers[x].discard(key)

    def _eliminate(self, key: int) -> None:
        inner = self.vertices[key]
        for reader in self.readers.pop(key):
            vertex = self.vertices[reader]
            if key in vertex.sum:
                vertex.sum = self.algebra.within(vertex.sum, key, inner.sum)
            if key in vertex.others:
                vertex.others = self.algebra.within(vertex.others, key, inner.sum)
            now = {x for sum in vertex.sums() for x in sum}
            for x in inner.sum:
                (self.readers[x].add if x in now else self.readers[x].discard)(reader)
        del self.vertices[key]
        for x in inner.sum:
            self.readers[x].discard(key)
