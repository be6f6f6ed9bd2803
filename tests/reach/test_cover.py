"""Proofs over boxes: against closed forms, against SciPy and runs of the simulator, and false claims."""

import math
from fractions import Fraction

import numpy as np
import pytest
from mutants import killed_by
from scipy.integrate import solve_ivp

import diffabs as d
from diffabs.objectives import Overshoot, StopDistance, StopTime
from diffabs.reach import NoRule, RunClaim, prove_box
from diffabs.reach.engine import Prover
from diffabs.reach.equations import Equations, RealOperation, derive_equations
from diffabs.scenario.scenario import load

pytestmark = pytest.mark.usefixtures("native_prover")
LIMITED = ["controller.torque_min=0", "controller.torque_max=9.03"]
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
    "reach/native/prove.cpp",
    "remainder[i] = rest.value(state_op[i], order + 1) * power;",
    "remainder[i] = I(0.0) * power;",
)
@killed_by(
    "reach/native/prove.cpp", "C[i] = sum + remainder[i] + push[i];", "C[i] = point((sum + remainder[i]).mid());"
)
def test_oscillator_against_its_closed_form() -> None:
    prover = Prover(oscillator(), ("x", "v"), 2.0, order=3, tolerance=1e-6)
    found = prover.prove(np.array([[[1.0, 1.001]]]), 1)
    assert found.status[0] == 2
    low, high = found.least[0], found.greatest[0]
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


def test_ticks_against_their_closed_form() -> None:
    """Every 0.25 s both states are halved, also at t = 0; between, the oscillator turns by 0.25."""
    prover = Prover(oscillator(0.25), ("x",), 1.0)
    found = prover.prove(np.array([[[1.0, 1.0]]]), 1)
    x, v, least = 1.0, 0.0, 1.0
    for _ in range(4):
        x, v = 0.5 * x, 0.5 * v
        x, v = x * math.cos(0.25) + v * math.sin(0.25), v * math.cos(0.25) - x * math.sin(0.25)
        least = min(least, x)
    assert found.least[0, 0] <= least < found.least[0, 0] + 1e-4
    assert 0.5 <= found.greatest[0, 0] < 0.5 + 1e-6


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


@killed_by(
    "reach/native/prove.cpp",
    "r.delta = (linear | over_ | under) ? zero : vmax(gaps.h - middle, gaps.n + middle);",
    "r.delta = zero;",
)
@killed_by(
    "reach/native/prove.cpp", "push[i] = push[i] + Y[i] * symmetric(delta) * HH;", "push[i] = push[i] + Y[i] * I(0.0);"
)
def test_published_gain_within_its_limits() -> None:
    proof = prove_box(
        load("slip-lmi", LIMITED).loop,
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


@pytest.mark.parametrize("quantity", ["greatest slip", "stop_time", "stop_distance"])
def test_false_claims_are_refuted(quantity: str) -> None:
    column = ("greatest slip", "stop_time", "stop_distance").index(quantity)
    corners = [(m, v) for m in SMALL["plant.mass"] for v in SMALL["initial.speed"]]
    values = [rig_run(*corner)[column] for corner in corners]
    worst = int(np.argmax(values))
    claim = RunClaim(quantity, values[worst] * 0.999)
    loop = load("slip-lmi", LIMITED).loop
    assert prove_box(loop, SMALL, [claim], signals=("slip",), horizon=2.0, budget=3).verdict != "proved"
    assert (
        prove_box(loop, SMALL, [claim], signals=("slip",), horizon=2.0, budget=20, suspects=[corners[worst]]).verdict
        == "refuted"
    )


def test_without_time_nothing_is_decided() -> None:
    proof = prove_box(
        load("slip-lmi", LIMITED).loop, SMALL, [RunClaim("greatest slip", 0.34)], horizon=2.0, budget=1e-9
    )
    assert proof.verdict == "undecided"
    assert proof.bounds["stop_time"] == (-math.inf, math.inf)


def test_cells_cover_the_box() -> None:
    worst = max(rig_run(m, v)[0] for m in SMALL["plant.mass"] for v in SMALL["initial.speed"])
    proof = prove_box(
        load("slip-lmi", LIMITED).loop,
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
    proof = prove_box(chosen.loop, box, [RunClaim("greatest slip", claim)], signals=("slip",), horizon=2.0, budget=200)
    assert proof.verdict == "proved"
    rng = np.random.default_rng(0)
    points = np.stack([rng.uniform(low, high, 2000) for low, high in box.values()], 1)
    metrics = {"overshoot": Overshoot(), "time": StopTime(), "distance": StopDistance()}
    runs = d.run_batch(chosen.loop, d.Batch(dict(zip(box, points.T, strict=True))), d.FixedStep(5e-5, 2.0), metrics)
    slip = 0.2 * (1 + np.asarray(runs.metrics["overshoot"]))
    for i, point in enumerate(points):
        inside = ((proof.cells[:, :, 0] <= point) & (point <= proof.cells[:, :, 1])).all(1)
        k = int(np.flatnonzero(inside)[0])
        assert slip[i] <= proof.rows.greatest[k, 0] + 1e-6
        for column, ends in (("time", proof.rows.time[k]), ("distance", proof.rows.distance[k])):
            assert ends[0] - 1e-6 <= runs.metrics[column][i] <= ends[1] + 1e-6


def test_parts_without_a_rule_are_refused_by_name() -> None:
    with pytest.raises(NoRule, match="events"):
        derive_equations(d.braking(controller=d.controllers.Relay()), ["plant.mass"])
    with pytest.raises(NoRule, match=r"plant\.weight is not a parameter"):
        derive_equations(load("slip-lmi").loop, ["plant.weight"])
