"""Tuning with rollouts: gradients, optima against another search, stability, worst cases, LQ weights, pole regions."""

import dataclasses
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from mutants import killed_by
from scipy.linalg import solve_continuous_are
from scipy.optimize import minimize
from scipy.stats import qmc

import diffabs as d
from diffabs import actuators, controllers, plants, references
from diffabs.core.pytree import canonical_dtypes, param, pytree
from diffabs.core.validity import find_problems
from diffabs.linear.slip_model import Sampling, SlipModel
from diffabs.loop.stability import stable_step, stable_steps
from diffabs.parts.objectives import BRAKING
from diffabs.parts.objectives.balance import PeakTorque
from diffabs.parts.objectives.tracking import FinalValue
from diffabs.parts.stops import SpeedReached
from diffabs.robust.design.polytopes import Polytope
from diffabs.robust.design.speed_scaled import SpeedScaled, greatest_speed_fall
from diffabs.scenario.defaults import braking
from diffabs.scenario.section_tune import Goal
from diffabs.tune import (
    AtMost,
    CertifiedDecay,
    CVaR,
    DerivativeMode,
    Method,
    Poles,
    SmoothWorst,
    StartError,
    Stopping,
    WorstCase,
    grid,
    tune,
    worst_case,
)
from diffabs.tune.problem import Multipliers, Problem
from diffabs.tune.tuning import build_problem
from diffabs.tune.weights import lq_weights, lqr_gain_design

RIG = braking(
    plant=plants.MirroredRig(),
    initial=d.BrakeStart(speed=8.0, slip=0.02),
    stop=SpeedReached(speed=6.5),
    controller=controllers.StateFeedback(gain=np.array([-3000.0, -60.0]), low=0.0, high=9.03),
    feedforward=controllers.HoldingInput(),
    actuator=actuators.Lag(time_constant=1e-3),
)
GAINS = {"controller.gain": ((-1e5, -1e3), (-30.0, -5.0))}
SOLVER = d.FixedStep(5e-4, 0.25)
TWO = grid({"plant.mass": [5.3, 6.2]})


@dataclasses.dataclass(frozen=True, eq=False)
class Least:
    """A constraint of the user's own: metric >= bound."""

    metric: str
    bound: float

    def excess(self, loop, metrics):
        """Return bound - metric."""
        return self.bound - metrics[self.metric]


def value_and_gradient(problem):
    """Loss and gradient as functions of one z."""
    m = Multipliers(jnp.full((1, 2), 0.3), jnp.full(1, 7.0))
    evaluate = problem.evaluator(0.01)
    return lambda z: jax.tree.map(lambda x: np.asarray(x[0]), evaluate(jnp.asarray(z)[None], m))


@pytest.mark.slow
def test_gradients_of_both_modes_agree_with_differences():
    """Objective and both terms of the augmented Lagrangian."""
    ask = {"objective": {"iae": 1.0}, "over": TWO, "solver": SOLVER, "constraints": [AtMost("overshoot", 0.01)]}
    forward, reverse = (value_and_gradient(build_problem(RIG, free=GAINS, mode=mode, **ask)) for mode in DerivativeMode)
    z = build_problem(RIG, free=GAINS, **ask).space.place(RIG)
    found = forward(z)
    assert (found.evaluation.excess > 0).all()
    np.testing.assert_allclose(found.gradient, reverse(z).gradient, rtol=1e-8)
    np.testing.assert_allclose(found.evaluation.metrics["overshoot"] / 0.01 - 1, found.evaluation.excess, rtol=1e-9)
    h = 1e-5
    for i in range(2):
        e = h * np.eye(2)[i]
        away = (forward(z + e).loss - forward(z - e).loss) / (2 * h)
        np.testing.assert_allclose(found.gradient[i], away, rtol=1e-6)


@pytest.mark.slow
def test_it_finds_the_optimum_of_nelder_mead():
    ask = {"objective": {"iae": 1.0, "final_slip_error": 0.1}, "over": TWO, "solver": SOLVER}
    found = tune(
        build_problem(RIG, free=GAINS, **ask),
        method=Method(starts=2, stopping=Stopping(iterations=40)),
    )
    problem = build_problem(RIG, free=GAINS, **ask)
    value, steady = problem.objective_evaluator(), problem.steady()

    def objective(z):
        return float(value(jnp.asarray(z)[None]).objective[0]) if steady(z[None])[0] else 1.0

    theirs = minimize(objective, problem.space.place(RIG), method="Nelder-Mead", options={"maxfev": 300})
    assert found.objective[1] <= theirs.fun * (1 + 1e-3)
    assert found.objective[1] < 0.8 * found.objective[0]
    assert stable_step(found.loop) >= SOLVER.step
    assert found.mode is DerivativeMode.FORWARD
    assert found.history[-1].objective == found.objective[1]
    again = tune(
        build_problem(RIG, free=GAINS, **ask),
        method=Method(starts=2, stopping=Stopping(iterations=40)),
    )
    assert again.history == found.history


