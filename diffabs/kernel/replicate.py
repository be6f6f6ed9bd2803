"""The program of several tangents of one of one tangent: what does not move as it is, of each tangent so many."""

from collections.abc import Iterable

import numpy as np

from diffabs.kernel.elimination import Elimination
from diffabs.kernel.graph import Graph, Node
from diffabs.kernel.linear import Sum, Vertex
from diffabs.kernel.program import live_nodes


def dependents(nodes: Iterable[Node], first: set[int]) -> set[int]:
    """Return what is made of these, themselves included; nodes with arguments first."""
    found = set(first)
    found.update(node.id for node in nodes if any(x.id in found for x in node.args))
    return found


def tangent_copy(nodes: list[Node], k: int) -> Node:
    """Return the k-th of so many, or of all of them the one that there is."""
    return nodes[k if len(nodes) > 1 else 0]


def replicate_nodes(
    graph: Graph,
    roots: list[Node],
    given: dict[int, list[Node]],
    slopes: set[int],
    size: tuple[int, np.dtype],
) -> dict[int, list[Node]]:
    """Return what becomes of each node of a program of one tangent that these need: itself, some tangents, or zero.

    given: inputs, of this graph; slopes: the inputs that are tangents, of which those that are not given are zero
    size: how many tangents, of what type"""
    nodes = live_nodes(roots)
    moving = dependents(nodes, {i for i in slopes if i in given})
    slopes = dependents(nodes, slopes)
    factors = Graph()
    values = _values(factors, nodes, given, slopes, moving)
    plan = Elimination(factors, *size)
    for node in nodes:
        if node.id not in moving:
            continue
        if node.op == "input":
            plan.begin(node.id, given[node.id][0].level)
        else:
            plan.add(node, lambda x: x.id in moving, lambda x: values[x.id])
    plan.reduce({node.id for node in roots if node.id in plan.vertices})
    return _ReplicaWriter(graph, plan, values, given).write(nodes)


def _values(
    graph: Graph, nodes: list[Node], given: dict[int, list[Node]], slopes: set[int], moving: set[int]
) -> dict[int, Node]:
    """What does not move, by node; what would follow from tangents that are zero is zero."""
    found: dict[int, Node] = {}
    for node in nodes:
        if node.id in moving:
            continue
        if node.id in slopes:
            found[node.id] = graph.const(0, node.dtype)
        elif node.op == "input":
            (one,) = given[node.id]
            found[node.id] = graph.input(one.dtype, one.level, one.attr)
        else:
            found[node.id] = graph.again(node, [found[x.id] for x in node.args])
    return found


class _ReplicaWriter:
    """A plan as nodes of a program: numbers in their order, tangents behind those that they are made of."""

    def __init__(self, graph: Graph, plan: Elimination, values: dict[int, Node], given: dict[int, list[Node]]):
        self.graph, self.plan, self.values = graph, plan, values
        self.numbers: dict[int, Node] = {}
        self.tangents = {i: nodes for i, nodes in given.items() if i in plan.readers}

    def write(self, nodes: list[Node]) -> dict[int, list[Node]]:
        found: dict[int, list[Node]] = {}
        for node in nodes:
            if node.id in self.values:
                found[node.id] = [self._number(self.values[node.id])]
            elif node.id in self.plan.vertices:
                self.tangents[node.id] = self._vertex(node, self.plan.vertices[node.id])
        return found | self.tangents

    def _number(self, node: Node) -> Node:
        """A number of the plan in this program."""
        left = [node]
        while left:
            one = left[-1]
            lacking = [x for x in one.args if x.id not in self.numbers]
            left += lacking
            if not lacking:
                left.pop()
                args = [self.numbers[x.id] for x in one.args]
                same = one.op == "input"
                self.numbers[one.id] = (
                    self.graph.input(one.dtype, one.level, one.attr) if same else self.graph.again(one, args)
                )
        return self.numbers[node.id]

    def _vertex(self, node: Node, vertex: Vertex) -> list[Node]:
        if vertex.reads:
            args = [
                self.tangents[x.id] if x.id in self.tangents else [self._number(self.values[x.id])] for x in node.args
            ]
            return [self.graph.again(node, [tangent_copy(x, k) for x in args]) for k in range(self.plan.many)]
        sums = [self._sum(sum, node) for sum in vertex.sums()]
        if vertex.which is None:
            return sums[0]
        which = self._number(vertex.which)
        return [self.graph.select(which, *(tangent_copy(x, k) for x in sums)) for k in range(self.plan.many)]

    def _sum(self, sum: Sum, node: Node) -> list[Node]:
        if not sum:
            return [self.graph.const(0, node.dtype)]
        ordered = sorted(sum, key=lambda x: (sum[x].number is not None, sum[x].negative))
        found: list[Node] = []
        for i, x in enumerate(ordered):
            factor, slopes = sum[x], self.tangents[x]
            number = None if factor.number is None else self._number(factor.number)
            terms = [slope if number is None else self.graph.op("mul", slope, number) for slope in slopes]
            if not i:
                found = [self.graph.op("neg", term) for term in terms] if factor.negative else terms
            else:
                name = "sub" if factor.negative else "add"
                found = [
                    self.graph.op(name, tangent_copy(found, k), tangent_copy(terms, k)) for k in range(self.plan.many)
                ]
        return found
