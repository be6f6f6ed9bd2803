"""Riccati and Lyapunov equations against SciPy, closed forms, published gains, and two control libraries."""

import functools
import pickle
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg as sl
from marks import cases
from mutants import killed_by

from diffabs.linear.gaussian import kalman, lqg
from diffabs.linear.lyapunov import discrete_lyapunov, lyapunov
from diffabs.linear.regulator import dlqr, lqr
from diffabs.linear.riccati import care, dare
from diffabs.linear.stabilisability import unstabilisable_mode
from diffabs.linear.weights import is_symmetric
from diffabs.parts.plants import ArmBalance

ALPHA, BETA, FAST, SLOW = 83.8796606703, 133.472842636189, 140.291806958, 14.0291806958
CARE, DARE = jax.jit(care), jax.jit(dare)
OPTIMISED = {"xla_backend_optimization_level": 3}  # as users compile: the hardest cases are a matter of rounding
HARD_CARE, HARD_DARE = (jax.jit(solve, compiler_options=OPTIMISED) for solve in (care, dare))


def rig(speed=FAST):
    return np.array([[0.0, 1.0], [0.0, ALPHA / speed]]), np.array([[0.0], [BETA / speed]])


def random_problem(n, seed, m=None):
    random = np.random.default_rng([n, seed])
    m = m or 1 + n // 4
    a, b, s = random.normal(size=(n, n)), random.normal(size=(n, m)), 0.1 * random.normal(size=(n, m))
    q, r = (x @ x.T + 0.5 * np.eye(len(x)) for x in (random.normal(size=(n, n)), random.normal(size=(m, m))))
    return a, b, q, r, s


def polished(a, b, q, r, s, p):
    """SciPy's P after two Newton-Kleinman steps: its own residual is often the larger one."""
    for _ in range(2):
        k = np.linalg.solve(r, b.T @ p + s.T)
        p = sl.solve_continuous_lyapunov((a - b @ k).T, -(q + k.T @ r @ k - s @ k - k.T @ s.T))
    return p


def relative(a, b):
    return np.linalg.norm(a - b) / np.linalg.norm(b)


