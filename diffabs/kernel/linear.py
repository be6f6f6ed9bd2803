"""Tangents as what they are: sums of products of other tangents with numbers.

What they are multiplied with is worked out once for all tangents."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from diffabs.kernel.graph import Graph, Node, UpdateLevel

TANGENT_OPERANDS = {"add": (0, 1), "sub": (0, 1), "select": (1, 2)}  # operands that are tangents, or zero


class Factor(NamedTuple):
    """A number, None for 1, and whether it counts negative."""

    negative: bool
    number: Node | None


UNIT_FACTOR = Factor(False, None)
Sum = dict[int, Factor]  # of tangents, by the numbers of their nodes


class Vertex:
    """A tangent: a sum; or where `which` another one; or an operation of its own, of which it matters what it reads."""

    __slots__ = ("others", "reads", "sum", "which")

    def __init__(self, sum: Sum, which: Node | None = None, others: Sum | None = None, reads: tuple[int, ...] = ()):
        """`others` is the sum where `which`."""
        self.sum, self.which, self.others, self.reads = sum, which, others or {}, reads

    def sums(self) -> tuple[Sum, ...]:
        """All that it is made of."""
        return (self.sum,) if self.which is None else (self.sum, self.others)


class Algebra:
    """What is done with sums; factors are nodes of a graph, of one type."""

    def __init__(self, graph: Graph, dtype: np.dtype):
        """Of this graph, which grows."""
        self.graph, self.dtype = graph, dtype

    def vertex(self, node: Node, moves: Callable[[Node], bool], value: Callable[[Node], Node]) -> Vertex:
        """Return an operation on tangents; `value`: what a number is that is none."""
        on, args = [moves(x) for x in node.args], node.args

        def alone(i: int, negative: bool = False) -> Sum:
            return {args[i].id: Factor(negative, None)} if on[i] else {}

        linear = all(on[i] or _is_zero_tangent(value(args[i])) for i in TANGENT_OPERANDS.get(node.op, ()))
        match node.op:
            case "add" | "sub" if linear:
                return Vertex(self._plus(alone(0), alone(1, node.op == "sub")))
            case "neg":
                return Vertex(alone(0, True))
            case "mul" if not all(on):
                x, y = args if on[0] else args[::-1]
                return Vertex({x.id: _factor(value(y))})
            case "div" if on == [True, False]:
                inverse = self.graph.op("div", self.graph.const(1, node.dtype), value(args[1]))
                return Vertex({args[0].id: _factor(inverse)})
            case "select" if linear and not on[0]:
                return Vertex(alone(1), value(args[0]), alone(2))
        return Vertex({}, reads=tuple(x.id for x, on in zip(args, on, strict=True) if on))

    def _number(self, factor: Factor) -> Node:
        return self.graph.const(1, self.dtype) if factor.number is None else factor.number

    def _times(self, x: Factor, y: Factor) -> Factor:
        negative = x.negative != y.negative
        if x.number is None or y.number is None:
            return Factor(negative, x.number or y.number)
        for a, b in ((x.number, y.number), (y.number, x.number)):
            if a.op == "select" and a.args[1].is_number(0):  # the zero stays one whatever it is multiplied with
                return Factor(negative, self.graph.select(a.args[0], a.args[1], self.graph.op("mul", b, a.args[2])))
        return Factor(negative, self.graph.op("mul", x.number, y.number))

    def _plus(self, sum: Sum, more: Sum) -> Sum:
        found = dict(sum)
        for key, new in more.items():
            old = found.pop(key, None)
            if old is None:
                found[key] = new
            elif old.negative == new.negative:
                found[key] = Factor(old.negative, self.graph.op("add", self._number(old), self._number(new)))
            elif old.number is not new.number:
                first, second = (new, old) if old.negative else (old, new)
                found[key] = Factor(False, self.graph.op("sub", self._number(first), self._number(second)))
        return found

    def within(self, sum: Sum, key: int, inner: Sum) -> Sum:
        """Return a sum with another one in the place of a tangent."""
        factor = sum[key]
        more = {x: self._times(factor, one) for x, one in inner.items()}
        return self._plus({x: one for x, one in sum.items() if x != key}, more)

    def decided(self, vertex: Vertex) -> Sum:
        """Return a choice of sums as a sum."""
        assert vertex.which is not None
        found = {}
        for x in [*vertex.sum, *(x for x in vertex.others if x not in vertex.sum)]:
            no, yes = vertex.sum.get(x), vertex.others.get(x)
            if no == yes:
                found[x] = no
                continue
            signs = {one.negative for one in (no, yes) if one is not None}
            sides = []
            for one in (no, yes):
                number = self.graph.const(0, self.dtype) if one is None else self._number(one)
                turned = one is not None and len(signs) > 1 and one.negative
                sides.append(self.graph.op("neg", number) if turned else number)
            found[x] = Factor(len(signs) == 1 and signs.pop(), self.graph.select(vertex.which, *sides))
        return found


def _factor(node: Node) -> Factor:
    if node.op == "neg":
        return Factor(True, node.args[0])
    return Factor(node.is_number(-1), None) if node.is_number(1) or node.is_number(-1) else Factor(False, node)


def _is_zero_tangent(node: Node) -> bool:
    """Whether a number is that of a tangent that is zero."""
    if node.op in ("mul", "neg", "div"):
        return any(_is_zero_tangent(x) for x in node.args[: 1 if node.op == "div" else None])
    return node.is_number(0) or (node.op in ("add", "sub") and all(map(_is_zero_tangent, node.args)))


def changes_in_step(factor: Factor) -> bool:
    """Return whether a factor is a number that changes in a step."""
    return factor.number is not None and factor.number.level == UpdateLevel.STEP


def count_terms(sum: Sum) -> int:
    """Return the operations of a sum for each tangent: a product and a sum are one."""
    alone = len(sum) == 1 and next(iter(sum.values())) == UNIT_FACTOR
    return 0 if alone or not sum else max(1, len(sum) - any(one == UNIT_FACTOR for one in sum.values()))
