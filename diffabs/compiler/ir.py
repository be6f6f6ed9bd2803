"""An expression graph of single numbers, without duplicates: equal operations on equal operands are one node.

A node's level says how often its value changes. Constants are folded. Uniform values are computed once a launch, values
of a lane once when it starts, and the rest in every step.
"""

import enum
import math
from collections.abc import Callable, Hashable, Iterable, Sequence
from typing import NamedTuple, TypeAlias

import numpy as np
from jax.extend.core import JaxprEqn
from jax.typing import DTypeLike

from diffabs.compiler.operations import MIRRORED, NEGATED, OPERATIONS
from diffabs.core.types import Any, PyTree

NodeArray: TypeAlias = np.ndarray  # of nodes


class UpdateLevel(enum.IntEnum):
    """How often a value changes: KNOWN never, UNIFORM with each launch, LANE with each lane, STEP in each step.

    The level of an array in `TracedFunctions` has the same names. There, STEP means the carry.
    """

    KNOWN, UNIFORM, LANE, STEP = range(4)


class Node:
    """A number: an operation on other numbers.

    Attributes:
        id: Index of the node in its graph; operands have smaller ones.
        op: Name of the operation; "const" for a constant, "input" for a number from outside.
        args: Operands.
        dtype: NumPy type of the number.
        attr: A constant's value, an input's place, or the `Gate` of a conditional; else None.
        level: How often the value changes.
        label: Name of a variable or function in the source, if the graph records it, else empty.
    """

    __slots__ = ("args", "attr", "dtype", "id", "label", "level", "op")

    def __init__(self, id: int, op: str, args: tuple["Node", ...], dtype: np.dtype, attr: object, level: UpdateLevel):
        """Store the fields. Only a `Graph` creates nodes."""
        self.id: int = id
        self.op: str = op
        self.args: tuple[Node, ...] = args
        self.dtype: np.dtype = dtype
        self.attr: Any = attr
        self.level: UpdateLevel = level
        self.label: str = ""

    def is_number(self, value: float) -> bool:
        """Return whether the node is a constant equal to `value`."""
        return self.op == "const" and bool(self.attr == value)


class Gate(NamedTuple):
    """The identity of a conditional. All nodes "gate" of one conditional have equal ones.

    Attributes:
        number: Index of the conditional in its graph.
        any: True if the condition is a marker of `Graph.any`. Then a constant result of the false branch is a
            placeholder, which no lane uses.
    """

    number: int
    any: bool


