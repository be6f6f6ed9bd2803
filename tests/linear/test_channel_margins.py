"""Loops with several channels: closed forms, python-control, SciPy, and the margins of their scalar loops."""

import json
import math
from itertools import pairwise, product

import control
import numpy as np
import pytest
from commands import assert_one_error_line
from commands import run as command
from mutants import killed_by
from project import ROOT
from scipy.linalg import eigvals, expm

from diffabs.core.blocks import Series
from diffabs.core.pytree import replace
from diffabs.linear import OpenLoop, Transfer, band, linearize, lqr, margins, multivariable_margins, open_loop
from diffabs.linear.operating_point import operating_point
from diffabs.parts.actuators import Delay, Lag, PerControl
from diffabs.parts.controllers import PID, MatrixFeedback, PerChannel, Sampled
from diffabs.parts.plants.quadruple_tank import PumpVoltages, QuadrupleTank, TankLevels
from diffabs.robust.design.state_feedback import feedback_gain, reduce_loop
from diffabs.robust.reach.equations import derive_equations
from diffabs.scenario.scenario import load

LEVELS = {"minimum phase": (0.124, 0.127, 0.018, 0.014), "non-minimum phase": (0.126, 0.130, 0.048, 0.049)}
PUMPS = {"minimum phase": (3.0, 3.0), "non-minimum phase": (3.15, 3.15)}
PLANTS = {
    "minimum phase": QuadrupleTank(),
    "non-minimum phase": QuadrupleTank(flow_1=3.14e-6, flow_2=3.29e-6, share_1=0.43, share_2=0.34),
}
TIMES = {"minimum phase": (62, 90, 23, 30), "non-minimum phase": (63, 91, 39, 56)}
ZEROS = {"minimum phase": (-0.060, -0.018), "non-minimum phase": (-0.057, 0.013)}
CHANNELS = {"pump_1": "level_1", "pump_2": "level_2"}
GAINS = {"pump_1": (150.0, 5.0), "pump_2": (135.0, 3.375)}
PERIOD = 0.5


def tank(setting="minimum phase", **parts):
    loop = load("quadruple-tank").loop
    first, second = LEVELS[setting][:2]
    changes = {"plant": PLANTS[setting], "reference.level_1.value": first, "reference.level_2.value": second}
    return replace(loop, changes | parts)


def sampled(delay=0.0, **gains):
    each = {name: PID(kp=kp, ki=ki, cutoff=1.0) for name, (kp, ki) in (GAINS | gains).items()}
    return Sampled(controller=PerChannel(each, CHANNELS), period=PERIOD, delay=delay)


DECOUPLED = QuadrupleTank(share_1=1.0, share_2=1.0)


def single(level, opened):
    """The scalar loop of a pump and its level, by the formulas of the tank and the PI controller."""
    i = {"pump_1": 0, "pump_2": 1}[level]
    area, outlet, flow = ((28e-4, 0.071e-4, 3.33e-6), (32e-4, 0.057e-4, 3.35e-6))[i]
    h, film, (kp, ki) = LEVELS["minimum phase"][i], 1e-4, GAINS[level]
    slope = outlet * math.sqrt(2 * 9.81) * ((h**2 + film**2) ** -0.25 - 0.5 * h**2 * (h**2 + film**2) ** -1.25)
    plant = Transfer(*(np.array([[x]]) for x in (-slope / area, flow / area, 1.0, 0.0)))
    step = PERIOD if opened.period else 1.0
    controller = (np.array([[x]]) for x in (1.0 if opened.period else 0.0, -step, ki, -kp))
    return OpenLoop(plant, Transfer(*controller, period=opened.period), opened.delay)


