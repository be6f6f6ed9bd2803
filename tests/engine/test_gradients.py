"""Every objective differentiated in every parameter of every part: forward, reverse, and against differences."""

import dataclasses
import functools

import jax
import jax.flatten_util
import jax.numpy as jnp
import numpy as np
import pytest
from marks import cases
from mutants import killed_by

import diffabs as d
from diffabs import actuators, controllers, objectives, plants, references, roads, sensors
from diffabs.core import blocks
from diffabs.core.pytree import canonical_dtypes, get, parameters, replace
from diffabs.parts.objectives import MaxSlip
from diffabs.parts.stops import Fallen, SpeedReached, Standstill
from diffabs.scenario.defaults import braking

OBJECTIVES = {
    **objectives.BRAKING,
    "itae": objectives.ITAE(),
    "effort": objectives.Effort(),
    "variation": objectives.Variation(),
    "cost": objectives.QuadraticCost(),
}
OF_BALANCE = {
    **objectives.BALANCE,
    "balance cost": objectives.BalanceCost(r=1e-4),
    "soft loss": objectives.SoftLoss(),
}
KEY = jax.random.key(3)

RIG = {"plant": plants.MirroredRig(), "initial": d.BrakeStart(speed=8.0, slip=0.05), "stop": SpeedReached(speed=6.8)}
CAR = {
    "plant": plants.QuarterCar(road=roads.MagicFormula()),
    "initial": d.BrakeStart(speed=8.0, slip=0.02),
    "stop": SpeedReached(speed=6.0),
}
PATCHES = roads.Patches(
    roads=(roads.DRY_CONCRETE, roads.Scaled(road=roads.SPLINE_B, scale=0.7)), edges=np.array([0.8]), width=0.3
)
ALONG = roads.ScaledAlong(road=roads.MagicFormula(), factors=np.array([1.0, 0.9, 1.05, 1.0]), spacing=2.0)
# Together these hold every part that a loop can be made of; the last test of this file sees to it.
LOOPS = {
    "feedback": braking(**RIG, controller=controllers.StateFeedback(), feedforward=controllers.HoldingInput()),
    "filtered reference": braking(
        **RIG,
        controller=controllers.ScheduledFeedback(
            speeds=np.array([2.0, 20.0]),
            integral_gains=np.array([-11000.0, -13000.0]),
            gains=np.array([-40.0, -64.0]),
            low=0.0,
            high=9.03,
            antiwindup=controllers.BackCalculation(tracking_time=0.02),
        ),
        feedforward=controllers.ConstantInput(value=2.7),
        reference=references.FilteredSlip(time_constant=0.02),
        actuator=actuators.Lag(time_constant=0.002),
    ),
    "proportional": braking(
        **RIG,
        sensor=sensors.SpeedScale(factor=0.98),
        controller=controllers.ProportionalFeedback(gain=np.array([-8000.0, -200.0])),
        feedforward=controllers.HoldingInput(),
    ),
    "latch": braking(
        **CAR | {"stop": Standstill(speed=5.5)},
        controller=controllers.PID(ki=5000.0, kd=5.67, high=200.0, low=0.0),
        reference=references.PeakLatch(),
    ),
    "lock": braking(
        plant=plants.LabRig(),
        initial=d.BrakeStart(speed=8.0, slip=0.1),
        stop=SpeedReached(speed=5.5),
        controller=controllers.ConstantTorque(torque=0.95),
    ),
    "relay": braking(
        **CAR,
        controller=controllers.Relay(high=250.0),
        reference=references.Setpoint(value=0.2),
        actuator=actuators.Limits(low=5.0, high=190.0),
    ),
    "computer": braking(
        **CAR | {"plant": plants.QuarterCar(road=PATCHES)},
        controller=controllers.Sampled(
            controller=controllers.PID(kp=900.0, ki=2000.0, high=120.0, antiwindup=controllers.Clamping(), low=0.0),
            period=5e-3,
            delay=1.3e-3,
        ),
        actuator=blocks.Series(blocks=(actuators.RateLimit(rate=4137.0), actuators.Lag(time_constant=0.003))),
    ),
    "noisy": braking(
        **CAR,
        controller=controllers.SlidingMode(gain=160.0, boundary=0.05, high=150.0, low=0.0),
        reference=references.PeakRobust(time_constant=0.004, threshold=0.02),
        sensor=blocks.Series(
            blocks=(
                sensors.Noise(slip=1e-4, deceleration=0.02, wheel_speed=1e-3, speed=1e-3),
                sensors.Bias(slip=1e-3, deceleration=0.02, speed=0.01, wheel_speed=0.01),
                sensors.Quantisation(),
                sensors.WheelSpeed(),
                sensors.IntegratedAccelerometer(bias=0.05),
            )
        ),
    ),
    "speed that drifts": braking(
        **RIG,
        controller=controllers.SampledOnGrid(
            controller=controllers.ProportionalFeedback(gain=np.array([-2000.0, -120.0])), delay=4e-4
        ),
        feedforward=controllers.ConstantInput(value=2.7),
        reference=references.LimitedSlip(rate=3.0, time_constant=0.02),
        sensor=blocks.Series(
            blocks=(sensors.WheelNoise(slip=1e-3), sensors.DriftingSpeed(first=0.01, last=-0.02, time_constant=0.1))
        ),
        actuator=actuators.Lag(time_constant=0.002),
    ),
    "estimated speed": braking(
        **RIG,
        controller=controllers.SampledOnGrid(
            controller=controllers.ProportionalFeedback(gain=np.array([-2000.0, -120.0])), delay=4e-4
        ),
        feedforward=controllers.ConstantInput(value=2.7),
        reference=references.LimitedSlip(rate=3.0, time_constant=0.02),
        sensor=blocks.Series(
            blocks=(
                sensors.WheelNoise(slip=1e-3),
                sensors.Noise(deceleration=0.1),
                sensors.SpeedEstimator(gate=0.15, growth=0.3),
            )
        ),
        actuator=actuators.Lag(time_constant=0.002),
    ),
    "extremum seeking": braking(
        **CAR | {"plant": plants.QuarterCar(road=ALONG)},
        controller=controllers.PID(kp=600.0, high=150.0, low=0.0),
        reference=references.ExtremumSeeking(gain=2.0, time_constant=0.05),
    ),
    "by deceleration": braking(
        **CAR | {"plant": plants.QuarterCar(road=ALONG)},
        controller=controllers.PID(kp=600.0, high=150.0, low=0.0),
        reference=references.SlipByDeceleration(
            decelerations=np.array([1.0, 6.0, 12.0]), slips=np.array([0.1, 0.12, 0.16])
        ),
        sensor=sensors.PlayedWheelNoise(noise=np.array([1e-3, -2e-3, 0.0]), period=5e-3),
    ),
    "arm": braking(
        plant=plants.ArmBalance(arm_length=-0.5, gear=1.1, rotor_inertia=0.3),
        initial=plants.BalanceStart(theta=0.004, psi=0.01, phi=0.001, theta_rate=-0.001, psi_rate=0.02, phi_rate=0.002),
        reference=references.Upright(),
        controller=controllers.BalanceFeedback(gain=np.array([3519.0, -301.0, 1397.0, 1242.0, -11.0, 517.0])),
        actuator=actuators.VoltageLimit(),
        stop=Fallen(),
    ),
    "arm, observed": braking(
        plant=plants.PrintedArm(),
        initial=plants.BalanceStart(theta=0.1, psi=0.05, phi=0.03),
        reference=references.Upright(),
        sensor=sensors.AngleSensor(theta=1e-4, psi=1e-4, period=5e-3),
        controller=controllers.Sampled(
            controller=controllers.ObserverFeedback(
                gain=np.array([90.0, -4.0, 30.0, 25.0, -3.0, 10.0]),
                transition=0.9 * np.eye(6) + 0.01 * np.eye(6, k=3),
                entry=np.array([0.0, 0.0, 0.0, -0.01, 0.03, 0.02]),
                correction=np.linspace(0.05, 0.6, 12).reshape(6, 2),
            ),
            period=5e-3,
            delay=1.3e-3,
        ),
        actuator=actuators.VoltageLimit(),
        stop=Fallen(),
    ),
    "given commands": braking(
        **CAR,
        controller=controllers.PlayedCommand(commands=np.array([90.0, 150.0, 40.0, 110.0, 70.0]), period=0.05),
        actuator=blocks.Series(
            blocks=(
                actuators.DeadTime(rise=0.0123, fall=0.0071),
                actuators.AsymmetricLag(rise=0.013, fall=0.0061),
            )
        ),
    ),
    "encoders": braking(
        **CAR,
        controller=controllers.Sampled(
            controller=controllers.PID(kp=250.0, ki=900.0, high=150.0, low=0.0), period=1e-2, delay=1.3e-3
        ),
        sensor=sensors.EncoderSlip(period=1e-2),
        actuator=actuators.DeadTime(rise=0.0063, fall=0.0052),
    ),
    "four phases": braking(
        **CAR | {"plant": plants.RoadVehicle(mass=440.0, road=roads.PiecewiseLinear())},
        controller=controllers.FourPhase(
            torque_low=500.0, torque_high=1500.0, slip_low=0.08, slip_high=0.313, rate=2e4
        ),
    ),
    "band": braking(
        **CAR,
        controller=controllers.Sampled(
            controller=controllers.BandLogic(slip_low=0.1, slip_high=0.14, growth=9.0, decay=14.0, torque=40.0),
            period=5e-3,
            delay=1.3e-3,
        ),
    ),
    "valve": braking(
        **CAR,
        controller=controllers.Relay(band=0.02, low=-1.0, high=1.3),
        reference=references.Setpoint(value=0.15),
        actuator=blocks.Series(
            blocks=(actuators.Lag(time_constant=0.004), actuators.IntegratingValve(gain=2100.0, low=3.0, high=130.0))
        ),
    ),
    "thresholds": braking(
        plant=plants.QuarterCar(mass=300.0, radius=0.3, inertia=1.0, road=roads.MagicFormula()),
        initial=d.BrakeStart(speed=8.0, slip=0.02),
        stop=SpeedReached(speed=6.0),
        sensor=sensors.SelectHigh(slope=8.0),
        controller=controllers.FivePhase(period=5e-3),
        actuator=blocks.Series(
            blocks=(
                actuators.DeadTime(rise=0.0033, fall=0.0022),
                actuators.HydraulicBrake(inlet_time=0.13, outlet_time=0.06, laminar_pressure=1e5),
            )
        ),
    ),
    "cascade": braking(
        **CAR,
        controller=controllers.Cascade(
            outer=controllers.PID(kp=20.0, ki=5.0, low=-3.0, high=3.0),
            inner=controllers.PID(kp=-4.0, ki=-30.0, low=0.0, high=90.0),
        ),
        reference=references.FixedSlip(slip=0.15),
    ),
    "delay": braking(
        **CAR,
        controller=controllers.PID(kp=300.0, kd=1.0, high=250.0, low=0.0),
        reference=references.PeakLiteral(slip=0.15),
        actuator=actuators.Delay(time=0.0123, capacity=64),
    ),
}
TANK, CHANNELS = plants.QuadrupleTank(), {"pump_1": "level_1", "pump_2": "level_2"}
LIMITS = {"low": np.zeros(2), "high": np.full(2, 10.0), "windup": np.diag([-0.2, -0.3])}


