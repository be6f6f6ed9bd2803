"""What the benchmarks compute: the problem of the peers, its references, whether a ratio became worse, the figure."""

import importlib
import itertools
import json
import re
import sys

import jax.numpy as jnp
import numpy as np
import pytest
from project import ROOT

import diffabs

FOLDER = ROOT / "benchmarks"
LANES = (np.array([5.3, 5.5, 5.9, 6.2]), np.array([30.0, 40.0, 50.0, 60.0]) / 3.6)


@pytest.fixture(autouse=True)
def _path(monkeypatch):
    monkeypatch.syspath_prepend(str(FOLDER))


def module(name):
    return importlib.import_module(name)


def test_the_problem_of_the_peers_is_that_of_our_parts():
    problem, loop = module("peers.problem"), module("peers.ours").LOOP
    plant, control = loop.plant, loop.controller
    assert (plant.wheel_radius, plant.body_radius, plant.wheel_inertia) == (problem.R1, problem.R2, problem.J1)
    assert tuple(control.gain) == (problem.K1, problem.K2)
    assert (control.low, control.high) == (0.0, problem.U)
    assert loop.reference.slip == problem.SLIP
    assert loop.stop.speed == problem.STOP
    for slip in (0.01, 0.2, 0.7):
        assert problem.friction(slip) == pytest.approx(float(plant.road.friction(slip)), rel=1e-12)
    for mass in problem.MASSES:
        shown = plant.output(plant.start(diffabs.BrakeStart(speed=10.0)))
        held = loop.feedforward.input(diffabs.replace(plant, {"mass": mass}), shown, problem.SLIP)
        assert problem.holding(mass) == pytest.approx(float(held), rel=1e-6)


def test_the_error_is_the_worst_run_and_nan_is_worse():
    errors = module("peers.problem").errors
    right = np.full((4, 3), 2.0)
    found = right.copy()
    found[0, 2], found[1, 0], found[2, 1] = 2.2, 1.8, np.nan
    np.testing.assert_allclose(errors(found, right), [0.1, 0.1, np.inf, 0.0], rtol=1e-12)


@pytest.mark.slow
def test_scipy_gives_the_published_run():
    found = module("peers.reference").by_scipy(5.3, 50 / 3.6)
    np.testing.assert_allclose(found, [1.615305, 12.370507, 0.363764, 0.02296340], rtol=1e-6)  # docs/results.md


@pytest.mark.slow
@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_c_agrees_with_scipy(dtype):
    c, reference = module("peers.c"), module("peers.reference")
    try:
        found, _ = c.solved("adaptive", *LANES, 1e-6, dtype)
    except c.NoCompiler as reason:
        pytest.skip(str(reason))
    right = np.array([reference.by_scipy(*lane) for lane in zip(*LANES, strict=True)]).T
    worst = module("peers.problem").errors(found, right)
    assert worst.max() < 3e-5
    assert np.all(np.full(4, 5e-324) / np.ones(4) > 0)  # the processor still knows the smallest numbers
    fixed, _ = c.solved("fixed", *LANES, 1e-4, dtype)
    assert module("peers.problem").errors(fixed, right).max() < 2e-4
    if dtype == "float64":
        assert module("peers.problem").errors(c.solved("adaptive", *LANES, 1e-9)[0], right).max() < worst.max() / 10


@pytest.mark.slow
def test_a_loop_without_a_jit_agrees_with_the_reference():
    reference, loop = module("peers.reference"), module("peers.scipy_loop")
    found = loop.prepared(LANES[0][:2], LANES[1][:2], 1e-8, "float64", 1)()
    right = np.array([reference.by_scipy(*lane) for lane in zip(LANES[0][:2], LANES[1][:2], strict=True)]).T
    assert module("peers.problem").errors(found, right).max() < 1e-5


def test_lanes_dealt_to_devices_come_back_in_their_order():
    dealt = module("peers.on_devices").dealt
    which = dealt(256, 2)
    assert which.shape == (2, 128)
    assert sorted(which.ravel()) == list(range(256))
    assert which[0, 64] == 128  # the second run of the first device
    with pytest.raises(ValueError, match="5 lanes"):
        dealt(5, 2)


def test_the_first_accurate_setting_is_taken():
    best = module("record").best
    points = [{"setting": s, "error": e} for s, e in ((1.0, 0.5), (0.5, 0.01), (0.25, 0.1), (0.1, 0.001))]
    assert best(points, 0.02)["setting"] == 0.5
    assert best(points[:3], 0.001)["setting"] == 0.5
    assert best([], 1.0) is None


def test_times_are_taken_in_turn_and_ratios_within_a_round():
    record, order = module("record"), []
    takers = {name: lambda name=name: order.append(name) or float(len(order)) for name in "ab"}
    assert record.in_turn(takers, 2) == {"a": [1.0, 3.0], "b": [2.0, 4.0]}
    assert order == ["a", "b", "a", "b"]
    assert record.ratio([2.0, 30.0, 4.0], [1.0, 10.0, 4.0]) == 2.0


