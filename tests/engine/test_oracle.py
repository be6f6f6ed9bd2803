"""Whole runs against SciPy: random plants, roads and controllers, integrated by an independent program."""

import numpy as np
import pytest
from marks import cases
from mutants import killed_by
from oracles import brake

import diffabs as d
from diffabs import controllers, plants, roads
from diffabs.parts.objectives import IAE, MaxSlip, StopDistance, StopTime
from diffabs.parts.stops import SpeedReached
from diffabs.scenario.defaults import braking

OBJECTIVES = {"stop_time": StopTime(), "stop_distance": StopDistance(), "max_slip": MaxSlip(), "iae": IAE()}
STEP = 5e-5


def _road(rng):
    return [
        lambda: roads.RationalCurve(w4=rng.uniform(0.3, 0.9), a=rng.uniform(2e-4, 2e-3)),
        lambda: roads.Burckhardt(c1=rng.uniform(0.4, 1.3), c2=rng.uniform(10, 40), c4=rng.uniform(0, 0.03)),
        lambda: roads.MagicFormula(D=rng.uniform(0.3, 1.0), B=rng.uniform(8, 16)),
        lambda: roads.Tabulated(mu=np.array(roads.SPLINE_B.mu) * rng.uniform(0.4, 1.0)),
        lambda: roads.Scaled(road=roads.DRY_CONCRETE, scale=rng.uniform(0.3, 0.9)),
    ][rng.integers(5)]()


def _plant(rng, road):
    if rng.integers(2):
        return plants.QuarterCar(mass=rng.uniform(12, 20), inertia=rng.uniform(0.8, 1.3), road=road)
    return plants.MirroredRig(mass=rng.uniform(5, 7), inertia_factor=rng.uniform(0.4, 1), road=road)


def _case(seed):
    """A loop, and the same controller for the oracle: (loop, torque, rates, length of its memory)."""
    rng = np.random.default_rng(seed)
    plant = _plant(rng, _road(rng))
    loop = braking(
        plant=plant, initial=d.BrakeStart(speed=rng.uniform(9, 14)), stop=SpeedReached(speed=rng.uniform(1.5, 2.5))
    )
    output = plant.output(plant.start(loop.initial))
    hold = float(plant.holding(output, 0.2))
    scale = 40 * hold  # gains in proportion to the torque of the plant
    kind = ("smooth", "smooth", "pid", "constant")[seed % 4]
    if kind == "smooth":
        k1, k2 = -3.0 * scale, -0.2 * scale
        controller = controllers.StateFeedback(gain=np.array([k1, k2]))
        loop = braking(**_fields(loop), controller=controller, feedforward=controllers.ConstantInput(value=hold))
        return loop, lambda t, s, m: hold + k1 * m[0] + k2 * (s - 0.2), lambda t, s, m: [s - 0.2], 1
    if kind == "pid":
        kp, ki, kd, wc, top = scale, 2 * scale, 0.002 * scale, 55.0, 1.5 * hold
        controller = controllers.PID(kp=kp, ki=ki, kd=kd, cutoff=wc, high=top, low=0.0)

        def torque(t, s, m):
            e = 0.2 - s
            return np.clip(kp * e + ki * m[0] + kd * wc * (e - m[1]), 0, top)

        return (
            braking(**_fields(loop), controller=controller),
            torque,
            lambda t, s, m: [0.2 - s, wc * (0.2 - s - m[1])],
            2,
        )
    top = rng.uniform(1.2, 2.0) * hold  # locks the wheel
    return braking(**_fields(loop), controller=controllers.ConstantTorque(torque=top)), lambda t, s, m: top, None, 0


def _fields(loop):
    return {"plant": loop.plant, "initial": loop.initial, "stop": loop.stop}


@pytest.mark.slow
@killed_by("parts.plants.mirrored_rig", "self.slip_and_friction(v, w, ", "self.slip_and_friction(w, v, ", case="2")
@pytest.mark.parametrize("seed", cases(range(12), 2, 3, 4, 6, 7, 8, 9, 10, 11))
def test_random_scenario_agrees_with_scipy(seed):
    loop, torque, rates, memory = _case(seed)
    d.check(loop)
    expected = brake(loop.plant, torque, speed=loop.initial.speed, stop=loop.stop.speed, memory=memory, rates=rates)
    run = d.measure(loop, d.FixedStep(STEP, 12.0), OBJECTIVES)
    assert run.stopped
    smooth = isinstance(loop.controller, controllers.StateFeedback)
    rtol = 1e-6 if smooth else 1e-4  # a kink of the torque limit, or the lock, costs the method its order
    for name, value in expected.items():
        np.testing.assert_allclose(run.metrics[name], value, rtol=rtol, atol=1e-9, err_msg=name)


@killed_by("parts.plants.lab_rig", "stuck = jnp.where(held, smaller(needed, capacity), capacity)", "stuck = capacity")
@pytest.mark.slow
def test_lab_rig_locks_and_stops_like_scipy():
    plant = plants.LabRig()
    loop = braking(
        plant=plant,
        initial=d.BrakeStart(speed=12.0),
        controller=controllers.ConstantTorque(torque=0.8),
        stop=SpeedReached(speed=1.0),
    )
    expected = brake(plant, lambda t, s, m: 0.8, speed=12.0, stop=1.0)
    run = d.measure(loop, d.FixedStep(STEP, 6.0), OBJECTIVES)
    assert expected["max_slip"] == 1.0
    for name, value in expected.items():
        np.testing.assert_allclose(run.metrics[name], value, rtol=1e-4, atol=1e-9, err_msg=name)
