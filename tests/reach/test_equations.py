"""What the equations of a proof take for granted about a loop, and refuse where it does not hold."""

import dataclasses
import math
import operator
from fractions import Fraction
from types import MappingProxyType
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from mutants import killed_by

import diffabs as d
from diffabs.core.protocols import BrakeOutput
from diffabs.core.pytree import param, pytree, static
from diffabs.core.types import PyTree, Scalar
from diffabs.parts.plants import BrakeStart, QuarterCar
from diffabs.parts.references import Setpoint
from diffabs.parts.stops import NoStop
from diffabs.robust.reach import NoRule
from diffabs.robust.reach.engine import Prover
from diffabs.robust.reach.equations import Equations, derive_equations
from diffabs.scenario.scenario import load


@killed_by("robust.reach.equations", "for speed in (SLOWEST, FASTEST)", "for speed in (FASTEST,)")
def test_a_plant_whose_slip_is_another_one_at_low_speed_is_refused() -> None:
    """The slip of the rig is (v - w)/max(v, w, crawl speed)."""
    assert derive_equations(load("slip-lmi", integrated=False).loop, ["plant.mass"]).params == ("plant.mass",)
    for crawl in (0.02001, 3.0):
        with pytest.raises(NoRule, match=r"its slip is not 1 - w/v"):
            derive_equations(load("slip-lmi", [f"plant.crawl_speed={crawl}"], integrated=False).loop, ["plant.mass"])


@killed_by("robust.reach.equations", "check_slip_chart(self.loop, self.paths)", "check_slip_chart(self.loop)")
def test_a_parameter_of_the_box_must_not_change_the_slip() -> None:
    radii = ["plant.wheel_radius", "plant.body_radius"]
    assert derive_equations(load("slip-lmi", integrated=False).loop, radii).params == tuple(radii)
    with pytest.raises(NoRule, match=r"its slip is not 1 - w/v"):
        derive_equations(load("slip-lmi", integrated=False).loop, ["plant.crawl_speed"])


@killed_by(
    "robust.reach.equations", '"delay"):\n                raise', "):\n                raise", case="controller.delay"
)
@pytest.mark.parametrize("path", ["controller.period", "controller.delay"])
def test_a_range_of_periods_or_delays_is_refused(path: str) -> None:
    """The equations have one period, that of the scenario."""
    with pytest.raises(NoRule, match="range of periods or delays"):
        derive_equations(load("slip-cured", integrated=False).loop, [path])


# What a program says beside its values: derivatives that a part declares, the number of a tick, tests for NaN.


def value_at(equations: Equations, root: int, params: list[float], states: list[float]) -> float | bool:
    """Return the value of an operation in floats, NaN where it has none."""

    rules = {"add": operator.add, "sub": operator.sub, "mul": operator.mul, "neg": operator.neg}
    rules |= {"lt": operator.lt, "le": operator.le, "ne": operator.ne, "exp": math.exp, "log": math.log}
    rules |= {"inv": lambda x: 1 / x if x else math.nan, "meet": lambda x: x}

    def of(i: int) -> float | bool:
        o = equations.operations[i]
        if not o.args:
            return {"param": params, "state": states}[o.name][o.value] if o.name in ("param", "state") else o.value
        if o.name == "select":
            asked = of(o.args[0])
            return asked if math.isnan(asked) else of(o.args[2 if asked else 1])
        x = [of(a) for a in (o.args[:1] if o.name in ("exp", "log", "power", "meet", "clamp") else o.args)]
        if any(map(math.isnan, x)):
            return math.nan
        if o.name == "clamp":
            low, high = (of(a) if a >= 0 else end for a, end in zip(o.args[1:], (-math.inf, math.inf), strict=True))
            return min(max(x[0], low), high)
        return max(x[0], 0.0) ** of(o.args[2]) if o.name == "power" else rules[o.name](*x)

    return of(root)


@pytree
class StoppedQuarterCar(QuarterCar):
    """The same values; the derivatives that it declares of its speeds are 0."""

    def output(self, state: PyTree) -> BrakeOutput:
        return QuarterCar.output(self, jax.lax.stop_gradient(state))


