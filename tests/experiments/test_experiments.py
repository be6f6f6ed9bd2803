"""The experiments run, small, and find what their docstrings say."""

import importlib
import json
import types
from typing import NamedTuple

import numpy as np
import pytest
from project import ROOT
from scipy.integrate import solve_ivp

from diffabs import FixedStep
from diffabs.core.pytree import replace
from diffabs.linear.balance_model import BalanceModel
from diffabs.papers import record
from diffabs.parts.plants import QuarterCar
from diffabs.scenario.scenario import load

pytest.importorskip("matplotlib")
pytestmark = pytest.mark.slow


def experiment(name):
    return importlib.import_module(f"experiments.{name}")


def test_sampled_control_agrees_with_an_independent_solution(tmp_path):
    module = experiment("slip_estimator.sampled")
    config = module.Config(periods=(1e-3,), delays=(0.0,), drawn_periods=(1e-3,), out=str(tmp_path), stop=0.05)
    result = module.main(config)
    for row, (_, time, distance) in zip(result["sweep"], config.reference, strict=True):
        np.testing.assert_allclose(row["time [s]"], time, rtol=0, atol=7e-4)  # three digits given
        np.testing.assert_allclose(row["distance [m]"], distance, rtol=0, atol=7e-4)
    assert list(tmp_path.glob("*.json"))
    assert list(tmp_path.glob("*.png"))


def test_noise_blinds_the_bare_latch_and_not_the_robust_one():
    module = experiment("slip_estimator.noise")
    config = module.Config(seeds=8)
    references = {"bare": module.PeakLatch(), "robust": module.PeakRobust()}
    car = module.CARS["Magic Formula"]
    loops = [module.noisy_loop(config, car, 0.1, reference) for reference in references.values()]
    means = {}
    for name, loop in zip(references, loops, strict=True):
        distance, stopped = module.noisy(config, [loop], 6.0)
        means[name] = np.mean(distance)
        assert np.all(stopped) == (name == "robust")
    assert means["bare"] > 100
    np.testing.assert_allclose(means["robust"], 42.9, rtol=0, atol=0.3)  # 42.87 +- .11 elsewhere


def test_a_compliant_tyre_follows_the_rigid_one_over_its_relaxation_length():
    """With the friction of its slip it moves as the rigid rig; otherwise L m' = v (mu - m), in closed form."""
    module = experiment("measured_rig.run")
    rig = load("lab-rig-measured", integrated=False).loop.plant
    yielding = replace(module.as_compliant(rig), {"relaxation": 0.12})
    rigid = module.LabRigState(wheel=120.0, drum=150.0, brake=6.0, distance=1.0)
    mu, normal, torque = rig.contact(rigid)
    settled = module.CompliantRigState(*rigid, mu)
    np.testing.assert_allclose(yielding.contact(settled), (mu, normal, torque), rtol=1e-6)
    rate = yielding.derivative(0.0, settled, 0.7)
    np.testing.assert_allclose(rate[:4], rig.derivative(0.0, rigid, 0.7), rtol=1e-6)
    np.testing.assert_allclose(rate.deflected, 0.0, atol=1e-6)
    half = yielding.derivative(0.0, settled._replace(deflected=0.5 * mu), 0.7)
    np.testing.assert_allclose(half.deflected, 0.5 * mu * float(rig.drum_radius) * 150.0 / 0.12, rtol=1e-5)


def test_the_laboratory_rig_locks_with_the_published_gain():
    module = experiment("lab_rig.run")
    config = module.Config()
    for row in module.checks(config):
        if row["reference"] is not None:
            np.testing.assert_allclose(row["ours"], row["reference"], rtol=1e-7, atol=0)
    critical = [value for row in module.critical_lags(config) for value in row.values() if isinstance(value, float)]
    assert any(abs(value - 4.02e-3) < 2e-5 or abs(value - 4.02) < 2e-2 for value in critical), critical


def test_one_prior_is_enough_to_identify_a_magic_formula(monkeypatch):
    module = experiment("identification.run")
    config = module.Config()
    *_, found = module.from_prior(config, config.priors[0][1])
    time, distance = np.abs(found.residuals.reshape(-1, 2)).max(axis=0)
    assert time <= 0.01
    assert distance <= 0.06
    np.testing.assert_allclose(float(found.values["plant.inertia"]), 1.0454, rtol=0, atol=2e-3)
    assert found.uncertainty.degrees == 13


