"""Solutions of any field: examples of threads in which others ask for them, and what cannot be computed.

Every example has a closed form. A program takes seconds to compile, so the fast tests share few fields."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pages
import pytest
import random_fields
from mutants import killed_by
from project import ROOT

import diffabs as d
from diffabs.compiler.ir import UpdateLevel
from diffabs.compiler.passes import find_lane_calls
from diffabs.compiler.schedule import schedule_nodes
from diffabs.engine.drive.deferred import find_kernels
from diffabs.engine.drive.engine import EngineError
from diffabs.engine.field import SolutionStatus
from diffabs.engine.interop import field_of

ADAPTIVE = d.Adaptive(1e-9)
GRAVITY = 9.81


def fall(t, y, args):
    """A ball that falls: (height, speed)."""
    del t
    return y[1], -args["gravity"]


GROUND = d.Event(lambda t, y, args: y[0], lambda t, y, args: (y[0], -args["keep"] * y[1]))


def bounce(keep, end=2.0, **more):
    return d.solve(fall, (1.0, 0.0), 0.0, end, {"gravity": GRAVITY, "keep": keep}, events=[GROUND], **more)


def height_after_two(keep):
    """Return the height at 2 s and its derivative by `keep`: in flight after three bounces for 0.75 < keep < 0.9."""
    first = jnp.sqrt(2 / GRAVITY)

    def at(keep):
        left = 2.0 - first - 2 * first * keep - 2 * first * keep**2
        return keep**3 * GRAVITY * first * left - GRAVITY * left**2 / 2

    return at(keep), jax.grad(at)(keep)


@pytest.mark.slow
@killed_by("engine.field", "held.counts + events,", "held.counts,")
def test_events_that_do_not_end_a_run():
    """https://github.com/patrick-kidger/diffrax/issues/13: a bouncing ball, in one solve and differentiable."""
    found = jax.jit(jax.vmap(lambda keep: bounce(keep, solver=ADAPTIVE)))(jnp.array([0.8, 0.85]))
    truth = [height_after_two(keep)[0] for keep in (0.8, 0.85)]
    np.testing.assert_allclose(found.y[0], truth, atol=1e-6)
    assert found.events.counts.tolist() == [[3], [3]]
    first = np.sqrt(2 / GRAVITY)
    np.testing.assert_allclose(found.events.times[0, 0, :3], first * np.array([1, 2.6, 2.6 + 1.28]), atol=1e-7)
    assert np.isnan(found.events.times[0, 0, 3])


@pytest.mark.slow
@pytest.mark.parametrize("solver", [ADAPTIVE, d.FixedStep(1e-2)], ids=["adaptive", "fixed"])
def test_a_bounce_has_derivatives_in_both_modes(solver):
    def height(keep):
        return bounce(keep, solver=solver).y[0]

    truth = height_after_two(0.8)[1]
    assert abs(jax.grad(height)(0.8) - truth) < 1e-6
    assert abs(jax.jacfwd(height)(0.8) - truth) < 1e-6
    for width in (1e-3, 1e-4, 1e-5):
        difference = (height(0.8 + width) - height(0.8 - width)) / (2 * width)
        assert abs(difference - truth) < 1e-6 + 100 * width**2


def steps(t, y, args):
    """A rate that is `up` until the time `switch` and `down` afterwards, not declared."""
    del y
    return jnp.piecewise(t, [t <= args["switch"], t > args["switch"]], [args["up"], args["down"]])


@pytest.mark.slow
@killed_by("engine.step.replay", "close = on & (", "close = on & False & (")
def test_the_time_of_a_switch_has_a_derivative():
    """https://github.com/patrick-kidger/diffrax/issues/363: dy/d(switch) of a piecewise field was zero."""

    def final(switch):
        return d.solve(steps, 0.0, 0.0, 2.0, {"switch": switch, "up": 1.0, "down": -2.0}, solver=ADAPTIVE).y

    value, slope = jax.value_and_grad(final)(0.7)
    assert abs(value - (0.7 - 2 * 1.3)) < 1e-6
    assert abs(slope - 3.0) < 1e-6


def test_a_discontinuity_of_a_field_is_detected():
    """https://github.com/patrick-kidger/diffrax/issues/729: no way was known to detect it."""
    found = d.switches(steps, 0.0, 0.0, {"switch": 0.7, "up": 1.0, "down": -2.0})
    assert {one.operation for one in found} <= {"le", "gt", "ge", "lt"}
    assert all("test_solve.py" in one.source for one in found)
    assert abs(abs(float(found[0].margin)) - 0.7) < 1e-12
    assert d.switches(fall, 0.0, (1.0, 0.0), {"gravity": GRAVITY}) == []