@pytest.mark.slow
def test_a_gain_that_the_step_cannot_follow_is_not_entered():
    """Speed is everything here, so kp goes up until RK4 with this step would no longer follow."""
    car = braking(
        plant=plants.QuarterCar(),
        initial=d.BrakeStart(speed=8.0, slip=0.02),
        stop=SpeedReached(speed=6.0),
        controller=controllers.PID(kp=2000.0, high=1e6, low=0.0),
        reference=references.FixedSlip(slip=0.1),
    )
    step = 2e-3
    found = tune(
        build_problem(car, free={"controller.kp": (500.0, 1e6)}, objective={"iae": 1.0}, solver=d.FixedStep(step, 0.4)),
        method=Method(stopping=Stopping(iterations=25)),
    )
    assert stable_step(found.loop) >= step
    assert stable_step(found.loop) < 4 * step
    assert found.loop.controller.kp > 2000


def test_a_start_that_is_not_stable_is_refused():
    with pytest.raises(ValueError, match=r"the integration step is not stable there: solver.step = 0.1 s"):
        tune(build_problem(RIG, free=GAINS, objective={"iae": 1.0}, solver=d.FixedStep(0.1, 0.3)))


@killed_by("tune.tuning", 'check_part(aggregate or Mean(), "aggregate.")', "aggregate or Mean()")
@killed_by("tune.tuning", "    _check_not_overwritten(subject, free_space, batch)\n", "")
@killed_by("tune.tuning", "if not listed or not all(", "if not all(")
@killed_by("tune.tuning", " and not isinstance(constraints, Mapping | str)", "")
@killed_by(
    "tune.tuning",
    'getattr(requirement, "metric", None)',
    'requirement.metric if type(requirement).__name__ == "AtMost" else None',
)
@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"objective": {}}, "the objective has no metric"),
        ({"objective": {"iea": 1.0}}, "iea is not measured; there is stop_time"),
        ({"objective": {"iae": np.nan}}, "the weight of iae is nan"),
        ({"objective": {"iae": "1"}}, "the weight of iae is '1', not a finite number"),
        ({"objective": ["iae"]}, r"objective = \['iae'\] is no mapping from metrics to weights"),
        ({"constraints": [AtMost("overshot", 0.1)]}, "overshot is not measured"),
        ({"constraints": [AtMost("iae", np.nan)]}, "the bound of iae is nan, not a finite number"),
        ({"constraints": [AtMost("iae", "0.7")]}, "the bound of iae is '0.7', not a finite number"),
        (
            {"constraints": [AtMost("iae", [0.1, 0.2])]},
            r"iae has the shape \(2,\); one number, or one for",
        ),
        ({"constraints": {"iae": 0.7}}, r"constraints = \{'iae': 0.7\} is no list of constraints"),
        ({"constraints": {}}, r"constraints = \{\} is no list of constraints"),
        ({"constraints": ""}, "constraints = '' is no list of constraints"),
        ({"constraints": [Least("overshot", 0.1)]}, "overshot is not measured"),
        ({"constraints": [Least("iae", np.nan)]}, "the bound of iae is nan, not a finite number"),
        ({"constraints": AtMost("iae", 0.7)}, r"constraints = AtMost\(.*\) is no list of constraints"),
        ({"aggregate": CVaR(level=90.0)}, r"^aggregate.level = 90 is outside \[0, 1\)"),
        ({"aggregate": CVaR(level=1.0)}, r"level = 1 is outside \[0, 1\)"),
        ({"aggregate": SmoothWorst(softness=-0.02)}, r"softness = -0.02 is outside \(0, inf\)"),
        (
            {"free": {"plant.mass": (4.0, 8.0)}, "over": TWO},
            "^plant.mass: free, but `over` gives its value in every run$",
        ),
        ({"over": {"plant.mass": [5.0]}}, "over = .* is no Batch"),
        ({"free": "controller.kp"}, "free = 'controller.kp' is text; a list of paths, or ranges by path"),
        ({"free": {"plant.mass": 5.0}}, r"plant.mass: the range 5.0 is not a pair \(low, high\) of numbers"),
        ({"measured": {"iae": PeakTorque()}}, "objectives.iae: peak-torque needs constant; there is only slip"),
        ({"over": d.Batch({"plant.mass": [-1.0]})}, "plant.mass = -1"),
        ({"free": {"plant.mass": (9.0, 10.0)}}, "plant.mass = 5.3 is not inside"),
    ],
)
def test_says_what_does_not_fit(change, message):
    given = {"free": GAINS, "objective": {"iae": 1.0}, "solver": SOLVER}
    with pytest.raises(ValueError, match=message):
        tune(build_problem(RIG, **given | change))


@killed_by("tune.tuning", "constraints = _check_constraints(", "_check_constraints(")
def test_constraints_may_come_from_a_generator():
    bounds = (AtMost(name, 0.5) for name in ("iae", "overshoot"))
    problem = build_problem(RIG, free=GAINS, objective={"iae": 1.0}, over=TWO, solver=SOLVER, constraints=bounds)
    assert problem.excesses == 2 * 2  # of each of two runs


