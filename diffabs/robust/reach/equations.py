"""The equations of a closed loop as a list of operations on real numbers, from the programs of its own parts.

    z(0) = start(p),   z := tick(z) every period,   dz/dt = flow(z) between ticks,   p: the parameters of a box

`jax.make_jaxpr` traces `Loop.start`, `Loop.change` and `Loop.flow`, and the lowering rules of `compiler` reduce them to
single numbers. The operations mean real numbers, and a number is folded only if that is exact. The numbers of the loop
are inputs of these programs, so NumPy does not round them; only periods and delays are not. A constant stands for the
double and for the decimal that its shortest text shows; the provers enclose both.

Three forms are recognised, because their floating-point form says less than their meaning: powers, limits, and the slip
of a braked wheel. A number that has no value, such as 1/0, leaves a proof undecided. So does `isfinite` of it.

A braked wheel is described by slip and speed instead of two angular speeds. In a set of runs both speeds vary together,
and only with the slip as a state does an enclosure keep that. `check_slip_chart` tests the change of coordinates.
"""

import dataclasses
import math
import random
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from fractions import Fraction
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.typing import DTypeLike

from diffabs.compiler.ir import Graph, Node, NodeArray, UpdateLevel, live_nodes
from diffabs.compiler.lower.rules import Unsupported, constant_array, lower_jaxpr, scalar_array
from diffabs.core.blocks import offers
from diffabs.core.channels import need_single_control
from diffabs.core.messages import Clock
from diffabs.core.protocols import BrakeOutput
from diffabs.core.pytree import parameters, replace
from diffabs.core.types import Int, PyTree, Scalar
from diffabs.core.validity import check_part
from diffabs.loop.closed_loop import BLOCKS, Loop, LoopState
from diffabs.parts.controllers.sampled import Sampled
from diffabs.parts.plants import BrakeStart

# Inputs: parameters of the box, states of the proof, states of the plant's own, and a tick's grid step and number.
PARAM, STATE, OWN, GRID = "param", "state", "own", "grid"
TIME = "t"
# A program computes with doubles, so a number that may overflow, such as exp(x), may have no value: 0 exp(1000) is NaN.
LARGEST_INPUT = 1e150  # of a state or a parameter; a proof ends before a state is larger
LARGEST_NUMBER, MAX_EXPONENT = 1e300, 690.0
# Operations whose result is not larger than their largest operand, and that are at most 2.
CHOOSING = ("neg", "abs", "min", "max", "lower", "higher", "select", "any", "gate", "convert")
SMALL = ("lt", "le", "gt", "ge", "eq", "ne", "and", "or", "not", "sin", "cos", "atan", "tanh", "is_finite")
CHART_TRIALS = 20  # random rational points; a wrong rational function is right at one with a probability of nearly 0
SLOWEST, FASTEST = Fraction(2, 100), Fraction(200)  # speeds [m/s] at which the chart is checked, ends included
CHART_DECADES = 6.0  # by which parameters of the box are changed, up and down
CHART_SLIPS = (Fraction(0), Fraction(1, 2), Fraction(999_999, 10**6))  # slips that go with both ends


class NoRule(ValueError):
    """An error: the proof has no sound rule for a part, an operation or a number of the loop."""


class RealOperation(NamedTuple):
    """One number: an operation on other ones.

    Attributes:
        name: `const`, `truth`, `param`, `state`, `add`, `sub`, `mul`, `neg`, `inv`, `clamp`, `round`, `select`, `meet`,
            comparisons, logic, functions.
        args: Indices of the operands. `select` has (condition, if false, if true), `clamp` (number, low, high) with -1
            for a missing limit. A function y of u has (u, g), where dy = g du and g may come after y. `power` has its
            exponent in addition.
        value: Of `const` the number, of `truth` the truth, of `param` and `state` its index.
    """

    name: str
    args: tuple[int, ...]
    value: Any = None


@dataclasses.dataclass(frozen=True)
class Equations:
    """A closed loop as operations on real numbers.

    Attributes:
        operations: Operations; operands come first, except the factors g of functions.
        params: Paths of the parameters of the box.
        states: Names of the states.
        start: Operation of each state at t = 0, a function of the parameters alone.
        flow: Operation of each state's rate of change.
        tick: Operation of each state after a tick; empty for a continuous loop.
        period: Time between two ticks [s]; None for a continuous loop.
        signals: Operation of each signal, by name.
        margin: Operation of the stop's margin, which is positive until the run ends.
        nonnegative: Indices of the states that are never negative, which the proof verifies.
        travelled: Index of the state that is the distance, or -1.
        speed: Index of the state that is the speed, or -1.
        clock: Index of the state that is the time.
        paced: True if the independent variable is eta with d eta = dt/v, so that rates are multiplied by the speed v.
        acceleration: Operation of the speed's rate of change in time, or -1.
    """

    operations: tuple[RealOperation, ...]
    params: tuple[str, ...]
    states: tuple[str, ...]
    start: tuple[int, ...]
    flow: tuple[int, ...]
    tick: tuple[int, ...]
    period: float | None
    signals: dict[str, int]
    margin: int
    nonnegative: tuple[int, ...]
    travelled: int
    speed: int
    clock: int
    paced: bool
    acceleration: int = -1


