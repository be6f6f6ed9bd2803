"""One command for the brakes of both axles, against the balance of torques of a steady stop, written out here."""

import math

import jax
import numpy as np
import pytest
from mutants import killed_by
from scipy.optimize import brentq

import diffabs as d
from diffabs import Adaptive, Loop, measure, replace
from diffabs.core.protocols import Tracking
from diffabs.parts.controllers import PID, BackCalculation, BrakeDistribution, ConstantTorque
from diffabs.parts.objectives import FinalError, InChannel, LockedTime, StopDistance
from diffabs.parts.plants import Car, HalfCar
from diffabs.parts.plants.car import CarControls
from diffabs.parts.roads import Burckhardt, RoadTyre
from diffabs.parts.stops import SpeedReached

C1, C2, C3 = 1.2801, 23.99, 0.52  # dry asphalt, here at all speeds alike
ROAD = RoadTyre(road=Burckhardt(c1=C1, c2=C2, c3=C3, c4=0.0))
SLIP = 0.1
M, A, B, H, R, J, G = 1093.2952334674046, 1.1561957064, 1.4227170936, 0.5748689544, 0.344, 1.7, 9.81
OBJECTIVES = {
    "distance": StopDistance(),
    "rear_error": InChannel(objective=FinalError(), control="rear_brake", output="rear_slip"),
    **{
        f"{axle}_locked": InChannel(objective=LockedTime(), control=f"{axle}_brake", output=f"{axle}_slip")
        for axle in ("front", "rear")
    },
}


def friction(slip):
    return C1 * (1 - math.exp(-C2 * slip)) - C3 * slip


def torques(rear_slip):
    """Torques of both axles in a steady stop with the front slip SLIP, by the equations of the half car [N m]."""
    front_mu, rear_mu = friction(SLIP), friction(rear_slip)
    force = M * G * (front_mu * B + rear_mu * A) / (A + B - (front_mu - rear_mu) * H)
    front, rear = front_mu * (M * G * B + H * force) / (A + B), rear_mu * (M * G * A - H * force) / (A + B)
    inertia = J * force / M / R
    return R * front + (1 - SLIP) * inertia, R * rear + (1 - rear_slip) * inertia


def ideal_share():
    front, rear = torques(SLIP)
    return front / (front + rear)


def half_car(controller):
    car = HalfCar(front_tyre=ROAD, rear_tyre=ROAD)
    return Loop(plant=car, **{**car.usual_parts(), "controller": controller, "stop": SpeedReached(speed=5.0)})


def of_front_slip(**distribution):
    pid = PID(kp=2e4, ki=3e5, low=0.0, high=6000.0, antiwindup=BackCalculation())
    return half_car(BrakeDistribution(controller=pid, **distribution))


def stop(loop):
    return {name: float(value) for name, value in measure(loop, Adaptive(1e-8, 10.0), OBJECTIVES).metrics.items()}


@killed_by("parts.controllers.distribution", "larger(rear - self.knee, 0.0)", "larger(rear, 0.0)")
@killed_by("parts.controllers.distribution", "(1 - self.valve_ratio) * larger", "self.valve_ratio * larger")
def test_the_valve_bends_the_torque_of_the_rear_axle_at_its_knee():
    distribution = BrakeDistribution(front_share=0.6, knee=400.0, valve_ratio=0.25)
    assert distribution.split(900.0) == pytest.approx((540.0, 360.0), abs=1e-12)
    assert distribution.split(2000.0) == pytest.approx((1200.0, 400.0 + 0.25 * 400.0), abs=1e-12)


@killed_by("parts.controllers.distribution", "brake: torque / len(axle)", "brake: torque")
def test_four_wheels_get_half_of_their_axle_and_the_steer_angle_stays():
    car = Car()
    axles = {axle: (f"{axle}_left_brake", f"{axle}_right_brake") for axle in ("front", "rear")}
    pedal = BrakeDistribution(
        controller=ConstantTorque(torque=1000.0), front_share=0.7, controlled="front_left_slip", **axles
    )
    output = car.output(car.start(d.BrakeStart()))
    signal = Tracking(output, output, CarControls(0.0, 0.0, 0.0, 0.0, 0.02))
    command = pedal.output(0.0, pedal.start(signal), signal)
    np.testing.assert_allclose(command, (350.0, 350.0, 150.0, 150.0, 0.02), rtol=1e-12)


def test_a_forgotten_brake_is_refused():
    pedal = BrakeDistribution(
        controlled="front_left_slip", front=("front_left_brake", "front_right_brake"), rear=("rear_left_brake",)
    )
    car = Car()
    output = car.output(car.start(d.BrakeStart()))
    with pytest.raises(ValueError, match=r"rear_right_brake .* is in neither list"):
        pedal.start(Tracking(output, output, CarControls(0.0, 0.0, 0.0, 0.0, 0.0)))


@pytest.mark.parametrize("more", [0.0, 0.05])
def test_the_rear_axle_slips_as_the_balance_of_torques_says(more):
    """The ideal share gives both axles the slip of the front one; a greater share gives the rear axle less."""
    share = ideal_share() + more
    expected = brentq(lambda slip: torques(slip)[1] / sum(torques(slip)) - (1 - share), 1e-4, SLIP + 1e-3)
    assert (expected == pytest.approx(SLIP, abs=1e-9)) == (more == 0)
    assert stop(of_front_slip(front_share=share))["rear_error"] == pytest.approx(SLIP - expected, abs=2e-5)


@pytest.mark.parametrize(("share", "locks"), [(0.66, "rear"), (0.95, "front")])
def test_the_axle_with_too_much_torque_locks(share, locks):
    metrics = stop(half_car(BrakeDistribution(controller=ConstantTorque(torque=4000.0), front_share=share)))
    other = {"front": "rear", "rear": "front"}[locks]
    assert metrics[f"{locks}_locked"] > 0.5
    assert metrics[f"{other}_locked"] == 0


@pytest.mark.slow
def test_derivatives_of_the_distance_against_differences_of_three_widths():
    loop, names = of_front_slip(front_share=0.7, knee=600.0, valve_ratio=0.3), ("front_share", "knee", "valve_ratio")

    def distance(numbers):
        changes = {f"controller.{name}": numbers[i] for i, name in enumerate(names)}
        return measure(replace(loop, changes), Adaptive(1e-9, 10.0), {"distance": StopDistance()}).metrics["distance"]

    at = np.array([0.7, 600.0, 0.3])
    slopes = jax.jacfwd(distance)(at)
    for width in (1e-2, 1e-3, 1e-4):
        moves = np.diag(width * at)
        differences = [float(distance(at + move) - distance(at - move)) / (2 * move.sum()) for move in moves]
        np.testing.assert_allclose(slopes, differences, rtol=1e-4 + width)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"front": ()}, "front = () is no list of names"),
        ({"rear": "rear_brake"}, "rear = 'rear_brake' is no list of names"),
        ({"rear": ("front_brake",)}, "front and rear have front_brake both"),
        ({"front": ("front_brake", "front_brake")}, "front has front_brake twice"),
        ({"rear": ("back",)}, "there is no control back; there is front_brake, rear_brake"),
        ({"controlled": "slip"}, "there is no channel slip; there is front_slip, rear_slip"),
        ({"front_share": 1.5}, r"front_share = 1.5 is outside \[0, 1\]"),
    ],
)
def test_a_distribution_that_cannot_be_is_refused(fields, message):
    with pytest.raises(ValueError, match=message.replace("(", r"\(").replace(")", r"\)")):
        stop(half_car(BrakeDistribution(**fields)))