@pytree
class MomentumQuarterCar(QuarterCar):
    """Its states are a fourth of the speeds, so its output divides."""

    def start(self, initial: BrakeStart) -> PyTree:
        x = QuarterCar.start(self, initial)
        return x._replace(speed=x.speed * 0.25, spin=x.spin * 0.25)

    def plain(self) -> QuarterCar:
        names = ("mass", "radius", "inertia", "crawl_speed", "road")
        return QuarterCar(**{name: getattr(self, name) for name in names})

    def full(self, state: PyTree) -> PyTree:
        return state._replace(speed=state.speed / 0.25, spin=state.spin / 0.25)

    def derivative(self, t: Scalar, state: PyTree, control: Scalar) -> PyTree:
        moved = self.plain().derivative(t, self.full(state), control)
        return moved._replace(speed=moved.speed * 0.25, spin=moved.spin * 0.25)

    def output(self, state: PyTree) -> BrakeOutput:
        return self.plain().output(self.full(state))


@killed_by("robust.reach.equations", 'op("sub", of(x), op("mul", node, of(y)))', "y", case="MomentumQuarterCar")
@killed_by("robust.reach.equations", "zip(inputs, rates, strict=True)", "zip(inputs, plant_nodes, strict=True)")
@pytest.mark.parametrize("plant", [StoppedQuarterCar, MomentumQuarterCar])
def test_rates_come_from_the_values_of_the_output(plant: type[QuarterCar]) -> None:
    """Not from the derivatives that a part declares, and whatever its states are."""
    e, other = (
        derive_equations(d.braking(plant=one(road=d.roads.DRY_ASPHALT)), ["plant.mass"]) for one in (QuarterCar, plant)
    )
    rng = np.random.default_rng(3)
    for _ in range(5):
        point = [rng.uniform(0.02, 0.6), rng.uniform(2.0, 30.0), *rng.uniform(0.0, 5.0, len(e.states) - 2)]
        for one, two in zip(e.flow, other.flow, strict=True):
            rate = value_at(e, one, [12.0], point)
            assert value_at(other, two, [12.0], point) == pytest.approx(rate, rel=1e-12, abs=1e-12)
        assert abs(value_at(e, e.flow[0], [12.0], point)) > 1e-6


NUMBERED = {
    "a played noise": load(
        "slip-cured", ["sensor=played-wheel-noise", "sensor.period=0.001", "sensor.noise=[0.0,0.1]"], integrated=False
    ).loop,
    "an encoder": load("slip-cured", ["sensor=encoder-slip", "sensor.period=0.001"], integrated=False).loop,
    "a played command": d.braking(controller=d.controllers.PlayedCommand(period=0.01, commands=np.arange(3.0))),
}


@killed_by("robust.reach.equations", "if not nodes_below(root).isdisjoint(grid):", "if False:", case="a played noise")
@pytest.mark.parametrize("name", NUMBERED)
def test_a_block_that_counts_its_ticks_is_refused(name: str) -> None:
    """The equations have one tick for all instants."""
    with pytest.raises(NoRule, match="number of its tick"):
        derive_equations(NUMBERED[name], ["plant.mass"])


@killed_by("robust.reach.equations", "period is not None and float(period) != loop_period", "False")
def test_an_inner_block_with_another_period_is_refused() -> None:
    inner = d.controllers.PlayedCommand(period=0.05)
    with pytest.raises(NoRule, match=r"different periods: 0\.01 s, 0\.05 s"):
        derive_equations(d.braking(controller=d.controllers.Sampled(controller=inner, period=0.01)), ["plant.mass"])


class OneOutput(NamedTuple):
    """A position [m]."""

    position: Scalar

    units = MappingProxyType({"position": "m"})


@pytree
class OneStart:
    """A position."""

    position: Scalar = param(default=0.5, unit="m")