class RealGraph(Graph):
    """A graph that means real numbers: it folds and simplifies only if the result is exact."""

    def __init__(self) -> None:
        """Create an empty graph."""
        super().__init__()
        self._sizes: dict[int, float] = {}
        self._counts: dict[int, float] = {}

    def has_value(self, node: Node) -> bool:
        """Return whether a number is finite, in doubles, for all values of the inputs; False if that is unknown."""
        return self._size(node) < LARGEST_NUMBER

    def is_count(self, node: Node) -> bool:
        """Return whether an integer is computed from truths without an overflow; it is a real number then."""
        return node.dtype.kind in "iu" and self._count(node) <= np.iinfo(node.dtype).max

    def _count(self, node: Node) -> float:
        """Return a bound of |integer| and of all integers it is computed from; infinite for other operations."""
        if node.dtype == bool:
            return 1.0
        if node.id not in self._counts:
            counts = [self._count(arg) for arg in node.args]
            match node.op:
                case "const":
                    self._counts[node.id] = abs(float(node.attr))
                case "add":
                    self._counts[node.id] = sum(counts)
                case "convert" | "min" | "max" | "lower" | "higher" | "select" if node.dtype.kind in "iu":
                    self._counts[node.id] = max(counts)
                case _:
                    self._counts[node.id] = np.inf
        return self._counts[node.id]

    def _size(self, node: Node) -> float:
        """Return a bound of |number| for all values of the inputs; infinite if it may have no value."""
        if node.id not in self._sizes:
            sizes = [self._size(arg) for arg in node.args]
            self._sizes[node.id] = self._size_of(node, sizes) if max(sizes, default=0.0) < np.inf else np.inf
        return self._sizes[node.id]

    def _size_of(self, node: Node, sizes: list[float]) -> float:
        """Return `_size` of an operation from those of its operands, which are finite."""
        match node.op:
            case "const" if _is_finite(node):
                return abs(float(node.attr))
            case "input":
                return LARGEST_INPUT
            case "add" | "sub":
                return sum(sizes)
            case "mul":
                return sizes[0] * sizes[1]
            case "div" if _is_nonzero(node.args[1]):
                return sizes[0] / sizes[1] if sizes[1] * LARGEST_NUMBER > sizes[0] else np.inf
            case "rint":
                return sizes[0] + 1.0
            case "exp":
                return math.exp(sizes[0]) if sizes[0] < MAX_EXPONENT else np.inf
        return max(sizes) if node.op in CHOOSING else 2.0 if node.op in SMALL else np.inf

    def op(self, name: str, *args: Node) -> Node:
        """Return a node for the operation `name` on `args`; see `Graph.op`."""
        real = all(np.issubdtype(arg.dtype, np.floating) for arg in args)
        if name in ("is_finite", "ne", "eq") and real and args[0] is args[-1] and args[0].op != "const":
            # A real number is finite and equals itself, if it has a value: `convert` asks whether it does.
            finite = self._make("is_finite", args[:1], bool)
            return self.op("not", finite) if name == "ne" else finite
        if not real or name in ("is_finite", "lt", "le", "gt", "ge", "eq", "ne"):
            return super().op(name, *args)
        if name == "neg" and args[0].op == "const":
            return self.const(-args[0].attr)
        if all(map(_is_decimal, args)) and name in ("add", "sub", "mul"):
            exact = {"add": lambda x, y: x + y, "sub": lambda x, y: x - y, "mul": lambda x, y: x * y}
            value = exact[name](*(Fraction(float(arg.attr)) for arg in args))
            if abs(value) < 2**1000 and Fraction(float(value)) == value:
                return self.const(float(value), args[0].dtype)
        simpler = _simplify(self, name, args)
        return self._make(name, args, args[0].dtype) if simpler is None else simpler

    def bits(self, x: Node, dtype: DTypeLike) -> Node:
        """Refuse the bits of a number, which real numbers have not."""
        raise Unsupported("lt_to", "a proof has no rule for a search in a table, as of jnp.interp or jnp.searchsorted")

    def table(self, index: Node, column: tuple[Node, ...]) -> Node:
        """Return the entry of a column at an index, by comparisons with numbers between two indices.

        An enclosure of an index may be a little wider than the integer, but contains no such number.
        """
        *entries, entry = column
        for i, x in reversed([*enumerate(entries)]):
            below = self.op("lt", self._make("convert", (index,), np.float64), self.const(i + 0.5))
            entry = self.select(below, entry, x)
        return entry

    def any(self, condition: Node) -> Node:
        """Return the condition itself: a result of a branch that no lane takes is a placeholder only in a kernel."""
        return condition


def _is_finite(node: Node) -> bool:
    return node.op == "const" and bool(np.isfinite(node.attr))


def _is_nonzero(node: Node) -> bool:
    return _is_finite(node) and not node.is_number(0)


def _is_decimal(node: Node) -> bool:
    """Return whether a node is a finite constant whose double is exactly the decimal that its shortest text shows."""
    return _is_finite(node) and Fraction(repr(float(node.attr))) == Fraction(float(node.attr))


def _simplify(graph: RealGraph, name: str, args: tuple[Node, ...]) -> Node | None:
    """Return an equal, simpler node for an operation on real numbers, or None."""
    x, y = args if len(args) == 2 else (args[0], args[0])

    def zero(node):
        return node.is_number(0)

    match name:
        case "add":
            return y if zero(x) else x if zero(y) else None
        case "sub":
            if x is y and graph.has_value(x):
                return graph.const(0.0, x.dtype)
            return x if zero(y) else graph.op("neg", y) if zero(x) else None
        case "mul":
            if (zero(x) and graph.has_value(y)) or (zero(y) and graph.has_value(x)):
                return graph.const(0.0, x.dtype)
            return y if x.is_number(1) else x if y.is_number(1) else None
        case "div":
            return graph.const(0.0, x.dtype) if zero(x) and _is_nonzero(y) else x if y.is_number(1) else None
        case "neg":
            return x.args[0] if x.op == "neg" else None
    return None


