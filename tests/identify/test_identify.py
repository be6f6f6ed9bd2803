"""Least squares and covariance on problems with known answers; traces and tables against runs of known parameters."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest
from mutants import killed_by
from scipy.optimize import curve_fit

import diffabs as d
from diffabs import controllers, objectives, plants, references, roads, stops
from diffabs.core.pytree import param, pytree, replace
from diffabs.core.reason import Reason
from diffabs.core.types import Scalar
from diffabs.loop.stability import stable_step
from diffabs.scenario.defaults import braking
from diffabs.tune.identify.data import Comparison
from diffabs.tune.identify.fit import Tolerances, fit
from diffabs.tune.identify.identification import identify
from diffabs.tune.identify.residuals import gaussian
from diffabs.tune.identify.table import Table
from diffabs.tune.identify.traces import Traces, _keep_instants

X = np.linspace(0.0, 3.0, 13)
NOISE = np.random.default_rng(3).standard_normal(13)
SIGMA = 0.1 + 0.05 * X


@pytree
class Decay:
    """a exp(-k x) + c."""

    a: Scalar = param(default=1.0, unit="1")
    k: Scalar = param(default=0.5, unit="1", above=0.0)
    c: Scalar = param(default=0.1, unit="1", low=-1.0, high=1.0)


@pytree
class Line:
    """a + c x."""

    a: Scalar = param(default=1.0, unit="1")
    c: Scalar = param(default=0.1, unit="1")


def decay(x, a, k, c):
    return a * np.exp(-k * x) + c


def decay_residuals(part, x, y):
    return part.a * jnp.exp(-part.k * x) + part.c - y


def line_residuals(part, x, y):
    return part.a + part.c * x - y


DATA = (X, decay(X, 2.0, 1.3, 0.3) + SIGMA * NOISE)
LINE = (X, 0.7 + 0.4 * X + SIGMA * NOISE)


class TestFit:
    @pytest.mark.parametrize("after", [1, 2, 4])
    def test_interrupted_it_keeps_the_last_accepted_point(self, after):
        told = []
        starts = [{"k": 0.5}, {"k": 5.0}]
        found = fit(
            Decay(),
            ["a", "k", "c"],
            decay_residuals,
            data=DATA,
            sigma=SIGMA,
            starts=starts,
            progress=lambda evaluations, cost: told.append((evaluations, cost)),
            stopping=lambda: len(told) >= after,
        )
        assert found.reason is Reason.INTERRUPTED
        assert len(told) == after
        assert len(found.starts) == 1
        values = {name: float(value) for name, value in found.values.items()}
        cost = np.sum(((decay(X, **values) - DATA[1]) / SIGMA) ** 2)
        np.testing.assert_allclose([found.cost, told[-1][1]], cost, rtol=1e-9, atol=0)
        assert told[-1][0] >= after

    @killed_by(
        "tune.identify.uncertainty",
        "jacobian = (data * size / scale)[:, free]",
        "jacobian = (data * size)[:, free]",
        case="False",
    )
    @pytest.mark.parametrize("absolute", [True, False])
    def test_a_line_has_the_closed_form_and_its_covariance(self, absolute):
        found = fit(Decay(), ["a", "c"], line_residuals, data=LINE, sigma=SIGMA, absolute=absolute)
        A, b = np.stack([1 / SIGMA, X / SIGMA], axis=1), LINE[1] / SIGMA
        best = np.linalg.solve(A.T @ A, A.T @ b)
        chi2 = np.sum((A @ best - b) ** 2)
        covariance = np.linalg.inv(A.T @ A) * (1.0 if absolute else chi2 / (13 - 2))
        np.testing.assert_allclose([found.values["a"], found.values["c"]], best, rtol=1e-7, atol=0)
        np.testing.assert_allclose(found.uncertainty.covariance, covariance, rtol=1e-6, atol=0)
        np.testing.assert_allclose(found.chi2, chi2, rtol=1e-9, atol=0)
        np.testing.assert_allclose(found.uncertainty.deviations["c"], np.sqrt(covariance[1, 1]), rtol=1e-6, atol=0)
        np.testing.assert_allclose(np.diag(found.uncertainty.correlation), 1.0, rtol=1e-12, atol=0)

    @killed_by(
        "tune.identify.fit",
        "over = np.divide(1.0, slope, out=np.zeros_like(slope), where=slope != 0)",
        "over = np.ones_like(slope)",
    )
    @pytest.mark.parametrize("sigma", [SIGMA, None])
    def test_a_curve_and_its_covariance_are_those_of_scipy(self, sigma):
        found = fit(Decay(), ["a", "k", "c"], decay_residuals, data=DATA, sigma=sigma)
        best, covariance = curve_fit(
            decay, *DATA, [1, 0.5, 0.1], sigma, sigma is not None, ftol=1e-13, xtol=1e-13, gtol=1e-13
        )
        np.testing.assert_allclose(list(found.values.values()), best, rtol=1e-6, atol=0)
        np.testing.assert_allclose(found.uncertainty.covariance, covariance, rtol=1e-4, atol=0)  # theirs: differences
        assert found.part.k == found.values["k"]
        assert found.uncertainty.names == ["a", "k", "c"]
        assert found.history[-1] == pytest.approx(found.cost, rel=1e-9)
        assert all(np.diff(found.history) <= 0)
        assert found.reason in (Reason.GRADIENT, Reason.CHANGE)
        assert found.start == {"a": 1.0, "k": 0.5, "c": pytest.approx(0.1)}

    @killed_by(
        "tune.identify.uncertainty",
        "np.concatenate([jacobian, (prior * size)[:, free]])",
        "np.concatenate([jacobian, (0 * prior)[:, free]])",
    )
    def test_a_gaussian_prior_has_the_closed_form(self):
        prior = gaussian({"c": (0.2, 0.05)})
        found = fit(Decay(), ["a", "c"], line_residuals, data=LINE, sigma=SIGMA, prior=prior)
        A, b = np.stack([1 / SIGMA, X / SIGMA], axis=1), LINE[1] / SIGMA
        A, b = np.concatenate([A, [[0, 20.0]]]), np.concatenate([b, [20 * 0.2]])
        np.testing.assert_allclose(list(found.values.values()), np.linalg.solve(A.T @ A, A.T @ b), rtol=1e-6, atol=0)
        np.testing.assert_allclose(found.uncertainty.covariance, np.linalg.inv(A.T @ A), rtol=1e-6, atol=0)
        assert len(found.residuals) == 13

    def test_a_prior_replaces_missing_data_only(self):
        prior = gaussian({"a": (1.0, 0.1), "k": (0.5, 0.1), "c": (0.1, 0.1)})
        few = tuple(x[:2] for x in DATA)
        found = fit(Decay(), ["a", "k", "c"], decay_residuals, data=few, sigma=0.1, prior=prior)
        assert np.isinf(found.uncertainty.directions[-1].spread)
        assert max(found.uncertainty.deviations.values()) < 0.1001

    def test_a_redundant_pair_is_named(self):
        def product(part, x, y):
            return part.a * part.k * jnp.exp(-x) + part.c - y

        found = fit(Decay(a=2.0), ["a", "k", "c"], product, data=DATA, sigma=SIGMA)
        (open_,) = found.uncertainty.undetermined_directions()
        assert np.isinf(open_.spread)
        a, k = abs(float(found.values["a"])), float(found.values["k"])
        expected = np.array([1.0, -1.0, 0.0]) / np.array([max(a, 2.0) / a, 1.0, 1.0])  # sizes: |a| or its scale; k
        expected /= np.linalg.norm(expected)
        components = np.array(list(open_.components.values()))
        np.testing.assert_allclose(np.abs(components @ expected), 1.0, rtol=0, atol=1e-6)
        assert components[0] * components[1] < 0
        assert "a" in open_.describe()
        assert k > 0
        assert found.uncertainty.correlation[0, 1] == pytest.approx(-1.0, abs=1e-6)
        assert found.uncertainty.singular[-1] < 1e-9 * found.uncertainty.singular[0]

    @killed_by("tune.identify.fit", "if far > END_COORDINATE and", "if False and")
    @pytest.mark.parametrize(("low", "high"), [(0.5, 1.0), (0.5, 50.0), (0.5, np.inf)])
    def test_a_value_at_an_end_of_its_range_has_no_deviation(self, low, high):
        """The best slope is about 0.4, below the range: c stays at 0.5, and a is the mean of the rest of the line."""
        found = fit(Line(c=0.8), {"a": None, "c": (low, high)}, line_residuals, data=LINE, sigma=SIGMA)
        weight = 1 / SIGMA**2
        assert found.ends == {"c": 0.5}
        np.testing.assert_allclose(found.values["c"], 0.5, rtol=1e-8)
        np.testing.assert_allclose(found.values["a"], np.average(LINE[1] - 0.5 * X, weights=weight), rtol=1e-6)
        assert np.isnan(found.uncertainty.deviations["c"])
        np.testing.assert_allclose(found.uncertainty.deviations["a"], np.sum(weight) ** -0.5, rtol=1e-9)
        np.testing.assert_array_equal(np.isnan(found.uncertainty.covariance), [[False, True], [True, True]])
        assert [one.components.keys() for one in found.uncertainty.directions] == [{"a"}]
        assert "c          0.8     0.5         end of range" in str(found)
        assert "c is at the end 0.5 of its range, so it has no standard deviation" in str(found)

    @killed_by("tune.identify.fit", "abs(value - end) * slope < MAX_END_DISTANCE", "True")
    def test_far_from_a_start_is_not_at_an_end(self):
        """0.4 is 4e-6 of the start's distance from the end 0, but many standard deviations away from it."""
        best, found = (fit(Line(c=c), {"c": (0.0, np.inf)}, line_residuals, data=LINE, sigma=SIGMA) for c in (0.5, 1e5))
        assert found.ends == {}
        np.testing.assert_allclose(found.values["c"], best.values["c"], rtol=1e-6)
        np.testing.assert_allclose(found.uncertainty.deviations["c"], best.uncertainty.deviations["c"], rtol=1e-6)

    @killed_by("tune.identify.fit", "slope * size > 1 and ", "", case="beside an end")
    @pytest.mark.parametrize("low", [0.1, 0.4999], ids=["far from an end", "beside an end"])
    def test_a_value_without_influence_is_undetermined_and_not_at_an_end(self, low):
        found = fit(Decay(), {"a": None, "k": (low, 10.0)}, line_residuals, data=LINE, sigma=SIGMA)
        assert found.ends == {}
        assert found.describe_deviation("k") == "undetermined"

    def test_a_value_that_is_held_alone_and_one_near_an_end_by_a_true_minimum(self):
        held = fit(Decay(c=0.8), {"c": (0.7, 1.0)}, line_residuals, data=LINE, sigma=SIGMA)
        assert held.ends == {"c": 0.7}
        assert held.uncertainty.directions == []
        best = fit(Decay(), ["c"], line_residuals, data=LINE, sigma=SIGMA)
        near = float(best.values["c"]) - 0.1 * best.uncertainty.deviations["c"]
        inside = fit(Decay(c=0.8), {"c": (near, 1.0)}, line_residuals, data=LINE, sigma=SIGMA)
        assert inside.ends == {}
        np.testing.assert_allclose(inside.uncertainty.deviations["c"], best.uncertainty.deviations["c"], rtol=1e-4)

    def test_ranges_of_lists_may_have_a_number_as_one_end(self):
        @pytree
        class Pair:
            x: Scalar = param(default=(1.0, 2.0), unit="1")

        found = fit(Pair(), {"x": (0.0, np.array([3.0, 4.0]))}, lambda part: part.x - jnp.array([2.0, 9.0]), sigma=1.0)
        assert found.ends == {"x.1": 4.0}
        assert str(found).count("x.") == 3  # two rows and a note
        np.testing.assert_allclose(found.uncertainty.deviations["x.0"], 1.0, rtol=1e-9)

    @killed_by("tune.identify.fit", "in self.uncertainty.undetermined_parameters()", "in ()")
    def test_the_table_says_what_is_undetermined(self):
        def product(part, x, y):
            return part.a * part.k * jnp.exp(-x) + part.c - y

        found = fit(Decay(a=2.0), ["a", "k", "c"], product, data=DATA, sigma=SIGMA)
        assert found.uncertainty.undetermined_parameters() == ["a", "k"]
        assert str(found).count(" undetermined") == 2
        (open_,) = found.uncertainty.undetermined_directions()
        assert f"the data do not determine {open_.describe()} (relative changes)" in str(found)
        prior = gaussian({"a": (2.0, 0.1)})
        known = fit(Decay(a=2.0), ["a", "k", "c"], product, data=DATA, sigma=SIGMA, prior=prior)
        assert known.uncertainty.undetermined_parameters() == []
        assert "the data do not determine" in str(known)  # the prior does

    def test_a_step_into_nowhere_is_shortened(self):
        tried = []

        def logarithm(part):
            return jnp.log(jnp.where(part.a > 0.05, part.a, jnp.nan))[None] - jnp.log(0.1)

        def seen(part):
            tried.append(float(part.a))
            return True

        found = fit(Decay(a=5.0), ["a"], logarithm, sigma=1.0, usable=seen)
        assert min(tried) <= 0.05
        np.testing.assert_allclose(found.values["a"], 0.1, rtol=1e-8, atol=0)
        assert found.evaluations == len(tried)

    def test_a_part_that_is_not_usable_is_not_taken(self):
        found = fit(
            Decay(), ["a"], lambda part: jnp.stack([part.a - 5.0]), sigma=1.0, usable=lambda part: part.a <= 3.0
        )
        assert 1.5 < found.values["a"] <= 3.0

    @killed_by("tune.identify.residuals", "return evaluation if evaluation.finite() else None", "return evaluation")
    def test_the_best_start_wins_and_the_others_are_kept(self):
        def well(part):
            return jnp.where(part.a > 10, jnp.nan, (part.a**2 - 4) * (part.a + 3))[None]

        starts = [{"a": -8.0}, {"a": 1.0}, {"a": 20.0}]
        found = fit(Decay(), ["a"], well, sigma=1.0, starts=starts)
        assert [float(one.start["a"]) for one in found.starts] == [-8.0, 1.0]
        assert [float(one["a"]) for one in found.diverged] == [20.0]
        assert found.cost == min(one.cost for one in found.starts)

    def test_a_high_norm_comes_near_to_the_least_greatest_residual(self):
        y = np.array([0.0, 0.0, 0.0, 1.0])
        two, many = (fit(Decay(), ["a"], lambda p, y: p.a - y, data=(y,), sigma=1.0, norm=n) for n in (2.0, 40.0))
        np.testing.assert_allclose(two.values["a"], 0.25, rtol=1e-8, atol=0)
        np.testing.assert_allclose(many.values["a"], 0.5, rtol=0, atol=0.02)

    def test_other_data_do_not_compile_again(self):
        calls = []

        def counted(part, x, y):
            calls.append(1)
            return decay_residuals(part, x, y)

        for shift in (0.0, 0.1):
            fit(
                Decay(),
                ["a", "k"],
                counted,
                data=(DATA[0], DATA[1] + shift),
                sigma=SIGMA,
                prior=gaussian({"a": (shift, 1)}),
            )
        assert len(calls) <= 3  # traced once, and once per fit for its shape

    @killed_by("tune.identify.fit", "if k and estimated:", "if k and sigma is None:")
    @killed_by("tune.identify.fit", "    check_prior(prior, [entry.path for entry in where.entries])\n", "")
    @pytest.mark.parametrize(
        ("changed", "message"),
        [
            ({"sigma": 0.0}, "sigma = 0 is not positive and finite"),
            ({"sigma": np.ones(3)}, r"sigma has shape \(3,\); 13 residuals need a number or \(13,\)"),
            ({"norm": 1.0}, r"norm = 1 is outside \[2, inf\)"),
            ({"sigma": None, "prior": gaussian({"a": (0.0, 1.0)})}, "a prior needs sigma: nothing"),
            ({"absolute": False, "prior": gaussian({"a": (0.0, 1.0)})}, "a prior needs sigma with absolute = True"),
            ({"free": ["a", "k"], "prior": gaussian({"c": (0.2, 0.1)})}, "c: a prior, but not free; free are a, k"),
            (
                {"data": tuple(x[:2] for x in DATA)},
                "2 data do not determine 3 parameters: free fewer, or state a prior",
            ),
            (
                {"data": tuple(x[:3] for x in DATA), "absolute": False},
                "3 data do not determine 3 parameters and one more",
            ),
            (
                {"data": (X, np.full(13, np.nan))},
                "the run diverges, slides along a switching surface, or its step is not stable, at each of the 1",
            ),
            ({"free": ["q"]}, "q is not a parameter; there is a, k, c"),
            ({"free": {"k": "1:5"}}, r"k: the range '1:5' is not a pair \(low, high\) of numbers"),
            ({"free": {"k": 5.0}}, "k: the range 5.0 is not a pair"),
            ({"free": {"k": ("1", 5.0)}}, r"k: the range \('1', 5.0\) is not a pair \(low, high\) of numbers"),
            ({"starts": [{"k": -1.0}]}, r"k = -1 is outside \(0, inf\)"),
        ],
    )
    def test_what_does_not_fit_is_named(self, changed, message):
        arguments = {"free": ["a", "k", "c"], "data": DATA, "sigma": 0.1, **changed}
        with pytest.raises(ValueError, match=message):
            fit(Decay(), residuals=decay_residuals, **arguments)

    @killed_by("tune.identify.residuals", "if not np.isfinite(np.asarray(mean, float)).all()", "if False")
    @pytest.mark.parametrize(
        ("known", "message"),
        [
            ((1.0, 0.0), "a: the prior's standard deviation is 0; it must be positive"),
            ((1.0, np.nan), "a: the prior's standard deviation is nan; it must be positive"),
            ((np.nan, 0.1), "a: the prior's mean is nan; it must be finite"),
            (("1", 0.1), "a: the prior's mean = '1' is text; it must be a number"),
        ],
    )
    def test_a_prior_without_width_or_place_is_an_error(self, known, message):
        with pytest.raises(ValueError, match=message):
            gaussian({"a": known})

    @killed_by("tune.identify.residuals", "if not distributions:", "if False:")
    def test_a_prior_without_parameters_is_an_error(self):
        with pytest.raises(ValueError, match="the prior has no parameter; leave the prior out"):
            gaussian({})

    def test_a_prior_of_one_element_of_a_list(self):
        """Two data 2 and 9 with deviation 1, and 1 +- 1 for the first: their mean 1.5."""

        @pytree
        class Pair:
            x: Scalar = param(default=(1.0, 2.0), unit="1")

        prior = gaussian({"x.0": (1.0, 1.0)})
        found = fit(Pair(), ["x"], lambda part: part.x - jnp.array([2.0, 9.0]), sigma=1.0, prior=prior)
        np.testing.assert_allclose(found.values["x"], [1.5, 9.0], rtol=1e-7)


