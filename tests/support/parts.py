"""One instance, at least, of every part. A new part needs one line here; tests/test_conformance.py does the rest.

Values differ from the defaults where a default would hide something: a gain of zero, a limit never reached, a delay at
the end of its range. Below them: the signals that blocks and objectives are fed, and derivatives by differences.
"""

import dataclasses
from collections.abc import Iterator
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from diffabs import actuators, controllers, objectives, plants, references, roads, sensors, stops
from diffabs.core import blocks
from diffabs.core.blocks import offers, record_signal
from diffabs.core.cubic import HermiteStep
from diffabs.core.numerics import axpy
from diffabs.core.protocols import (
    BalanceOutput,
    BrakeOutput,
    Clock,
    Ending,
    Memory,
    Sample,
    Segment,
    Tracking,
)
from diffabs.core.pytree import canonical_dtypes
from diffabs.engine.step.runge_kutta import rk4_step

FAMILIES = (roads, plants, controllers, references, actuators, sensors, objectives, stops, blocks)

ROADS: dict[str, Any] = {
    **{name: road for name, road in vars(roads).items() if name.isupper()},
    "walking speed": roads.Burckhardt(c4=0.0),
    "magic": roads.MagicFormula(),
    "scaled": roads.Scaled(road=roads.RIG, scale=0.8),
    "patches": roads.Patches(),
    "patches, three": roads.Patches(
        roads=(roads.Scaled(road=roads.DRY_ASPHALT, scale=0.9), roads.MagicFormula(), roads.WET_ASPHALT),
        edges=np.array([10.0, 10.2]),
        width=0.5,
    ),
    "patches, sharp": roads.Patches(width=0.0),
    "scaled along": roads.ScaledAlong(road=roads.RIG, factors=np.array([1.0, 0.8, 1.1, 0.9, 1.2]), spacing=3.0),
    "scaled along, once": roads.ScaledAlong(road=roads.WET_ASPHALT, factors=np.array([0.9])),
    "tabulated": roads.Tabulated(slip=np.array([0.0, 0.1, 0.3, 0.6, 1.0]), mu=np.array([0.0, 0.8, 0.6, 0.65, 0.5])),
    "piecewise linear": roads.PiecewiseLinear(
        slip=np.array([0.0, 0.1, 0.3, 0.6, 1.0]), mu=np.array([0.0, 0.8, 0.6, 0.65, 0.5])
    ),
}

PLANTS: dict[str, Any] = {
    "quarter car": plants.QuarterCar(),
    "quarter car, asphalt": plants.QuarterCar(road=roads.DRY_ASPHALT),
    "quarter car, snow": plants.QuarterCar(mass=300.0, radius=0.3, road=roads.SNOW),
    "quarter car, magic": plants.QuarterCar(road=roads.MagicFormula()),
    "quarter car, patches": plants.QuarterCar(road=roads.Patches()),
    "mirrored rig": plants.MirroredRig(),
    "mirrored rig, a body": plants.MirroredRig(mass=6.2, inertia_factor=1.0),
    "lab rig": plants.LabRig(),
    "lab rig, unrounded": plants.LabRig(road=roads.RIG_UNROUNDED),
    "road vehicle": plants.RoadVehicle(wheel_load=5000.0),
}

BALANCES: dict[str, Any] = {
    "arm": plants.ArmBalance(),
    "arm, hanging": plants.ArmBalance(arm_length=-0.5, rider_mass=70.0),
    "arm, geared": plants.ArmBalance(
        torque_constant=0.1, back_emf=0.1, gear=100.0, rotor_inertia=2e-4, current_max=60.0
    ),
    "acrobot": plants.ACROBOT,
    "arm, as printed": plants.PrintedArm(),
}

_PID = controllers.PID(kp=150.0, ki=800.0, kd=1.5, low=-5.0, high=90.0)

TANK = {"pump_1": "level_1", "pump_2": "level_2"}

