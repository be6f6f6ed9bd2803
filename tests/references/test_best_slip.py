"""The parts and the bound of experiments/best_slip, against closed forms and an independent solution."""

import importlib

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from mutants import killed_by
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

import diffabs as d
from diffabs import controllers, plants, references, roads
from diffabs.core.protocols import BrakeOutput, Memory

MODULES = ("bound", "fixed", "rules", "search", "run")


@pytest.fixture(scope="module")
def experiment():
    """The experiment's modules by name."""
    pytest.importorskip("matplotlib")
    return {name: importlib.import_module(f"experiments.best_slip.{name}") for name in MODULES}


def seen(slip, deceleration):
    """What a sensor shows of these; the rest does not matter."""
    one = jnp.ones_like(jnp.asarray(slip))
    return BrakeOutput(jnp.asarray(slip), 10.0 * one, 9.0 * one, deceleration * one, 0.0 * one)


def fed(block, signal_at, end, steps=4000):
    """The block's memory after a signal of time, by Runge-Kutta."""
    h = end / steps

    def rate(t, z):
        return block.flow(t, Memory(z), signal_at(t))

    def step(z, k):
        t = k * h
        a = rate(t, z)
        b = rate(t + h / 2, jax.tree.map(lambda x, y: x + h / 2 * y, z, a))
        c = rate(t + h / 2, jax.tree.map(lambda x, y: x + h / 2 * y, z, b))
        e = rate(t + h, jax.tree.map(lambda x, y: x + h * y, z, c))
        return jax.tree.map(lambda x, p, q, r, s: x + h / 6 * (p + 2 * q + 2 * r + s), z, a, b, c, e), None

    start = block.start(signal_at(jnp.zeros(()))).flow
    return Memory(jax.lax.scan(step, start, jnp.arange(steps, dtype=float))[0])


@killed_by(
    "parts.references.extremum_seeking",
    "slip * deceleration - m.covariance",
    "slip * signal.deceleration - m.covariance",
)
def test_seeking_finds_the_slope_whatever_moves_the_slip():
    """On a line a = a0 + p slip the covariance is p times the variance, so the estimate is p m/b where the resolution
    does not matter; a swing A sin(w t) has the variance (A^2/2) (wT)^2/(1 + (wT)^2) about the mean that lags, in the
    mean over the lag T, which a great T shows."""
    swing, w, big = 0.02, 60.0, 2.0
    block = references.ExtremumSeeking(time_constant=big, resolution=1e-9, gain=0.0)
    end = fed(block, lambda t: seen(0.1 + swing * jnp.sin(w * t), 3.0 + 5.0 * swing * jnp.sin(w * t)), 12.0)
    m = end.flow
    np.testing.assert_allclose(m.covariance, 5.0 * m.variance, rtol=1e-9)
    np.testing.assert_allclose(block.elasticity(end), 5.0 * m.slip / m.deceleration, rtol=1e-6)
    share = (w * big) ** 2 / (1 + (w * big) ** 2)
    np.testing.assert_allclose(m.variance, swing**2 / 2 * share * (1 - np.exp(-6.0)), rtol=0.02)


@killed_by(
    "parts.references.extremum_seeking", "self.gain * e * clamp(room / jnp.log1p(self.band), 0.0, 1.0)", "self.gain * e"
)
def test_seeking_climbs_at_its_gain_and_stays_within_its_limits():
    """A deceleration in proportion to the slip has the elasticity 1: ln s grows at the gain, until the band."""
    block = references.ExtremumSeeking(
        slip=0.1, gain=2.0, resolution=1e-9, time_constant=0.01, slip_high=0.4, band=0.01
    )

    def signal(t):
        slip = 0.1 + 0.01 * jnp.sin(90.0 * t)
        return seen(slip, 40.0 * slip)

    start, later = (fed(block, signal, end).flow.logarithm for end in (0.2, 0.4))
    np.testing.assert_allclose(later - start, 2.0 * 0.2, rtol=1e-3)
    top = fed(block, signal, 3.0).flow.logarithm
    assert np.log(0.4) - 0.002 < top <= np.log(0.4)
    down = fed(block, lambda t: signal(t)._replace(deceleration=4.0 - 30.0 * (signal(t).slip - 0.1)), 9.0)
    assert np.log(0.02) <= down.flow.logarithm < np.log(0.02) + 0.002
    np.testing.assert_allclose(block.output(np.pi / 60.0, down, None), 1.1 * block.setpoint(down), rtol=1e-12)


