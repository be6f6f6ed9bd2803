"""Comparisons made visible, held and located: against the functions themselves, closed forms, and differences."""

from collections.abc import Callable
from types import MappingProxyType
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conditional import ConditionalIntegration
from marks import cases
from mutants import killed_by

import diffabs as d
from diffabs.core.numerics import quotient, searchsorted
from diffabs.core.pytree import param, pytree, static
from diffabs.engine.step.comparisons import SwitchedProgram
from diffabs.engine.step.modes import Mode, find_contradicted
from diffabs.loop.closed_loop import Loop
from diffabs.parts.actuators import Delay, Lag
from diffabs.parts.controllers import (
    PID,
    Clamping,
    ConstantTorque,
    HoldingInput,
    Sampled,
    ScheduledFeedback,
    StateFeedback,
)
from diffabs.parts.objectives import IAE, Effort, FinalError
from diffabs.parts.plants import LabRig, MirroredRig
from diffabs.parts.references import FixedSlip, Setpoint
from diffabs.parts.roads import DRY_ASPHALT
from diffabs.parts.stops import SpeedReached
from diffabs.scenario.defaults import braking

KNOTS = np.array([-1.0, 0.0, 0.5, 2.0, 3.0])
POINTS = (-3.0, -1.0, -0.3, 0.0, 0.2, 0.7, 1.0, 2.5, 9.0)
KINKED: dict[str, tuple[Callable[[Any, Any], Any], int]] = {  # of x, which moves, and p; how many comparisons
    "gt": (lambda x, p: jnp.where(x > p, x * x, x), 1),
    "ge": (lambda x, p: jnp.where(x >= p, x * x, x), 1),
    "lt": (lambda x, p: jnp.where(x < p, x * x, x), 1),
    "le": (lambda x, p: jnp.where(p <= x, x * x, x), 1),
    "one margin": (lambda x, p: jnp.where(x > p, x * x, x) + jnp.where(p < x, 1.0, 0.0), 1),
    "a contrary": (lambda x, p: jnp.where(x > p, x * x, x) + jnp.where(x <= p, 1.0, 0.0), 1),
    "max": (lambda x, p: jnp.maximum(x, p), 1),
    "min": (lambda x, p: jnp.minimum(x, p), 1),
    "abs": (lambda x, p: jnp.abs(x - p), 1),
    "sign": (lambda x, p: jnp.sign(x - p), 2),
    "clip": (lambda x, p: jnp.clip(x, -p, p), 2),
    "clamp": (lambda x, p: jax.lax.clamp(-p, x, p), 2),
    "vector": (lambda x, p: jnp.sum(x * jnp.where(x > p * KNOTS, 1.0, 0.5)), 5),
    "many": (lambda x, p: jnp.sum(jnp.where(x > p * jnp.linspace(-2.0, 3.0, 70), 1.0, 0.5)), 70),
    "search": (lambda x, p: jnp.arange(6.0)[searchsorted(jnp.asarray(KNOTS), x)] * p, 5),
    "search of JAX": (lambda x, p: jnp.arange(6.0)[jnp.searchsorted(jnp.asarray(KNOTS), x, side="right")] * p, 5),
    "a function with its own rule": (lambda x, p: quotient(jnp.maximum(x, p), p), 1),
    "within jit": (jax.jit(lambda x, p: jnp.where(x > p, 2.0, 1.0)), 1),
    "of what is fixed": (lambda x, p: jnp.where(p > 0.3, x, -x), 0),
    "of equality": (lambda x, p: jnp.where(x == p, 1.0, x), 0),
    "of integers": (lambda x, p: jnp.where(x.astype(int) > 1, 1.0, x), 0),
    "a conditional": (lambda x, p: jax.lax.cond(x > p, lambda: x * x, lambda: x), 1),
    "in one of three": (
        lambda x, p: jax.lax.switch((p > 0.3).astype(int), [jnp.abs, lambda x: jnp.maximum(x, p), jnp.sign], x),
        4,
    ),
    "relu": (lambda x, p: jax.nn.relu(x - p), 1),
    "the greatest": (lambda x, p: jnp.max(x * jnp.array([1.0, -2.0, 0.5]) - p), 2),
    "the least of columns": (lambda x, p: jnp.sum(jnp.min(x * jnp.array([[1.0, -2.0], [0.5, 3.0]]) - p, axis=0)), 2),
    "an angle": (lambda x, p: jnp.arctan2(p - x, jnp.where(p > 0.3, -1.0, x)).astype(np.float32), 1),
    "of a smooth function": (lambda x, p: jax.nn.softplus(x - p), 0),
    "in a loop": (lambda x, p: jax.lax.fori_loop(0, 2, lambda _, y: jnp.where(y > p, y, 2.0 * y), x), 0),
}