ROAD = roads.Scaled(road=roads.MagicFormula(), scale=1.0)
LOOP = braking(
    plant=plants.QuarterCar(road=ROAD),
    reference=references.FixedSlip(),
    controller=controllers.ConstantTorque(torque=90.0),
    stop=stops.SpeedReached(speed=24.0),
)
SOLVER = d.FixedStep(step=1e-3, duration=0.6)
T = np.arange(0.0, 0.5, 1.3e-3)
HOLE = np.where(np.arange(len(T)) == 3, np.nan, T)
FREE = {"plant.inertia": (0.2, 5.0), "plant.road.scale": (0.3, 2.0)}


def noisy(loop, fields, sigmas, seed, **more):
    """Data of known parameters: a trace on a finer grid, and noise."""
    seen = d.rollout(loop, dataclasses.replace(SOLVER, step=5e-4)).trajectory
    draw = np.random.default_rng(seed)
    clean = {name: np.interp(T, seen.sample.t, getattr(seen.sample.output, name)) for name in fields}
    columns = {name: x + sigmas[name] * draw.standard_normal(len(T)) for name, x in clean.items()}
    return Traces(t=T, columns=columns, sigma=sigmas, **more)


class TestTraces:
    @pytest.mark.slow
    def test_known_parameters_are_recovered_within_three_deviations(self):
        truth = replace(LOOP, {"plant.inertia": 1.3, "plant.road.scale": 0.8})
        data = noisy(truth, ("wheel_speed", "speed"), {"wheel_speed": 0.05, "speed": 0.1}, seed=1)
        found = identify(LOOP, data, FREE, solver=SOLVER, tolerances=Tolerances(cost=1e-8))
        for path, value in {"plant.inertia": 1.3, "plant.road.scale": 0.8}.items():
            deviation = found.uncertainty.deviations[path]
            assert abs(found.values[path] - value) < 3 * deviation
            assert deviation < 0.02
        assert 0.85 < found.chi2 / found.uncertainty.degrees < 1.15  # sqrt(2/768) = .05
        left = data.residuals(found)
        assert left["speed"].shape == (1, len(T))
        np.testing.assert_allclose(np.std(left["speed"]), 0.1, rtol=0.15, atol=0)
        np.testing.assert_allclose(np.std(left["wheel_speed"]), 0.05, rtol=0.15, atol=0)

    @killed_by(
        "tune.identify.traces", "part = clamp(ratio(t - times[i], times[i + 1] - times[i]), 0.0, 1.0)", "part = 0.0 * t"
    )
    @pytest.mark.slow
    def test_the_output_is_interpolated_and_constant_after_the_end(self):
        t = np.array([0.0, 0.0103, 0.1999, 0.3, 0.41, 0.59])
        over = {"initial.speed": np.array([26.0, 30.0]), "plant.inertia": np.array([1.0, 1.2])}
        data = Traces(
            t=t, columns={"speed": np.zeros((2, 6)), "slip": np.ones((2, 6))}, sigma={"speed": 1, "slip": 1},
            over=over, until=[np.inf, 0.4],
        )  # fmt: skip
        solver = dataclasses.replace(SOLVER, every=4)
        against = data.against(LOOP, ["plant.road.scale"], solver)
        seen = against.residuals(LOOP, *against.data)
        expected = []
        for name, shift in (("speed", 0.0), ("slip", 1.0)):
            for i, kept in enumerate((t <= np.inf, t <= 0.4)):
                # a sparse record is not interpolated: every step is kept
                run = d.rollout(replace(LOOP, {path: x[i] for path, x in over.items()}), SOLVER)
                y = getattr(run.trajectory.sample.output, name)
                expected.append((np.interp(t, run.trajectory.sample.t, y) - shift)[kept])
        assert expected[0][-1] == pytest.approx(24.0, abs=1e-6)  # it has ended there
        np.testing.assert_allclose(seen, np.concatenate(expected), rtol=1e-12, atol=1e-12)

    @pytest.mark.slow
    def test_a_scale_and_the_peak_that_it_scales_are_not_told_apart(self):
        data = noisy(LOOP, ("wheel_speed",), {"wheel_speed": 0.05}, seed=2)
        free = ["plant.road.scale", "plant.road.road.D", "plant.inertia"]
        found = identify(LOOP, data, free, solver=SOLVER, tolerances=Tolerances(cost=1e-6))
        (open_,) = found.uncertainty.undetermined_directions()
        scale, peak, inertia = open_.components.values()
        assert open_.spread > 1e3
        assert scale * peak < 0
        assert abs(inertia) < 1e-6

    @killed_by("tune.identify.traces", '        check_sigma_table(self.sigma, "columns")\n', "")
    @pytest.mark.parametrize(
        ("changed", "message"),
        [
            ({"columns": {"pressure": T}}, "columns: pressure; there is slip, speed, wheel_speed"),
            ({"columns": {}}, "columns: none; there is"),
            ({"columns": {"speed": T[1:]}}, r"speed has shape \(384,\); t and the runs \(over\) need \(1, 385\) or"),
            ({"columns": {"speed": HOLE}}, "speed: 1 values are not finite, the first at t = 0.0039"),
            ({"t": T[::-1]}, "must be finite numbers in increasing order"),
            ({"t": T + 0.3}, r"t = 0.3 ... 0.7992 s leaves \[0, 0.6\] s, the solver's duration"),
            ({"sigma": {"speed": -0.1}}, r"sigma.speed = -0.1 is outside \(0, inf\) m/s"),
            ({"sigma": {"slip": 0.1}}, "sigma is that of slip; the columns are speed"),
            ({"sigma": {}}, "sigma is that of no column; the columns are speed"),
            ({"sigma": 0.002}, "sigma = 0.002 is no mapping from columns to standard deviations"),
            ({"columns": {"speed": T, "slip": T}, "sigma": None}, "sigma: needed to weigh speed, slip"),
            ({"over": {"plant.mess": np.ones(2)}}, "plant.mess is not a parameter of the loop"),
            ({"over": {"plant.inertia": np.ones(1)}}, "plant.inertia: both free and given for each run"),
            ({"until": [1.0, 2.0]}, r"until has shape \(2,\)"),
        ],
    )  # fmt: skip
    def test_data_that_do_not_fit_are_named(self, changed, message):
        data = Traces(**{"t": T, "columns": {"speed": T}, "sigma": {"speed": 0.1}, **changed})
        with pytest.raises(ValueError, match=message):
            identify(LOOP, data, FREE, solver=SOLVER)

    @killed_by("tune.identify.identification", "rounding=decimal.ROUND_FLOOR", "rounding=decimal.ROUND_CEILING")
    @pytest.mark.slow
    def test_a_step_that_is_not_stable_is_named(self):
        data = Traces(t=T, columns={"speed": T})
        loop = dataclasses.replace(
            LOOP, controller=controllers.PID(kp=3893.0, low=0.0, high=90.0), stop=stops.Standstill(speed=0.05)
        )
        with pytest.raises(
            ValueError, match=r"not stable at the start; the longest stable step there is \S+ s$"
        ) as caught:
            identify(loop, data, FREE, solver=SOLVER)
        longest, found = float(stable_step(loop)), float(str(caught.value).split()[-2])
        assert longest - 10.0 ** np.floor(np.log10(longest) - 2) < found <= longest

    @killed_by("tune.identify.identification", 'if why.endswith("is not stable"):', "if True:")
    def test_another_refusal_does_not_blame_the_step(self):
        """The step is not stable either, but a shorter one would not help."""
        stiff = dataclasses.replace(LOOP, controller=controllers.PID(kp=3893.0, low=0.0, high=90.0))
        data, starts = Traces(t=T, columns={"speed": T}), [{"plant.inertia": -1.0}]
        with pytest.raises(ValueError, match=r"^plant.inertia is outside \(0, inf\) kg m\^2$"):
            identify(stiff, data, FREE, solver=SOLVER, starts=starts)