def tank(**parts):
    """Return a loop of two inputs, away from its targets."""
    initial = plants.TankStart(level_1=0.12, level_2=0.13, level_3=0.02, level_4=0.015)
    return d.Loop(plant=TANK, **{**TANK.usual_parts(), "initial": initial, **parts})


LOOPS |= {
    "two inputs": tank(
        sensor=sensors.PerOutput(
            sensor={
                "level_1": actuators.Lag(time_constant=1.5),
                "level_2": sensors.OutputNoise(deviation=1e-4, period=0.5),
                "level_3": sensors.OutputError(factor=1.02, offset=1e-3),
            }
        ),
        actuator=actuators.PerControl(actuator={"pump_1": actuators.Lag(time_constant=0.8)}),
    ),
    "two inputs, lowest": tank(
        controller=controllers.SelectLow(
            controller=controllers.PerChannel(controllers.PID(kp=150.0, ki=5.0, cutoff=1.0), CHANNELS),
            groups=(("pump_1", "pump_2"),),
        )
    ),
    "two inputs, gain": tank(
        controller=controllers.MatrixFeedback(
            gain=-np.array([[5.0, 1.0, 150.0, 10.0, 20.0, 3.0], [0.5, 4.0, 8.0, 130.0, 5.0, 15.0]]),
            outputs_at_rest=np.array([0.134, 0.127, 0.015, 0.017]),
            states=("level_1", "level_2", "level_3", "level_4"),
            **LIMITS,
        )
    ),
    "two inputs, observed": tank(
        controller=controllers.ObservedFeedback(
            gain=-np.array([[5.0, 1.0, 150.0, 10.0], [0.5, 4.0, 8.0, 130.0]]),
            state_matrix=-np.array([[0.02, 0.001], [0.002, 0.01]]),
            input_matrix=np.array([[8e-4, 1e-4], [1e-4, 6e-4]]),
            output_matrix=np.array([[1.0, 0.1], [0.05, 1.0]]),
            observer_gain=np.array([[0.3, 0.02], [0.01, 0.2]]),
            outputs_at_rest=np.array([0.134, 0.127]),
            outputs=("level_1", "level_2"),
            **LIMITS,
        )
    ),
}
OF_CHANNELS = {
    "iae": objectives.OverChannels(objective=objectives.IAE(), channels=tuple(CHANNELS.items()), weights=(1.0, 2.0)),
    "effort": objectives.InChannel(objective=objectives.Effort(), control="pump_2", output="level_2"),
}
SOLVERS = dict.fromkeys(LOOPS, d.FixedStep(5e-4, 0.8)) | {
    "feedback": d.FixedStep(2.5e-4, 0.4),
    "arm": d.FixedStep(1e-3, 0.3),
    "arm, observed": d.FixedStep(1e-3, 0.1),
    **{name: d.FixedStep(0.25, 15.0) for name in LOOPS if name.startswith("two inputs")},
}
# Step of the differences and what they may miss: their own truncation (an oscillating end wants a smaller step), and a
# kink that moves inside an integration step, where the derivative of the numerical run jumps by O(h).
ACCURACY = dict.fromkeys(LOOPS, (1e-5, 1e-6)) | {
    "feedback": (3e-6, 1e-6),
    "computer": (1e-5, 5e-5),
    "delay": (1e-5, 2e-6),
    "relay": (1e-5, 2e-5),
    "noisy": (1e-5, 2e-6),
    "speed that drifts": (1e-7, 1e-6),  # wider ones pass the corners of a noisy run: they converge with the width
    "estimated speed": (1e-7, 1e-6),
}