@killed_by("core.tracing", "[True] * len(program.outvars)", "[False] * len(program.outvars)", case="log_diagonal")
@pytest.mark.parametrize(
    ("free", "over", "idle"),
    [
        ("log_diagonal", {"plant.mass": [5.3, 6.2]}, False),
        ("loop.controller.gain", {"plant.mass": [5.3, 6.2]}, True),
        ("log_diagonal", {"controller.gain": np.array([[-3e3, -60.0], [-2e3, -50.0]])}, True),
    ],
    ids=["log_diagonal", "a designed gain", "a gain of each run"],
)
def test_a_free_parameter_is_not_overwritten(free, over, idle):
    loop = lq_weights(RIG, (1e6, 1e4), 1.0, lqr_gain_design(SlipModel(speed=20 / 3.6)))
    given = {"free": [free], "over": d.Batch(over), "objective": {"iae": 1.0}, "solver": SOLVER}
    if not idle:
        assert build_problem(loop, **given).space.names == ["log_diagonal.0", "log_diagonal.1"]
        return
    with pytest.raises(
        ValueError, match=rf"^{free}: free, but `over` or `closed_loop\(\)` gives its value in every run$"
    ):
        build_problem(loop, **given)


@killed_by("scenario.section_tune", "if both := set(self.free) & set(self.over):", "if both := set():")
def test_a_section_frees_no_parameter_of_its_lanes():
    goal = Goal(free={"plant.mass": (4.0, 8.0)}, objective={"iae": 1.0}, over={"plant.mass": (5.3, 6.2)})
    with pytest.raises(ValueError, match=r"^plant.mass: both in tune.free and in tune.over; leave it out of one"):
        goal.check(RIG)


@killed_by("tune.augmented_lagrangian", "for name in (*self.problem.weights, *bounds):", "for name in ():")
@pytest.mark.slow
@pytest.mark.parametrize("where", ["constraint", "objective"])
def test_a_metric_that_is_infinite_at_the_start_is_named(where):
    """The slip starts at 0.02 and cannot settle at 0.2 within two steps."""
    given = {"objective": {"iae": 1.0}, "constraints": [AtMost("settling_time", 1.0)]}
    if where == "objective":  # its smooth worst is inf/inf
        given = {"objective": {"settling_time": 1.0}, "aggregate": SmoothWorst()}
    problem = build_problem(RIG, free=GAINS, over=TWO, solver=d.FixedStep(5e-4, 1e-3), **given)
    with pytest.raises(StartError, match=r"^settling_time is infinite at the start in 2 of 2 lanes: such a run never"):
        tune(problem)


@pytree
class Margin(FinalValue):
    """The logarithm of a negative number: NaN, though no run diverges."""

    unit = "1"

    def value(self, memory, ending):
        """NaN."""
        return jnp.log(-ending.sample.output.distance - 1.0)


@killed_by("tune.augmented_lagrangian", "np.count_nonzero(value == unreached)", "np.count_nonzero(~np.isfinite(value))")
@pytest.mark.slow
@pytest.mark.parametrize("where", ["constraint", "objective"])
def test_a_nan_metric_at_the_start_does_not_settle_late(where):
    measured = {"iae": BRAKING["iae"], "margin": Margin()}
    given = {"objective": {"iae": 1.0}, "constraints": [Least("margin", 1.0)]}
    if where == "objective":
        given = {"objective": {"margin": 1.0}}
    problem = build_problem(RIG, free=GAINS, over=TWO, solver=d.FixedStep(5e-4, 1e-3), measured=measured, **given)
    with pytest.raises(StartError, match=r"^margin is not finite at the start in 2 of 2 lanes$"):
        tune(problem)


@pytest.mark.parametrize(
    ("kind", "change", "message"),
    [
        (Method, {"starts": 0}, r"starts = 0 is no whole number in \[1, inf\)"),
        (Method, {"starts": 1.5}, r"starts = 1.5 is no whole number in \[1, inf\)"),
        (Method, {"margin": -0.1}, r"margin = -0.1 is no number in \[0, inf\)"),
        (Stopping, {"iterations": -1}, r"iterations = -1 is no whole number in \[0, inf\)"),
    ],
)
def test_settings_out_of_range_are_refused(kind, change, message):
    with pytest.raises(ValueError, match=message):
        kind(**change)


@pytest.mark.slow
def test_lanes_in_groups_are_the_lanes_together():
    speeds = np.array([8.0, 12.0, 7.0, 11.0])
    values = {"initial.speed": speeds}
    ask = {"free": GAINS, "objective": {"stop_distance": 1.0}, "solver": d.FixedStep(5e-4, 0.8)}
    together, apart = (
        jax.jit(build_problem(RIG, over=d.Batch(values, durations=t), **ask).evaluate)(jnp.zeros(2))
        for t in (None, np.array([0.3, 0.8, 0.25, 0.75]))
    )
    np.testing.assert_allclose(apart.metrics["stop_distance"], together.metrics["stop_distance"], rtol=1e-12)
    weighed = build_problem(RIG, over=d.Batch(values, weights=1 / speeds), **ask).evaluate(jnp.zeros(2))
    np.testing.assert_allclose(weighed.objective, np.mean(together.metrics["stop_distance"] / speeds), rtol=1e-12)


