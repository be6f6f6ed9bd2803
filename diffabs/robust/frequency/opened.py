"""The opened loop as operations on real numbers: its rest, its matrices and its delay, functions of a box's parameters.

    0 = r(x, p)      rest: x are the states, the command and the controller's memory that the setpoint does not decide
    A, B, C, D       derivatives of the parts there, as in `linear.opened_loop`: entries are operations of x and p

The operations come from the programs of the parts, as in `reach.equations`. They are differentiated here and not by
JAX: a derivative that a part declares need not be that of its values. A braked wheel has slip and speed as
coordinates. The setpoint and the start then decide both, so the only unknown of a plain brake is its torque.

An entry that is 0 whatever the numbers are is no operation but `NO_ENTRY`.
"""

from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from diffabs.compiler.ir import UpdateLevel
from diffabs.core.channels import need_single_control
from diffabs.core.protocols import Memory, Tracking
from diffabs.core.pytree import replace
from diffabs.core.types import Array, PyTree
from diffabs.core.validity import check_part
from diffabs.linear.opened_loop import controller_function, rest_point, split_off_delays
from diffabs.loop.closed_loop import Loop
from diffabs.parts.controllers import Sampled
from diffabs.robust.reach.equations import (
    STATE,
    Chart,
    Derivation,
    NoRule,
    RealOperation,
    check_slip_chart,
)

NO_ENTRY = -1

Row = tuple[int, ...]
Matrix = tuple[Row, ...]


class OpenedEquations(NamedTuple):
    """An opened loop with one control as operations on real numbers.

    Attributes:
        operations: Operations, as in `reach.equations`; `inside` is the slope of `clamp`. Operands come first, except
            the factors g of functions and what the settled states are.
        params: Paths of the parameters of the box.
        settled: Operation of each state that is no unknown.
        unknown: States that the rest decides.
        guess: Their values at the middle of the box.
        rest: Operations that vanish at rest, one more than unknowns if the controller has a memory.
        spare: Number of the last operations of `rest` of which one follows from the others; 0 or more.
        plant: (A, B, C) from the command to the signals of the controller; B has one column.
        controller: (F, G, H, J); of a sampled one F - I in place of F.
        delay: Operation of the delay [s].
        period: Period of the samples [s]; None in continuous time.
    """

    operations: tuple[RealOperation, ...]
    params: tuple[str, ...]
    settled: dict[int, int]
    unknown: tuple[int, ...]
    guess: tuple[float, ...]
    rest: Row
    spare: int
    plant: tuple[Matrix, Matrix, Matrix]
    controller: tuple[Matrix, Matrix, Matrix, Matrix]
    delay: int
    period: float | None


def derive_opened(loop: Loop, over: dict[str, tuple[float, float]], target: float | None = None) -> OpenedEquations:
    """Return the equations of an opened loop, with the parameters of a box as variables.

    Args:
        loop: Loop with one control.
        over: Range (low, high) of each parameter, by path, in SI units.
        target: Setpoint; None for the loop's own.

    Raises:
        ValueError: The loop has no linear model at the middle of the box; see `linear.open_loop`.
        NoRule: A part, an operation or a parameter has no sound rule.
    """
    check_part(loop)
    try:
        need_single_control(loop.plant, "a proof over a box")
    except ValueError as error:
        raise NoRule(str(error)) from None
    try:
        with jax.enable_x64(True):
            derivation = _OpenedDerivation(loop, tuple(over))
            middle = replace(loop, {path: 0.5 * (low + high) for path, (low, high) in over.items()})
            return derivation.open_equations(rest_point(middle, target), target)
    except RecursionError as error:
        raise NoRule("the loop has too long a chain of operations, each of which reads the one before") from error