@killed_by(
    "linear.riccati_batched",
    "a, q = A - times(B, transpose(S)), Q - times(S, transpose(S))",
    "a, q = A, Q",
    case="2",
)
@killed_by(
    "linear.riccati_batched",
    "return whole[:n, :n], -whole[:n, n:], whole[n:, :n]",
    "return whole[:n, :n], whole[:n, n:], -whole[n:, :n]",
    case="2",
)
@pytest.mark.parametrize("n", cases(range(1, 11), 2, 3, 4, 5, 6, 7, 8, 9, 10))
def test_care_is_scipys(n):
    for seed in range(6):
        a, b, q, r, s = random_problem(n, seed, m=1 + n // 4)
        found = CARE(a, b, q, r, s)
        assert found.stabilising
        assert found.residual < 1e-13
        exact = polished(a, b, q, r, s, sl.solve_continuous_are(a, b, q, r, s=s))
        assert relative(found.P, exact) < 1e-11


@pytest.mark.parametrize("n", cases([3, 1, 6, 10], 1, 6, 10))
def test_dare_is_scipys(n):
    for seed in range(6):
        a, b, q, r, s = random_problem(n, seed, m=1 + n // 4)
        found = DARE(a, b, q, r, s)
        assert found.stabilising
        assert relative(found.P, sl.solve_discrete_are(a, b, q, r, s=s)) < 1e-10


@killed_by(
    "linear.regulator",
    "return Regulator(-jnp.linalg.solve(symmetric_part(jnp.asarray(R, riccati.P.dtype)), turned)",
    "return Regulator(jnp.linalg.solve(symmetric_part(jnp.asarray(R, riccati.P.dtype)), turned)",
    case="q1-140.291806958",
)
@pytest.mark.parametrize("speed", [FAST, SLOW])
@pytest.mark.parametrize("q", [(11753.0**2, 1.0), (1.38e8, 1.0), (1e6, 1e4), (1.0, 1.0), (1e-5, 1e5)])
def test_the_rig_is_its_closed_form(speed, q):
    a, b = rig(speed)
    found = lqr(a, b, np.diag(q), np.eye(1))
    k1, c = -np.sqrt(q[0]), ALPHA / BETA
    k2 = -(c + np.sqrt(c**2 + q[1] - 2 * k1 * speed / BETA))
    np.testing.assert_allclose(found.gain[0], [k1, k2], rtol=1e-11)
    np.testing.assert_allclose(np.trace(found.P), k1 * k2 + k1 * c - k2 * speed / BETA, rtol=1e-11)


@pytest.mark.slow
def test_published_gain_of_the_arm():
    """A two-wheeler balanced by an arm, linearised; Q = I, R = 1 (F = -K there)."""
    rows = [
        (12.9180668385, -4.45395728949, 70.2901931216, 0, 26.6593633961, 8.14807608114),
        (-11.7727635355, 23.7491365472, -143.727708323, 0, -99.2915341084, -16.6609913898),
        (-11.9588753223, 8.35116991779, -161.19827877, 0, -49.9863063677, -19.4443093188),
    ]
    a = np.vstack([np.hstack([np.zeros((3, 3)), np.eye(3)]), rows])
    b = np.array([[0, 0, 0, -0.888586207456, 3.30949717047, 1.66609913898]]).T
    found = lqr(a, b, np.eye(6), np.eye(1))
    f = (-24208.064, -2293.1921, -7667.1, -8683.2995, -889.36867, -2860.7285)
    np.testing.assert_allclose(found.gain[0], -np.array(f), rtol=2e-6)  # as precise as the entries of A
    assert found.residual < 1e-12


@pytest.mark.slow
def test_two_control_libraries_agree():
    import contrax
    import control

    a, b, q, r, _ = random_problem(3, 0)
    found = lqr(a, b, q, r)
    np.testing.assert_allclose(-found.gain, control.lqr(a, b, q, r)[0], rtol=1e-9)
    np.testing.assert_allclose(-found.gain, contrax.care(*map(jnp.asarray, (a, b, q, r))).K, rtol=1e-9)
    found = dlqr(a, b, q, r)
    np.testing.assert_allclose(-found.gain, contrax.dare(*map(jnp.asarray, (a, b, q, r))).K, rtol=1e-9)
    np.testing.assert_allclose(-found.gain, control.dlqr(a, b, q, r)[0], rtol=1e-9)


def test_lyapunov_equations_are_scipys():
    for n in (1, 3, 6):
        a, _, q, *_ = random_problem(n, 1)
        np.testing.assert_allclose(
            jax.jit(lyapunov)(a, q).P, sl.solve_continuous_lyapunov(a.T, -q), rtol=1e-9, atol=1e-9
        )
        a = a / (1.1 * np.abs(np.linalg.eigvals(a)).max())
        found = jax.jit(discrete_lyapunov)(a, q)
        np.testing.assert_allclose(found.P, sl.solve_discrete_lyapunov(a.T, q), rtol=1e-9, atol=1e-9)
        assert found.residual < 1e-13


@killed_by("linear.lyapunov", "jnp.linalg.solve(operator, -Q.ravel())", "jnp.linalg.lstsq(operator, -Q.ravel())[0]")
@pytest.mark.parametrize(("solve", "modes"), [(lyapunov, (1.0, -1.0, 0.5)), (discrete_lyapunov, (2.0, 0.5, 0.3))])
def test_a_singular_lyapunov_equation_has_a_huge_solution(solve, modes):
    for seed in range(6):
        basis = np.random.default_rng(seed).normal(size=(3, 3))
        found = solve(basis @ np.diag(modes) @ np.linalg.inv(basis), np.eye(3))
        assert not np.abs(found.P).max() < 1e12


# SciPy's own cases: the collections of benchmarks of Benner, Laub and Mehrmann (1995), and others


@functools.cache
def scipys():
    """The cases of SciPy's tests, where the wheel ships them: by class, (A, B, Q, R, ...). Read in another process:
    their module has marks that these tests do not know."""
    read = (
        "import pickle, sys; from scipy.linalg.tests import test_solvers as t; "
        "names = ('TestSolveContinuousAre', 'TestSolveDiscreteAre'); "
        "sys.stdout.buffer.write(pickle.dumps({name: getattr(t, name).cases for name in names}))"
    )
    found = subprocess.run([sys.executable, "-W", "ignore", "-c", read], capture_output=True)
    if found.returncode:
        pytest.skip("this SciPy is without its tests")
    return pickle.loads(found.stdout)


def scipys_case(name, case):
    return [np.atleast_2d(np.asarray(x, float)) for x in scipys()[name][case][:4]]


def rounding(a, b, q, r, p):
    """How much, relative, P moves with the terms of the equation by one rounding: |X| eps |terms| / |P|."""
    closed = a - b @ np.linalg.solve(r, b.T @ p)
    x = np.linalg.norm(sl.solve_continuous_lyapunov(closed.T, -np.eye(len(a))))
    terms = 2 * np.linalg.norm(p @ a) + np.linalg.norm(p @ b @ np.linalg.solve(r, b.T @ p)) + np.linalg.norm(q)
    return x * np.finfo(float).eps * terms / np.linalg.norm(p)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("case", cases(range(20), 0, 1, 2, 3, 12, 13, 4, 5, 6, 11, 14, 15, 16, 17, 18, 19))
def test_scipys_cases_in_continuous_time(case):
    """All but two. A fourteenth example of the collection (case 13) has poles 5e-13 left of the imaginary axis; with 80
    digits SciPy's P is wrong by 2e-4. The other, a chain of 21 integrators, is one that SciPy gives up, too."""
    a, b, q, r = scipys_case("TestSolveContinuousAre", case)
    found = HARD_CARE(a, b, q, r)
    if case in (13, 16):
        assert not found.stabilising
        assert rounding(a, b, q, r, sl.solve_continuous_are(a, b, q, r)) > 1e-7  # the error that is promised
        return
    assert found.stabilising
    p = np.asarray(found.P)
    terms = p @ a, a.T @ p, -p @ b @ np.linalg.solve(r, b.T @ p), q
    assert np.linalg.norm(sum(terms)) < 1e-10 * sum(map(np.linalg.norm, terms))
    assert np.linalg.eigvals(a - b @ np.linalg.solve(r, b.T @ p)).real.max() < 0


@pytest.mark.slow
@pytest.mark.parametrize("case", range(3, 19))
def test_scipys_cases_in_discrete_time(case):
    """All that are real; R is 0 in one and singular in another (6 and 7)."""
    a, b, q, r = scipys_case("TestSolveDiscreteAre", case)
    found = HARD_DARE(a, b, q, r)
    assert found.stabilising
    p = np.asarray(found.P)
    gain = np.linalg.solve(r + b.T @ p @ b, b.T @ p @ a)
    terms = a.T @ p @ a, -p, -(b.T @ p @ a).T @ gain, q
    assert np.linalg.norm(sum(terms)) < 1e-12 * sum(map(np.linalg.norm, terms))
    assert np.abs(np.linalg.eigvals(a - b @ gain)).max() < 1
    assert relative(p, sl.solve_discrete_are(a, b, q, r)) < 1e-7


def singular_problem(seed, rank):
    """States in units of 1e-3 to 1e3, and an input weight of a lower rank."""
    random = np.random.default_rng([23, seed])
    units, half = 10.0 ** random.integers(-3, 4, 3), random.normal(size=(3, 3))
    a, b = random.normal(size=(3, 3)), random.normal(size=(3, 2))
    q, v = half @ half.T, random.normal(size=(2, rank))
    return a * units[:, None] / units, b * units[:, None], q / units / units[:, None], v @ v.T, units


@pytest.mark.slow
@pytest.mark.parametrize("rank", cases([0, 1], 0))
def test_inputs_that_cost_nothing(rank):
    problems = [singular_problem(seed, rank) for seed in range(12)]
    regular = [*problems[0][:3], np.eye(2)]  # shares the batch, and gets the bits that it gets alone
    batch = [np.stack(x) for x in zip(*[problem[:4] for problem in problems], regular, strict=True)]
    found = jax.jit(jax.vmap(dare))(*batch)
    assert found.stabilising.all()
    for (a, b, q, r, units), p in zip(problems, np.asarray(found.P), strict=False):
        even = units * units[:, None]
        assert relative(p * even, sl.solve_discrete_are(a, b, q, r) * even) < 1e-10
    np.testing.assert_allclose(found.P[-1], DARE(*regular).P, rtol=1e-12)


@pytest.mark.slow
def test_derivative_where_an_input_costs_nothing():
    a, b, q, r, _ = (x.copy() for x in singular_problem(0, 1))
    a, b, q = a / 3, b / np.abs(b).max(axis=1)[:, None], np.eye(3)
    slope = jax.jvp(lambda q: dare(a, b, q, r).P, (q,), (np.diag([1.0, 0.0, 2.0]),))[1]
    h = 1e-4
    ends = [sl.solve_discrete_are(a, b, q + s * h * np.diag([1.0, 0.0, 2.0]), r) for s in (1, -1)]
    np.testing.assert_allclose(slope, (ends[0] - ends[1]) / (2 * h), rtol=1e-6, atol=1e-6 * np.abs(slope).max())


@killed_by("linear.riccati", "if B.dtype != jnp.float64:", "if False:", case="care")
@pytest.mark.parametrize("solve", [care, dare, lqr, dlqr])
def test_single_precision_is_refused(solve):
    """Where every P would be NaN, because none is proven to 1e-7."""
    a, b, one = (np.array([[x]], np.float32) for x in (-0.5, 1.0, 1.0))
    with pytest.raises(ValueError, match=r"A, B, Q, R are float32: .* needs float64"):
        solve(a, b, one, one)
    with pytest.raises(ValueError, match="are float32"):
        jax.vmap(lambda q: solve(jnp.asarray(a), b, q, one))(jnp.stack([one, one]))


@pytest.mark.slow
def test_the_filter_of_numbers_in_lists():
    """x(k+1) = x(k) + w, y = x + v, all variances 1: P is the golden number, as of the regulator."""
    found = kalman([[1.0]], [[1.0]], [[1.0]], [[1.0]])
    np.testing.assert_allclose(found.P, (1 + np.sqrt(5)) / 2, rtol=1e-12)
    np.testing.assert_allclose(found.gain, found.P / (found.P + 1), rtol=1e-12)


def symmetric(x):
    return (x + x.T) / 2


def gain_of(name, a, b, q, r):
    """The gain of SciPy's solution for the symmetric parts."""
    q, r = symmetric(q), symmetric(r)
    if name == "lqr":
        return -np.linalg.solve(r, b.T @ sl.solve_continuous_are(a, b, q, r))
    p = sl.solve_discrete_are(a, b, q, r)
    weight = r + b.T @ p @ b
    return -np.linalg.solve(weight, b.T @ p @ a) if name == "dlqr" else np.linalg.solve(weight, b.T @ p).T


GAINS = {
    "lqr": lambda *data: lqr(*data).gain,
    "dlqr": lambda *data: dlqr(*data).gain,
    "kalman": lambda a, b, q, r: kalman(a.T, b.T, q, r).gain,
}


def skewed_problem():
    """Weights that are not symmetric."""
    a, b, q, r, _ = random_problem(3, 0, m=2)
    return a, b, q + np.triu(np.ones((3, 3)), 1), r + np.array([[0.0, 0.4], [-0.6, 0.0]])


@killed_by("linear.gaussian", "C @ riccati.P @ C.T + symmetric_part(V)", "C @ riccati.P @ C.T + V", case="kalman")
@killed_by("linear.regulator", "symmetric_part(jnp.asarray(R, riccati.P.dtype))", "jnp.asarray(R)", case="lqr")
@killed_by("linear.regulator", "symmetric_part(jnp.asarray(R)) + b.T", "jnp.asarray(R) + b.T", case="dlqr")
@pytest.mark.parametrize("name", cases(GAINS, "dlqr", "kalman"))
def test_traced_weights_count_by_their_symmetric_part(name):
    numbers = skewed_problem()
    np.testing.assert_allclose(jax.jit(GAINS[name])(*numbers), gain_of(name, *numbers), rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("name", cases(GAINS, "dlqr", "kalman"))
@pytest.mark.slow
def test_traced_weights_count_by_their_symmetric_part_in_the_derivative(name):
    """By a single entry of R."""
    a, b, q, r = skewed_problem()
    gain = jax.jit(GAINS[name])
    entry, h = np.array([[0.0, 1.0], [0.0, 0.0]]), 1e-4
    slope = jax.jvp(lambda r: gain(a, b, q, r), (r,), (entry,))[1]
    ends = [gain_of(name, a, b, q, r + sign * h * entry) for sign in (1, -1)]
    np.testing.assert_allclose(slope, (ends[0] - ends[1]) / (2 * h), rtol=1e-6, atol=1e-7)


@killed_by("linear.gaussian", "check_symmetric(name, covariance, size)", "pass", case="W")
@pytest.mark.parametrize("name", ["W", "V"])
def test_a_covariance_that_is_not_symmetric_is_refused(name):
    wrong = np.array([[1.0, 0.8], [-0.8, 1.0]])
    with pytest.raises(ValueError, match=rf"^{name} = .* is not symmetric and finite$"):
        kalman(**{"A": 0.5 * np.eye(2), "C": np.eye(2), "W": np.eye(2), "V": np.eye(2), name: wrong})


@killed_by("linear.gaussian", 'as_weight_matrix(name, covariance, size, definite=name == "V")', "pass")
@killed_by("linear.gaussian", 'definite=name == "V"', "definite=False")
@killed_by("linear.gaussian", 'definite=name == "V"', "definite=True")
@pytest.mark.usefixtures("refused_shapes")
def test_the_filter_needs_covariances():
    """Unlike a regulator's Q: a variance is not negative, and V has an inverse. Without w a stable state is known."""
    for w, v, message in ((-0.1, 1.0, "W is not positive semidefinite"), (1.0, 0.0, "V is not positive definite")):
        with pytest.raises(ValueError, match=f"^{message}: an eigenvalue is {min(w, v):g}, outside"):
            kalman([[0.5]], [[1.0]], [[w]], [[v]])
    np.testing.assert_allclose(kalman([[0.5]], [[1.0]], [[0.0]], [[1.0]]).P, 0.0, atol=1e-12)


@killed_by("linear.gaussian", "(jnp.isfinite(noise) & (noise > 0)).all()", "True")
@pytest.mark.parametrize("noise", [(0.0, 1e-3), (1e-3, -1e-3), (np.nan, 1e-3), (1e-3, np.inf)], ids=str)
def test_a_sensor_without_noise_has_no_filter(noise):
    with pytest.raises(ValueError, match=r"^noise = \[.*\] is outside \(0, inf\) rad$"):
        lqg(ArmBalance(), np.eye(6), 1.0, noise=noise)


@killed_by("linear.weights", "np.outer(scale, scale)", "0.0")
def test_rounding_does_not_make_a_matrix_unsymmetric():
    """A product F P F' has small entries that are all rounding; differences far above rounding are refused."""
    product = np.array([[1e8, 3e-9], [-2e-9, 1e8]])
    assert is_symmetric(product)
    assert not is_symmetric(product + np.array([[0.0, 1e-3], [0.0, 0.0]]))
    assert not is_symmetric(np.array([[1e8, 1e-6], [2e-6, 1e-8]]))


def test_complex_matrices_are_refused():
    for solver in (care, dare):
        with pytest.raises(ValueError, match="must be real"):
            solver(np.eye(2), np.array([[1.0], [1.0j]]), np.eye(2), np.eye(1))


# derivatives


def scalar(solver, weights):
    return lambda *data: jnp.sum(weights * solver(*data).P)


@killed_by("linear.riccati", "closed = A - B @ jnp.linalg.solve(R, B.T @ P + S.T)", "closed = A", case="care")
@pytest.mark.slow
@pytest.mark.parametrize("solver", [care, dare])
def test_gradients_are_differences(solver):
    data = random_problem(3, 3)
    function = scalar(solver, np.random.default_rng(0).normal(size=(3, 3)))
    reverse = jax.jit(jax.grad(function, (0, 1, 2, 3, 4)))(*data)
    forward = jax.jit(jax.jacfwd(function, (0, 1, 2, 3, 4)))(*data)
    value = jax.jit(function)
    for i, (back, ahead) in enumerate(zip(reverse, forward, strict=True)):
        np.testing.assert_allclose(back, ahead, rtol=1e-9, atol=1e-9 * np.abs(ahead).max())
        direction = np.random.default_rng(i).normal(size=data[i].shape)
        direction = direction + direction.T if i in (2, 3) else direction
        h = 1e-4

        def at(step, i=i, direction=direction):
            moved = [x + step * direction if j == i else x for j, x in enumerate(data)]
            return value(*moved)

        difference = (8 * (at(h) - at(-h)) - (at(2 * h) - at(-2 * h))) / (12 * h)
        np.testing.assert_allclose(np.sum(np.asarray(back) * direction), difference, rtol=1e-6)


@pytest.mark.slow
def test_gradient_of_the_rigs_gain_in_its_weights():
    """k1 = -sqrt(q1/R): its derivative in log q1 is k1/2."""
    a, b = rig()

    def k1(log_q1):
        return lqr(a, b, jnp.diag(jnp.array([jnp.exp(log_q1), 1.0])), jnp.eye(1)).gain[0, 0]

    value, slope = jax.value_and_grad(k1)(np.log(1.38e8))
    np.testing.assert_allclose(slope, value / 2, rtol=1e-9)


@pytest.mark.slow
def test_batched_is_single():
    problems = [random_problem(3, seed) for seed in range(5)]
    batch = [np.stack(x) for x in zip(*problems, strict=True)]
    many = jax.jit(jax.vmap(care))(*batch)
    for i, problem in enumerate(problems):
        one = care(*problem)
        np.testing.assert_allclose(many.P[i], one.P, rtol=1e-12, atol=1e-12 * np.abs(one.P).max())
    shared = jax.vmap(care, (0, None, None, None))(batch[0], *problems[0][1:4])
    np.testing.assert_allclose(shared.P[0], care(*problems[0][:4]).P, rtol=1e-12, atol=1e-13)


# what has no answer


@pytest.mark.parametrize(
    ("a", "b", "q"),
    [
        (np.diag([1.0, -1.0]), [[0.0], [1.0]], np.eye(2)),  # an unstable mode that the input does not move
        (np.zeros((2, 2)), [[0.0], [0.0]], np.eye(2)),
        ([[0.0, 1.0], [-1.0, 0.0]], [[0.0], [1.0]], np.zeros((2, 2))),  # undamped, and unseen by the cost
        ([[0.0, 1.0], [0.0, 0.0]], [[0.0], [1.0]], np.diag([0.0, 1.0])),  # an integrator that the cost does not see
        (np.diag([1.0, -1.0]), [[1.0], [1.0]], -100 * np.eye(2)),
        (np.diag([np.nan, -1.0]), [[1.0], [1.0]], np.eye(2)),
    ],
)
def test_what_has_no_solution_is_reported(a, b, q):
    found = CARE(np.array(a), np.array(b), q, np.eye(1))
    assert not found.stabilising
    assert np.isnan(found.P).all()


@pytest.mark.slow
def test_a_weight_that_is_not_definite_is_reported():
    a, b = rig()
    assert not CARE(a, b, np.eye(2), -np.eye(1)).stabilising
    assert not DARE(a, b, np.eye(2), -np.eye(1)).stabilising
    assert not DARE(a, b, np.eye(2), -1e-9 * np.eye(1)).stabilising
    assert not DARE(2 * np.eye(2), np.ones((2, 2)), np.eye(2), np.zeros((2, 2))).stabilising  # R + B'PB stays singular


@pytest.mark.slow
def test_repeated_poles_and_unseen_unstable_modes():
    jordan = np.array([[1.0, 1.0, 0.0], [0.0, 1.0, 1.0], [0.0, 0.0, 1.0]])
    b = np.array([[0.0], [0.0], [1.0]])
    for q in (np.eye(3), np.zeros((3, 3))):  # without a cost the poles are mirrored, to -1 three times
        found = CARE(jordan, b, q, np.eye(1))
        assert found.stabilising
        closed = jordan - b @ b.T @ found.P
        assert np.linalg.eigvals(closed).real.max() < -0.9


@killed_by("linear.riccati_batched", "return jnp.where((error <= limit) & (moved <= limit), P, jnp.nan)", "return P")
def test_nearly_unstabilisable_is_right_or_reported():
    reported = 0
    for coupling in 10.0 ** -np.arange(0.0, 15.0):
        a, b = np.diag([1.0, -2.0]), np.array([[coupling], [1.0]])
        found = CARE(a, b, np.eye(2), np.eye(1))
        if not found.stabilising:
            reported += 1
            continue
        # scaled by the coupling the first state is moved by 1, and the problem is a good one but for its weight
        unit = np.diag([coupling, 1.0])
        exact = polished(a, np.ones((2, 1)), unit @ unit, np.eye(1), np.zeros((2, 1)),
                         sl.solve_continuous_are(a, np.ones((2, 1)), unit @ unit, np.eye(1)))  # fmt: skip
        p = unit @ np.asarray(found.P) @ unit
        assert relative(p, exact) < 1e-6, coupling
    assert reported <= 8  # from a coupling of 1e-7 on


@pytest.mark.slow
def test_no_silent_failure_among_a_thousand():
    random = np.random.default_rng(7)
    a, b = (np.stack([rig(speed)[i] for speed in np.geomspace(SLOW, FAST, 1000)]) for i in (0, 1))
    q = np.stack([np.diag(x) for x in 10.0 ** random.uniform(-5, 5, (1000, 2))])
    r = 10.0 ** random.uniform(-5, 5, (1000, 1, 1))
    found = jax.jit(jax.vmap(care))(a, b, q, r)
    fine = np.asarray(found.stabilising)
    assert fine.sum() > 990
    q1, q2, r, speed = q[:, 0, 0], q[:, 1, 1], r[:, 0, 0], np.geomspace(SLOW, FAST, 1000)
    k1, c = -np.sqrt(q1 / r), ALPHA / BETA
    k2 = -(c + np.sqrt(c**2 + q2 / r - 2 * k1 * speed / BETA))
    trace = r * (k1 * k2 + k1 * c - k2 * speed / BETA)
    np.testing.assert_allclose(np.trace(found.P, axis1=1, axis2=2)[fine], trace[fine], rtol=1e-9)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"A": np.zeros((2, 3))}, r"A has shape \(2, 3\) and B \(2, 1\)"),
        ({"B": np.zeros((3, 1))}, r"B \(3, 1\); \(n, n\) and \(n, m\) are needed"),
        ({"Q": np.eye(3)}, r"Q has shape \(3, 3\); \(2, 2\) is needed"),
        ({"Q": np.array([[1.0, 1.0], [0.0, 1.0]])}, "Q = .* is not symmetric"),
        ({"R": np.zeros((1, 1))}, r"R is not positive definite: an eigenvalue is 0, outside \(0, inf\)"),
        ({"A": np.full((2, 2), np.inf)}, "not finite"),
        ({"B": np.zeros((2, 1))}, "not stabilisable: the input does not move the mode at"),
        ({"S": np.array([[0.0], [np.nan]])}, "^S has an entry that is not finite$"),
        ({"S": np.array([[np.inf], [0.0]])}, "^S has an entry that is not finite$"),
    ],
)
@killed_by("linear.regulator", "not isinstance(S, Tracer) and", "False and")
@pytest.mark.usefixtures("refused_shapes")
def test_bad_matrices(change, message):
    a, b = rig()
    given = {"A": a, "B": b, "Q": np.eye(2), "R": np.eye(1)} | change
    for regulator in (lqr, dlqr):
        if "mode" in message and regulator is dlqr:
            given["A"] = np.diag([1.5, 0.5])
        with pytest.raises(ValueError, match=message):
            regulator(**given)


