"""The parts of the real rig, against a second version in NumPy that reads nothing but the documents it is given."""

import dataclasses
import importlib
import itertools
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import real_rig_oracle as oracle
import scipy.linalg
from mutants import killed_by
from project import ROOT

import diffabs as d
from diffabs import controllers, objectives, references, scenario, sensors
from diffabs.core.blocks import Series
from diffabs.core.protocols import BrakeOutput, Clock
from diffabs.parts.roads import RIG


@pytest.fixture(scope="module")
def rig():
    """The experiment's modules."""
    names = ("box", "loops", "floor", "document", "proof")
    return {name: importlib.import_module(f"experiments.real_rig.{name}") for name in names}


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
LET_GO = {"speed": 70.0, "bias": -0.3}  # m/s^2, three times what the box has: the vehicle seems ever faster than it is
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


@pytest.mark.slow
@killed_by("parts.controllers.sampled_on_grid", "waits * last + (1 - waits) * latest", "latest", case="all wrong-known")
@killed_by(
    "parts.sensors.speed",
    "error = self.last + (self.first - self.last) * jnp.exp(-t / self.time_constant)",
    "error = self.last + 0.0 * t",
    case="all wrong-known",
)
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


SLOW = pytest.mark.slow
FOLDER = ROOT / "experiments" / "real_rig" / "controllers"
COMMITTED = sorted(FOLDER.glob("*.json"))
EXAMPLES = [  # one of each kind of reference, controller and seen speed
    "estimated-tuned-cvar",
    "estimated-sliding-mode-cma-es",
    "known-published-gain",
    "known-first-cure",
    "known-pi-cma-es",
]


def of_document(rig, document):
    """The loop of a document, without its noise."""
    noise = ("sensor.blocks.0.slip", "sensor.blocks.2.deceleration")
    one = rig["document"].loop_of(document)
    return d.replace(one, {path: 0.0 for path in noise if path in document["parameters"]})


CONTROLLERS = [pytest.param(path, id=path.stem, marks=() if path.stem in EXAMPLES else SLOW) for path in COMMITTED]


@killed_by(
    "parts.controllers.switching",
    "self.gain * inside, self.low",
    "2 * self.gain * inside, self.low",
    case="estimated-sliding-mode-cma-es",
)
@pytest.mark.parametrize("path", CONTROLLERS)
@pytest.mark.slow
def test_each_committed_controller_runs_elsewhere(rig, path):
    """The documents of the study, on a rig that is not the nominal one."""
    document = json.loads(path.read_text())
    for name, value in {"plant.mass": 6.2, "controller.delay": 7e-4, "sensor.blocks.3.deceleration": 0.08}.items():
        if name in document["parameters"]:
            document["parameters"][name]["value"] = value
    one = of_document(rig, document)
    assert rig["document"].document(one)["equations"] == document["equations"]
    run = d.rollout(one, d.FixedStep(1e-3, 0.5, kinks=False), key=jax.random.key(0))
    sample, found = run.trajectory.sample, oracle.simulated(document, 499)  # nothing ticks at the end of a run
    ours = {"slip": sample.output.slip, "speed": sample.output.speed, "torque": sample.control, "target": sample.target}
    for quantity, values in ours.items():
        np.testing.assert_allclose(values[:500], found[quantity], rtol=1e-8, atol=1e-10, err_msg=quantity)


def test_each_kind_of_controller_is_committed():
    """And is looked at by the test above without being asked for."""
    assert set(EXAMPLES) <= {path.stem for path in COMMITTED}
    kinds = {path: json.loads(path.read_text())["kinds"] for path in COMMITTED}
    for part in ("controller", "reference", "speed"):
        assert {kinds[path][part] for path in COMMITTED} == {
            kinds[path][part] for path in COMMITTED if path.stem in EXAMPLES
        }


