"""What a two-wheeler's controllers can do: bounds, filters, output feedback."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from balancing import EFFORT, HANGING, MULTIPLES, START, WEIGHTS, closed, model
from mutants import killed_by
from scipy.integrate import solve_ivp

from diffabs.core.protocols import BalanceOutput, Clock, Memory, Tracking
from diffabs.core.pytree import replace
from diffabs.core.validity import check_part, find_problems
from diffabs.engine.solvers import FixedStep
from diffabs.linear.gaussian import SELECTION, kalman, lqg
from diffabs.linear.recoverable import mode_bounds, recoverable_bound
from diffabs.loop.run import measure
from diffabs.parts.controllers import BalanceFeedback, ObserverFeedback, Sampled
from diffabs.parts.controllers.balance import ObserverMemory
from diffabs.parts.objectives import FinalNorm
from diffabs.parts.plants import ArmBalance
from diffabs.parts.sensors import AngleSensor

SOLVER, MEASURED = FixedStep(step=1e-3, duration=10.0), {"final_norm": FinalNorm()}

# What any control can do


def by_eigenvectors(a, b, start, limit):
    """|w'B| U/(s |w'd|) of the one unstable pole."""
    poles, left = scipy.linalg.eig(a, left=True, right=False)  # pyright: ignore[reportAssignmentType]
    (place,) = np.flatnonzero(poles.real > 0)
    w = left[:, place].real
    return abs(w @ b[:, 0]) * limit / (poles[place].real * abs(w @ start))


@pytest.mark.slow
@killed_by("linear.recoverable", "return 2 * limit / jnp.sqrt", "return limit / jnp.sqrt")
def test_the_bound_is_that_of_the_unstable_mode():
    a, b = (np.asarray(x) for x in model(HANGING))
    expected = by_eigenvectors(a, b, START, 48.0)
    assert expected == pytest.approx(0.0933332, abs=5e-8)
    assert float(recoverable_bound(a, b, START, 48.0)) == pytest.approx(expected, rel=1e-9)
    ((pole, bound),) = mode_bounds(a, b, START, 48.0).items()
    assert (pole, bound) == (pytest.approx(2.84055, abs=5e-6), pytest.approx(expected, rel=1e-12))


@pytest.mark.slow
def test_the_slope_of_the_bound_is_a_difference():
    """In the length of the arm, of the closed form at 1e-5 m: second order, and 1e-9 of rounding over 1e-5."""

    @jax.value_and_grad
    def bound(length):
        return recoverable_bound(*model(replace(HANGING, {"arm_length": length})), START, 48.0)

    value, slope = bound(-0.5)
    ends = [
        by_eigenvectors(*(np.asarray(x) for x in model(ArmBalance(arm_length=z))), START, 48.0)
        for z in (-0.50001, -0.49999)
    ]
    assert float(value) == pytest.approx(np.mean(ends), rel=1e-8)
    assert float(slope) == pytest.approx((ends[1] - ends[0]) / 2e-5, rel=1e-6)


def test_two_unstable_poles_are_two_bounds():
    """The upright arm has two; 0.0087 of the start is all that 48 V can do."""
    a, b = (np.asarray(x) for x in model(ArmBalance()))
    found = mode_bounds(a, b, START, 48.0)
    assert sorted(found) == pytest.approx([0.29783666, 2.78790563], abs=1e-8)
    for pole, bound in found.items():
        w = scipy.linalg.null_space(a.T - pole * np.eye(6), rcond=1e-9)[:, 0]
        assert bound == pytest.approx(abs(w @ b[:, 0]) * 48.0 / (pole * abs(w @ START)), rel=1e-6)
    assert min(found.values()) == pytest.approx(0.0087, abs=5e-5)
    assert mode_bounds(a, b, np.zeros(6), 48.0) == dict.fromkeys(found, np.inf)


@killed_by("linear.recoverable", "np.linalg.norm(offset - along * moved) > ROUNDING", "0.0 > ROUNDING")
def test_equal_poles_have_the_least_bound():
    """No control reaches the first state; in the second order it is the last one."""
    for b in ([[0.0], [1.0]], [[1.0], [0.0]]):
        assert mode_bounds(np.eye(2), b, np.ones(2), 1.0) == {1.0: 0.0}


@pytest.mark.parametrize(("share", "returns"), [(0.999, True), (1.001, False)])
def test_full_effort_returns_from_within_the_bound_only(share, returns):
    """x' = s x + b u with u = -U sign(b x), the most that can be done, until x changes its sign or has doubled."""
    s, b, limit = 1.7, -0.4, 3.0
    start = share * float(recoverable_bound(np.array([[s]]), np.array([[b]]), np.ones(1), limit))

    def back(t, x):
        return x[0]

    def away(t, x):
        return x[0] - 2 * start

    back.terminal = away.terminal = True
    run = solve_ivp(lambda t, x: s * x - abs(b) * limit, (0, 100), [start], events=(back, away), rtol=1e-10, atol=1e-12)
    assert [len(times) for times in run.t_events] == [int(returns), int(not returns)]


