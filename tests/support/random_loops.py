"""Random closed loops of all parts, in few structures: what is compiled once serves every loop of a structure.

`drawn(number, seed)` is always the same loop. The values are such that a run has its events well within (switches,
latches, limits, a locked wheel, an edge of the road) and stops after a second or so. Left out are the parts whose
derivative is documented to say nothing of their jumps: quantisation, a sharp edge of a road, and the literal estimator,
whose braking is the delay of one sample."""

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, NamedTuple

import linear_plant
import numpy as np

import diffabs as d
from diffabs import actuators, controllers, objectives, plants, references, roads, sensors
from diffabs.core.blocks import Direct, Series
from diffabs.core.pytree import parameters, replace
from diffabs.parts.stops import Fallen, NoStop, SpeedReached, Standstill
from diffabs.scenario.defaults import braking

BRAKING = {
    **objectives.BRAKING,
    "itae": objectives.ITAE(),
    "quadratic": objectives.QuadraticCost(q=np.array([30.0, 20.0]), r=1e-3),
    "effort": objectives.Effort(),
    "variation": objectives.Variation(),
    "torque_rate": objectives.TorqueRate(),
}
BALANCE = {
    **objectives.BALANCE,
    "balance_cost": objectives.BalanceCost(r=1e-4),
    "soft_loss": objectives.SoftLoss(),
}


PAIRS = {"left": "a", "right": "b", "middle": "c"}  # output that each control controls


def in_channels(count: int) -> dict[str, Any]:
    """Return objectives of a loop with this number of channels."""
    pairs = tuple(PAIRS.items())[:count]
    return {
        "iae": objectives.OverChannels(channels=pairs, weights=(1.0, 2.0, 0.5)[:count]),
        "itae": objectives.InChannel(objective=objectives.ITAE(), output="b"),
        "effort": objectives.InChannel(objective=objectives.Effort(), control="left"),
        "variation": objectives.InChannel(objective=objectives.Variation(), control="right"),
        "overshoot": objectives.InChannel(objective=objectives.Overshoot(), output="a", control="left"),
    }


class Draw:
    """Random numbers of a loop."""

    def __init__(self, rng: np.random.Generator):
        self.rng = rng

    def near(self, value: float, spread: float = 0.25) -> float:
        """A number of this size, off by up to exp(spread)."""
        return float(value * np.exp(self.rng.uniform(-spread, spread)))

    def within(self, low: float, high: float) -> float:
        """A number between these."""
        return float(self.rng.uniform(low, high))

    def spline(self) -> roads.Tabulated:
        """A measured road: it rises to a peak at a knot, and falls."""
        peak, most = self.within(0.08, 0.16), self.within(0.85, 1.1)
        slip = np.array([0.0, 0.25 * peak, 0.6 * peak, peak, 1.8 * peak, 3.0 * peak, 0.75, 1.0])
        share = np.array([0.0, 0.5, 0.85, 1.0, 0.95, 0.88, 0.8, 0.75])
        share[1:] *= np.exp(self.rng.uniform(-0.01, 0.01, 7))
        return roads.Tabulated(slip=slip, mu=most * share)

    def car(self, road: Any, rolling: bool = False, **fields: Any) -> dict[str, Any]:
        """A quarter car that is to stop from middling speed. One that is rolling has no slip at the start: where the
        torque comes late, the deceleration would fall from the first instant on, and a latch take that for a peak."""
        slip = 0.0 if rolling else self.within(0.01, 0.04)
        parts = {
            "plant": plants.QuarterCar(road=road, inertia=self.near(0.5, 0.4)),
            "initial": d.BrakeStart(speed=self.within(14.0, 18.0), slip=slip),
            "stop": SpeedReached(speed=self.within(6.0, 8.0)),
        }
        return parts | fields

    def rig(self) -> dict[str, Any]:
        """The mirrored rig."""
        return {
            "plant": plants.MirroredRig(),
            "initial": d.BrakeStart(speed=self.within(10.0, 12.0), slip=self.within(0.02, 0.06)),
            "stop": SpeedReached(speed=self.within(6.0, 7.0)),
        }

    def pid(self, kp: float = 1200.0, antiwindup: Any = None, most: float = 120.0) -> controllers.PID:
        """PID with all of its terms."""
        return controllers.PID(
            kp=self.near(kp),
            ki=self.near(3.0 * kp, 0.8),
            kd=self.near(2e-3 * kp),
            low=self.within(1.0, 4.0),
            high=self.near(most),
            antiwindup=antiwindup or controllers.NoAntiWindup(),
        )

    def relay(self, band: float = 0.02) -> controllers.Relay:
        """A relay whose lower torque still brakes."""
        return controllers.Relay(band=self.near(band), low=self.within(2.0, 8.0), high=self.near(140.0, 0.15))

    def patches(self, *surfaces: Any) -> roads.Patches:
        """Surfaces in a row, with smooth edges."""
        edges = np.cumsum([self.within(1.5, 4.0) for _ in surfaces[1:]])
        return roads.Patches(roads=surfaces, edges=edges, width=self.within(0.3, 0.8))