class _OpenedDerivation(Derivation):
    """The derivation of the equations of one opened loop."""

    def open_equations(self, point: tuple[np.ndarray, np.ndarray, np.ndarray], target: float | None) -> OpenedEquations:
        """Return the equations; `point` is the rest at the middle of the box."""
        concrete = split_off_delays(self.loop)[0]
        if getattr(concrete.plant, "frozen", ()) and not self.charted:
            raise NoRule(f"plant {type(concrete.plant).__name__}: it has states besides slip, speed and distance")
        start = concrete.start()
        around = (self.chart(self.loop).plant, start.sensor.flow, start.actuator.flow) if self.charted else None
        around = around or (start.plant, start.sensor.flow, start.actuator.flow)
        n, as_around = _make_unflatten(around)
        plant_size = _count(start.plant)
        signals = jax.eval_shape(lambda loop: _signals(split_off_delays(loop)[0], target), self.loop)
        q, as_signal = _make_unflatten(signals)
        sampled = concrete.controller if isinstance(concrete.controller, Sampled) else None
        m = len(point[2])
        nodes = [self.graph.input(np.float64, UpdateLevel.STEP, (STATE, i)) for i in range(n + 1 + m + q)]
        z, v, c, s = nodes[:n], nodes[n : n + 1], nodes[n + 1 : n + 1 + m], nodes[n + 1 + m :]

        def whole(loop: Loop, numbers: Sequence[Array]) -> tuple[Loop, Any, PyTree]:
            """Return the loop without delays, the states of plant, sensor and actuator, and the start of its blocks."""
            loop = split_off_delays(loop)[0]
            x, begun = as_around(numbers), loop.start()
            return loop, (self.loop_state(loop, begun._replace(plant=x[0])).plant, *x[1:]), begun

        def move(loop: Loop, numbers: Sequence[Array], command: Sequence[Array]) -> list[Array]:
            loop, (plant, sensor, actuator), begun = whole(loop, numbers)
            memory = Memory(actuator, begun.actuator.held)
            control = loop.actuator.output(0.0, memory, command[0])
            rates = (
                loop.plant.derivative(0.0, plant, control),
                loop.sensor.flow(0.0, Memory(sensor, begun.sensor.held), loop.plant.output(plant)),
                loop.actuator.flow(0.0, memory, command[0]),
            )
            return _flatten(rates)

        def show(loop: Loop, numbers: Sequence[Array]) -> list[Array]:
            loop, (plant, sensor, _), begun = whole(loop, numbers)
            return _flatten(_signals(loop, target, plant, Memory(sensor, begun.sensor.held)))

        def track(loop: Loop, numbers: Sequence[Array]) -> list[Array]:
            loop, (plant, _, _), _ = whole(loop, numbers)
            return [loop.plant.output(plant)[0] - _setpoint(loop, target)]

        def settle(loop: Loop) -> list[Array]:
            undelayed, delay = split_off_delays(loop)
            return _flatten((_setpoint(undelayed, target), delay))

        def control(loop: Loop, memory: Sequence[Array], numbers: Sequence[Array]) -> list[Array]:
            compute = controller_function(split_off_delays(loop)[0], as_signal)[1]
            after, command = compute(jnp.stack(memory) if memory else jnp.zeros(0), jnp.stack(numbers))
            return _flatten((after, command))

        moved, shown = self.lower(move, z, v), self.lower(show, z)
        chart_states: dict[int, tuple[str, int]] = {}
        if self.charted:
            plant_nodes = self.lower(lambda loop, x: _flatten(whole(loop, x)[1][0]), z)
            y = self.lower(lambda loop, x: _flatten(tuple(loop.plant.output(whole(loop, x)[1][0]))), z)
            names = self.loop.plant.shows._fields
            places = [Chart._fields.index(name) for name in ("slip", "speed")]
            for name, i in zip(("slip", "speed"), places, strict=True):
                chart_states[y[names.index(name)].id] = ("state", i)
            fields = jax.tree.leaves(self.chart_rates(plant_nodes, moved[:plant_size], Chart(*z[:3])))
            moved = [*fields, *moved[plant_size:]]
            check_slip_chart(self.loop, self.paths)
        flow = [self.convert(x, chart_states) for x in moved]
        signal = [self.convert(x, chart_states) for x in shown]
        setpoint, delay = (self.convert(x, {}) for x in self.lower(settle))
        after = [self.convert(x, {}) for x in self.lower(control, c, s)]
        after, command = after[:-1], after[-1]
        if sampled is not None:
            delay = self.total(delay, self.number(float(sampled.delay)) if float(sampled.delay) else NO_ENTRY)
            after = [self.make("sub", (x, self.make("state", (), n + 1 + i))) for i, x in enumerate(after)]
        settled = {n + 1 + m + i: x for i, x in enumerate(signal)}
        rest, unknown = [*flow], [*range(n + 1)]
        if self.charted:
            begin = (
                setpoint,
                self.convert(self.initial_node("speed"), {}),
                self.convert(self.lower(self._distance)[0], {}),
            )
            settled |= dict(enumerate(begin))
            rest, unknown = [self.pace_rate(flow[0], 1), *flow[3:]], unknown[3:]
        else:
            rest.append(self.convert(self.lower(track, z)[0], {}))
        holds = [*after, self.make("sub", (command, self.make("state", (), n)))] if m else []
        keep = [i for i in range(n) if not (self.charted and i in (1, 2))]
        plant = (
            self.jacobian([flow[i] for i in keep], keep),
            self.jacobian([flow[i] for i in keep], [n]),
            self.jacobian(signal, keep),
        )
        inside, read = [*range(n + 1, n + 1 + m)], [*range(n + 1 + m, n + 1 + m + q)]
        controller = (
            self.jacobian(after, inside), self.jacobian(after, read),
            self.jacobian([command], inside), self.jacobian([command], read),
        )  # fmt: skip
        guess = [*point[0][plant_size:], *point[1], *point[2]] if self.charted else [*np.concatenate(point)]
        return OpenedEquations(
            operations=tuple(self.operations), params=self.paths, settled=settled, unknown=(*unknown, *inside),
            guess=tuple(map(float, guess)), rest=(*rest, *holds), spare=len(holds), plant=plant, controller=controller,
            delay=delay, period=None if sampled is None else float(sampled.period),
        )  # fmt: skip

    def _distance(self, loop: Loop) -> list[Array]:
        return [jnp.asarray(split_off_delays(loop)[0].start().plant.distance, float)]

    def jacobian(self, rows: Iterable[int], states: Iterable[int]) -> Matrix:
        """Return the derivatives of operations with respect to states."""
        columns = list(states)
        memories: dict[int, dict[int, int]] = {column: {} for column in columns}
        return tuple(tuple(self.tangent(row, column, memories[column]) for column in columns) for row in rows)

    def total(self, x: int, y: int) -> int:
        """Return a sum, of which either may be `NO_ENTRY`."""
        return y if x == NO_ENTRY else x if y == NO_ENTRY else self.make("add", (x, y))

    def product(self, x: int, y: int) -> int:
        """Return a product, of which either may be `NO_ENTRY`."""
        if NO_ENTRY in (x, y):
            return NO_ENTRY
        values = [self.operations[i].value if self.operations[i].name == "const" else None for i in (x, y)]
        return y if values[0] == 1.0 else x if values[1] == 1.0 else self.make("mul", (x, y))

    def tangent(self, i: int, state: int, memory: dict[int, int]) -> int:
        """Return the derivative of operation i with respect to a state."""
        if i not in memory:
            memory[i] = self.derive(i, state, memory)
        return memory[i]

    def derive(self, i: int, state: int, memory: dict[int, int]) -> int:
        """Return `tangent` from the operands."""
        name, value = self.operations[i].name, self.operations[i].value
        args: Any = self.operations[i].args
        if name in ("const", "truth", "param"):
            return NO_ENTRY
        if name == "state":
            return self.number(1.0) if value == state else NO_ENTRY
        if name == "select":
            no, yes = (self.tangent(x, state, memory) for x in args[1:])
            if no == yes:
                return no
            zero = self.number(0.0)
            return self.make("select", (args[0], zero if no == NO_ENTRY else no, zero if yes == NO_ENTRY else yes))
        along = [
            NO_ENTRY if x == NO_ENTRY else self.tangent(x, state, memory)
            for x in args[: 1 if len(args) > 1 and name in FUNCTIONS else None]
        ]
        match name:
            case "add":
                return self.total(*along)
            case "sub":
                if along[0] == along[1]:
                    return NO_ENTRY
                return self.total(along[0], NO_ENTRY if along[1] == NO_ENTRY else self.make("neg", (along[1],)))
            case "neg":
                return NO_ENTRY if along[0] == NO_ENTRY else self.make("neg", (along[0],))
            case "mul" if is_nought(self.operations, i):
                return NO_ENTRY if along == [NO_ENTRY, NO_ENTRY] else i
            case "mul":
                return self.total(self.product(along[0], args[1]), self.product(args[0], along[1]))
            case "inv":
                return (
                    NO_ENTRY
                    if along[0] == NO_ENTRY
                    else self.make("neg", (self.product(along[0], self.make("mul", (i, i))),))
                )
            case "meet":
                return along[0] if along[0] == along[1] or NO_ENTRY in along else self.make("meet", tuple(along))
            case "clamp" if along[1:] == [NO_ENTRY, NO_ENTRY]:
                return NO_ENTRY if along[0] == NO_ENTRY else self.product(along[0], self.make("inside", tuple(args)))
        if name in FUNCTIONS:
            return self.product(args[1], along[0])
        raise NoRule(f"{name}: a proof has no derivative of it")


