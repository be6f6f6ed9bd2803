"""Robust design: what a new weight or a new gain costs, against a program written out in cvxpy each time.

The rig of [lmi], four vertices (5.3 and 6.2 kg, 5 and 50 km/h). One run, medians over random weights; both sides solve
with Clarabel in good units, and agree on the cost to the accuracy shown.

    solve     the parametrised program (eqs. 30-32), coefficients included
    design    the same with Riccati lower bounds, duality gap, and the exact proof of the gain
    certify   any gain: quadratic stability or its impossibility, proved
    by hand   eqs. (30)-(32) in cvxpy's language, compiled anew as a script does it

    python benchmarks/bench_design.py [--weights 40]
"""

import argparse
import json
import pathlib
import statistics
import time
import warnings

import cvxpy as cp
import numpy as np
import record
from rich.console import Console
from rich.table import Table

from diffabs.robust.design import Polytope, Spec, certify, design
from diffabs.robust.design.sdp import solver
from diffabs.robust.design.sdp.program import DesignProgram
from diffabs.robust.design.sdp.scaling import design_frames

BETA, ALPHAS, SPEEDS = 133.472842636189, (83.8796606703, 84.6321445666), (140.291806958, 14.0291806958)
PAIRS = [(alpha, speed) for alpha in ALPHAS for speed in SPEEDS]
RIG = Polytope(
    A=[[[0, 1], [0, alpha / speed]] for alpha, speed in PAIRS], B=[[[0], [BETA / speed]] for _, speed in PAIRS]
)


def solved(spec):
    """Only the program, in the first frame."""
    frame, _ = next(iter(design_frames(RIG, spec.Q, spec.R)))
    program = DesignProgram(RIG, RIG, spec, frame)
    c = program.objective()
    return float(c @ solver.solve_sdp(c, program.blocks(1.0)).y) * program.scale


def by_hand(spec):
    """The program in cvxpy, in the units that REFERENCE of [lmi] asks for: time, integral, torque, cost."""
    q1, q2, r = spec.Q[0, 0], spec.Q[1, 1], spec.R[0, 0]
    t = np.sqrt(SPEEDS[0] / (BETA * np.sqrt(q1 / r)))
    unit = np.diag([t, 1.0])
    torque = np.sqrt(q2 / r) + np.sqrt(2 * np.sqrt(q1 / r) * SPEEDS[0] / BETA)
    q = unit @ spec.Q @ unit
    cost = max(q.max(), r * torque**2)
    x, z, f = cp.Variable((2, 2), symmetric=True), cp.Variable((2, 2), symmetric=True), cp.Variable((1, 2))
    root, effort = np.sqrt(q / cost), np.sqrt(r * torque**2 / cost)
    constraints = [cp.bmat([[z, np.eye(2)], [np.eye(2), x]]) >> 0]
    for a, b in zip(RIG.A, RIG.B, strict=True):
        flow = t * (np.linalg.inv(unit) @ a @ unit @ x + np.linalg.inv(unit) @ b * torque @ f)
        rows = [[-(flow + flow.T), x @ root, effort * f.T], [root @ x, np.eye(2), np.zeros((2, 1))]]
        constraints.append(cp.bmat([*rows, [effort * f, np.zeros((1, 2)), np.eye(1)]]) >> 0)
    weights = cost * t / np.diag(unit) ** 2 / (cost * t)
    problem = cp.Problem(cp.Minimize(weights[0] * z[0, 0] + weights[1] * z[1, 1]), constraints)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            problem.solve(solver="CLARABEL", **solver.OPTIONS["CLARABEL"])
        except cp.SolverError:
            return float("nan")
    return float(problem.value) * cost * t


def timed(function, arguments):
    """Median milliseconds over the arguments after one call, and the answers."""
    function(arguments[0])
    times, answers = [], []
    for argument in arguments:
        begun = time.perf_counter()
        answers.append(function(argument))
        times.append(1e3 * (time.perf_counter() - begun))
    return statistics.median(times), answers


def main():
    """Time the four, print a table, write JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--weights", type=int, default=40)
    parser.add_argument("--out", type=pathlib.Path)
    options = parser.parse_args()
    random = np.random.default_rng(0)
    draws = 10.0 ** np.stack([random.uniform(0, 8, options.weights), random.uniform(0, 4, options.weights)], 1)
    specs = [Spec(Q=q, R=1.0).check(2, 1) for q in draws]
    solve, costs = timed(solved, specs)
    designing, designs = timed(lambda spec: design(RIG, spec), specs)
    gains = [found.gain for found in designs] + [found.gain * [[1.0, 0.3]] for found in designs]
    certifying, proofs = timed(lambda gain: certify(gain, RIG), gains)
    hand, others = timed(by_hand, specs)
    failed = sum(np.isnan(others))
    off = [float(np.nanmax(np.abs(np.array(ours) / others - 1))) for ours in (costs, [d.trace_cost for d in designs])]
    rows = {
        "solve": {"median_ms": solve, "relative_difference": off[0]},
        "design": {"median_ms": designing, "relative_difference": off[1]},
        "certify": {
            "median_ms": certifying,
            "proved_stable": sum(p.quadratically_stable is True for p in proofs),
            "proved_impossible": sum(p.quadratically_stable is False for p in proofs),
            "of": len(proofs),
        },
        "by hand": {"median_ms": hand, "failed": int(failed)},
    }
    report(rows, options)


def report(rows, options):
    """A table, and JSON with machine and versions."""
    table = Table("", "median [ms]", "by hand / this", "largest relative difference of the cost")
    for name, row in rows.items():
        ratio = rows["by hand"]["median_ms"] / row["median_ms"]
        difference = row.get("relative_difference")
        table.add_row(
            name, f"{row['median_ms']:.2f}", f"{ratio:.1f}", "" if difference is None else f"{difference:.1e}"
        )
    Console().print(table)
    found = {"rows": rows, "weights": options.weights}
    path = record.written("design", found, options.out, ("numpy", "scipy", "cvxpy", "clarabel"))
    print(json.dumps(rows["certify"]), f"by hand, failed: {rows['by hand']['failed']};", path)


if __name__ == "__main__":
    main()