def program(f: Callable[[Any, Any], Any]) -> SwitchedProgram:
    """Of the whole function."""
    return SwitchedProgram(f, jnp.asarray(0.1), jnp.asarray(0.6), lambda out: out)


def held(one: SwitchedProgram, x: float, p: float = 0.6) -> Mode:
    """The answers at x."""
    return Mode(one.look(lambda out: out, x, p, Mode(None))[1].words)


def same(out: Any) -> Any:
    """The output."""
    return out


@killed_by(
    "engine.step.comparisons",
    "key = (y, x, not strict) if turned else (x, y, strict)",
    "key = (x, y, strict)",
    case="a contrary",
)
@killed_by("engine.step.comparisons", "asks = name if moves and real", "asks = name if real", case="of what is fixed")
@pytest.mark.parametrize(
    "name", cases(KINKED, "in a loop", "in one of three", "a conditional", "many", "the least of columns", "vector")
)
def test_a_program_is_the_function(name):
    f, count = KINKED[name]
    one = program(f)
    assert sum(int(np.prod(shape)) for _, shape in one.places) == count
    free = held(one, 0.1)._replace(free=True)
    for x in POINTS:
        value = f(jnp.asarray(x), jnp.asarray(0.6))
        for regime in (Mode(None), held(one, x), free):
            np.testing.assert_array_equal(one(same, x, 0.6, regime), value)


@pytest.mark.parametrize(
    ("name", "at", "beyond", "value", "slope"),
    [("gt", 0.1, 2.0, 2.0, 1.0), ("gt", 1.0, 0.1, 0.01, 0.2), ("max", 2.0, 0.1, 0.1, 1.0), ("min", 2.0, 0.1, 0.6, 0.0)]
    + [("abs", 1.0, 0.1, -0.5, 1.0), ("clip", 0.1, 2.0, 2.0, 1.0), ("clamp", 3.0, 0.1, 0.6, 0.0)]
    + [("search", 0.1, 9.0, 2 * 0.6, 0.0), ("vector", 0.1, 9.0, 9.0 * (3 * 0.5 + 2.0), 3.5)],
)
def test_a_regime_goes_on_beyond_its_kinks(name, at, beyond, value, slope):
    one = program(KINKED[name][0])
    regime = held(one, at)
    found, move = jax.jvp(lambda x: one(same, x, jnp.asarray(0.6), regime), (jnp.asarray(beyond),), (jnp.asarray(1.0),))
    np.testing.assert_allclose([found, move], [value, slope], rtol=1e-15)