def test_every_peer_has_a_ladder_without_a_gap():
    """At most half a decade from one setting to the next, the same for every peer that is given the same thing."""
    ladders = {}
    for path in sorted((FOLDER / "peers").glob("*_*.py")):
        named = re.findall(r"^LADDER = (.*)$", path.read_text(encoding="utf-8"), re.MULTILINE)
        if named:
            ladders[path.stem] = named[0]
    families = module("peers.serve").FAMILIES.values()
    ours = {name: peer for family in families for name, peer in module(f"peers.{family}").PEERS.items()}
    assert set(ladders) | set(ours) == set(module("bench_peers").PEERS)
    assert set(ladders.values()) == {"TOLERANCES", "STEPS"}, ladders
    ladder = module("peers.ladder")
    assert {peer.LADDER for peer in ours.values()} == {ladder.TOLERANCES, ladder.STEPS}
    for settings in (ladder.TOLERANCES, ladder.STEPS):
        assert all(1 < a / b < 3.4 for a, b in itertools.pairwise(settings))


@pytest.mark.slow
def test_a_peer_that_is_not_there_says_so_and_the_others_go_on(tmp_path, monkeypatch, capsys):
    bench, out = module("bench_peers"), tmp_path / "peers.json"
    monkeypatch.setattr(bench, "PEERS", ("scipy_loop", "nobody", "c_none"))
    arguments = [
        "--peers",
        "scipy_loop",
        "nobody",
        "c_none",
        "--lanes",
        "4",
        "--rounds",
        "2",
        "--threads",
        "1",
        "--out",
        str(out),
    ]
    monkeypatch.setattr(sys, "argv", ["bench_peers.py", *arguments])
    bench.main()
    said = capsys.readouterr().out
    assert "nobody: No module named 'peers.nobody'" in said
    assert "c_none: 'c_none'" in said
    assert all(len(line) <= 80 for line in said.splitlines() if "│" in line)
    rows = json.loads(out.read_text())["rows"]
    assert rows["scipy_loop"]["accurate"]
    assert rows["scipy_loop"]["of_first"] == 1.0
    assert "run_s" not in rows["nobody"]


@pytest.mark.slow
def test_the_price_of_a_gradient_is_measured(tmp_path, monkeypatch):
    bench, out = module("bench_gradient"), tmp_path / "gradient.json"
    small = ["--quick", "--rounds", "1", "--loops", "lmi", "--lanes", "4", "--step", "2e-3", "--out", str(out)]
    monkeypatch.setattr(sys, "argv", ["bench_gradient.py", *small])
    bench.main()
    rows = json.loads(out.read_text())["loops"]["lmi"]["rows"]
    assert rows["reverse"]["ratio"] > 0
    assert rows["forward 1"]["ratio"] > 0


@pytest.mark.slow
def test_the_yardsticks_agree(tmp_path, monkeypatch):
    """Kernel, C++ and diffrax on the same lanes; the ball's derivative; the end of explicit steps."""
    bench, out = module("bench_yardsticks"), tmp_path / "yardsticks.json"
    small = ["--lanes", "40", "--block", "8", "--rounds", "1", "--ends", "1", "1e3", "--out", str(out)]
    monkeypatch.setattr(sys, "argv", ["bench_yardsticks.py", *small])
    bench.main()
    found = json.loads(out.read_text())
    assert len(found["lorenz"]) == 8
    assert all(row["error"] <= 1e-8 and row["of_kernel"] > 0 for row in found["lorenz"])
    assert all(found["ball"][name]["error"] <= 1e-6 for name in ("diffabs", "diffrax"))
    assert [row["d.solve"]["status"] for row in found["robertson"]] == ["FINISHED", "DIVERGED"]
    assert found["robertson"][0]["d.solve"]["error"] < 1e-5
    assert all(row["error"] < 1e-9 for row in module("bench_gpu").ensemble(40, "float64", 1))


@pytest.mark.slow
def test_the_car_by_hand_is_the_car_of_our_parts(monkeypatch):
    """Kernel and C++ agree on every run; with another driver in the C++ the benchmark refuses to compare."""
    bench = module("bench_car")
    fixed, adaptive = (
        bench.measured(lanes=12, step=1e-3, rounds=1, threads=1, dtype="float64", kind=kind)
        for kind in ("fixed", "adaptive")
    )
    assert len(fixed) == 4
    assert all(row["difference"] < 1e-12 and row["runs_per_s_and_core"] > 0 for row in fixed.values())
    assert all(row["error"] < 1e-7 for row in fixed.values())
    assert len(adaptive) == 3
    assert all(row["error"] <= bench.GOAL for row in adaptive.values())
    constants = bench.constants()
    monkeypatch.setattr(bench, "constants", lambda: constants | {"GAIN": "0.0301"})
    with pytest.raises(SystemExit, match=r"C\+\+, flags of the kernel: the ends differ by"):
        bench.measured(lanes=12, step=1e-3, rounds=1, threads=1, dtype="float64", kind="fixed")


