"""Pure delay against closed forms: where the command is smooth, where it jumps, at steps of any length, and derivatives
with respect to everything. Against SciPy: `test_order_of_events.py`; in random loops: `gradients_random.py`."""

import dataclasses
import functools
from math import factorial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from delays import H, Integrator, Proportional, Says, loop
from marks import cases
from mutants import killed_by
from signals import Mean, close

import diffabs as d
from diffabs.core.blocks import Series
from diffabs.core.cubic import HermiteStep
from diffabs.core.protocols import Clock, Memory, no_flow
from diffabs.core.pytree import canonical_dtypes, param, pytree
from diffabs.engine.step.attempt import start_state
from diffabs.engine.step.system import build_system
from diffabs.parts.actuators import Delay, Lag, Limits
from diffabs.parts.controllers import ConstantTorque, Relay, Sampled
from diffabs.parts.objectives import TorqueRate
from diffabs.parts.references import Setpoint


@pytree
class Toggles:
    """From 2 to 5, and back, first at `first` and then `every` so often."""

    first: Any = param(default=1e-2, unit="s")
    every: Any = param(default=1.0, unit="s")

    flow = no_flow

    def start(self, signal):
        return Memory(held=(2.0 + 0.0 * signal.target, self.first + 0.0 * signal.target))

    def output(self, t, memory, signal):
        return memory.held[0]

    def margins(self, t, memory, signal, rate):
        return (memory.held[1] - t,)

    def event(self, t, memory, signal, fired):
        level, until = memory.held
        return Memory(held=(jnp.where(fired[0], 7.0 - level, level), jnp.where(fired[0], until + self.every, until)))


RAMP = Says(read=lambda t: 3.0 + 1000.0 * t)


def played(controller, actuator, steps, h=H, **solver):
    """Control at the instants, and its mean."""
    run = d.rollout(loop(controller, actuator), d.FixedStep(h, steps * h, **solver), {"mean": Mean()})
    assert not run.diverged
    return np.asarray(run.trajectory.sample.control), float(run.metrics["mean"][1])


# A smooth command


@pytest.mark.slow
@killed_by("core.log", "if self.lent else rows", "if False else rows", case="1.0")
@pytest.mark.parametrize("back", [1.0, 2.0, 2.7, 5.5])
def test_a_ramp_comes_later(back):
    """Exact at the instants and in the mean, from the very first moment."""
    u, mean = played(RAMP, Delay(time=back * H, capacity=9), 25)
    came = H * (np.arange(26) - back)
    close(u, np.where(came > -1e-12, 3.0 + 1000.0 * came, 0.0), rtol=1e-11)
    last = came[-1]
    close(mean, (3.0 * last + 500.0 * last**2) / (25 * H), rtol=1e-11)


@pytest.mark.slow
def test_a_sine_comes_later_to_fourth_order():
    w = 200.0
    says = Says(read=lambda t: jnp.sin(w * t))

    def error(n):
        h = 0.05 / n
        u, mean = played(says, Delay(time=0.0123, capacity=204), n, h=h)
        a = h * np.arange(n + 1) - 0.0123
        whole = (1 - np.cos(w * a[-1])) / w / 0.05
        return np.max(np.abs(u - np.where(a > 0, np.sin(w * a), 0.0))), abs(mean - whole)

    counts = np.array([50, 100, 200])
    at_instants, means = np.log([error(int(n)) for n in counts]).T
    for found in (at_instants, means):
        order = -np.polyfit(np.log(counts), found, 1)[0]
        assert order > 3.7, order


def delayed_decay(t, k, late):
    """x' = -k x(t - late), where 0 until then: by the method of steps, the sum of (-k)^n (t - n late)^n/n!."""
    return sum((-k) ** n * max(t - n * late, 0.0) ** n / factorial(n) for n in range(1, 40)) + 1.0


@pytest.mark.parametrize("kinks", [pytest.param(False, marks=pytest.mark.slow), True])
@pytest.mark.slow
def test_converges_to_the_method_of_steps(kinks):
    """The command's second derivative jumps, once, in the midst of a step: third order."""
    k, late, end = 40.0, 0.03137, 0.25

    def error(n):
        solver = d.FixedStep(end / n, end, kinks=kinks)
        run = d.measure(loop(Proportional(k=k), Delay(time=late, capacity=400), Integrator(), 1.0), solver, {})
        return abs(float(run.ending.sample.output.slip) - delayed_decay(end, k, late))

    errors = [error(n) for n in (50, 100, 200, 400)]
    assert errors[-1] < 5e-8, errors
    assert np.log2(errors[0] / errors[-1]) / 3 > 2.7, errors