CONTROLLERS: dict[str, Any] = {
    "pid": _PID,
    "pid, default": controllers.PID(low=0.0, high=90.0),
    "pid, clamping": controllers.PID(
        kp=900.0, ki=5000.0, kd=5.67, antiwindup=controllers.Clamping(), low=0.0, high=90.0
    ),
    "pid, back-calculation": controllers.PID(
        kp=900.0, ki=5000.0, antiwindup=controllers.BackCalculation(), low=0.0, high=90.0
    ),
    "pid, reverse and weighted": controllers.PID(kp=-9.0, ki=-50.0, kd=-0.05, b=0.5, c=0.0, low=-90.0, high=90.0),
    "cascade": controllers.Cascade(
        outer=controllers.PID(kp=20.0, ki=5.0, low=-3.0, high=3.0, antiwindup=controllers.BackCalculation()),
        inner=controllers.PID(kp=-4.0, ki=-30.0, kd=-0.01, low=0.0, high=90.0, antiwindup=controllers.Clamping()),
    ),
    "state feedback": controllers.StateFeedback(),
    "state feedback, limited": controllers.StateFeedback(
        gain=np.array([-900.0, -150.0]),
        low=0.0,
        high=30.0,
        antiwindup=controllers.BackCalculation(tracking_time=0.02),
    ),
    "scheduled feedback": controllers.ScheduledFeedback(
        speeds=np.array([2.0, 11.0, 24.0]),
        integral_gains=np.array([-900.0, -1100.0, -1000.0]),
        gains=np.array([-60.0, -110.0, -150.0]),
        high=40.0,
    ),
    "proportional feedback": controllers.ProportionalFeedback(gain=np.array([-900.0, -150.0]), high=40.0),
    "constant torque": controllers.ConstantTorque(),
    "relay": controllers.Relay(low=2.0),
    "sliding mode": controllers.SlidingMode(gain=60.0, boundary=0.1, high=70.0, low=0.0),
    "sampled pid": controllers.Sampled(controller=_PID, period=2e-3, delay=5e-4),
    "balance feedback": controllers.BalanceFeedback(),
    "observer feedback": controllers.ObserverFeedback(
        gain=np.array([900.0, -40.0, 300.0, 250.0, -3.0, 100.0]),
        transition=0.9 * np.eye(6) + 0.01 * np.eye(6, k=3),
        entry=np.array([0.0, 0.0, 0.0, -0.01, 0.03, 0.02]),
        correction=np.linspace(0.05, 0.6, 12).reshape(6, 2),
        predicted_high=60.0,
    ),
    "played command": controllers.PlayedCommand(commands=np.array([0.0, 30.0, 12.0]), period=2e-3),
    "sampled relay": controllers.Sampled(controller=controllers.Relay(), delay=3e-4),
    "sampled on the grid": controllers.SampledOnGrid(controller=_PID, sampling_period=2e-3, delay=1.3e-3),
    "five phase": controllers.FivePhase(
        braking_threshold=300.0, strong_threshold=400.0, slip_low=0.12, slip_high=0.19, opening=0.2, period=1e-3
    ),
    "four phase": controllers.FourPhase(torque_low=10.0, torque_high=20.0, slip_low=0.11, slip_high=0.15, rate=6000.0),
    "band logic": controllers.BandLogic(slip_low=0.12, slip_high=0.17, growth=20.0, decay=30.0, torque=30.0, high=35.0),
}

REFERENCES: dict[str, Any] = {
    "fixed": references.FixedSlip(),
    "filtered": references.FilteredSlip(),
    "literal": references.PeakLiteral(),
    "latch": references.PeakLatch(),
    "upright": references.Upright(),
    "setpoint": references.Setpoint(value=0.3),
    "robust": references.PeakRobust(time_constant=0.002, threshold=0.01),
    "limited": references.LimitedSlip(rate=15.0, time_constant=0.003, period=2e-3),
    "by deceleration": references.SlipByDeceleration(time_constant=0.003),
    "extremum seeking": references.ExtremumSeeking(gain=40.0, time_constant=0.004, frequency=400.0, resolution=0.01),
}

