"""Derivatives through a robust design and through a decay rate against differences of `design` and `certify`."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from mutants import killed_by
from seams import replace_seam

from diffabs.linear.riccati import care
from diffabs.robust.design import Polytope, Spec, certify, design
from diffabs.robust.design.interior.decay_rate import certified_decay
from diffabs.robust.design.interior.differentiable import robust_design, robust_gain
from diffabs.robust.design.sdp import solver
from diffabs.robust.design.sdp.program import DesignProgram
from diffabs.robust.design.sdp.scaling import design_frames

BETA, ALPHAS = 133.472842636189, (83.8796606703, 84.6321445666)  # as in test_design
FAST, SLOW = 140.291806958, 14.0291806958
PUBLISHED = {"paper": (11753.0**2, 1.0, 1.0), "middle": (1e6, 1e4, 1.0), "ones": (1.0, 1.0, 1.0)}
PERIOD = 1e-3
STENCIL = np.array([1, -8, 8, -1]) / 12  # at -2, -1, 1, 2 steps: fourth order


def rig(speeds=(FAST, SLOW), alphas=ALPHAS):
    pairs = [(alpha, speed) for alpha in alphas for speed in speeds]
    a = [[[0, 1], [0, alpha / speed]] for alpha, speed in pairs]
    return Polytope(A=a, B=[[[0], [BETA / speed]] for _, speed in pairs])


def sampled(system, period=PERIOD):
    a, b = system.A[:, 1, 1], system.B[:, 1, 0]
    factor, zero, one = np.exp(a * period), np.zeros_like(a), np.ones_like(a)
    matrices = np.stack([np.stack([one, period * one], -1), np.stack([zero, factor], -1)], -2)
    return Polytope(A=matrices, B=np.stack([zero, (factor - 1) / a * b], -1)[..., None], period=period)


RIG, ONE = rig(), rig((FAST,), ALPHAS[:1])


@partial(jax.jit, static_argnames="discrete")
def by_logarithms(A, B, weights, discrete=False):
    """Cost and gain for weights (q1, q2, r), and their derivatives by the weights' logarithms."""

    def solved(logs):
        q1, q2, r = jnp.exp(logs)
        found = robust_design(A, B, jnp.diag(jnp.stack([q1, q2])), r[None, None], discrete=discrete)
        return jnp.trace(found.P), found.gain[0]

    return solved(jnp.log(weights)), jax.jacfwd(solved)(jnp.log(weights))


def differences(system, weights, step):
    """The same derivatives from designs whose weights differ; no less independent than they can be."""
    cost, gain = np.zeros(3), np.zeros((2, 3))
    for j in range(3):
        for place, factor in zip((-2, -1, 1, 2), STENCIL / step, strict=True):
            q1, q2, r = np.array(weights) * np.exp(place * step * (np.arange(3) == j))
            found = design(system, Spec(Q=(q1, q2), R=r))
            cost[j] += factor * found.trace_cost
            gain[:, j] += factor * found.gain[0]
    return cost, gain


def agrees(system, weights, tolerance):
    """To 2e-5 for the cost, whose differences miss the sum of 1 by up to 6e-6: the cost is homogeneous in the weights.
    The gain is flat at the optimum: its difference has an error of up to 1e-4 itself."""
    discrete = system.period is not None
    (cost, gain), (by_cost, by_gain) = by_logarithms(system.A, system.B, jnp.array(weights), discrete=discrete)
    expected = design(system, Spec(Q=weights[:2], R=weights[2]))
    np.testing.assert_allclose(cost, expected.trace_cost, rtol=1e-6)
    np.testing.assert_allclose(gain, expected.gain[0], rtol=1e-3)
    np.testing.assert_allclose(by_cost.sum() / cost, 1.0, atol=2e-6)
    np.testing.assert_allclose(by_cost / cost, differences(system, weights, 0.1)[0] / cost, rtol=0, atol=2e-5)
    gains = differences(system, weights, 0.2)[1]
    np.testing.assert_allclose(by_gain / gain[:, None], gains / np.array(gain)[:, None], rtol=0, atol=tolerance)


