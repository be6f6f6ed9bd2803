"""The step from a program with one tangent to a program with several: values stay single, tangents are repeated."""

from collections.abc import Iterable

import numpy as np

from diffabs.compiler.autodiff.eliminate import Elimination
from diffabs.compiler.autodiff.linear import Sum, Vertex
from diffabs.compiler.ir import Graph, Node, live_nodes


def dependents(nodes: Iterable[Node], first: set[int]) -> set[int]:
    """Return the ids in `first`, and the ids of all nodes that depend on them.

    Args:
        nodes: Nodes, operands first.
        first: Ids to start from.
    """
    found = set(first)
    found.update(node.id for node in nodes if any(x.id in found for x in node.args))
    return found


def tangent_copy(nodes: list[Node], k: int) -> Node:
    """Return the node of a number in tangent direction k, or its only node if it is the same in all directions.

    Args:
        nodes: One node, or one for each tangent direction.
        k: Index of the direction.
    """
    return nodes[k if len(nodes) > 1 else 0]


def replicate_nodes(
    graph: Graph,
    roots: list[Node],
    given: dict[int, list[Node]],
    slopes: set[int],
    size: tuple[int, np.dtype],
) -> dict[int, list[Node]]:
    """Return, for each node id that the roots need, its nodes in a program of several tangent directions.

    A value has one node, a nonzero tangent one for each direction, a zero tangent the constant 0. A node that the
    elimination has removed has no entry.

    Args:
        graph: Graph that receives the nodes.
        roots: Results of the program of one tangent.
        given: Inputs of the new program by node id of the old one.
        slopes: Ids of the inputs that are tangents; a tangent without an entry in `given` is zero.
        size: Number of the tangent directions, and the type of the tangents.
    """
    nodes = live_nodes(roots)
    moving = dependents(nodes, {i for i in slopes if i in given})
    # Nodes that depend only on tangents without a seed are in `slopes` but not in `moving`: they are zero.
    slopes = dependents(nodes, slopes)
    factors = Graph()
    # Everything but nonzero tangents becomes a node of the factor graph; every result of zero tangents is 0.
    values: dict[int, Node] = {}
    for node in nodes:
        if node.id in moving:
            continue
        if node.id in slopes:
            values[node.id] = factors.const(0, node.dtype)
        elif node.op == "input":
            (one,) = given[node.id]
            values[node.id] = factors.input(one.dtype, one.level, one.attr)
        else:
            values[node.id] = factors.again(node, [values[x.id] for x in node.args])
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


class _ReplicaWriter:
    """A writer of an eliminated program as nodes: values in their order, tangents after their operands."""

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
        """Return a number of the factor graph as a node of the new program."""
        # A stack instead of recursion: a chain of operations may be longer than Python's limit.
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
        """Return a sum for each tangent; terms with the factor 1 and positive terms come first."""
        if not sum:
            return [self.graph.const(0, node.dtype)]
        # The first term needs no addition. A positive one saves the negation.
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