ACTUATORS: dict[str, Any] = {
    "direct": blocks.Direct(),
    "limits": actuators.Limits(low=5.0, high=60.0),
    "voltage": actuators.VoltageLimit(high=40.0),
    "lag": actuators.Lag(),
    "asymmetric lag": actuators.AsymmetricLag(rise=0.012, fall=0.004),
    "dead time": actuators.DeadTime(rise=2.3e-3, fall=1.6e-3),
    "hydraulic brake": actuators.HydraulicBrake(inlet_time=0.03, dead_share=0.01, laminar_pressure=3e5),
    "integrating valve": actuators.IntegratingValve(gain=200.0, low=-5.0, high=20.0),
    "rate limit": actuators.RateLimit(),
    "delay": actuators.Delay(time=2.3e-3, capacity=8),
    "series": blocks.Series(
        blocks=(actuators.Delay(time=1.6e-3, capacity=8), actuators.Lag(), actuators.Limits(low=-5.0, high=90.0))
    ),
}

SENSORS: dict[str, Any] = {
    "direct": blocks.Direct(),
    "noise": sensors.Noise(slip=0.01, speed=0.1, wheel_speed=0.2, deceleration=0.3, period=2e-3),
    "bias": sensors.Bias(slip=0.01, deceleration=-0.2),
    "quantisation": sensors.Quantisation(slip=0.013, wheel_speed=0.1),
    "wheel speed": sensors.WheelSpeed(),
    "angles": sensors.AngleSensor(theta=0.01, psi=0.02, period=2e-3),
    "speed scale": sensors.SpeedScale(factor=0.95),
    "accelerometer": sensors.IntegratedAccelerometer(bias=0.05),
    "wheel noise": sensors.WheelNoise(slip=0.01, period=2e-3),
    "played wheel noise": sensors.PlayedWheelNoise(noise=np.array([0.01, -0.02, 0.005]), period=2e-3),
    "drifting speed": sensors.DriftingSpeed(first=0.03, last=-0.05, time_constant=0.01),
    "encoder slip": sensors.EncoderSlip(period=2e-3),
    "select high": sensors.SelectHigh(slope=12.0, period=2e-3),
    "estimated speed": sensors.SpeedEstimator(gate=0.2, growth=0.3, period=2e-3),
    "series": blocks.Series(blocks=(sensors.Noise(deceleration=0.05), sensors.WheelSpeed())),
}

PARTS: dict[str, dict[str, Any]] = {
    "road": ROADS,
    "plant": PLANTS | BALANCES,
    "initial": {
        "default": plants.BrakeStart(),
        "slipping": plants.BrakeStart(speed=20.0, slip=0.1),
        "leaning": plants.BalanceStart(theta=0.1),
    },
    "controller": CONTROLLERS,
    "reference": REFERENCES,
    "actuator": ACTUATORS,
    "sensor": SENSORS,
    "antiwindup": {
        "none": controllers.NoAntiWindup(),
        "clamping": controllers.Clamping(),
        "back-calculation": controllers.BackCalculation(),
    },
    "feedforward": {
        "none": controllers.NoFeedforward(),
        "constant": controllers.ConstantInput(value=2.5),
        "holding": controllers.HoldingInput(),
    },
    "stop": {
        "speed reached": stops.SpeedReached(),
        "standstill": stops.Standstill(),
        "fallen": stops.Fallen(),
        "none": stops.NoStop(),
    },
    "objective": {
        **objectives.BRAKING,
        "itae": objectives.ITAE(),
        "quadratic": objectives.QuadraticCost(q=np.array([3.0, 2.0]), r=0.5),
        "share at a limit": objectives.ShareAtLimit(high=12.0),
        "effort": objectives.Effort(),
        "brake work": objectives.BrakeWork(radius=0.3),
        "torque rate": objectives.TorqueRate(),
        "variation": objectives.Variation(),
        "peak output": objectives.PeakOutput(output="distance", until=0.1995),
        "time between speeds": objectives.TimeBetweenSpeeds(fast=19.0, slow=18.0),
        "rise time": objectives.RiseTime(place=0.05, deceleration=7.0),
        **{f"balance: {name}": part for name, part in objectives.BALANCE.items()},
        "balance: soft loss": objectives.SoftLoss(weight=np.arange(1.0, 7.0), radius=0.05, softness=0.7),
        "balance: cost": objectives.BalanceCost(q=np.array([1.0, 2.0, 3.0, 4.0, 5.0, 6.0]), r=0.5),
    },
}

