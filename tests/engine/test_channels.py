"""Loops with several inputs: against loops of one, SciPy, differences, and other engines."""

from collections.abc import Mapping
from types import MappingProxyType
from typing import ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from marks import cases
from mutants import killed_by
from scipy.integrate import solve_ivp
from scipy.linalg import solve_continuous_are

import diffabs as d
from diffabs import actuators, controllers, objectives, plants, references, sensors, stops
from diffabs.core.blocks import ChangedCommand, Direct, Parallel
from diffabs.core.channels import Channels
from diffabs.core.protocols import Block, Memory, Tracking
from diffabs.core.pytree import get, param, part, pytree
from diffabs.core.types import Scalar

SOLVERS = {"fixed": d.FixedStep(0.02, 6.0), "adaptive": d.Adaptive(rtol=1e-7, duration=6.0)}
CHANNELS = {"left": "a", "right": "b"}


class Pair(NamedTuple):
    a: Scalar
    b: Scalar


class PairOutput(Pair):
    __slots__ = ()
    units: ClassVar[Mapping[str, str]] = MappingProxyType({"a": "m", "b": "m"})
    tracked: ClassVar[tuple[str, ...]] = ("a", "b")


class SidesSignals(NamedTuple):
    left: Scalar
    right: Scalar


class Sides(SidesSignals):
    __slots__ = ()
    units: ClassVar[Mapping[str, str]] = MappingProxyType({"left": "N", "right": "N"})


class Single(NamedTuple):
    a: Scalar


class SingleOutput(Single):
    __slots__ = ()
    units: ClassVar[Mapping[str, str]] = MappingProxyType({"a": "m"})


@pytree
class PairStart:
    a: Scalar = param(default=0.0, unit="m")
    b: Scalar = param(default=0.2, unit="m")


@pytree
class SingleStart:
    a: Scalar = param(default=0.0, unit="m")


@pytree
class TwoTanks:
    """Two bowls that may leak into each other: x' = u - sqrt(1 + x^2) x/T + c (other - x)."""

    time_a: Scalar = param(default=1.0, unit="s", above=0.0)
    time_b: Scalar = param(default=2.0, unit="s", above=0.0)
    coupling: Scalar = param(default=0.0, unit="1/s", low=0.0)

    shows = PairOutput
    controls = Sides

    def start(self, initial):
        return Pair(initial.a, initial.b)

    def derivative(self, t, state, control):
        del t
        a, b = state
        return Pair(
            control.left - leak(a, self.time_a) + self.coupling * (b - a),
            control.right - leak(b, self.time_b) + self.coupling * (a - b),
        )

    def project(self, state):
        return state

    def output(self, state):
        return PairOutput(*state)

    def holding(self, output, target):
        del output
        return Sides(leak(target.a, self.time_a), leak(target.b, self.time_b))


@pytree
class OneTank:
    time: Scalar = param(default=1.0, unit="s", above=0.0)

    shows = SingleOutput
    control_unit = "N"

    def start(self, initial):
        return Single(initial.a)

    def derivative(self, t, state, control):
        del t
        return Single(control - leak(state.a, self.time))

    def project(self, state):
        return state

    def output(self, state):
        return SingleOutput(*state)

    def holding(self, output, target):
        del output
        return leak(target, self.time)


def leak(x, time):
    return jnp.sqrt(1.0 + x * x) * x / time


PIDS = {
    "left": controllers.PID(kp=3.0, ki=2.0, kd=0.1, cutoff=9.0, low=-1.0, high=1.2, antiwindup=controllers.Clamping()),
    "right": controllers.PID(
        kp=1.5, ki=0.7, cutoff=9.0, low=-2.0, high=1.1, antiwindup=controllers.BackCalculation(tracking_time=0.4)
    ),
}
TARGETS = {"a": references.Setpoint(value=0.6), "b": references.Setpoint(value=-0.3)}
LAGS = {"left": actuators.Lag(time_constant=0.08), "right": actuators.Limits(low=-1.0, high=1.0)}


