"""Runs that slide along a switching surface have no derivatives and say so; all others keep theirs, against SciPy."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import sliding
from conditional import ConditionalIntegration
from marks import cases
from mutants import killed_by

import diffabs as d
from diffabs.loop.closed_loop import Loop
from diffabs.loop.sliding import describe_slide
from diffabs.parts.actuators import Lag
from diffabs.parts.controllers import PID, HoldingInput, ScheduledFeedback
from diffabs.parts.objectives import IAE
from diffabs.parts.plants import MirroredRig
from diffabs.parts.references import Setpoint
from diffabs.parts.stops import NoStop, SpeedReached

END = 3.0
FIXED, ADAPTIVE = d.FixedStep(2e-3, END), d.Adaptive(1e-8, END, 1e-2)


def loop_of(plant, **parts):
    return Loop(**{"plant": plant, "initial": (), "reference": Setpoint(value=0.0), "controller": PID(kp=0.0),
                   "stop": NoStop(), **parts})  # fmt: skip


@d.core.pytree.pytree
class Square:
    """Integral of the square of the first signal."""

    def start(self, sample):
        return d.core.protocols.Memory(flow=0.0 * sample.t)

    def flow(self, memory, sample):
        return sample.output[0] ** 2

    def update(self, memory, segment):
        return memory.held

    def value(self, memory, ending):
        return memory.flow


def check_random(count, seed, solver):
    """Compare random switched loops with SciPy, and return how many slide.

    At most one in a hundred of the others may be reported, too.
    """
    rng = np.random.default_rng(seed)
    numbers = [sliding.draw_switched(rng) for _ in range(count)]
    moves = [sliding.draw_switched(rng) for _ in range(count)]
    loop = loop_of(sliding.Switched())

    def cost(p):
        one = d.replace(loop, {f"plant.{name}": x for name, x in p.items()})
        run = d.measure(one, solver, {"cost": Square()})
        return run.metrics["cost"], run.slid | run.diverged

    stacked = [jax.tree.map(lambda *x: jnp.asarray(np.stack(x)), *rows) for rows in (numbers, moves)]
    values, slopes, reported = jax.jit(jax.vmap(lambda p, v: jax.jvp(cost, (p,), (v,), has_aux=True)))(*stacked)
    slides = spare = 0
    for i, (p, v) in enumerate(zip(numbers, moves, strict=True)):
        exact, h = sliding.solve_switched(p, END), 1e-5
        if exact.slowest < 1e-2:  # a touch, where nothing has a derivative
            continue
        slides += exact.slides
        assert np.isnan(slopes[i]) == reported[i], i
        assert reported[i] or not exact.slides, (i, exact)
        spare += reported[i] and not exact.slides
        if reported[i]:
            continue
        sides = [{name: x + step * v[name] for name, x in p.items()} for step in (h, -h)]
        ends = [sliding.solve_switched(one, END).cost for one in sides]
        np.testing.assert_allclose(values[i], exact.cost, rtol=1e-6, err_msg=str(i))
        np.testing.assert_allclose(slopes[i], (ends[0] - ends[1]) / (2 * h), rtol=1e-3, atol=1e-5, err_msg=str(i))
    assert spare <= count // 100
    return slides


@killed_by("engine.step.slides", "returns >= MAX_RETURNS", "returns > 1000")
@pytest.mark.slow
def test_random_switched_loops_slide_where_scipy_says_so():
    assert 5 <= check_random(24, 1, FIXED) <= 20


@pytest.mark.slow
@pytest.mark.parametrize("solver", [FIXED, ADAPTIVE])
def test_many_random_switched_loops(solver):
    assert check_random(300, 2, solver) > 50


@jax.jit  # JAX keeps its operations with the lines of the first trace
def sign(x):
    return jnp.where(x > 0, 1.0, jnp.where(x < 0, -1.0, 0.0))


@d.core.pytree.pytree
class BangBang:
    """u = -level sign(y): a control law that holds its target by switching."""

    level: float = d.core.pytree.param(default=0.5, unit="control", above=0.0)

    flow = d.core.protocols.no_flow

    def start(self, signal):
        return d.core.protocols.Memory()

    def output(self, t, memory, signal):
        return self.level * sign(signal.target - signal.measured[0])


@d.core.pytree.pytree
class Follower:
    """An actuator or a filter whose output follows its input at a fixed speed, by the sign of the difference."""

    speed: float = d.core.pytree.param(default=0.8, unit="control/s", above=0.0)

    def start(self, signal):
        return d.core.protocols.Memory(flow=0.0 * signal)

    def flow(self, t, memory, signal):
        return self.speed * jnp.sign(signal - memory.flow)

    def output(self, t, memory, signal):
        return memory.flow


SLIDING = {
    "textbook anti-windup": (sliding.limited_pi(ConditionalIntegration()), "controller.ki", 0.2938),
    "dry friction": (loop_of(sliding.Block()), "plant.Fc", 1 / 0.7),
    "bang-bang law": (loop_of(sliding.Block(), controller=BangBang()), "controller.level", 1 / 1.2),
    "actuator": (
        loop_of(sliding.Lagging(), controller=PID(kp=2.0), reference=Setpoint(value=0.5), actuator=Follower()),
        "actuator.speed",
        None,
    ),
}


COMPARED_IN = {
    "textbook anti-windup": "pid.py",
    "dry friction": "sliding.py",
    "bang-bang law": "test_slides.py",
    "actuator": "test_slides.py",
}


@pytest.mark.parametrize("name", cases(SLIDING, "bang-bang law", "actuator", "textbook anti-windup"))
def test_a_sliding_run_has_no_derivative_and_says_so(name, users_engine):
    """Its value with fixed steps stays, in both modes."""
    (loop, path, begins), solver = SLIDING[name], d.FixedStep(1e-2, END)

    def iae(x):
        run = d.measure(d.replace(loop, {path: x}), solver, {"iae": IAE()})
        return run.metrics["iae"], run

    at = float(d.core.pytree.get(loop, path))
    slope, run = jax.jacfwd(iae, has_aux=True)(at)
    assert run.slid
    assert np.isnan(slope)
    assert np.isfinite(run.metrics["iae"])
    assert not run.diverged
    if begins is not None:
        np.testing.assert_allclose(run.slide.t, begins, rtol=1e-3)
    line = describe_slide(loop, solver, {"iae": IAE()}, jax.device_get(run))
    place = re.match(r"the run slides from t = [\d.]+ s along the comparison `.*` \((.*\.py):\d+, in .*\): both", line)
    assert place
    assert place[1] == COMPARED_IN[name]
    assert "slides along a switching surface" in str(run)


@pytest.mark.slow
@pytest.mark.parametrize("node", [50.0, 45.0])
@pytest.mark.parametrize("solver", [d.Adaptive(1e-9, 0.1), d.FixedStep(1e-3, 0.1, kinks=True)])
@killed_by("engine.step.event_location", "length, landing, beyond)", "length, landing + beyond, 0.0)")
def test_a_run_that_starts_on_a_node_with_a_rate_that_turns_is_no_slide(node, solver):
    """At small slip the measured curve is negative: the body's rate rises before it falls through zero, and so does the
    margin of standstill's comparison. A search that takes its first attempt for the zero changes the answer too early.
    """
    speeds, gains = np.array([5.0, node]) / 3.6, np.array([-60.0, -60.0])
    controller = ScheduledFeedback(speeds=speeds, integral_gains=50 * gains, gains=gains, low=0.0, high=9.03)
    loop = d.braking(
        plant=MirroredRig(),
        initial=d.BrakeStart(speed=50 / 3.6),
        controller=controller,
        feedforward=HoldingInput(),
        actuator=Lag(time_constant=1e-3),
        stop=SpeedReached(speed=5 / 3.6),
    )

    def iae(mass):
        run = d.measure(d.replace(loop, {"plant.mass": mass}), solver, {"iae": IAE()})
        return run.metrics["iae"], run

    slope, run = jax.jacfwd(iae, has_aux=True)(5.75)
    assert not run.slid
    for width in (1e-3, 3e-4, 1e-4):
        difference = (iae(5.75 + width)[0] - iae(5.75 - width)[0]) / (2 * width)
        np.testing.assert_allclose(slope, difference, rtol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("name", SLIDING)
def test_a_sliding_run_with_adaptive_steps_is_reported(name):
    loop, path, _ = SLIDING[name]
    objectives, at = {"iae": IAE()}, float(d.core.pytree.get(loop, path))

    def iae(x):
        run = d.measure(d.replace(loop, {path: x}), d.Adaptive(1e-6, END, 1e-2), objectives)
        return run.metrics["iae"], run

    runs = [iae(at)[1], jax.jacfwd(iae, has_aux=True)(at)[1]]
    if name == "dry friction" and not runs[0].slid:  # by rounding the speed may become 0 exactly, and then it stays
        assert runs.pop(0).metrics["iae"] == pytest.approx(1.0 / (2.0 * at), rel=1e-6)
    for run in runs:
        assert run.slid
        assert run.diverged
        assert np.isnan(run.metrics["iae"])
    assert np.isnan(jax.grad(lambda x: iae(x)[0])(at))


@pytest.mark.slow
def test_reverse_mode_kernels_and_trajectories_have_no_derivatives_either():
    loop, path, _ = SLIDING["dry friction"]
    solver, objectives, at = d.FixedStep(1e-2, END), {"iae": IAE()}, 0.7
    assert np.isnan(jax.grad(lambda x: d.measure(d.replace(loop, {path: x}), solver, objectives).metrics["iae"])(at))

    def shown(x):
        return d.rollout(d.replace(loop, {path: x}), solver).trajectory.sample.output.y

    assert np.isnan(jax.jacfwd(shown)(at)).all()

    def batch(x, engine):
        columns = {path: x * jnp.array([0.2, 1.0])}  # the first block is still moving at the end
        run = d.run_batch(loop, d.Batch(columns), solver, objectives, together=False, engine=engine)
        return run.metrics["iae"], run

    slopes, runs = jax.jacfwd(lambda x: batch(x, "kernel"), has_aux=True)(at)
    np.testing.assert_array_equal(runs.slid, [False, True])
    np.testing.assert_allclose(slopes[0], -0.2 * END**2 / 2, rtol=1e-6)  # of the integral of 1 - 0.2 x t
    assert np.isnan(slopes[1])
    assert "1 slide along" in str(jax.device_get(runs))