# The largest programs to compile, and a wheel that locks, of which test_kinks.py has closed forms.
SLOW = (
    *(
        "cascade",
        "estimated speed",
        "filtered reference",
        "arm, observed",
        "proportional",
        "computer",
        "noisy",
        "relay",
        "delay",
    ),
    *(
        "lock",
        "arm",
        "speed that drifts",
        "feedback",
        "latch",
        "extremum seeking",
        "by deceleration",
        "encoders",
        "four phases",
        "band",
        "valve",
        "thresholds",
        "given commands",
    ),
    *("two inputs", "two inputs, lowest", "two inputs, observed"),
)


MEASURES = {"arm": OF_BALANCE, "two inputs": OF_CHANNELS}


@functools.cache
def flat(name):
    """(names, values, objectives as a function of the values, its Jacobian) of the tunable parameters of a loop."""
    loop = canonical_dtypes(LOOPS[name])
    paths = [p for p, spec, v in parameters(loop) if spec.tunable and np.all(np.isfinite(v))]
    measures = next((of for word, of in MEASURES.items() if name.startswith(word)), OBJECTIVES)
    values, unravel = jax.flatten_util.ravel_pytree([get(loop, p) for p in paths])
    names = [f"{p}[{i}]" for p in paths for i in range(np.size(get(loop, p)))]

    solver = dataclasses.replace(SOLVERS[name], kinks=True)  # values as derivatives have them

    @jax.jit
    def measured(x):
        run = d.measure(replace(loop, dict(zip(paths, unravel(x), strict=True))), solver, measures, key=KEY)
        end = run.ending.sample.t  # in place of what is never reached, which has no derivative
        return jnp.stack([jnp.where(jnp.isinf(x), end, x) for x in (run.metrics[one] for one in measures)])

    return names, values, measured, jax.jit(jax.jacfwd(measured)), list(measures)