# Parts of loops with several inputs, whose signals are no single numbers: tests/engine/test_channels.py runs them.
WITH_CHANNELS: dict[str, dict[str, Any]] = {
    "plant": {
        "quadruple tank": plants.QuadrupleTank(share_1=0.43, share_2=0.34),
        "half car": plants.HalfCar(drag=0.4, rolling=0.01, rear_tyre=roads.PacejkaTyre(grip=0.7)),
        "half car, relaxed": plants.HalfCar(front_tyre=roads.RelaxedTyre(), pads=plants.FadingPads(initial=700.0)),
        "car": plants.Car(drag=0.4, rolling=0.01, front_left_tyre=roads.PacejkaTyre(grip=0.7)),
    },
    "tyre": {
        "on a road": roads.RoadTyre(road=roads.WET_ASPHALT),
        "pacejka": roads.PacejkaTyre(grip=0.7),
        "relaxed": roads.RelaxedTyre(tyre=roads.PacejkaTyre(grip=0.7), length=0.2),
    },
    "pads": {"constant": plants.ConstantPads(), "fading": plants.FadingPads(initial=700.0)},
    "initial": {"filled": plants.TankStart(level_1=0.1)},
    "controller": {
        "per channel": controllers.PerChannel({"pump_1": _PID, "pump_2": controllers.Relay()}, TANK),
        "per channel, one": controllers.PerChannel(_PID, TANK),
        "select low": controllers.SelectLow(controller=controllers.PerChannel(_PID, TANK), groups=(tuple(TANK),)),
        "hold course": controllers.HoldCourse(controller=controllers.PerChannel(_PID, TANK), gain=0.05),
        "brake distribution": controllers.BrakeDistribution(
            controller=_PID, knee=2.0, valve_ratio=0.5, controlled="level_1", front=("pump_1",), rear=("pump_2",)
        ),
        "matrix feedback": controllers.MatrixFeedback(
            gain=-np.arange(1.0, 13.0).reshape(2, 6),
            outputs_at_rest=np.full(4, 0.1),
            windup=-np.eye(2),
            low=np.zeros(2),
            high=np.full(2, 10.0),
            states=("level_1", "level_2", "level_3", "level_4"),
        ),
        "observed feedback": controllers.ObservedFeedback(
            gain=-np.arange(1.0, 9.0).reshape(2, 4),
            state_matrix=-np.eye(2),
            input_matrix=np.eye(2),
            output_matrix=np.eye(2),
            observer_gain=np.array([[0.5, 0.1], [0.0, 0.4]]),
            outputs_at_rest=np.full(2, 0.1),
            windup=-np.eye(2),
            low=np.zeros(2),
            high=np.full(2, 10.0),
            outputs=tuple(TANK.values()),
        ),
    },
    "reference": {
        "per target": references.PerTarget(
            reference={"level_1": references.Setpoint(value=0.13), "level_2": references.Setpoint(value=0.12)}
        )
    },
    "actuator": {"per control": actuators.PerControl(actuator={"pump_1": actuators.Lag(), "pump_2": blocks.Direct()})},
    "sensor": {
        "per output": sensors.PerOutput(
            sensor={"level_1": actuators.Lag(time_constant=2.0), "level_2": sensors.OutputNoise(deviation=1e-3)}
        ),
        "per output, errors": sensors.PerOutput(sensor={"level_1": sensors.OutputError(factor=1.01, offset=1e-3)}),
    },
    "objective": {
        "in a channel": objectives.InChannel(objective=objectives.IAE(), output="level_2", control="pump_2"),
        "over channels": objectives.OverChannels(channels=tuple(TANK.items()), weights=np.array([1.0, 2.0])),
    },
}