def tick_clock(loop_period: float, t: Scalar, h: Scalar, k: Int) -> Clock:
    """Return the clock at a tick of every block, whose number is k; a block of another period has no rule."""

    class Tick(Clock):
        def ticks(self, period: PyTree = None) -> tuple[PyTree, PyTree]:
            # Without a period a block ticks with `h`: the controller in a sampled one, with each of its samples.
            if period is None and isinstance(self.h, Tracer):
                raise NoRule("a block ticks with the integration grid, which a proof has not")
            if isinstance(period, Tracer):
                raise NoRule("a block whose period is not its parameter `period`")
            if period is not None and float(period) != loop_period:
                raise NoRule(f"clocks of different periods: {loop_period:g} s, {float(period):g} s")
            return jnp.asarray(True), self.k

    return Tick(t, h, k, None)


def derive_equations(loop: Loop, over: Iterable[str]) -> Equations:
    """Return the equations of a loop, with the parameters at the paths `over` as variables.

    Raises:
        ValueError: A parameter is out of range, or an output of the plant has the name of another signal.
        NoRule: A part has events or noise, two blocks have different clocks, an operation has no sound rule, or there
            are too many in a chain.
    """
    paths = tuple(over)
    check_part(loop)
    try:
        need_single_control(loop.plant, "a proof over a box")
    except ValueError as error:
        raise NoRule(str(error)) from None
    try:
        with jax.enable_x64(True):
            return Derivation(loop, paths).equations()
    except RecursionError as error:
        raise NoRule("the loop has too long a chain of operations, each of which reads the one before") from error