# Two angles measured, four quantities estimated


@pytest.fixture(scope="module")
def observer():
    return lqg(HANGING, WEIGHTS, EFFORT, predicted_high=48.0)


@pytest.mark.slow
@killed_by("linear.gaussian", "dare(A.T, C.T, W, V)", "dare(A.T, C.T, 0.5 * W, V)")
def test_kalman_is_scipys():
    random = np.random.default_rng(6)
    a, c, root = random.normal(size=(6, 6)), random.normal(size=(2, 6)), random.normal(size=(6, 6))
    w, v = root @ root.T, np.diag([0.3, 2.0])
    found = kalman(a, c, w, v)
    expected = scipy.linalg.solve_discrete_are(a.T, c.T, w, v)
    assert bool(found.stabilising)
    np.testing.assert_allclose(found.P, expected, rtol=0, atol=1e-9 * np.max(expected))
    gain = expected @ c.T @ np.linalg.inv(c @ expected @ c.T + v)
    np.testing.assert_allclose(found.gain, gain, rtol=0, atol=1e-8 * np.max(np.abs(gain)))
    again = a @ (expected - gain @ c @ expected) @ a.T + w  # the filter's covariance, predicted from corrected
    np.testing.assert_allclose(found.P, again, rtol=0, atol=1e-9 * np.max(expected))


def seen(x):
    """What a controller is given in the state x (6,)."""
    return Tracking(jnp.asarray(0.0), BalanceOutput(*x, 1.0, 0.0, 1.0, jnp.inf), 0.0)


def corrected(observer, last, x, k=1):
    """The estimate after a sample of the state x."""
    return observer.tick(Clock(0.01 * k, 0.01, k, None), Memory(held=last), seen(x)).held


@pytest.mark.slow
@killed_by(
    "linear.gaussian", "jnp.linalg.solve(spread, C @ riccati.P).T", "jnp.linalg.solve(spread, C @ riccati.P @ A.T).T"
)
def test_regulator_and_filter_are_those_of_the_weights():
    """SciPy's, of unknown accelerations that are constant over a period of 20 ms; other weights than the defaults."""
    a, b = (np.asarray(x) for x in model(HANGING))
    whole = scipy.linalg.expm(0.02 * np.block([[a, b], [np.zeros((1, 7))]]))[:6]
    a, b = whole[:, :6], whole[:, 6:]
    found = lqg(HANGING, WEIGHTS, EFFORT, period=0.02, disturbance=(0.5, 2.0, 3.0), noise=(2e-3, 4e-3)).controller
    p = scipy.linalg.solve_discrete_are(a, b, 0.02 * WEIGHTS, 0.02 * EFFORT * np.eye(1))
    gain = -np.linalg.solve(0.02 * EFFORT + b.T @ p @ b, b.T @ p @ a)[0]
    kicks = np.vstack([0.5 * 0.02**2 * np.eye(3), 0.02 * np.eye(3)]) @ np.diag([0.5, 2.0, 3.0])
    c, v = np.eye(6)[:2], np.diag([2e-3, 4e-3]) ** 2
    p = scipy.linalg.solve_discrete_are(a.T, c.T, kicks @ kicks.T, v)
    correction = p @ c.T @ np.linalg.inv(c @ p @ c.T + v)
    np.testing.assert_allclose(found.gain, gain, rtol=1e-6, atol=0)
    np.testing.assert_allclose(found.correction, correction, rtol=0, atol=1e-7 * np.max(np.abs(correction)))
    np.testing.assert_allclose(found.transition, a, rtol=0, atol=1e-13)
    np.testing.assert_allclose(found.entry, b[:, 0], rtol=0, atol=1e-14)