class Distances:
    """Data that need no run: 1 and 2 kg m^2, each with a deviation of 1, are measured for the inertia."""

    def against(self, loop, free, solver):
        """The comparison with the loop's inertia."""

        def residuals(loop, measured):
            return loop.plant.inertia - measured

        return Comparison(residuals, (np.array([1.0, 2.0]),), np.ones(2), lambda part: [])


@killed_by("tune.identify.identification", "    starts = tuple(starts)\n", "")
def test_starts_may_come_from_a_generator():
    starts = ({"plant.inertia": x} for x in (0.5, 3.0))
    found = identify(LOOP, Distances(), ["plant.inertia"], solver=SOLVER, starts=starts)
    np.testing.assert_allclose([one.start["plant.inertia"] for one in found.starts], [0.5, 3.0], rtol=1e-12)
    np.testing.assert_allclose(found.values["plant.inertia"], 1.5, rtol=1e-6)  # the mean


ROWS = {
    "locked": LOOP,
    "weak": replace(LOOP, {"controller.torque": 60.0}),
    "sliding": dataclasses.replace(LOOP, controller=controllers.PID(kp=500.0, low=0.0, high=90.0)),
}


class TestTable:
    @pytest.mark.slow
    def test_rows_of_several_structures_are_measured_as_they_are(self):
        values = {
            "sliding": {"stop_time": 0.4},
            "locked": {"stop_distance": 10.0, "stop_time": 0.5},
            "weak": {"stop_time": 0.0},
        }
        table = Table(loops=ROWS, values=values, sigma={"stop_time": 0.01, "stop_distance": 0.1})
        against = table.against(LOOP, ["plant.inertia"], SOLVER)
        changed = replace(LOOP, {"plant.inertia": 1.4})
        seen = against.residuals(changed, *against.data)
        assert table.labels == [
            ("sliding", "stop_time"),
            ("locked", "stop_distance"),
            ("locked", "stop_time"),
            ("weak", "stop_time"),
        ]
        for (row, metric), ours in zip(table.labels, seen, strict=True):
            run = d.measure(replace(ROWS[row], {"plant.inertia": 1.4}), SOLVER, objectives.BRAKING)
            np.testing.assert_allclose(ours, run.metrics[metric] - values[row][metric], rtol=0, atol=1e-10)
        np.testing.assert_array_equal(against.sigma, [0.01, 0.1, 0.01, 0.01])

    @killed_by("tune.identify.data", 'if not hasattr(sigma, "keys"):', "if not isinstance(sigma, dict):")
    def test_sigma_may_be_a_series(self):
        table = Table(
            loops=ROWS,
            values={"locked": {"stop_time": 1.0, "iae": 2.0}},
            sigma=pd.Series({"iae": 0.3, "stop_time": 0.1}),
        )
        np.testing.assert_array_equal(table.against(LOOP, ["plant.inertia"], SOLVER).sigma, [0.1, 0.3])
        traces = Traces(t=T, columns={"speed": T}, sigma=pd.Series({"speed": 0.2}))
        np.testing.assert_array_equal(traces.against(LOOP, ["plant.inertia"], SOLVER).sigma, np.full(T.size, 0.2))

    @killed_by("tune.identify.table", '        check_sigma_table(self.sigma, "metrics")\n', "")
    @pytest.mark.parametrize(
        ("changed", "message"),
        [
            ({"values": {"wet": {"stop_time": 1.0}}}, "row wet: no loop; there is locked, weak, sliding"),
            ({"values": {"locked": {"grip": 1.0}}}, "row locked: grip is not measured; there is stop_time"),
            ({"values": {"locked": {"stop_time": np.nan}}}, "row locked: stop_time = nan is not finite"),
            ({"sigma": {"stop_time": 0.0}}, r"sigma.stop_time = 0 is outside \(0, inf\)"),
            ({"sigma": {"iae": 1.0}}, "sigma: none for stop_time"),
            ({"sigma": 0.1}, "sigma = 0.1 is no mapping from metrics to standard deviations"),
            ({"loops": {"locked": braking()}}, "row locked: plant.road.scale is not a parameter of its loop"),
        ],
    )  # fmt: skip
    def test_tables_that_do_not_fit_are_named(self, changed, message):
        table = Table(
            **{"loops": ROWS, "values": {"locked": {"stop_time": 1.0}}, "sigma": {"stop_time": 0.1}, **changed}
        )
        with pytest.raises(ValueError, match=message):
            identify(LOOP, table, FREE, solver=SOLVER)