@killed_by("linear.regulator", "if not b.size:", "if False:", case="lqr-no input")
@killed_by("linear.riccati", "if not B.size:", "if False:", case="care-no state")
@pytest.mark.parametrize(("n", "m"), [(0, 1), (2, 0)], ids=["no state", "no input"])
@pytest.mark.parametrize("solve", [lqr, dlqr, care, dare])
def test_a_system_without_states_or_inputs_is_refused(solve, n, m):
    with pytest.raises(ValueError, match=rf"^B has shape \({n}, {m}\); at least one state and one input are needed$"):
        solve(-np.eye(n), np.zeros((n, m)), np.eye(n), np.eye(m))


@killed_by("linear.riccati_batched", "max(lanes, 1)", "lanes")
@killed_by("linear.riccati_batched", "P.reshape(*lanes, *P.shape[1:])", "P.reshape(axis_size, -1, *P.shape[1:])")
@pytest.mark.parametrize("batch", cases([(0,), (0, 3), (3, 0)], (0,), (3, 0)), ids=str)
def test_a_batch_may_be_empty(batch):
    def solve(a):
        return care(a, jnp.ones((2, 1)), jnp.eye(2), jnp.eye(1))

    for _ in batch:
        solve = jax.vmap(solve)
    found = solve(jnp.zeros((*batch, 2, 2)))
    assert (found.P.shape, found.residual.shape) == ((*batch, 2, 2), batch)