BLOCKS = {(family, name): PARTS[family][name] for family in ("controller", "reference", "actuator", "sensor")
          for name in PARTS[family]}  # fmt: skip


def inside(part: Any) -> Iterator[Any]:
    """A part and every part in it."""
    yield part
    for field in dataclasses.fields(part):
        if "part" in field.metadata:
            inner = getattr(part, field.name)
            inner = tuple(inner.values()) if isinstance(inner, dict) else inner
            for item in inner if isinstance(inner, tuple) else (inner,):
                yield from inside(item)


def leaves(tree: Any) -> list[np.ndarray]:
    """The leaves as NumPy arrays."""
    return [np.asarray(x) for x in jax.tree.leaves(tree)]


def struct(tree: Any, dtype: Any = None) -> Any:
    """Structure, shapes and dtypes; with `dtype`, a stand-in that `eval_shape` accepts."""
    return jax.tree.map(lambda x: jax.ShapeDtypeStruct(jnp.shape(x), dtype or jnp.result_type(x)), tree)


H = 1e-3  # s, the step at which blocks are fed


def output_at(t: Any) -> BrakeOutput:
    """A wheel that slips ever more while the deceleration passes its maximum at 4.3 ms."""
    slip, speed = 0.1 + 17.0 * t, 20.0 - 8.0 * t
    return BrakeOutput(slip, speed, (1 - slip) * speed, 8.0 - 3e5 * (t - 4.3e-3) ** 2, 20.0 * t)


def leaning_at(t: Any) -> BalanceOutput:
    """A two-wheeler on its way upright: every angle falls with the time constant 0.1 s."""
    left = jnp.exp(-t / 0.1)
    angles = [size * left for size in (0.3, -0.6, 0.2)]
    return BalanceOutput(
        *angles, *(-10.0 * x for x in angles), 30.0 + 0.0 * t, -15.0 * left, 3.0 + 0.0 * t, 20.0 + 0.0 * t
    )


OBJECTIVES_OF_BALANCE = (
    objectives.BalanceCost,
    objectives.SoftLoss,
    *(type(part) for part in objectives.BALANCE.values()),
)
OF_BALANCE = (controllers.BalanceFeedback, controllers.ObserverFeedback, references.Upright, sensors.AngleSensor)


def signal_at(family: str, block: Any, t: Any) -> Any:
    """What a block of this family is given at time t."""
    seen = leaning_at(t) if isinstance(block, OF_BALANCE) else output_at(t)
    if family == "controller":
        return Tracking(0.2 + 0.0 * t, seen, 20.0 + 300.0 * t)
    return 20.0 + 50.0 * jnp.sin(200.0 * t + 0.5) if family == "actuator" else seen


def braking_at(t: Any) -> Sample:
    """A locked wheel whose slip falls from 1 to the setpoint 0.2 with the time constant 0.1 s; torque 10 + 5 e."""
    excess = 0.8 * jnp.exp(-t / 0.1)
    y = BrakeOutput(0.2 + excess, 20.0 - 8.0 * t, 16.0 - 8.0 * t, 8.0 + 0.0 * t, 20.0 * t - 4.0 * t**2)
    return Sample(t, y, 0.2 + 0.0 * t, 0.2 + 0.0 * t, 10.0 + 0.0 * t, 10.0 + 5.0 * excess, 10.0 + 5.0 * excess)


def at_instant(
    block: Any, clock: Clock, memory: Memory, signal: Any, rate: Any, before: Any, passage: HermiteStep | None = None
) -> tuple[Memory, Any]:
    """A block's memory after an instant, and its margins there: an event where one has become negative since `before`,
    which are None at first; the step that ends there; then its tick."""

    def margins(memory: Memory) -> Any:
        return block.margins(clock.t, memory, signal, lambda: rate) if offers(block, "margins") else ()

    if offers(block, "margins"):
        before = before or [0.0 * clock.t for _ in margins(memory)]
        fired = tuple((a >= 0) & (b < 0) for a, b in zip(before, margins(memory), strict=True))
        memory = block.event(clock.t, memory, signal, fired)
    if passage is not None:
        memory = block.record(memory, passage)
    memory = block.tick(clock, memory, signal) if offers(block, "tick") else memory
    return memory, margins(memory)