def pair(**changes):
    """Return the loop of two channels, with parts in place of the usual ones."""
    usual = {
        "plant": TwoTanks(),
        "initial": PairStart(),
        "reference": references.PerTarget(reference=TARGETS),
        "feedforward": controllers.HoldingInput(),
        "controller": controllers.PerChannel(PIDS, CHANNELS),
        "actuator": actuators.PerControl(actuator=LAGS),
        "stop": stops.NoStop(),
    }
    return d.Loop(**{**usual, **changes})


def single(control, output, **changes):
    """Return the loop of one channel of `pair()`."""
    loop = pair()
    usual = {
        "plant": OneTank(time=get(loop, f"plant.time_{output}")),
        "initial": SingleStart(a=get(loop, f"initial.{output}")),
        "reference": TARGETS[output],
        "feedforward": controllers.HoldingInput(),
        "controller": PIDS[control],
        "actuator": LAGS[control],
        "stop": stops.NoStop(),
    }
    return d.Loop(**{**usual, **changes})


MEASURED = {"iae": objectives.IAE(), "overshoot": objectives.Overshoot(), "effort": objectives.Effort()}


def in_channel(control, output):
    return {
        name: objectives.InChannel(objective=objective, control=control, output=output)
        for name, objective in MEASURED.items()
    }


@killed_by("core.channels", "order = (name, *", "order = (*", case="fixed")
@pytest.mark.parametrize("how", cases(SOLVERS, "adaptive"))
def test_channels_that_do_not_meet_are_two_loops(how):
    """Fixed steps to rounding. Adaptive steps are those of both channels, so the values differ within the tolerance."""
    tolerance = {"fixed": 1e-13, "adaptive": 2e-6}[how]
    for control, output in CHANNELS.items():
        both = d.measure(pair(), SOLVERS[how], in_channel(control, output)).metrics
        alone = d.measure(single(control, output), SOLVERS[how], MEASURED).metrics
        for name, value in alone.items():
            np.testing.assert_allclose(both[name], value, rtol=tolerance, atol=1e-12)


@pytest.mark.slow
def test_sampled_channels_with_delays_are_two_loops():
    def sampled(inner):
        return controllers.Sampled(controller=inner, period=0.1, delay=0.03)

    loop = pair(controller=sampled(controllers.PerChannel(PIDS, CHANNELS)))
    for control, output in CHANNELS.items():
        both = d.measure(loop, SOLVERS["fixed"], in_channel(control, output)).metrics
        alone = d.measure(
            single(control, output, controller=sampled(PIDS[control])), SOLVERS["fixed"], MEASURED
        ).metrics
        for name, value in alone.items():
            np.testing.assert_allclose(both[name], value, rtol=1e-12, atol=1e-12)


@pytest.mark.slow
def test_controllers_with_own_clocks_and_relays_are_two_loops():
    each = {
        "left": controllers.Sampled(controller=PIDS["left"], period=0.06, delay=0.05),
        "right": controllers.Sampled(controller=PIDS["right"], period=0.1, delay=0.0),
    }
    loop = pair(controller=controllers.PerChannel(each, CHANNELS))
    for control, output in CHANNELS.items():
        both = d.measure(loop, SOLVERS["fixed"], in_channel(control, output)).metrics
        alone = d.measure(single(control, output, controller=each[control]), SOLVERS["fixed"], MEASURED).metrics
        for name, value in alone.items():  # the other channel's events cut steps
            np.testing.assert_allclose(both[name], value, rtol=1e-9, atol=1e-12)


@pytest.mark.slow
def test_one_controller_for_all_has_a_memory_for_each():
    shared = controllers.PerChannel(PIDS["right"], CHANNELS)
    each = controllers.PerChannel({"left": PIDS["right"], "right": PIDS["right"]}, CHANNELS)
    a, b = (d.measure(pair(controller=c), SOLVERS["fixed"], in_channel("left", "a")).metrics for c in (shared, each))
    assert a == b
    assert get(shared, "controller.kp") == get(each, "left.kp") == 1.5


