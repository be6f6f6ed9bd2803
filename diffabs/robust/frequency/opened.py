"""The opened loop as operations on real numbers: its rest, its matrices and its delay, functions of a box's parameters.

    0 = r(x, p)      rest: x are the states, the command and the controller's memory that the setpoint does not decide
    A, B, C, D       derivatives of the parts there, as in `linear.opened_loop`: entries are operations of x and p

The operations come from the programs of the parts, as in `reach.equations`. They are differentiated here and not by
JAX: a derivative that a part declares need not be that of its values. A plant with `frozen` outputs has the slips of
its wheels, these outputs and its other states as coordinates. The setpoint and the start then decide slips and speed,
so the only unknown of a plain brake is its torque.

An entry that is 0 whatever the numbers are is no operation but `NO_ENTRY`.
"""

from collections.abc import Iterable, Sequence
from fractions import Fraction
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from diffabs.compiler.ir import Graph, Node, UpdateLevel
from diffabs.core.channels import control_names, has_channels, outputs_like, select_output
from diffabs.core.protocols import Memory, Tracking
from diffabs.core.pytree import parameters, replace
from diffabs.core.types import Array, PyTree
from diffabs.core.validity import check_part
from diffabs.linear.linearization import independent_components
from diffabs.linear.opened_loop import controller_function, rest_point, split_off_delays
from diffabs.loop.closed_loop import Loop
from diffabs.parts.controllers import Sampled
from diffabs.robust.reach.equations import (
    OWN,
    PARAM,
    STATE,
    Derivation,
    NoRule,
    RealOperation,
    chart_points,
    exact_values,
    graph_tangent,
    nodes_below,
)

NO_ENTRY = -1

Row = tuple[int, ...]
Matrix = tuple[Row, ...]


class OpenedEquations(NamedTuple):
    """An opened loop as operations on real numbers.

    Attributes:
        operations: Operations, as in `reach.equations`; `inside` is the slope of `clamp`. Operands come first, except
            the factors g of functions and what the settled states are.
        params: Paths of the parameters of the box.
        settled: Operation of each state that is no unknown.
        unknown: States that the rest decides.
        guess: Their values at the middle of the box.
        rest: Operations that vanish at rest, more than unknowns by the commands if the controller has a memory.
        spare: Number of the last operations of `rest` of which as many follow from the others as there are more of them
            than unknowns; 0 or more.
        plant: (A, B, C) from the commands to the signals of the controller; B has a column for each control.
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
        loop: Loop; a sampled one has one control.
        over: Range (low, high) of each parameter, by path, in SI units.
        target: Setpoint; None for the loop's own.

    Raises:
        ValueError: The loop has no linear model at the middle of the box; see `linear.open_loop`.
        NoRule: A part, an operation or a parameter has no sound rule.
    """
    check_part(loop)
    try:
        with jax.enable_x64(True):
            derivation = _OpenedDerivation(loop, tuple(over))
            middle = replace(loop, {path: 0.5 * (low + high) for path, (low, high) in over.items()})
            return derivation.open_equations(rest_point(middle, target), target)
    except RecursionError as error:
        raise NoRule("the loop has too long a chain of operations, each of which reads the one before") from error


class _Wheels(NamedTuple):
    """A plant of braked wheels in the coordinates slips, other states, and frozen outputs.

    Attributes:
        states: The plant's own states, as functions of the coordinates.
        inputs: The plant's own states.
        rims: Rim speed of each wheel, a function of the inputs.
        speed_output: The speed, a function of the inputs.
        z: The coordinates.
        slips: Number of slips, the first coordinates.
        remaining: Indices of the own states that are coordinates.
        speed: Index of the speed among the coordinates.
        held: Indices of the frozen outputs among the coordinates.
        coordinates: The coordinate that a node is, by the node's number.
    """

    states: list[Node]
    inputs: list[Node]
    rims: list[Node]
    speed_output: Node
    z: list[Node]
    slips: int
    remaining: list[int]
    speed: int
    held: list[int]
    coordinates: dict[int, tuple[str, int]]