def test_the_mode_that_is_not_moved():
    assert unstabilisable_mode(np.diag([0.6, -1.0]), [[0.0], [1.0]]) == 0.6
    assert unstabilisable_mode(np.diag([-0.6, 1.0]), [[0.0], [1.0]]) is None
    assert unstabilisable_mode(np.diag([-0.6, 1.0]), [[0.0], [1.0]], discrete=True) is None
    assert unstabilisable_mode(np.diag([-1.6, 0.1]), [[0.0], [1.0]], discrete=True) == -1.6


HYDRAULIC = (  # a cylinder: position [m], speed [m/s], pressure [Pa]; the input is a flow [m3/s]
    np.array([[0.0, 1.0, 0.0], [0.0, -0.5, 1e-5], [0.0, -1e10, -1.0]]),
    np.array([[0.0], [0.0], [1e13]]),
)


@pytest.mark.slow
def test_a_cylinder_in_pascal_has_a_regulator():
    a, b = HYDRAULIC
    q, r = np.diag([1.0, 0.0, 0.0]), np.array([[1e6]])
    exact = -np.linalg.solve(r, b.T @ sl.solve_continuous_are(a, b, q, r))
    np.testing.assert_allclose(lqr(a, b, q, r).gain, exact, rtol=1e-7)  # SciPy's own residual is about 1e-9
    late, held = sl.expm(1e-3 * a), np.linalg.solve(a + 1e-12 * np.eye(3), (sl.expm(1e-3 * a) - np.eye(3)) @ b)
    assert unstabilisable_mode(late, held, discrete=True) is None
    assert bool(kalman(late.T, held.T, q, r).stabilising)