@pytest.mark.slow
def test_the_car_by_hand_has_a_single_precision():
    bench = module("bench_car")
    ends = {
        (dtype, kind): bench.by_hand(*bench.drawn(16), dtype, kind, setting, 1)()
        for dtype in bench.REALS
        for kind, setting in (("fixed", 1e-3), ("adaptive", 1e-6))
    }
    truth = ends["float64", "fixed"]
    assert bench.difference(ends["float64", "adaptive"], truth) < 1e-6
    for kind in ("fixed", "adaptive"):
        single = ends["float32", kind]
        assert single.dtype == np.float32
        assert 1e-8 < bench.difference(single, truth) < bench.AGREEMENT["float32"]


RECORD = {"loops": {"lmi": {"rows": {"forward 1": {"ratio": 2.0}, "reverse": {"ratio": 6.0}}}}}


@pytest.mark.parametrize(("reverse", "status"), [(6.0, 0), (8.9, 0), (9.1, 1), (float("nan"), 1)])
def test_a_worse_ratio_is_named_and_sets_the_exit_status(tmp_path, monkeypatch, capsys, reverse, status):
    RECORD["loops"]["lmi"]["rows"]["reverse"]["ratio"] = reverse
    (tmp_path / "gradient.json").write_text(json.dumps(RECORD))
    stored, check = tmp_path / "ratios.json", module("check")
    stored.write_text(json.dumps({"gradient": {"lmi: forward 1 over value": 2.0, "lmi: reverse over value": 6.0}}))
    command = ["check.py", "gradient", "--records", str(tmp_path), "--stored", str(stored)]
    monkeypatch.setattr(sys, "argv", command)
    assert check.main() == status
    said = capsys.readouterr().err
    assert ("worse: gradient, lmi: reverse over value" in said) == bool(status)
    assert "forward" not in said
    monkeypatch.setattr(sys, "argv", [*command, "--store"])
    assert check.main() == 0
    monkeypatch.setattr(sys, "argv", command)
    assert check.main() == int(reverse != reverse)


def test_ratios_that_are_new_or_missing_are_not_worse():
    compared = module("check").compared
    assert compared({"a": 3.0}, {"b": 1.0}, 1.3) == [("b", "-", "1", "not measured"), ("a", "3", "-", "new")]


def test_every_stored_ratio_is_one_that_a_benchmark_can_give():
    check = module("check")
    stored = json.loads(check.STORED.read_text(encoding="utf-8"))
    assert set(stored) == set(check.RUNS)
    assert all(value > 0 for each in stored.values() for value in each.values())


def test_the_figure_has_a_panel_for_each_problem(tmp_path):
    matplotlib = pytest.importorskip("matplotlib")
    draw = module("draw_work_precision")
    points = [
        {"solver": kind, "setting": s, "lanes": 64, "error": s, "run_s": 1 / s}
        for kind in ("fixed", "adaptive")
        for s in (1e-2, 1e-4)
    ]
    found = {"float64": {name: {"title": name, "points": points} for name in ("lmi", "arm")}}
    whole = {"found": found, "asked": 1e-4, "lanes": [64]}
    point = {"error": 1e-4, "runs_per_s": 1e5}
    peers = {"threads": 2, "points": {"c_adaptive": [point], "diffabs_adaptive": [point]}}
    figure = draw.panels(whole, peers, 64, "float64")
    assert [len(axes.lines) for axes in figure.axes] == [3, 3]  # with the line of what is asked
    assert figure.axes[0].lines[0].get_xdata()[0] == pytest.approx(1e-5)
    assert figure.axes[1].lines[0].get_xdata()[0] == pytest.approx(100 / 64)
    with pytest.raises(ValueError, match="3 lanes were not run"):
        draw.panels(whole, None, 3, "float64")
    matplotlib.pyplot.close(figure)


def test_useful_operations_are_those_of_real_numbers_in_a_step():
    """Not what is worked out before it, nor whole numbers, nor what only chooses."""
    from diffabs.compiler.program import lower_functions
    from diffabs.compiler.trace import trace_functions

    def step(lane, carry):
        x, k = carry
        return jnp.where(x > 1.0, (x * lane + 2.0 * lane) / x - 1.0, x), k + 1

    found = lower_functions(trace_functions({"step": step}, 1.0, (1.0, 1)))
    assert module("bench_gpu").arithmetic(found) == 4


def test_the_gpu_is_asked_for_first(monkeypatch):
    monkeypatch.setattr(sys, "argv", ["bench_gpu.py"])
    with pytest.raises(SystemExit, match="JAX runs on no GPU here"):
        module("bench_gpu").main()