@killed_by(
    "robust.design.interior.differentiable",
    "step = -central_path.solve_newton_system(hessian, by_problem)",
    "step = central_path.solve_newton_system(hessian, by_problem)",
    case="ones",
)
@killed_by(
    "robust.design.interior.central_path",
    '2 * jnp.einsum("ij,abji->ba", total, curved)',
    '0 * jnp.einsum("ij,abji->ba", total, curved)',
    case="ones",
)
@killed_by("robust.design.interior.differentiable", "FINAL_MU = 1e-8", "FINAL_MU = 1e-3", case="ones")
@pytest.mark.parametrize(
    "weights",
    [pytest.param(w, id=name, marks=pytest.mark.slow if name != "middle" else ()) for name, w in PUBLISHED.items()],
)
@pytest.mark.slow
def test_derivatives_of_a_design_are_differences(weights):
    agrees(RIG, weights, 1e-4)


@pytest.mark.slow
def test_derivatives_at_random_weights():
    random = np.random.default_rng(11)
    for weights in 10.0 ** random.uniform(-4, 4, (8, 3)):
        agrees(RIG, weights, 5e-4)


@pytest.mark.slow
def test_derivatives_in_discrete_time():
    """The logarithmic slopes of a gain add up to 0, because weights count by their ratios: ours do to 1e-6, those of
    the solver's differences miss it by 2e-3, and cannot be asked for more."""
    system, weights = sampled(RIG), (1e3, 10.0, 1e-3)
    agrees(system, weights, 2.5e-3)
    (_, gain), (_, by_gain) = by_logarithms(system.A, system.B, jnp.array(weights), discrete=True)
    np.testing.assert_allclose(by_gain.sum(1) / gain, 0.0, atol=3e-6)


@pytest.mark.slow
def test_no_weights_without_a_derivative():
    weights = 10.0 ** np.random.default_rng(12).uniform(-5, 5, (200, 3))
    (cost, gain), (by_cost, by_gain) = jax.vmap(lambda w: by_logarithms(RIG.A, RIG.B, w))(jnp.array(weights))
    np.testing.assert_allclose(by_cost.sum(1), cost, rtol=1e-5)  # the cost is homogeneous in (Q, R)
    np.testing.assert_allclose(by_gain.sum(2) / gain, 0.0, atol=1e-2)  # and the gain does not change
    assert (np.asarray(by_cost) > 0).all()


@pytest.mark.slow
def test_cost_obeys_the_envelope_theorem():
    """d trace Z/dQ = sum over the vertices of X W X, with W the multipliers of eq. (30) where Q is, at the solver's
    optimum: the derivative needs no derivative of X or F."""
    for q1, q2, r in PUBLISHED.values():
        spec = Spec(Q=(q1, q2), R=r).check(2, 1)
        frame = next(design_frames(RIG, spec.Q, spec.R))[0]
        program = DesignProgram(RIG, RIG, spec, frame)
        blocks = program.blocks(1.0)
        answer = solver.solve_sdp(program.objective(), blocks)
        v = program.unknowns.values(answer.y)
        sizes = [float(max(np.abs(b.G).max(), np.abs(b.h).max())) for b in program.common[:4]]
        group = next(w for w, b in zip(answer.multipliers, blocks, strict=True) if b.h.shape[-1] == 5)
        total = sum(w[:2, :2] / size for w, size in zip(group, sizes, strict=True)) * program.scale
        x = frame.T @ v["X0"] @ program.even @ total @ program.even.T @ v["X0"] @ frame.T.T / frame.tau
        (_, _), (by_cost, _) = by_logarithms(RIG.A, RIG.B, jnp.array((q1, q2, r)))
        np.testing.assert_allclose(by_cost[:2], np.diag(x) * (q1, q2), rtol=1e-4)