class Graph:
    """A list of nodes in topological order, operands first; equal nodes are one."""

    def __init__(self) -> None:
        """Create an empty graph."""
        self.nodes: list[Node] = []
        self._by_key: dict[PyTree, Node] = {}
        self._gates = 0

    def begin_equation(self, eqn: JaxprEqn) -> None:
        """Do nothing; a subclass may record that the following nodes come from the JAX equation `eqn`."""

    def _make(
        self, op: str, args: tuple[Node, ...], dtype: DTypeLike, attr: object = None, level: UpdateLevel | None = None
    ) -> Node:
        """Return the only node with these fields; without `level`, it changes as often as its most changing operand."""
        dtype = np.dtype(dtype)
        key = (op, tuple(arg.id for arg in args), dtype, attr)
        if key not in self._by_key:
            node_level = max((UpdateLevel.UNIFORM, *(arg.level for arg in args))) if level is None else level
            self.nodes.append(Node(len(self.nodes), op, args, dtype, attr, node_level))
            self._by_key[key] = self.nodes[-1]
        return self._by_key[key]

    def const(self, value: object, dtype: DTypeLike | None = None) -> Node:
        """Return the constant `value` of type `dtype`."""
        x = np.asarray(value, dtype)[()]
        # The key has the bytes, because 0 == -0 and NaN != NaN.
        key = ("const", x.dtype, x.tobytes())
        if key not in self._by_key:
            self.nodes.append(Node(len(self.nodes), "const", (), x.dtype, x, UpdateLevel.KNOWN))
            self._by_key[key] = self.nodes[-1]
        return self._by_key[key]

    def input(self, dtype: DTypeLike, level: UpdateLevel, place: Hashable) -> Node:
        """Return the input node of type `dtype` and level `level`; `place` (hashable) says where its value is from."""
        return self._make("input", (), dtype, place, level)

    def op(self, name: str, *args: Node) -> Node:
        """Return a node for the operation `name` on `args`: new, known, folded to a constant, or simplified.

        `name` is a row of `OPERATIONS`, or "gt" or "ge". The operands have one type. A comparison gives a boolean.
        """
        if name in MIRRORED:
            name, args = MIRRORED[name], args[::-1]
        operation = OPERATIONS[name]
        dtype = np.dtype(bool) if operation.compares else args[0].dtype
        # Folding may overflow or give NaN, as the operation itself does, so NumPy's warnings are off.
        if operation.fold and all(arg.op == "const" for arg in args):
            with np.errstate(all="ignore"):
                return self.const(operation.fold(*(arg.attr for arg in args)), dtype)
        simpler = _SIMPLIFICATIONS[name](self, *args) if name in _SIMPLIFICATIONS else None
        if simpler is not None:
            return simpler
        # One order of operands for commutative operations, so that x + y and y + x are one node.
        if operation.symmetric and args[0].id > args[1].id:
            args = args[::-1]
        return self._make(name, args, dtype)

    def select(self, condition: Node, no: Node, yes: Node) -> Node:
        """Return `yes` where `condition` is true, else `no`."""
        if condition.op == "const" or no is yes:
            return yes if no is yes or condition.attr else no
        if condition.op == "not":
            return self.select(condition.args[0], yes, no)
        if no.dtype == bool:
            return self._select_boolean(condition, no, yes)
        # A nested selection on the same truth has only one reachable branch.
        yes = yes.args[2] if yes.op == "select" and yes.args[0] is condition else yes
        no = no.args[1] if no.op == "select" and no.args[0] is condition else no
        if no is yes:
            return yes
        # `lower` and `higher` are the processor's min and max. They return the second operand for NaN, as here.
        if condition.op == "lt" and {yes, no} == set(condition.args):
            return self._make("lower" if yes is condition.args[0] else "higher", (yes, no), yes.dtype)
        return self._make("select", (condition, no, yes), yes.dtype)

    def _select_boolean(self, condition: Node, no: Node, yes: Node) -> Node:
        """Return a selection between two booleans, as logical operations."""
        if yes.op == "const":
            return self.op("or", condition, no) if yes.attr else self.op("and", self.op("not", condition), no)
        if no.op == "const":
            return self.op("or", self.op("not", condition), yes) if no.attr else self.op("and", condition, yes)
        return self.op("or", self.op("and", condition, yes), self.op("and", self.op("not", condition), no))

    def gate(self, condition: Node, no: Iterable[Node], yes: Iterable[Node]) -> list[Node]:
        """Return the results of a conditional: nodes "gate", which a back end may compute with a jump.

        `no` and `yes` are the results of the false and of the true branch, in one order. `condition` is a boolean of a
        lane, or the marker that `any` returns for one.
        """
        pairs = list(zip(no, yes, strict=True))
        truth = condition.args[0] if condition.op == "any" else condition
        if truth.op == "const":
            return [b if truth.attr else a for a, b in pairs]
        gate, self._gates = Gate(self._gates, condition.op == "any"), self._gates + 1
        return [b if a is b else self._gate(gate, truth, a, b) for a, b in pairs]

    def _gate(self, gate: Gate, condition: Node, no: Node, yes: Node) -> Node:
        """Return one result of the conditional `gate`, whose condition is not constant."""
        # A constant in the other branch is a placeholder: only lanes with a true `condition` use the result.
        if gate.any and no.op == "const":
            return yes
        return self._make("gate", (condition, no, yes), yes.dtype, gate)

    def any(self, condition: Node) -> Node:
        """Return a node for `condition` that `gate` takes as the condition "`condition` is true in some lane".

        Its value in a lane is `condition` itself.
        """
        return condition if condition.op in ("const", "any") else self._make("any", (condition,), bool)

    def convert(self, x: Node, dtype: DTypeLike) -> Node:
        """Return the number `x` converted to `dtype`; as a boolean, x != 0."""
        dtype = np.dtype(dtype)
        if x.dtype == dtype:
            return x
        if x.op == "const":
            if dtype.kind in "iu" and x.dtype.kind == "f":
                return self.const(_bounded_integer(float(x.attr), dtype), dtype)
            with np.errstate(all="ignore"):
                return self.const(np.asarray(x.attr).astype(dtype)[()])
        if dtype.kind == "b":
            return self.op("ne", x, self.const(0, x.dtype))
        return self._make("convert", (x,), dtype)

    def bits(self, x: Node, dtype: DTypeLike) -> Node:
        """Return the bits of `x`, read as a number of the type `dtype` of the same size."""
        if x.dtype == np.dtype(dtype):
            return x
        return self.const(x.attr.view(dtype)) if x.op == "const" else self._make("bits", (x,), dtype)

    def table(self, index: Node, column: tuple[Node, ...]) -> Node:
        """Return the entry of `column` at `index` (in range), by comparisons if the entries differ between lanes."""
        if len(column) > 2 and all(x.level < UpdateLevel.LANE for x in column):
            return self._make("table", (index, *column), column[0].dtype)
        entries = list(column)
        entry = entries.pop()  # needs no comparison, because the index is in range
        for i, x in reversed([*enumerate(entries)]):
            entry = self.select(self.op("eq", index, self.const(i, index.dtype)), entry, x)
        return entry

    def again(self, node: Node, args: list[Node]) -> Node:
        """Return the operation of `node`, which may belong to another graph, on the operands `args` of this graph."""
        match node.op:
            case "const":
                return self.const(node.attr)
            case "convert" | "bits":
                return (self.convert if node.op == "convert" else self.bits)(args[0], node.dtype)
            case "table":
                return self.table(args[0], tuple(args[1:]))
            case "select" | "any":
                return self.select(*args) if node.op == "select" else self.any(args[0])
            case "gate":
                if args[0].op == "const":
                    return args[2] if args[0].attr else args[1]
                return args[2] if args[1] is args[2] else self._gate(node.attr, *args)
        return self.op(node.op, *args)