def differences(measured, x, step, floor=1e-2):
    """Central differences, relative to the size of each parameter: (log-scale gradient, scale)."""
    scale = np.maximum(np.abs(x), floor)
    moves = np.diag(scale * step)
    many = jax.jit(jax.vmap(measured))
    return np.asarray((many(x + moves) - many(x - moves)) / (2 * step)).T, scale


@pytest.mark.parametrize("name", cases(LOOPS, *SLOW))
def test_gradient_of_every_objective_in_every_parameter(name):
    names, x, measured, jacobian_at, measures = flat(name)
    jacobian = np.asarray(jacobian_at(x))
    assert np.all(np.isfinite(jacobian)), [names[j] for j in np.argwhere(~np.isfinite(jacobian))[:, 1]]
    step, tolerance = ACCURACY[name]
    # A tank's numbers are small: a flow per volt is some 1e-6.
    expected, scale = differences(measured, x, step, 1e-8 if name.startswith("two inputs") else 1e-2)
    for i, objective in enumerate(measures):
        largest = np.max(np.abs(expected[i]))
        error = np.abs(jacobian[i] * scale - expected[i])
        worst = int(np.argmax(error))
        assert error[worst] <= tolerance * largest + 1e-10, (objective, names[worst], error[worst] / largest)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["feedback", pytest.param("latch", marks=pytest.mark.slow)])