def test_the_cure_holds_at_its_corners_and_not_beyond(tmp_path, monkeypatch):
    module = experiment("overshoot_cured.run")
    box = module.Box(masses=(5.3, 6.2), speeds=(5.0, 50.0))
    near = {"gain": (-17300.0, -348.6), "filter": 0.01732, "iterations": 1}  # tuned from where tuning ends
    result = module.main(module.Config(out=str(tmp_path), box=box, seeds=1, **near))
    rows = {row["controller"]: row for row in result["table"]}
    cure = rows["the cure, as packaged"]
    assert cure["overshoot [%]"] <= 1
    assert cure["settling [s]"] <= 0.1
    assert (cure["locked [s]"], cure["diverged"], cure["proved"]) == (0, 0, "stable")
    assert rows["published gain"]["overshoot [%]"] > 90
    assert rows["cure, filter left out"]["overshoot [%]"] > 10
    assert rows["cure, gain fixed as at 50 km/h"]["largest frozen |pole|"] > 1
    assert {"gain at v0 [N m/s, N m]", "limits [N m]"} <= set(result["cure"]["controller"])
    weak = {row["controller"]: row for row in result["weak_spots"]}
    np.testing.assert_allclose(cure["overshoot [%]"], 0.791, rtol=0, atol=1e-3)  # test_cure.py has the others
    np.testing.assert_allclose(weak["the cure, as packaged"]["70 km/h"], 25.87, rtol=0, atol=0.01)
    assert set(weak) == set(rows)


def test_the_worst_case_found_is_at_least_as_bad_as_samples(tmp_path):
    module = experiment("worst_case.run")
    result = module.main(module.Config(samples=2000, starts=2, iterations=3, out=str(tmp_path)))
    for row in result["table"]:
        assert row["worst found [%]"] >= row["worst of 2000 samples [%]"]
        assert row["worst found [%]"] >= row["worst of the 32 corners [%]"] * (1 - 1e-9)
    published, cure = result["table"]
    assert published["worst found [%]"] > 90
    np.testing.assert_allclose(cure["worst of the 32 corners [%]"], 18.68, rtol=0, atol=0.01)
    assert "That is a corner of the box: running its 32 corners finds it." in result["reports"]["the cure"]
    assert result["worst_corner"]["the cure"] == pytest.approx(result["worst"]["the cure"], rel=1e-6)


def test_lanes_that_fail_are_no_part_of_a_mean(tmp_path, monkeypatch):
    """By hand: of four lanes one diverges and one does not stop, under one of the controllers; then all fail."""
    module, cure = experiment("pid_over_roads.run"), experiment("overshoot_cured.run")
    flags = {
        "stopped": np.array([1, 1, 1, 0], bool),
        "diverged": np.array([0, 0, 1, 0], bool),
        "locked_time": np.zeros(4),
    }
    after = flags | {"stop_distance": np.array([9.0, 8.0, np.nan, np.inf])}
    good = {"stopped": np.ones(4, bool), "diverged": np.zeros(4, bool)}
    before = flags | good | {"stop_distance": np.full(4, 10.0)}
    unseen = module.Family({}, np.full(4, 8.0), np.ones(4))
    row = module.compared(module.Config(), "pid", before, after, unseen)
    assert (row["shorter [%]"], row["tuned"]) == (pytest.approx(15.0), pytest.approx(8.5 / 8))
    assert row["+- [%]"] == pytest.approx(12.706204736 * 5)  # t of one degree, 97.5 %; s/sqrt(2) is 5 %
    assert (row["worst lane, tuned"], row["both stop"], row["not stopped"], row["diverged"]) == (9 / 8, 2, 1, 1)
    after["stopped"] = np.zeros(4, bool)
    row = module.compared(module.Config(), "pid", before, after, unseen)
    assert np.isnan([row["tuned"], row["worst lane, tuned"], row["+- [%]"]]).all()

    class Runs(NamedTuple):
        metrics: dict
        diverged: np.ndarray

    names = ("overshoot", "settling_time", "locked_time", "max_slip", "iae")
    runs = Runs(dict.fromkeys(names, np.array([0.1, 0.3, np.nan])), np.array([False, False, True]))
    proof = types.SimpleNamespace(quadratically_stable=None, decay_rate=0.0, frozen=np.array([0.5]))
    for name, found in (("run_batch", runs), ("certify", proof), ("feedback_gain", None)):
        monkeypatch.setattr(cure, name, lambda *_, found=found, **__: found)
    row, _ = cure.judged(cure.Config(), None, types.SimpleNamespace(states=()), None)
    assert (row["overshoot [%]"], row["diverged"]) == (pytest.approx(30.0), 1)
    runs.diverged[:] = True
    row, _ = cure.judged(cure.Config(), None, types.SimpleNamespace(states=()), None)
    assert np.isnan(row["overshoot [%]"])
    written = record.experiment(cure.Config(out=str(tmp_path)), {"table": [row]}, {})
    assert (written["table"][0]["overshoot [%]"], written["table"][0]["diverged"]) == (None, 3)