@killed_by("parts.references.extremum_seeking", "climb = self.gain * e", "climb = -self.gain * e")
@pytest.mark.slow
def test_seeking_ends_at_the_peak_of_a_road():
    """From either side, under a controller, on a road whose peak is known."""
    car = plants.QuarterCar(road=roads.MagicFormula())
    best = float(d.roads.peak(car.road).slip)
    stop, pi = (
        d.stops.Standstill(speed=2.0),
        controllers.PID(ki=5e4, antiwindup=controllers.BackCalculation(), low=0.0, high=90.0),
    )
    found = []
    for slip in (0.05, 0.3):
        seeking = references.ExtremumSeeking(slip=slip, gain=20.0)
        loop = d.braking(plant=car, reference=seeking, controller=pi, stop=stop)
        run = d.rollout(loop, d.FixedStep(1e-3, 5.0), {})
        found.append(float(run.ending.sample.setpoint))
    np.testing.assert_allclose(found, best, rtol=0.15)


@killed_by(
    "parts.references.by_deceleration",
    "return (signal.deceleration - memory.flow) / self.time_constant",
    "return 1e3 * (signal.deceleration - memory.flow)",
)
def test_the_slip_by_deceleration_is_interpolated_and_filtered():
    """np.interp, of the step response of the filter."""
    nodes, slips = np.array([1.0, 2.0, 5.0]), np.array([0.05, 0.2, 0.1])
    block = references.SlipByDeceleration(decelerations=nodes, slips=slips, time_constant=0.1)
    for level in (0.3, 1.7, 4.0, 9.0):
        memory = fed(block, lambda t, level=level: seen(0.1, jnp.where(t > 0, level, 0.5)), 0.15)
        filtered = level + (0.5 - level) * np.exp(-1.5)
        np.testing.assert_allclose(block.output(0.0, memory, None), np.interp(filtered, nodes, slips), rtol=1e-3)


def best_stop(mass, v0, road, torque, width=None, edge=np.inf):
    """SciPy: all the torque until the slip is at the peak; then whatever holds it, if the torque can."""
    r, inertia, g = 0.2, 1.0539, 9.81
    friction = [lambda s, c=c: float(roads.MagicFormula(**c).friction(s)) for c in road]
    peak = brentq(lambda s: friction[0](s + 1e-6) - friction[0](s - 1e-6), 0.01, 0.5)

    def holding(s):
        return friction[0](s) * g * (mass * r + (1 - s) * inertia / r)

    def rates(t, y):
        v, w, _ = y
        s = 1 - r * w / v
        torque_now = torque if s < peak else min(torque, holding(peak))
        return [-friction[0](s) * g, (r * friction[0](s) * mass * g - torque_now) / inertia, v]

    def slow(t, y):
        return y[0] - 0.5

    slow.terminal = True
    found = solve_ivp(rates, (0, 40), [v0, v0 / r, 0.0], events=slow, rtol=1e-8, atol=1e-10, max_step=2e-3)
    v, w, x = found.y[:, -1]
    return x + v**2 / (2 * g * friction[0](1 - r * w / v))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("mass", "mu"),
    [pytest.param(12.0, 0.3, marks=pytest.mark.slow), (15.0, 0.98), pytest.param(20.0, 1.1, marks=pytest.mark.slow)],
)
def test_the_bound_is_full_torque_and_then_the_peak(experiment, mass, mu):
    """The last one has more friction than 90 N m can use."""
    road = {"B": 13.0, "C": 1.45, "D": mu, "E": -0.8}
    values = {f"plant.road.roads.{i}.{n}": np.array([x]) for i in (0, 1) for n, x in road.items()}
    values |= {"plant.mass": np.array([mass]), "initial.speed": np.array([25.0]), "plant.road.edges": np.array([[9.0]])}
    found = experiment["bound"].bound(values, 90.0, 0.3)
    np.testing.assert_allclose(found.distance[0], best_stop(mass, 25.0, [road], 90.0), rtol=2e-5)
    np.testing.assert_allclose(found.friction[0], 25.0**2 / (2 * 9.81 * mu), rtol=1e-12)
    assert found.weak[0] == (mu == 1.1)
    assert found.attained[0]