def test_reverse_mode_equals_forward_mode(name):
    _, x, measured, jacobian_at, _ = flat(name)
    weights = jnp.array(np.random.default_rng(0).normal(size=len(OBJECTIVES)))
    value, pull = jax.vjp(measured, x)
    reverse = jax.jit(pull)(weights / (1 + jnp.abs(value)))[0]
    forward = (weights / (1 + jnp.abs(value))) @ jacobian_at(x)
    np.testing.assert_allclose(reverse, forward, rtol=1e-9, atol=1e-10 * np.max(np.abs(forward)))


def _distance(logs, loop, paths):
    """Of a loop whose parameters at these paths are times exp(logs)."""
    values = {p: get(loop, p) * jnp.exp(v) for p, v in zip(paths, logs, strict=True)}
    measured = {"stop_distance": objectives.StopDistance()}
    return d.measure(replace(loop, values), d.FixedStep(1e-4, 4.0), measured).metrics["stop_distance"]


_slopes = jax.jit(jax.jacfwd(_distance), static_argnums=2)
_distances = jax.jit(jax.vmap(_distance, (0, None, None)), static_argnums=2)


def _sensitivity(loop, paths, difference=None):
    """d(distance)/d ln(parameter) for each path, by forward mode or a central difference of that relative size."""
    loop, paths = canonical_dtypes(loop), tuple(paths)
    if difference is None:
        return np.asarray(_slopes(jnp.zeros(len(paths)), loop, paths))
    moves = difference * jnp.eye(len(paths))
    lanes = _distances(jnp.concatenate([moves, -moves]), loop, paths)
    return np.asarray(lanes[: len(paths)] - lanes[len(paths) :]) / (2 * difference)