class Structure(NamedTuple):
    """Loops that one program runs."""

    make: Callable[[Draw], d.Loop]
    step: float = 1e-4
    duration: float = 2.5
    objectives: Mapping[str, Any] = BRAKING


def latch(r: Draw) -> d.Loop:
    return braking(
        **r.car(roads.DRY_ASPHALT), controller=r.pid(), reference=references.PeakLatch(slip=r.within(0.2, 0.3))
    )


def latch_spline(r: Draw) -> d.Loop:
    return braking(
        **r.car(r.spline(), rolling=True, stop=Standstill(speed=r.within(5.0, 7.0))),
        controller=r.pid(900.0, controllers.BackCalculation(tracking_time=r.near(0.03))),
        reference=references.PeakLatch(slip=r.within(0.2, 0.3)),
        actuator=actuators.Lag(time_constant=r.near(0.004)),
    )


def relay(r: Draw) -> d.Loop:
    return braking(
        **r.car(roads.MagicFormula()),
        controller=r.relay(),
        reference=references.FixedSlip(slip=r.near(0.15)),
        actuator=actuators.Limits(low=r.within(0.5, 1.5), high=r.near(110.0, 0.1)),
    )


def relay_latch(r: Draw) -> d.Loop:
    return braking(
        **r.car(roads.DRY_CONCRETE, rolling=True),
        controller=r.relay(0.03),
        reference=references.PeakLatch(slip=r.within(0.2, 0.3)),
        actuator=actuators.Lag(time_constant=r.near(0.008)),
    )


def robust(r: Draw) -> d.Loop:
    return braking(
        **r.car(roads.WET_ASPHALT),
        controller=r.pid(1000.0, controllers.Clamping(), 90.0),
        reference=references.PeakRobust(
            slip=r.within(0.25, 0.35), time_constant=r.near(0.01), threshold=r.near(0.01), arming=2.0
        ),
        sensor=Series(
            blocks=(
                sensors.Bias(slip=1e-3, speed=0.02, wheel_speed=0.01, deceleration=0.05),
                sensors.WheelSpeed(time_constant=r.near(0.003)),
            )
        ),
    )


def robust_noise(r: Draw) -> d.Loop:
    noise = sensors.Noise(slip=1e-3, speed=0.01, wheel_speed=0.01, deceleration=r.near(0.1), period=2e-3)
    return braking(
        **r.car(roads.MagicFormula()),
        controller=controllers.SlidingMode(
            gain=r.near(120.0), boundary=r.near(0.06), low=r.within(1.0, 4.0), high=r.near(90.0)
        ),
        feedforward=controllers.ConstantInput(value=r.near(12.0)),
        reference=references.PeakRobust(
            slip=r.within(0.25, 0.35), time_constant=r.near(0.02), threshold=r.near(0.02), arming=2.0
        ),
        sensor=Series(blocks=(noise, sensors.IntegratedAccelerometer(bias=r.within(-0.1, 0.1)))),
    )


def rig(r: Draw) -> d.Loop:
    return braking(
        **r.rig(),
        controller=controllers.StateFeedback(
            gain=np.array([-r.near(9000.0), -r.near(90.0)]),
            low=r.within(0.1, 0.4),
            high=r.near(3.0),
            antiwindup=controllers.BackCalculation(tracking_time=r.near(0.02)),
        ),
        feedforward=controllers.HoldingInput(),
        reference=references.FilteredSlip(slip=r.near(0.15), time_constant=r.near(0.03)),
        actuator=actuators.Lag(time_constant=r.near(0.002)),
    )