@pytest.mark.parametrize("plant", PLANTS)
def test_the_tank_has_the_published_time_constants_and_zeros(plant):
    levels, pumps = TankLevels(*LEVELS[plant]), PumpVoltages(*PUMPS[plant])
    A = np.asarray(linearize(PLANTS[plant], levels, pumps).A)
    np.testing.assert_allclose(-1 / np.diag(A), TIMES[plant], atol=1.0)
    opened = open_loop(tank(plant)).plant
    C = opened.C[2:4]
    np.testing.assert_array_equal(C, np.eye(2, 4))
    pencil = np.block([[opened.A, opened.B], [C, np.zeros((2, 2))]])
    mass = np.zeros_like(pencil)
    mass[:4, :4] = np.eye(4)
    zeros = eigvals(pencil, mass)
    zeros = np.sort(zeros[np.isfinite(zeros) & (np.abs(zeros) < 1e3)].real)
    np.testing.assert_allclose(zeros, ZEROS[plant], atol=1.2e-3)


@killed_by("linear.channel_loop", "A=system.A - system.B[:, others] @ system.C[others],", "A=system.A,", case="coupled")
@pytest.mark.parametrize("name", ["coupled", "sampled", "lags"])
def test_poles_and_open_channels_are_those_of_python_control(name):
    parts = {
        "coupled": {},
        "sampled": {"controller": sampled(0.2)},
        "lags": {"actuator": PerControl(actuator={"pump_1": Lag(time_constant=3.0), "pump_2": Lag(time_constant=1.0)})},
    }[name]
    opened = open_loop(tank(**parts))
    L = opened.transfer()
    theirs = control.ss(L.A, L.B, L.C, L.D, L.period or 0)
    found = multivariable_margins(opened)
    poles = np.sort_complex(control.feedback(theirs, np.eye(2)).poles())
    np.testing.assert_allclose(np.sort_complex(found.poles), poles, rtol=1e-6, atol=1e-10)
    w = np.geomspace(1e-4, math.pi / PERIOD, 200)
    for i, channel in enumerate(CHANNELS):
        other = 1 - i
        closed = control.feedback(theirs, control.ss([], [], [], np.diag(np.eye(2)[other]), L.period or 0))
        ours = margins(opened, channel)
        at = (lambda w: np.exp(1j * w * PERIOD)) if L.period else (lambda w: 1j * w)
        crossing = closed(at(ours.phase_at))[i, i]
        np.testing.assert_allclose(abs(crossing), 1.0, rtol=1e-8)
        np.testing.assert_allclose(abs(np.angle(-crossing)), ours.phase, rtol=1e-8)
        response = closed(at(w))[i, i]
        assert np.sum(np.diff(np.abs(response) > 1)) == 1  # no crossing but this one
        assert ours.modulus <= np.min(np.abs(1 + response)) * (1 + 1e-9)
        assert ours.modulus >= np.min(np.abs(1 + response)) * 0.99


@pytest.mark.parametrize("name", ["continuous", "sampled", "sampled late"])
def test_channels_that_do_not_meet_have_the_margins_of_their_scalar_loops(name):
    parts = {"continuous": {}, "sampled": {"controller": sampled()}, "sampled late": {"controller": sampled(0.3)}}[name]
    if name == "continuous":
        parts = {"controller": sampled().controller}
    opened = open_loop(tank(plant=DECOUPLED, **{"initial.level_3": 0.0, "initial.level_4": 0.0}, **parts))
    both = multivariable_margins(opened)
    alone = {channel: margins(single(channel, opened)) for channel in CHANNELS}
    for channel, wanted in alone.items():
        for key, value in wanted.numbers().items():
            assert both.channels[channel].numbers()[key] == pytest.approx(value, rel=1e-6), (channel, key)
    assert both.input.smallest == pytest.approx(min(m.modulus for m in alone.values()), rel=1e-8)
    assert both.input.complementary == pytest.approx(max(m.complementary for m in alone.values()), rel=1e-8)
    assert both.output
    assert both.output.smallest == pytest.approx(both.input.smallest, rel=1e-8)