class TestStability:
    def test_many_loops_at_once(self):
        masses = np.array([5.3, 6.2, 9.0])
        batch = jax.vmap(lambda m: d.replace(canonical_dtypes(RIG), {"plant.mass": m}))(masses)
        each = [stable_step(d.replace(RIG, {"plant.mass": m})) for m in masses]
        np.testing.assert_allclose(stable_steps(batch), each, rtol=1e-12)

    @killed_by(
        "loop.stability",
        "angles = np.abs(np.angle(direction))",
        "angles = np.full(np.shape(direction), np.pi)",
    )
    def test_the_limit_of_a_real_and_of_an_imaginary_mode(self):
        from diffabs.loop.stability import _radius

        np.testing.assert_allclose(_radius(np.array([-1.0 + 0j])), 2.785, atol=1.5e-3)  # the roots of |R(z)| = 1
        np.testing.assert_allclose(_radius(np.array([1j])), np.sqrt(8.0), atol=1.5e-3)


class TestPoles:
    CLOSED = np.array([[[-2.0, 3.0], [-3.0, -2.0]], [[-5.0, 1.0], [0.0, -1.0]]])

    def loop_for(self, gain):
        return dataclasses.replace(RIG, controller=controllers.StateFeedback(gain=gain))

    def test_continuous(self):
        system = Polytope(self.CLOSED, np.zeros((2, 2, 1)), states=("integral of slip error", "slip error"))
        excess = Poles(system, decay=1.5, damping=0.6).excess(self.loop_for(np.array([-1.0, -2.0])), {})
        rates, damping = np.split(np.asarray(excess), 2)
        np.testing.assert_allclose(np.sort(rates), np.sort(1 + np.array([-2, -2, -5, -1]) / 1.5), rtol=1e-12)
        np.testing.assert_allclose(np.sort(damping), np.sort([0.6 - 2 / 13**0.5] * 2 + [-0.4] * 2), rtol=1e-9)

    @killed_by("tune.constraints", "(abs(self.decay) or 1.0)", "(self.decay or 1.0)")
    def test_a_bound_on_growth(self):
        """Growth of at most 2/s: the poles -2, -2, -5 and -1 hold it, and one of +3 does not."""
        names = ("integral of slip error", "slip error")
        grown = self.CLOSED.copy()
        grown[1, 1, 1] = 3.0
        for closed, real in ((self.CLOSED, [-2, -2, -5, -1]), (grown, [-2, -2, -5, 3])):
            system = Polytope(closed, np.zeros((2, 2, 1)), states=names)
            excess = Poles(system, decay=-2.0).excess(self.loop_for(np.array([-1.0, -2.0])), {})
            np.testing.assert_allclose(np.sort(excess), np.sort((np.array(real) - 2.0) / 2), rtol=1e-12)

    @killed_by("tune.constraints", "if self.system.period is not None:", "if False:")
    def test_discrete_poles_are_those_of_continuous_time(self):
        from scipy.linalg import expm

        period = 0.05
        sampled = np.array([expm(a * period) for a in self.CLOSED])
        names = ("integral of slip error", "slip error")
        both = [
            Poles(Polytope(a, np.zeros((2, 2, 1)), period=p, states=names), decay=1.5, damping=0.6)
            for a, p in ((self.CLOSED, None), (sampled, period))
        ]
        loop = self.loop_for(np.array([-1.0, -2.0]))
        np.testing.assert_allclose(*(np.sort(np.asarray(one.excess(loop, {}))) for one in both), rtol=1e-9)

    @pytest.mark.slow
    def test_the_derivative_in_the_gain(self):
        a, b = SlipModel().matrices()
        system = Polytope(a[None], b[None], states=SlipModel().states)

        def excess(k):
            return Poles(system, decay=50.0, damping=0.8).excess(self.loop_for(k), {})

        k, h = jnp.array([-11753.0, -48.0]), 1e-3
        slope = jax.jacfwd(excess)(k)
        for i in range(2):
            e = h * np.eye(2)[i]
            np.testing.assert_allclose(slope[:, i], (excess(k + e) - excess(k - e)) / (2 * h), rtol=1e-6, atol=1e-10)