def test_names_change_places():
    """A loop whose channels are exchanged, with start, targets and parts, makes the same run."""
    swap = {"left": "right", "right": "left"}
    loop = pair(plant=TwoTanks(coupling=0.3))
    swapped = pair(
        plant=TwoTanks(time_a=2.0, time_b=1.0, coupling=0.3),
        initial=PairStart(a=0.2, b=0.0),
        reference=references.PerTarget(reference={"a": TARGETS["b"], "b": TARGETS["a"]}),
        controller=controllers.PerChannel({swap[name]: pid for name, pid in PIDS.items()}, CHANNELS),
        actuator=actuators.PerControl(actuator={swap[name]: lag for name, lag in LAGS.items()}),
    )
    a = d.measure(loop, SOLVERS["adaptive"], in_channel("left", "a")).metrics
    b = d.measure(swapped, SOLVERS["adaptive"], in_channel("right", "b")).metrics
    for name in MEASURED:
        np.testing.assert_allclose(a[name], b[name], rtol=1e-9)


PATHS = (
    "plant.coupling",
    "controller.left.kp",
    "controller.right.ki",
    "reference.a.value",
    "actuator.left.time_constant",
)


@pytest.mark.parametrize(
    "mode", [pytest.param(jax.jacfwd, id="forward", marks=pytest.mark.slow), pytest.param(jax.grad, id="reverse")]
)
@pytest.mark.parametrize("how", cases(SOLVERS, "adaptive"))
def test_derivatives_are_those_of_differences(how, mode, monkeypatch):
    loop = pair(plant=TwoTanks(coupling=0.3))
    over = objectives.OverChannels(channels=tuple(CHANNELS.items()), weights=(1.0, 2.0))
    solver = {"fixed": d.FixedStep(0.02, 6.0, kinks=True), "adaptive": d.Adaptive(rtol=1e-8, duration=6.0)}[how]

    def cost(x):
        return d.measure(d.replace(loop, dict(zip(PATHS, x, strict=True))), solver, {"iae": over}).metrics["iae"]

    x = jnp.array([float(get(loop, path)) for path in PATHS])
    derivative = jax.jit(mode(cost))(x)
    monkeypatch.setenv("DIFFABS_ENGINE", "xla")
    np.testing.assert_allclose(derivative, jax.jit(mode(cost))(x), rtol=1e-9)
    cost = jax.jit(cost)
    for i, width in enumerate(1e-4 * np.asarray(x)):
        moved = [x.at[i].add(step * width) for step in (-2, -1, 1, 2)]
        far, near, close, distant = map(cost, moved)
        difference = (8 * (close - near) - (distant - far)) / (12 * width)
        np.testing.assert_allclose(derivative[i], difference, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("how", cases(SOLVERS, "adaptive"))
def test_kernels_make_the_same_runs(how):
    loop = pair(plant=TwoTanks(coupling=0.3))
    batch = d.Batch({"controller.left.kp": jnp.linspace(2.0, 4.0, 8), "plant.time_b": jnp.linspace(1.0, 3.0, 8)})
    measured = in_channel("right", "b")
    runs = {engine: d.run_batch(loop, batch, SOLVERS[how], measured, engine=engine) for engine in ("xla", "kernel")}
    for name in MEASURED:
        a, b = (runs[engine].metrics[name] for engine in ("xla", "kernel"))
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-12)