def split_affine(graph: Graph, node: Node, x: Node) -> tuple[Node, Node] | None:
    """Return slope and offset of a node that is affine in x, or None if its form does not say that it is."""
    unit, zero, op = graph.const(1.0), graph.const(0.0), graph.op
    if node is x:
        return unit, zero
    if x not in nodes_below(node):
        return zero, node
    parts = [split_affine(graph, arg, x) for arg in node.args]
    if any(part is None for part in parts):
        return None
    slopes, offsets = zip(*(part for part in parts if part is not None), strict=True)
    match node.op:
        case "add" | "sub" | "neg":
            return op(node.op, *slopes), op(node.op, *offsets)
        case "mul" if x not in nodes_below(node.args[0]):
            return op("mul", node.args[0], slopes[1]), op("mul", node.args[0], offsets[1])
        case "mul" | "div" if x not in nodes_below(node.args[1]):
            return op(node.op, slopes[0], node.args[1]), op(node.op, offsets[0], node.args[1])
    return None


class _OpenedDerivation(Derivation):
    """The derivation of the equations of one opened loop."""

    def open_equations(self, point: tuple[np.ndarray, np.ndarray, np.ndarray], target: float | None) -> OpenedEquations:
        """Return the equations; `point` is the rest at the middle of the box."""
        concrete = split_off_delays(self.loop)[0]
        start = concrete.start()
        n, as_around = _make_unflatten((start.plant, start.sensor.flow, start.actuator.flow))
        plant_size, channels = _count(start.plant), control_names(concrete.plant)
        signals = jax.eval_shape(lambda loop: _signals(split_off_delays(loop)[0], target), self.loop)
        q, as_signal = _make_unflatten(signals)
        sampled = concrete.controller if isinstance(concrete.controller, Sampled) else None
        if sampled is not None and channels:
            raise NoRule(f"controller {type(concrete.controller).__name__}: a sampled loop with several controls")
        m, k = len(point[2]), len(point[1])
        nodes = [self.graph.input(np.float64, UpdateLevel.STEP, (STATE, i)) for i in range(n + k + m + q)]
        z, v, c, s = nodes[:n], nodes[n : n + k], nodes[n + k : n + k + m], nodes[n + k + m :]

        def whole(loop: Loop, numbers: Sequence[Array]) -> tuple[Loop, Any, PyTree]:
            """Return the loop without delays, the states of plant, sensor and actuator, and the start of its blocks."""
            loop = split_off_delays(loop)[0]
            return loop, as_around(numbers), loop.start()

        def move(loop: Loop, numbers: Sequence[Array], commands: Sequence[Array]) -> list[Array]:
            loop, (plant, sensor, actuator), begun = whole(loop, numbers)
            memory = Memory(actuator, begun.actuator.held)
            command: Any = loop.plant.controls(*commands) if channels else commands[0]  # pyright: ignore
            rates = (
                loop.plant.derivative(0.0, plant, loop.actuator.output(0.0, memory, command)),
                loop.sensor.flow(0.0, Memory(sensor, begun.sensor.held), loop.plant.output(plant)),
                loop.actuator.flow(0.0, memory, command),
            )
            return _flatten(rates)

        def show(loop: Loop, numbers: Sequence[Array]) -> list[Array]:
            loop, (plant, sensor, _), begun = whole(loop, numbers)
            return _flatten(_signals(loop, target, plant, Memory(sensor, begun.sensor.held)))

        def track(loop: Loop, numbers: Sequence[Array]) -> list[Array]:
            loop, (plant, _, _), _ = whole(loop, numbers)
            setpoint = _setpoint(loop, target)
            pairs = zip(_flatten(outputs_like(loop.plant.output(plant), setpoint)), _flatten(setpoint), strict=True)
            return [output - aim for output, aim in pairs]

        def control(loop: Loop, memory: Sequence[Array], numbers: Sequence[Array]) -> list[Array]:
            compute = controller_function(split_off_delays(loop)[0], as_signal)[1]
            after, command = compute(jnp.stack(memory) if memory else jnp.zeros(0), jnp.stack(numbers))
            return _flatten((after, command))

        wheels = self.solve_wheels(z, plant_size, target) if getattr(concrete.plant, "frozen", ()) else None
        states, coordinates = (z, {}) if wheels is None else ([*wheels.states, *z[plant_size:]], wheels.coordinates)
        moved, shown = self.lower(move, states, v), self.lower(show, states)
        if wheels is not None:
            moved = [*self.wheel_rates(wheels, moved[:plant_size]), *moved[plant_size:]]
        flow = [self.convert(x, coordinates) for x in moved]
        signal = [self.convert(x, coordinates) for x in shown]
        delay = self.convert(self.lower(lambda loop: _flatten(split_off_delays(loop)[1]))[0], {})
        after = [self.convert(x, {}) for x in self.lower(control, c, s)]
        after, commands = after[:m], after[m:]
        if sampled is not None:
            delay = self.total(delay, self.number(float(sampled.delay)) if float(sampled.delay) else NO_ENTRY)
            after = [self.make("sub", (x, self.make("state", (), n + k + i))) for i, x in enumerate(after)]
        settled = {n + k + m + i: x for i, x in enumerate(signal)}
        frozen_places = [] if wheels is None else wheels.held
        keep = [i for i in range(n) if i not in frozen_places]
        rest, unknown = [flow[i] for i in keep], [*range(n + k)]
        guess = [*point[0], *point[1]]
        if wheels is None:
            rest += [self.convert(x, {}) for x in self.lower(track, z)]
        else:
            begin = [self.convert(x, {}) for x in self.lower(lambda loop: _begin(loop, target))]
            settled |= dict(zip((*range(wheels.slips), *frozen_places), begin, strict=True))
            rest[: wheels.slips] = [self.pace_rate(x, wheels.speed) for x in rest[: wheels.slips]]
            unknown = [i for i in unknown if i not in settled]
            guess = [*(point[0][i] for i in wheels.remaining), *point[0][plant_size:], *point[1]]
        holds = [*after, *(self.make("sub", (x, self.make("state", (), n + i))) for i, x in enumerate(commands))]
        holds = holds if m else []
        plant = (
            self.jacobian([flow[i] for i in keep], keep),
            self.jacobian([flow[i] for i in keep], range(n, n + k)),
            self.jacobian(signal, keep),
        )
        inside, read = [*range(n + k, n + k + m)], [*range(n + k + m, n + k + m + q)]
        controller = (
            self.jacobian(after, inside), self.jacobian(after, read),
            self.jacobian(commands, inside), self.jacobian(commands, read),
        )  # fmt: skip
        return OpenedEquations(
            operations=tuple(self.operations), params=self.paths, settled=settled, unknown=(*unknown, *inside),
            guess=tuple(map(float, (*guess, *point[2]))), rest=(*rest, *holds), spare=len(holds), plant=plant,
            controller=controller, delay=delay, period=None if sampled is None else float(sampled.period),
        )  # fmt: skip

    def solve_wheels(self, z: list[Node], plant_size: int, target: float | None) -> "_Wheels":
        """Return the states of a plant of braked wheels as functions of slips, other states, speed and distance.

        Its outputs say that each wheel's slip is 1 - w/v. Each rim speed w and each frozen output has to be affine in
        one of the plant's states. Exact arithmetic checks the slips, as in `check_slip_chart`.
        """
        loop, graph = split_off_delays(self.loop)[0], self.graph
        plant: Any = loop.plant
        state, setpoint = loop.start().plant, _setpoint(loop, target)
        frozen = tuple(plant.frozen)
        tracked = setpoint._fields if has_channels(setpoint) else plant.shows._fields[:1]
        refused = f"plant {type(plant).__name__}: a proof of margins needs"
        remaining = independent_components(plant, state, (*tracked, *frozen))
        if "speed" not in frozen or len(tracked) + len(remaining) + len(frozen) != plant_size:
            raise NoRule(f"{refused} as many states as slips, speed, other frozen outputs, and states apart from these")
        structure = jax.tree.structure(state)
        inputs = [graph.input(np.float64, UpdateLevel.STEP, (OWN, i)) for i in range(plant_size)]

        def show(loop: Loop, x: list[Any]) -> list[Array]:
            output = split_off_delays(loop)[0].plant.output(jax.tree.unflatten(structure, x))
            wheels = [select_output(output, name) for name in tracked]
            if not all(hasattr(wheel, "slip") and hasattr(wheel, "wheel_speed") for wheel in wheels):
                raise NoRule(f"{refused} outputs `slip` and `wheel_speed` of each channel")
            return _flatten([*((w.slip, w.wheel_speed) for w in wheels), *(getattr(output, name) for name in frozen)])

        shown = self.lower(show, inputs)
        count, first = len(tracked), len(tracked) + len(remaining)
        slips, rims, others = shown[: 2 * count : 2], shown[1 : 2 * count : 2], shown[2 * count :]
        speed = first + frozen.index("speed")
        rim_speeds = [graph.op("mul", graph.op("sub", graph.const(1.0), x), z[speed]) for x in z[:count]]
        solved = {inputs[i].id: z[count + j] for j, i in enumerate(remaining)}
        waiting = [*zip((*others, *rims), (*z[first:plant_size], *rim_speeds), strict=True)]
        while waiting:
            for number, (output, value) in enumerate(waiting):
                open_states = [x for x in inputs if x.id not in solved and x in nodes_below(output)]
                parts = split_affine(graph, output, open_states[0]) if len(open_states) == 1 else None
                if parts is not None:
                    slope, offset = (self.substitute(x, dict(solved)) for x in parts)
                    solved[open_states[0].id] = graph.op("div", graph.op("sub", value, offset), slope)
                    del waiting[number]
                    break
            else:
                raise NoRule(f"{refused} rim speeds and frozen outputs that are affine in one state each")
        rim_outputs, speed_output = rims, others[frozen.index("speed")]
        slips, others = ([self.substitute(x, dict(solved)) for x in group] for group in (slips, others))
        places = [*range(count), *range(first, plant_size)]
        values = {path: value for path, _, value in parameters(self.loop)}
        nominal = [Fraction(float(values[path]) or 1.0) for path in self.paths]
        for v, ratios, distance, numbers in chart_points(count, nominal):
            fixed = [v if name == "speed" else distance for name in frozen]
            at = {(STATE, i): x for i, x in zip(places, [*ratios, *fixed], strict=True)} | {
                (PARAM, i): x for i, x in enumerate(numbers)
            }
            if exact_values([*slips, *others], at) != [*ratios, *fixed]:
                raise NoRule(f"plant {type(plant).__name__}: its slip is not 1 - w/v at {float(v):.3g} m/s")
        coordinates = {x.id: ("state", i) for x, i in zip((*slips, *others), places, strict=True)}
        return _Wheels(
            [solved[x.id] for x in inputs], inputs, rim_outputs, speed_output, z[:plant_size], count,
            [*map(int, remaining)], speed, [*range(first, plant_size)], coordinates,
        )  # fmt: skip

    def wheel_rates(self, wheels: "_Wheels", rates: list[Node]) -> list[Node]:
        """Return the rates of the coordinates from those of the plant's own states: v s' = (1 - s) v' - w'.

        Those of the frozen outputs are not used.
        """
        graph = self.graph
        tangents = {x.id: rate for x, rate in zip(wheels.inputs, rates, strict=True)}
        substitutes = {x.id: state for x, state in zip(wheels.inputs, wheels.states, strict=True)}
        dv, *rims = (
            self.substitute(graph_tangent(graph, root, tangents), dict(substitutes))
            for root in (wheels.speed_output, *wheels.rims)
        )
        speed, moved = wheels.z[wheels.speed], []
        for slip, dw in zip(wheels.z, rims, strict=False):
            loss = graph.op("sub", graph.op("mul", graph.op("sub", graph.const(1.0), slip), dv), dw)
            moved.append(graph.op("div", loss, speed))
        return [*moved, *(rates[i] for i in wheels.remaining), *(dv for _ in wheels.held)]

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


def _begin(loop: Loop, target: float | None) -> list[Array]:
    """Return the setpoints, then the frozen outputs at the start."""
    loop = split_off_delays(loop)[0]
    plant: Any = loop.plant
    output = plant.output(loop.start().plant)
    return _flatten((_setpoint(loop, target), [getattr(output, name) for name in plant.frozen]))


def _setpoint(loop: Loop, target: float | None) -> Any:
    return loop.reference.setpoint(loop.start().reference) if target is None else jnp.asarray(target, float)


def _signals(loop: Loop, target: float | None, plant: Any = None, sensor: Memory | None = None) -> Tracking:
    """Return the signals of the controller at states of plant and sensor; without them, at the start."""
    start, setpoint = loop.start(), _setpoint(loop, target)
    output = loop.plant.output(start.plant if plant is None else plant)
    measured = loop.sensor.output(0.0, start.sensor if sensor is None else sensor, output)
    return Tracking(setpoint, measured, loop.feedforward.input(loop.plant, measured, setpoint))
