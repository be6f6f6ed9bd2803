"""A program whose comparisons are visible and can be answered from outside.

Examples are a limit, the knot of a spline, or a wheel at standstill. The flow of a loop is smooth between comparisons
of numbers that depend on the state: x > y, max(x, y), |x|. `SwitchedProgram` walks the jaxpr to find them, so that
parts need not declare them.

The answers to all comparisons together are a mode. With frozen answers the program is smooth also beyond its kinks, as
event location requires, and a derivative at a kink is one-sided.

`inner_functions` says which functions are opened. Comparisons in the others stay unchanged, and are recorded as hidden.
"""

import pathlib
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.extend.core as jex
import jax.numpy as jnp
import numpy as np
from jax._src.source_info_util import user_frame  # JAX has no public function that names the line of an operation
from jax.extend.core import JaxprEqn

from diffabs.core.types import Array, Equation, PyTree, Scalar, Source
from diffabs.engine.step.inner_functions import (
    SEARCHSORTED,
    Hidden,
    find_bent,
    find_hidden,
    is_knot_search,
    jumps,
    open_equation,
)
from diffabs.engine.step.modes import WORD_BITS, BitRange, ComparisonAnswers, ComparisonTrace, Mode

ENGINE = str(pathlib.Path(__file__).parents[1])  # no line of the engine has written a comparison of a loop


class _Op(NamedTuple):
    """An operation on numbered values.

    A comparing operation has a name, and for each of its comparisons the number and whether the comparison is reversed.
    `source` is JAX's record of the line that wrote the operation.
    """

    apply: Callable[..., Sequence[PyTree]]
    ins: tuple[int, ...]
    outs: tuple[int, ...]
    shape: tuple[int, ...]
    name: str = ""
    source: Source = None
    queries: tuple[tuple[int, bool], ...] = ()