def is_nought(operations: Sequence[RealOperation], i: int) -> bool:
    """Return whether an operation is 0 times a number: it has a value where that has one, and is its own derivative."""
    name, args, _ = operations[i]
    return name == "mul" and any(operations[a] == RealOperation("const", (), 0.0) for a in args)


FUNCTIONS = ("exp", "log", "sin", "cos", "atan", "power")  # (u, g) with the derivative g du


def _flatten(tree: object) -> list[Array]:
    return [jnp.asarray(x, float) for leaf in jax.tree.leaves(tree) for x in jnp.ravel(leaf)]


def _count(tree: object) -> int:
    return sum(int(np.prod(np.shape(leaf))) for leaf in jax.tree.leaves(tree))


def _make_unflatten(like: PyTree) -> tuple[int, Any]:
    """Return how many numbers a tree has, and the function that makes one of them."""
    leaves, structure = jax.tree.flatten(like)
    shapes = [np.shape(leaf) for leaf in leaves]
    for leaf in leaves:
        if not jnp.issubdtype(jnp.result_type(leaf), jnp.floating):
            raise NoRule("a memory that is not a real number (a counter or a random key)")

    def build(numbers: Sequence[Array]) -> PyTree:
        rest = iter(list(numbers))
        return jax.tree.unflatten(
            structure,
            [jnp.stack([next(rest) for _ in range(int(np.prod(x)))]).reshape(x) if x else next(rest) for x in shapes],
        )

    return sum(int(np.prod(x)) for x in shapes), build


def _setpoint(loop: Loop, target: float | None) -> Any:
    return loop.reference.setpoint(loop.start().reference) if target is None else jnp.asarray(target, float)


def _signals(loop: Loop, target: float | None, plant: Any = None, sensor: Memory | None = None) -> Tracking:
    """Return the signals of the controller at states of plant and sensor; without them, at the start."""
    start, setpoint = loop.start(), _setpoint(loop, target)
    output = loop.plant.output(start.plant if plant is None else plant)
    measured = loop.sensor.output(0.0, start.sensor if sensor is None else sensor, output)
    return Tracking(setpoint, measured, loop.feedforward.input(loop.plant, measured, setpoint))