def test_tuned_over_roads_no_wheel_locks_longer(tmp_path):
    module = experiment("pid_over_roads.run")
    config = module.Config(
        roads=8,
        held_out=8,
        candidates=64,
        near=0.1,
        nearest=4,
        few=4,
        iterations=2,
        own_step=1e-3,
        out=str(tmp_path),
    )
    result = module.main(config)
    assert len(result["table"]) == 4
    for row in result["table"]:
        assert row["worst lane, tuned"] > 1 - 1e-3  # of what friction allows
        assert (row["lanes locked longer"], row["not stopped"], row["diverged"]) == (0, 0, 0)


def test_gradients_need_fewer_rollouts_than_searches_without(tmp_path, monkeypatch):
    module = experiment("lq_weights.run")
    config = module.Config(budgets=((2, 120),), rig_step=1e-3, repeats=1, first_steps=(0.2, 0.5), out=str(tmp_path))
    rows = {row["accuracy"]: row for row in module.main(config, ("gain",))["table"]}
    kept = json.loads((tmp_path / "gain.json").read_text())
    assert kept["found"]["tune"] <= kept["found"]["Nelder-Mead"] * (1 + 1e-4)
    assert len([who for who in kept["found"] if who.startswith("CMA-ES")]) == 2
    assert rows["0.0001"]["gradients"] < 15
    assert rows["0.0001"]["L-BFGS-B, differences"] < 45
    assert rows["0.0001"]["Nelder-Mead"] > 30


def test_a_table_of_gains_can_be_tuned(tmp_path, monkeypatch):
    """By gradients in reverse mode, from its start on."""
    module = experiment("lq_weights.run")
    few = {"table_masses": (5.75,), "table_speeds": (9.0, 50.0, 3), "first": 0.1, "iterations": (2, 2)}
    config = module.Config(budgets=((48, 100),), repeats=1, first_steps=(0.2,), out=str(tmp_path), **few)
    for name in ("table 6", "table 24"):
        module.main(config, (name,))
        kept = json.loads((tmp_path / f"{name.replace(' ', '_')}.json").read_text())
        assert kept["found"]["tune"] < kept["start"]
        assert kept["found"]["L-BFGS-B"] < kept["start"]


def test_what_searches_spent_is_counted(monkeypatch):
    """By hand: a bound where no search without gradients arrives, and none where the gradients do not."""
    module = experiment("lq_weights.run")
    traces = {
        "tune": [[1, 9.0], [6, 1.0]],
        "L-BFGS-B": [[1, 9.0], [5, 1.0]],
        "L-BFGS-B, differences": [[1, 9.0], [40, 1.0]],
        "Nelder-Mead": [[1, 9.0], [60, 2.0]],
        "CMA-ES, first step 0.2": [[1, 9.0], [44, 2.0], [90, 1.4]],
        "CMA-ES, first step 0.5": [[1, 9.0], [33, 1.5]],
    }
    kept = {
        "problem": "p",
        "parameters": 3,
        "price": 2.0,
        "traces": traces,
        "found": {who: trace[-1][1] for who, trace in traces.items()},
        "spent": {who: 200 for who in traces},
    }
    row = module.line(kept, "2", 2.0)
    assert (row["gradients"], row["tune"], row["L-BFGS-B"], row["L-BFGS-B, differences"]) == (5, 12, 10, 40)
    assert (row["Nelder-Mead"], row["CMA-ES"], row["best of CMA-ES"]) == (60, 33, "first step 0.5")
    assert (row["differences / gradients"], row["CMA-ES / gradients"]) == (4.0, 3.3)
    row = module.line(kept, "1", 1.0)
    assert (row["Nelder-Mead"], row["CMA-ES"], row["CMA-ES / gradients"]) == (None, None, 20.0)
    row = module.line(kept, "0", 0.5)
    assert (row["gradients"], row["tune"], row["differences / gradients"]) == (None, None, None)