@killed_by("parts.actuators.delay", "jnp.where(at[0] <= 1.0, moves[0], 0.0)", "0.0 * moves[0]", case="jacfwd-0.0317")
@pytest.mark.parametrize("late", [0.0317, pytest.param(0.03, marks=pytest.mark.slow)])
@pytest.mark.parametrize("derivative", [jax.jacfwd, pytest.param(jax.jacrev, marks=pytest.mark.slow)])
@pytest.mark.slow
def test_derivatives_of_the_method_of_steps(late, derivative):
    """With respect to gain and delay; also of a delay that is a whole number of steps, whose second derivatives jump on
    the grid: to second order there."""
    end = 0.25

    def final(at):
        run = d.measure(loop(Proportional(k=at[0]), Delay(time=at[1], capacity=64), Integrator(), 1.0), solver, {})
        return run.ending.sample.output.slip

    solver = d.FixedStep(1e-3, end)
    at, size = np.array([40.0, late]), np.array([40.0, late])
    moves = 1e-4 * np.diag(size)
    expected = [(delayed_decay(end, *(at + move)) - delayed_decay(end, *(at - move))) / 2e-4 for move in moves]
    np.testing.assert_allclose(np.asarray(derivative(final)(at)) * size, expected, rtol=2e-5)


# A command that jumps


@killed_by("parts.actuators.delay", "(m.window[i, -1] > 0.5)", "(m.window[i, -1] > 2.0)", case="0.0073-0.0026-False")
@pytest.mark.parametrize("kinks", cases([False, True], False))
@pytest.mark.parametrize(("first", "late"), [(7.3e-3, 2.6e-3), (7.3e-3, 2.7e-3), (7e-3, 2e-3), (7.3e-3, 1e-3)])
def test_a_jump_comes_out_at_its_moment(first, late, kinks):
    """Wherever both fall in a step, also on its end: 2 for a while, then 5, and no value between."""
    u, mean = played(Toggles(first=first), Delay(time=late, capacity=9), 14, kinks=kinks)
    close(mean, (2.0 * first + 5.0 * (14 * H - late - first)) / (14 * H), rtol=1e-12)
    t = H * np.arange(15)
    clear = np.abs(t - first - late) > 1e-9
    close(u[clear], np.where(t < late - 1e-9, 0.0, np.where(t < first + late, 2.0, 5.0))[clear], rtol=1e-12)


@functools.cache
def slope_of_jump(derivative):
    def mean(at):
        there = loop(Toggles(first=at[0]), Delay(time=at[1], capacity=9))
        return d.measure(there, d.FixedStep(H, 14 * H), {"mean": Mean()}).metrics["mean"][1]

    return jax.jit(derivative(mean))


@killed_by(
    "parts.actuators.delay",
    "_piece(m.window, last + 1).start,",
    "jax.lax.stop_gradient(_piece(m.window, last + 1).start),",
    case="0.0073-0.0026-jacfwd",
)
@pytest.mark.slow
@pytest.mark.parametrize("derivative", [jax.jacfwd, pytest.param(jax.jacrev, marks=pytest.mark.slow)])
@pytest.mark.parametrize(("first", "late"), [(7.3e-3, 2.6e-3), (7.3e-3, 2.7e-3), (7.25e-3, 0.75e-3 + H)])
def test_the_moment_of_a_jump_is_differentiable(first, late, derivative):
    """d(mean)/d(first) = -3/duration, d/d(late) = -5/duration; so on the grid, too."""

    close(slope_of_jump(derivative)(np.array([first, late])) * 14 * H, [-3.0, -5.0], rtol=1e-7)


@killed_by(
    "parts.actuators.delay",
    "jnp.where(newest, 1.0, -1.0) * _time_tolerance(until + self.time)",
    "_time_tolerance(until + self.time)",
    case="0.002",
)
@pytest.mark.slow
@pytest.mark.parametrize("late", [2e-3, pytest.param(2.4e-3, marks=pytest.mark.slow)])
def test_what_a_computer_says_comes_out_later(late):
    """It says the time, each 2 ms. The control is a staircase; its mean falls with the delay as the last level."""

    def mean(late):
        sampled = Sampled(controller=Says(read=lambda t: 1.0 + 100.0 * t), period=2e-3)
        there = loop(sampled, Delay(time=late, capacity=9))
        return d.measure(there, d.FixedStep(H, 14.5e-3), {"mean": Mean()}).metrics["mean"][1]

    levels, end = 1.0 + 100.0 * 2e-3 * np.arange(8), 15e-3 - late  # the run has 15 steps
    lengths = np.clip(end - 2e-3 * np.arange(8), 0.0, 2e-3)
    close(mean(late) * 15e-3, levels @ lengths, rtol=1e-11)
    close(jax.grad(mean)(late) * 15e-3, -levels[lengths > 1e-9][-1], rtol=1e-7)