@pytest.mark.slow
def test_an_opened_function_is_where_it_is_called():
    found = d.switches(lambda t, y, args: jnp.max(y) * jnp.arctan2(y, 1.0 - t), 0.0, jnp.ones(2))
    assert [one.operation for one in found] == ["max", "ge"]
    assert all("test_solve.py" in one.source for one in found)


@pytest.mark.slow
def test_the_jump_of_an_angle_is_located():
    """The angle is atan2(level - y, -1): near pi below the level and near -pi above it."""

    def final(level):
        def field(t, y, level):
            return 2.0 + 0.5 / jnp.pi * jnp.arctan2(level - y, -1.0)

        return d.solve(field, 0.0, 0.0, 1.0, level, solver=ADAPTIVE).y

    difference = (final(0.7 + 1e-4) - final(0.7 - 1e-4)) / 2e-4
    assert abs(jax.grad(final)(0.7) - difference) < 1e-6


@killed_by("engine.solve", " and not searches", "")
@pytest.mark.parametrize("place", [-0.3, 0.4, 0.7, 1.0, 2.6])
@pytest.mark.parametrize("factor", [1, 2])  # as it is written, and as a product, the search asks in either order
def test_the_margin_of_a_search_is_a_distance(place, factor):
    knots = np.array([0.0, 1.0, 2.0])
    (found,) = d.switches(lambda t, y, args: 1.0 * jnp.searchsorted(knots, factor * y), 0.0, place / factor)
    assert found.margin == pytest.approx(np.abs(knots - place).min(), abs=1e-15)


@pytest.mark.slow
def test_the_flips_of_a_run_are_listed():
    found = d.switches(steps, 0.0, 0.0, {"switch": 0.7, "up": 1.0, "down": -2.0}, t1=2.0)
    assert [round(time, 6) for one in found for time in one.flips][:1] == [0.7]


@pytest.mark.slow
def test_states_after_a_discontinuity_have_derivatives():
    """https://github.com/patrick-kidger/diffrax/issues/729: a heater that stops where y reaches a level."""

    def final(level):
        heated = d.Event(lambda t, y, args: args - y["y"], lambda t, y, args: {**y, "on": 0.0})
        start = {"y": 0.0, "on": 1.0}

        def field(t, y, args):
            return {"y": jnp.where(y["on"] > 0.5, 2.0, -y["y"]), "on": 0.0 * y["on"]}

        return d.solve(field, start, 0.0, 2.0, level, solver=ADAPTIVE, events=[heated]).y["y"]

    # y = 2 t up to t* = level/2, then level exp(-(2 - t*)).
    def closed(level):
        return level * jnp.exp(-(2.0 - level / 2))

    assert abs(final(1.0) - closed(1.0)) < 1e-6
    assert abs(jax.grad(final)(1.0) - jax.grad(closed)(1.0)) < 1e-6


def dose(t, y, args):
    """Decay at the rate `decay`."""
    del t
    return {"amount": -args["decay"] * y["amount"]}


DOSE = d.Event(lambda t, y, args: args["at"] - t, lambda t, y, args: {"amount": y["amount"] + args["dose"]})


@pytest.mark.slow
@killed_by("engine.field", "jnp.where(unmoved & ~(rise > 0), -small - after, small - after)", "0.0 * after")
@killed_by("engine.field", "<= self.places + COINCIDENCE_FRACTION", "< self.places - COINCIDENCE_FRACTION")
def test_an_event_at_a_save_time_is_over_there():
    """https://github.com/SciML/SciMLSensitivity.jl/issues/1447: 7 % off where an event meets a save time."""
    save = jnp.array([0.0, 1.0, 5.0, 6.0])

    def saved(args):
        return d.solve(dose, {"amount": 3.0}, 0.0, 8.0, args, solver=ADAPTIVE, events=[DOSE], save=save).y["amount"]

    def closed(args):
        before = 3.0 * jnp.exp(-args["decay"] * save)
        return before + jnp.where(save >= 5.0, args["dose"] * jnp.exp(-args["decay"] * (save - args["at"])), 0.0)

    args = {"decay": 0.3, "at": 5.0, "dose": 2.0}
    moves = {"decay": 0.7, "at": -0.2, "dose": 0.4}
    found = jax.jvp(saved, (args,), (moves,))
    truth = jax.jvp(closed, (args,), (moves,))
    np.testing.assert_allclose(found, truth, atol=1e-6)
    late = d.solve(dose, {"amount": 3.0}, 0.0, 5.0, args, solver=ADAPTIVE, events=[DOSE])  # at t1 it does not happen
    np.testing.assert_allclose(late.y["amount"], 3.0 * np.exp(-1.5), atol=1e-6)