def passed(family: str, block: Any, memory: Memory, t: Any) -> HermiteStep:
    """The step that ends at t; before the first there is none."""

    def seen(t: Any) -> Any:
        return record_signal(block, t, memory, signal_at(family, block, t))

    start = jnp.maximum(t - H, 0.0)
    (first, rate), (last, final) = (jax.jvp(seen, (at,), (jnp.ones_like(at),)) for at in (start, t))
    return HermiteStep(start, t, (first, last), (rate, final))


def block_run(family: str, block: Any, steps: int = 8) -> Any:
    """Outputs and continuous memories over some steps, by Euler; events at the instants only."""

    def step(at: Any, k: Any) -> Any:
        memory, margins = at
        t = k * H
        signal, rate = jax.jvp(partial(signal_at, family, block), (t,), (jnp.ones_like(t),))
        passage = passed(family, block, memory, t) if offers(block, "record") else None
        memory, margins = at_instant(block, Clock(t, H, k, jax.random.key(7)), memory, signal, rate, margins, passage)
        seen = block.output(t, memory, signal), memory.flow
        return (Memory(axpy(H, block.flow(t, memory, signal), memory.flow), memory.held), margins), seen

    signal = signal_at(family, block, jnp.zeros(()))
    memory = block.start(signal)
    margins = block.margins(jnp.zeros(()), memory, signal, lambda: signal) if offers(block, "margins") else ()
    start = memory, jax.tree.map(jnp.zeros_like, margins)
    return jax.lax.scan(step, start, jnp.arange(steps))[1]


def balancing_at(t: Any) -> Sample:
    """The same run under a voltage 5 + 20 exp(-t/0.1)."""
    voltage = 5.0 + 20.0 * jnp.exp(-t / 0.1)
    return Sample(t, leaning_at(t), 0.0 * t, 0.0 * t, 0.0 * t, voltage, voltage)


RUNS = {family: partial(block_run, family) for family, _ in BLOCKS}


def mirrored_at(t: Any) -> Sample:
    """The same run with the error of the other sign: slip below the setpoint."""
    sample = braking_at(t)
    return sample._replace(output=sample.output._replace(slip=2 * sample.setpoint - sample.output.slip))


def objective_run(objective: Any, sample_at: Any = None, end: float = 0.5, steps: int = 500) -> Any:
    """The value of an objective on the run of its task, or another, streamed as the rollout does."""
    h = end / steps
    sample_at = sample_at or (balancing_at if isinstance(objective, OBJECTIVES_OF_BALANCE) else braking_at)

    def step(memory: Memory, k: Any) -> Any:
        t = k * h
        flow = rk4_step(lambda t, z: objective.flow(Memory(z, memory.held), sample_at(t)), t, memory.flow, h)
        (a, da), (b, db) = (jax.jvp(sample_at, (x,), (jnp.ones_like(x),)) for x in (t, t + h))
        segment = Segment(a, b, h, h, lambda: (da.show(), db.show()), lambda: (da, db))
        return Memory(flow, objective.update(Memory(flow, memory.held), segment)), None

    memory, _ = jax.lax.scan(step, objective.start(sample_at(0.0 * h)), jnp.arange(steps))
    return objective.value(memory, Ending(sample_at(jnp.asarray(end)), True, 0.25, 0.7))