def rig_scheduled(r: Draw) -> d.Loop:
    return braking(
        **r.rig(),
        controller=controllers.ScheduledFeedback(
            speeds=np.array([5.0, r.near(8.0, 0.1), 14.0]),
            integral_gains=-np.array([r.near(900.0) for _ in range(3)]),
            gains=-np.array([r.near(60.0) for _ in range(3)]),
            low=r.within(0.1, 0.4),
            high=r.near(4.0),
            antiwindup=controllers.Clamping(),
        ),
        feedforward=controllers.ConstantInput(value=r.near(1.5)),
        reference=references.FixedSlip(slip=r.near(0.15)),
        actuator=actuators.Delay(time=r.near(0.00313), capacity=128),
    )


def rig_proportional(r: Draw) -> d.Loop:
    return braking(
        **r.rig(),
        sensor=sensors.SpeedScale(factor=r.near(1.0, 0.02)),
        controller=controllers.ProportionalFeedback(
            gain=np.array([-r.near(2000.0), -r.near(100.0)]), low=r.within(0.1, 0.4), high=r.near(4.0)
        ),
        feedforward=controllers.HoldingInput(),
        reference=references.FixedSlip(slip=r.near(0.15)),
        actuator=actuators.RateLimit(rate=r.near(150.0), time_constant=r.near(0.003)),
    )


def rig_clamped(r: Draw) -> d.Loop:
    return braking(
        **r.rig(),
        controller=controllers.StateFeedback(
            gain=np.array([-r.near(3000.0), -r.near(90.0)]),
            low=r.within(0.1, 0.4),
            high=r.near(5.0),
            antiwindup=controllers.Clamping(),
        ),
        feedforward=controllers.HoldingInput(),
        reference=references.LimitedSlip(slip=r.near(0.15), rate=r.near(2.0), time_constant=r.near(0.02), period=2e-3),
    )


def rig_on_grid(r: Draw, speed: Any) -> d.Loop:
    return braking(
        **r.rig(),
        sensor=Series(blocks=(sensors.WheelNoise(slip=1e-3, period=2e-3), *speed)),
        controller=controllers.SampledOnGrid(
            controller=controllers.ProportionalFeedback(
                gain=np.array([-r.near(2000.0), -r.near(100.0)]),
                low=r.within(0.1, 0.4),
                high=r.near(4.0),
                antiwindup=controllers.BackCalculation(tracking_time=r.near(0.05)),
            ),
            sampling_period=2e-3,
            delay=r.within(1e-4, 1.9e-3),
        ),
        feedforward=controllers.ConstantInput(value=r.near(1.5)),
        reference=references.LimitedSlip(slip=r.near(0.15), rate=r.near(3.0), time_constant=r.near(0.02), period=2e-3),
        actuator=actuators.Lag(time_constant=r.near(0.002)),
    )


def rig_drifting(r: Draw) -> d.Loop:
    first, last = r.within(-0.03, 0.03), r.within(-0.03, 0.03)
    return rig_on_grid(r, (sensors.DriftingSpeed(first=first, last=last, time_constant=r.near(0.3)),))


def rig_estimated(r: Draw) -> d.Loop:
    noise = sensors.Noise(deceleration=r.near(0.1), period=2e-3)
    return rig_on_grid(r, (noise, sensors.SpeedEstimator(gate=r.near(0.2), growth=r.near(0.3), period=2e-3)))


def lab_rig(r: Draw) -> d.Loop:
    return braking(
        plant=plants.LabRig(),
        initial=d.BrakeStart(speed=r.within(10.0, 12.0), slip=r.within(0.05, 0.1)),
        stop=SpeedReached(speed=r.within(5.0, 6.0)),
        controller=controllers.Relay(band=r.near(0.03), low=r.within(0.45, 0.5), high=r.within(0.7, 0.9)),
        reference=references.Setpoint(value=r.near(0.2)),
    )