@pytest.mark.slow
def test_a_model_with_events_has_gradients():
    """https://github.com/lanl/PyBNF/issues/536: gradients of a fit were refused for a model with events.

    Two species decay; where the first falls through a threshold, both get a dose: state-dependent and repeated."""
    rates = jnp.array([1.0, 0.4])
    refill = d.Event(lambda t, y, args: y[0] - args[0], lambda t, y, args: y + args[1] * jnp.array([1.0, 0.5]))
    save = jnp.linspace(0.25, 4.0, 16)

    def loss(args):
        def field(t, y, args):
            return -rates * y

        run = d.solve(field, jnp.array([1.0, 1.0]), 0.0, 4.0, args, solver=ADAPTIVE, events=[refill], save=save)
        return jnp.sum(run.y**2)

    def closed(args):
        level, amount = args
        first = jnp.log(1.0 / level)
        period = jnp.log((level + amount) / level)
        times = first + period * jnp.arange(5)
        at = save[:, None] - times
        since = jnp.where(at >= 0, at, jnp.inf)
        one = jnp.exp(-save) + amount * jnp.exp(-since).sum(1)
        two = jnp.exp(-0.4 * save) + 0.5 * amount * jnp.exp(-0.4 * since).sum(1)
        return jnp.sum(one**2 + two**2)

    args = jnp.array([0.3, 0.5])
    assert abs(loss(args) - closed(args)) < 1e-6
    np.testing.assert_allclose(jax.grad(loss)(args), jax.grad(closed)(args), rtol=1e-6)


@pytest.mark.slow
def test_a_terminal_event_ends_a_solution():
    landing = d.Event(lambda t, y, args: y[0], terminal=True)
    wait = d.Event(lambda t, y, args: t - 9.0, terminal=True)

    def end(gravity):
        args = {"gravity": gravity}
        return d.solve(fall, (1.0, 0.0), 0.0, 5.0, args, solver=ADAPTIVE, events=[wait, landing], save=[0.1, 3.0])

    found = end(GRAVITY)
    assert found.status == SolutionStatus.TERMINATED
    assert found.events.counts.tolist() == [0, 1]
    np.testing.assert_allclose(found.y[0], [1 - GRAVITY * 0.01 / 2, 0.0], atol=1e-9)
    slope = jax.grad(lambda gravity: end(gravity).events.times[1, 0])(GRAVITY)
    assert abs(slope + np.sqrt(2) / 2 * GRAVITY**-1.5) < 1e-8


@pytest.mark.slow
@pytest.mark.parametrize("keep", [0.9, 0.5, 0.1, 1e-3])
def test_bounces_without_end_are_reported(keep):
    found = bounce(keep, end=12.0, solver=ADAPTIVE)
    assert found.status == SolutionStatus.CROWDED
    assert np.isnan(found.y[0])
    if keep == 0.5:  # its derivative is no number either
        assert np.isnan(jax.jacfwd(lambda keep: bounce(keep, end=12.0, solver=ADAPTIVE).y[0])(keep))


@pytest.mark.slow
@pytest.mark.parametrize("solver", [ADAPTIVE, d.FixedStep(1e-2)], ids=["adaptive", "fixed"])
def test_a_slide_is_reported(solver):
    found = d.solve(lambda t, y, args: 0.3 - jnp.sign(y), 1.0, 0.0, 5.0, solver=solver)
    assert found.status == SolutionStatus.SLID
    assert np.isnan(found.y)


@pytest.mark.slow
@killed_by(
    "engine.step.fixed",
    "leaves=decision.valid & carry.unrestricted if self.switches.watches else False",
    "leaves=jnp.logical_not(decision.valid)",
    case="exponential",
)
@killed_by("engine.step.fixed", "_outruns_step(carry, attempt)\n", "False\n", case="pole")
@pytest.mark.parametrize(
    "field",
    [
        lambda t, y, level: jnp.where(y > level, 1.0, 2.0) * y**2,
        lambda t, y, level: jnp.where(t > level, 1.0, 2.0) * jnp.exp(y),
        lambda t, y, level: jnp.where(t > level, 1.0, 2.0) * -1e3 * y,  # ten times too stiff for the step
    ],
    ids=["pole", "exponential", "stiff"],
)
def test_numbers_without_bound_diverge_with_fixed_steps(field):
    solver = d.FixedStep(1e-2)
    found = jax.jit(lambda level: d.solve(field, 0.3, 0.0, 3.0, level, solver=solver, engine="xla"))(0.5)
    assert found.status == SolutionStatus.DIVERGED
    assert np.isnan(found.y)


@pytest.mark.slow
@killed_by("engine.step.switching", "jnp.where(resolved, margin_error(system, carry, h, dynamics, state), 0.0)", "0.0")
def test_a_touch_is_reported_and_a_short_crossing_is_found():
    def final(level):
        return d.solve(
            lambda t, y, args: jnp.where(jnp.sin(t) + args > 0, 1.0, 2.0), 0.0, 0.0, 8.0, level, solver=ADAPTIVE
        )

    assert final(1.0).status == SolutionStatus.GRAZED
    for level in (0.99, 0.9999, 1.0001):
        assert abs(final(level).y - (8 + 2 * np.arccos(min(level, 1.0)))) < 1e-6