@pytest.mark.slow
def test_poles_of_the_loop_are_those_of_regulator_and_filter(observer):
    """The loop's map is differentiated from the controller's own code; e^(AT), G(T)B are SciPy's."""
    a, b = (np.asarray(x) for x in model(HANGING))
    whole = scipy.linalg.expm(0.01 * np.block([[a, b], [np.zeros((1, 7))]]))[:6]
    a, b, inner = whole[:, :6], whole[:, 6], observer.controller

    def period(z):
        x, last = z[:6], ObserverMemory(z[6:], inner.gain @ z[6:])
        now = corrected(inner, last, x)
        return jnp.concatenate([a @ x + b * now.voltage, now.state])

    poles = np.linalg.eigvals(jax.jacfwd(period)(jnp.zeros(12)))
    regulated = np.linalg.eigvals(a + np.outer(b, inner.gain))
    filtered = np.linalg.eigvals(a - a @ inner.correction @ SELECTION)
    assert max(abs(regulated)) < 1
    assert max(abs(filtered)) < 1
    np.testing.assert_allclose(np.sort(abs(poles)), np.sort(abs(np.r_[regulated, filtered])), rtol=0, atol=1e-7)
    np.testing.assert_allclose(np.sum(poles), np.sum(np.r_[regulated, filtered]), rtol=1e-12, atol=0)


@pytest.mark.slow
@killed_by(
    "parts.controllers.balance",
    "voltage = clamp(estimate.voltage, -self.predicted_high, self.predicted_high)",
    "voltage = estimate.voltage",
)
def test_an_observer_knows_the_limit_of_its_voltage(observer):
    """From the last estimate under 48 V, however much was asked for."""
    inner, last = observer.controller, np.linspace(-0.1, 0.2, 6)
    predicted = inner.transition @ last + inner.entry * 48.0
    found = corrected(inner, ObserverMemory(jnp.asarray(last), jnp.asarray(5e3)), predicted)
    np.testing.assert_allclose(found.state, predicted, rtol=1e-12, atol=1e-15)
    assert float(found.voltage) == pytest.approx(float(inner.gain @ predicted), rel=1e-12)


@pytest.mark.slow
@killed_by(
    "parts.controllers.balance",
    "jnp.where(number > 0, predicted + self.correction @ error, self.start(signal).held.state)",
    "predicted + self.correction @ error",
)
def test_an_observer_starts_at_what_is_measured(observer):
    """Without a prediction at its first sample, whatever voltage it would have asked for."""
    x = jnp.linspace(0.1, 0.6, 6)
    inner = observer.controller
    start = inner.start(seen(x)).held
    np.testing.assert_array_equal(start.state, [0.1, 0.2, 0.0, 0.0, 0.0, 0.0])
    noisy = x + 0.01 * jnp.arange(1.0, 7.0)  # `start` is given the true angles; the first sample has noise
    first = corrected(inner, start._replace(voltage=jnp.asarray(40.0)), noisy, k=0)
    np.testing.assert_allclose(first.state, [0.11, 0.22, 0.0, 0.0, 0.0, 0.0], rtol=1e-14)


@pytest.mark.slow
def test_without_noise_the_observer_recovers(observer):
    """As feedback of the whole state does from there: `simulate arm-hanging`."""
    loop = closed(0.06, controller=observer, sensor=AngleSensor(theta=0.0, psi=0.0))
    run = measure(loop, SOLVER, dict(MEASURED), key=jax.random.key(0))
    assert not run.stopped
    assert float(run.metrics["final_norm"]) < 1e-6


@pytest.mark.slow
def test_the_observer_recovers_most_starts_with_noise(observer):
    """0.8 of the multiple under 1e-3 rad at both angles. Nothing that was lost is upright after 10 s: the unstable mode
    has grown by e^28. Noise holds the frame within 0.01 rad."""
    loop = closed(0.8 * MULTIPLES[48.0], controller=observer, sensor=AngleSensor(theta=1e-3, psi=1e-3))
    for seed in range(8):
        run = measure(loop, SOLVER, dict(MEASURED), key=jax.random.key(seed))
        assert not run.stopped, seed
        assert abs(float(run.ending.sample.output.theta)) < 0.01
        assert float(run.metrics["final_norm"]) > 1e-3  # the noise was there


def test_shapes_of_an_observer_are_said():
    with pytest.raises(ValueError, match=r"^gain has shape \(2,\); it needs \(6,\)$"):
        check_part(BalanceFeedback(gain=np.ones(2)))
    with pytest.raises(ValueError, match=r"controller\.correction has shape \(6, 6\); it needs \(6, 2\)"):
        check_part(Sampled(controller=ObserverFeedback(correction=np.eye(6)), period=0.01))
    for name, wrong in (("transition", np.eye(2)), ("entry", np.zeros((6, 1))), ("gain", np.zeros(5))):
        (line,) = find_problems(dataclasses.replace(ObserverFeedback(), **{name: wrong}))
        assert line.startswith(f"{name} has shape {wrong.shape}; it needs ")