class TestCertifiedDecay:
    """s^2 + (1 - k2) s - k1: of one system the decay that can be proved is that of its slowest mode."""

    NAMES = ("integral of slip error", "slip error")
    SYSTEM = Polytope(np.array([[[0.0, 1.0], [0.0, -1.0]]]), np.array([[[0.0], [1.0]]]), states=NAMES)

    def excess(self, gain, decay):
        loop = dataclasses.replace(RIG, controller=controllers.StateFeedback(gain=jnp.asarray(gain)))
        return CertifiedDecay(self.SYSTEM, decay).excess(loop, {})

    def test_is_what_is_missing_relative_to_what_is_asked(self):
        gain = np.array([-6.0, -4.0])  # poles -2 and -3
        np.testing.assert_allclose(self.excess(gain, 3.0), [1 / 3], rtol=1e-5)
        np.testing.assert_allclose(self.excess(gain, 0.5), [-1.5], rtol=1e-5)

    @pytest.mark.slow
    def test_its_slope_is_that_of_the_slowest_pole(self):
        slope = jax.jacfwd(lambda k: self.excess(k, 3.0)[0])(jnp.array([-6.0, -4.0]))
        # (2 s + 1 - k2) ds = s dk2 + dk1 at s = -2, and decay = -s
        np.testing.assert_allclose(slope, [1 / 3, -2 / 3], rtol=1e-4)

    def test_an_unstable_gain_falls_short_by_its_growth(self):
        np.testing.assert_allclose(self.excess(np.array([6.0, 0.0]), 1.0), [3.0], rtol=1e-5)  # poles 2 and -3


class TestWeights:
    @pytest.mark.slow
    @killed_by("tune.weights", "root = root + jnp.diag(diagonal)", "root = jnp.diag(diagonal)")
    def test_the_gain_is_that_of_the_riccati_equation(self):
        model = SlipModel(speed=20 / 3.6)
        q = np.array([[1e6, 2e3], [2e3, 1e4]])
        loop = lq_weights(RIG, q, 2.0, lqr_gain_design(model))
        np.testing.assert_allclose(loop.weights()[0], q, rtol=1e-12)
        a, b = (np.asarray(x) for x in model.matrices())
        k = -b.T @ solve_continuous_are(a, b, q, np.array([[2.0]])) / 2.0
        np.testing.assert_allclose(loop.closed_loop().controller.gain, k[0], rtol=1e-8)

    @pytest.mark.slow
    def test_its_derivative(self):
        loop = lq_weights(RIG, (1e6, 1e4), 1.0, lqr_gain_design(SlipModel(speed=20 / 3.6)))

        def gain(x):
            values = {"log_diagonal": x[:2], "lower": x[2:3], "log_effort": x[3]}
            return d.replace(loop, values).closed_loop().controller.gain

        x, h = jnp.concatenate([loop.log_diagonal, loop.lower + 30.0, jnp.zeros(1)]), 1e-5
        slope = jax.jacfwd(gain)(x)
        np.testing.assert_allclose(slope, jax.jacrev(gain)(x), rtol=1e-9)
        for i in range(4):
            e = h * np.eye(4)[i]
            np.testing.assert_allclose(slope[:, i], (gain(x + e) - gain(x - e)) / (2 * h), rtol=1e-6)

    @pytest.mark.parametrize(("q", "r"), [((1.0, 0.0), 1.0), ((1.0, 1.0), 0.0), ([[1.0, 2.0], [2.0, 1.0]], 1.0)])
    def test_refuses_what_has_no_logarithm(self, q, r):
        with pytest.raises(ValueError, match="is not positive definite"):
            lq_weights(RIG, q, r, lqr_gain_design(SlipModel()))

    @killed_by(
        "tune.weights",
        'log_diagonal: Vector = param(default=(0.0, 0.0), unit="1", free=True)',
        'log_diagonal: Vector = param(default=(0.0, 0.0), unit="1")',
    )
    @killed_by("tune.weights", "if shapes != ((n,), (n * (n - 1) // 2,)):", "if False:")
    def test_any_number_of_states(self):
        loop = lq_weights(RIG, np.ones(4), 1.0, lqr_gain_design(SlipModel()))
        assert not list(find_problems(loop))
        fewer, square = (
            dataclasses.replace(loop, **one) for one in ({"lower": np.zeros(3)}, {"log_diagonal": np.eye(4)})
        )
        needs = "n states need (n,), (n (n - 1)/2,)"
        assert list(find_problems(fewer)) == [f"log_diagonal and lower have shapes (4,), (3,); {needs}"]
        assert list(find_problems(square)) == [f"log_diagonal and lower have shapes (4, 4), (6,); {needs}"]

    @killed_by("tune.weights", 'q = as_weight_matrix("Q", Q, len(np.atleast_1d(Q)), definite=True)', "q = Q")
    @killed_by("tune.weights", 'r = as_weight_matrix("R", R, 1, definite=True)', "r = np.array([[R]])")
    @pytest.mark.parametrize(
        ("q", "r", "message"),
        [
            ([[2.0, 1.0], [0.0, 2.0]], 1.0, "Q = .* is not symmetric"),
            ((1.0, 1.0), np.inf, "R = .* has an entry that is not finite"),
        ],
        ids=["asymmetric", "infinite"],
    )
    def test_refuses_what_lqr_refuses(self, q, r, message):
        with pytest.raises(ValueError, match=message):
            lq_weights(RIG, q, r, lqr_gain_design(SlipModel()))