@pytest.mark.parametrize("name", ["continuous", "sampled"])
def test_the_least_singular_value_is_that_of_a_dense_grid(name):
    """The loop is an interconnection of python-control, from plant and controllers."""
    lags = PerControl(actuator={"pump_1": Lag(time_constant=9.0), "pump_2": Lag(time_constant=4.0)})
    opened = open_loop(tank(actuator=lags, controller=sampled() if name == "sampled" else sampled().controller))
    found = multivariable_margins(opened)
    A, B = opened.plant.A[:4, :4], opened.plant.A[:4, 4:]
    plant = control.ss(A, B, np.eye(2, 4), 0)
    plant = plant * control.append(control.ss(control.tf(1, [9.0, 1])), control.ss(control.tf(1, [4.0, 1])))
    each = [control.ss([[0]], [[1]], [[ki]], [[kp]]) for kp, ki in GAINS.values()]
    if name == "sampled":
        plant = control.c2d(plant, PERIOD)
        each = [control.ss([[1]], [[PERIOD]], [[ki]], [[kp]], PERIOD) for kp, ki in GAINS.values()]
    regulator = control.append(*each)
    w = np.geomspace(1e-2, 1.0, 20_001)
    at = np.exp(1j * w * PERIOD) if name == "sampled" else 1j * w
    G, K = (np.moveaxis(system(at), -1, 0) for system in (plant, regulator))
    for L, ours in ((K @ G, found.input), (G @ K, found.output)):
        values = np.linalg.svd(np.eye(2) + L, compute_uv=False)[:, -1]
        i = np.argmin(values)
        assert values[i] < 0.9  # inside the axis, and no limit
        np.testing.assert_allclose(ours.smallest, values[i], rtol=1e-6)
        np.testing.assert_allclose(ours.sensitivity_at, w[i], rtol=1e-3)
        peak = np.linalg.svd(L @ np.linalg.inv(np.eye(2) + L), compute_uv=False)[:, 0].max()
        np.testing.assert_allclose(ours.complementary, peak, rtol=1e-6)