def lock(r: Draw) -> d.Loop:
    return braking(
        plant=plants.LabRig(),
        initial=d.BrakeStart(speed=r.within(8.0, 9.0), slip=r.within(0.05, 0.1)),
        stop=SpeedReached(speed=r.within(4.0, 5.0)),
        controller=controllers.ConstantTorque(torque=r.within(0.85, 1.0)),
    )


def lock_and_free(r: Draw) -> d.Loop:
    return braking(
        **r.car(roads.DRY_ASPHALT),
        controller=r.relay(0.3),
        reference=references.FixedSlip(slip=r.near(0.5, 0.1)),
        actuator=actuators.Lag(time_constant=r.near(0.02)),
    )


def computer(r: Draw) -> d.Loop:
    surface = roads.Scaled(road=r.spline(), scale=r.within(0.6, 0.8))
    return braking(
        **r.car(r.patches(roads.DRY_CONCRETE, surface)),
        controller=controllers.Sampled(
            controller=r.pid(600.0, controllers.Clamping()), period=5e-3, delay=r.within(0.6e-3, 4e-3)
        ),
        reference=references.FixedSlip(slip=r.near(0.15)),
        actuator=Series(blocks=(actuators.RateLimit(rate=r.near(4000.0)), actuators.Lag(time_constant=r.near(0.003)))),
    )


def computer_latch(r: Draw) -> d.Loop:
    return braking(
        **r.car(roads.DRY_ASPHALT, rolling=True),
        controller=controllers.Sampled(
            controller=controllers.StateFeedback(
                gain=np.array([-r.near(2000.0), -r.near(500.0)]), low=r.within(1.0, 4.0), high=r.near(90.0)
            ),
            period=2e-3,
            delay=r.within(0.3e-3, 1.7e-3),
        ),
        feedforward=controllers.HoldingInput(),
        reference=references.PeakLatch(slip=r.within(0.2, 0.3)),
    )


def patches_latch(r: Draw) -> d.Loop:
    return braking(
        **r.car(r.patches(roads.DRY_CONCRETE, roads.WET_ASPHALT, roads.MagicFormula()), rolling=True),
        controller=r.pid(400.0),
        reference=references.PeakLatch(slip=r.within(0.2, 0.3)),
        actuator=Series(
            blocks=(
                actuators.Delay(time=r.near(1.7e-3), capacity=64),
                actuators.Lag(time_constant=r.near(0.003)),
                actuators.Limits(low=r.within(0.2, 0.8), high=r.near(80.0, 0.1)),
            )
        ),
    )


def relay_delay(r: Draw) -> d.Loop:
    return braking(
        **r.car(r.spline(), rolling=True),
        controller=r.relay(0.02),
        reference=references.PeakLatch(slip=r.within(0.2, 0.3)),
        actuator=actuators.Delay(time=r.near(2.2e-3), capacity=64),
    )


def sliding(r: Draw) -> d.Loop:
    return braking(
        **r.car(r.patches(roads.DRY_COBBLESTONE, roads.DRY_ASPHALT)),
        controller=controllers.SlidingMode(
            gain=r.near(120.0), boundary=r.near(0.05), low=r.within(1.0, 4.0), high=r.near(100.0)
        ),
        reference=references.FilteredSlip(slip=r.near(0.2), time_constant=r.near(0.05)),
        sensor=sensors.WheelSpeed(time_constant=r.near(0.003)),
        actuator=actuators.RateLimit(rate=r.near(2500.0), time_constant=r.near(0.003)),
    )


def scheduled_robust(r: Draw) -> d.Loop:
    return braking(
        **r.car(roads.MagicFormula()),
        controller=controllers.ScheduledFeedback(
            speeds=np.array([5.0, r.near(10.0, 0.1), 20.0]),
            integral_gains=-np.array([r.near(2000.0) for _ in range(3)]),
            gains=-np.array([r.near(500.0) for _ in range(3)]),
            low=r.within(1.0, 4.0),
            high=r.near(90.0),
            antiwindup=controllers.BackCalculation(tracking_time=r.near(0.03)),
        ),
        reference=references.PeakRobust(
            slip=r.within(0.25, 0.35), time_constant=r.near(0.005), threshold=r.near(0.01), arming=2.0
        ),
        sensor=sensors.IntegratedAccelerometer(bias=r.within(-0.2, 0.2)),
    )