class Derivation:
    """The derivation of the equations of one loop: a graph, and the operations that it becomes."""

    def __init__(self, loop: Loop, paths: tuple[str, ...]):
        """Make an input of each parameter at `paths`. Raises NoRule for a path without a rule."""
        self.loop = jax.tree.map(lambda x: np.asarray(x, float) if np.asarray(x).dtype.kind == "f" else x, loop)
        self.paths, self.graph = paths, RealGraph()
        self.period: float | None = None
        values = {path: value for path, _, value in parameters(self.loop)}
        for path in paths:
            if path not in values:
                raise NoRule(f"{path} is not a parameter of the loop")
            if np.ndim(values[path]):
                raise NoRule(f"{path} is a list; a proof varies single numbers")
            if path.split(".")[0] in BLOCKS and path.split(".")[-1] in ("period", "delay"):
                raise NoRule(f"{path}: the proof has no rule for a range of periods or delays")
        self.parameter_nodes = [
            self.graph.input(np.float64, UpdateLevel.UNIFORM, (PARAM, i)) for i in range(len(paths))
        ]
        state = loop.start().plant
        fields = set(getattr(state, "_fields", ()))
        self.charted = loop.plant.shows is BrakeOutput and isinstance(loop.initial, BrakeStart)
        self.charted &= "distance" in fields and len(fields) == len(Chart._fields)
        self.operations: list[RealOperation] = []
        self.indices: dict[Any, int] = {}
        self.converted: dict[Any, dict[int, int]] = {}

    def lower(self, function: Callable[..., Any], *groups: list[Node]) -> list[Node]:
        """Return the results of a function of a loop and lists of numbers as nodes, one for each number.

        The loop has the parameters of the box and all its numbers as inputs, so that Python computes with none.
        """
        shown, structure = jax.tree_util.tree_flatten_with_path(self.loop)
        fixed = [x for path, x in shown if _is_traced(path, x)]

        def call(numbers: list[Any], values: list[Any], *arguments: PyTree) -> PyTree:
            stream = iter(numbers)
            leaves = [next(stream) if _is_traced(path, x) else x for path, x in shown]
            loop = replace(jax.tree.unflatten(structure, leaves), dict(zip(self.paths, values, strict=True)))
            return function(loop, *arguments)

        shapes = [[jax.ShapeDtypeStruct((), node.dtype) for node in group] for group in (self.parameter_nodes, *groups)]
        closed = jax.make_jaxpr(call)([jax.ShapeDtypeStruct(x.shape, x.dtype) for x in fixed], *shapes)
        constants = [constant_array(self.graph, np.asarray(x)) for x in closed.consts]
        inputs: list[NodeArray] = [constant_array(self.graph, x) for x in fixed]
        inputs += [scalar_array(node) for group in (self.parameter_nodes, *groups) for node in group]
        try:
            return [x for array in lower_jaxpr(self.graph, closed.jaxpr, constants, inputs) for x in array.flat]
        except Unsupported as error:
            raise NoRule(str(error)) from None

    def equations(self) -> Equations:
        """Return the equations; the states are those of the loop's memory, in its order, then the time."""
        self.period = _clock_of(self.loop)
        start, rates, after, show = self.programs()
        first = jax.eval_shape(self.chart, self.loop)
        shown, structure = jax.tree_util.tree_leaves_with_path(first), jax.tree.structure(first)
        names: list[str] = []
        for (_, leaf), path in zip(shown, _state_names([path for path, _ in shown]), strict=True):
            if not np.issubdtype(leaf.dtype, np.floating):
                raise NoRule(f"{path}: a memory that is not a real number (a counter or a random key)")
            names += [path + (f".{i}" if leaf.ndim else "") for i in range(int(np.prod(leaf.shape)))]
        n = len(names)
        nodes = [self.graph.input(np.float64, UpdateLevel.STEP, (STATE, i)) for i in range(n + 1)]

        def state_of(numbers: PyTree) -> PyTree:
            leaves, at = [], 0
            for _, leaf in shown:
                size = int(np.prod(leaf.shape))
                leaves.append(jnp.stack(numbers[at : at + size]).reshape(leaf.shape) if leaf.ndim else numbers[at])
                at += size
            return jax.tree.unflatten(structure, leaves)

        def flat(tree: object) -> list[Any]:
            return [jnp.asarray(x, float) for leaf in jax.tree.leaves(tree) for x in jnp.ravel(leaf)]

        begun = self.lower(lambda loop: flat(start(loop)))
        moved = self.lower(lambda loop, z: flat(rates(loop, state_of(z[:-1]), z[-1])), nodes)
        shows = self.lower(lambda loop, z: flat(show(loop, state_of(z[:-1]), z[-1])), nodes)
        signal_names = [*self.loop.plant.shows._fields, "target", "command", "control", "setpoint"]
        if not (len(begun) == len(moved) == n and len(shows) == len(signal_names) + 1):
            raise NoRule("a memory whose rate has another shape, or a signal that is no single number")
        slip, speed, travelled = chart = [names.index(f"plant.{x}") if self.charted else -1 for x in Chart._fields]
        if self.charted:
            plant_nodes = self.lower(lambda loop, z: flat(self.loop_state(loop, state_of(z[:-1])).plant), nodes)
            rates_of_own = [moved[i] for i in sorted(chart)]
            shown_rates = self.chart_rates(plant_nodes, rates_of_own, Chart(*(nodes[i] for i in chart)))
            for i, rate in zip(chart, shown_rates, strict=True):
                moved[i] = rate
        # The slip and the speed that the plant computes from its own states are the states of the chart.
        chart_states = {shows[0].id: ("state", slip), shows[1].id: ("state", speed)} if self.charted else {}
        initial = {name: self.initial_node(name) for name in ("slip", "speed")} if self.charted else {}
        at_start = (
            {begun[i].id: initial[name] for i, name in ((slip, "slip"), (speed, "speed"))} if self.charted else {}
        )
        starts = [self.convert(self.substitute(x, at_start), {}) for x in begun]
        names = [*names, TIME]
        ticked: list[int] = []
        if self.period is not None:
            grid = [self.graph.input(x, UpdateLevel.STEP, (GRID, i)) for i, x in enumerate((np.float64, np.int64))]
            ticks = self.lower(lambda loop, z, c: flat(after(loop, state_of(z[:-1]), z[-1], *c)), nodes, grid)
            for name, root in zip(names[:-1], ticks, strict=True):
                if not nodes_below(root).isdisjoint(grid):
                    raise NoRule(f"{name} depends on the number of its tick or on the step of the integration grid")
            ticked = [self.convert(x, chart_states) for x in ticks] + [self.make("state", (), n)]
            for i in (slip, speed, travelled) if self.charted else ():
                ticked[i] = self.make("state", (), i)  # a tick does not move the plant
        flow = [self.convert(x, chart_states) for x in moved] + [self.make("const", (), 1.0)]
        # The slip moves at a rate that goes with 1/v. With d eta = dt/v it does not, and one step suits all speeds.
        acceleration = flow[speed] if self.charted else -1
        paced = self.charted and self.period is None
        if paced:
            flow = [self.pace_rate(x, speed) for x in flow]
        signals = {name: self.convert(x, chart_states) for name, x in zip(signal_names, shows[:-1], strict=True)}
        margin = self.convert(shows[-1], chart_states)
        if self.charted:
            check_slip_chart(self.loop, self.paths)
        return Equations(
            operations=tuple(self.operations), params=self.paths, states=tuple(names),
            start=(*starts, self.make("const", (), 0.0)), flow=tuple(flow), tick=tuple(ticked), period=self.period,
            signals=signals, margin=margin, nonnegative=(slip,) if self.charted else (), travelled=travelled,
            speed=speed, clock=n, paced=paced, acceleration=acceleration,
        )  # fmt: skip

    def loop_state(self, loop: Loop, state: PyTree) -> LoopState:
        """Return the loop's own state, from one in the coordinates of the proof."""
        if not self.charted:
            return state
        x = loop.plant.start(BrakeStart(speed=state.plant.speed, slip=state.plant.slip))
        return state._replace(plant=x._replace(distance=state.plant.distance))

    def programs(self) -> tuple[Any, Any, Any, Any]:
        """Return the functions start(loop), rates(loop, state, t), after(loop, state, t, h, k), show(loop, state, t).

        h and k are the step of the integration grid and the number of the tick.
        """

        def rates(loop: Loop, state: object, t: Scalar) -> PyTree:
            whole = self.loop_state(loop, state)
            flow = loop.flow(t, whole, loop.signals(t, whole))
            return jax.tree.map(jnp.zeros_like, whole).with_flow(flow)

        period = self.period or 0.0

        def after(loop: Loop, state: LoopState, t: Scalar, h: Scalar, k: Int) -> LoopState:
            whole = self.loop_state(loop, state)
            clock = tick_clock(period, t, h, k)
            return loop.change(clock, whole, loop.signals(t, whole), {}, {}, None)._replace(plant=state.plant)

        def show(loop: Loop, state: object, t: Scalar) -> Sequence[Scalar]:
            whole = self.loop_state(loop, state)
            sample = loop.signals(t, whole).sample
            return [
                *sample.output,
                sample.target,
                sample.command,
                sample.control,
                sample.setpoint,
                loop.stop.margin(sample.output),
            ]

        return self.chart, rates, after, show

    def chart_rates(self, plant_nodes: list[Node], rates: list[Node], chart: "Chart") -> list[Node]:
        """Return the rates of slip, speed and distance from those of the plant's own states.

        The graph of the speeds v and w in the plant's output is differentiated here. A derivative that a part declares
        need not be that of its values.
        """
        graph, structure = self.graph, jax.tree.structure(self.loop.start().plant)
        inputs = [graph.input(np.float64, UpdateLevel.STEP, (OWN, i)) for i in range(len(plant_nodes))]

        def speeds(loop: Loop, x: list[Any]) -> list[Any]:
            y = loop.plant.output(jax.tree.unflatten(structure, x))
            return [jnp.asarray(y.speed, float), jnp.asarray(y.wheel_speed, float)]

        tangents = {x.id: rate for x, rate in zip(inputs, rates, strict=True)}
        substitutes = {x.id: state for x, state in zip(inputs, plant_nodes, strict=True)}
        roots = [graph_tangent(graph, root, tangents) for root in self.lower(speeds, inputs)]
        dv, dw = (self.substitute(root, substitutes) for root in roots)
        loss = graph.op("sub", graph.op("mul", graph.op("sub", graph.const(1.0), chart.slip), dv), dw)
        return [graph.op("div", loss, chart.speed), dv, jax.tree.unflatten(structure, rates).distance]

    def chart(self, loop: Loop) -> PyTree:
        """Return the start of the loop in the coordinates of the proof."""
        state = loop.start()
        if not self.charted:
            return state
        y = loop.plant.output(state.plant)
        return state._replace(plant=Chart(y.slip, y.speed, state.plant.distance))

    def initial_node(self, name: str) -> Node:
        """Return a number of the loop's start, such as the speed."""
        path = f"initial.{name}"
        if path in self.paths:
            return self.parameter_nodes[self.paths.index(path)]
        return self.graph.const(float(getattr(self.loop.initial, name)))

    def substitute(self, node: Node, replacements: dict[int, Node]) -> Node:
        """Return a node with other nodes in place of those in `replacements`, by number; that gets each node."""
        for original in live_nodes([node]):
            if original.id not in replacements:
                args = [replacements[arg.id] for arg in original.args]
                replacements[original.id] = self.graph.again(original, args) if args else original
        return replacements[node.id]

    def make(self, name: str, args: tuple[int, ...], value: object = None) -> int:
        """Return the index of an operation, which is added if it is new."""
        key = (name, args, value)
        if key not in self.indices:
            self.operations.append(RealOperation(*key))
            self.indices[key] = len(self.operations) - 1
        return self.indices[key]

    def number(self, value: float) -> int:
        """Return the index of a constant."""
        return self.make("const", (), float(value))

    def pace_rate(self, rate: int, speed: int) -> int:
        """Return a rate times the speed."""
        v = self.make("state", (), speed)
        inverse = self.make("inv", (v,))
        operation = self.operations[rate]
        if operation.name == "mul" and inverse in operation.args:
            return operation.args[0] if operation.args[1] == inverse else operation.args[1]
        return v if operation == RealOperation("const", (), 1.0) else self.make("mul", (rate, v))

    def function(self, name: str, u: int) -> int:
        """Return a function of an operation; its second operand is the factor g of its derivative, dy = g du."""
        key = (name, u)
        if key in self.indices:
            return self.indices[key]
        at = len(self.operations)
        match name:
            case "exp":
                self.operations.append(RealOperation(name, (u, at)))
            case "sin" | "cos":
                self.operations += [RealOperation("sin", (u, at + 1)), RealOperation("cos", (u, at + 2))]
                self.operations.append(RealOperation("neg", (at,)))
                self.indices[("sin", u)], self.indices[("cos", u)] = at, at + 1
                return self.indices[key]
            case "log":
                inverse = self.make("inv", (u,))
                at = self.make(name, (u, inverse))
            case "atan":
                inverse = self.make("inv", (self.make("add", (self.number(1.0), self.make("mul", (u, u)))),))
                at = self.make(name, (u, inverse))
        self.indices[key] = at
        return at

    def power(self, u: int, exponent: int, value: float) -> int:
        """Return u^e of u >= 0. The factor of its derivative is e u^(e-1), which for e < 1 has no value at u = 0."""
        if value < 1:
            key = ("power", u, exponent)
            if key not in self.indices:
                at = len(self.operations)
                # g = e u^e / u needs the result itself, so the three are made together
                self.operations.append(RealOperation("power", (u, at + 3, exponent)))
                self.operations += [
                    RealOperation("inv", (u,)),
                    RealOperation("mul", (at, at + 1)),
                    RealOperation("mul", (exponent, at + 2)),
                ]
                self.indices[key] = at
            return self.indices[key]
        less = self.power(u, self.make("sub", (exponent, self.number(1.0))), value - 1)
        return self.make("power", (u, self.make("mul", (exponent, less)), exponent))

    def convert(self, node: Node, chart_states: dict[int, tuple[str, int]]) -> int:
        """Return the index of a node's operation; `chart_states` has the nodes that are a state of the chart."""
        memory = self.converted.setdefault(tuple(sorted(chart_states.items())), {})
        stack = [node]
        while stack:
            top = stack[-1]
            if top.id in memory:
                stack.pop()
                continue
            if top.id in chart_states:
                memory[top.id] = self.make(chart_states[top.id][0], (), chart_states[top.id][1])
                continue
            pattern = _power_of(top)
            needed = pattern if pattern else top.args
            waiting = [arg for arg in needed if arg.id not in memory]
            if waiting:
                stack += waiting
                continue
            if pattern:
                base, exponent = pattern
                if exponent.op != "const":
                    raise NoRule("a power whose exponent is not a number")
                memory[top.id] = self.power(memory[base.id], memory[exponent.id], float(exponent.attr))
            else:
                memory[top.id] = self.operation(top, [memory[arg.id] for arg in top.args])
        return memory[node.id]

    def operation(self, node: Node, args: list[int]) -> int:
        """Return the operation of a node whose operands are converted."""
        make, number = self.make, self.number
        if node.dtype not in (np.float64, np.bool_) and not self.graph.is_count(node):
            raise NoRule(f"{node.op}: the proof has no rule for numbers of the type {node.dtype}")
        match node.op:
            case "const":
                return make("truth", (), bool(node.attr)) if node.dtype == bool else number(node.attr)
            case "input":
                kind, index = node.attr
                return make("param" if kind == PARAM else "state", (), index)
            case "add" | "sub" | "mul":
                return make(node.op, tuple(args))
            case "neg":
                return make("neg", (args[0],))
            case "div":
                return self.division(*args)
            case "min" | "lower" | "max" | "higher":
                return self.extreme(node.op in ("min", "lower"), *args)
            case "abs":
                return make("select", (make("lt", (args[0], number(0.0))), args[0], make("neg", (args[0],))))
            case "select" | "gate":
                return self.selection(*args)
            case "any":
                return args[0]
            case "convert" if node.args[0].dtype == bool:
                return make("select", (args[0], number(0.0), number(1.0)))
            case "convert" if node.args[0].op == "const":
                return number(float(node.args[0].attr))
            case "convert" if self.graph.is_count(node.args[0]):
                return args[0]
            case "lt" | "le" | "eq" | "ne":
                return make(node.op, tuple(args))
            case "and" | "or" | "not":
                return self.logic(node.op, args)
            case "is_finite" if self.graph.has_value(node.args[0]):
                return make("truth", (), True)
            case "is_finite":  # 0 x < 1 is true, and has no value where x has none
                return make("lt", (make("mul", (args[0], number(0.0))), number(1.0)))
            case "rint":
                return make("round", (args[0],))
            case "sqrt":
                return self.root(args[0], 0.5)
            case "pow" if _is_finite(node.args[1]) and float(node.args[1].attr) % 1:
                exponent = float(node.args[1].attr)
                value = self.root(args[0], abs(exponent))
                return value if exponent > 0 else make("inv", (value,))
            case "exp" | "log" | "sin" | "cos" | "atan":
                return self.function(node.op, args[0])
            case "tan":
                return make("mul", (self.function("sin", args[0]), make("inv", (self.function("cos", args[0]),))))
            case "tanh":
                growth = self.function("exp", make("mul", (number(2.0), args[0])))
                part = make("mul", (number(2.0), make("inv", (make("add", (growth, number(1.0))),))))
                return make("sub", (number(1.0), part))
            case "log1p":
                return self.function("log", make("add", (number(1.0), args[0])))
            case "expm1":
                return make("sub", (self.function("exp", args[0]), number(1.0)))
        raise NoRule(f"{node.op}: the proof has no sound rule for this operation")

    def root(self, u: int, exponent: float) -> int:
        """Return u^e, e > 0 and no integer, which has no value for u < 0."""
        negative, no_value = self.make("lt", (u, self.number(0.0))), self.make("inv", (self.number(0.0),))
        return self.make("select", (negative, self.power(u, self.number(exponent), exponent), no_value))

    def logic(self, name: str, args: list[int]) -> int:
        """Return a logical operation; one that a known truth decides is that truth."""
        truths = [self.operations[a].value if self.operations[a].name == "truth" else None for a in args]
        if name == "not":
            return self.make(name, tuple(args)) if truths[0] is None else self.make("truth", (), not truths[0])
        decides = name == "or"
        if decides in truths:
            return self.make("truth", (), decides)
        return self.make(name, tuple(args)) if truths == [None, None] else args[truths[0] is not None]

    def division(self, x: int, y: int) -> int:
        """Return x/y; k u/(u + c) becomes k (1 - c/(u + c)), in which u occurs once. The slopes then do not cancel."""
        inverse, below = self.make("inv", (y,)), self.operations[y]
        above = self.operations[x]
        if below.name == "add":
            for u, c in (below.args, below.args[::-1]):
                if self.operations[c].name not in ("const", "param"):
                    continue
                if x == u or (above.name == "mul" and u in above.args):
                    share = self.make("sub", (self.number(1.0), self.make("mul", (c, inverse))))
                    factor = None if x == u else above.args[0] if above.args[1] == u else above.args[1]
                    product = share if factor is None else self.make("mul", (factor, share))
                    # The second is exactly 0 at u = 0.
                    return self.make("meet", (product, self.make("mul", (x, inverse))))
        return self.make("mul", (x, inverse))

    def extreme(self, minimum: bool, x: int, y: int) -> int:
        """Return the lesser or the greater of two operations, as a limit."""
        if self.operations[x].name == "const":
            x, y = y, x
        if self.operations[y].name == "const":
            if np.isinf(self.operations[y].value):
                return x if (self.operations[y].value > 0) == minimum else y
            low, high = (-1, y) if minimum else (y, -1)
            return self.make("clamp", (x, low, high))
        # min(x, y) = y + min(x - y, 0)
        gap, zero = self.make("sub", (x, y)), self.number(0.0)
        return self.make("add", (y, self.make("clamp", (gap, -1, zero) if minimum else (gap, zero, -1))))

    def selection(self, condition: int, no: int, yes: int) -> int:
        """Return a selection; the form x < low ? low : min(x, high) is a limit."""
        if no == yes:
            return no
        if self.operations[condition].name == "truth":
            return yes if self.operations[condition].value else no
        test, alternative = self.operations[condition], self.operations[no]
        if test.name == "lt" and test.args[1] == yes and self.operations[yes].name == "const":
            x, low = test.args
            if self.operations[low].value == -np.inf:
                return no
            limited = alternative.name == "clamp" and alternative.args[:2] == (x, -1)
            if limited and self.operations[low].value <= self.operations[alternative.args[2]].value:
                return self.make("clamp", (x, low, alternative.args[2]))
            if no == x:
                return self.make("clamp", (x, low, -1))
        return self.make("select", (condition, no, yes))