@pytest.mark.slow
@killed_by("engine.step.modes", "against = margin < -_rounding_error(x)", "against = margin < -jnp.inf", case="gt")
@pytest.mark.parametrize("name", [name for name, (_, count) in KINKED.items() if count])
def test_who_looks_sees_what_is_contradicted_and_by_how_much(name):
    f, _ = KINKED[name]
    one = program(f)
    for x in (-3.0, 0.2, 9.0):
        regime = held(one, x)
        answers = one.look(same, x, 0.6, regime)[1]
        assert not any(answers.contradicted)
        assert answers.words == regime.words
        for y in (-2.7, 0.31, 2.2, 8.0):
            answers = one.look(same, y, 0.6, regime)[1]
            contrary = [a ^ b for a, b in zip(regime.words, held(one, y).words, strict=True)]
            assert any(answers.contradicted) == any(contrary)
            other, crossed, chosen, margin = find_contradicted(answers, jnp.asarray(0), jnp.asarray(y))
            assert bool((other >= 0) | crossed) == any(contrary)
            if any(contrary):
                assert int(contrary[int(chosen) // 32]) >> (int(chosen) % 32) & 1
                assert margin < 0
        gives_way = regime._replace(released=(~jnp.uint32(0),) * one.word_count, free=jnp.asarray(True))
        value, answers = one.look(same, 2.2, 0.6, gives_way)
        np.testing.assert_array_equal(value, f(jnp.asarray(2.2), jnp.asarray(0.6)))
        assert answers.words == held(one, 2.2).words


@killed_by("engine.step.modes", "jnp.where(below > 0, first + below - 1, NO_BIT)", "first + below - 1")
def test_a_search_below_all_knots_has_one_side():
    """Bit 0 is max(x, p), the next five are the knots. Below all knots the search has no lower side."""
    one = program(lambda x, p: jnp.maximum(x, p) + jnp.arange(6.0)[searchsorted(jnp.asarray(KNOTS) + 10.0, x)])
    answers = one.look(same, 0.5, 0.6, held(one, 0.7))[1]
    found = find_contradicted(answers, jnp.asarray(0), jnp.asarray(0.5))
    assert found[1]
    assert found[3] == pytest.approx(-0.1)


@killed_by("engine.step.inner_functions", '"remat", "remat2", ', "")
def test_a_comparison_within_a_checkpoint_is_seen():
    assert program(jax.checkpoint(lambda x, p: jnp.maximum(x, p))).bit_count == 1


@killed_by("engine.step.inner_functions", "jax.lax.stop_gradient(x), x) if _is_real(x)", "x, x) if _is_real(x)")
def test_a_branch_that_is_not_taken_has_no_infinite_derivative():
    def root(x: Any, p: Any) -> Any:
        return jax.lax.cond(x > p, lambda x: jnp.abs(x) * jnp.sqrt(x - p), lambda x: x, x)

    one = program(root)
    assert jax.grad(lambda x: one(same, x, jnp.asarray(0.6), held(one, 0.1)))(0.6) == 1.0


def test_what_a_loop_hides_is_told():
    """Of numbers that move, in whatever turn, and that count; what a loop compares of others is not hidden."""

    def turns(x: Any, p: Any) -> Any:
        late = jax.lax.fori_loop(0, 3, lambda _, both: (both[1] > p, x * x), (p > 0.1, p))[1]
        return late, jax.lax.fori_loop(0, 3, lambda i, y: jnp.where(p > 0.1 * i, y, 2.0 * y), x)

    assert [(one.name, one.function) for one in program(turns).hidden] == [("gt", "scan")]
    one = SwitchedProgram(turns, jnp.asarray(0.1), jnp.asarray(0.6), lambda out: out[1])
    assert one.hidden == []


@killed_by("engine.step.modes", "limits.eps**ROUNDING_POWER *", "0.0 *")
def test_numbers_that_are_equal_to_rounding_say_nothing():
    one = program(lambda x, p: jnp.where(x > p, 1.0, 0.0))
    regime = held(one, 0.1)
    for excess, sees in ((1e-14, False), (1e-9, True)):
        assert any(one.look(same, 0.6 + excess, 0.6, regime)[1].contradicted) == sees


@killed_by("engine.step.modes", "against |= gives & (margin == 0) & (says() != answer)", "pass")
def test_a_product_that_has_become_0_is_held_by_nobody():
    """(x - min(x, p)) x > 0 above p, and 0 > 0 below, which contradicts nobody: it gives way all the same."""
    one = program(lambda x, p: jnp.where((x - jnp.minimum(x, p)) * x > 0, 1.0, 0.0))
    above = held(one, 2.0)
    gives_way = above._replace(released=(~jnp.uint32(0),) * one.word_count)
    assert one.look(same, 2.1, 0.6, gives_way)[0] == 1
    value, answers = one.look(same, 0.5, 0.6, gives_way)
    assert value == 0
    assert answers.words == held(one, 0.5).words
    assert not any(answers.contradicted)


class Shown(NamedTuple):
    """What a plant of two numbers shows."""

    y: Any
    x: Any

    units = MappingProxyType({"y": "m", "x": "m"})


@pytree
class Clockwork:
    """x' = 1, y' = rate(x): what a kink at x = place does is known."""

    place: Any = param(default=0.3337, unit="m")
    rate: Callable[[Any, Any], Any] = static(default=jnp.maximum)

    shows = Shown
    control_unit = "N"

    def start(self, initial: Any) -> Shown:
        return Shown(0.0 * initial, initial)

    def derivative(self, t: Any, state: Shown, control: Any) -> Shown:
        return Shown(self.rate(state.x, self.place), 1.0 + 0.0 * control)

    def project(self, state: Shown) -> Shown:
        return state

    def output(self, state: Shown) -> Shown:
        return state

    def holding(self, output: Shown, target: Any) -> Any:
        return 0.0 * target


@pytree
class Never:
    """No stop."""

    success = False

    def margin(self, output: Shown) -> Any:
        return 1.0 + 0.0 * output.y

    def remainder(self, sample: Any, stopped: Any) -> tuple[Any, Any]:
        return 0.0 * sample.t, 0.0 * sample.t


END = 1.0
CLOSED = {  # rate of y, y(END) as a function of the kink's place
    "a corner": (lambda x, a: jnp.where(x > a, x - a, 0.0), lambda a: (END - a) ** 2 / 2),
    "a jump": (lambda x, a: jnp.where(x > a, 2.0, 1.0), lambda a: a + 2 * (END - a)),
    "two at once": (
        lambda x, a: jnp.where(x > a, 2.0, 1.0) + jnp.abs(x - a),
        lambda a: 2 - a + (a**2 + (1 - a) ** 2) / 2,
    ),
    "two in a step": (
        lambda x, a: jnp.where(x > a, 2.0, 1.0) * jnp.where(x < a + 0.003, 1.0, 3.0),
        lambda a: a + 2 * 0.003 + 6 * (END - a - 0.003),
    ),
    "a table": (lambda x, a: jnp.array([1.0, 4.0, 2.0])[searchsorted(jnp.stack([a, 2 * a]), x)], lambda a: 2 + a),
    "of time": (lambda x, a: 1.0 + jnp.minimum(a, 0.2), lambda a: 1.0 + jnp.minimum(a, 0.2)),
    "of a place where a number ends": (lambda x, a: jnp.where(x < a, jnp.sqrt(a - x), 0.0), lambda a: a**1.5 * 2 / 3),
}


def clockwork(rate: Any, place: Any) -> Loop:
    """A loop that turns."""
    return Loop(
        plant=Clockwork(place=place, rate=rate),
        initial=jnp.asarray(0.0),
        reference=Setpoint(value=0.0),
        controller=ConstantTorque(torque=0.0),
        stop=Never(),
    )


@pytest.mark.slow
@killed_by(
    "engine.step.modes",
    "next = below + jnp.where(high < -_rounding_error(x), 1, 0) - jnp.where(low < -_rounding_error(x), 1, 0)",
    "next = below",
    case="a table",
)
@killed_by(
    "engine.step.fixed",
    "dataclasses.replace(self._resolve(KEPT_MODES), second_order=True)",
    "dataclasses.replace(self._resolve(FREE_MODES), second_order=True)",
    case="a jump",
)
@pytest.mark.parametrize("name", CLOSED)
def test_a_derivative_through_a_kink_is_that_of_the_closed_form(name):
    """However long the step: 10 ms here, and a derivative that misses a jump is 0."""
    rate, exact = CLOSED[name]

    def final(place: Any) -> Any:
        return d.measure(clockwork(rate, place), d.FixedStep(0.01, END, kinks=True), {"y": FinalError()}).metrics["y"]

    place = jnp.asarray(0.3337)
    wanted = jax.value_and_grad(exact)(place)
    found = jax.jvp(final, (place,), (jnp.ones_like(place),))
    # a root has an order of three halves, its derivative one of a half
    tolerance = [1e-3, 0.1] if name == "of a place where a number ends" else [1e-8, 1e-8]
    assert (np.abs(np.subtract(found, wanted)) <= np.multiply(tolerance, np.maximum(np.abs(wanted), 0.1))).all()
    if name == "two in a step":
        np.testing.assert_allclose(final(place), wanted[0], rtol=1e-8)
        np.testing.assert_allclose(jax.grad(final)(place), wanted[1], rtol=1e-8)


@pytest.mark.slow
@killed_by("engine.step.event_location", "& (nearer[0] != place)", "& False")
def test_a_step_ends_on_a_comparison_near_the_start():
    """At rest all comparisons of a run are near their zeros. A probe for one of them would lie before the first step,
    where another one changes: then the backward pass would be of no number, where the run and its tangents are.

    One margin rises before it falls, so that no parabola reaches from its zero to the end of the step."""
    loop = braking(
        plant=MirroredRig(),
        controller=ScheduledFeedback(
            speeds=(1.4, 14.0), integral_gains=(-300.0, -3e3), gains=(-6.0, -60.0), low=0.0, high=9.03
        ),
        feedforward=HoldingInput(),
        actuator=Lag(time_constant=1e-3),
        initial=d.BrakeStart(speed=2.5),
    )
    solver = d.FixedStep(step=1e-3, duration=0.004, kinks=True)

    def iae(gains: Any) -> Any:
        return d.measure(d.replace(loop, {"controller.gains": gains}), solver, {"iae": IAE()}).metrics["iae"]

    gains = jnp.array([-6.0, -60.0])
    moves = 1e-3 * np.diag(gains)
    ahead, behind = jax.jit(jax.vmap(iae))(gains + np.concatenate([moves, -moves])).reshape(2, 2)
    found = jax.jit(jax.jacrev(iae))(gains)
    np.testing.assert_allclose(found, (ahead - behind) / np.diag(2 * moves), rtol=1e-6)
    np.testing.assert_allclose(found, jax.jit(jax.jacfwd(iae))(gains), rtol=1e-12)


@pytest.mark.slow
@killed_by(
    "engine.step.switching",
    "decision.searches & (after.search.number < system.bit_count)",
    "False",
)
def test_a_run_that_slides_along_a_kink_is_a_run():
    """x' = -sign(x - a) + 0.3: nobody can follow each switch; it stays within a step of the place, and says so."""

    def slides(place: Any) -> Any:
        loop = clockwork(lambda x, a: 0.0 * x, place)
        plant = Sliding(place=loop.plant.place)
        return d.measure(
            d.Loop(**{**vars(loop), "plant": plant}), d.FixedStep(0.01, END, kinks=True), {"y": FinalError()}
        )

    run = jax.vmap(slides)(jnp.array([0.2, 0.4]))
    assert not run.diverged.any()
    np.testing.assert_allclose(run.metrics["y"], [0.2, 0.4], atol=0.02)


@pytest.mark.slow
@killed_by(
    "engine.step.fixed",
    "valid &= carry.unrestricted | request.mode.slides | _is_plausible(carry, attempt)",
    "pass",
)
def test_where_a_step_is_too_long_a_regime_is_not_believed():
    """Below its crawl speed a wheel is stiffer than any step, and a curve of friction beyond its kinks has no bound."""
    loop = braking(
        plant=LabRig(road=DRY_ASPHALT),
        initial=d.BrakeStart(speed=3.0),
        controller=ConstantTorque(torque=0.8),
        stop=SpeedReached(speed=1e-9),
    )
    run = d.rollout(loop, d.FixedStep(1e-4, 0.4, every=5, kinks=True))
    energy = np.asarray(jax.vmap(loop.plant.energy)(run.trajectory.state))
    assert not run.diverged
    assert energy[-1] < 1e-3 * energy[0]
    assert np.all(np.diff(energy) <= 1e-6 * energy[0])


@pytree
class Sliding(Clockwork):
    """y' = 0.3 - sign(y - place)."""

    def derivative(self, t: Any, state: Shown, control: Any) -> Shown:
        return Shown(0.3 - jnp.where(state.y > self.place, 1.0, -1.0), 1.0 + 0.0 * control)


@pytest.mark.slow
def test_an_integral_that_was_clamped_goes_on():
    """Beside a derivative the run is that of the values, to the kinks' own error: the torque leaves its limit, and the
    integral moves again."""
    loop = braking(
        plant=MirroredRig(),
        initial=d.BrakeStart(speed=11.0, slip=0.03),
        reference=FixedSlip(slip=0.15),
        controller=StateFeedback(gain=np.array([-3000.0, -60.0]), low=0.2, high=4.3, antiwindup=Clamping()),
        stop=SpeedReached(speed=6.5),
    )
    plain, located = (
        d.measure(loop, d.FixedStep(1e-4, 1.0, kinks=kinks), {"iae": IAE()}).metrics["iae"] for kinks in (False, True)
    )
    np.testing.assert_allclose(located, plain, rtol=1e-3)


def integrating(late: float) -> tuple[Loop, float]:
    """The error falls in proportion to the time, and the torque with it, from its limit inwards: from that moment on
    the integral grows. The command comes out `late`. The integral of its square, too."""
    setpoint, kp, ki, most = 1.7337, 2.0, 1.0, 2.0
    error, leaves = np.poly1d([-1.0, setpoint]), setpoint - most / kp
    integral = error.integ() - error.integ()(leaves)
    square = ((kp * error + ki * integral) ** 2).integ()
    loop = clockwork(lambda x, a: 1.0 + 0.0 * x, jnp.asarray(0.0))
    pid = PID(kp=kp, ki=ki, high=most, antiwindup=ConditionalIntegration(), low=0.0)
    parts = {"controller": pid, "reference": Setpoint(value=setpoint)}
    parts |= {"actuator": Delay(time=late, capacity=128)} if late else {}
    return Loop(**{**vars(loop), **parts}), most**2 * leaves + square(END - late) - square(leaves)


@killed_by("engine.step.fixed", "KEPT_MODES if hybrid.jumps else FREE_MODES", "FREE_MODES")
@pytest.mark.parametrize("late", [0.0, pytest.param(0.0337, marks=pytest.mark.slow)])
def test_where_a_rate_jumps_a_value_is_right_too(late):
    """An integral that waits for a limit starts at once when the limit is left: in the middle of a step of 10 ms, which
    is off by as much as it is long unless it ends there."""
    loop, expected = integrating(late)
    found = d.measure(loop, d.FixedStep(0.01, END), {"effort": Effort()}).metrics["effort"]
    np.testing.assert_allclose(found, expected, rtol=1e-8)
    held = Loop(**{**vars(loop), "controller": Sampled(controller=loop.controller, period=0.02)})
    assert loop.jumps
    assert not held.jumps  # nothing in it is integrated


@pytree
class DeclaredFeedforward:
    jumps = True

    def input(self, plant, measured, setpoint):
        return jnp.where(setpoint > 0.0, 1.0, 0.0)


@killed_by("loop.closed_loop", 'for name in ("plant", "feedforward", *BLOCKS))', 'for name in ("plant", *BLOCKS))')
def test_an_output_that_jumps_makes_the_plants_rate_jump():
    """Also if the part integrates nothing itself."""
    loop, _ = integrating(0.0)
    plain = Loop(**{**vars(loop), "controller": PID()})
    memoryless = type("DeclaredTorque", (ConstantTorque,), {"jumps": True})
    assert not plain.jumps
    assert Loop(**{**vars(plain), "feedforward": DeclaredFeedforward()}).jumps
    assert Loop(**{**vars(plain), "controller": memoryless()}).jumps


@pytree
class Pulsed(Clockwork):
    """y' = 1, and 3 from an instant to another one, both known in advance."""

    jumps = True

    def derivative(self, t: Any, state: Shown, control: Any) -> Shown:
        on = (t > self.place) & (t < self.place + 0.2)
        return Shown(jnp.where(on, 3.0, 1.0) + 0.0 * control, 1.0 + 0.0 * control)


@pytest.mark.slow
@pytest.mark.parametrize(("solver", "off"), [(d.FixedStep(0.01, END), 1e-7), (d.Adaptive(1e-5, END, 0.01), 3e-5)])
def test_a_pulse_begins_and_ends_at_its_instants(solver, off):
    """Also where the end of the run cuts it off; on the grid and off it. Adaptive values see the jump as an error."""

    def final(place: Any) -> Any:
        loop = clockwork(jnp.maximum, place)
        loop = Loop(**{**vars(loop), "plant": Pulsed(place=place)})
        return d.measure(loop, solver, {"y": FinalError()}).metrics["y"]

    for place, slope in ((0.3337, 0.0), (0.3, 0.0), (0.9, -2.0), (0.87654321, -2.0)):
        exact = END + 2.0 * min(0.2, END - place)
        np.testing.assert_allclose(jax.jit(final)(place), exact, rtol=off)
        found = jax.jvp(jax.jit(final), (place,), (1.0,))
        np.testing.assert_allclose(found, [exact, slope], rtol=off, atol=off)