class SwitchedProgram:
    """The program f(moving, fixed) between pytrees, with numbered comparisons.

    A comparison has a number if it depends on `moving` and an output in `counts` depends on it. Only shapes and types
    of the arguments matter.
    """

    def __init__(
        self, f: Callable[[PyTree, PyTree], PyTree], moving: object, fixed: object, counts: Callable[[PyTree], PyTree]
    ):
        """Trace `f` for arguments with the shapes of `moving` and `fixed`.

        `counts` picks those outputs of `f` whose comparisons get numbers.
        """
        closed, shape = jax.make_jaxpr(f, return_shape=True)(moving, fixed)
        self.ops: list[_Op] = []
        self.places: list[BitRange] = []
        self.origins: list[_Op] = []  # of each comparison, the first operation that asks it
        self.jumps: list[_Op] = []  # operations that jump without a comparison, and count
        self.hidden: list[Hidden] = []  # comparisons that closed functions hide, and that count
        self._jumping: list[_Op] = []
        self._hiding: list[tuple[tuple[int, ...], Hidden]] = []
        self._constants: dict[int, PyTree] = {}
        self._names: list[PyTree] = []  # of values; equal for the same operation on the same values
        self._moves: list[bool] = []
        self._numbers: dict[PyTree, int] = {}
        self._zero = self._value("zero", False)
        moves = [True] * len(jax.tree.leaves(moving)) + [False] * len(jax.tree.leaves(fixed))
        self._inputs = [self._value(("in", i), on) for i, on in enumerate(moves)]
        flat = self._add_jaxpr(closed.jaxpr, self._add_constants(closed.consts), self._inputs)
        self.outputs: object = jax.tree.unflatten(jax.tree.structure(shape), flat)
        self._number_comparisons(set(jax.tree.leaves(counts(self.outputs))))
        self._operations: dict[tuple[int, ...], list[_Op]] = {}

    @property
    def bit_count(self) -> int:
        """Number of bits that hold the answers."""
        return max((first + int(np.prod(shape)) for first, shape in self.places), default=0)

    @property
    def word_count(self) -> int:
        """Number of words that hold the answers; at least one."""
        return max(1, -(-self.bit_count // WORD_BITS))

    def __call__(self, pick: Callable[[PyTree], PyTree], moving: object, fixed: object, mode: Mode) -> Scalar:
        """Return the outputs that `pick` picks at (`moving`, `fixed`) in `mode`."""
        return self._run(pick, moving, fixed, mode, False)[0]

    def look(
        self, pick: Callable[[PyTree], PyTree], moving: object, fixed: object, mode: Mode
    ) -> tuple[PyTree, ComparisonAnswers]:
        """Return the outputs that `pick` picks at (`moving`, `fixed`) in `mode`, and the answers to all comparisons."""
        return self._run(pick, moving, fixed, mode, True)

    def _run(
        self, pick: Callable[[PyTree], PyTree], moving: object, fixed: object, mode: Mode, look: bool
    ) -> tuple[PyTree, PyTree]:
        """Return the picked outputs and, with `look`, the answers to all comparisons; otherwise None.

        Only the operations that these outputs need are evaluated.
        """
        # A NumPy array cannot be indexed by a traced number. It is converted here, within the present trace: a
        # converted constant that the program kept would belong to the trace in which it was made.
        values = {i: jnp.asarray(x) if isinstance(x, np.ndarray) else x for i, x in self._constants.items()}
        values.update(zip(self._inputs, map(jnp.asarray, jax.tree.leaves((moving, fixed))), strict=True))
        picked, tree = jax.tree.flatten(pick(self.outputs))
        trace = ComparisonTrace(self.places, self.word_count, mode, look)
        for op in self._operations_for(tuple(picked)):
            ins = [values[i] for i in op.ins]
            outs = _RESULT_FROM_ANSWERS[op.name](trace, op, *ins) if op.queries else op.apply(*ins)
            values.update(zip(op.outs, outs, strict=True))
        return tree.unflatten([values[i] for i in picked]), trace.answers() if look else None

    def _operations_for(self, outputs: tuple[int, ...]) -> list[_Op]:
        """Return the operations that these output values depend on, in the order of the program."""
        if outputs not in self._operations:
            self._operations[outputs] = [
                op for op, on in zip(self.ops, self._needed_operations(set(outputs)), strict=True) if on
            ]
        return self._operations[outputs]

    def _needed_operations(self, values: set[int]) -> list[bool]:
        """Return for each operation whether these values depend on it."""
        needed = []
        for op in reversed(self.ops):
            needed.append(not values.isdisjoint(op.outs))
            values = values.union(op.ins) if needed[-1] else values
        return needed[::-1]

    def _value(self, name: object, moves: bool) -> int:
        """Return the number of a new value; equal names mark equal values."""
        self._names.append(self._numbers.setdefault(name, len(self._names)))
        self._moves.append(moves)
        return len(self._names) - 1

    def _add_constants(self, constants: Sequence[PyTree]) -> list[int]:
        numbers = [self._value(("constant", len(self._names) + i), False) for i in range(len(constants))]
        self._constants.update(zip(numbers, constants, strict=True))
        return numbers

    def _literal(self, literal: Any) -> int:
        x = np.asarray(literal.val)
        new = self._value(("literal", str(literal.aval.dtype), x.shape, x.tobytes()), False)
        self._constants[new] = x.astype(literal.aval.dtype)[()]
        return new

    def _add_jaxpr(self, jaxpr: Any, constants: list[int], inputs: list[int], source: Source = None) -> list[int]:
        """Add the operations of a jaxpr, and return the numbers of its outputs; `source` wrote its call."""
        at = dict(zip([*jaxpr.constvars, *jaxpr.invars], [*constants, *inputs], strict=True))

        def read(atom: object) -> int:
            return self._literal(atom) if isinstance(atom, jex.Literal) else at[atom]

        bent = find_bent(jaxpr)
        for eqn in jaxpr.eqns:
            ins = tuple(read(atom) for atom in eqn.invars)
            # A function of `jax.numpy` is a jaxpr of its own, whose operations no line of a user has written.
            origin = _nearest_line(eqn.source_info, source)
            inner = open_equation(eqn, [self._moves[i] for i in ins], not bent.isdisjoint(eqn.outvars))
            if inner is None:
                outs = self._operation(eqn, ins, origin)
            else:
                outs = self._add_jaxpr(inner.jaxpr, self._add_constants(inner.consts), list(ins), origin)
            at.update(zip(eqn.outvars, outs, strict=True))
        return [read(atom) for atom in jaxpr.outvars]

    def _operation(self, eqn: Equation, ins: tuple[int, ...], source: Source) -> list[int]:
        """Add an operation, written by the line `source`, and return the numbers of its outputs."""
        # The same operation on the same values gets the same name, so that a repeated comparison has one number.
        parameters = tuple(sorted((key, str(value)) for key, value in eqn.params.items() if not callable(value)))
        operation_name = (eqn.primitive.name, parameters, tuple(self._names[i] for i in ins))
        moves = any(self._moves[i] for i in ins)
        outs = [self._value((*operation_name, i), moves) for i in range(len(eqn.outvars))]
        real = all(jnp.issubdtype(atom.aval.dtype, jnp.floating) for atom in eqn.invars)
        name = SEARCHSORTED if is_knot_search(eqn) else eqn.primitive.name
        shape = eqn.invars[0].aval.shape if name == SEARCHSORTED else eqn.outvars[0].aval.shape
        asks = name if moves and real and name in _RESULT_FROM_ANSWERS else ""
        self.ops.append(_Op(_bind_equation(eqn), ins, tuple(outs), shape, asks, source))
        if moves and jumps(eqn):
            self._jumping.append(self.ops[-1]._replace(name=eqn.primitive.name))
        if hidden := find_hidden(eqn, [self._moves[i] for i in ins]):
            self._hiding.append((tuple(outs), hidden._replace(source=_nearest_line(hidden.source, source))))
        return outs

    def _number_comparisons(self, counted: set[int]) -> None:
        """Number the comparisons on which the counted outputs depend."""
        numbers: dict[PyTree, int] = {}
        needed = self._needed_operations(counted)
        used = {op.outs for op, on in zip(self.ops, needed, strict=True) if on}
        self.jumps = [op for op in self._jumping if op.outs in used]
        self.hidden = [hidden for outs, hidden in self._hiding if outs in used]
        for i, (op, on) in enumerate(zip(self.ops, needed, strict=True)):
            if on and op.name:
                asks = [
                    self._number(numbers, x, y, strict, op)
                    for x, y, strict in _COMPARISONS[op.name](self._zero, *op.ins)
                ]
                self.ops[i] = op._replace(queries=tuple(asks))

    def _number(self, numbers: dict[PyTree, int], x: int, y: int, strict: bool, op: _Op) -> tuple[int, bool]:
        """Return the number of x > y or x >= y, and whether that number denotes the negation (y >= x or y > x)."""
        x, y = self._names[x], self._names[y]
        # One number for x > y and y >= x, which are negations of each other: the order of the names decides.
        turned = x > y
        key = (y, x, not strict) if turned else (x, y, strict)
        if key not in numbers:
            numbers[key] = len(self.places)
            shape = op.shape
            first, size = self.bit_count, int(np.prod(shape))
            # Answers that fit in a word do not straddle two words: `ComparisonTrace.search` reads a single word.
            fits = first % WORD_BITS + size <= WORD_BITS or size > WORD_BITS
            self.origins.append(op._replace(queries=((numbers[key], turned),)))
            self.places.append((first if fits else -(-first // WORD_BITS) * WORD_BITS, shape))
        return numbers[key], turned


def _nearest_line(source: Source, caller: object) -> Any:
    """Return JAX's record `source` of an operation if it names a line of a user, and otherwise that of its caller."""
    frame = user_frame(source.traceback)
    return source if caller is None or (frame and not frame.file_name.startswith(ENGINE)) else caller


def _bind_equation(eqn: JaxprEqn) -> Callable[..., Sequence[PyTree]]:
    """Return an operation as a function; an operation with an inner function becomes a program of its own."""
    if not any(callable(x) or hasattr(x, "eqns") or hasattr(x, "jaxpr") for x in eqn.params.values()):

        def bind(*ins: Any) -> Sequence[PyTree]:
            outs = eqn.primitive.bind(*ins, **eqn.params)
            return outs if eqn.primitive.multiple_results else (outs,)

        return bind
    # Primitives with inner functions (custom rules, scans) cannot be bound from their parameters alone.
    places = {atom: i for i, atom in enumerate(eqn.invars) if not isinstance(atom, jex.Literal)}
    used_outputs = [i for i, out in enumerate(eqn.outvars) if not isinstance(out, jex.DropVar)]
    debug_info = jex.DebugInfo("kinks", str(eqn.primitive), None, None)
    body = jex.Jaxpr((), list(places), [eqn.outvars[i] for i in used_outputs], [eqn], eqn.effects, debug_info)
    run = jex.jaxpr_as_fun(jex.ClosedJaxpr(body, ()))

    def call(*ins: Any) -> Sequence[PyTree]:
        outs: list[PyTree] = [None] * len(eqn.outvars)
        for i, out in zip(used_outputs, run(*(ins[place] for place in places.values())), strict=True):
            outs[i] = out
        return outs

    return call


# Comparisons of an operation as (x, y, strict), from the constant zero and the operation's inputs.
_COMPARISONS: dict[str, Callable[..., list[tuple[int, int, bool]]]] = {
    "gt": lambda zero, x, y: [(x, y, True)],
    "ge": lambda zero, x, y: [(x, y, False)],
    "lt": lambda zero, x, y: [(y, x, True)],
    "le": lambda zero, x, y: [(y, x, False)],
    "max": lambda zero, x, y: [(x, y, False)],
    "min": lambda zero, x, y: [(y, x, False)],
    "abs": lambda zero, x: [(x, zero, False)],
    "sign": lambda zero, x: [(x, zero, True), (zero, x, True)],
    "clamp": lambda zero, low, x, high: [(low, x, True), (x, high, True)],
    SEARCHSORTED: lambda zero, knots, x: [(x, knots, True)],
}


def _sign(trace: ComparisonTrace, op: _Op, x: Array) -> list[PyTree]:
    zero = jnp.zeros_like(x)
    up, down = trace(op.queries[0], x, zero, True), trace(op.queries[1], zero, x, True)
    return [jnp.where(up, 1, jnp.where(down, -1, 0)).astype(x.dtype)]


def _clamp(trace: ComparisonTrace, op: _Op, low: Scalar, x: Scalar, high: Scalar) -> list[PyTree]:
    low, high = jnp.broadcast_to(low, jnp.shape(x)), jnp.broadcast_to(high, jnp.shape(x))
    return [jnp.where(trace(op.queries[0], low, x, True), low, jnp.where(trace(op.queries[1], x, high, True), high, x))]


def _search(trace: ComparisonTrace, op: _Op, knots: Array, x: Scalar) -> list[PyTree]:
    return [trace.search(op.queries[0], lambda: op.apply(knots, x)[0], knots, x)]


# Result of an operation from the answers to its comparisons. `jnp.where` has the derivative of the selected branch.
_RESULT_FROM_ANSWERS: dict[str, Callable[..., list[PyTree]]] = {
    "gt": lambda trace, op, x, y: [trace(op.queries[0], x, y, True)],
    "ge": lambda trace, op, x, y: [trace(op.queries[0], x, y, False)],
    "lt": lambda trace, op, x, y: [trace(op.queries[0], y, x, True)],
    "le": lambda trace, op, x, y: [trace(op.queries[0], y, x, False)],
    "max": lambda trace, op, x, y: [jnp.where(trace(op.queries[0], x, y, False), x, y)],
    "min": lambda trace, op, x, y: [jnp.where(trace(op.queries[0], y, x, False), x, y)],
    "abs": lambda trace, op, x: [jnp.where(trace(op.queries[0], x, jnp.zeros_like(x), False), x, -x)],
    "sign": _sign,
    "clamp": _clamp,
    SEARCHSORTED: _search,
}