def is_real(dtype: DTypeLike) -> bool:
    """Return whether a type is real (floating point)."""
    return np.issubdtype(dtype, np.floating)


def live_nodes(roots: Sequence[Node]) -> list[Node]:
    """Return the roots and all nodes that they depend on, without duplicates, operands first."""
    nodes: dict[int, Node] = {}
    pending = list(roots)
    while pending:
        node = pending.pop()
        if node.id not in nodes:
            nodes[node.id] = node
            pending.extend(node.args)
    # Node ids grow from operands to results, so sorting is a topological order.
    return [nodes[i] for i in sorted(nodes)]


# Each of these returns a simpler node for an operation, or None if the operation stays as it is.


# x + 0 becomes x although -0 + 0 is +0.
def _add(graph: Graph, x: Node, y: Node) -> Node | None:
    return y if x.is_number(0) else x if y.is_number(0) else None


def _without_zero(graph: Graph, x: Node, y: Node) -> Node | None:
    return x if y.is_number(0) else None


# x*0 is not folded: it is NaN for an infinite x.
def _mul(graph: Graph, x: Node, y: Node) -> Node | None:
    for a, b in ((x, y), (y, x)):
        if a.is_number(1):
            return b
        if a.is_number(-1):
            return graph.op("neg", b)
        # Two factors that are constant over the steps become one: fewer operations, with another rounding.
        if is_real(x.dtype) and a.level < UpdateLevel.STEP and b.op == "mul" and b.level == UpdateLevel.STEP:
            for c, factor in (b.args, b.args[::-1]):
                if c.level < UpdateLevel.STEP and _is_factor(product := graph.op("mul", a, c)):
                    return graph.op("mul", product, factor)
    return None


def _div(graph: Graph, x: Node, y: Node) -> Node | None:
    """Return x times the inverse of a divisor that is constant over the steps: faster, with one rounding more."""
    if y.is_number(1):
        return x
    if not is_real(x.dtype) or x.level < UpdateLevel.STEP or y.level == UpdateLevel.STEP:
        return None
    inverse = graph.op("div", graph.const(1, y.dtype), y)
    return graph.op("mul", x, inverse) if _is_factor(inverse) else None


def _is_factor(x: Node) -> bool:
    """Return whether a factor may replace others: it is no constant, or a normal one, which has all its digits."""
    return x.op != "const" or bool(np.finfo(x.dtype).tiny <= abs(x.attr) < np.inf)


def _and(graph: Graph, x: Node, y: Node) -> Node | None:
    if x is y:
        return x
    for a, b in ((x, y), (y, x)):
        if a.op == "const" and x.dtype == bool:
            return b if a.attr else a
        if a.is_number(0):
            return a
        if a.op == "not" and a.args[0] is b and x.dtype == bool:
            return graph.const(False)
    return None


def _or(graph: Graph, x: Node, y: Node) -> Node | None:
    if x is y:
        return x
    for a, b in ((x, y), (y, x)):
        if a.op == "const" and x.dtype == bool:
            return a if a.attr else b
        if a.is_number(0):
            return b
        if a.op == "not" and a.args[0] is b and x.dtype == bool:
            return graph.const(True)
    return None


def _xor(graph: Graph, x: Node, y: Node) -> Node | None:
    return y if x.is_number(0) else x if y.is_number(0) else None


def _not(graph: Graph, x: Node) -> Node | None:
    if x.op == "not":
        return x.args[0]
    return graph.op(NEGATED[x.op], *x.args) if x.op in NEGATED else None


def _ne(graph: Graph, x: Node, y: Node) -> Node | None:
    """Simplify x != 0 for a number converted from a boolean, and a comparison of a boolean with a constant."""
    for a, b in ((x, y), (y, x)):
        if b.is_number(0) and a.op == "convert" and a.args[0].dtype == bool:
            return a.args[0]
        if x.dtype == bool and b.op == "const":
            return graph.op("not", a) if b.attr else a
    return None


def _eq(graph: Graph, x: Node, y: Node) -> Node | None:
    unequal = _ne(graph, x, y)
    return None if unequal is None else graph.op("not", unequal)


def _bounded_integer(value: float, dtype: np.dtype) -> int:
    """Return a real number as an integer, as XLA does. NaN is 0, and the ends of the type's range bound the others."""
    ends = np.iinfo(dtype)
    if math.isnan(value):
        return 0
    return int(ends.min) if value <= ends.min else int(ends.max) if value >= ends.max else int(value)


_SIMPLIFICATIONS: dict[str, Callable[..., Node | None]] = {
    "add": _add,
    "sub": _without_zero,
    "mul": _mul,
    "div": _div,
    "and": _and,
    "or": _or,
    "xor": _xor,
    "not": _not,
    "quotient": lambda graph, x, y: x if y.is_number(1) else None,
    "neg": lambda graph, x: x.args[0] if x.op == "neg" else None,
    "ne": _ne,
    "eq": _eq,
    "shift_left": _without_zero,
    "shift_right_logical": _without_zero,
}
