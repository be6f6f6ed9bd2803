"""Proofs over boxes: against closed forms, against SciPy and runs of the simulator, and false claims."""

import dataclasses
import math
from fractions import Fraction
from typing import Any

import numpy as np
import pytest
from marks import cases
from mutants import killed_by
from scipy.integrate import solve_ivp

import diffabs as d
from diffabs.parts.objectives import Overshoot, StopDistance, StopTime
from diffabs.robust.reach import NoRule, RunClaim, cover_box
from diffabs.robust.reach.cover import _cut_to_size, comes_from_halving
from diffabs.robust.reach.engine import FAILURES, Prover
from diffabs.robust.reach.equations import Equations, RealOperation, derive_equations
from diffabs.scenario.scenario import load

pytestmark = pytest.mark.usefixtures("native_prover", "any_step_is_stable")
LIMITED = ["controller.low=0", "controller.high=9.03"]
SMALL = {"plant.mass": (5.3, 5.32), "initial.speed": (6.0, 6.05)}  # kg, m/s


def oscillator(period: float | None = None) -> Equations:
    """x' = v, v' = -x from (p, 0): x = p cos t. With a period, a tick halves both."""
    operations = [
        RealOperation("param", (), 0), RealOperation("state", (), 0), RealOperation("state", (), 1),
        RealOperation("neg", (1,)),
        RealOperation("const", (), 0.0), RealOperation("const", (), 1.0), RealOperation("state", (), 2),
        RealOperation("const", (), 0.5),
        RealOperation("mul", (1, 7)), RealOperation("mul", (2, 7)),
    ]  # fmt: skip
    return Equations(
        tuple(operations), ("p",), ("x", "v", "t"), (0, 4, 4), (2, 3, 5), (8, 9, 6) if period else (), period,
        {"x": 1, "v": 2}, 5, (), -1, -1, 2, False,
    )  # fmt: skip


@killed_by(
    "robust/reach/native/prove.cpp",
    "remainder[i] = rest.value(state_op[i], order + 1) * power;",
    "remainder[i] = I(0.0) * power;",
)
@killed_by(
    "robust/reach/native/prove.cpp",
    "for (int k = order; k-- > 0;) sum = sum * H + mid.value(a, k);",
    "for (int k = order - 1; k-- > 0;) sum = sum * H + mid.value(a, k);",
)
def test_oscillator_against_its_closed_form() -> None:
    prover = Prover(oscillator(), ("x", "v"), 2.0, order=3, tolerance=1e-6)
    found = prover.prove(np.array([[[1.0, 1.001]]]), 1)
    assert found.status[0] == 2
    low, high = found.lower[0], found.upper[0]
    assert low[0] <= 1.0 * math.cos(2.0) * 1.001
    assert high[0] >= 1.001
    assert low[1] <= -1.001
    assert high[1] >= 0.0
    assert low[0] > 1.001 * math.cos(2.0) - 1e-3
    assert high[0] < 1.002
    assert low[1] > -1.003
    # The bound that every run reaches is one that the run with the least amplitude reaches.
    assert 1.0 - 1e-3 < found.above[0, 0] <= 1.0
    assert -1.0 <= found.below[0, 1] < -1.0 + 1e-2


@killed_by("robust/reach/native/series.h", "y[j] = -slope(a, k)[j]; return;", "y[j] = slope(a, k)[j]; return;")
@killed_by("robust/reach/native/prove.cpp", "fine ? -bottom[s][lane] : -INFINITY", "fine ? top[s][lane] : -INFINITY")
def test_a_wide_oscillator_against_its_closed_form() -> None:
    found = Prover(oscillator(), ("x", "v"), 3.0).prove(np.array([[[0.5, 1.5]]]), 1)
    assert found.status[0] == 2
    assert -1.6 < found.lower[0, 0] <= 1.5 * math.cos(3.0)
    assert 1.5 <= found.upper[0, 0] < 1.6
    assert -1.6 < found.lower[0, 1] <= -1.5