class TestSpeedScaled:
    MODEL = SlipModel(actuator=actuators.Lag(time_constant=1e-3), sampling=Sampling(period=1e-3))

    @pytest.mark.slow
    def test_at_a_frozen_speed_it_is_the_same_loop(self):
        """w = K z is u = (v/v0) K x, so closed loops are similar: the same poles."""
        gain, v = np.array([[-8000.0, -200.0, 0.1, -0.2]]), 4.0
        scaled = SpeedScaled(model=dataclasses.replace(self.MODEL, speed=v), reference_speed=10.0)
        (a, b), (az, bz) = scaled.model.matrices(), scaled.matrices()
        turned = gain * np.array([0.4, 0.4, 1.0, 1.0])  # the torques among the states are themselves in units of v/v0
        poles = [np.sort_complex(np.linalg.eigvals(m)) for m in (az + bz @ gain, a + b @ turned)]
        np.testing.assert_allclose(*poles, atol=1e-12)

    @killed_by(
        "robust.design.speed_scaled", "jnp.where(torque, 1 + scaled.fall, 1.0) / s", "jnp.where(torque, 1.0, 1.0) / s"
    )
    @pytest.mark.slow
    def test_a_falling_speed_is_followed_step_by_step(self):
        """Two periods, from v to v+: the physical states, brought to z with the speed of their own instant."""
        v0, speeds = 10.0, (6.0, 5.9, 5.75)
        gain = np.array([-8000.0, -200.0])
        x = np.array([1e-3, 0.05, 1.0, 1.2])
        z = x / np.array([1, 1, speeds[0] / v0, speeds[0] / v0])
        for v, after in itertools.pairwise(speeds):
            model = dataclasses.replace(self.MODEL, speed=v)
            a, b = (np.asarray(m) for m in model.matrices())
            x = a @ x + b[:, 0] * (v / v0) * (gain @ x[:2])
            scaled = SpeedScaled(model=model, reference_speed=v0, fall=v / after - 1)
            az, bz = (np.asarray(m) for m in scaled.matrices())
            z = az @ z + bz[:, 0] * (gain @ z[:2])
            np.testing.assert_allclose(z * np.array([1, 1, after / v0, after / v0]), x, rtol=1e-12)

    def test_the_greatest_fall(self):
        v, a, period = 1.4, 7.9, 1e-3
        np.testing.assert_allclose(greatest_speed_fall(a, v, period), v / (v - a * period) - 1, rtol=1e-12)

    def test_refuses_continuous_time(self):
        with pytest.raises(ValueError, match=r"model.sampling is continuous"):
            SpeedScaled().matrices()


BOX = {"plant.mass": (4.0, 8.0), "plant.road.w4": (0.3, 0.5), "actuator.time_constant": (5e-4, 4e-3)}


@killed_by(
    "tune.worst",
    "math.isclose(self.value, self.corner, rel_tol=CORNER_TOLERANCE)",
    "self.value <= self.corner * (1 + CORNER_TOLERANCE)",
)
@killed_by("tune.worst", "if math.isclose(self.value, self.corner, rel_tol=CORNER_TOLERANCE):", "if False:")
@pytest.mark.parametrize(
    ("value", "corner", "screened", "words"),
    [
        (0.3, 0.3, 0.3, "That is a corner of the box: running its 4 corners finds it."),
        (-0.3, -0.3, -0.3, "That is a corner of the box: running its 4 corners finds it."),
        (0.3, 0.2, 0.3, "That is one of the points that were run first (worst corner 0.2)."),
        (-0.3, -0.4, -0.3, "That is one of the points that were run first (worst corner -0.4)."),
        (
            0.3,
            0.2,
            0.25,
            "Gradients found it from 0.25, the worst of the points that were run first (worst corner 0.2).",
        ),
    ],
)
def test_a_worst_case_says_what_found_it(value, corner, screened, words):
    """A worst case at a corner is no merit of gradients."""
    found = WorstCase(
        metric="m", values={"a": 1.0, "b": 2.0}, value=value, corners=4, corner=corner, screened=screened,
        metrics={}, loop=None, rollouts=40.0, bound=value - 0.2, diverged=None, reasons=[],
    )  # fmt: skip
    assert found.report() == f"COUNTEREXAMPLE: m = {value} at a = 1.0, b = 2.0, beyond {value - 0.2:g} by 0.2. {words}"
    assert words in dataclasses.replace(found, bound=None).report()
    some = dataclasses.replace(found, corners=3).report()
    assert ("one of the 3 corners (of 4) that were run" in some) or (f"(worst corner {corner}, 3 of 4 run)" in some)


@pytest.mark.slow
@pytree
class Shortness(FinalValue):
    """-distance: what is greatest somewhere within."""

    unit = "m"
    physical = (-np.inf, 0.0)

    def value(self, memory, ending):
        """-distance."""
        return -ending.sample.output.distance