@pytest.mark.slow
def test_a_closure_and_the_times_have_derivatives():
    def final(rate, start, end):
        return d.solve(lambda t, y, args: -rate * y, 1.0, start, end, solver=ADAPTIVE).y

    found = jax.jit(jax.grad(final, argnums=(0, 1, 2)))(0.3, 0.5, 1.5)
    np.testing.assert_allclose(found, np.array([-1.0, 0.3, -0.3]) * np.exp(-0.3), rtol=1e-6)
    assert abs(final(0.3, 1.0, 0.0) - np.exp(0.3)) < 1e-6  # backwards


class Decay:
    """A field that is a method: its rate changes between calls."""

    def __init__(self, rate):
        self.rate = rate

    def field(self, t, y, args):
        return -self.rate * y


@pytest.mark.slow
@killed_by("engine.admission", "return x.dtype, x.shape, x.tobytes()", "return x.dtype, x.shape")
def test_a_changed_closure_is_noticed():
    decay = Decay(1.0)

    def final(rate):
        decay.rate = rate
        return d.solve(decay.field, 1.0, 0.0, 1.0, solver=ADAPTIVE).y

    for rate in (1.0, 2.0, np.array(3.0), 1.0):
        assert abs(final(rate) - np.exp(-rate)) < 1e-8
        assert abs(jax.grad(final)(float(rate)) + np.exp(-rate)) < 1e-8


def decay(t, y, args):
    return -y


@pytest.mark.slow
@killed_by("engine.field", "-rounding)), i + 1.0, ends)", "-rounding)), ends, ends)")
def test_a_reset_makes_a_terminal_event_happen():
    never = d.Event(lambda t, y, args: 9.0 - y, terminal=True)
    dose = d.Event(lambda t, y, args: args - t, lambda t, y, args: y + 1.0)
    full = d.Event(lambda t, y, args: 1.2 - y, terminal=True)

    def end(at, save=None):
        return d.solve(decay, 1.0, 0.0, 2.0, at, solver=ADAPTIVE, events=[never, dose, full], save=save)

    found = end(0.5)
    assert found.status == SolutionStatus.TERMINATED
    assert found.events.counts.tolist() == [0, 1, 1]
    np.testing.assert_allclose([found.t, found.events.times[2, 0], found.y], [0.5, 0.5, 1 + np.exp(-0.5)], atol=1e-8)
    np.testing.assert_allclose(end(0.5, [0.2, 1.0]).y, [np.exp(-0.2), 1 + np.exp(-0.5)], atol=1e-8)
    slopes = jax.jacfwd(lambda at: (end(at).t, end(at).y))(0.5)
    np.testing.assert_allclose(slopes, [1.0, -np.exp(-0.5)], atol=1e-8)


@pytest.mark.slow
@killed_by("engine.field", "jnp.abs(margin) / jnp.where(rate < 0, -rate, 1.0)", "jnp.abs(margin)")
def test_the_scale_of_a_condition_does_not_matter():
    small = d.Event(lambda t, y, args: 1e-20 * (10.0 - y), terminal=True)
    first = d.Event(lambda t, y, args: 3.7 - y * jnp.exp(0.01 * t), terminal=True)
    found = d.solve(lambda t, y, args: 1.0 + 0.1 * jnp.sin(t), 0.1, 0.0, 20.0, solver=ADAPTIVE, events=[small, first])
    assert found.events.counts.tolist() == [0, 1]


@pytest.mark.slow
@killed_by("engine.solve", "late -= jax.lax.stop_gradient(late)", "late *= 0.0")
@killed_by("engine.solve", "COINCIDENCE_FRACTION, 1.0, jnp.nan)", "COINCIDENCE_FRACTION, 1.0, 1.0)")
def test_saves_at_the_end_and_beyond():
    def saved(save, end=2.0):
        return d.solve(decay, 1.0, 0.0, end, solver=ADAPTIVE, save=save).y

    save = jnp.array([0.0, 1.0, 2.0])
    np.testing.assert_allclose(saved(save), np.exp(-save), atol=1e-8)
    np.testing.assert_allclose(jax.jacrev(saved)(save), -np.diag(np.exp(-save)), atol=1e-7)
    np.testing.assert_allclose(jax.jacfwd(saved, argnums=1)(save, 2.0), np.zeros(3), atol=1e-7)
    outside = jax.jit(saved)(jnp.array([-1.0, 1.0, 3.0, jnp.nan]))
    np.testing.assert_allclose(outside, [np.nan, np.exp(-1.0), np.nan, np.nan], atol=1e-8)