def slip_poles(k, at):
    """Greatest |pole| of the sampled slip loop of a machine, by SciPy's matrix exponential from the equations of
    the study's page: integral (Euler), slip error, torque of the brake, torque of the last sample."""
    h, slip, g, r1 = 1e-3, 0.2, 9.81, 0.0995
    mass, inertia, w4, v, lag, delay = at
    road = RIG.__class__(w1=RIG.w1, w2=RIG.w2, w3=RIG.w3, w4=w4, a=RIG.a, q=RIG.q)

    def rate(s, torque):
        mu = float(road.friction(s, v, 0.0))
        return -r1 * (mass * g * r1 * mu - torque) / inertia / v - (1 - s) * 2 * mu * g / v

    hold = mass * g * r1 * float(road.friction(slip, v, 0.0)) + (1 - slip) * 2 * g * inertia / r1 * float(
        road.friction(slip, v, 0.0)
    )
    e = 1e-6
    a = (rate(slip + e, hold) - rate(slip - e, hold)) / (2 * e)
    b = (rate(slip, hold + e) - rate(slip, hold - e)) / (2 * e)
    flow = np.array([[a, b, 0.0], [0.0, -1 / lag, 1 / lag], [0.0, 0.0, 0.0]])
    before, after = scipy.linalg.expm(flow * delay), scipy.linalg.expm(flow * (h - delay))
    plant = after[:2, :2] @ before[:2, :2]
    old, new = after[:2, :2] @ before[:2, 2], after[:2, 2]
    whole = np.zeros((4, 4))
    whole[0, :2] = 1.0, h
    whole[1:3, 1:3], whole[1:3, 3] = plant, old
    entry = np.array([0.0, *new, 1.0])
    return np.abs(np.linalg.eigvals(whole + np.outer(entry, [*k, 0.0, 0.0]))).max()


@pytest.mark.slow
def test_a_failing_hull_vertex_is_no_failing_machine(rig):
    """The PI of CMA-ES has a pole of 1.087 at a vertex, and none outside of the circle at a machine; the published gain
    has one. Poles of machines are SciPy's."""
    proof, box = rig["proof"], rig["box"]
    names = {"published": "known-published-gain", "searched": "known-pi-cma-es"}
    documents = {name: json.loads((FOLDER / f"{file}.json").read_text()) for name, file in names.items()}
    ones = {name: rig["document"].loop_of(document) for name, document in documents.items()}
    found = proof.proofs(proof.Proving(cuts=1, grid=3), box.Box(), box.Fixed(), ones)
    b, low = box.Box(), 5 / 3.6
    inertia = (7.53e-3 * 0.9 / 1.03, 7.53e-3 * 1.1 * 1.03)  # a speed seen 3 % high or low is a range of the inertia
    heights = (0.9 * RIG.w4, 1.1 * RIG.w4)
    machines = list(itertools.product(b.mass, inertia, heights, (low, 70 / 3.6), b.lag, b.delay))
    for name, one in ones.items():
        k, _ = proof.gain(one)
        worst = max(slip_poles(k, at) for at in machines)
        assert found[name]["largest frozen |pole| of a machine"] == pytest.approx(worst, abs=1e-6)
    assert found["published"]["said"] == "unstable"
    assert found["searched"]["said"] == "refuted"
    assert found["searched"]["largest frozen |pole| of a machine"] < 1


def let_go(rig, rest):
    """A loop whose estimate gets so far ahead that the wheel rolls where it seems to slip as asked; and its run."""
    one = quiet(rig, "estimated", "nominal")
    at = rig["box"].columns({name: np.full(1, value) for name, value in LET_GO.items()})
    one = d.replace(one, {path: float(value[0]) for path, value in at.items()} | {"sensor.blocks.4.rest": rest})
    return one, d.rollout(one, d.FixedStep(1e-3, 4.0, kinks=False), key=jax.random.key(0))


@killed_by("parts.sensors.speed_estimator", "(slip < self.gate) | (braked >= self.rest)", "(slip < 2.0)")
@pytest.mark.slow
def test_a_brake_that_was_let_go_by_mistake_bites_again(rig):
    """The wheel that seems to slip does not push, so it is believed in the end; the same in NumPy. Where nobody looks
    at that, the car rolls for ever."""
    one, run = let_go(rig, 1.0)
    assert bool(run.stopped)
    sample, steps = run.trajectory.sample, int(np.asarray(run.trajectory.running).sum()) - 1
    found = oracle.simulated(json.loads(json.dumps(rig["document"].document(one))), steps)
    np.testing.assert_allclose(np.asarray(sample.output.speed)[: steps + 1], found["speed"], rtol=1e-9)
    force = np.asarray(sample.output.deceleration)[1000 : steps + 1]
    assert force.min() < 1.0 - LET_GO["bias"]  # let go on the way
    assert force[-1] > 7.0  # m/s^2: at work again at the end
    _, lost = let_go(rig, 1e-200)
    assert not bool(lost.stopped)
    np.testing.assert_array_less(5 / 3.6, np.asarray(lost.trajectory.sample.output.speed))