class Chart(NamedTuple):
    """The states of a braked wheel in a proof: slip [1], speed [m/s], distance [m]."""

    slip: Node
    speed: Node
    distance: Node


def _power_of(node: Node) -> tuple[Node, Node] | None:
    """Return base and exponent of a power as `core.numerics.power` writes it, which is 0 for base <= 0; else None.

    The form is base > 0 ? (base^2 != 0 ? exp(e (0.5 log(base^2 != 0 ? base^2 : 1))) : 0) : 0.
    """
    if (
        node.op != "select"
        or node.args[0].op != "lt"
        or not node.args[0].args[0].is_number(0)
        or not node.args[1].is_number(0)
    ):
        return None
    base, inner = node.args[0].args[1], node.args[2]

    def unguard(x: Node, otherwise: float) -> Node:
        """Return y if x has the form base^2 != 0 ? y : otherwise, else x itself."""
        if x.op != "select" or x.args[0].op != "ne" or not x.args[1].is_number(otherwise):
            return x
        sides = x.args[0].args
        is_asked = any(y.op == "mul" and y.args == (base, base) for y in sides) and any(y.is_number(0) for y in sides)
        return x.args[2] if is_asked else x

    inner = unguard(inner, 0)
    if inner.op != "exp" or inner.args[0].op != "mul":
        return None
    for exponent, scaled in (inner.args[0].args, inner.args[0].args[::-1]):
        if scaled.op == "mul" and any(x.is_number(0.5) for x in scaled.args):
            log = next(x for x in scaled.args if not x.is_number(0.5))
            square = unguard(log.args[0], 1) if log.op == "log" else log
            if log.op == "log" and square.op == "mul" and square.args == (base, base):
                return base, exponent
    return None