@killed_by("parts.plants.quadruple_tank", "(1 - self.share_2) * p2", "self.share_2 * p2")
def test_the_quadruple_tank_agrees_with_scipy():
    tank = plants.QuadrupleTank(share_1=0.43, share_2=0.34)
    a, o = np.array([28, 32, 28, 32]) * 1e-4, np.array([71, 57, 71, 57]) * 1e-7

    def rates(t, h, volts):
        q = o * np.sqrt(2 * 9.81 * h)
        p1, p2 = 3.33e-6 * volts[0], 3.35e-6 * volts[1]
        return np.array([q[2] - q[0] + 0.43 * p1, q[3] - q[1] + 0.34 * p2, 0.66 * p2 - q[2], 0.57 * p1 - q[3]]) / a

    start = np.array([0.12, 0.13, 0.05, 0.04])
    exact = solve_ivp(rates, (0, 50), start, args=((3.0, 3.2),), rtol=1e-11, atol=1e-13).y[:, -1]
    rest = plants.TankStart(**dict(zip(("level_1", "level_2", "level_3", "level_4"), start, strict=True)))
    open_loop = {
        "feedforward": Constant(pump_1=3.0, pump_2=3.2),
        "controller": controllers.PerChannel(
            controllers.PID(kp=0.0, cutoff=1.0), {"pump_1": "level_1", "pump_2": "level_2"}
        ),
    }
    loop = d.Loop(**{"plant": tank, **tank.usual_parts(), "initial": rest, **open_loop})
    run = d.rollout(loop, d.Adaptive(rtol=1e-9, duration=50.0), {})
    # The film leaves (film/h)^2/4 = 2e-6 of an upper outflow.
    np.testing.assert_allclose(run.ending.sample.output, exact, rtol=2e-6)


@pytree
class Constant:
    pump_1: Scalar = param(default=0.0, unit="V")
    pump_2: Scalar = param(default=0.0, unit="V")

    def input(self, plant, output, target):
        del output, target
        return plant.controls(self.pump_1, self.pump_2)


@killed_by("parts.plants.quadruple_tank", "(1 - self.share_1) * q1", "(1 - self.share_2) * q1")
@pytest.mark.parametrize(("shares", "volts"), [((0.7, 0.6), (3.0, 3.0)), ((0.43, 0.34), (3.15, 3.15))])
def test_the_quadruple_tank_rests_at_the_printed_levels(shares, volts):
    """Johansson 2000, table of operating points, whose levels have two or three digits."""
    levels = {(0.7, 0.6): (0.124, 0.127, 0.018, 0.014), (0.43, 0.34): (0.126, 0.130, 0.048, 0.049)}[shares]
    k = {(0.7, 0.6): (3.33e-6, 3.35e-6), (0.43, 0.34): (3.14e-6, 3.29e-6)}[shares]
    tank = plants.QuadrupleTank(share_1=shares[0], share_2=shares[1], flow_1=k[0], flow_2=k[1])
    output = tank.output(tank.start(plants.TankStart()))
    np.testing.assert_allclose(tank.holding(output, Levels(*levels[:2])), volts, rtol=0.03)


class Levels(NamedTuple):
    level_1: float
    level_2: float


@pytree
class LeastOf(Parallel):
    """Two controllers of all controls, of which the lower command counts: an arbitration in ten lines."""

    first: Block = part()
    second: Block = part()

    def by_channel(self):
        return {"first": self.first, "second": self.second}

    def join(self, signal, outputs):
        del signal
        return jax.tree.map(jnp.minimum, outputs["first"], outputs["second"])


@pytree
class Difference(ChangedCommand):
    """A limit on the difference of both commands, as on a yaw moment."""

    controller: Block = part()
    limit: Scalar = param(default=0.1, unit="N", low=0.0)

    def change(self, t, command, signal):
        del t, signal
        return command._replace(left=jnp.minimum(command.left, command.right + self.limit))