@killed_by("robust.design.interior.central_path", "1e-3 * jnp.abs(first) + rounding", "1e-3 * jnp.abs(first) + 1e-30")
@pytest.mark.slow
def test_one_vertex_is_the_riccati_equation():
    q1, q2, r, a = 1e6, 1e4, 2.0, ALPHAS[0] / BETA
    (_, gain), (_, by_gain) = by_logarithms(ONE.A, ONE.B, jnp.array((q1, q2, r)))

    def closed_form(logs):
        q1, q2, r = jnp.exp(logs)
        k1 = jnp.sqrt(q1 / r)
        return -jnp.stack([k1, a + jnp.sqrt(a**2 + q2 / r + 2 * k1 * FAST / BETA)])

    logs = jnp.log(jnp.array((q1, q2, r)))
    np.testing.assert_allclose(gain, closed_form(logs), rtol=1e-6)
    np.testing.assert_allclose(by_gain, jax.jacfwd(closed_form)(logs), atol=1e-5 * np.abs(gain).max())

    weights = 10.0 ** np.random.default_rng(0).uniform(
        -4, 4, (40, 3)
    )  # the path begins where it ends, but for rounding
    (_, gains), _ = jax.vmap(lambda w: by_logarithms(ONE.A, ONE.B, w))(jnp.array(weights))
    np.testing.assert_allclose(gains, jax.vmap(closed_form)(jnp.log(weights)), rtol=1e-3)

    def cost(solve, a, b):
        return jnp.trace(solve(a, b))

    q, r = jnp.diag(jnp.array([q1, q2])), jnp.full((1, 1), r)
    ours = jax.grad(partial(cost, lambda a, b: robust_design(a[None], b[None], q, r).P), (0, 1))(ONE.A[0], ONE.B[0])
    theirs = jax.grad(partial(cost, lambda a, b: care(a, b, q, r).P), (0, 1))(ONE.A[0], ONE.B[0])
    for one, other in zip(ours, theirs, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-5, atol=1e-5 * np.abs(other).max())


@pytest.mark.slow
def test_both_modes_batches_and_full_matrices():
    q, r = jnp.array([[1e6, 2e4], [2e4, 1e4]]), jnp.eye(1)
    forward = jax.jit(jax.jacfwd(partial(robust_gain, RIG), (0, 1)))(q, r)
    reverse = jax.jit(jax.jacrev(partial(robust_gain, RIG), (0, 1)))(q, r)
    for one, other, unit in zip(forward, reverse, (1e-3, 1e3), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-5, atol=1e-3 * unit)
    h = 1e-2
    moved = [design(RIG, Spec(Q=q + s * 2e4 * h * np.array([[0, 1], [1, 0]]), R=1.0)).trace_cost for s in (-1, 1)]
    slope = jax.grad(lambda x: jnp.trace(robust_design(RIG.A, RIG.B, q.at[0, 1].set(x).at[1, 0].set(x), r).P))(2e4)
    np.testing.assert_allclose(slope, (moved[1] - moved[0]) / (2 * 2e4 * h), rtol=1e-4)
    many = jax.vmap(lambda s: robust_gain(RIG, s * q, r))(jnp.array([1.0, 3.0, 1e-4]))
    for gain, s in zip(many, (1.0, 3.0, 1e-4), strict=True):
        np.testing.assert_allclose(gain, robust_gain(RIG, s * q, r), rtol=1e-7)