def along(r: Draw, reference: Any) -> d.Loop:
    factors = np.exp([r.within(-0.1, 0.1) for _ in range(6)])
    return braking(
        **r.car(roads.ScaledAlong(road=roads.MagicFormula(), factors=factors, spacing=r.near(3.0))),
        controller=r.pid(600.0),
        reference=reference,
        sensor=sensors.PlayedWheelNoise(noise=[r.within(-2e-3, 2e-3) for _ in range(7)], period=5e-3),
        actuator=actuators.Lag(time_constant=r.near(0.004)),
    )


def seeking(r: Draw) -> d.Loop:
    return along(
        r,
        references.ExtremumSeeking(
            slip=r.near(0.12), gain=r.near(3.0), dither=r.near(0.1), frequency=r.near(30.0), time_constant=r.near(0.1)
        ),
    )


def by_deceleration(r: Draw) -> d.Loop:
    slips = np.array([0.08, 0.1, 0.12, 0.14]) * r.near(1.0)
    return along(r, references.SlipByDeceleration(slips=slips, time_constant=r.near(0.05)))


def given_commands(r: Draw) -> d.Loop:
    return braking(
        **r.car(roads.WET_ASPHALT, rolling=True),
        controller=controllers.PlayedCommand(commands=[r.within(20.0, 60.0) for _ in range(12)], period=0.05),
        actuator=Series(
            blocks=(
                actuators.DeadTime(rise=r.near(0.012), fall=r.near(0.007)),
                actuators.AsymmetricLag(rise=r.near(0.01), fall=r.near(0.005)),
            )
        ),
    )


def encoders(r: Draw) -> d.Loop:
    return braking(
        **r.car(roads.DRY_CONCRETE, rolling=True),
        controller=controllers.Sampled(
            controller=controllers.PID(kp=r.near(150.0), ki=r.near(400.0), low=r.within(1.0, 4.0), high=r.near(110.0)),
            period=1e-2,
        ),
        reference=references.FixedSlip(slip=r.near(0.1)),
        sensor=sensors.EncoderSlip(period=1e-2),
        actuator=actuators.DeadTime(rise=r.near(0.006), fall=r.near(0.004)),
    )


def four_phases(r: Draw) -> d.Loop:
    return braking(
        **r.car(
            roads.DRY_ASPHALT,
            rolling=True,
            plant=plants.RoadVehicle(mass=r.near(440.0), drag=r.near(0.8), road=roads.PiecewiseLinear()),
        ),
        controller=controllers.FourPhase(
            torque_low=r.near(500.0),
            torque_high=r.near(1500.0, 0.1),
            slip_low=r.near(0.08),
            slip_high=r.near(0.3, 0.1),
            rate=r.near(2e4),
        ),
    )


def band(r: Draw) -> d.Loop:
    return braking(
        **r.car(roads.DRY_ASPHALT, rolling=True),
        controller=controllers.Sampled(
            controller=controllers.BandLogic(
                slip_low=r.near(0.1, 0.1),
                slip_high=r.near(0.14, 0.1),
                growth=r.near(9.0),
                decay=r.near(14.0),
                torque=r.near(40.0),
            ),
            period=5e-3,
            delay=r.within(0.6e-3, 4e-3),
        ),
    )


def valve(r: Draw) -> d.Loop:
    return braking(
        **r.car(roads.MagicFormula(), rolling=True),
        controller=controllers.Relay(band=r.near(0.02), low=-r.near(1.0), high=r.near(1.0)),
        reference=references.FixedSlip(slip=r.near(0.12)),
        actuator=Series(
            blocks=(
                actuators.Lag(time_constant=r.near(0.004)),
                actuators.IntegratingValve(gain=r.near(2000.0), low=r.within(1.0, 4.0), high=r.near(110.0, 0.1)),
            )
        ),
    )


def arm(r: Draw) -> d.Loop:
    return braking(
        plant=plants.ArmBalance(gear=1.1, rotor_inertia=0.3, current_max=r.near(40.0)),
        initial=_leaning(r, 0.02),
        reference=references.Upright(),
        controller=controllers.BalanceFeedback(),
        actuator=Series(
            blocks=(actuators.VoltageLimit(high=r.near(100.0)), actuators.Lag(time_constant=r.near(0.002)))
        ),
        stop=Fallen(),
    )