FULL = braking(plant=plants.QuarterCar(road=roads.MagicFormula(), inertia=1.0539))


@killed_by(
    "parts.plants.quarter_car",
    "mu = self.output(state).deceleration / GRAVITY",
    "mu = __import__('jax').lax.stop_gradient(self.output(state).deceleration / GRAVITY)",
)
@pytest.mark.slow
def test_sensitivity_of_the_conventional_brake():
    """d(distance)/d ln p of [est]'s P loop; expected: differences (1e-3) of SciPy runs of oracles.py."""
    expected = {
        "controller.kp": 0.33163,
        "reference.slip": 3.873,
        "plant.inertia": 0.98866,
        "controller.high": -0.93409,
        "plant.road.D": -43.27,
    }
    np.testing.assert_allclose(_sensitivity(FULL, list(expected)), list(expected.values()), rtol=5e-4, atol=0)


@killed_by("engine.step.event_location", "located = near | at_once", "located = at_once", case="0.0-published0")
@pytest.mark.slow
@pytest.mark.parametrize(
    ("ki", "published"),
    [(0.0, (4.305, -4.646)), (5000.0, None)],  # by another program with the same correction
)
def test_the_gradient_through_the_latch_is_a_wide_difference(ki, published):
    """A narrow difference would agree with a wrong derivative: both miss how the latched slip moves between samples."""
    loop = dataclasses.replace(
        FULL, reference=references.PeakLatch(), controller=controllers.PID(ki=ki, low=0.0, high=90.0)
    )
    paths = ["plant.inertia", "controller.high"]
    ours = _sensitivity(loop, paths)
    np.testing.assert_allclose(ours, _sensitivity(loop, paths, difference=1e-2), rtol=1e-3, atol=0)
    if published:
        np.testing.assert_allclose(ours, published, rtol=1e-3, atol=0)


@pytest.mark.slow
def test_a_maximum_on_a_knot_has_the_slip_of_the_knot():
    """Where the spline of the paper has its greatest friction, its curvature jumps; whatever the inertia."""
    loop = dataclasses.replace(FULL, reference=references.PeakLatch(), controller=controllers.PID(low=0.0, high=90.0))
    loop = dataclasses.replace(
        loop, plant=plants.QuarterCar(road=roads.SPLINE_B), initial=d.BrakeStart(speed=100 / 3.6)
    )

    def greatest(log):
        one = replace(loop, {"plant.inertia": jnp.exp(log) * loop.plant.inertia})
        return d.measure(one, d.FixedStep(1e-4, 1.0), {"max_slip": MaxSlip()}).metrics["max_slip"]

    value, slope = jax.jvp(greatest, (0.0,), (1.0,))
    np.testing.assert_allclose(value, 0.10539, rtol=1e-9)
    assert abs(slope) < 1e-6


def test_every_part_is_differentiated_in_some_loop():
    def classes(part):
        yield type(part).__name__
        for field in dataclasses.fields(part):
            value = getattr(part, field.name)
            value = tuple(value.values()) if isinstance(value, dict) else value
            for item in value if isinstance(value, tuple) else (value,):
                if dataclasses.is_dataclass(item):
                    yield from classes(item)

    used = {name for loop in LOOPS.values() for name in classes(loop)}
    offered = {
        name
        for family in (plants, roads, controllers, references, actuators, sensors)
        for name, part in vars(family).items()
        if dataclasses.is_dataclass(part) and isinstance(part, type)
    }
    # Runs of cars take a minute to compile; their own tests differentiate them.
    assert offered - used == {
        *(
            "BrakeDistribution",
            "Car",
            "ConstantPads",
            "FadingPads",
            "HalfCar",
            "HoldCourse",
            "PacejkaTyre",
            "RelaxedTyre",
            "RoadTyre",
        ),
    }