def _clock_of(loop: Loop) -> float | None:
    """Return the period of the loop's clock [s], or None; raise NoRule for events and for a second clock."""
    periods = set()
    for name in BLOCKS:
        block = getattr(loop, name)
        if type(block) is Sampled:  # a subclass may have events that count
            if float(block.delay) not in (0.0, float(block.period)):
                raise NoRule(f"{name}.delay = {float(block.delay):g} s: only 0 and the whole period have a rule")
        elif offers(block, "margins"):
            raise NoRule(f"{name} of type {type(block).__name__} has events; a proof has no rule for events")
        elif offers(block, "record"):
            raise NoRule(f"{name} of type {type(block).__name__} records a signal; a proof has no rule for that")
        if offers(block, "tick"):
            period = getattr(block, "period", None)
            if period is None:
                raise NoRule(
                    f"{name} of type {type(block).__name__} ticks with the integration grid, which a proof has not"
                )
            periods.add(float(period))
    if len(periods) > 1:
        raise NoRule(f"clocks of different periods: {', '.join(f'{x:g} s' for x in sorted(periods))}")
    return next(iter(periods), None)


def _is_traced(path: object, leaf: np.ndarray) -> bool:
    """Return whether a number of the loop is an input of its programs. Periods and delays of blocks are not."""
    words = _text(path).split(".")
    return np.asarray(leaf).dtype.kind == "f" and not (words[0] in BLOCKS and words[-1] in ("period", "delay"))