@pytest.mark.slow
def test_no_design_is_nan():
    q, r = jnp.eye(2), jnp.eye(1)
    opposed = Polytope(A=[[[0, 1], [0, 6]]] * 2, B=[[[0], [1]], [[0], [-1]]])  # no sign of the gain serves both
    unmoved = Polytope(A=[[[1.0, 0.0], [0.0, -1.0]]] * 2, B=[[[0.0], [1.0]]] * 2)
    for system in (opposed, unmoved):
        assert np.isnan(robust_gain(system, q, r)).all()
    assert np.isnan(robust_gain(RIG, q, -r)).all()
    assert np.isnan(robust_gain(RIG, q * jnp.nan, r)).all()
    both = jax.vmap(lambda r: robust_gain(RIG, q, r))(jnp.stack([r, -r]))
    assert np.isfinite(both[0]).all()
    with pytest.raises(ValueError, match="have shapes"):
        robust_gain(RIG, jnp.eye(3), r)


# the certified decay


both_times = pytest.mark.parametrize(
    "system",
    [pytest.param(RIG, id="continuous"), pytest.param(sampled(RIG), id="discrete", marks=pytest.mark.slow)],
)


@partial(jax.jit, static_argnames="period")
def decay(gain, A, B, period=None):
    """The rate and its derivative by the gain."""
    return jax.value_and_grad(lambda k: certified_decay(k, A, B, period))(gain)


def test_a_decay_needs_vertices_and_a_period():
    with pytest.raises(ValueError, match=r"A has shape \(2, 2\); the vertices need \(V, n, n\)"):
        certified_decay(np.ones(2), RIG.A[0], RIG.B[0])
    for period in (0.0, -1.0):
        with pytest.raises(ValueError, match=rf"period = {period:g} is outside \(0, inf\) s"):
            certified_decay(np.ones(2), RIG.A, RIG.B, period)


GAINS = ((-11753.0, -158.17), (-999.7, -111.07), (-0.834, -2.599))


@pytest.mark.slow
@killed_by("robust.design.interior.decay_rate", "SHIFT_GAP = 1e-8", "SHIFT_GAP = 1e-2", case="gain0-continuous")
@both_times
@pytest.mark.parametrize("gain", GAINS)
def test_decay_is_what_can_be_proved(gain, system):
    rate = float(decay(jnp.array(gain), system.A, system.B, system.period)[0])
    assert certify(gain, system, fastest=True).decay_rate == pytest.approx(rate, rel=2e-3)
    assert certify(gain, system, Spec(decay=0.9999 * rate)).decay_rate >= 0.9999 * rate
    assert certify(gain, system, Spec(decay=1.0001 * rate)).decay_rate is None


@pytest.mark.slow
@killed_by(
    "robust.design.interior.decay_rate",
    "2 * jnp.sum(weights * derivative)",
    "2 * jnp.sum(jnp.mean(weights, 0) * derivative)",
    case="continuous",
)
@both_times
def test_the_decay_derivative_is_a_difference_of_certificates(system, monkeypatch):
    replace_seam(monkeypatch, "decay_tolerance", 1e-8)
    replace_seam(monkeypatch, "max_search_programs", 60)
    gain, h = np.array([-999.7, -111.07]), 0.03
    slope = decay(gain, system.A, system.B, system.period)[1]
    for j in range(2):
        moved = [gain * (1 + place * h * (np.arange(2) == j)) for place in (-2, -1, 1, 2)]
        rates = [certify(k, system, fastest=True).decay_rate for k in moved]
        np.testing.assert_allclose(slope[j] * gain[j], STENCIL @ np.array(rates) / h, rtol=1e-4)


@pytest.mark.slow
def test_decay_of_one_system_is_that_of_its_slowest_mode():
    for gain in ((-1000.0, -30.0), (-1000.0, -300.0), (-1000.0, 30.0)):

        def slowest(k):
            return -jnp.max(jnp.linalg.eigvals(ONE.A[0] + ONE.B[0] @ k[None]).real)

        gain = jnp.array(gain)
        expected, slope = slowest(gain), jax.jacfwd(slowest)(gain)
        rate, by_gain = decay(gain, ONE.A, ONE.B)
        np.testing.assert_allclose(rate, expected, rtol=1e-6)
        np.testing.assert_allclose(by_gain, slope, rtol=1e-4, atol=1e-6 * np.abs(slope).max())