@pytest.mark.slow
@killed_by("engine.field", 'self.inputs["t0"] * (1.0 - s) + self.inputs["t1"] * s', 'self.inputs["t0"] + self.span * s')
def test_an_event_at_the_end_does_not_happen():
    last = d.Event(lambda t, y, end: end - t, lambda t, y, end: y + 1.0)
    starts, save = np.linspace(0.0, 0.8, 30), np.array([0.83, 0.85, 0.9])
    found = jax.vmap(lambda t0: d.solve(decay, 1.0, t0, 0.9, 0.9, solver=ADAPTIVE, events=[last], save=save))(starts)
    np.testing.assert_allclose(found.y[:, -1], np.exp(starts - 0.9), atol=1e-8)
    np.testing.assert_array_equal(found.t, np.tile(save, (30, 1)))


@pytest.mark.slow
@killed_by("engine.solve", "if status != SolutionStatus.FINISHED:", "if False:")
def test_the_flips_of_an_unfinished_run_are_refused():
    def stiff(t, y, args):
        return -3000.0 * (y - jnp.where(jnp.sin(t) > 0, 1.0, -1.0))

    with pytest.raises(ValueError, match="t1: the run has no end, its status is DIVERGED"):
        d.switches(stiff, 0.01, 0.0, t1=40.0)


@killed_by("engine.admission", "if eps * max(", "if 0 * max(")
def test_a_span_below_the_rounding_of_time_is_refused():
    for start, end in ((1e9, 1e9 + 1), (-1e9 - 1, -1e9)):
        with pytest.raises(ValueError, match=r"t1 - t0 is lost in .* as float32: shift the time"):
            d.solve(decay, jnp.float32(1.0), start, end, solver=ADAPTIVE)


@pytest.mark.slow
def test_integers_in_args_and_many_states():
    def field(t, y, args):
        return -y * args["rates"][args["which"]]

    args = {"rates": jnp.array([1.0, 2.0]), "which": 1}
    found = d.solve(field, jnp.ones((10, 5)), 0.0, 1.0, args, solver=ADAPTIVE)
    np.testing.assert_allclose(found.y, np.full((10, 5), np.exp(-2)), rtol=1e-7)


@pytest.mark.slow
def test_a_field_of_diffrax_goes_in():
    diffrax = pytest.importorskip("diffrax", reason="the group `bench` brings it")
    assert field_of(diffrax.ODETerm(fall)) is fall
    with pytest.raises(ValueError, match=r"no diffrax.ODETerm"):
        field_of(fall)


ruled, ruled_backwards = jax.custom_jvp(jnp.abs), jax.custom_vjp(jnp.abs)
ruled.defjvp(lambda at, moves: (jnp.abs(*at), jnp.sign(*at) * moves[0]))
ruled_backwards.defvjp(lambda y: (jnp.abs(y), y), lambda y, slope: (jnp.sign(y) * slope,))
TERMINAL_RESET = d.Event(fall, fall, terminal=True)
REFUSED = {
    "solver = 3 is no solver": {"solver": 3},
    r"solver.rtol = -1.0 is not positive": {"solver": d.Adaptive(-1.0)},
    r"solver.step = 5 s is outside \(0, 1\] s: longer than t1 - t0 = 1 s": {"solver": d.FixedStep(5)},
    "solver.kinks = False": {"solver": d.FixedStep(1e-2, kinks=False)},
    "t1 = 0.0 is equal to t0": {"t1": 0.0},
    "t1 = nan is not finite": {"t1": float("nan")},
    r"save has 3.0; times in \[0, 1\]": {"save": [0.5, 3.0]},
    r"save has shape \(\); a list of times": {"save": 0.5},
    "y0 = 'a' is text; a number is needed": {"y0": "a"},
    "y0 has no number": {"y0": ()},
    "field = 3 is no function": {"field": 3},
    r"field returns shape \(2,\); \(\) is needed": {"field": lambda t, y, args: jnp.ones(2)},
    "field returns the structure": {"field": lambda t, y, args: (y,)},
    "field has the operation 'floor' at .*test_solve": {"field": lambda t, y, args: jnp.floor(y)},
    "field has the operation 'sort' at": {"field": lambda t, y, args: jnp.sort(jnp.stack([y, t]))[0]},
    "comparison 'lt' within 'scan' at .*test_solve.* as a loop of Python": {
        "field": lambda t, y, args: jax.lax.fori_loop(0, 2, lambda _, x: jnp.where(y < 0.5, 1.0, x), 0.0)
    },
    "comparison 'gt' within 'while' at .* a fixed number of turns": {
        "field": lambda t, y, args: jax.lax.while_loop(lambda x: y > x, lambda x: 2 * x, 0.1)
    },
    "comparison 'abs' within 'custom_jvp_call' at .* leave out its derivative rule": {
        "field": lambda t, y, args: ruled(y)
    },
    "comparison 'abs' within 'custom_vjp_call'": {"field": lambda t, y, args: ruled_backwards(y)},
    "'pure_callback' at .*Write the function in JAX": {"field": lambda t, y, args: jax.pure_callback(np.cos, t, y)},
    "events.0 = 1 is no d.Event": {"events": [1]},
    "events.0 is terminal and has a reset": {"events": [TERMINAL_RESET]},
    r"events.0.condition returns shape \(3,\)": {"events": [d.Event(lambda t, y, args: jnp.ones(3))]},
    "events = Event.* is no list of d.Event": {"events": TERMINAL_RESET},
    "args.'f'. = <function fall .* is no number or array": {"args": {"f": fall}},
    "kept_events = 0 is no whole number": {"kept_events": 0},
    "float32 cannot locate": {"field": lambda t, y, args: -jnp.abs(y - 0.5), "y0": jnp.float32(1.0)},
    "float32 cannot .* and give float64 numbers": {
        "events": [d.Event(lambda t, y, args: 0.5 - t)],
        "y0": jnp.float32(1.0),
    },
}