def test_ticks_against_their_closed_form() -> None:
    """Every 0.25 s both states are halved, also at t = 0; between, the oscillator turns by 0.25."""
    prover = Prover(oscillator(0.25), ("x",), 1.0)
    found = prover.prove(np.array([[[1.0, 1.0]]]), 1)
    x, v, least = 1.0, 0.0, 1.0
    for _ in range(4):
        x, v = 0.5 * x, 0.5 * v
        x, v = x * math.cos(0.25) + v * math.sin(0.25), v * math.cos(0.25) - x * math.sin(0.25)
        least = min(least, x)
    assert found.lower[0, 0] <= least < found.lower[0, 0] + 1e-4
    assert 0.5 <= found.upper[0, 0] < 0.5 + 1e-6


def rig_run(mass: float, speed: float, high: float = 9.03) -> tuple[float, float, float]:
    """Greatest slip, stop time and distance of the rig under the published gain, by SciPy and the paper's equations."""
    r1, r2, J1, g, c = 0.0995, 0.099, 7.53e-3, 9.81, 0.5

    def mu(s):
        return 0.407 * s**2.1 / (2.57e-4 + s**2.1) + s * (-4.24e-2 + s * (2.94e-10 + s * 3.51e-2))

    holding = mu(0.2) * g * (mass * r1 + 0.8 * J1 / (c * r1))

    def rates(t: float, z: np.ndarray) -> list[float]:
        w1, w2, integral, _ = z
        s = max(1 - r1 * w1 / (r2 * w2), 0.0)
        torque = min(max(holding - 11753 * integral - 48 * (s - 0.2), 0.0), high)
        return [(mass * g * r1 * mu(s) - torque) / J1, -g * mu(s) / (c * r2), s - 0.2, r2 * w2]

    def end(t, z):
        return r2 * z[1] - 5 / 3.6

    end.terminal = True
    found = solve_ivp(
        rates, (0, 3), [speed / r1, speed / r2, 0, 0], "LSODA", rtol=1e-10, atol=1e-12, events=end, max_step=1e-4
    )
    return float(np.max(1 - r1 * found.y[0] / (r2 * found.y[1]))), float(found.t[-1]), float(found.y[3, -1])


@pytest.mark.slow
def test_published_gain_within_its_limits() -> None:
    proof = cover_box(
        load("slip-lmi", LIMITED, integrated=False).loop,
        SMALL,
        [RunClaim("greatest slip", 0.34)],
        signals=("slip",),
        horizon=2.0,
        budget=100,
    )
    assert proof.verdict == "proved"
    slip, time, distance = (proof.bounds[name] for name in ("greatest slip", "stop_time", "stop_distance"))
    runs = np.array([rig_run(m, v) for m in SMALL["plant.mass"] for v in SMALL["initial.speed"]])
    for column, (low, high) in zip(runs.T, (slip, time, distance), strict=True):
        assert low <= column.min()
        assert column.max() <= high
        assert high - column.max() < 2e-3 * column.max()


@pytest.mark.slow
@killed_by("robust/reach/native/prove.cpp", "rate.mid() * (inverse_rate.mid()", "0.0 * (inverse_rate.mid()")
@killed_by(
    "robust/reach/native/prove.cpp", "end.caused(end.way_G, end.speed, p)", "end.caused(end.time_G, end.speed, p)"
)
def test_the_sides_of_a_cell_widen_time_and_distance_as_in_runs() -> None:
    prover = Prover(derive_equations(load("slip-lmi", LIMITED, integrated=False).loop, list(SMALL)), ("slip",), 2.0)
    prover.choose_weights(np.array([5.3, 6.0]))
    found = prover.prove(np.array([[[5.3, 5.302], [6.0, 6.01]]]), 1)
    near, heavy, fast = (np.array(rig_run(*at)[1:]) for at in ((5.3, 6.0), (5.302, 6.0), (5.3, 6.01)))
    halves = np.abs(np.stack([heavy - near, fast - near], 1)) / 2
    np.testing.assert_allclose(found.reach[0, 1:], halves, rtol=0.1)