def test_logic_of_a_user():
    each, low = controllers.PerChannel(PIDS, CHANNELS), controllers.PID(kp=0.0, low=-0.4, high=-0.2, cutoff=9.0)
    capped = controllers.PerChannel(low, CHANNELS)
    run = d.rollout(pair(controller=LeastOf(first=each, second=capped)), SOLVERS["fixed"], {})
    assert np.max(run.trajectory.sample.command) <= -0.2
    run = d.rollout(pair(controller=Difference(controller=each)), SOLVERS["fixed"], {})
    assert np.max(run.trajectory.sample.command.left - run.trajectory.sample.command.right) <= 0.1 + 1e-15
    low = controllers.SelectLow(controller=each, groups=(("left", "right"),))
    command = d.rollout(pair(controller=low), SOLVERS["fixed"], {}).trajectory.sample.command
    np.testing.assert_array_equal(command.left, command.right)


def test_noise_of_each_output_is_its_own():
    noise = sensors.OutputNoise(deviation=0.01, period=0.02)
    loop = pair(sensor=sensors.PerOutput(sensor={"a": noise, "b": noise}))
    run = d.rollout(loop, SOLVERS["fixed"], {}, key=jax.random.key(3))
    error = np.asarray(run.trajectory.measured) - np.asarray(run.trajectory.sample.output)
    np.testing.assert_allclose(np.std(error, axis=1), 0.01, rtol=0.2)
    assert abs(np.corrcoef(error)[0, 1]) < 0.2


def test_a_full_gain_is_that_of_the_linear_model():
    """u = K (z, x): with K of `linear.lqr` the run is that of the matrix exponential of the closed loop."""
    from scipy.linalg import expm

    a = np.array([[-1.3, 0.3], [0.3, -0.8]])
    big_a, big_b = (
        np.block([[np.zeros((2, 2)), np.eye(2)], [np.zeros((2, 2)), a]]),
        np.vstack([np.zeros((2, 2)), np.eye(2)]),
    )
    gain = np.asarray(d.linear.lqr(big_a, big_b, np.eye(4), 0.1 * np.eye(2)).gain)
    target = np.array([1e-5, -2e-5])  # so small that the bowls are linear
    loop = pair(
        plant=TwoTanks(time_a=1.0, time_b=2.0, coupling=0.3),
        initial=PairStart(a=0.0, b=0.0),
        reference=references.PerTarget(
            reference={"a": references.Setpoint(value=target[0]), "b": references.Setpoint(value=target[1])}
        ),
        feedforward=controllers.NoFeedforward(),
        actuator=Direct(),
        controller=controllers.MatrixFeedback(
            gain=gain,
            outputs_at_rest=np.zeros(2),
            windup=np.zeros((2, 2)),
            low=np.full(2, -np.inf),
            high=np.full(2, np.inf),
            states=("a", "b"),
        ),
    )
    run = d.rollout(loop, d.FixedStep(0.01, 4.0), {})
    closed = np.block([[big_a + big_b @ gain, np.vstack([-np.eye(2), np.zeros((2, 2))])], [np.zeros((2, 6))]])
    exact = (expm(4.0 * closed) @ np.concatenate([np.zeros(4), target]))[2:4]
    np.testing.assert_allclose(run.ending.sample.output, exact, rtol=1e-7)


def test_targets_have_one_order_in_and_outside_of_compiled_functions():
    """JAX rebuilds a dictionary with sorted keys."""
    given = {"b": references.Setpoint(value=2.0), "a": references.Setpoint(value=1.0)}
    reference = references.PerTarget(reference=given)
    rebuilt = jax.jit(lambda part: part)(reference)
    for part_ in (reference, rebuilt):
        memory = part_.start(PairOutput(0.0, 0.0))
        assert part_.setpoint(memory)._fields == part_.output(0.0, memory, PairOutput(0.0, 0.0))._fields == ("a", "b")