@killed_by("parts.actuators.delay", "return jnp.any(jnp.stack(jumps))", "return jumps[0]", case="True")
@killed_by("engine.step.system", "(dynamics[:2], dynamics.signals.recorded)", "dynamics[:2]", case="True")
@killed_by(
    "core.blocks",
    "            signal = block.output(t, m, signal)\n        return inputs\n\n    def record",
    "        return inputs\n\n    def record",
    case="True",
)
@pytest.mark.slow
@pytest.mark.parametrize("kinks", cases([None, True], None))
def test_what_bends_comes_out_bent(kinks):
    """A command cut off at 5 by a limit before the delay, in series: the mean of its square to the order of the method
    where kinks are located."""
    read, late = Says(read=lambda t: 400.0 * t), 3.3e-3
    series = Series(blocks=(Limits(low=0.0, high=5.0), Delay(time=late, capacity=32)))
    u, mean = played(read, series, 30, kinks=kinks)
    came = np.maximum(H * np.arange(31) - late, 0.0)
    close(u, np.minimum(400.0 * came, 5.0), rtol=0, atol=1e-6 if kinks else 0.1)
    exact = (5.0 * (30 * H - late - 5.0 / 800.0)) / (30 * H)
    close(mean, exact, rtol=1e-7 if kinks else 1e-3)


def limit_cycle(band, late, force):
    """Period and greatest |x| of x' = u, where u is -force or force, told `late` after x has crossed -+band."""
    return 4.0 * (band / force + late), band + force * late


@pytest.mark.slow
def test_a_relay_behind_a_delay_has_its_limit_cycle():
    """Period and amplitude of an integrator, and their derivatives."""
    band, late, force = 0.05, 3.37e-3, 20.0

    def run(at):
        band, late, force = at
        relay = Relay(band=band, low=-force, high=force)
        there = loop(relay, Delay(time=late, capacity=64), Integrator(), 0.0)
        there = dataclasses.replace(there, reference=Setpoint(value=0.0))
        return d.measure(there, d.FixedStep(1e-3, 0.1), {"mean": Mean()}).ending.sample.output.slip

    def exact(at):
        """x(0.1): at rest until the first command comes, then up to the greatest, and to and fro."""
        band, late, force = at
        period, most = limit_cycle(band, late, force)
        phase = (0.1 - 2 * late - band / force) % period  # since it was least
        return force * phase - most if phase < period / 2 else most - force * (phase - period / 2)

    at = np.array([band, late, force])
    close(run(at), exact(at), rtol=0, atol=1e-11)
    slopes = [(exact(at + 1e-4 * e) - exact(at - 1e-4 * e)) / 2e-4 for e in np.diag(at)]
    for derivative in (jax.jacfwd, jax.jacrev):
        np.testing.assert_allclose(np.asarray(derivative(run)(at)) * at, slopes, rtol=1e-6, atol=1e-8)


# Steps that are not on a grid


def stepped(delay, command, slope, lengths, jumps=()):
    """Times, delayed commands before and after, and margins, where the steps have these lengths unless the delay cuts
    them: driven by hand, as by a solver that chooses its steps."""
    margins, output, record = jax.jit(delay.margins), jax.jit(delay.output), jax.jit(delay.record)
    event = jax.jit(lambda t, memory, cut: delay.event(t, memory, 0.0, (cut,)))
    tick = jax.jit(lambda t, h, whole, memory: delay.tick(Clock(t, h, 0, None, whole), memory, 0.0))
    memory, t = delay.start(jnp.asarray(0.0)), 0.0
    memory = tick(t, 0.0, True, memory)
    ends = np.cumsum(lengths)
    found, tries = [], 0
    for end in ends:
        while t < end - 1e-12:
            tries += 1
            margin = float(margins(t, memory, 0.0, None)[0])
            assert margin >= 0
            cut = margin < end - t
            h = min(margin, end - t)
            values = tuple(jnp.asarray(command(at, side)) for at, side in ((t, 1), (t + h, -1)))
            rates = tuple(jnp.asarray(slope(at)) for at in (t, t + h))
            middle = float(output(t + 0.5 * h, memory, 0.0))
            before = float(output(t + h, memory, 0.0))
            memory = event(t + h, memory, jnp.asarray(cut))
            memory = record(memory, HermiteStep(jnp.asarray(t), jnp.asarray(t + h), values, rates))
            found.append((t + 0.5 * h, middle, t + h, before))
            t = t + h
            memory = tick(t, h, not cut, memory)
            found[-1] += (float(output(t, memory, 0.0)),)
    return np.array(found), tries