@pytree
class OddPlant:
    """x' = formula(x, a, b, c)."""

    formula: Any = static(default=None)
    a: Scalar = param(default=1.0, unit="1")
    b: Scalar = param(default=1.0, unit="1")
    c: Scalar = param(default=1.0, unit="1")

    shows = OneOutput
    control_unit = "1"

    def start(self, initial: OneStart) -> OneOutput:
        return OneOutput(initial.position)

    def project(self, state: OneOutput) -> OneOutput:
        return state

    def output(self, state: OneOutput) -> OneOutput:
        return state

    def holding(self, output: OneOutput, target: Scalar) -> Scalar:
        return 0.0 * target

    def derivative(self, t: Scalar, state: OneOutput, control: Scalar) -> OneOutput:
        return OneOutput(self.formula(state.position, self.a, self.b, self.c))


def odd_loop(formula: Any, **values: float) -> d.Loop:
    """A loop in which nothing acts on the plant."""
    return d.Loop(
        plant=OddPlant(formula=formula, **values), initial=OneStart(), reference=Setpoint(),
        controller=d.controllers.ConstantTorque(), stop=NoStop(),
    )  # fmt: skip


def rate_of(formula: Any, x: float, **values: float) -> float | bool:
    """Return the rate of x' = formula(x, a, b, c) that the equations have, NaN where they have none."""
    e = derive_equations(odd_loop(formula, **values), ["plant.a"])
    return value_at(e, e.flow[0], [values.get("a", 1.0)], [x, 0.0, 0.0, 0.0])


@killed_by(
    "robust.reach.equations",
    'self.make("select", (negative, self.power(u, self.number(exponent), exponent), no_value))',
    "self.power(u, self.number(exponent), exponent)",
    case="root",
)
@killed_by("robust.reach.equations", 'make("lt", (make("mul", (args[0], number(0.0))), number(1.0)))',
           'make("truth", (), True)', case="test")  # fmt: skip
@killed_by("robust.reach.equations", "else 2.0 if node.op in SMALL else np.inf", "else 2.0", case="zero")
@killed_by(
    "robust.reach.equations",
    'case "const" if _is_finite(node):',
    'case "const" if node.attr == np.inf:\n                return 2.0\n            case "const":',
    case="times",
)
@pytest.mark.parametrize(
    "formula",
    [
        lambda x, a, b, c: jnp.sqrt(a - x),
        lambda x, a, b, c: jnp.where(jnp.isnan(jnp.sqrt(a - x)), 1.0, 2.0),
        lambda x, a, b, c: 0.0 * (1 / (x - 2)),
        lambda x, a, b, c: jnp.where(jnp.isfinite(1 / (x - 2)), 1.0, 2.0),
        lambda x, a, b, c: jnp.where(jnp.isfinite(jnp.where(x > 1, jnp.inf, x)), 1.0, 2.0),
        lambda x, a, b, c: 0.0 * jnp.where(x > 1, jnp.inf, x),
    ],
    ids=["root", "test", "zero", "finite", "infinite", "times"],
)
def test_a_number_without_a_value_has_none(formula: Any) -> None:
    """At x = 2 the root is of -1, the division is by 0, and the infinite number is no real one."""
    assert math.isfinite(rate_of(formula, 0.5))
    assert math.isnan(rate_of(formula, 2.0))


@pytest.mark.usefixtures("native_prover")
@killed_by(
    "robust.reach.equations", "math.exp(sizes[0]) if sizes[0] < MAX_EXPONENT else np.inf", "2.0", case="times exp"
)
@killed_by("robust.reach.equations", "return sizes[0] * sizes[1]", "return 2.0", case="times square")
@pytest.mark.parametrize(
    ("formula", "x"),
    [
        (lambda x, a, b, c: 0.0 * jnp.exp(x), 1000.0),
        (lambda x, a, b, c: jnp.exp(x) - jnp.exp(x), 710.0),
        (lambda x, a, b, c: 0.0 * jnp.exp(-x), -1000.0),
        (lambda x, a, b, c: 0.0 * (x * x * x), 1e110),
        (lambda x, a, b, c: jnp.where(jnp.isfinite(jnp.exp(x)), 1.0, 2.0), 1000.0),
    ],
    ids=["times exp", "difference", "times exp of minus", "times square", "test"],
)
def test_a_number_that_no_double_holds_has_no_value(formula: Any, x: float) -> None:
    """The program computes NaN, or takes the other branch, and a proof must not fold that to 0 or to a truth."""
    program = float(jax.jit(lambda x: formula(x, 1.0, 1.0, 1.0))(x))
    assert np.isnan(program) or program == 2.0
    loop = d.replace(odd_loop(formula), {"initial.position": x})
    equations = derive_equations(loop, ["plant.a"])
    found = Prover(equations, ("position",), 1e-3).prove(np.array([[[1.0, 1.1]]]), 1)
    assert found.status[0] == 0
    checker = pytest.importorskip("diffabs.robust.reach.checker")
    with pytest.raises(checker.NotProved, match="no finite value"):
        checker.check_cell(equations, ["position"], [(1.0, 1.1)], steps=[1e-3], horizon=1e-3)