@pytest.mark.slow
@killed_by("robust/reach/native/prove.cpp", "if (q < 0) return;", "if (q < n) return;")
def test_a_distance_that_is_a_signal_has_its_bounds() -> None:
    prover = Prover(
        derive_equations(load("slip-lmi", LIMITED, integrated=False).loop, list(SMALL)), ("slip", "distance"), 2.0
    )
    prover.choose_weights(np.array([5.3, 6.0]))
    found = prover.prove(np.array([[[5.3, 5.301], [6.0, 6.001]]]), 1)
    _, time, distance = rig_run(5.3, 6.0)
    assert found.time[0, 0] <= time <= found.time[0, 1]
    assert found.distance[0, 0] <= distance <= found.distance[0, 1]
    assert distance <= found.upper[0, 1]
    assert found.distance[0, 1] - found.distance[0, 0] < 0.01


@pytest.mark.parametrize(
    "quantity", cases(["greatest slip", "stop_time", "stop_distance"], "stop_time", "stop_distance")
)
@pytest.mark.slow
def test_false_claims_are_refuted(quantity: str) -> None:
    column = ("greatest slip", "stop_time", "stop_distance").index(quantity)
    corners = [(m, v) for m in SMALL["plant.mass"] for v in SMALL["initial.speed"]]
    values = [rig_run(*corner)[column] for corner in corners]
    worst = int(np.argmax(values))
    claim = RunClaim(quantity, values[worst] * 0.999)
    loop = load("slip-lmi", LIMITED, integrated=False).loop
    assert cover_box(loop, SMALL, [claim], signals=("slip",), horizon=2.0, budget=1).verdict != "proved"
    assert (
        cover_box(loop, SMALL, [claim], signals=("slip",), horizon=2.0, budget=20, suspects=[corners[worst]]).verdict
        == "refuted"
    )


@pytest.mark.slow
def test_no_false_claim_of_a_hundred_is_proved() -> None:
    """Each claim is 0.1 % better than one run of its box, which SciPy made."""
    rng, loop, prove_time = np.random.default_rng(7), load("slip-lmi", LIMITED, integrated=False).loop, 1.0
    for _ in range(100):
        mass, speed = rng.uniform(5.3, 6.2), rng.uniform(4.0, 9.0)
        shares = rng.uniform(0, 1, 2)
        box = {
            "plant.mass": (mass - 0.01 * shares[0], mass + 0.01 * (1 - shares[0])),
            "initial.speed": (speed - 0.01 * shares[1], speed + 0.01 * (1 - shares[1])),
        }
        column = int(rng.integers(3))
        bound = rig_run(mass, speed)[column] * 0.999
        claim = RunClaim(("greatest slip", "stop_time", "stop_distance")[column], bound)
        assert cover_box(loop, box, [claim], signals=("slip",), horizon=2.0, budget=prove_time).verdict != "proved"


@pytest.mark.slow
def test_without_time_nothing_is_decided() -> None:
    proof = cover_box(
        load("slip-lmi", LIMITED, integrated=False).loop,
        SMALL,
        [RunClaim("greatest slip", 0.34)],
        horizon=2.0,
        budget=1e-9,
    )
    assert proof.verdict == "undecided"
    assert proof.bounds["stop_time"] == (-math.inf, math.inf)


@killed_by("robust.reach.cover", "    _check_claims(claims, equations.signals)\n", "", case="largest slip")
@pytest.mark.parametrize("quantity", ["overshoot", "largest slip", "greatest slop", "greatest slip speed"])
def test_a_claim_about_no_quantity_is_refused(quantity: str) -> None:
    message = f"claims: '{quantity}' is no quantity of this loop; there is stop_time, stop_distance, and .* slip, speed"
    with pytest.raises(ValueError, match=message):
        cover_box(load("slip-lmi", LIMITED, integrated=False).loop, SMALL, [RunClaim(quantity, 0.34)], horizon=2.0)


