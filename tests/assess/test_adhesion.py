"""The coefficient of adhesion measured with one axle: from the balance of forces, in a run, and its slopes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from mutants import killed_by
from scipy.optimize import brentq

import diffabs as d
from diffabs.assess import AxleAdhesion, StopProgram, assess, find_axle_adhesion, measure_adhesion, plan_stops
from diffabs.core.pytree import replace
from diffabs.parts.plants import GRAVITY, HalfCar
from diffabs.scenario import load

CAR = HalfCar()
MASS, BASE = 1500.0, CAR.to_front + CAR.to_rear
STATIC = {"front": MASS * GRAVITY * CAR.to_rear / BASE, "rear": MASS * GRAVITY * CAR.to_front / BASE}


def braking_rate(axle, adhesion, resistance):
    """z from two equations in z and the axle's load: z P g = k F + c F_other, F = F_0 +- h z P g/E."""
    other, sign = ("rear", 1.0) if axle == "front" else ("front", -1.0)
    weight = MASS * GRAVITY
    equations = np.array([[weight, -adhesion], [-sign * CAR.height / BASE * weight, 1.0]])
    return np.linalg.solve(equations, [resistance * STATIC[other], STATIC[axle]])[0]


@killed_by("assess.adhesion", "(rear_rate - of_front * share)", "(rear_rate - of_rear * share)")
@killed_by("assess.adhesion", "(1 - share - lever * rear_rate)", "(1 - share + lever * rear_rate)")
@killed_by("assess.adhesion", "{True: 0.015, False: 0.010}", "{True: 0.010, False: 0.015}")
@pytest.mark.parametrize(("driven", "of_rear", "of_front"), [("rear", 0.015, 0.01), ("front", 0.01, 0.015)])
def test_the_formulas_solve_the_balance_of_forces(driven, of_rear, of_front):
    known = np.array([[0.8, 0.3], [0.75, 0.25]])  # unladen and laden, on two roads
    pairs = [("front", of_rear), ("rear", of_front)]
    rates = np.stack([np.vectorize(lambda k, a=a, c=c: braking_rate(a, k, c))(known) for a, c in pairs], axis=-1)
    axles = find_axle_adhesion(jnp.asarray(rates[None]), CAR, StopProgram(driven=driven), {})
    np.testing.assert_allclose(axles.front[0], known, rtol=1e-12)
    np.testing.assert_allclose(axles.rear[0], known, rtol=1e-12)


@killed_by("assess.adhesion", "rear * (1 - on_front)", "rear * on_front")
@killed_by("assess.adhesion", "jnp.where(alone, front,", "jnp.where(~alone, front,")
@pytest.mark.parametrize("height", [0.5, 0.7])
def test_the_car_has_the_mean_by_its_dynamic_loads(height):
    """The default wheelbase is 2.58 m: at a height of 0.7 m the rear axle counts not (1.5)."""
    stops = plan_stops(CAR, StopProgram())
    ends = jnp.array([[0.8, 0.3], [0.7, 0.28]])
    shape = (np.array([[CAR.to_rear / BASE]]), np.array([[height / BASE]]), np.array([[BASE]]))
    axles = AxleAdhesion(ends[None], 0.9 * ends[None], *map(jnp.asarray, shape))
    of_stops = axles.mean_adhesion(jnp.full((1, len(stops)), 0.2), stops)[0]
    shift = height / BASE * 0.2 * MASS * GRAVITY
    front, rear = STATIC["front"] + shift, STATIC["rear"] - shift
    for stop, value in zip(stops, of_stops, strict=True):
        k = float(ends[int(stop.laden), int(stop.left_side[0])])
        expected = k * (front + 0.9 * rear) / (MASS * GRAVITY) if height < 0.25 * BASE else k
        assert float(value) == pytest.approx(expected, rel=1e-12)


def test_an_unknown_measure_is_refused_in_a_line():
    for change, line in (("adhesion=axle", "road, axles"), ("driven=left", "front, rear, both")):
        field, name = change.split("=")
        with pytest.raises(ValueError, match=f'assess.{field} = "{name}" is unknown; there is {line}'):
            load("half-car", [f"assess.{change}"])


def one_axle_braked(axle, adhesion, mass):
    """k as the formula reads it, for friction k at the braked axle, a rolling resistance, and the spin of the other."""
    weight, other, sign = mass * GRAVITY, *(("rear", 1.0) if axle == "front" else ("front", -1.0))
    static = {name: load * mass / MASS for name, load in STATIC.items()}

    def balance(rate):  # the spin of the free wheels drives the car
        load = static[axle] + sign * CAR.height / BASE * rate * weight
        return adhesion * load - CAR.rear_inertia * rate * GRAVITY / CAR.radius**2 - rate * weight

    rate = brentq(balance, 0.0, 2.0, xtol=1e-14)
    resistance = 0.015 if other == "rear" else 0.010
    load = static[axle] + sign * CAR.height / BASE * rate * weight
    return (rate * weight - resistance * static[other]) / load


@pytest.mark.slow
def test_runs_measure_what_forces_and_spins_make():
    """The free axle's spin drives the car, and the formula takes off a rolling resistance that it does not have."""
    scenario, program = load("half-car"), StopProgram(load=300.0)
    solver = d.Adaptive(1e-8, 25.0)
    axles = measure_adhesion(scenario.loop, solver, program)
    for laden, mass in enumerate((CAR.mass, CAR.mass + 300.0)):
        for slippery, adhesion in enumerate((0.8, 0.3)):
            expected = [one_axle_braked(axle, adhesion, mass) for axle in ("front", "rear")]
            measured = [k[0, laden, slippery] for k in (axles.front, axles.rear)]
            np.testing.assert_allclose(measured, expected, rtol=1e-3)

    def adhesions(values):
        loop = replace(scenario.loop, {"plant.height": values[0], "plant.rear_inertia": values[1]})
        measured = measure_adhesion(loop, solver, program)
        return jnp.concatenate([measured.front.ravel(), measured.rear.ravel()])

    x = np.array([0.55, 1.7])
    slopes, values = np.asarray(jax.jit(jax.jacfwd(adhesions))(jnp.asarray(x))), jax.jit(adhesions)
    for width in (1e-2, 3e-3, 1e-3):
        for i, step in enumerate(np.diag(width * x)):
            far, near, close, distant = (np.asarray(values(jnp.asarray(x + n * step))) for n in (-2, -1, 1, 2))
            difference = (8 * (close - near) - (distant - far)) / (12 * step[i])
            np.testing.assert_allclose(slopes[:, i], difference, rtol=1e-3, atol=1e-3 * np.abs(difference).max())


@pytest.mark.slow
def test_a_measured_coefficient_asks_for_another_measurement():
    """It is below that of the road, so that the half car uses more than there is on snow."""
    scenario = load("half-car", ["assess.adhesion=axles"])
    clause = assess(scenario.loop, scenario.solver, scenario.assess).clauses[0]
    assert clause.rule == "utilised adhesion from 55 km/h, k by one axle"
    assert clause.verdict == "met"
    assert "in low, 55 km/h, unladen is above 1.00: measure k again" in clause.note
