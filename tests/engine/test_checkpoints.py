"""Reverse mode over many steps: how much it keeps, and that it is the derivative that forward mode gives."""

import functools
import itertools
import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from mutants import killed_by
from seams import replace_seam

import diffabs as d
from diffabs import controllers, plants
from diffabs.core.lanes import keep_decision
from diffabs.core.pytree import get
from diffabs.engine.drive.loops import (
    SCAN_GROUP_STEPS,
    repeat_step,
    round_up_capacity,
    scan_steps,
)
from diffabs.parts.objectives import IAE, StopDistance
from diffabs.parts.stops import SpeedReached
from diffabs.scenario.defaults import braking

LOOP = braking(
    plant=plants.MirroredRig(),
    initial=d.BrakeStart(speed=50 / 3.6),
    controller=controllers.StateFeedback(low=0.0, high=9.03),
    feedforward=controllers.HoldingInput(),
    stop=SpeedReached(speed=5 / 3.6),
)
PATHS = ("plant.mass", "plant.road.w4", "reference.slip", "controller.gain", "initial.speed")


def objective(steps, lanes=64, step=1e-3, kinks=None):
    """Logarithmic changes of the parameters -> mean distance + IAE over masses."""

    def mean(logs):
        loop = d.replace(LOOP, {p: get(LOOP, p) * jnp.exp(x) for p, x in zip(PATHS, logs, strict=True)})

        def one(factor):
            run = d.measure(
                d.replace(loop, {"plant.mass": get(loop, "plant.mass") * factor}),
                d.FixedStep(step, steps * step, kinks=kinks),
                {"distance": StopDistance(), "iae": IAE()},
            )
            return run.metrics["distance"] + run.metrics["iae"]

        return jnp.mean(jax.vmap(one)(jnp.linspace(1.0, 1.2, lanes)))

    return mean


def memory(steps):
    """Temporary memory [bytes] of the reverse gradient."""
    program = jax.jit(jax.grad(objective(steps))).lower(jnp.zeros(len(PATHS))).compile()
    analysis = program.memory_analysis()
    assert analysis is not None
    return analysis.temp_size_in_bytes


@killed_by("engine.drive.loops", "MAX_SAVED_CARRIES = 1800", "MAX_SAVED_CARRIES = 10**9")
@pytest.mark.slow
def test_reverse_mode_memory_hardly_grows_with_steps():
    sizes = [memory(steps) for steps in (1000, 4000, 16000)]
    assert max(sizes) < 2 * min(sizes), sizes


@pytest.mark.parametrize("count", [1, 5, 17, 1000, 4004, 123457])
def test_slots_leave_little_over_and_are_few(count):
    room = round_up_capacity(count)
    assert count <= room <= 1.125 * count + 1
    assert len({round_up_capacity(n) for n in range(1000, 4000)}) <= 17


def test_groups_after_the_end_have_no_derivative():
    def power(x, count, room):
        def step(carry):
            return carry[0] * x, carry[1] + 1

        return repeat_step(step, (1.0, 0), room, lambda carry: carry[1] < count)

    made = SCAN_GROUP_STEPS * math.ceil(70 / SCAN_GROUP_STEPS)
    value, times = jax.jit(power, static_argnums=2)(1.01, 70, 100)
    assert times == made
    np.testing.assert_allclose(value, 1.01**made, rtol=1e-12)
    slope = jax.jit(jax.grad(lambda x, n, room: power(x, n, room)[0]), static_argnums=2)(1.01, 70, 100)
    np.testing.assert_allclose(slope, made * 1.01 ** (made - 1), rtol=1e-12)


class Attempts(NamedTuple):
    """A run of `accepted` attempts, each of which multiplies x."""

    x: Any
    accepted: Any


@killed_by("core.lanes", "checkpoint_name(x, DECISION)", "x")
@killed_by("engine.drive.loops", "carry, until=until), carry, cap", "carry, until=None), carry, cap", case="segments")
@pytest.mark.parametrize("steps", [20, 200], ids=["one scan", "segments"])
def test_what_is_computed_again_decides_as_before(steps, monkeypatch):
    """A decision by the last digits comes out another way when XLA computes it again and rounds otherwise."""
    replace_seam(monkeypatch, "max_saved_carries", 100)
    replace_seam(monkeypatch, "segment_steps", 16)
    answers = itertools.cycle([True, True, False, True, True, True, False])
    ask = functools.partial(jax.pure_callback, lambda x: np.asarray(next(answers)), jax.ShapeDtypeStruct((), bool))

    def final(x):
        def is_on(carry, until):
            return carry.accepted < (steps if until is None else jnp.minimum(until, steps))

        def step(carry, until):
            accepted = keep_decision(ask(jax.lax.stop_gradient(carry.x)) & is_on(carry, until))
            return Attempts(jnp.where(accepted, carry.x * x, carry.x), carry.accepted + accepted)

        start = Attempts(jnp.asarray(1.0), jnp.asarray(0))
        return scan_steps(step, is_on, start, 0, None, steps, lambda steps: 2 * steps + 7).x

    factor = 1.0 + 1.0 / steps
    np.testing.assert_allclose(jax.jit(final)(factor), factor**steps, rtol=1e-9)
    np.testing.assert_allclose(jax.jit(jax.grad(final))(factor), steps * factor ** (steps - 1), rtol=1e-9)


@killed_by("core.lanes", "checkpoint_name(x, DECISION)", "x")
@pytest.mark.slow
def test_reverse_mode_of_many_roads(monkeypatch):
    """XLA's program for 4,096 runs rounds a step that it computes again otherwise than the step of the run; that for
    2,048 does not. The size of a step's numbers is judged by the last digits where a state is zero but for rounding."""
    rig = d.load("slip-lmi", ["solver.step=1e-3"])

    def distance(grip):
        loop = d.replace(rig.loop, {"plant.road.w4": grip})
        return d.measure(loop, rig.solver, {"distance": StopDistance()}).metrics["distance"]

    grips = jnp.linspace(0.3, 0.6, 4096)
    reverse = jax.jit(jax.vmap(jax.grad(distance)))(grips)
    monkeypatch.setenv("DIFFABS_ENGINE", "kernel")
    np.testing.assert_allclose(reverse, jax.jit(jax.vmap(jax.jacfwd(distance)))(grips), rtol=1e-9)


@killed_by(
    "engine.step.runge_kutta",
    "jvp_nonzero(lambda *step: _scanned_step(tableau, f, *step), primals",
    "jvp_nonzero(lambda *step: _scanned_step(tableau, f, *step[:4], jax.lax.stop_gradient(step[4])), primals",
)
@pytest.mark.slow
def test_reverse_forward_and_differences_agree_in_nested_scans(monkeypatch):
    replace_seam(monkeypatch, "max_saved_carries", 16)
    jax.clear_caches()
    replace_seam(monkeypatch, "segment_steps", 7)
    mean, zero = objective(100, lanes=2, step=2e-3), jnp.zeros(len(PATHS))
    reverse, forward = jax.jit(jax.grad(mean))(zero), jax.jit(jax.jacfwd(mean))(zero)
    moves = 1e-5 * jnp.eye(len(PATHS))
    many = jax.jit(jax.vmap(objective(100, lanes=2, step=2e-3, kinks=True)))  # a value as derivatives have it
    np.testing.assert_allclose(reverse, forward, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(forward, (many(moves) - many(-moves)) / 2e-5, rtol=1e-6, atol=1e-8)