def test_tuned_weights_recover_more_starts_and_are_proved(tmp_path):
    """24 x 24 cells know the share to some 2 %: the full run has 0.294, 0.328, 0.464 and 0.487. What any control could
    do is a strip, whose area is also counted."""
    module = experiment("two_wheeler.weights")
    config = module.Config(starts=24, proof_points=2, tuned_starts=(7, 13), out=str(tmp_path))
    found = module.main(config)
    rows = {row["weights"]: row for row in found["table"]}
    shares = {"Q = I, R = 1": 0.294, "Q = I, R = 0.01": 0.328, "Q = diag(1, 100, 1, 1, 1, 1)": 0.464, "tuned": 0.48}
    for name, share in shares.items():
        assert rows[name]["share of the box"] == pytest.approx(share, abs=0.02), name
        assert (rows[name]["undecided"], rows[name]["next multiple undecided"]) == (0, False)
    assert rows["tuned"]["share of the box"] > rows["Q = diag(1, 100, 1, 1, 1, 1)"]["share of the box"]
    assert rows["Q = I, R = 0.01"]["multiple of (.5, 0, .2)"] == pytest.approx(0.0565, abs=1e-4)
    share, (theta, phi) = module.possible(config)
    axis = module.Cells(-config.box, config.box, 1001).centres
    assert share == pytest.approx(0.5407, abs=5e-5)
    assert share == pytest.approx(np.mean(np.abs(np.add.outer(axis / theta, axis / phi)) <= 1), abs=1e-3)
    assert rows["tuned"]["common P over the riders"] == "yes"
    assert rows["Q = diag(1, 100, 1, 1, 1, 1)"]["common P over the riders"] == "none"


@pytest.mark.usefixtures("users_engine")
def test_an_observer_recovers_nearly_what_the_whole_state_does(tmp_path):
    module = experiment("two_wheeler.lqg")
    config = module.Config(noises=((3e-3, 3e-3),), seeds=4, multiples=(0.06, 0.09, 16), duration=6.0, out=str(tmp_path))
    full, observed = module.main(config)["table"]
    assert abs(full["multiple"] - 0.08) < 0.0021
    assert observed["of the full state's"] >= 0.9


def test_the_bound_rises_as_the_root_of_the_motor_power(monkeypatch):
    """And the best machine for a bound is where the ranges end: long, heavy; the gear is inside."""
    module = experiment("two_wheeler.codesign")
    config = module.Config()
    hanging = module.load("arm-hanging").loop
    found = [
        module.best_bound(config, module.Machine(loop=hanging, resistance=r, current=1e3), "rod") for r in (3.0, 0.75)
    ]
    weak, strong = (float(np.min(module.bounds(config, machine))) for machine in found)
    np.testing.assert_allclose(strong / weak, 2.0, rtol=0.05, atol=0)
    assert float(found[0].arm_mass) > 39
    assert 6 < float(found[0].gear) < 390


@pytest.mark.parametrize(
    ("only", "known", "estimated"),
    [  # whether it is met, near the floor [%], worst corner [%], proof; as the study's page says of more points
        ("published", ("no", 0, 143, "unstable"), ("no", 0, 150, "unstable")),
        ("tuned-cvar", ("yes", 99.9, 20, "proved"), ("no", 55, 96, "proved")),
    ],
)
def test_the_committed_controllers_are_judged_and_proved_again(tmp_path, monkeypatch, only, known, estimated):
    module = experiment("real_rig.again")
    judging = module.Judging(samples=256, fewer=256, block=256, corner_seeds=1)
    found = module.main(module.Config(judging=judging, only=only, out=str(tmp_path)))
    for speed, (meets, near, corner, said) in (("known", known), ("estimated", estimated)):
        ((name, one),) = found[speed].items()
        row = module.row(one)
        assert name.startswith(only)
        assert (row["meets"], one["proof"]["said"]) == (meets, said)
        assert float(row["deviation near the floor"]) == pytest.approx(near, abs=10)  # 3 standard deviations of 55 %
        assert one["corners"]["corners"] == {"known": 512, "estimated": 256}[speed]
        assert one["corners"]["overshoot [%]"] == pytest.approx(corner, rel=0.1)
        assert row["locks, not stopped"] == "0, 0"
    if only == "tuned-cvar":
        assert one["near the worst corner, overshoot [%]"] > 50
        corner = one["corners"]["at"]
        box, near = module.Box(), module.near_corner(module.Config(judging=judging), "estimated", corner)
        for path, (low, high) in box.ranges("estimated").items():
            assert np.all(np.abs(near[path] - corner[path]) <= 0.2 * (high - low))
            assert np.all((near[path] >= low) & (near[path] <= high))
    assert list(tmp_path.glob("*.json"))