def graph_tangent(graph: Graph, root: Node, tangents: dict[int, Node]) -> Node:
    """Return the derivative of a node along the given derivatives of other nodes, by their number."""
    zero, op, derivatives = graph.const(0.0), graph.op, dict(tangents)

    def of(node: Node) -> Node:
        if node.id not in derivatives:
            derivatives[node.id] = derive(node)
        return derivatives[node.id]

    def derive(node: Node) -> Node:
        x, y = node.args[0] if node.args else node, node.args[-1] if node.args else node
        match node.op:
            case "const" | "input":
                return zero
            case "add" | "sub":
                return op(node.op, of(x), of(y))
            case "neg":
                return op("neg", of(x))
            case "mul":
                return op("add", op("mul", of(x), y), op("mul", x, of(y)))
            case "div":
                return op("div", op("sub", of(x), op("mul", node, of(y))), y)
            case "select" if node.dtype == np.float64:
                return graph.select(x, of(node.args[1]), of(y))
        raise NoRule(f"{node.op}: the proof has no derivative of it in the speeds of the plant")

    return of(root)


def nodes_below(root: Node) -> set[Node]:
    """Return a node, its operands, their operands, and so on."""
    nodes, pending = {root}, [root]
    while pending:
        new = set(pending.pop().args) - nodes
        nodes |= new
        pending += new
    return nodes