def test_an_observer_in_front_of_a_gain_is_the_linear_one():
    """Plant, observer, integrals and gain as one matrix, whose exponential SciPy has; and L is that of a dual LQR."""
    from scipy.linalg import expm

    a = np.array([[-1.3, 0.3], [0.3, -0.8]])
    cost, noise, zero, one = 0.1 * np.eye(2), np.diag([0.2, 0.3]), np.zeros((2, 2)), np.eye(2)
    gain = np.asarray(d.linear.lqr(np.block([[zero, one], [zero, a]]), np.vstack([zero, one]), np.eye(4), cost).gain)
    correction = -np.asarray(d.linear.lqr(a.T, one, one, noise).gain).T
    riccati = solve_continuous_are(a.T, one, one, noise)
    np.testing.assert_allclose(correction, riccati @ np.linalg.inv(noise), rtol=1e-9)
    target, start = np.array([1e-5, -2e-5]), np.array([3e-6, 1e-6])  # so small that the bowls are linear
    loop = pair(
        plant=TwoTanks(time_a=1.0, time_b=2.0, coupling=0.3),
        initial=PairStart(a=start[0], b=start[1]),
        reference=references.PerTarget(
            reference={"a": references.Setpoint(value=target[0]), "b": references.Setpoint(value=target[1])}
        ),
        feedforward=controllers.NoFeedforward(),
        actuator=Direct(),
        controller=controllers.ObservedFeedback(
            gain=gain,
            state_matrix=a,
            input_matrix=one,
            output_matrix=one,
            observer_gain=correction,
            outputs_at_rest=np.zeros(2),
            windup=zero,
            low=np.full(2, -np.inf),
            high=np.full(2, np.inf),
            outputs=("a", "b"),
        ),
    )
    end = d.rollout(loop, d.FixedStep(0.01, 4.0), {}).ending.sample.output
    integrals, states = gain[:, :2], gain[:, 2:]
    # The state is (plant, integrals, estimate, target).
    closed = np.block([
        [a, integrals, states, zero],
        [one, zero, zero, -one],
        [correction, integrals, a + states - correction, zero],
        [zero, zero, zero, zero],
    ])  # fmt: skip
    exact = expm(4.0 * closed) @ np.concatenate([start, np.zeros(4), target])
    np.testing.assert_allclose(end, exact[:2], rtol=1e-7)


@killed_by("parts.controllers.matrix_feedback", "@ (limited - raw)", "@ (raw - limited)")
def test_the_excess_over_a_limit_decays_with_the_tracking_time():
    """E = Kz^-1/Tt: at a limit, for a plant and a target at rest, u_raw - u falls as exp(-t/Tt) to Tt Kz e."""
    tracking, gain = 0.5, np.array([[-2.0, 0.3], [0.1, -1.5]])
    windup = np.linalg.inv(gain) / tracking
    controller = full_gain(
        gain=np.hstack([gain, np.zeros((2, 2))]), windup=windup, low=np.full(2, -0.1), high=np.full(2, 0.1)
    )
    errors, z = np.array([0.2, -0.1]), np.array([-0.4, 0.5])
    signal = Tracking(Pair(0.0, 0.0), PairOutput(*errors), Sides(0.0, 0.0))
    rate = controller.flow(0.0, Memory(flow=jnp.asarray(z)), signal)
    raw = gain @ z
    excess = raw - np.clip(raw, -0.1, 0.1)
    assert (np.abs(excess) > 0.1).all()
    np.testing.assert_allclose(gain @ rate, gain @ errors - excess / tracking, rtol=1e-12)


def full_gain(**changes):
    """Return a `MatrixFeedback` of two controls, targets and states, with other fields in place of some."""
    fields = {
        "gain": -np.ones((2, 4)),
        "outputs_at_rest": np.zeros(2),
        "windup": np.zeros((2, 2)),
        "low": np.zeros(2),
        "high": np.ones(2),
        "states": ("a", "b"),
    }
    return controllers.MatrixFeedback(**{**fields, **changes})