@pytest.mark.parametrize("message", REFUSED)
def test_bad_arguments_are_refused_in_one_line(message):
    given = {"field": lambda t, y, args: -y, "y0": 1.0, "t0": 0.0, "t1": 1.0, "solver": ADAPTIVE} | REFUSED[message]
    with pytest.raises(ValueError, match=message) as caught:
        d.solve(given.pop("field"), given.pop("y0"), given.pop("t0"), given.pop("t1"), **given)
    assert "\n" not in str(caught.value)
    if message.startswith(("field has", "comparison", "'pure")):
        with pytest.raises(ValueError, match=message):
            d.switches(REFUSED[message]["field"], 0.0, 1.0)


def both(y, level):
    """2 below the level and 0.5 above it."""
    return jnp.where(y < level, 2.0, 0.5)


INNER = {  # fields that are 2 below the level and 0.5 above it
    "cond": lambda t, y, level: jax.lax.cond(y < level, lambda: 2.0, lambda: 0.5),
    "switch": lambda t, y, level: jax.lax.switch(jnp.where(y < level, 2, 0), [lambda: 0.5, lambda: 9.0, lambda: 2.0]),
    "in a branch": lambda t, y, level: jax.lax.cond(t < 9.0, both, lambda y, level: 3.0 * y, y, level),
    "jit": lambda t, y, level: jax.jit(both)(y, level),
    "remat": lambda t, y, level: jax.checkpoint(both)(y, level),
    "of the greatest": lambda t, y, level: both(jnp.max(jnp.stack([y, -t, t - 9.0])), level),
    "beside a loop": lambda t, y, level: (
        both(y, level) * jax.lax.fori_loop(0, 2, lambda i, x: x + jnp.where(level > 0.9 * i, 0.5, 9.0), 0.0)
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", INNER)
def test_a_jump_in_an_inner_function_is_located(name):
    def final(level):
        return d.solve(INNER[name], 0.0, 0.0, 1.0, level, solver=ADAPTIVE).y

    value, slope = jax.value_and_grad(final)(1.0)
    assert abs(value - 1.25) < 1e-8  # level + (1 - level/2)/2
    assert abs(slope - 0.75) < 1e-8


@pytest.mark.slow
def test_the_bend_of_relu_is_located():
    """y = t up to the level, then level - 1 + exp(t - level)."""

    def final(level):
        return d.solve(
            lambda t, y, level: 1.0 + jax.nn.relu(y - level), 0.0, 0.0, 2.0, level, solver=d.Adaptive(1e-6)
        ).y

    value, slope = jax.value_and_grad(final)(0.5)
    assert abs(value - (0.5 - 1 + np.exp(1.5))) < 1e-5
    assert abs(slope - (1 - np.exp(1.5))) < 1e-5


@pytest.mark.slow
@killed_by("engine.drive.kernel", "return jax.tree.map(operator.itemgetter(0), lane)", "return lane")
def test_a_kernel_solves_a_batch():
    levels = jnp.array([0.5, 0.8])

    def final(level):
        return d.solve(
            lambda t, y, level: jnp.where(y < level, 1.0, 2.0), 0.0, 0.0, 1.0, level, solver=ADAPTIVE, engine="kernel"
        ).y

    np.testing.assert_allclose(jax.vmap(final)(levels), 2.0 - levels, atol=1e-8)  # level + 2 (1 - level)
    np.testing.assert_allclose(jax.vmap(jax.jacfwd(final))(levels), [-1.0, -1.0], atol=1e-8)
    assert jax.grad(final)(0.5) == pytest.approx(-1.0, abs=1e-8)


@killed_by("engine.step.switching", "none, UNCONSTRAINED, accepted & last)", "none, UNCONSTRAINED, accepted)")
@killed_by("engine.step.fixed", "self.h, strike * self.h, self.h", "self.h, carry.k * self.h, self.h")
def test_fixed_steps_of_a_smooth_field_are_rk4():
    """Values of RK4 by NumPy, backwards in time; where they overflow, the solution has diverged."""

    def field(t, y, args):
        return args * y * y + t

    def rk4(y, h, args):
        for t in 2.0 + h * np.arange(20):
            a = field(t, y, args)
            b = field(t + h / 2, y + h / 2 * a, args)
            c = field(t + h / 2, y + h / 2 * b, args)
            y += h / 6 * (a + 2 * b + 2 * c + field(t + h, y + h * c, args))
        return y

    found = jax.vmap(lambda args: d.solve(field, 0.5, 2.0, 1.0, args, solver=d.FixedStep(0.05)))(jnp.array([0.3, -1e9]))
    np.testing.assert_allclose(found.y, [rk4(0.5, -0.05, 0.3), np.nan], rtol=1e-13)
    assert found.status.tolist() == [SolutionStatus.FINISHED, SolutionStatus.DIVERGED]


@killed_by("engine.step.fixed", "return end.state.flow(), end.rates[0]", "return end.state.flow()")
@killed_by("engine.solve", 'system.inputs["t1"], system.time(point.t)', "system.time(point.t), system.time(point.t)")
def test_the_last_fixed_step_ends_at_t1_within_the_domain():
    def field(t, y, args):
        return t**3, jnp.sqrt(args - y[0])  # y[0] = 1/4 at t = 1

    def solve(args):
        return d.solve(field, (0.0, 0.0), 0.0, 1.0, args, solver=d.FixedStep(1 / 49), save=jnp.ones(1))

    found = jax.vmap(solve)(jnp.array([0.3, 0.249999]))
    assert found.status.tolist() == [SolutionStatus.FINISHED, SolutionStatus.DIVERGED]
    end = d.solve(lambda t, y, args: y, 1.0, 0.0, 1.0, solver=d.FixedStep(1 / 49))
    assert end.t == 1.0  # 49 times 1/49 is less


@pytest.mark.slow
@killed_by("engine.step.advance", "stepping.second_order or stepping.switches.isolates", "stepping.switches.isolates")
@killed_by("engine.step.adaptive", "switches=switches, stable=True", "switches=switches")
@killed_by("engine.step.replay", "entry.refresh | ~entry.accepted, 0.0", "entry.refresh, 0.0")
def test_reverse_mode_where_rates_end_or_vanish():
    """Beyond t1, at rest, and in attempts that were rejected, numbers are not finite, or grow."""

    def final(field, y0, solver):
        return lambda args: d.solve(field, y0, 0.0, 1.0, args, solver=solver).y

    ends = final(lambda t, y, args: args * jnp.sqrt(1.001 - t), 0.0, d.FixedStep(0.01))
    np.testing.assert_allclose(jax.grad(ends)(1.0), 2 / 3 * (1.001**1.5 - 0.001**1.5), rtol=1e-5)
    rests = final(lambda t, y, args: 1000.0 * (args - y), 1.0, d.Adaptive(1e-8))
    np.testing.assert_allclose(jax.grad(rests)(1.0), 1.0, rtol=1e-6)
    drains = final(lambda t, y, args: -args * jnp.sqrt(y), 1.0, d.Adaptive(1e-4))
    rates = jnp.linspace(1.9, 1.9995, 24)
    np.testing.assert_allclose(jax.vmap(jax.grad(drains))(rates), rates / 2 - 1, atol=1e-3)


@killed_by("engine.step.fixed", "return PlainFixedStepping(self.h, self.steps, UNSWITCHED)", "return self")
def test_a_smooth_field_pays_for_no_event():
    def lorenz(t, y, rho):
        a, b, c = y
        return 10.0 * (b - a), a * (rho - c) - b, a * b - 8 / 3 * c

    def final(rho):
        return d.solve(lorenz, (1.0, 0.0, 0.0), 0.0, 1.0, rho, solver=d.FixedStep(1e-3), engine="kernel").y

    ((kernel, _),) = find_kernels(jax.make_jaxpr(jax.vmap(final))(jnp.linspace(0.0, 21.0, 4)))
    (call,) = find_lane_calls(kernel)
    operations = list(schedule_nodes(call.program().results["step"], UpdateLevel.STEP).nodes())
    by_hand = 4 * 9 + 3 * (3 * 2 + 4 * 2)  # four fields; for each number three stages and the sum of four rates
    assert len(operations) < 1.5 * by_hand


def test_a_field_without_a_translation_is_refused_by_a_kernel():
    with pytest.raises(EngineError, match="engine = 'kernel' is not possible: "):
        d.solve(lambda t, y, args: jnp.linalg.solve(y, y), jnp.eye(2), 0.0, 1.0, solver=ADAPTIVE, engine="kernel")


def test_fixed_steps_need_concrete_times():
    with pytest.raises(ValueError, match=r"d.FixedStep must know the number of its steps"):
        jax.jit(lambda t1: d.solve(lambda t, y, args: -y, 1.0, 0.0, t1, solver=d.FixedStep(1e-2)).y)(1.0)


@pytest.mark.slow
def test_the_page_runs():
    page = ROOT / "docs/fields.md"
    first, second = pages.printed(page.read_text(encoding="utf-8"), str(page))
    # 8 (1 - exp(-t)) up to 3, then 4 + (target - 4) exp(t* - t)
    wanted = [4 - np.exp(-2) * 8 / 5, np.exp(-2) * 8 * (1 / 5 - 1 / 25)]
    np.testing.assert_allclose([float(x) for x in first.split()], wanted, rtol=1e-6)  # rtol of the solver is 1e-8
    slope, source = second.splitlines()
    assert abs(float(slope) - 1.7314957) < 1e-6  # SciPy in pieces, central differences of 1e-5
    assert "fields.md" in source


SOLVER, BY_BOTH = d.Adaptive(1e-8), 10  # fields that XLA solves, too
WIDTHS = [1e-4, -1e-4, 3e-5, -3e-5, 1e-5, -1e-5]


def judge_fields(shape, count, seed):
    """Return how many random fields of a shape are right, reported, or wrong, by a word for each."""
    rng = np.random.default_rng(seed)
    fields = [random_fields.draw(rng, *shape) for _ in range(count)]
    moves = [{name: 0.1 * rng.standard_normal(x.shape) for name, x in one.items()} for one in fields]
    events = random_fields.build_events(shape[2])

    def final(p, engine="kernel"):
        run = d.solve(
            random_fields.field, p["y"], 0.0, random_fields.END, p, solver=SOLVER, events=events, engine=engine
        )
        return run.y, (run.status, run.events.counts)

    def slope(p, v, engine="kernel"):
        return jax.jvp(lambda p: final(p, engine), (p,), (v,), has_aux=True)

    batch, along = (jax.tree.map(lambda *x: jnp.stack(x), *some) for some in (fields, moves))
    runs = jax.jit(jax.vmap(final))
    ends = [runs(jax.tree.map(lambda x, dx, h=h: x + h * dx, batch, along))[0] for h in WIDTHS]
    differences = [np.asarray(a - b) / (2 * h) for a, b, h in zip(ends[::2], ends[1::2], WIDTHS[::2], strict=True)]
    values, (statuses, counts) = runs(batch)
    _, slopes, (logged, _) = jax.jit(jax.vmap(slope))(batch, along)

    tangent = jax.jit(partial(slope, engine="xla"))
    for i in range(BY_BOTH):
        value, move, (status, _) = tangent(fields[i], moves[i])
        if status != SolutionStatus.DIVERGED:  # a derivative by XLA has a limit of steps, that of a kernel has none
            assert status == statuses[i]
            # To the accuracy of the solver: the last bit of a step's length decides where the next ones end.
            np.testing.assert_allclose(value, values[i], rtol=0, atol=1e-6 * np.max(np.abs(value)))
            np.testing.assert_allclose(move, slopes[i], rtol=0, atol=1e-5 * np.max(np.abs(move)) + 1e-8)
    tally = {}
    for i, p in enumerate(fields):
        mine = values[i], statuses[i], counts[i], slopes[i], logged[i], [one[i] for one in differences]
        word = _judge_field(random_fields.solve_in_pieces(p), *mine)
        tally[word] = tally.get(word, 0) + 1
    return tally


def _judge_field(truth, value, status, counts, slope, logged, differences):
    if status > SolutionStatus.TERMINATED:
        return f"reported {SolutionStatus(int(status)).name}; oracle: {truth if isinstance(truth, str) else 'a value'}"
    if isinstance(truth, str):
        return f"WRONG: oracle {truth}"
    if np.max(np.abs(value - truth[0])) > 1e-3 * np.max(np.abs(truth[0])) or list(counts) != list(truth[1]):
        return "WRONG value"
    if logged > SolutionStatus.TERMINATED:
        return "reported in the derivative"
    scale = np.max(np.abs(slope)) + 1e-3
    off = [np.max(np.abs(slope - one)) / scale for one in differences if np.all(np.isfinite(one))]
    if off and min(off) <= 1e-3:
        return "right"
    # Where differences of three widths disagree with each other, an event or switch lies between their runs.
    spread = max((np.max(np.abs(a - b)) / scale for a in differences for b in differences), default=np.nan)
    return "WRONG derivative" if spread <= 1e-3 else "right value, differences disagree"


@pytest.mark.slow
@pytest.mark.parametrize("shape", random_fields.SHAPES)
def test_no_random_field_is_silently_wrong(shape):
    """Together 1,002 fields of dimension 1 to 6, with 1 to 4 switches and with resets."""
    tally = judge_fields(shape, 167, seed=sum(shape))
    assert not any("WRONG" in word for word in tally), tally
    assert tally.get("right", 0) > 80, tally