def observed(r: Draw) -> d.Loop:
    return braking(
        plant=plants.PrintedArm(),
        initial=_leaning(r, 0.1),
        reference=references.Upright(),
        sensor=sensors.AngleSensor(theta=1e-4, psi=1e-4, period=5e-3),
        controller=controllers.Sampled(
            controller=controllers.ObserverFeedback(
                gain=np.array([90.0, -4.0, 30.0, 25.0, -3.0, 10.0]),
                transition=0.9 * np.eye(6) + 0.01 * np.eye(6, k=3),
                entry=np.array([0.0, 0.0, 0.0, -0.01, 0.03, 0.02]),
                correction=np.linspace(0.05, 0.6, 12).reshape(6, 2),
                predicted_high=r.near(12.0),
            ),
            period=5e-3,
            delay=r.within(0.3e-3, 4e-3),
        ),
        actuator=actuators.VoltageLimit(high=r.near(9.0)),
        stop=Fallen(),
    )


def fall(r: Draw) -> d.Loop:
    return braking(
        plant=plants.ACROBOT,
        initial=_leaning(r, 0.1),
        reference=references.Upright(),
        controller=controllers.BalanceFeedback(gain=np.array([5.0, 2.0, 0.1, 2.0, 1.0, 0.1])),
        actuator=actuators.VoltageLimit(high=r.near(1.0)),
        sensor=Direct(),
        stop=Fallen(angle=r.within(0.5, 0.8)),
    )


def _leaning(r: Draw, size: float) -> plants.BalanceStart:
    angles = {name: r.near(size) for name in ("theta", "psi", "phi")}
    return plants.BalanceStart(**angles, **{f"{name}_rate": r.near(0.3 * size) for name in angles})


def channels(r: Draw, count: int, **fields: Any) -> d.Loop:
    """Return a loop of two or three channels on a linear plant with one hidden state."""
    outputs = list(PAIRS.values())[:count]
    targets = {name: references.Setpoint(value=r.within(0.3, 0.8)) for name in outputs}
    targets["b"] = linear_plant.Filtered(value=r.within(0.3, 0.8), time_constant=r.near(0.1))
    parts = {
        "plant": linear_plant.draw_plant(r.rng, count),
        "initial": linear_plant.Start(x=r.rng.uniform(-0.2, 0.2, count + 1)),
        "reference": references.PerTarget(reference=targets),
        "feedforward": controllers.HoldingInput(),
        "stop": NoStop(),
    }
    return d.Loop(**parts | fields)


def channel_pid(r: Draw, antiwindup: Any = None, derivative: bool = False, integral: bool = True) -> controllers.PID:
    """Return a PID of one channel that meets its limits."""
    return controllers.PID(
        kp=r.near(5.0),
        ki=r.near(4.0, 0.5) if integral else 0.0,
        kd=r.near(0.1) if derivative else 0.0,
        cutoff=r.near(15.0),
        low=-r.within(0.3, 1.0),
        high=r.within(1.2, 2.2),
        antiwindup=antiwindup or controllers.NoAntiWindup(),
    )


def per_channel(*each: Any) -> controllers.PerChannel:
    """Return these controllers, one for each channel."""
    names = list(PAIRS)[: len(each)]
    return controllers.PerChannel(dict(zip(names, each, strict=True)), {name: PAIRS[name] for name in names})


def channel_noise(r: Draw) -> sensors.OutputNoise:
    """Return noise of one output."""
    return sensors.OutputNoise(deviation=r.near(0.02), period=0.04)


def back_calculation(r: Draw) -> controllers.BackCalculation:
    return controllers.BackCalculation(tracking_time=r.near(0.3))


def two_pids(r: Draw) -> d.Loop:
    chain = Series(blocks=(actuators.RateLimit(rate=r.near(20.0), time_constant=r.near(0.02)), limits(r)))
    return channels(
        r,
        2,
        controller=per_channel(channel_pid(r, controllers.Clamping(), True), channel_pid(r, back_calculation(r))),
        actuator=actuators.PerControl(actuator={"left": actuators.Lag(time_constant=r.near(0.05)), "right": chain}),
        sensor=sensors.PerOutput(sensor={"a": actuators.Lag(time_constant=r.near(0.03))}),
    )