CHAIN = {n: (jnp.eye(n, k=1)[None], jnp.eye(n)[None, :, -1:]) for n in (1, 2, 3)}  # companion matrices with K below


@killed_by("robust.design.interior.decay_rate", "jnp.where(possible, new, old)", "new")
@killed_by("robust.design.interior.decay_rate", "path.settled >= FINAL_CENTRE_STEPS, jnp", "path.settled >= 0, jnp")
@pytest.mark.slow
def test_decay_at_a_multiple_pole_is_just_below_it():
    """(s + p)^n, or (z - p)^n: no P proves the rate of the pole itself."""
    at_poles = (((-1.0, -2.0), 1.0), ((-4.0, -4.0), 2.0), ((-1e4, -200.0), 100.0), ((0.0, 0.0), 0.0))
    for gain, truth in at_poles:
        rate, slope = decay(jnp.array(gain), *CHAIN[2])
        assert truth * (1 - 1e-6) - 1e-12 <= rate < truth
        assert np.isnan(slope).all()
    rate, slope = decay(jnp.array((-0.25, 1.0)), *CHAIN[2], 2.0)  # period 2 s, poles 0.5
    assert (1 - 1e-6) * np.log(2) / 2 <= rate < np.log(2) / 2
    assert np.isnan(slope).all()
    assert 1 - 1e-4 <= decay(jnp.array((-1.0, -3.0, -3.0)), *CHAIN[3])[0] < 1
    near = 1e-8  # the poles of (s + 1)^2 + near s
    rate = decay(jnp.array((-1.0, -2.0 - near)), *CHAIN[2])[0]
    np.testing.assert_allclose(rate, 1 + near / 2 - np.sqrt(near + near**2 / 4), rtol=1e-8)


@killed_by(
    "robust.design.interior.decay_rate", "(s * jnp.abs(jnp.log(s)), jnp.minimum(size, s))", "(jnp.abs(s - 1), size)"
)
def test_decay_of_a_fast_sampled_loop_is_that_of_its_pole():
    for pole in (0.9, 1e-2, 1e-3, 1e-5, 1e-12):
        rate, slope = decay(jnp.array([pole]), *CHAIN[1], 0.5)
        np.testing.assert_allclose(rate, -np.log(pole) / 0.5, rtol=1e-8)
        np.testing.assert_allclose(slope, -1 / pole / 0.5, rtol=1e-5)
    for states in (1, 2):  # deadbeat: every rate is proved by some P, and none is the largest
        rate, slope = decay(jnp.zeros(states), *CHAIN[states], 0.5)
        assert 50 < rate < np.inf
        assert np.isnan(slope).all()


@pytest.mark.slow
def test_decay_of_any_gain_has_a_derivative():
    """Stable or not, over ten decades, compiled and batched; and in the vertices."""
    random = np.random.default_rng(13)
    gains = 10.0 ** random.uniform(-5, 5, (300, 2)) * np.where(random.uniform(size=(300, 2)) < 0.1, 1, -1)
    both = jax.vmap(lambda k: decay(k, RIG.A, RIG.B))
    rates, slopes = both(jnp.array(gains))
    assert np.isfinite(rates).all()
    assert np.isfinite(slopes).all()
    assert (rates[(gains > 0).any(axis=1)] < 0).all()
    zero, slope = both(jnp.zeros((1, 2)))
    assert zero[0] < 0
    assert slope[0, 1] < 0  # more feedback is better
    assert np.isnan(both(jnp.full((1, 2), jnp.nan))[0]).all()
    forward = jax.jit(jax.jacfwd(lambda a, b: certified_decay(GAINS[1], a, b), (0, 1)))(RIG.A, RIG.B)
    reverse = jax.jit(jax.jacrev(lambda a, b: certified_decay(GAINS[1], a, b), (0, 1)))(RIG.A, RIG.B)
    for one, other in zip(forward, reverse, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-12)
