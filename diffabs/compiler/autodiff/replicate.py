"""From one tangent direction to several: values and factors stay single, eliminated tangents are repeated."""

from collections.abc import Iterable

import numpy as np

from diffabs.compiler.autodiff.eliminate import Elimination
from diffabs.compiler.autodiff.linear import Sum, Vertex
from diffabs.compiler.ir import Graph, Node, live_nodes


def dependents(nodes: Iterable[Node], first: set[int]) -> set[int]:
    """Return the ids in `first`, and the ids of all nodes that depend on them; `nodes` come operands first."""
    reached = set(first)
    reached.update(node.id for node in nodes if any(x.id in reached for x in node.args))
    return reached


def tangent_copy(nodes: list[Node], k: int) -> Node:
    """Return the node for tangent direction k, or the only node of a number that is the same in all directions."""
    return nodes[k if len(nodes) > 1 else 0]


def replicate_nodes(
    graph: Graph,
    roots: list[Node],
    inputs: dict[int, list[Node]],
    slopes: set[int],
    size: tuple[int, np.dtype],
) -> dict[int, list[Node]]:
    """Write a program of several tangent directions; return its nodes by the id of the old node.

    A value has one node, a tangent that can be nonzero one for each direction, and a zero tangent the constant 0. A
    tangent that the elimination has removed has no entry.

    Args:
        inputs: Inputs of the new program, by the id of the old input.
        slopes: Ids of the old inputs that are tangents; one without an entry in `inputs` is zero.
    """
    nodes = live_nodes(roots)
    moving = dependents(nodes, {i for i in slopes if i in inputs})
    # A node that depends on tangents, but only on zero ones, is in `slopes` and not in `moving`: it is zero.
    slopes = dependents(nodes, slopes)
    factors = Graph()
    # All nodes outside of `moving` become nodes of the factor graph, zero tangents as the constant 0.
    values: dict[int, Node] = {}
    for node in nodes:
        if node.id in moving:
            continue
        if node.id in slopes:
            values[node.id] = factors.const(0, node.dtype)
        elif node.op == "input":
            (new_input,) = inputs[node.id]
            values[node.id] = factors.input(new_input.dtype, new_input.level, new_input.attr)
        else:
            values[node.id] = factors.again(node, [values[x.id] for x in node.args])
    plan = Elimination(factors, *size)
    for node in nodes:
        if node.id not in moving:
            continue
        if node.op == "input":
            plan.add_input(node.id, inputs[node.id][0].level)
        else:
            plan.add_operation(node, lambda x: x.id in moving, lambda x: values[x.id])
    plan.reduce({node.id for node in roots if node.id in plan.vertices})
    return _ReplicaWriter(graph, plan, values, inputs).write(nodes)


class _ReplicaWriter:
    """A writer of an eliminated program as nodes of a new graph.

    Attributes:
        graph: New graph.
        plan: Tangents to compute.
        values: Nodes of the factor graph, by the id of the old node.
        numbers: Nodes of the new graph, by the id of the node of the factor graph.
        tangents: Nodes of the new graph for each direction, by the id of the old node.
    """

    def __init__(self, graph: Graph, plan: Elimination, values: dict[int, Node], inputs: dict[int, list[Node]]):
        self.graph, self.plan, self.values = graph, plan, values
        self.numbers: dict[int, Node] = {}
        self.tangents = {i: nodes for i, nodes in inputs.items() if i in plan.readers}

    def write(self, nodes: list[Node]) -> dict[int, list[Node]]:
        """Write the values and tangents of the old `nodes`; return their new nodes by the id of the old node."""
        new_nodes: dict[int, list[Node]] = {}
        for node in nodes:
            if node.id in self.values:
                new_nodes[node.id] = [self._write_value(self.values[node.id])]
            elif node.id in self.plan.vertices:
                self.tangents[node.id] = self._write_tangent(node, self.plan.vertices[node.id])
        return new_nodes | self.tangents

    def _write_value(self, node: Node) -> Node:
        """Write a node of the factor graph and its operands; return its node of the new graph."""
        # A stack instead of recursion: a chain of operations may be longer than Python's limit.
        stack = [node]
        while stack:
            top = stack[-1]
            lacking = [x for x in top.args if x.id not in self.numbers]
            stack += lacking
            if not lacking:
                stack.pop()
                args = [self.numbers[x.id] for x in top.args]
                is_input = top.op == "input"
                self.numbers[top.id] = (
                    self.graph.input(top.dtype, top.level, top.attr) if is_input else self.graph.again(top, args)
                )
        return self.numbers[node.id]

    def _write_tangent(self, node: Node, vertex: Vertex) -> list[Node]:
        """Write the tangent `vertex`, whose old node is `node`; return a node for each direction, or one constant 0."""
        if vertex.reads:
            args = [
                self.tangents[x.id] if x.id in self.tangents else [self._write_value(self.values[x.id])]
                for x in node.args
            ]
            return [self.graph.again(node, [tangent_copy(x, k) for x in args]) for k in range(self.plan.many)]
        sums = [self._write_sum(sum, node) for sum in vertex.sums()]
        if vertex.condition is None:
            return sums[0]
        condition = self._write_value(vertex.condition)
        return [self.graph.select(condition, *(tangent_copy(x, k) for x in sums)) for k in range(self.plan.many)]

    def _write_sum(self, sum: Sum, node: Node) -> list[Node]:
        """Write a sum; return a node for each direction, or one constant 0.

        Terms with the factor 1 and positive terms come first.
        """
        if not sum:
            return [self.graph.const(0, node.dtype)]
        # The first term needs no addition. A positive one saves the negation.
        ordered = sorted(sum, key=lambda x: (sum[x].number is not None, sum[x].negative))
        total: list[Node] = []
        for i, x in enumerate(ordered):
            factor, slopes = sum[x], self.tangents[x]
            number = None if factor.number is None else self._write_value(factor.number)
            terms = [slope if number is None else self.graph.op("mul", slope, number) for slope in slopes]
            if not i:
                total = [self.graph.op("neg", term) for term in terms] if factor.negative else terms
            else:
                name = "sub" if factor.negative else "add"
                total = [
                    self.graph.op(name, tangent_copy(total, k), tangent_copy(terms, k)) for k in range(self.plan.many)
                ]
        return total