@pytest.mark.parametrize(("resistance", "watts"), [(3.0, 192.0), (1.0, 576.0), (0.3, 1800.0), (0.1, 2520.0)])
def test_the_power_of_a_motor_knows_the_limit_of_its_current(monkeypatch, resistance, watts):
    """The greatest I (U - R I) over currents within 60 A, on a grid."""
    currents = np.linspace(0.0, 60.0, 60_001)
    assert np.max(currents * (48.0 - resistance * currents)) == pytest.approx(watts, rel=1e-9)
    assert experiment("two_wheeler.codesign").motor_power(48.0, resistance, 60.0) == pytest.approx(watts, rel=1e-12)


def rows_of_page(page, first, last):
    """Cells of a table between two lines of a page."""
    text = (
        (ROOT / "experiments" / page / "README.md").read_text(encoding="utf-8").partition(first)[2].partition(last)[0]
    )
    lines = [line.strip("| ").split(" | ") for line in text.splitlines() if line.startswith("|")]
    return {cells[0].strip("*"): cells[1:] for cells in lines}


def test_each_row_of_machines_has_the_bound_of_its_own_machine(monkeypatch):
    """By the left eigenvector w of the unstable pole s: |w'B| U/(s |w'd|). The page has three digits of a machine."""
    plant, start = load("arm-hanging", integrated=False).loop.plant, np.array([0.5, 0.0, 0.2, 0.0, 0.0, 0.0])
    machines = rows_of_page("two_wheeler", "The tuned machines:", "**The paper's motor")
    bounds = rows_of_page("two_wheeler", "## A machine for the claim", "The machines of greatest bound")
    names = {"best flywheel, 3 ohm": "flywheel, 3 ohm", "best rod, 0.3 ohm, 60 A, 1.80 kW": "rod, 0.3 ohm",
             "best flywheel, 0.3 ohm, 60 A, 1.80 kW": "flywheel, 0.3 ohm",
             "the same improved for 50 kg alone": "the same for 50 kg",
             "best flywheel, 0.1 ohm, 60 A, 2.52 kW": "flywheel, 0.1 ohm"}  # fmt: skip
    for row, name in names.items():
        mount, centre, arm, constant, gear, _ = machines[name]
        mass, inertia = arm.split(", ")
        ohm = 0.1 if "0.1" in name else 3.0 if "3 ohm" in name and "0.3" not in name else 0.3
        amperes = 16.0 if ohm == 3.0 else 60.0
        values = {"mount_height": mount, "arm_length": centre, "arm_mass": mass, "arm_inertia": inertia, "gear": gear,
                  "torque_constant": constant, "rotor_inertia": 2e-4, "resistance": ohm}  # fmt: skip
        built = replace(plant, {path: float(value) for path, value in values.items()})
        for printed, rider in zip(bounds[row][0].split("; "), (100.0, 50.0), strict=True):
            limits = []
            for emf, volts in ((float(constant), 48.0), (0.0, amperes * ohm)):
                model = BalanceModel(plant=replace(built, {"back_emf": emf, "rider_mass": rider}))
                a, b = (np.asarray(x) for x in model.matrices())
                poles, left = np.linalg.eig(a.T)
                (i,) = np.flatnonzero(poles.real > 0)
                w, pole = left[:, i].real, poles[i].real
                limits.append(abs(w @ b[:, 0]) * volts / (pole * abs(w @ start)))
            assert float(printed) == pytest.approx(min(limits), rel=0.01), (row, rider)