def _text(path: PyTree) -> str:
    return ".".join(str(getattr(key, "name", getattr(key, "key", getattr(key, "idx", key)))) for key in path)


def _state_names(paths: list[PyTree]) -> list[str]:
    """Return the names of states; the words flow and held stand only where two states would have one name."""
    full = [_text(path) for path in paths]
    short = [".".join(word for word in name.split(".") if word not in ("flow", "held")) for name in full]
    return [name if short.count(name) == 1 else whole for name, whole in zip(short, full, strict=True)]


def check_slip_chart(loop: Loop, over: Iterable[str] = ()) -> None:
    """Check that the plant's slip is 1 - w/v and its start has the slip and the speed asked for, in exact arithmetic.

    Both sides are evaluated in fractions. Speeds go from 2 cm/s to 200 m/s, slips from 0 to almost 1, and distances up
    to 10 km. The points are random, spread evenly over the decades of speed, and the ends of the ranges of speed and
    slip are among them. Parameters of the plant in `over` are multiplied by factors from 1e-6 to 1e6, both ends
    included.

    A wrong rational function agrees at a random point with a probability of nearly 0. A function with branches, such as
    max(v, 0.01), is wrong between two thresholds. It passes only if no point lies between them.
    """
    graph, paths = RealGraph(), [path for path in over if path.startswith("plant.")]
    inputs = [graph.input(np.float64, UpdateLevel.STEP, (STATE, i)) for i in range(3 + len(paths))]

    def show(speed: Scalar, slip: Scalar, distance: Scalar, *values: Scalar) -> Sequence[Scalar]:
        plant = replace(loop, dict(zip(paths, values, strict=True))).plant
        y = plant.output(plant.start(BrakeStart(speed=speed, slip=slip))._replace(distance=distance))
        return y.slip, y.speed, y.wheel_speed

    closed = jax.make_jaxpr(show)(*[jax.ShapeDtypeStruct((), np.float64)] * len(inputs))
    constants = [constant_array(graph, np.asarray(x)) for x in closed.consts]
    roots = [x.item() for x in lower_jaxpr(graph, closed.jaxpr, constants, [scalar_array(x) for x in inputs])]
    nominal = {path: Fraction(float(value) or 1.0) for path, _, value in parameters(loop) if path in paths}
    for speed, (slip,), distance, values in chart_points(1, [nominal[path] for path in paths]):
        numbers = [speed, slip, distance, *values]
        if exact_values(roots, {(STATE, i): x for i, x in enumerate(numbers)}) != [slip, speed, (1 - slip) * speed]:
            raise NoRule(f"plant {type(loop.plant).__name__}: its slip is not 1 - w/v at {float(speed):.3g} m/s")


def chart_points(
    slips: int, nominal: Sequence[Fraction]
) -> Iterator[tuple[Fraction, list[Fraction], Fraction, list[Fraction]]]:
    """Yield speed, slips, distance and parameters around nominal ones, at which a change of coordinates is checked."""
    draw = random.SystemRandom()  # a plant cannot know the points
    ends = (-CHART_DECADES, CHART_DECADES)
    points = [
        (speed, [slip] * slips, [x] * len(nominal))
        for speed in (SLOWEST, FASTEST)
        for slip in CHART_SLIPS
        for x in ends
    ]
    for _ in range(CHART_TRIALS):
        speed = min(max(Fraction(10 ** draw.uniform(-1.7, 2.3)).limit_denominator(10**9), SLOWEST), FASTEST)
        drawn = [Fraction(draw.randint(0, 10**6 - 1), 10**6) for _ in range(slips)]
        points.append((speed, drawn, [draw.uniform(*ends) for _ in nominal]))
    for speed, drawn, decades in points:
        values = [x * Fraction(10.0**decade) for x, decade in zip(nominal, decades, strict=True)]
        yield speed, drawn, Fraction(draw.randint(0, 10**7), 1000), values


def exact_values(roots: list[Node], inputs: Mapping[Any, Fraction]) -> list[Any]:
    """Return the values of nodes in fractions, from those of the inputs by their place."""
    exact: dict[int, Any] = {}

    def value(node: Node) -> Any:
        if node.id not in exact:
            exact[node.id] = compute(node)
        return exact[node.id]

    def compute(node: Node) -> Fraction | bool:
        if node.op == "const":
            return bool(node.attr) if node.dtype == bool else Fraction(float(node.attr))
        if node.op == "input":
            return inputs[node.attr]
        x = [value(arg) for arg in node.args]
        match node.op:
            case "add":
                return x[0] + x[1]
            case "sub":
                return x[0] - x[1]
            case "mul":
                return x[0] * x[1]
            case "div":
                return x[0] / x[1]
            case "neg":
                return -x[0]
            case "lt":
                return x[0] < x[1]
            case "le":
                return x[0] <= x[1]
            case "min" | "lower":
                return min(x)
            case "max" | "higher":
                return max(x)
            case "select":
                return x[2] if x[0] else x[1]
        raise NoRule(f"{node.op} in the slip of the plant")

    return [value(root) for root in roots]