@pytest.mark.slow
@killed_by(
    "parts.actuators.delay",
    "_piece(m.window, last).end)",
    "_piece(m.window, last).end + jnp.where(m.valid == m.count, 0.0, 1.0))",
)
def test_steps_of_any_length():
    """A cubic command that jumps by 3 at 0.1 s. Steps between 20 us and 5 ms; the delay is 3.7 ms, so that longer ones
    are cut. Exact everywhere; on a break, before and after."""
    rng = np.random.default_rng(5)
    lengths = np.exp(rng.uniform(np.log(2e-5), np.log(5e-3), 150))
    at = int(np.argmin(np.abs(np.cumsum(lengths) - 0.1)))
    jump = float(np.cumsum(lengths)[at])
    late = 3.7e-3

    def command(t, side):
        smooth = 2.0 + 30.0 * t - 400.0 * t**2 + 900.0 * t**3
        return smooth + 3.0 * ((t > jump + 1e-12) | ((abs(t - jump) < 1e-12) & (side > 0)))

    def slope(t):
        return 30.0 - 800.0 * t + 2700.0 * t**2

    found, tries = stepped(Delay(time=late, capacity=512), command, slope, lengths)
    middles, inside, ends, before, after = found.T

    def exact(t, side):
        return np.array([command(s, side) if s > 1e-12 or (s > -1e-12 and side > 0) else 0.0 for s in t - late])

    close(inside, exact(middles, 1), rtol=1e-9)
    close(before, exact(ends, -1), rtol=1e-9)
    close(after, exact(ends, 1), rtol=1e-9)
    assert np.min(np.abs(ends - jump - late)) < 1e-12
    assert tries < 2 * len(lengths)


# Where there is no room


@pytest.mark.slow
@killed_by(
    "parts.actuators.delay", "window = jnp.where(count < size, rows, jnp.nan)", "window = rows", case="0.0009-True"
)
@pytest.mark.parametrize(("every", "diverges"), [(4.1e-3, False), (0.9e-3, True)])
def test_a_delay_that_has_no_room_has_no_value(every, diverges):
    """30 steps of delay in a ring of 32: commands that jump each fourth step fit, those that jump in each do not."""
    there = loop(Toggles(first=1.3e-4, every=every), Delay(time=30 * H, capacity=32))
    run = d.measure(there, d.FixedStep(H, 0.035), {"mean": Mean()})
    assert bool(run.diverged) is diverges
    assert np.all(np.isfinite(run.metrics["mean"])) is np.bool_(not diverges)


@pytest.mark.slow
def test_a_lag_behind_a_delay():
    """1 - exp(-(t - late)/T), and the greatest rate where the command comes."""
    late, lag = 2.37e-3, 4e-3
    series = Series(blocks=(Delay(time=late, capacity=16), Lag(time_constant=lag)))
    there = loop(ConstantTorque(torque=50.0), series)
    run = d.rollout(there, d.FixedStep(H, 0.03), {"rate": TorqueRate()})
    since = np.maximum(np.asarray(run.trajectory.sample.t) - late, 0.0)
    close(run.trajectory.sample.control, 50.0 * (1 - np.exp(-since / lag)), rtol=0, atol=2e-3)
    close(run.metrics["rate"], 50.0 / lag, rtol=1e-12)


@killed_by(
    "parts.actuators.delay",
    "return _count([m.window[i, 1] for i in range(WINDOW_PIECES)], t - self.time, m.place, m.last)",
    "return jnp.clip(jnp.sum(t - self.time >= m.window[:, 1]).astype(m.last.dtype), m.place, m.last)",
)
def test_nobody_looks_for_the_ends_of_smooth_pieces():
    """A step spans two of them, and compares, but what it compares does not count as a kink."""
    there = canonical_dtypes(loop(Says(read=lambda t: jnp.sin(40.0 * t)), Delay(time=3.3e-3, capacity=16)))
    comparisons = []

    def traced():
        zero = jnp.asarray(0.0)
        state, accumulators = start_state(there, {}, Clock(zero, jnp.asarray(H), 0, None))
        comparisons.append(build_system(there, {}, zero, state, accumulators, switched=True).bit_count)

    jax.eval_shape(traced)
    assert comparisons == [0]


@killed_by("core.validity", 'part, "plant", None)), "problems")', 'part, "plant", None)), "none")')
@pytest.mark.parametrize(
    ("capacity", "message"),
    [
        (100.0, r"capacity = 100.0 is no integer; one in \[3, inf\) steps is needed"),
        (-5, r"capacity = -5 is outside \[3, inf\) steps"),
        (2, r"capacity = 2 is outside \[3, inf\) steps"),
    ],
)
def test_a_ring_without_room_is_refused_by_its_name(capacity, message):
    given = loop(RAMP, Delay(time=3 * H, capacity=capacity))
    for use in (d.check, lambda given: d.rollout(given, d.FixedStep(H, 10 * H))):
        with pytest.raises(ValueError, match=f"^actuator.{message}$"):
            use(given)