@killed_by("parts.controllers.sampled_on_grid", "fixed / clock.h, 0.0", "fixed / clock.h + 0.5, 0.0")
@pytest.mark.slow
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


@pytest.mark.slow
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


def fed(block, outputs, key=None):
    """What a sampled sensor puts out at 1 kHz for these outputs of a plant, (n,) each."""

    def step(memory, at):
        k, signal = at
        memory = block.tick(Clock(1e-3 * k, 1e-3, k, key), memory, signal)
        return memory, block.output(1e-3 * k, memory, signal)

    first = jax.tree.map(lambda x: x[0], outputs)
    return jax.lax.scan(step, block.start(first), (jnp.arange(len(outputs[0])), outputs))[1]


@killed_by(
    "parts.sensors.noise", "wheel_speed=signal.wheel_speed - signal.speed * noise", "wheel_speed=signal.wheel_speed"
)
def test_noise_of_the_wheel_is_the_slip_s_at_any_speed():
    n = 4000
    v = jnp.linspace(20.0, 2.0, n)
    true = BrakeOutput(0.2 + 0.0 * v, v, 0.8 * v, 8.0 + 0.0 * v, 0.0 * v)
    seen = fed(sensors.WheelNoise(slip=0.01), true, jax.random.key(5))
    noise = np.asarray(seen.slip) - 0.2
    np.testing.assert_allclose((v - seen.wheel_speed) / v, seen.slip, rtol=1e-12)
    np.testing.assert_allclose(seen.speed, v, rtol=0)
    for part in (noise[: n // 2], noise[n // 2 :]):
        assert abs(part.std() / 0.01 - 1) < 4 / np.sqrt(2 * n / 2)
    assert abs(np.corrcoef(noise[1:], noise[:-1])[0, 1]) < 4 / np.sqrt(n)
    assert float(sensors.WheelNoise(slip=0.01).start(true).held[0]) == 0  # before the first instant


@killed_by("parts.sensors.noise", "played % noise.size", "played")
def test_a_played_noise_is_the_sequence_that_is_given():
    """Three entries of 2 ms, which repeat, of the slip at any speed."""
    n, noise = 20, np.array([0.01, -0.02, 0.005])
    v = jnp.linspace(20.0, 2.0, n)
    true = BrakeOutput(0.2 + 0.0 * v, v, 0.8 * v, 8.0 + 0.0 * v, 0.0 * v)
    seen = fed(sensors.PlayedWheelNoise(noise=noise, period=2e-3), true)
    np.testing.assert_allclose(seen.slip, 0.2 + np.repeat(np.tile(noise, 4), 2)[:n], rtol=1e-14)
    np.testing.assert_allclose((v - seen.wheel_speed) / v, seen.slip, rtol=1e-12)


@killed_by("parts.sensors.speed_estimator", "clamp(1 - slip / self.gate, 0.0, 1.0)", "1.0 + 0.0 * slip")
def test_an_estimator_is_not_led_astray_by_a_wheel_that_locks():
    """It rolls for 20 ms, locks for 0.3 s, and rolls again, at 8 m/s^2; the accelerometer is off by 0.1 m/s^2."""
    t = 1e-3 * jnp.arange(500)
    v = 15.0 - 8.0 * t
    w = v * jnp.clip(jnp.where(t < 0.2, 1 - (t - 0.02) / 0.01, (t - 0.33) / 0.01), 0.0, 1.0)
    true = BrakeOutput(1 - w / v, v, w, 8.1 + 0.0 * v, 0.0 * v)
    gated, open_ = (fed(sensors.SpeedEstimator(gate=gate, growth=0.05), true) for gate in (0.03, 0.99))
    error = np.asarray(gated.speed - v)
    assert np.abs(error).max() < 0.07
    assert np.abs(np.asarray(open_.speed - v)).max() > 1.0
    locked = slice(40, 320)  # the accelerometer alone: its bias, integrated
    np.testing.assert_allclose(np.diff(error[locked]), -1e-4, rtol=1e-6)
    assert abs(error[-1]) < 0.2 * abs(error[320])  # what it had lost is found again on the wheel that rolls
    np.testing.assert_allclose(gated.slip, 1 - w / gated.speed, rtol=0, atol=1e-12)


@killed_by(
    "parts.sensors.speed_estimator",
    "larger(signal.deceleration, m.braked * jnp.exp(-self.period / self.hold))",
    "signal.deceleration",
)
def test_a_wheel_that_does_not_push_is_believed_after_a_while():
    """Where it seems to slip and nothing decelerates, the filter begins anew, hold ln(g/rest) after it began."""
    hold, rest, k = 0.02, 1.5, np.arange(120)
    w = jnp.where(k == 0, 10.0, 7.0) + 0.0
    estimator = sensors.SpeedEstimator(gate=0.01, rest=rest, hold=hold)
    seen = fed(estimator, BrakeOutput(0 * w, w, w, 0 * w, 0 * w))
    first = int(np.ceil(hold * np.log(9.81 / rest) / 1e-3))
    assert first == 38
    np.testing.assert_allclose(seen.speed, np.where(k < first, 10.0, 7.0), rtol=1e-12)
    for slow in (0.0, 5.0):  # locked, or merely slipping, and now and then a sample that shows nothing: never believed
        w = jnp.where(k == 0, 10.0, slow)
        a = np.where(k % 10 == 9, 0.0, 1.001 * rest * np.exp(1e-3 / hold))
        seen = fed(estimator, BrakeOutput(0 * w, w, w, jnp.asarray(a), 0 * w))
        np.testing.assert_allclose(seen.speed, 10.0 - 1e-3 * (np.cumsum(a) - a[0]), rtol=1e-12)


@killed_by("parts.sensors.speed_estimator", "(1 - gain) * variance", "variance")
def test_the_estimator_averages_the_first_samples():
    """P starts at R, so without growth the gains are 1/2, 1/3, ...: of a wheel that rolls, and is never slower than the
    estimate, the estimate is the mean so far."""
    w = 10.0 + 1e-3 * jnp.arange(40.0)
    still = BrakeOutput(0 * w, w, w, 0 * w, 0 * w)
    seen = fed(sensors.SpeedEstimator(growth=1e-9, noise=0.005), still)
    mean = np.cumsum(w) / np.arange(1, 41)
    np.testing.assert_allclose(seen.speed, mean, rtol=1e-5)  # R goes with the estimate


@killed_by(
    "parts.references.limited",
    "h = self.period * self.reference_speed / jnp.maximum(signal.speed, self.floor)",
    "h = self.period",
)
def test_a_limited_target_has_one_torque_at_every_speed():
    """Its rise, times the speed, is at most rate v0; and then it settles with T v/v0."""
    target = references.LimitedSlip(rate=3.0, time_constant=0.02, reference_speed=10.0)
    for v in (5.0, 20.0):
        n = 600
        speed = jnp.full(n, v)
        still = BrakeOutput(0 * speed, speed, speed, 0 * speed, 0 * speed)
        rise = np.asarray(fed(target, still))
        steps = np.diff(np.concatenate([[0.0], rise]))
        assert steps.max() * v / 10.0 / 1e-3 <= 3.0 * (1 + 1e-9)
        first = (0.2 - 3.0 * 0.02) / 3.0 * v / 10.0  # s, as long as it rises at its limit
        np.testing.assert_allclose(rise[int(0.5 * first / 1e-3)], 3.0 * 10 / v * 1e-3 * (int(0.5 * first / 1e-3) + 1))
        left = 0.2 - rise[int(first / 1e-3) + 20 : int(first / 1e-3) + 80]
        np.testing.assert_allclose(left[1:] / left[:-1], np.exp(-1e-3 * 10.0 / (0.02 * v)), rtol=1e-6)


@pytest.mark.slow
def test_the_packaged_scenario_neither_locks_nor_strays(rig):
    """slip-real, with sixteen noises, beside the same loop that sees the true speed."""
    found = scenario.load("slip-real", integrated=False)
    lanes = d.Batch({"sensor.blocks.3.deceleration": np.linspace(-0.1, 0.1, 16)}, np.arange(16))
    measured = {"locked": objectives.LockedTime(), "distance": objectives.StopDistance()}
    run = d.run_batch(found.loop, lanes, found.solver, measured)
    assert not np.any(run.diverged)
    assert np.all(run.metrics["locked"] == 0)
    truth = rig["loops"].with_truth(found.loop)
    known = d.run_batch(truth, d.Batch({}, np.arange(16)), found.solver, measured)
    np.testing.assert_allclose(run.metrics["distance"], known.metrics["distance"], rtol=0.02)