MISFITS = {
    "a gain of one row": (
        {"controller": full_gain(gain=-np.ones((1, 4)))},
        r"controller.gain has shape \(1, 4\); \(2, 4\) is needed, for 2 controls, 2 targets and 2 states",
    ),
    "a rest of one": (
        {"controller": full_gain(outputs_at_rest=np.ones(1))},
        r"controller.outputs_at_rest has shape \(1,\); \(2,\) is needed, for the states a, b",
    ),
    "a limit of one": ({"controller": full_gain(low=(0.0,))}, r"controller.low has shape \(1,\); \(2,\) is needed"),
    "limits that cross": ({"controller": full_gain(low=np.array([2.0, 0.0]))}, "low exceeds high for a control"),
    "a state of no output": ({"controller": full_gain(states=("a", "c"))}, "controller: c is no output of the plant"),
    "an actuator of one": ({"actuator": actuators.Lag()}, "per-control has one for each of left, right"),
    "a group that is a name": (
        {
            "controller": controllers.SelectLow(
                controller=controllers.PerChannel(PIDS, CHANNELS), groups=("left", "right")
            )
        },
        "groups: left is one name; lists of names are needed",
    ),
    "a group that is empty": (
        {"controller": controllers.SelectLow(controller=controllers.PerChannel(PIDS, CHANNELS), groups=((),))},
        "controller.groups: a group is empty; lists of names are needed",
    ),
    "a group of an unknown control": (
        {
            "controller": Difference(
                controller=controllers.SelectLow(
                    controller=controllers.PerChannel(PIDS, CHANNELS), groups=(("left", "middle"),)
                )
            )
        },
        "^controller.controller.groups: there is no control middle; there is left, right$",
    ),
    "actuators without names": (
        {"actuator": actuators.PerControl(actuator=actuators.Lag())},  # pyright: ignore[reportArgumentType]
        "^actuator.actuator = Lag has no name; a table by name is needed, such as ",
    ),
    "a reference without a name": (
        {"reference": references.PerTarget(reference=references.Setpoint())},  # pyright: ignore[reportArgumentType]
        "^reference.reference = Setpoint has no name; a table by name is needed, such as ",
    ),
    "a controller of one": (
        {"controller": controllers.PID(cutoff=1.0)},
        "per-channel has one for each of left, right",
    ),
    "a target of one": (
        {"reference": references.Setpoint()},
        "reference.output returns float; a NamedTuple of a, b is",
    ),
    "an unknown output": (
        {"controller": controllers.PerChannel(PIDS, {"left": "a", "right": "c"})},
        "^controller: there is no channel c; there is a, b$",
    ),
    "a controller too many": (
        {"controller": controllers.PerChannel(PIDS, {"left": "a"})},
        "controller.channels has left; there are controllers of left, right",
    ),
    "a channel is missing": (
        {"controller": controllers.PerChannel(PIDS["left"], {})},
        "controller.channels = {} is empty; the output of each control is needed",
    ),
    "a feed-forward of one": (
        {"feedforward": controllers.ConstantInput()},
        r"feedforward.input returns float; Sides\(...\) is needed, as plant.controls says",
    ),
}


@pytest.mark.parametrize("name", MISFITS)
def test_parts_that_do_not_fit_are_refused_in_a_line(name):
    changes, line = MISFITS[name]
    with pytest.raises(ValueError, match=line):
        d.measure(pair(**changes), SOLVERS["fixed"], {})


def test_the_channels_of_a_controller_cannot_change():
    channels = Channels({"left": "a"})
    assert hash(channels) == hash(Channels({"left": "a"}))
    assert channels != Channels({"left": "b"})
    assert not hasattr(channels, "__setitem__")


def test_a_field_keeps_the_type_of_its_arguments():
    """Only parts by name are looked into: the dictionary of a field's arguments is no such part."""

    def decay(t, y, args):
        return -args.a * y

    solution = d.solve(decay, jnp.array([1.0]), 0.0, 1.0, Single(2.0), solver=d.Adaptive(1e-8))
    np.testing.assert_allclose(solution.y, np.exp(-2.0), rtol=1e-7)