def limits(r: Draw) -> actuators.Limits:
    return actuators.Limits(low=-r.within(0.2, 0.5), high=r.within(0.9, 1.4))


def two_computers(r: Draw) -> d.Loop:
    fast = controllers.Sampled(
        controller=channel_pid(r, controllers.Clamping()), period=0.04, delay=r.within(5e-3, 0.03)
    )
    slow = controllers.Sampled(controller=channel_pid(r, None, True), period=0.05, delay=0.0)
    return channels(
        r,
        2,
        controller=per_channel(fast, slow),
        actuator=actuators.PerControl(actuator={"left": limits(r), "right": actuators.Lag(time_constant=r.near(0.05))}),
        sensor=sensors.PerOutput(sensor={"b": channel_noise(r)}),
    )


def two_delays(r: Draw) -> d.Loop:
    delay = actuators.Delay(time=r.near(0.0313), capacity=64)
    return channels(
        r,
        2,
        controller=controllers.SelectLow(
            controller=per_channel(channel_pid(r), channel_pid(r, back_calculation(r))), groups=(("left", "right"),)
        ),
        actuator=actuators.PerControl(
            actuator={"left": Series(blocks=(delay, actuators.Lag(time_constant=r.near(0.03)))), "right": limits(r)}
        ),
    )


def matrix_fields(r: Draw, count: int, states: int) -> dict[str, Any]:
    """Return gain, anti-windup and limits of a full gain."""
    integral = -np.diag([r.near(3.0) for _ in range(count)]) + r.rng.uniform(-0.4, 0.4, (count, count))
    proportional = -3.0 * np.eye(count, states) + r.rng.uniform(-0.5, 0.5, (count, states))
    return {
        "gain": np.hstack([integral, proportional]),
        "windup": np.linalg.inv(integral) / r.near(0.3),
        "low": -np.array([r.within(0.3, 1.0) for _ in range(count)]),
        "high": np.array([r.within(0.8, 1.6) for _ in range(count)]),
        "outputs_at_rest": r.rng.uniform(0.0, 0.2, count),
    }


def full_gain(r: Draw, count: int) -> d.Loop:
    outputs = tuple(PAIRS.values())[:count]
    return channels(
        r,
        count,
        controller=controllers.MatrixFeedback(**matrix_fields(r, count, count), states=outputs),
        actuator=actuators.PerControl(
            actuator={"left": actuators.AsymmetricLag(rise=r.near(0.06), fall=r.near(0.03)), "right": limits(r)}
        ),
        sensor=sensors.PerOutput(sensor={"a": channel_noise(r)}),
    )


def observed_channels(r: Draw, count: int) -> d.Loop:
    model = linear_plant.draw_plant(r.rng, count)
    return channels(
        r,
        count,
        controller=controllers.ObservedFeedback(
            **matrix_fields(r, count, count + 1),
            state_matrix=model.A,
            input_matrix=model.B,
            output_matrix=np.eye(count, count + 1),
            observer_gain=4.0 * np.eye(count + 1, count) + r.rng.uniform(-0.5, 0.5, (count + 1, count)),
            outputs=tuple(PAIRS.values())[:count],
        ),
        sensor=sensors.PerOutput(sensor={"b": channel_noise(r)}),
    )


def three_computers(r: Draw) -> d.Loop:
    each = per_channel(
        channel_pid(r, controllers.Clamping()), channel_pid(r, None, True), channel_pid(r, None, False, False)
    )
    return channels(
        r,
        3,
        controller=controllers.Sampled(controller=each, period=0.04, delay=r.within(5e-3, 0.03)),
        actuator=actuators.PerControl(
            actuator={
                "left": actuators.DeadTime(rise=r.near(0.03), fall=r.near(0.02)),
                "middle": actuators.Lag(time_constant=r.near(0.04)),
                "right": limits(r),
            }
        ),
        sensor=sensors.PerOutput(sensor={"c": channel_noise(r)}),
    )