@killed_by("robust.reach.cover", "if not 0 < value < math.inf:", "if False:", case="a horizon before the start")
@killed_by("robust.reach.cover", "if not math.isfinite(claim.bound):", "if False:", case="a claim without a bound")
@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        pytest.param({"signals": ("slop",)}, r"signals: .slop. is no signal .*; there is .*slip, speed", id="a signal"),
        pytest.param({"over": {}}, r"over: the box has no parameter", id="no box"),
        pytest.param(
            {"over": {"plant.mass": (5.4, 5.3), "initial.speed": (6.1, 6.0)}},
            r"over\.plant\.mass = \[5\.4, 5\.3\]; two numbers below 1e\+150 are needed, the lower first",
            id="an inverted box",
        ),
        pytest.param({"over": {"plant.mass": (5.3, math.inf)}}, r"over\.plant\.mass = \[5\.3, inf\]", id="no end"),
        pytest.param({"over": {"plant.mass": (math.nan, 5.3)}}, r"over\.plant\.mass = \[nan, 5\.3\]", id="no number"),
        pytest.param({"horizon": -1.0}, r"horizon = -1 is outside \(0, inf\) s", id="a horizon before the start"),
        pytest.param({"budget": math.nan}, r"budget = nan is outside \(0, inf\) s", id="a budget that is none"),
        pytest.param(
            {"claims": [RunClaim("stop_time", math.nan)]},
            r"claims: stop_time has the bound nan, outside \(-inf, inf\)",
            id="a claim without a bound",
        ),
    ],
)
def test_a_wrong_argument_of_a_proof_is_named(wrong: dict[str, Any], message: str) -> None:
    given: dict[str, Any] = {"over": {"plant.mass": (5.3, 5.3)}, "horizon": 2.0, "budget": 1.0, **wrong}
    with pytest.raises(ValueError, match=message):
        cover_box(load("slip-lmi", LIMITED, integrated=False).loop, **given)


def test_a_setting_that_does_not_exist_is_refused() -> None:
    wrong: dict[str, Any] = {"tolerances": 1e-9}
    with pytest.raises(TypeError, match="tolerances"):
        Prover(oscillator(), ("x",), 2.0, **wrong)


@killed_by("robust.reach.cover", "FEWEST * np.spacing(np.abs(box).max(1))", "0.0")
@pytest.mark.slow
def test_a_side_of_two_floats_is_not_halved() -> None:
    """A run that stops too late keeps the proof refining; there is no float between two neighbours."""
    box = {"plant.mass": (float(np.nextafter(5.5, 0.0)), float(np.nextafter(5.5, 6.0)))}
    fast = load("slip-lmi", [*LIMITED, "initial.speed_kmh=7"], integrated=False).loop
    proof = cover_box(fast, box, horizon=1.0, budget=60.0, extremes={"stop_time": (0.001, 0.002)})  # it ends at once
    assert proof.cells.tolist() == [[list(*box.values())]]


@killed_by("robust.reach.cover", "_widths(cells) * influence, 0.0)", "_widths(cells) * influence, _widths(cells))")
@killed_by("robust.reach.cover", " & (matters > 0).any(1)", "")
def test_a_short_side_is_not_halved_untried() -> None:
    """The first side has the length of two floats, and matters most; the second is halved until it is too short."""
    box = np.array([[1.0, np.nextafter(1.0, 2.0)], [0.0, 1.0]])
    kept, rest = _cut_to_size(np.repeat(box[None], 5, 0), 0.0, np.array([1e18, 1.0]), np.array([1e-15, 0.2]))
    assert not len(rest)
    assert (kept[:, 0] == box[0]).all()
    assert sorted(kept[4:, 1].tolist()) == [[k / 8, (k + 1) / 8] for k in range(8)]


def test_many_halvings_of_many_sides_are_found() -> None:
    """A corner of six sides that are halved a hundred times each; without one of the cells, a hole is found."""
    box, cells = [[0.0, 1.0]] * 6, []
    left = box
    for i in range(600):
        (low, high), rest = left[i % 6], left[i % 6 + 1 :]
        cells.append([*left[: i % 6], [high / 2, high], *rest])
        left = [*left[: i % 6], [low, high / 2], *rest]
    assert comes_from_halving(box, [*cells, left])
    assert not comes_from_halving(box, [*cells[:-1], left])


@killed_by("robust.reach.cover", "again = now[~satisfied]\n", "again = now[~satisfied][1:]\n")
def test_cells_cover_the_box() -> None:
    worst = max(rig_run(m, v)[0] for m in SMALL["plant.mass"] for v in SMALL["initial.speed"])
    proof = cover_box(
        load("slip-lmi", LIMITED, integrated=False).loop,
        SMALL,
        [RunClaim("greatest slip", worst * 1.0002)],
        signals=("slip",),
        horizon=2.0,
        budget=60,
    )
    assert proof.verdict == "proved"
    assert len(proof.cells) > 1

    def volume(cell):
        return math.prod(Fraction(b) - Fraction(a) for a, b in cell)

    assert sum(volume(cell) for cell in proof.cells.tolist()) == volume(list(SMALL.values()))


