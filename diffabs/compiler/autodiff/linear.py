"""Tangents as linear combinations of other tangents, with factors that are the same in all tangent directions.

A factor is a value of the program, such as a partial derivative. It is computed once for all directions.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from diffabs.compiler.ir import Graph, Node, UpdateLevel

TANGENT_OPERANDS = {"add": (0, 1), "sub": (0, 1), "select": (1, 2)}  # operands that must be tangents or 0


class Factor(NamedTuple):
    """A signed factor of a tangent.

    Attributes:
        negative: True if the factor is -`number`.
        number: Node of the factor's graph, None for 1.
    """

    negative: bool
    number: Node | None


FACTOR_ONE = Factor(False, None)
Sum = dict[int, Factor]  # a linear combination: the factor of each tangent, by the tangent's id


class Vertex:
    """A tangent: a sum of other tangents, a selection between two sums, or a nonlinear operation.

    Attributes:
        sum: The linear combination; in a selection, the one where `condition` is false.
        condition: Boolean node of the factor graph that selects; None without a selection.
        true_sum: The sum where `condition` is true.
        reads: Ids of the tangents that a nonlinear operation reads; empty for a sum or a selection.
    """

    __slots__ = ("condition", "reads", "sum", "true_sum")

    def __init__(
        self, sum: Sum, condition: Node | None = None, true_sum: Sum | None = None, reads: tuple[int, ...] = ()
    ):
        """Store a tangent; the arguments are the attributes."""
        self.sum: Sum = sum
        self.condition: Node | None = condition
        self.true_sum: Sum = true_sum or {}
        self.reads: tuple[int, ...] = reads

    def sums(self) -> tuple[Sum, ...]:
        """Return the sum, or both sums of a selection."""
        return (self.sum,) if self.condition is None else (self.sum, self.true_sum)


class Algebra:
    """Operations on sums of tangents, which add the factors of their results to a graph.

    Attributes:
        graph: Graph that the factors are nodes of.
        dtype: Type of the factors.
    """

    def __init__(self, graph: Graph, dtype: np.dtype):
        """Store the graph, which grows with new factors."""
        self.graph = graph
        self.dtype = dtype

    def vertex(self, node: Node, moves: Callable[[Node], bool], value: Callable[[Node], Node]) -> Vertex:
        """Return the vertex of an operation on tangents: a sum, a selection between two sums, or a nonlinear one.

        A `gate` is nonlinear here, so that it stays a conditional. `moves` and `value` are as in
        `Elimination.add_operation`.
        """
        on, args = [moves(x) for x in node.args], node.args

        def operand(i: int, negative: bool = False) -> Sum:
            """Return operand i as a sum: one term, or none if it is 0."""
            return {args[i].id: Factor(negative, None)} if on[i] else {}

        # A tangent plus a number other than 0 is no linear combination, so it remains as an operation of its own.
        linear = all(on[i] or _is_zero_tangent(value(args[i])) for i in TANGENT_OPERANDS.get(node.op, ()))
        match node.op:
            case "add" | "sub" if linear:
                return Vertex(self._plus(operand(0), operand(1, node.op == "sub")))
            case "neg":
                return Vertex(operand(0, True))
            case "mul" if not all(on):
                x, y = args if on[0] else args[::-1]
                return Vertex({x.id: _as_factor(value(y))})
            # A division by a factor becomes a product: the inverse is computed once for all tangents.
            case "div" if on == [True, False]:
                inverse = self.graph.op("div", self.graph.const(1, node.dtype), value(args[1]))
                return Vertex({args[0].id: _as_factor(inverse)})
            case "select" if linear and not on[0]:
                return Vertex(operand(1), value(args[0]), operand(2))
        return Vertex({}, reads=tuple(x.id for x, on in zip(args, on, strict=True) if on))

    def _as_node(self, factor: Factor) -> Node:
        """Return the node of a factor without its sign."""
        return self.graph.const(1, self.dtype) if factor.number is None else factor.number

    def _times(self, x: Factor, y: Factor) -> Factor:
        negative = x.negative != y.negative
        if x.number is None or y.number is None:
            return Factor(negative, x.number or y.number)
        for a, b in ((x.number, y.number), (y.number, x.number)):
            # The product moves into the branch of the selection, so that its zero remains an exact zero.
            if a.op == "select" and a.args[1].is_number(0):
                return Factor(negative, self.graph.select(a.args[0], a.args[1], self.graph.op("mul", b, a.args[2])))
        return Factor(negative, self.graph.op("mul", x.number, y.number))

    def _plus(self, sum: Sum, more: Sum) -> Sum:
        merged = dict(sum)
        for key, new in more.items():
            old = merged.pop(key, None)
            if old is None:
                merged[key] = new
            elif old.negative == new.negative:
                merged[key] = Factor(old.negative, self.graph.op("add", self._as_node(old), self._as_node(new)))
            # Equal terms of opposite sign cancel: the tangent leaves the sum.
            elif old.number is not new.number:
                first, second = (new, old) if old.negative else (old, new)
                merged[key] = Factor(False, self.graph.op("sub", self._as_node(first), self._as_node(second)))
        return merged

    def substitute(self, sum: Sum, key: int, inner: Sum) -> Sum:
        """Return `sum` with the sum `inner` in place of the tangent `key`, times the factor of `key`."""
        factor = sum[key]
        more = {x: self._times(factor, term) for x, term in inner.items()}
        return self._plus({x: term for x, term in sum.items() if x != key}, more)

    def select_factors(self, vertex: Vertex) -> Sum:
        """Return the selection of `vertex` between two sums as one sum, whose factors are selections."""
        assert vertex.condition is not None
        factors = {}
        for x in [*vertex.sum, *(x for x in vertex.true_sum if x not in vertex.sum)]:
            no, yes = vertex.sum.get(x), vertex.true_sum.get(x)
            if no == yes:
                factors[x] = no
                continue
            # A sign that both branches share stays outside of the selection.
            signs = {side.negative for side in (no, yes) if side is not None}
            sides = []
            for side in (no, yes):
                number = self.graph.const(0, self.dtype) if side is None else self._as_node(side)
                turned = side is not None and len(signs) > 1 and side.negative
                sides.append(self.graph.op("neg", number) if turned else number)
            factors[x] = Factor(len(signs) == 1 and signs.pop(), self.graph.select(vertex.condition, *sides))
        return factors


def _as_factor(node: Node) -> Factor:
    """Return a node as a factor, with its sign apart."""
    if node.op == "neg":
        return Factor(True, node.args[0])
    return Factor(node.is_number(-1), None) if node.is_number(1) or node.is_number(-1) else Factor(False, node)


def _is_zero_tangent(node: Node) -> bool:
    """Return whether a node is a zero tangent: the constant 0, a product with or quotient of it, or a sum of such."""
    if node.op in ("mul", "neg", "div"):
        return any(_is_zero_tangent(x) for x in node.args[: 1 if node.op == "div" else None])
    return node.is_number(0) or (node.op in ("add", "sub") and all(map(_is_zero_tangent, node.args)))


def changes_in_step(factor: Factor) -> bool:
    """Return whether a factor changes with each step."""
    return factor.number is not None and factor.number.level == UpdateLevel.STEP


def sum_cost(sum: Sum) -> int:
    """Return the number of operations that a sum needs in each tangent direction.

    A product and the addition of it count as one (FMA). A copy or an empty sum counts as 0.
    """
    alone = len(sum) == 1 and next(iter(sum.values())) == FACTOR_ONE
    return 0 if alone or not sum else max(1, len(sum) - any(factor == FACTOR_ONE for factor in sum.values()))