def three_logic(r: Draw) -> d.Loop:
    first = per_channel(channel_pid(r), channel_pid(r, None, True), channel_pid(r, controllers.Clamping()))
    second = controllers.PerChannel(channel_pid(r, None, False, False), PAIRS)
    least = linear_plant.LeastOf(first=first, second=second)
    return channels(
        r,
        3,
        controller=linear_plant.Difference(controller=least, limit=r.within(0.1, 0.3)),
        actuator=actuators.PerControl(actuator={"left": actuators.Lag(time_constant=r.near(0.04)), "right": limits(r)}),
    )


CHANNELS = {
    "two channels, PIDs": (two_pids, 2),
    "two channels, computers, noise": (two_computers, 2),
    "two channels, delay, select low": (two_delays, 2),
    "two channels, full gain": (partial(full_gain, count=2), 2),
    "two channels, observer": (partial(observed_channels, count=2), 2),
    "three channels, full gain": (partial(full_gain, count=3), 3),
    "three channels, computer, noise": (three_computers, 3),
    "three channels, logic": (three_logic, 3),
}
STRUCTURES = {
    "latch": Structure(latch),
    "latch, spline, lag": Structure(latch_spline),
    "relay": Structure(relay),
    "relay, latch, lag": Structure(relay_latch),
    "robust latch, wheel speed": Structure(robust),
    "robust latch, noise": Structure(robust_noise),
    "rig, filtered": Structure(rig),
    "rig, scheduled, delay": Structure(rig_scheduled),
    "rig, proportional, rate limit": Structure(rig_proportional),
    "rig, limited, clamped": Structure(rig_clamped),
    "rig, speed that drifts": Structure(rig_drifting),
    "rig, estimated speed": Structure(rig_estimated),
    "given commands, dead times": Structure(given_commands),
    "encoders, dead times": Structure(encoders),
    "four phases, road vehicle": Structure(four_phases),
    "band": Structure(band),
    "valve": Structure(valve),
    "extremum seeking": Structure(seeking),
    "slip by deceleration": Structure(by_deceleration),
    "lab rig, relay": Structure(lab_rig),
    "lab rig, lock": Structure(lock),
    "lock and free": Structure(lock_and_free),
    "computer, patches": Structure(computer),
    "computer, latch": Structure(computer_latch),
    "patches, latch, delay": Structure(patches_latch),
    "spline, relay, latch, delay": Structure(relay_delay),
    "sliding mode, patches": Structure(sliding),
    "scheduled, robust latch": Structure(scheduled_robust),
    "arm": Structure(arm, 5e-4, 0.5, BALANCE),
    "arm, observed": Structure(observed, 1e-3, 0.4, BALANCE),
    "fall": Structure(fall, 1e-3, 3.0, BALANCE),
    **{name: Structure(make, 2.5e-3, 2.0, in_channels(count)) for name, (make, count) in CHANNELS.items()},
}


def drawn(name: str, number: int, seed: int) -> d.Loop:
    """Loop `number` of a seed, of the structure `name`. Beyond what the structure draws itself, every tunable number
    that is not 0 is off by up to a twentieth; not those of a tabulated road, which has an order to keep."""
    rng = np.random.default_rng([seed, number])
    loop = STRUCTURES[name].make(Draw(rng))
    moved = {}
    for path, spec, value in parameters(loop):
        if spec.tunable and not path.endswith(("road.slip", "road.mu")):
            value = np.asarray(value, float)
            moved[path] = value * np.exp(rng.uniform(-0.05, 0.05, value.shape))
    return replace(loop, moved)


def numbers(loop: d.Loop, measures: Mapping[str, Any]) -> dict[str, list[tuple[int, ...]]]:
    """The tunable numbers of a loop and of what it is measured by, by path: places in their array. The knots of a
    road at slip 0 and 1 stay where its rules have them, and a wheel that rolls does not slip."""
    found: dict[str, list[tuple[int, ...]]] = {}
    parts = [("", loop), *((f"{name}:", part) for name, part in measures.items())]
    for prefix, part in parts:
        for path, spec, value in parameters(part):
            rolls = path == "initial.slip" and value == 0
            if not spec.tunable or rolls or not np.all(np.isfinite(value)):
                continue
            places = list(np.ndindex(np.shape(value)))
            if path.endswith("road.slip"):
                places = places[1:-1]
            elif path.endswith("road.mu"):
                places = places[1:]
            found[prefix + path] = places
    return found