@pytest.mark.slow
@pytest.mark.parametrize(("name", "changes", "claim"), [("slip-lmi", LIMITED, 0.37), ("slip-cured", [], 0.21)])
def test_random_runs_lie_within_their_cells(name: str, changes: list[str], claim: float) -> None:
    box = {"plant.mass": (5.3, 5.5), "initial.speed": (6.0, 6.5)}
    chosen = load(name, changes)
    proof = cover_box(chosen.loop, box, [RunClaim("greatest slip", claim)], signals=("slip",), horizon=2.0, budget=200)
    assert proof.verdict == "proved"
    rng = np.random.default_rng(0)
    points = np.stack([rng.uniform(low, high, 10_000) for low, high in box.values()], 1)
    metrics = {"overshoot": Overshoot(), "time": StopTime(), "distance": StopDistance()}
    runs = d.run_batch(chosen.loop, d.Batch(dict(zip(box, points.T, strict=True))), d.FixedStep(5e-5, 2.0), metrics)
    slip = 0.2 * (1 + np.asarray(runs.metrics["overshoot"]))
    for i, point in enumerate(points):
        inside = ((proof.cells[:, :, 0] <= point) & (point <= proof.cells[:, :, 1])).all(1)
        k = int(np.flatnonzero(inside)[0])
        assert slip[i] <= proof.rows.upper[k, 0] + 1e-6
        for column, ends in (("time", proof.rows.time[k]), ("distance", proof.rows.distance[k])):
            assert ends[0] - 1e-6 <= runs.metrics[column][i] <= ends[1] + 1e-6


@killed_by("robust.reach.cover", "if beyond > RUN_ERROR * abs(run):", "if False:")
@pytest.mark.parametrize("both", cases([False, True], True), ids=["above", "at both ends"])
def test_a_run_beyond_a_proved_bound_makes_the_proof_undecided(both: bool) -> None:
    """Either the proof or the run is wrong; a stop after 20 s is."""
    loop, claims = load("slip-lmi", LIMITED, integrated=False).loop, [RunClaim("greatest slip", 0.9)]

    def prove(known):
        return cover_box(loop, {"plant.mass": (5.5, 5.5)}, claims, horizon=2.5, extremes=known)

    alone = prove({})
    assert alone.verdict == "proved"
    low, high = alone.bounds["stop_time"]
    found = prove({"stop_time": (0.1, 20.0) if both else (low, 20.0)})
    assert found.verdict == "undecided"
    assert "a simulated run has stop_time = " in found.failure
    assert not np.isfinite(found.bounds["stop_time"]).any()
    assert not both or prove({"stop_time": (low, high)}).verdict == "proved"
    assert not both or prove({"stop_time": (0.1, high)}).verdict == "undecided"


def test_parts_without_a_rule_are_refused_by_name() -> None:
    with pytest.raises(NoRule, match="events"):
        derive_equations(d.braking(controller=d.controllers.Relay()), ["plant.mass"])
    with pytest.raises(NoRule, match=r"plant\.weight is not a parameter"):
        derive_equations(load("slip-lmi", integrated=False).loop, ["plant.weight"])


def tape(*operations: tuple) -> tuple[RealOperation, ...]:
    """Operations from (name, args) or (name, args, value)."""
    return tuple(RealOperation(name, args, *value) for name, args, *value in operations)


def single(
    operations: tuple[RealOperation, ...], flow: int, *, start: int = 0, margin: int = 4, tick: int = -1,
    period: float | None = None,
) -> Equations:  # fmt: skip
    """One state x, with the time. Operation 0 is the parameter p, 1 is x, 2 the time, 3 is 0 and 4 is 1."""
    return Equations(
        operations, ("p",), ("x", "t"), (start, 3), (flow, 4), (tick, 2) if period else (), period, {"x": 1}, margin,
        (), -1, -1, 1, False,
    )  # fmt: skip


BASIC = (("param", (), 0), ("state", (), 0), ("state", (), 1), ("const", (), 0.0), ("const", (), 1.0))