@pytree
class Farness(Shortness):
    """The distance."""

    physical = (0.0, np.inf)

    def value(self, memory, ending):
        """The distance."""
        return ending.sample.output.distance


@jax.custom_jvp
def limit_plain(value, limit):
    """Return the value; without a derivative, NaN above the limit."""
    return jnp.where(value > limit, jnp.nan, value)


limit_plain.defjvp(lambda values, tangents: (values[0], tangents[0]))


@pytree
class Limited(Shortness):
    """-distance, which only runs with derivatives measure above the limit."""

    limit: float = param(default=0.0, unit="m")

    def value(self, memory, ending):
        """-distance or NaN."""
        return limit_plain(-ending.sample.output.distance, self.limit)


SLIPS = {"reference.slip": (0.08, 0.4)}
COARSE = d.FixedStep(2e-3, 0.05)
# Of two corners as of two ends, so that one program is compiled for both.
TWO_ASCENTS = {"over": SLIPS, "metric": "short", "solver": COARSE, "screen": 0, "starts": 2, "iterations": 3}


class TestWorstCase:
    @pytest.mark.slow
    @killed_by(
        "tune.worst",
        "run_batch(loop, batch, solver,",
        "run_batch(loop, batch, dataclasses.replace(solver, kinks=True),",
    )
    @killed_by("tune.worst", "    if len(ends):\n", "    if False:\n")
    def test_the_value_is_that_of_a_plain_run(self):
        """Steps of an ascent end on kinks, here worth more than what the ascent gains."""
        measured = {"short": Limited()}
        found = worst_case(RIG, **TWO_ASCENTS, measured=measured, price=1e-6)
        plain = d.measure(found.loop, COARSE, measured).metrics["short"]
        np.testing.assert_allclose([found.value, found.metrics["short"]], plain, rtol=1e-12)
        assert found.screened < found.value
        np.testing.assert_allclose(found.rollouts, 2 + 2, rtol=1e-4)  # corners and ends

    @pytest.mark.slow
    @killed_by(
        "tune.worst",
        "np.flatnonzero(runs.diverged | np.isnan(runs.metrics[metric]))",
        "np.flatnonzero((runs.diverged | np.isnan(runs.metrics[metric]))[:screened])",
    )
    def test_an_end_that_diverges_is_a_counterexample(self):
        measured = {"short": Limited(limit=-0.39083)}  # above both corners
        found = worst_case(RIG, **TWO_ASCENTS, measured=measured, bound=0.0)
        assert found.value == found.corner < 0
        assert found.met is False
        assert 0.08 < found.diverged["reference.slip"] < 0.4
        assert found.report().startswith("COUNTEREXAMPLE: the run diverges at reference.slip = ")

    @killed_by("tune.worst", "if len(ends) != 2 or not np.isfinite(ends).all():", "if len(ends) != 2:")
    @killed_by("tune.worst", "or count < 0:", "or False:")
    @pytest.mark.parametrize(
        ("change", "message"),
        [
            ({"metric": "iea"}, "iea is not measured; there is stop_time"),
            ({"bound": np.nan}, r"bound = nan is outside \(-inf, inf\) s"),
            ({"starts": -1}, r"starts = -1 is no whole number in \[0, inf\)"),
            ({"screen": -1}, r"screen = -1 is no whole number in \[0, inf\)"),
            ({"iterations": 1.5}, r"iterations = 1.5 is no whole number in \[0, inf\)"),
            ({"over": {}}, "no parameter is free"),
            ({"over": {"plant.mas": (5.0, 6.0)}}, "plant.mas is not a parameter; there is plant.mass"),
            ({"over": {"plant.mass": (6.0, 5.0)}}, r"plant.mass: the range \[6, 5\] is empty"),
            (
                {"over": {"plant.mass": None}},
                r"over: plant.mass = None is not a pair \(low, high\) of finite numbers in \(0, inf\) kg",
            ),
            ({"over": {"plant.mass": (5.0,)}}, r"over: plant.mass = \(5.0,\) is not a pair"),
            ({"over": {"plant.mass": (5.0, np.inf)}}, r"over: plant.mass = \(5.0, inf\) is not a pair"),
            ({"over": {"plant.mass": ("a", "b")}}, r"over: plant.mass = \('a', 'b'\) is not a pair"),
            (
                {"over": {"controller.gain": (np.zeros(3), np.ones(3))}},
                r"of finite numbers of shape \(2,\) in \(-inf, inf\) N m/s",
            ),
        ],
    )
    def test_says_which_request_does_not_fit(self, change, message):
        given = {"over": BOX, "metric": "iae", "solver": SOLVER}
        with pytest.raises(ValueError, match=message):
            worst_case(RIG, **given | change)

    @pytest.mark.slow
    def test_it_is_at_least_as_bad_as_a_thousand_samples(self):
        measured = {"max_slip": BRAKING["max_slip"]}
        found = worst_case(
            RIG, over=BOX, metric="max_slip", solver=SOLVER, measured=measured, bound=0.25, screen=16, starts=3
        )
        low, high = np.array(list(BOX.values())).T
        points = low + (high - low) * np.random.default_rng(0).random((1000, 3))
        run = jax.jit(
            jax.vmap(lambda p: d.measure(d.replace(RIG, dict(zip(BOX, p, strict=True))), SOLVER, measured).metrics)
        )
        assert found.value >= float(jnp.max(run(points)["max_slip"]))
        assert found.rollouts < 400
        np.testing.assert_allclose(d.measure(found.loop, SOLVER, measured).metrics["max_slip"], found.value, rtol=1e-9)
        assert found.met is (found.value <= 0.25)
        corners = np.array(list(itertools.product(*BOX.values())))
        assert found.corners == len(corners) == 8
        np.testing.assert_allclose(found.corner, np.max(run(corners)["max_slip"]), rtol=1e-9)
        assert found.corner <= found.screened <= found.value
        assert found.report().startswith("COUNTEREXAMPLE: max_slip" if not found.met else "No counterexample in")

    @killed_by("tune.worst", "for lane in lanes if lane.reason is not Reason.START]", "for lane in []]")
    @pytest.mark.slow
    def test_the_ascent_finds_what_lies_between_the_points(self):
        """The shortest way of all slips, beside a thousand of them: at no corner."""
        measured = {"short": Shortness()}
        found = worst_case(RIG, over=SLIPS, metric="short", solver=SOLVER, measured=measured, screen=3, starts=2)
        lanes = d.Batch({"reference.slip": np.linspace(0.08, 0.4, 1000)})
        best = float(np.max(d.run_batch(RIG, lanes, SOLVER, measured).metrics["short"]))
        assert found.screened < best <= found.value + 1e-9

    @pytest.mark.slow
    def test_points_without_gradients(self):
        """Any number of points, the first of Sobol's."""
        found = worst_case(RIG, over=BOX, metric="iae", solver=SOLVER, screen=9, starts=0)
        low, high = np.array(list(BOX.values())).T
        points = low + (high - low) * qmc.Sobol(3, rng=np.random.default_rng(0)).random(16)[:9]
        points = np.concatenate([np.array(list(itertools.product(*BOX.values()))), points])
        lanes = d.Batch(dict(zip(BOX, points.T, strict=True)))
        worst = float(np.max(d.run_batch(RIG, lanes, SOLVER, BRAKING).metrics["iae"]))
        np.testing.assert_allclose([found.value, found.rollouts], [worst, len(points)], rtol=1e-12)

    @killed_by(
        "tune.worst", "np.random.default_rng(seed).permuted(both, axis=0)", "both[:1].repeat(64, 0)", case="last"
    )
    @killed_by(
        "tune.worst", "itertools.product(*ranges[:FULL_CORNERS])", "itertools.product(*ranges[-6:])", case="first"
    )
    @pytest.mark.slow
    @pytest.mark.parametrize("place", ["first", "last"])
    def test_corners_of_many_numbers_reach_every_end(self, place):
        """A car that starts faster goes farther in the first hundredth of a second, whatever the other six numbers."""
        others = {"controller.gain": ((-3100.0, -61.0), (-2900.0, -59.0)), "reference.slip": (0.15, 0.25)}
        speed, others = {"initial.speed": (8.0, 9.0)}, others | BOX
        box = speed | others if place == "first" else others | speed
        measured = {"far": Farness()}
        found = worst_case(
            RIG, over=box, metric="far", solver=d.FixedStep(5e-4, 0.01), measured=measured, screen=0, starts=0
        )
        assert found.values["initial.speed"] == 9.0
        assert found.corners == 64
        assert "it is one of the 64 corners (of 128) that were run" in found.report()

    @killed_by("tune.worst", "price * sum(lane.evaluations for lane in lanes)", "price * len(lanes)")
    @pytest.mark.slow
    def test_every_gradient_is_counted(self, monkeypatch):
        """Of one ascent: each evaluation with a gradient is one point."""
        made, evaluator = [], Problem.evaluator

        def counted(problem, scale):
            evaluate = evaluator(problem, scale)
            return lambda z, m: made.append(len(z)) or evaluate(z, m)

        monkeypatch.setattr(Problem, "evaluator", counted)
        given = {"metric": "far", "measured": {"far": Farness()}, "screen": 0, "starts": 1, "iterations": 2}
        found = worst_case(RIG, over={"initial.speed": (8.0, 9.0)}, solver=COARSE, **given, price=10.0)
        assert found.rollouts == 2 + 1 + 10 * sum(made)  # corners, the end, gradients
        assert sum(made) > 2

    @pytest.mark.slow
    def test_the_report_says_what_is_known(self):
        """Of runs that another test has compiled."""
        given = {"measured": {"max_slip": BRAKING["max_slip"]}, "screen": 16, "starts": 3, "iterations": 1}
        found = worst_case(RIG, over=BOX, metric="max_slip", solver=SOLVER, bound=1.0, **given)
        assert found.met
        assert "proved stable over the box" in found.report(True)
        assert "No certificate covers the box" in found.report(False)