def step_matrix(opened, delays):
    """The closed loop over a period, from SciPy's exponentials of the pieces between the arrivals of both inputs."""
    plant, K = opened.plant, opened.controller
    n, c = len(plant.A), len(K.A)
    whole = [int(delay // PERIOD) for delay in delays]
    rests = [delay - PERIOD * k for delay, k in zip(delays, whole, strict=True)]
    starts = n + c + np.cumsum([0, whole[0] + 1])
    size = n + c + sum(whole) + 2
    rates = np.zeros((n + 2, n + 2))
    rates[:n, :n], rates[:n, n:] = plant.A, plant.B

    def step(state):
        x, memory = state[:n], state[n : n + c]
        buffers = [state[s : s + k + 1] for s, k in zip(starts, whole, strict=True)]  # the latest input first
        y = plant.C @ x
        u = K.C @ memory + K.D @ y
        queues = [np.append(u[i], buffers[i]) for i in range(2)]
        ends = sorted({0.0, *rests, PERIOD})
        for begin, end in pairwise(ends):
            middle = 0.5 * (begin + end)
            held = [queues[i][whole[i] + (middle < rests[i])] for i in range(2)]
            x = (expm(rates * (end - begin)) @ np.concatenate([x, held]))[:n]
        return np.concatenate([x, K.A @ memory + K.B @ y, *(queue[:-1] for queue in queues)])

    return np.stack([step(unit) for unit in np.eye(size)], axis=1)


def test_the_delay_margin_of_a_sampled_channel_is_where_the_loop_turns_unstable():
    opened = open_loop(tank(controller=sampled(0.2, pump_1=(600.0, 20.0))))
    for i, channel in enumerate(CHANNELS):
        margin = margins(opened, channel).delay
        for factor, unstable in ((0.999, False), (1.001, True)):
            delays = [0.2, 0.2]
            delays[i] += factor * margin
            radius = np.max(np.abs(np.linalg.eigvals(step_matrix(opened, delays))))
            assert (radius > 1) == unstable, (channel, factor, radius)


@killed_by("linear.multivariable_margins", "m[:, i, :] *= scale", "m[:, i, :] *= 0.1 * scale")
def test_factors_within_the_disk_margin_leave_the_loop_stable():
    lags = PerControl(actuator={"pump_1": Lag(time_constant=9.0), "pump_2": Lag(time_constant=4.0)})
    opened = open_loop(tank(actuator=lags))
    L, found = opened.transfer(), multivariable_margins(opened).input

    def worst(size):
        """The largest real part of a pole, over factors on the circle |d| = size."""
        circle = size * np.exp(2j * np.pi * np.arange(24) / 24)
        factors = (1 + circle / 2) / (1 - circle / 2)
        return max(np.linalg.eigvals(L.A - L.B @ np.diag(pair) @ L.C).real.max() for pair in product(factors, factors))

    assert worst(0.99 * found.disk) < 0 < worst(1.05 * found.disk)
    low, high = found.gain
    assert low == pytest.approx(1 / high)
    d = np.exp(1j * math.pi / 2) * found.disk
    assert abs(np.angle((1 + d / 2) / (1 - d / 2))) == pytest.approx(found.phase)


def test_the_disk_margin_does_not_depend_on_units():
    L = open_loop(tank()).transfer()
    units = np.diag([1.0, 1e3])
    other = L._replace(B=L.B @ units, C=np.linalg.inv(units) @ L.C)
    a, b = (multivariable_margins(system).input for system in (L, other))
    assert a.disk == pytest.approx(b.disk, rel=1e-7)
    assert a.smallest != pytest.approx(b.smallest, rel=1e-3)


def regulated():
    """The tank under an LQR with integrals of the errors, weighed by R = I."""
    loop = tank()
    A, B = open_loop(loop).plant[:2]
    A = np.block([[np.zeros((2, 2)), np.eye(2, 4)], [np.zeros((4, 2)), A]])
    B = np.vstack([np.zeros((2, 2)), B])
    regulator = lqr(A, B, np.diag([10.0, 10.0, 3e3, 3e3, 0.0, 0.0]), np.eye(2))
    states = ("level_1", "level_2", "level_3", "level_4")
    return A, B, np.asarray(regulator.gain), replace(
        loop,
        {
            "controller": MatrixFeedback(
                gain=np.asarray(regulator.gain),
                outputs_at_rest=np.array(LEVELS["minimum phase"]), windup=np.zeros((2, 2)),
                low=np.zeros(2), high=np.full(2, 10.0), states=states,
            )
        },
    )  # fmt: skip


def test_an_lqr_of_the_tank_keeps_the_return_difference_above_one():
    """With R = I, Kalman's inequality says s(I + L) >= 1; every channel then has 60 degrees, and half to all gains."""
    A, B, gain, loop = regulated()
    opened = open_loop(loop)
    found = multivariable_margins(opened)
    np.testing.assert_allclose(
        np.sort_complex(found.poles), np.sort_complex(np.linalg.eigvals(A + B @ gain)), rtol=1e-5
    )
    assert found.input.smallest == pytest.approx(1.0, abs=1e-9)
    for channel in found.channels.values():
        assert channel.gain[0] <= 0.5
        assert channel.gain[1] == math.inf
        assert channel.phase >= math.pi / 3


@killed_by("linear.operating_point", "self.held, name)._replace(flow=getattr(x, name))", "self.held, name)")
def test_the_operating_point_has_the_poles_of_the_closed_loop():
    loop = tank()
    point, opened = operating_point(loop), open_loop(loop)
    A, B = point.matrices()
    K = point.gain()
    assert B.shape[1] == K.shape[0] == 2
    assert point.states[:4] == ("level_1", "level_2", "level_3", "level_4")
    poles = np.sort_complex(np.linalg.eigvals(np.asarray(A + B @ K)))
    np.testing.assert_allclose(poles, np.sort_complex(multivariable_margins(opened).poles), rtol=1e-7)


def test_what_has_no_margins_says_why():
    opened = open_loop(tank())
    with pytest.raises(ValueError, match="name a channel: pump_1 or pump_2"):
        margins(opened)
    with pytest.raises(
        ValueError, match="channel = 'pump_3' is no channel of the loop; its channels are pump_1, pump_2"
    ):
        margins(opened, "pump_3")
    with pytest.raises(ValueError, match="channel = 'x' is no channel of the loop; its channels are none"):
        margins(opened.transfer(), "x")
    with pytest.raises(ValueError, match="the loop has several targets, level_1, level_2: set its reference"):
        open_loop(tank(), 0.1)
    late = open_loop(tank(actuator=Series(blocks=(Delay(time=0.5),))))
    for judge in (multivariable_margins, lambda loop: margins(loop, "pump_1")):
        with pytest.raises(ValueError, match=r"delay = 0\.5 s: margins of several channels in continuous"):
            judge(late)


@killed_by("cli.show_margins", "for channel, single in all_margins.channels.items():", "for channel, single in ():")
def test_the_command_says_margins_of_each_channel():
    text = command("margins", "quadruple-tank")
    for words in ("pump_1", "pump_2", "at the controls"):
        assert words in text.stdout
    result = json.loads(command("margins", "quadruple-tank", "--json").stdout)
    assert result["channels"].keys() == CHANNELS.keys()
    assert result["input"]["smallest"] == pytest.approx(1.0)
    assert result["input"].keys() | result["channels"]["pump_1"].keys() <= result["units"].keys() | {"stable"}


@pytest.mark.parametrize(
    ("arguments", "who"),
    [
        (("margins", "quadruple-tank", "--plot", "{folder}/loop.png"), "margins --plot"),
        (("design", "quadruple-tank"), "design"),
        (("certify", "quadruple-tank"), "certify"),
        (("prove", "quadruple-tank", "--over", "plant.share_1=0.6:0.7"), "prove"),
    ],
)
def test_commands_for_one_control_refuse_in_one_line(arguments, who, tmp_path):
    done = command(*(text.format(folder=tmp_path) for text in arguments), status=2)
    assert f"{who} needs a loop with one control; plant QuadrupleTank has pump_1, pump_2\n" in done.stderr
    assert_one_error_line(done)


def test_tools_for_one_control_refuse():
    loop = tank()
    refusing = {
        "a band of margins": lambda: band(loop, {}),
        "a proof by state feedback": lambda: reduce_loop(loop),
        "a constraint on poles or decay": lambda: feedback_gain(loop, ("level_1",)),
        "a proof over a box": lambda: derive_equations(loop, ("plant.share_1",)),
    }
    for who, call in refusing.items():
        with pytest.raises(ValueError, match=f"{who} needs a loop with one control; .* has pump_1, pump_2"):
            call()


@pytest.mark.slow
def test_the_page_runs(capsys):
    code = (ROOT / "docs" / "margins.md").read_text().split("```python\n")[2].partition("```")[0]
    exec(compile(code, "margins.md", "exec"), {})
    phase, disk, smallest = map(float, capsys.readouterr().out.split())
    assert phase > 1
    assert disk > 1
    assert smallest == pytest.approx(1.0, abs=1e-6)


@killed_by("linear.opened_loop", "isinstance(block, Delay) or any", "any")
@pytest.mark.parametrize("block", [Delay(time=0.5), Series(blocks=(Delay(time=0.5), Lag()))])
def test_a_delay_of_one_control_is_refused(block):
    loop = tank(actuator=PerControl(actuator={"pump_1": block}))
    with pytest.raises(ValueError, match="actuator PerControl delays some controls: a linear loop has one delay"):
        open_loop(loop)
    assert open_loop(tank(actuator=Delay(time=0.5))).delay == 0.5