@killed_by(
    "robust/reach/native/prove.cpp",
    "r.delta = (linear | above | under) ? zero : vmax(gaps.h - middle, gaps.n + middle);",
    "r.delta = zero;",
)
@killed_by("robust/reach/native/prove.cpp", "push[i] = push[i] + Y[i] * symmetric(delta) * HH;", "push[i] = I(0.0);")
@killed_by(
    "robust/reach/native/prove.cpp",
    "I(NEVER) : s.value(c, 0); }",
    "I(NEVER) : scaled(s.value(c, 0), 0.99); }",
    case="short",
)
@pytest.mark.parametrize(("step", "width"), [(0.3, 0.2), (1e-3, 2e-3)], ids=["long", "short"])
def test_a_step_across_a_limit_is_enclosed(step: float, width: float) -> None:
    """x' = min(x, 1) from x(0) = 1/2 in steps of equal length: x = 2 at t = 1 + log 2."""
    operations = tape(*BASIC, ("clamp", (1, -1, 4)), ("const", (), 2.0), ("sub", (6, 1)))
    steps: dict[str, Any] = {"first": step, "shortest": step, "longest": step, "order": 5}
    found = Prover(single(operations, 5, margin=7), ("x",), 9.0, **steps).prove(np.array([[[0.5, 0.5]]]), 1)
    assert found.status[0] == 1
    assert found.time[0, 0] <= 1 + math.log(2.0) <= found.time[0, 1]
    assert found.time[0, 1] - found.time[0, 0] < width


@killed_by("robust/reach/native/prove.cpp", "{&mid, &rest, &whole, &box,", "{&mid, &whole, &box,")
@killed_by("robust/reach/native/prove.cpp", "out[1] = stopped ? -T.n[lane] : 0", "out[1] = stopped ? T.h[lane] : 0")
def test_a_parameter_of_the_flow_is_enclosed() -> None:
    """x' = -p x from x(0) = 1 by steps of low order: x = 1/2 at t = log 2/p."""
    operations = tape(*BASIC, ("mul", (0, 1)), ("neg", (5,)), ("const", (), 0.5), ("sub", (1, 7)))
    e = single(operations, 6, start=4, margin=8)
    found = Prover(e, ("x",), 9.0, order=2, tolerance=1e-3, longest=0.1).prove(np.array([[[2.0, 2.0]]]), 1)
    assert found.status[0] == 1
    assert found.time[0, 0] <= math.log(2.0) / 2 <= found.time[0, 1]
    assert 0 < found.time[0, 1] - found.time[0, 0] < 0.05


@killed_by("robust/reach/native/prove.cpp", "ok &= upper ? there[i].h <= 0 : there[i].n <= 0;", "ok &= mask(true);")
def test_growth_that_is_faster_than_a_step() -> None:
    """x' = 60 x: a box whose faces point outward holds nothing, so the step must be shorter than 1/60 s."""
    operations = tape(*BASIC, ("const", (), 60.0), ("mul", (5, 1)))
    found = Prover(single(operations, 6), ("x",), 0.2, order=8, tolerance=1e9).prove(np.array([[[1.0, 1.0]]]), 1)
    assert found.status[0] == 2
    assert math.exp(12.0) <= found.upper[0, 0]


def test_a_lag_that_is_shorter_than_a_period() -> None:
    """x' = (u - x)/T with T = 0.02 s, u set every 0.1 s to -x/2: one step a period, though Picard needs h < T."""
    operations = tape(
        *BASIC, ("state", (), 2), ("sub", (5, 1)), ("const", (), 50.0), ("mul", (6, 7)), ("const", (), -0.5),
        ("mul", (9, 1)),
    )  # fmt: skip
    e = Equations(
        operations, ("p",), ("x", "t", "u"), (0, 3, 3), (8, 4, 3), (1, 2, 10), 0.1, {"x": 1}, 4, (), -1, -1, 1, False
    )
    found = Prover(e, ("x",), 1.0, order=14, tolerance=1e-3).prove(np.array([[[0.9, 1.0]]]), 1)
    x, least = 1.0, 1.0
    for _ in range(10):
        u = -0.5 * x
        x = u + (x - u) * math.exp(-5.0)
        least = min(least, x)
    assert found.status[0] == 2
    assert found.lower[0, 0] <= least < found.lower[0, 0] + 0.05
    assert 1.0 <= found.upper[0, 0] < 1.05