def hidden_mode(random, n, growth, *, discrete):
    """A random system with a mode `growth` that no input moves, in coordinates that do not show it."""
    a, b = random.normal(size=(n, n)), random.normal(size=(n, 1 + n // 4))
    a[-1, :-1], b[-1] = 0.0, 0.0
    a[-1, -1] = 1.0 + growth if discrete else growth
    basis = random.normal(size=(n, n))
    return basis @ a @ np.linalg.inv(basis), basis @ b


def stiff_chain(random, n):
    """States in series with rates from 1e-6 to 1e6 1/s, all behind one input."""
    rates = 10.0 ** random.uniform(-6, 6, n) * random.choice([-1.0, 1.0], n)
    return np.diag(rates) + np.diag(10.0 ** random.uniform(-6, 6, n - 1), 1), np.eye(n)[:, -1:]


@killed_by("linear.stabilisability", "* scales[0][:, None] * scales[1]", "")
@killed_by("linear.stabilisability", "return -states - np.log(rates)", "return 0.0 * states")
@killed_by("linear.stabilisability", "if discrete else np.real(mode) >= -error", "if discrete else np.real(mode) >= 0")
def test_units_do_not_decide_what_is_stabilisable():
    """Distinct rates in series make every mode movable; a hidden mode stays hidden. Units differ by up to 1e16."""
    random = np.random.default_rng(3)
    for k in range(24):
        n, discrete = 2 + k % 6, bool(k % 2)
        hidden = hidden_mode(random, n, (0.0, 0.3, 2.0)[k % 3], discrete=discrete)
        chain = stiff_chain(random, n)
        for units in (np.ones(n), *10.0 ** random.uniform(-8, 8, (3, n))):
            for (a, b), unmoved in ((hidden, True), (chain, False)):
                mode = unstabilisable_mode(a * units[:, None] / units, b * units[:, None], discrete=discrete)
                assert (mode is not None) == unmoved, (k, units, mode)


@killed_by("linear.stabilisability", "reached |= (a[:, reached] != 0).any(axis=1)", "pass")
def test_a_state_behind_no_input_is_not_moved():
    """No entry leads from the input to the last state, however large the units make the others."""
    a = np.array([[1.0, 1e12, 0.0], [0.0, -2.0, 1e12], [0.0, 0.0, 1e-9]])
    b = np.array([[0.0], [1e12], [0.0]])
    assert unstabilisable_mode(a, b) == 1e-9
    assert unstabilisable_mode(a[:2, :2], b[:2]) is None
