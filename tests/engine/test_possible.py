"""Whatever loop is run with whatever step: no metric without a flag lies outside its physical range."""

import dataclasses

import jax
import numpy as np
import parts
import pytest

import diffabs as d
from diffabs import actuators, controllers, objectives
from diffabs.core import blocks
from diffabs.core.pytree import parameters, replace
from diffabs.loop.contracts import find_misfits
from diffabs.parts.objectives import BALANCE, BRAKING
from diffabs.scenario.defaults import braking

MEASURED = {
    "braking": BRAKING
    | {"effort": objectives.Effort(), "variation": objectives.Variation(), "itae": objectives.ITAE()},
    "balance": BALANCE | {"cost": objectives.BalanceCost()},
}
LANES = 64
MULTIPLES = (1e-6, 1e-3, 0.1, 0.5, 1.0, 1.0, 2.0, 10.0, 1e3)  # of a parameter: from harmless to absurd
STEPS = (1e-4, 1e-3, 1e-2)


def drawn(rng, task):
    """A loop of parts that fit, whatever they do together."""
    plant = rng.choice(list((parts.PLANTS if task == "braking" else parts.BALANCES).values()))
    typical = {"braking": d.braking, "balance": d.balancing}[task]()
    choices = {"controller": parts.CONTROLLERS, "sensor": parts.SENSORS, "actuator": parts.ACTUATORS}
    choices |= {"reference": parts.REFERENCES, "stop": parts.PARTS["stop"], "feedforward": parts.PARTS["feedforward"]}
    loop = dataclasses.replace(typical, plant=plant)
    for name, family in choices.items():
        other = dataclasses.replace(loop, **{name: rng.choice(np.array(list(family.values()), object))})
        loop = loop if list(find_misfits(other, MEASURED[task])) else other
    return loop


def lanes(loop, rng):
    """Values of its parameters by path, in their ranges, most of them where somebody may want them, some not."""
    values = {}
    for path, spec, value in parameters(loop):
        if np.ndim(value) == 0 and np.isfinite(value) and not path.startswith("plant.road") and rng.random() < 0.5:
            column = value * rng.choice(MULTIPLES, LANES) * rng.choice([1.0, 1.0, 1.0, -1.0], LANES)
            values[path] = np.where([spec.holds(x) for x in column], column, value)
    return values or {"plant.mass": np.full(LANES, loop.plant.mass)}


def check_runs(loop, values, step, measured, seed):
    """Metrics of lanes without a flag are in their ranges; speed does not rise under a brake that only brakes."""
    keys = jax.vmap(jax.random.key)(np.arange(LANES) + seed)
    solver = d.FixedStep(step, 400 * step)

    @jax.jit
    @jax.vmap
    def run(values, key):
        return d.measure(replace(loop, values), solver, measured, key=key)

    done = jax.device_get(run(values, keys))
    assert not (done.diverged & done.stopped).any()
    for name, part in measured.items():
        low, high = type(part).physical
        x = done.metrics[name][~done.diverged]
        if hasattr(part, "unreached"):
            x = x[~np.isin(x, part.unreached) & ~(np.isnan(part.unreached) & np.isnan(x))]  # none, which is an answer
        assert np.isfinite(x).all(), (name, loop)
        assert (x >= low - 1e-9).all(), (name, x.min(), loop)
        assert (x <= high + 1e-9).all(), (name, x.max(), loop)
        assert np.isnan(done.metrics[name][done.diverged]).all()
    return done


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(1, 25))])
@pytest.mark.parametrize("task", ["braking", "balance"])
def test_no_metric_without_a_flag_is_impossible(task, seed):
    rng = np.random.default_rng(seed)
    loop = drawn(rng, task)
    done = check_runs(loop, lanes(loop, rng), rng.choice(STEPS), MEASURED[task], seed)
    assert done.diverged.shape == (LANES,)


@pytest.mark.slow
def test_a_brake_never_speeds_the_car_up_without_a_flag():
    """A lag from well resolved to far beyond the step, around a brake with limits: the car is no faster at the end than
    at the start, or the run has diverged."""
    loop = braking(
        controller=controllers.PID(kp=3893.0, low=0.0, high=90.0),
        actuator=blocks.Series(blocks=(actuators.Lag(), actuators.Limits(low=0.0, high=400.0))),
    )
    rng = np.random.default_rng(4)
    values = {
        "actuator.blocks.0.time_constant": 10 ** rng.uniform(-5, -1, LANES),
        "initial.speed": rng.uniform(0.2, 40, LANES),
        "plant.inertia": 10 ** rng.uniform(-3, 0.5, LANES),
    }
    done = check_runs(loop, values, 1e-3, BRAKING, 0)
    y, fine = done.ending.sample.output, ~done.diverged
    assert 8 < fine.sum() < LANES
    assert (np.maximum(y.speed, 0)[fine] <= 1.01 * values["initial.speed"][fine]).all()