def test_drawn_designs_climb_to_where_most_is_recovered():
    """A known top, 0.5 at x = 0.7 and y = 100, where x is counted in its range and y in logarithms of its own."""
    module = experiment("two_wheeler.random_designs")
    ranges = {"x": (0.0, 1.0), "y": (1.0, 1e3)}

    def judge(designs, multiples):
        top = 0.5 - np.abs(designs["x"] - 0.7) - np.abs(np.log10(designs["y"]) - 2.0)
        return multiples <= top[:, None]

    found, most = module.improved(module.Draws(), {"x": 0.6, "y": 80.0}, ranges, judge, 0.3)
    assert 0.47 < most <= 0.5
    assert abs(found["x"] - 0.7) < 0.02
    assert abs(np.log10(found["y"]) - 2.0) < 0.02
    kept, same = module.improved(module.Draws(), {"x": 0.7, "y": 100.0}, ranges, judge, 0.5)
    assert (kept, same) == ({"x": 0.7, "y": 100.0}, 0.5)


def test_a_design_is_judged_as_its_own_loop_would_be():
    """Two machines and two multiples in one call, and each of them alone."""
    module, scenario = experiment("two_wheeler.random_designs"), load("arm-hanging")
    gain = np.asarray(scenario.loop.controller.gain)
    solver, start = FixedStep(step=1e-3, duration=6.0), np.array([0.5, 0.0, 0.2])

    def closed(design):
        return replace(scenario.loop, {"controller.gain": design["gain"], "plant.arm_mass": design["mass"]})

    designs = {"gain": np.stack([gain, 0.0 * gain]), "mass": np.array([30.0, 30.0])}
    judge = module.runs(closed, 50.0, start, solver)
    assert judge(designs, np.array([0.03, 0.2])).tolist() == [[True, False], [False, False]]


def latched_stop(own, height, place, edge, width):
    """Distance [m] of the paper's car under its PI, whose target is 0.2 up to the slip of the first peak and then that
    slip, by SciPy."""
    mass, inertia, radius, torque, kp, ki = 15.0, 1.0539, QuarterCar().radius, 90.0, 3893.0, 5000.0
    at = np.linspace(0.01, 0.3, 29_001)

    def curve(s, b=own.B):
        return own.D * np.sin(own.C * np.arctan(b * s - own.E * (b * s - np.arctan(b * s))))

    peak = at[np.argmax(curve(at))]

    def friction(s, x):
        y = np.clip((x - edge) / width + 0.5, 0.0, 1.0)
        share = y * y * (3 - 2 * y)
        return (1 - share) * curve(s) + share * height * curve(s, own.B / place)

    def rates(t, state, target):
        v, w, x, total = state
        s = 1 - w / v
        mu, error = friction(s, x), target - s
        u = np.clip(kp * error + ki * total, 0.0, torque)
        return [-9.81 * mu, radius * (radius * mass * 9.81 * mu - u) / inertia, v, error]

    def at_peak(t, state, target):
        return 1 - state[1] / state[0] - peak

    def slow(t, state, target):
        return state[0] - 2.0

    at_peak.terminal = slow.terminal = True
    how = {"method": "LSODA", "rtol": 1e-8, "atol": 1e-10, "max_step": 0.02}
    first = solve_ivp(rates, (0, 40), [100 / 3.6, 100 / 3.6, 0.0, 0.0], args=(0.2,), events=at_peak, **how)
    last = solve_ivp(rates, (first.t[-1], 80), first.y[:, -1], args=(peak,), events=slow, **how).y[:, -1]
    return last[2] + last[0] ** 2 / (2 * 9.81 * friction(1 - last[1] / last[0], last[2]))


def test_the_latch_holds_the_first_slip_on_the_second_surface(monkeypatch):
    """So it is too long where the second peak lies at another slip, and hardly where both are at one slip."""
    module = experiment("slip_estimator.changing_road")
    config = module.Config(heights=(0.5,), places=(1.0, 2.0), edges=(0.5,))
    values = module.roads(config)
    found = module.excess(config, module.RULES["proposed, latch"], values)
    lanes = {path: x for path, x in values.items() if "." in path}
    edge = float(values["plant.road.edges"][0, 0])
    theirs = [latched_stop(module.OWN, 0.5, place, edge, config.width) for place in config.places]
    np.testing.assert_allclose(found, theirs / module.bound(lanes, 90.0, config.width).distance - 1, rtol=0, atol=1e-3)
    assert found[0] < 0.02 < 0.08 < found[1]