@pytest.mark.slow
def test_the_derivative_through_interpolation_is_right():
    data = Traces(
        t=np.array([0.1037, 0.55]), columns={"distance": np.zeros(2)}, over={"initial.speed": np.array([26.0])}
    )
    against = data.against(LOOP, [], SOLVER)

    def seen(scale):
        return against.residuals(replace(LOOP, {"plant.road.scale": scale}), *against.data)

    slope, h = jax.jacfwd(seen)(0.9), 1e-5
    np.testing.assert_allclose(slope, (seen(0.9 + h) - seen(0.9 - h)) / (2 * h), rtol=1e-6, atol=1e-8)


@killed_by("tune.identify.traces", "math.gcd(*whole.astype(int).tolist()) or 1", "solver.every")
def test_a_run_keeps_the_instants_of_its_data():
    """Of a sparse record no straight line is left: the steps stay, or the grid of adaptive steps is divided."""
    t = 5 + 37.3 * np.arange(16)
    fixed = _keep_instants(d.FixedStep(1.0, 600.0, every=100), t)
    assert (fixed.step, fixed.every) == (1.0, 1)  # no step ends at 42.3 s
    assert _keep_instants(d.FixedStep(0.1, 600.0, every=7), np.array([20.0, 50.0])).every == 100
    adaptive = _keep_instants(d.Adaptive(1e-6, 600.0, 100.0), t)
    counts = t / (adaptive.step * adaptive.every)
    np.testing.assert_allclose(counts, np.round(counts), rtol=0, atol=1e-6)