@killed_by("robust.reach.equations", "return x.args[2] if is_asked else x", "return x.args[2]")
def test_a_power_with_another_condition_is_no_power() -> None:
    """The form of `core.numerics.power`, whose inner condition asks something else."""

    def gate(x: Scalar, a: Scalar, b: Scalar, c: Scalar) -> Scalar:
        return jnp.where(x > 0, jnp.where(a != 0, jnp.exp(b * (0.5 * jnp.log(x * x))), 0.0), 0.0)

    assert rate_of(gate, 0.7, a=0.0, b=3.0) == 0.0
    assert rate_of(gate, 0.7, a=1.0, b=3.0) == pytest.approx(0.7**3)


@killed_by("robust.reach.equations", 'np.asarray(leaf).dtype.kind == "f" and not', "False and not")
def test_numbers_of_the_loop_are_not_rounded_by_numpy() -> None:
    """In doubles a b - c is 0; exactly it is 0.18."""
    a, b, c = 94906267.3, 94906271.1, 9007199933462864.0
    exact = float(Fraction(a) * Fraction(b) - Fraction(c))
    assert a * b - c == 0.0 < exact
    loop = odd_loop(lambda x, a, b, c: a * b - c, a=a, b=b, c=c)
    names = [o.name for o in derive_equations(loop, ["initial.position"]).operations]
    assert "mul" in names
    assert "sub" in names


@killed_by("robust.reach.equations", "return _is_finite(node) and Fraction(repr(float(node.attr)))",
           "return _is_finite(node) and Fraction(float(node.attr))")  # fmt: skip
def test_a_difference_of_two_decimals_is_not_folded() -> None:
    """0.3 - 0.2 is exact in doubles, 0.09999999999999998; the decimals have the difference 0.1."""
    e = derive_equations(odd_loop(lambda x, a, b, c: a - b, a=0.3, b=0.2), ["initial.position"])
    assert e.operations[e.flow[0]].name == "sub"


@killed_by("robust.reach.equations", "if node.dtype not in (np.float64, np.bool_) and", "if False and")
def test_integers_are_refused() -> None:
    """An unsigned 0 - 1 is 255."""
    loop = odd_loop(lambda x, a, b, c: ((x > 1).astype(jnp.uint8) - jnp.uint8(1)).astype(float))
    with pytest.raises(NoRule, match="type uint8"):
        derive_equations(loop, ["initial.position"])


def chain(x: Scalar, a: Scalar) -> Scalar:
    """Return a + x/2 400 times: 2 a, by a chain of operations."""
    for _ in range(400):
        x = a + 0.5 * x
    return x


@pytree
class ChainTorque(d.controllers.ConstantTorque):
    """The torque 2 a."""

    def output(self, t: Scalar, memory: Any, signal: Any) -> Scalar:
        return chain(signal.measured[0], 0.5 * super().output(t, memory, signal))


def test_a_controller_may_have_a_long_chain_of_operations() -> None:
    loop = dataclasses.replace(load("slip-lmi", integrated=False).loop, controller=ChainTorque())
    assert len(derive_equations(loop, ["plant.mass"]).operations) > 800


def test_a_question_about_the_end_of_a_long_chain_is_refused() -> None:
    with pytest.raises(NoRule, match="too long a chain of operations") as found:
        rate_of(lambda x, a, b, c: jnp.where(jnp.isfinite(chain(x, a)), 1.0, 2.0), 0.5)
    assert isinstance(found.value.__cause__, RecursionError)  # shows where, if a user's part has no end