E, T = np.exp(-5.0), 0.1  # the error is 0.8 exp(-t/T), 0.8 E at the end; x1 = 0.8 T (1 - exp(-t/T)), u - ff = 5 e
SQUARES = np.array([0.09, 0.36, 0.04, 9.0, 36.0, 4.0])  # of the balance's angles and rates at the start
VALUES = {  # of the objectives on those runs, by hand
    "stop_time": 0.5 + 0.25,
    "stop_distance": 20 * 0.5 - 4 * 0.25 + 0.7,
    "max_slip": 1.0,
    "overshoot": 0.0,  # a step down that stays above its setpoint
    "settling_time": T * np.log(0.8 / 0.01),
    "iae": 0.8 * T * (1 - E),
    "itae": 0.8 * (T**2 - (T**2 + T * 0.5) * E),
    "final_slip_error": 0.8 * E,
    "locked_time": T * np.log(0.8 / 0.79),
    "quadratic": 3 * (0.8 * T) ** 2 * (0.5 - 2 * T * (1 - E) + T / 2 * (1 - E**2))
    + (2 + 0.5 * 25) * 0.64 * T / 2 * (1 - E**2),
    "share at a limit": 69.5e-3 / 0.5,  # 5 e >= 2 until T log(2) = 0.0693: 69 steps, and half of the next
    "effort": 100 * 0.5 + 100 * 0.8 * T * (1 - E) + 25 * 0.64 * T / 2 * (1 - E**2),
    "brake work": (70 + 64 * T * (1 - E) - 32 * (T**2 - (T**2 + T * 0.5) * E)) / 0.3,
    "variation": 4.0 * (1 - E),
    "balance: settling_time": T * np.log(0.6 / 0.01),
    "balance: peak_lean": 0.3,
    "balance: peak_arm_angle": 0.6,
    "balance: peak_voltage": 25.0,
    "balance: peak_torque": 30.0 * (25.0 + 15.0) / 3.0,
    "balance: final_norm": np.sqrt(SQUARES.sum()) * E,
    "balance: fell": 1.0,  # the run below ends at its stop
    "balance: soft loss": 1 / (1 + (0.05 / (np.sqrt(SQUARES @ np.arange(1.0, 7.0)) * E)) ** (1 / 0.7)),
    "balance: cost": SQUARES @ np.arange(1.0, 7.0) * T / 2 * (1 - E**2)
    + 0.5 * (25 * 0.5 + 200 * T * (1 - E) + 400 * T / 2 * (1 - E**2)),
    "torque rate": 4.0 / T,  # at the start
    "peak output": 20 * 0.2 - 4 * 0.2**2,  # the last step that begins before 0.1995 s ends at 0.2 s
    "time between speeds": 1.0 / 8.0,
    "rise time": 0.0,  # the deceleration is 8 m/s^2 throughout
}


@partial(jax.jit, static_argnums=0, compiler_options={"xla_backend_optimization_level": 0})  # compiles twice as fast
def _linearised(function: Any, tree: Any) -> Any:
    x, unravel = ravel_pytree(tree)

    def flat(x: Any) -> Any:
        y = ravel_pytree(function(unravel(x)))[0]
        return y, y

    return jax.jacfwd(flat, has_aux=True)(x)


def value(function: Any, tree: Any) -> np.ndarray:
    """function(tree), its leaves in one vector."""
    return np.asarray(_linearised(function, canonical_dtypes(tree))[1])


def jacobian(function: Any, tree: Any) -> np.ndarray:
    """d(function)/d(every element of every leaf), one row for each element, by forward-mode differentiation.

    Compiled once for each function and structure of the tree: give it functions that outlive the test."""
    return np.asarray(_linearised(function, canonical_dtypes(tree))[0]).T


def differences(function: Any, tree: Any, step: float = 1e-5) -> np.ndarray:
    """The same by central differences, with a step relative to the element (absolute for a zero)."""
    x, unravel = ravel_pytree(canonical_dtypes(tree))
    h = step * np.where(np.isfinite(x) & (np.abs(x) > 1e-6), np.abs(x), 1.0)
    left, right = (np.array([value(function, unravel(x + sign * d)) for d in np.diag(h)]) for sign in (-1, 1))
    return (right - left) / (2 * h[:, None]) if len(x) else jacobian(function, tree)
