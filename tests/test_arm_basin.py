"""Regions of attraction of the two-wheeler, and gains for a box of riders."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from balancing import DIRECTION, EFFORT, GAIN, HANGING, MULTIPLES, SHORT, SOLVER, START, WEIGHTS, closed, model
from oracles import arm_stays_up

from diffabs.balance_model import BalanceModel
from diffabs.basin import MEASURED, attraction, recoverable
from diffabs.controllers import BalanceFeedback, ObserverFeedback, Sampled
from diffabs.design import Spec, certify, design
from diffabs.design.gridded import gridded
from diffabs.design.recovery import recoverable_bound
from diffabs.design.upright import upright
from diffabs.plants import ArmBalance
from diffabs.pytree import replace
from diffabs.rollout import FixedStep, measure

pytestmark = pytest.mark.xdist_group("arm-basin")  # one worker compiles what these share

OVER = {"plant.rider_mass": (40.0, 100.0), "plant.stiffness": (700.0, 1300.0), "plant.damping": (70.0, 130.0)}


# Regions of attraction


AXIS = np.linspace(-0.1, 0.1, 9)


def test_a_region_is_what_its_runs_do():
    """Not symmetric in the two axes, and of what is upright after 4 s, some is not yet at rest. One run
    after the other, compiled as one."""
    first, second = AXIS, np.linspace(-0.08, 0.12, 5)
    found = attraction(closed(), first, second, SHORT, tolerance=3e-4)

    def one(theta, phi):
        return measure(replace(closed(), {"initial.theta": theta, "initial.phi": phi}), SHORT, MEASURED)

    runs = [[one(theta, phi) for phi in second] for theta in first]
    up = np.array([[not run.stopped for run in row] for row in runs])
    fine = up & np.array([[float(run.metrics["final_norm"]) < 3e-4 for run in row] for row in runs])
    np.testing.assert_array_equal(found.recovered, fine)
    assert found.diverged == 0
    assert 0.1 < found.share < np.mean(up) < 0.8
    assert found.share == np.mean(fine)
    assert not np.array_equal(found.recovered[:5], found.recovered[:5][::-1])


@pytest.mark.parametrize("voltage", MULTIPLES)
def test_the_largest_multiple_that_is_recovered(voltage):
    """REFERENCE has 0.080 at 48 V, and 0.046 and 0.116 at 24 and 100 V: there SciPy falls, and agrees with us."""
    found = recoverable(closed(voltage=voltage), DIRECTION, SOLVER, most=0.12)
    assert found == pytest.approx(MULTIPLES[voltage], abs=6e-5)
    assert found < float(recoverable_bound(*model(HANGING), START, voltage))
    assert arm_stays_up(HANGING, GAIN, (found - 1e-4) * START, voltage)
    assert not arm_stays_up(HANGING, GAIN, (found + 1e-4) * START, voltage)


def test_nothing_and_all_can_be_recovered():
    assert recoverable(closed(), DIRECTION, SOLVER, most=0.01) == 0.01
    assert recoverable(closed(controller=BalanceFeedback(gain=-GAIN)), DIRECTION, SOLVER, most=0.1) == 0.0


@pytest.mark.slow
def test_float32_and_float64_agree_on_the_region():
    """At most 2 of 400 starts, at the border."""
    axis = np.linspace(-0.1, 0.1, 20)
    double = attraction(closed(), axis, axis, SHORT, tolerance=0.05)
    loop = jax.tree.map(jnp.float32, closed())
    single = attraction(loop, axis, axis, SHORT, tolerance=0.05)
    assert np.sum(double.recovered != single.recovered) <= 2
    assert 0.2 < double.share < 0.8


def test_the_slope_of_the_time_of_a_fall_is_a_difference():
    """In the lean that it starts with: the last step ends on the ground, wherever that is between two instants."""
    falling = closed(0.2)

    def time(theta):
        return measure(
            replace(falling, {"initial.theta": theta}), FixedStep(step=2e-3, duration=2.0), {}
        ).ending.sample.t

    value, slope = jax.jvp(time, (0.1,), (1.0,))
    assert 0.2 < float(value) < 2
    assert float(slope) == pytest.approx(float(time(0.1 + 1e-5) - time(0.1 - 1e-5)) / 2e-5, rel=1e-5)


# Over a box of riders


@pytest.fixture(scope="module")
def robust():
    """A proved gain for riders of 40 to 100 kg, springs and dampers +-30 %, on a grid of three points."""
    return design(gridded(BalanceModel(plant=HANGING), OVER), Spec(Q=np.diag(WEIGHTS), R=EFFORT))


def test_the_vertices_are_the_systems_on_the_grid():
    """Ends included; the last parameter runs first, as in the corners."""
    over = {"plant.rider_mass": (40.0, 100.0), "plant.stiffness": (1000.0, 1000.0), "plant.damping": (70.0, 130.0)}
    found = gridded(BalanceModel(plant=HANGING), over)
    values = [(m, d) for m in (40.0, 70.0, 100.0) for d in (70.0, 100.0, 130.0)]
    assert [(x["plant.rider_mass"], x["plant.damping"]) for x in found.corners] == values
    assert {x["plant.stiffness"] for x in found.corners} == {1000.0}
    for place, (m, d) in enumerate(values):
        a, b = model(ArmBalance(arm_length=-0.5, rider_mass=m, damping=d))
        np.testing.assert_allclose(found.A[place], a, rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(found.B[place], b, rtol=1e-12, atol=1e-12)


def test_one_gain_for_all_riders_is_proved(robust):
    """On the grid that it was designed on, and on one that has as many points between."""
    assert robust.certificate.verified_exactly
    assert robust.certificate.quadratically_stable
    finer = gridded(BalanceModel(plant=HANGING), OVER, 5)
    assert len(finer.A) == 125
    proof = certify(robust.gain, finer)
    assert proof.quadratically_stable
    assert proof.verified_exactly
    assert all(np.linalg.eigvals(a + b @ robust.gain).real.max() < 0 for a, b in zip(finer.A, finer.B, strict=True))


def test_the_gain_for_one_rider_is_disproved():
    system = gridded(BalanceModel(plant=HANGING), OVER)
    proof = certify(GAIN, system)
    assert proof.verified_exactly
    assert not proof.quadratically_stable
    assert [claim.kind for claim in proof.claims] == ["infeasible"]
    assert max(np.linalg.eigvals(a + b @ GAIN[None]).real.max() for a, b in zip(system.A, system.B, strict=True)) > 0.9


def test_a_grid_has_two_points_at_least_and_not_too_many_systems():
    with pytest.raises(ValueError, match=r"points = 1 is outside \[2, inf\)"):
        gridded(BalanceModel(plant=HANGING), OVER, 1)
    with pytest.raises(ValueError, match=r"a grid of 4913 systems is more than 4096"):
        gridded(BalanceModel(plant=HANGING), OVER, 17)


def test_a_loop_becomes_the_model_that_it_is():
    plain, gain, exact, neglected = upright(closed())
    assert (plain.period, exact) == (None, True)
    np.testing.assert_array_equal(gain, GAIN)
    assert any("voltage limit of 48 V" in line for line in neglected)
    sampled = upright(closed(controller=Sampled(controller=BalanceFeedback(gain=GAIN), period=0.01)))[0]
    assert sampled.period == 0.01
    with pytest.raises(ValueError, match="ObserverFeedback is not feedback of the whole state"):
        upright(closed(controller=ObserverFeedback()))