def test_the_bound_beyond_an_edge_is_the_energy_that_is_left(experiment):
    """By hand: up to the edge as on one surface, through its width at the mean of both peaks, then at the second's."""
    module = experiment["bound"]
    both = ({"B": 13.0, "C": 1.45, "D": 0.8, "E": -0.8}, {"B": 20.0, "C": 1.3, "D": 0.2, "E": 0.2})
    values = {f"plant.road.roads.{i}.{n}": np.array([x]) for i, road in enumerate(both) for n, x in road.items()}
    values |= {"plant.mass": np.array([15.0]), "initial.speed": np.array([25.0])}
    values["plant.road.edges"] = np.array([[20.0]])
    found = module.bound(values, 90.0, 0.3)
    one = {path: both[0][path[-1]] + 0 * x if "roads" in path else x for path, x in values.items()}
    whole = module.bound(one, 90.0, 0.3).distance[0]
    v2 = 2 * 9.81 * 0.8 * (whole - 19.85) - 9.81 * (0.8 + 0.2) * 0.3
    np.testing.assert_allclose(found.distance[0], 20.15 + v2 / (2 * 9.81 * 0.2), rtol=1e-6)
    assert not found.attained[0]


@pytest.mark.slow
def test_no_rule_beats_the_bound_and_tuning_shortens(experiment, tmp_path, monkeypatch):
    """On a few roads, with exact sensors: who knows the peak comes within a hundredth of the bound, and derivatives
    where the search ended are those of differences."""
    main, fixed, search = (experiment[name] for name in ("run", "fixed", "search"))
    config = main.Config(
        fixed=fixed.Fixed(roads=fixed.Roads(held_out=64)),
        search=search.Search(roads=32, few=16, starts=2, tried=3, iterations=3, cma_evaluations=24),
        rules={fixed.EXACT: ("fixed slip",)},
        searched_again=("fixed slip",),
        out=str(tmp_path),
    )
    kept, of_sensors = [], main.of_sensors
    monkeypatch.setattr(main, "of_sensors", lambda *given: kept.append(of_sensors(*given)) or kept[0])
    result = main.main(config)
    said, metrics, _ = kept[0]
    shortest = fixed.lanes(config.fixed, 64, 2).bound.distance
    above = {name: (one["stop_distance"] / shortest - 1)[fixed.good(one)] for name, one in metrics.items()}
    assert all(np.all(excess > -1e-3) for excess in above.values())
    assert min(above, key=lambda name: np.mean(above[name])) == "peak known"
    assert np.mean(above["peak known"]) < 0.01
    paper, *_, known = said["table"]
    assert (paper["shorter than the paper's [%]"], paper["both stop"]) == (0, 64)
    np.testing.assert_allclose(
        known["shorter than the paper's [%]"], paper["above the bound [%]"] - known["above the bound [%]"], rtol=1e-9
    )
    assert result["exact sensors"]["best"]["best"] == "fixed slip"
    objective, slope = (said[key]["fixed slip"] for key in ("tuning", "derivatives"))
    assert objective["objective"]["after"] < objective["objective"]["before"]
    assert slope["agree with one"] == slope["lanes"] == 32
    again = result["CMA-ES, exact sensors"]["fixed slip"]["objective"]
    assert objective["objective"]["after"] - 2e-3 < again < objective["objective"]["before"]
    assert abs(said["half the step"]["tuned, fixed slip"]["mean change [%]"]) < 0.01
    assert (tmp_path / "roads.png").exists()


def test_failures_are_counted_and_never_averaged_in(experiment):
    """By hand: two lanes of four are good under both, one of the paper's does not stop, one of the rule's locks."""
    module = experiment["fixed"]
    shortest = np.array([10.0, 20.0, 40.0, 50.0])
    flags = {"stopped": np.array([True] * 4), "diverged": np.zeros(4, bool), "locked_time": np.zeros(4)}
    paper = flags | {"stop_distance": np.array([12.0, 22.0, 900.0, 55.0]), "stopped": np.array([1, 1, 0, 1], bool)}
    rule = flags | {"stop_distance": np.array([11.0, 21.0, 42.0, 70.0]), "locked_time": np.array([0, 0, 0, 0.1])}
    row = module.line(module.Fixed(), rule, paper, shortest)
    np.testing.assert_allclose(row["above the bound [%]"], 100 * np.mean([0.1, 0.05, 0.05]))
    np.testing.assert_allclose(row["shorter than the paper's [%]"], 100 * np.mean([0.1, 0.05]))
    np.testing.assert_allclose(row["+- of that [%]"], 100 * 12.706204736 * 0.025, rtol=1e-6)  # t of one degree, 97.5 %
    assert (row["both stop"], row["locked"], row["not stopped"], row["diverged"]) == (2, 1, 0, 0)
    found = module.best(module.Fixed(most_failures=0.25), {"a": paper, "b": rule}, shortest)
    assert (found["best"], found["common lanes"]) == ("b", 2)
    assert module.best(module.Fixed(), {"a": paper, "b": rule}, shortest)["best"] is None