@killed_by("robust/reach/native/series.h", "y + symmetric(fill(0.5))", "y")
def test_a_rounding_at_a_tick_is_enclosed() -> None:
    """x := x/2 + round(4 x)/16 every second, from x(0) = p: some run of the cell is near each end of the bounds."""
    operations = tape(
        *BASIC, ("const", (), 4.0), ("mul", (1, 5)), ("round", (6,)), ("const", (), 0.0625), ("mul", (7, 8)),
        ("const", (), 0.5), ("mul", (1, 10)), ("add", (9, 11)),
    )  # fmt: skip
    found = Prover(single(operations, 3, tick=12, period=1.0), ("x",), 3.0, longest=1.0).prove(
        np.array([[[0.9, 1.4]]]), 1
    )
    assert found.status[0] == 2
    runs = np.linspace(0.9, 1.4, 1001)
    after = []
    for _ in range(3):
        runs = runs / 2 + np.round(4 * runs) / 16
        after.append(runs)
    assert found.lower[0, 0] <= np.min(after)
    assert np.max(after) <= found.upper[0, 0]
    assert found.lower[0, 0] > np.min(after) - 0.1
    assert found.upper[0, 0] < np.max(after) + 0.1


@killed_by("robust/reach/native/prove.cpp", "x = fill(-INFINITY);", "x = fill(-NEVER);", case="rounding")
@killed_by(
    "robust/reach/native/prove.cpp",
    "symmetric(fill(INFINITY)), both)",
    "symmetric(fill(NEVER)), both)",
    case="no value",
)
@pytest.mark.parametrize("name", ["rounding", "no value"])
def test_what_is_not_proved_has_infinite_bounds(name: str) -> None:
    """x' = -round(x) is relaxed in every step, so no run is followed exactly. 1/x has no value where x may be 0."""
    operations = tape(*BASIC, ("round", (1,)), ("neg", (5,)), ("inv", (1,)))
    e = single(operations, {"rounding": 6, "no value": 4}[name])
    e = dataclasses.replace(e, signals={"x": 1, "y": 7})
    cell = {"rounding": [3.2, 3.21], "no value": [-0.1, 0.2]}[name]
    found = Prover(e, ("x", "y"), 0.05).prove(np.array([[cell]]), 1)
    assert found.status[0] == 2
    assert found.lower[0, 0] <= cell[0]
    assert found.upper[0, 0] >= cell[1]
    if name == "rounding":
        assert (found.above[0, 0], found.below[0, 0]) == (-math.inf, math.inf)
    else:
        assert (found.lower[0, 1], found.upper[0, 1]) == (-math.inf, math.inf)


@killed_by("robust.reach.engine", "live |= set(e.nonnegative)", "pass")
def test_a_state_that_may_not_be_negative_is_always_followed() -> None:
    """x' = -1 from x(0) = p until t = 1/2: nothing reads x, which becomes negative at t = p."""
    operations = tape(*BASIC, ("neg", (4,)), ("const", (), 0.5), ("sub", (6, 2)))
    e = dataclasses.replace(single(operations, 5, margin=7), signals={"t": 2}, nonnegative=(0,))
    found = Prover(e, ("t",), 1.0).prove(np.array([[[0.1, 0.2]], [[0.8, 0.81]]]), 1)
    assert found.status.tolist() == [0, 1]
    assert FAILURES[found.failure[0]] == "the slip may become negative"


def test_a_tube_holds_the_runs_at_every_time() -> None:
    tube = Prover(oscillator(), ("x", "v"), 2.0).follow(np.array([[1.0, 1.001]]))
    assert tube.time[0, 0] == 0.0
    assert tube.time[-1, 1] >= 2.0
    for (begin, end), low, high in zip(tube.time, tube.lower, tube.upper, strict=True):
        for t in (begin, end):
            for p in (1.0, 1.001):
                truth = p * np.array([math.cos(t), -math.sin(t)])
                assert (low <= truth).all()
                assert (truth <= high).all()
        assert (high - low < 0.5).all()  # a step is at most 0.5 s
