"""The parts of the real rig, against a second version in NumPy that reads nothing but the documents it is given."""

import dataclasses
import json
import pathlib
import sys

import jax
import numpy as np
import pytest
import real_rig_oracle as oracle

import diffabs as d
from diffabs import controllers, references, sensors
from diffabs.core.blocks import Series

ROOT = pathlib.Path(__file__).parent.parent


@pytest.fixture(scope="module")
def rig():
    """The experiment's modules."""
    names = ("real_rig_box", "real_rig_loops", "real_rig_floor", "real_rig_document")
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(ROOT / "experiments")
        yield {name.removeprefix("real_rig_"): __import__(name) for name in names}
    for name in names:
        sys.modules.pop(name)


CASES = {
    "nominal": {},
    "all wrong": {
        "mass": 6.2,
        "speed": 31.0,
        "height": 0.93,
        "place": 1.07,
        "inertia": 1.08,
        "lag": 1.7e-3,
        "delay": 7e-4,
    },
    "a whole period": {"mass": 5.3, "speed": 67.0, "delay": 1e-3, "lag": 0.6e-3},
}
WRONG = {"known": {"first": -0.03, "last": 0.02}, "estimated": {"bias": 0.08}}


def quiet(rig, speed, case):
    """A loop of the box without noise, which is another program's to draw, but with the quantisation."""
    box, loops = rig["box"], rig["loops"]
    controller = controllers.ProportionalFeedback(
        gain=np.array([-2000.0, -140.0]), antiwindup=controllers.BackCalculation(tracking_time=0.03)
    )
    fixed = box.Fixed(slip_noise=0.0, acceleration_noise=0.0)
    one = loops.loop(fixed, controller, speed, references.LimitedSlip(rate=5.0, time_constant=0.02))
    at = {name: np.full(1, value) for name, value in {**CASES[case], **WRONG[speed]}.items()}
    return d.replace(one, {path: float(value[0]) for path, value in box.columns(at).items()})


@pytest.mark.parametrize("speed", ["known", "estimated"])
@pytest.mark.parametrize("case", CASES)
def test_a_document_runs_elsewhere(rig, speed, case):
    """To rounding, until the wheel's speed is rounded the other way: that is, until the end."""
    one = quiet(rig, speed, case)
    document = json.loads(json.dumps(rig["document"].document(one)))
    run = d.rollout(one, d.FixedStep(1e-3, 0.5, kinks=False), key=jax.random.key(0))
    sample, running = run.trajectory.sample, np.asarray(run.trajectory.running)
    steps = int(running.sum()) - 1
    found = oracle.simulated(document, steps)
    ours = {"slip": sample.output.slip, "speed": sample.output.speed, "torque": sample.control, "target": sample.target}
    assert steps > 300
    for name, values in ours.items():
        np.testing.assert_allclose(np.asarray(values)[: steps + 1], found[name], rtol=1e-9, atol=1e-11, err_msg=name)


def test_the_grid_agrees_with_located_events(rig):
    """Where the computing delay is located by events, and by the mean over the step in which the command changes."""
    one = quiet(rig, "known", "all wrong")
    smooth = dataclasses.replace(
        one, sensor=Series(blocks=(one.sensor.blocks[0], sensors.Bias(), one.sensor.blocks[2]))
    )
    at = d.FixedStep(1e-4, 0.3)
    exact = d.rollout(rig["loops"].located(smooth), d.FixedStep(2.5e-5, 0.3, every=4), key=jax.random.key(0))
    near = d.rollout(smooth, at, key=jax.random.key(0))
    slips = [np.asarray(run.trajectory.sample.output.slip) for run in (near, exact)]
    np.testing.assert_allclose(*slips, rtol=0, atol=2e-6)


def test_a_speed_seen_low_biases_the_slip_whatever_the_gain(rig):
    """The floor: 0.8 e of slip, 4 e of overshoot."""
    floors = []
    for gain in ((-500.0, -60.0), (-4000.0, -160.0)):
        one = quiet(rig, "known", "nominal")
        one = d.replace(one, {"controller.controller.gain": np.array(gain), "sensor.blocks.1.wheel_speed": 0.0})
        one = d.replace(one, {"sensor.blocks.2.first": -0.03, "sensor.blocks.2.last": -0.03})
        run = d.rollout(one, d.FixedStep(1e-3, 1.0, kinks=False), key=jax.random.key(0))
        floors.append(float(np.asarray(run.trajectory.sample.output.slip)[-1]) / 0.2 - 1)
    np.testing.assert_allclose(floors, 4 * 0.03, rtol=0.02)
    points = {name: np.full(1, value) for name, value in rig["box"].NOMINAL.items()}
    points |= {"first": np.full(1, -0.03), "last": np.full(1, -0.03)}
    np.testing.assert_allclose(rig["floor"].floor(points, "known", rig["box"].Fixed()), 0.12, rtol=1e-12)
