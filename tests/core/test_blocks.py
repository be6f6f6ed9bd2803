"""Sensors, references, controllers and actuators against values by hand, closed forms and loops in NumPy."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from marks import cases
from mutants import killed_by
from scipy.optimize import brentq
from signals import H, Mean, Script, close, seen

import diffabs as d
from diffabs.core.blocks import Series, offers
from diffabs.core.protocols import BrakeOutput, Clock, Memory, Sample, Tracking
from diffabs.core.validity import check_part
from diffabs.engine.step.runge_kutta import rk4_step
from diffabs.parts.actuators import Lag, Limits, RateLimit
from diffabs.parts.controllers import (
    PID,
    BackCalculation,
    Clamping,
    ConstantTorque,
    FourPhase,
    NoAntiWindup,
    ProportionalFeedback,
    Relay,
    Sampled,
    ScheduledFeedback,
    SlidingMode,
    StateFeedback,
)
from diffabs.parts.controllers.pid import PIDMemory
from diffabs.parts.objectives import IAE, ITAE, MaxSlip, SettlingTime
from diffabs.parts.plants import BrakeStart, MirroredRig
from diffabs.parts.references import (
    ExtremumSeeking,
    FilteredSlip,
    FixedSlip,
    PeakLatch,
    PeakLiteral,
    PeakRobust,
    SlipByDeceleration,
)
from diffabs.parts.sensors import Bias, IntegratedAccelerometer, Noise, Quantisation, SpeedScale, WheelSpeed
from diffabs.parts.stops import NoStop, SpeedReached, Standstill


def sample(output, t=1.0):
    return Sample(t, output, 0.2, 0.2, 0.0, 0.0, 0.0)


def tracking(error, feedforward=0.0, target=0.2):
    return Tracking(target, seen(target - error), feedforward)


def run(block, signal, steps, h=H, key=None):
    """Tick, output, then RK4 over the step: outputs at the instants, as a loop would see them."""

    def step(memory, k):
        t = k * h
        memory = block.tick(Clock(t, h, k, key), memory, signal(t)) if offers(block, "tick") else memory
        flow = rk4_step(lambda t, z: block.flow(t, Memory(z, memory.held), signal(t)), t, memory.flow, h)
        return Memory(flow, memory.held), block.output(t, memory, signal(t))

    start = jax.tree.map(jnp.asarray, block.start(jax.tree.map(jnp.asarray, signal(0.0))))
    return jax.jit(lambda start: jax.lax.scan(step, start, jnp.arange(steps))[1])(start)


def played(read, steps, h=H, key=None, **parts):
    """Target and control at the instants and in the mean, of a loop whose plant follows a script."""
    loop = d.Loop(plant=Script(read=read), initial=0.0, stop=NoStop(), **{"reference": FixedSlip(), **parts})
    run = d.rollout(loop, d.FixedStep(h, steps * h), {"mean": Mean()}, key=key)
    seen = run.trajectory.sample
    assert not run.diverged
    return seen.target[:-1], seen.control[:-1], *run.metrics["mean"]


# Controllers


def test_pid_by_hand():
    """10 + 100 * 0.05 + 2000 * 0.01 + 3 * 55 * (0.05 - 0.02) = 39.95."""
    pid = PID(kp=100.0, ki=2000.0, kd=3.0, cutoff=55.0, low=0.0, high=90.0)
    memory = Memory(PIDMemory(0.01, 0.02))
    close(pid.output(0.0, memory, tracking(0.05, 10.0)), 39.95)
    close(pid.flow(0.0, memory, tracking(0.05)), (0.05, 55.0 * 0.03))
    close([pid.output(0.0, memory, tracking(error)) for error in (1.0, -1.0)], [90.0, 0.0])


@killed_by(
    "parts.controllers.pid",
    "return PIDMemory(integral, self._filter_rate(memory, signal))",
    "return PIDMemory(integral, 0.0 * integral)",
)
def test_pi_and_filtered_derivative_to_a_step():
    """u = kp e + ki e t + kd wc e exp(-wc t)."""
    pid = PID(kp=10.0, ki=40.0, kd=0.5, cutoff=30.0, low=0.0, high=90.0)
    t = H * np.arange(50)
    u = run(pid, lambda t: tracking(0.1 + 0.0 * t), 50)
    close(u, 1.0 + 4.0 * t + 0.5 * 30.0 * 0.1 * np.exp(-30.0 * t), rtol=1e-8)


@killed_by(
    "parts.controllers.antiwindup",
    "ratio(limited - raw, gain * self.tracking_time)",
    "ratio(raw - limited, gain * self.tracking_time)",
)
@pytest.mark.parametrize(
    ("strategy", "rates"),
    [
        # error, gain and excess raw - limited: outward, inward, not limited, outward below, gain zero
        (NoAntiWindup(), (0.1, -0.1, 0.1, -0.1, 0.1)),
        (Clamping(), (0.0, -0.1, 0.1, 0.0, 0.1)),
        (BackCalculation(tracking_time=0.5), (0.1 - 3.0, -0.1 - 3.0, 0.1, -0.1 + 3.0, 0.1)),
    ],
)
def test_antiwindup(strategy, rates):
    cases = ((0.1, 20.0, 120.0, 90.0), (-0.1, 20.0, 120.0, 90.0), (0.1, 20.0, 50.0, 50.0), (-0.1, 20.0, -30.0, 0.0),
             (0.1, 0.0, 120.0, 90.0))  # fmt: skip
    close([strategy.rate(*case) for case in cases], rates)


def test_antiwindup_of_state_feedback():
    """Its gain is negative and its error slip - target: the signs cancel, and the excess drains all the same."""
    k = StateFeedback(gain=np.array([-20.0, -100.0]), high=5.0, antiwindup=Clamping())
    assert k.flow(0.0, Memory(-1.0), tracking(0.1)) == 0  # raw = 20 + 10, the error asks for more
    close(k.flow(0.0, Memory(-1.0), tracking(-0.05)), 0.05)
    back = StateFeedback(gain=np.array([-20.0, -100.0]), high=5.0, antiwindup=BackCalculation(tracking_time=0.1))
    close(back.flow(0.0, Memory(-1.0), tracking(0.1)), -0.1 + (5.0 - 30.0) / (-20.0 * 0.1))


def test_state_feedback_by_hand():
    k = StateFeedback()
    close(k.output(0.0, Memory(2e-4), tracking(-0.05, 2.5)), 2.5 - 11753.0 * 2e-4 - 48.0 * 0.05)
    close(k.flow(0.0, Memory(2e-4), tracking(-0.05)), 0.05)


def test_scheduled_feedback_interpolates_its_gains():
    """At a node, between nodes, and beyond the last: against StateFeedback with the gain by hand."""
    k = ScheduledFeedback(
        speeds=np.array([2.0, 4.0]), integral_gains=np.array([-10.0, -30.0]), gains=np.array([-1.0, -5.0])
    )
    for speed, gain in ((2.0, (-10.0, -1.0)), (3.5, (-25.0, -4.0)), (9.0, (-30.0, -5.0))):
        signal = tracking(0.1, 2.5)
        signal = signal._replace(measured=signal.measured._replace(speed=speed))
        fixed = StateFeedback(gain=np.array(gain))
        close(k.output(0.0, Memory(0.3), signal), fixed.output(0.0, Memory(0.3), signal))
        close(k.flow(0.0, Memory(0.3), signal), fixed.flow(0.0, Memory(0.3), signal))


@killed_by("core.numerics", "jnp.where(x >= nodes[1:], 1.0,", "jnp.where(x >= nodes[1:], 0.0,")
def test_scheduled_feedback_interpolates_between_many_nodes():
    """Against NumPy: before the first node, at nodes, between, beyond the last; rounding only."""
    nodes, values = np.array([2.0, 3.0, 5.0, 9.0]), np.array([-1.0, -5.0, -2.0, -7.0])
    k = ScheduledFeedback(speeds=nodes, integral_gains=np.zeros(4), gains=values)
    for speed in (1.0, 2.0, 2.25, 3.0, 4.5, 5.0, 8.0, 9.0, 20.0):
        signal = tracking(0.1)
        signal = signal._replace(measured=signal.measured._replace(speed=speed))
        close(k.output(0.0, Memory(0.3), signal), -0.1 * np.interp(speed, nodes, values))


@killed_by("parts.controllers.gain_schedule", "(signal.measured.speed / self.reference_speed)", "1.0")
def test_proportional_is_state_feedback_scaled_by_speed():
    k = ProportionalFeedback(gain=np.array([-30.0, -5.0]), reference_speed=4.0, high=9.0)
    for speed, part in ((4.0, 1.0), (1.0, 0.25), (8.0, 2.0)):  # all beyond 9 N m with an integral of -3
        signal = tracking(0.1, 2.5)
        signal = signal._replace(measured=signal.measured._replace(speed=speed))
        close(k.output(0.0, Memory(-0.03), signal), 2.5 + part * (30.0 * 0.03 + 5.0 * 0.1))
        close(k.output(0.0, Memory(-3.0), signal), 9.0)
        close(k.flow(0.0, Memory(-0.03), signal), -0.1)


@killed_by("core.units", 'for name in ("control", "signal"):', 'for name in ("control",):')
@killed_by("core.rules", '"" if unit == "1" else', '"" if unit == "0" else')
@killed_by("core.validity", 'shapes.append(f"{field.name} {line}")', "pass")
@pytest.mark.parametrize(
    ("part", "message"),
    [
        (ScheduledFeedback(gains=np.array([-1.0])), "they need one"),
        (ScheduledFeedback(speeds=np.array([3.0, 2.0])), "do not increase"),
        (ScheduledFeedback(low=3.0, high=2.0), "exceeds high"),
        (FourPhase(slip_low=0.5), "^slip_low = 0.5 is not below slip_high = 0.35$"),
        (SettlingTime(share=0.0), "^share and band are both 0; a settling time needs a band of some width$"),
        (ExtremumSeeking(slip=0.6), "^slip = 0.6 exceeds slip_high = 0.5$"),
        (Limits(low=[1.0, 2.0], high=3.0), r"^low has shape \(2,\); it needs \(\)$"),
        (Series(blocks=(Relay(low=[5.0]),)), r"^blocks.0.low has shape \(1,\); it needs \(\)$"),
        (PID(kp=[1.0, 2.0]), r"^kp has shape \(2,\); it needs \(\)$"),
    ],
)
def test_a_part_is_refused_by_its_own_check(part, message):
    with pytest.raises(ValueError, match=message):
        check_part(part)


@killed_by("parts.controllers.switching", "return (self.band + jnp.where", "return (0.0 * self.band + jnp.where")
@killed_by(
    "engine.step.event_location",
    "length = place - margin / jnp.where(at_place < 0, at_place, -jnp.inf)",
    "length = place",
)
def test_relay_switches_on_the_far_side_of_its_band():
    """Slip 0.2 + 0.03 sin(w t), band 0.02: released where the sine is 2/3 and rises, applied where it is -2/3 and
    falls; 10 periods in 523 steps, which no period divides. It starts on its target, released."""
    relay, steps = Relay(band=0.02, low=1.0, high=9.0), 523
    w = 20 * np.pi / (steps * H)
    _, torque, _, mean = played(lambda t: seen(0.2 + 0.03 * jnp.sin(w * t)), steps, controller=relay)
    phase = (w * H * np.arange(steps)) % (2 * np.pi)
    up, down = np.arcsin(2 / 3), np.pi + np.arcsin(2 / 3)
    released = (phase > up) & (phase < down)
    released[w * H * np.arange(steps) < up] = True
    close(torque, np.where(released, 1.0, 9.0))
    on = 9 * (2 * np.pi - down + up) + (2 * np.pi - down)
    close(mean, 1.0 + 8.0 * on / (20 * np.pi), rtol=1e-9)


@pytest.mark.slow
@killed_by("engine.step.event_location", "enough & ~at_once & crossings.another", "enough & ~at_once & False")
def test_two_events_in_one_step():
    """The deceleration has its maximum 0.3 into step 5, at a slip of 0.15; the relay, whose target is that from then
    on, releases at 0.16; with the target before it, it would at 0.21, 0.8 into the step. The slip bends so that a
    search for the relay tries nothing but what is beyond both."""

    def rise(x):
        return 0.096 * x + 0.01 * jnp.tanh(4.0 * x) + 0.01888 * x**3

    def script(t):
        return seen(0.15 + rise((t - 5.3e-3) / H), deceleration=9.0 - 4e4 * (t - 5.3e-3) ** 2)

    relay = Relay(band=0.01, low=0.0, high=12.0)
    target, torque, target_mean, torque_mean = played(script, 12, reference=PeakLatch(), controller=relay)
    close(target, [0.2] * 6 + [0.15] * 6, rtol=1e-9)
    close(torque, [12.0] * 6 + [0.0] * 6)
    close(target_mean, 0.15 + 0.05 * 5.3 / 12, rtol=1e-9)
    close(torque_mean, 5.3 + brentq(lambda x: float(rise(x)) - 0.01, 0.0, 1.0), rtol=1e-9)


@pytest.mark.slow
@killed_by(
    "engine.step.fixed",
    "jnp.where(extra > max_extra, RunStatus.EXHAUSTED, status)",
    "jnp.where(extra > max_extra, RunStatus.TIMED_OUT, status)",
)
def test_what_switches_in_every_step_is_no_run():
    """A relay on the rig with hardly a band: it would switch some ten times in each step of 1 ms."""
    loop = d.Loop(
        plant=MirroredRig(),
        initial=BrakeStart(speed=50 / 3.6),
        reference=FixedSlip(),
        controller=Relay(band=1e-6, high=12.0),
        stop=SpeedReached(),
    )
    run = d.measure(loop, d.FixedStep(1e-3, 2.0), {"iae": IAE()})
    assert run.diverged
    assert np.isnan(run.metrics["iae"])


@pytest.mark.slow
@killed_by("parts.objectives.tracking", "cubic.start * cubic.end < 0", "cubic.start * cubic.end < -1e9")
@killed_by("core.cubic", "return jnp.where(inside & (top > ends), top, ends)", "return ends")
@pytest.mark.parametrize("h", [1e-3, 5e-4])
def test_the_integral_of_an_error_that_changes_sign(h):
    """Of 0.03 |sin(w t)| over five and a quarter periods that no step divides, and with the weight t; and its peak."""
    w, end = 100.0, 10.5 * np.pi / 100.0
    loop = d.Loop(
        plant=Script(read=lambda t: seen(0.2 - 0.03 * jnp.sin(w * t), deceleration=1.0, speed=1.0 + end - t)),
        initial=0.0,
        reference=FixedSlip(),
        controller=ConstantTorque(),
        stop=SpeedReached(speed=1.0),
    )
    found = d.measure(loop, d.FixedStep(h, 1.0), {"iae": IAE(), "itae": ITAE(), "peak": MaxSlip()}).metrics
    t = np.linspace(0.0, end, 2_100_001)
    close(found["peak"], 0.23, rtol=4e-8 * (h / 1e-3) ** 4)
    close(found["iae"], 0.03 * 21 / w, rtol=3e-6 * (h / 1e-3) ** 4)
    close(found["itae"], np.trapezoid(t * 0.03 * np.abs(np.sin(w * t)), t), rtol=3e-6 * (h / 1e-3) ** 4)


@pytest.mark.slow
@killed_by(
    "core.messages",
    "self.start.show(), self.end.show()",
    "self.start.show(), self.end.show()._replace(setpoint=self.start.setpoint)",
)
@killed_by(
    "core.messages",
    "self.h * rate, rates) for rates in self.shown_rates())",
    "self.h * rate, rates._replace(setpoint=0.0 * rates.setpoint)) for rates in self.shown_rates())",
)
@pytest.mark.parametrize(
    ("solver", "rtol"),
    [
        (d.FixedStep(1e-3, 1.0), 3e-6),
        (d.FixedStep(5e-4, 1.0), 2e-7),
        # No state moves as fast as this script, so its steps are long, a tenth of a period.
        (d.Adaptive(1e-8, 1.0), 1.5e-4),
    ],
)
def test_the_integral_of_an_error_whose_setpoint_moves(solver, rtol):
    """A filtered ramp of deceleration moves the setpoint within every step: a = 5 + 30 t, and from the first sample on
    a_f = 5 + 30 (t - T (1 - exp(-t/T)))."""
    w, end, lag, band = 100.0, 0.33, 0.05, 0.07
    loop = d.Loop(
        plant=Script(
            read=lambda t: seen(0.2 - 0.03 * jnp.sin(w * t), deceleration=5.0 + 30.0 * t, speed=1.0 + end - t)
        ),
        initial=0.0,
        reference=SlipByDeceleration(decelerations=(0.0, 20.0), slips=(0.1, 0.2), time_constant=lag),
        controller=ConstantTorque(),
        stop=SpeedReached(speed=1.0),
    )
    t = np.linspace(0.0, end, 2_000_001)
    setpoint = 0.1 + 0.005 * (5.0 + 30.0 * (t + lag * np.expm1(-t / lag)))
    e = np.abs(0.2 - 0.03 * np.sin(w * t) - setpoint)
    found = d.measure(loop, solver, {"iae": IAE(), "itae": ITAE(), "settling": SettlingTime(band=band)}).metrics
    close(found["iae"], np.trapezoid(e, t), rtol=rtol)
    close(found["itae"], np.trapezoid(t * e, t), rtol=rtol)
    close(found["settling"], t[np.flatnonzero(e > band)[-1]], rtol=rtol + 1e-6)  # to the points of t


def test_sliding_mode():
    mode = SlidingMode(gain=40.0, boundary=0.1, low=-100.0, high=90.0)
    close([mode.output(0.0, Memory(), tracking(e, 5.0)) for e in (0.05, -0.02, 0.3, -0.3)], [25.0, -3.0, 45.0, -35.0])


@killed_by("parts.controllers.sampled", "t + self.delay - jax", "t - jax")
@pytest.mark.parametrize("delay", cases([0.0, 1.5, 2.0, 4.0], 0.0, 2.0, 4.0))
def test_sampled_is_a_zero_order_hold(delay):
    """Against the textbook loop: u_k held from t_k + delay on, integral by forward Euler."""
    period, steps, fine = 4, 23, 2  # in steps; `fine` resolves the mean
    pid = PID(kp=30.0, ki=500.0, low=-200.0, high=200.0)

    def error(t):
        return 0.1 * jnp.cos(300.0 * t)

    integral, changes = 0.0, []
    for k in range(0, steps, period):
        e = 0.1 * np.cos(300.0 * k * H)
        changes.append((k + delay, 30.0 * e + 500.0 * integral))
        integral += period * H * e
    expected = []
    for k in range(steps):
        moments = k + (np.arange(fine) + 0.5) / fine
        expected.append(np.mean([([0.0] + [u for t, u in changes if t <= m])[-1] for m in moments]))
    sampled = Sampled(controller=pid, period=period * H, delay=delay * H)
    _, u, _, mean = played(lambda t: seen(0.2 - error(t)), steps, controller=sampled)
    between = np.array([k for k in range(steps) if all(abs(k - t) > 1e-9 for t, _ in changes) or not delay])
    close(u[between], [([0.0] + [u for t, u in changes if t <= k])[-1] for k in between])
    close(mean, np.mean(expected), rtol=1e-9)


# References


def test_filtered_slip():
    target = run(FilteredSlip(slip=0.2, time_constant=0.035), lambda t: seen(0.05), 60)
    close(target, 0.2 - 0.15 * np.exp(-H * np.arange(60) / 0.035), rtol=1e-8)  # RK4 leaves 35 (1/35)^5/120


def parabola(t, top=5.3e-3, a=9.0, bend=4e4):
    """A deceleration with its maximum `a` at `top`; the slip there is 0.15."""
    return seen(0.15 + 20.0 * (t - top) + 300.0 * (t - top) ** 2, deceleration=a - bend * (t - top) ** 2)


@pytest.mark.slow
@killed_by(
    "engine.step.event_location",
    "jnp.where(earlier, before, jnp.where(enough, probe, guess)), enough & ~earlier",
    "x, True",
)
@pytest.mark.parametrize("top", [5.3e-3, 5.7e-3, 6e-3])
def test_latch_finds_the_vertex(top):
    """Exactly, and at its moment; also on an instant of the grid."""
    target, _, mean, _ = played(partial(parabola, top=top), 12, reference=PeakLatch(), controller=ConstantTorque())
    before, after = H * np.arange(12) < top - 1e-9, H * np.arange(12) > top + 1e-9
    close(target[before], 0.2)
    close(target[after], 0.15, rtol=1e-9)
    close(mean, 0.15 + 0.05 * top / (12 * H), rtol=1e-9)


def two_maxima(t):
    """9 at 3.3 ms and 12 at 8.6 ms, with a minimum of 6 at 6 ms; cubics between. The slip is 0.1 + t."""
    places, values = jnp.array([0.0, 3.3, 6.0, 8.6, 12.0]) * 1e-3, jnp.array([1.0, 9.0, 6.0, 12.0, 4.0])
    i = jnp.clip(jnp.searchsorted(places, t, side="right") - 1, 0, 3)
    x = (t - places[i]) / (places[i + 1] - places[i])
    return seen(0.1 + t, deceleration=values[i] + (values[i + 1] - values[i]) * x * x * (3 - 2 * x))


@killed_by("parts.references.peak_slip", "zero + MIN_DECELERATION, slip", "zero, slip")
@pytest.mark.slow
def test_latch_waits_for_the_brake():
    """A wheel that rolls shows a deceleration of some 1e-5 m/s^2 in single precision, up and down; then the brake."""

    def script(t):
        braked = jnp.where(t > 4e-3, 9.0 - 4e4 * (t - 9.3e-3) ** 2, 0.0)
        return seen(0.1 + t, deceleration=1e-5 * jnp.sin(5e3 * t) + jnp.maximum(braked, 0.0))

    target, *_ = played(script, 12, reference=PeakLatch(), controller=ConstantTorque())
    close(target, [0.2] * 10 + [0.1093] * 2, rtol=1e-5)


@pytest.mark.slow
def test_latch_follows_later_maxima():
    """The second one is higher: the target moves there. Past the peak from the start, the best slip was the first."""
    parts = {"reference": PeakLatch(), "controller": ConstantTorque()}
    target, *_ = played(two_maxima, 12, **parts)
    close(target, [0.2] * 4 + [0.1033] * 5 + [0.1086] * 3, rtol=1e-9)
    falling, *_ = played(lambda t: seen(0.5 - 10 * t, deceleration=8 - 100 * t), 3, **parts)
    close(falling, [0.5] * 3)


@pytest.mark.slow
@pytest.mark.parametrize("reference", [PeakLatch(), PeakLiteral()])
def test_the_estimators_go_by_the_size_of_the_acceleration(reference):
    """|a| = |0.31 - 100 t|, which falls at once and exceeds 0.31 again at 6.2 ms: the latch takes the first slip and
    no later one as long as |a| rises; the estimator as printed follows the slip from there."""
    script = partial(lambda t: seen(0.1 + t, deceleration=0.31 - 100.0 * t))
    target, *_ = played(script, 9, reference=reference, controller=ConstantTorque())
    latch = isinstance(reference, PeakLatch)
    close(target, [0.1] * 9 if latch else [0.2] * 7 + [0.107, 0.108], rtol=1e-9)


@pytest.mark.slow
def test_latch_does_not_move_for_rounding():
    """A controller that holds the best slip keeps the deceleration at its maximum, to rounding: 3, and 3 (1 + 1e-7)."""

    def ripple(t):
        size = jnp.where(t < 4.4e-3, 1.0, 1.0 + 1e-7)
        return seen(0.1 + t, deceleration=3.0 * size * jnp.sin(jnp.pi * t / 4.4e-3) ** 2)

    target, *_ = played(ripple, 8, reference=PeakLatch(), controller=ConstantTorque())
    close(target, [0.2] * 3 + [0.1022] * 5, rtol=1e-9)


@killed_by("loop.closed_loop", "((a >= 0) & ((b < 0) | (c < 0)))", "((a >= 0) & (c < 0))")
@pytest.mark.slow
def test_a_noisy_sampled_accelerometer_latches_on_a_drop():
    """a = 3 + 50 t + noise that is held for 2 steps: a jump down from more than ever is a maximum, wherever it goes to,
    and the slip is the slip then."""
    key, noise, steps = jax.random.key(5), Noise(deceleration=0.5, period=2 * H), 80
    drawn = np.asarray(run(noise, lambda t: seen(0.1 + t, deceleration=0.0 * t), steps, key=key).deceleration)
    expected, greatest, below = [0.2], 0.0, 0
    for k in range(1, steps):
        before, after = 3.0 + 50.0 * k * H + drawn[k - 1 : k + 1]
        jumps = after < before and before > greatest
        below += bool(jumps and expected[-1] != 0.2 and after < greatest)
        expected.append(0.1 + k * H if jumps else expected[-1])
        greatest = before if jumps else greatest
    assert below > 2
    script = partial(lambda t: seen(0.1 + t, deceleration=3.0 + 50.0 * t))
    target, *_ = played(script, steps, key=key, sensor=noise, reference=PeakLatch(), controller=ConstantTorque())
    close(target, expected, rtol=1e-9)


def test_literal_follows_the_slip_while_friction_rises():
    """So that the error is zero: what keeps it from braking."""
    target = run(PeakLiteral(slip=0.2), parabola, 12)
    slip = np.asarray(jax.vmap(parabola)(H * jnp.arange(12)).slip)
    close(target, [0.2, *slip[1:6], *[slip[5]] * 6])


@pytest.mark.slow
@killed_by("parts.references.peak_slip", "(m.latched < 0.5) & (m.greatest > self.arming)", "(m.latched < 0.5)")
@pytest.mark.parametrize(("threshold", "arming", "latches"), [(0.05, 3.0, True), (0.05, 9.1, False), (0.5, 3.0, False)])
def test_robust_latch(threshold, arming, latches):
    """A low-pass turns A - B t^2 into A - B T^2 - B (t - T)^2, slip likewise. With top 9.3 ms, T = 0.2 ms, the level
    0.95 (9 - 0.0016) is met at 9.5 + sqrt(0.44992/4e4) 1e3 = 12.8538 ms. Not armed, or falling less: nothing."""
    reference = PeakRobust(time_constant=2e-4, threshold=threshold, arming=arming)
    script = partial(parabola, top=9.3e-3)
    target, _, mean, _ = played(script, 800, h=2e-5, reference=reference, controller=ConstantTorque())
    late = 12.8538e-3 if latches else 16e-3
    slip = 0.15 + 300.0 * 4e-8
    close(target, np.where(2e-5 * np.arange(800) < late, 0.2, slip), rtol=0, atol=1e-7)
    close(mean, slip + (0.2 - slip) * late / 16e-3, rtol=0, atol=2e-6)


# Actuators


def test_limits_and_lag():
    limits = Limits(low=-1.0, high=5.0)
    close([limits.output(0.0, Memory(), u) for u in (-3.0, 2.0, 7.0)], [-1.0, 2.0, 5.0])
    u = run(Lag(time_constant=0.01), lambda t: 50.0 + 0.0 * t, 40)
    close(u, 50.0 * (1 - np.exp(-0.1 * np.arange(40))), rtol=1e-6)


def test_rate_limit():
    """A ramp until (command - u)/T meets the rate, an exponential from there."""
    u = run(RateLimit(rate=1000.0, time_constant=0.004), lambda t: 10.0 + 0.0 * t, 2000, h=1e-5)
    t = 1e-5 * np.arange(2000)
    close(u, np.where(t < 0.006, 1000.0 * t, 10.0 - 4.0 * np.exp(-(t - 0.006) / 0.004)), rtol=1e-6, atol=1e-6)


def test_two_lags_in_series():
    """1 - (T1 exp(-t/T1) - T2 exp(-t/T2))/(T1 - T2)."""
    t1, t2, t = 0.02, 0.005, H * np.arange(60)
    series = Series(blocks=(Lag(time_constant=t1), Lag(time_constant=t2)))
    u = run(series, lambda t: 1.0 + 0.0 * t, 60)
    close(u, 1 - (t1 * np.exp(-t / t1) - t2 * np.exp(-t / t2)) / (t1 - t2), rtol=0, atol=2e-6)


# Sensors


@killed_by("core.messages", "self.on_grid & (self.k % n == 0)", "self.on_grid & (self.k % n == 1)")
def test_noise():
    """10^4 draws: their mean within 4/sqrt(10^4) and their deviation within 4/sqrt(2 10^4) of the deviation."""
    noise = Noise(slip=0.1, speed=2.0, wheel_speed=0.5, deceleration=3.0, period=2 * H)
    key = jax.random.key(11)
    y = run(noise, lambda t: seen(0.5 + 0.0 * t), 20000, key=key)
    for values, mean, deviation in zip(y[:4], (0.5, 20.0, 10.0, 0.0), (0.1, 2.0, 0.5, 3.0), strict=True):
        draws = np.asarray(values).reshape(-1, 2)
        close(draws[:, 0], draws[:, 1], rtol=0, atol=0)  # held over the period
        close((np.mean(draws) - mean) / deviation, 0.0, rtol=0, atol=0.04)
        close(np.std(draws[:, 0]) / deviation, 1.0, rtol=0, atol=4 / np.sqrt(2e4))
    close(np.corrcoef(np.asarray(y[:4])[:, ::2]), np.eye(4), rtol=0, atol=0.04)
    close(run(noise, lambda t: seen(0.5 + 0.0 * t), 100, key=key).slip, y.slip[:100], rtol=0, atol=0)
    other = run(noise, lambda t: seen(0.5 + 0.0 * t), 100, key=jax.random.key(12))
    assert np.all(other.slip != y.slip[:100])
    with pytest.raises(ValueError, match="needs a random key"):
        run(noise, lambda t: seen(0.5 + 0.0 * t), 2)


def test_bias_and_quantisation():
    y = BrakeOutput(0.234, 20.3, 15.9, 8.76, 5.0)
    bias = Bias(slip=0.01, speed=-1.0, wheel_speed=0.5, deceleration=0.2)
    close(bias.output(0.0, Memory(), y), (0.244, 19.3, 16.4, 8.96, 5.0))
    quantised = Quantisation(slip=0.05, speed=0.5, deceleration=0.1).output(0.0, Memory(), y)
    close(quantised, (0.25, 20.5, 15.9, 8.8, 5.0))


def test_wheel_speed_lags_a_ramp():
    """After a step of rate a, w - true = -a T (1 - exp(-t/T)); the slip is computed with it and the floor."""
    sensor, t = WheelSpeed(time_constant=0.004, floor=30.0), H * np.arange(20)
    y = run(sensor, lambda t: seen(0.0, 20.0, wheel_speed=18.0 - 100.0 * t), 20)
    close(y.wheel_speed, 18.0 - 100.0 * t + 0.4 * (1 - np.exp(-t / 0.004)), rtol=1e-6)
    close(y.slip, (20.0 - y.wheel_speed) / 30.0)


@killed_by("parts.sensors.speed", "return self.bias - signal.deceleration", "return -signal.deceleration")
def test_integrated_accelerometer():
    """v = v0 - a t + bias t; slip (v - w)/v."""
    t = H * np.arange(30)
    sensor = IntegratedAccelerometer(bias=0.5)
    y = run(sensor, lambda t: seen(0.0, 20.0 - 8.0 * t, deceleration=8.0, wheel_speed=15.0), 30)
    close(y.speed, 20.0 - 7.5 * t)
    close(y.slip, 1 - 15.0 / (20.0 - 7.5 * t))
    close(y.deceleration, 7.5)


@killed_by("parts.sensors.speed", "slip=(v - signal.wheel_speed) / jnp.maximum(v, self.floor), speed=v)", "speed=v)")
def test_a_speed_seen_low_hides_slip():
    """At 20 m/s with the rim at 16: seen as 19, slip 3/19 instead of 0.2; a wheel that rolls seems to be driven. The
    floor stands in for the speed below it, the accelerometer and the distance are as they are."""
    y = BrakeOutput(0.2, 20.0, 16.0, 8.76, 5.0)
    close(SpeedScale(factor=0.95).output(0.0, Memory(), y), (3 / 19, 19.0, 16.0, 8.76, 5.0))
    rolling = BrakeOutput(0.0, 20.0, 20.0, 0.0, 5.0)
    close(SpeedScale(factor=0.95).output(0.0, Memory(), rolling).slip, -1 / 19)
    close(SpeedScale(factor=0.95, floor=38.0).output(0.0, Memory(), y).slip, 3 / 38)
    close(SpeedScale().output(0.0, Memory(), y), y)


# Stops


def test_remainders():
    """v/a and v^2/(2 a) from the stop speed, or from wherever a run was cut off, down to the end."""
    y = seen(speed=3.0, deceleration=2.0)
    for stopped in (True, False):
        close(Standstill(speed=0.05).remainder(sample(y), stopped), (1.5, 2.25))
    close(SpeedReached(speed=1.0).remainder(sample(y), False), (1.0, 2.0))
    close(SpeedReached(speed=1.0).remainder(sample(y), True), (0.0, 0.0))
    accelerating = seen(speed=3.0, deceleration=-1.0)
    close(Standstill().remainder(sample(accelerating), False), (3000.0, 4500.0))  # at least 1e-3 m/s^2
    # from 7 m/s in 1 s over 5 m: 4 m/s^2 in the mean, of which half counts where the last instant chatters
    close(Standstill().remainder(sample(accelerating._replace(distance=5.0)), True), (1.5, 2.25))
    for stop in (Standstill(speed=1.0), SpeedReached(speed=1.0)):
        close(stop.margin(y), 2.0)
