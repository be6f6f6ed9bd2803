"""Has a ratio that we state become worse? Runs the benchmarks in short, and compares ratios only, not seconds.

    gradient   a forward gradient in one parameter, and one in reverse mode, in rollouts of the same round
    riccati    10,000 equations in one vmap over a loop over SciPy
    rollout    runs per second over those of diffrax, both to 1e-4 in the worst lane
    design     a program written by hand in cvxpy over ours

The bounds leave a noisy machine a third. Prints a table; exit status 1 if a bound does not hold.

    python benchmarks/guard.py [gradient riccati rollout design]
"""

import json
import pathlib
import subprocess
import sys
from collections.abc import Callable
from typing import Any, NamedTuple

from rich.console import Console
from rich.table import Table

HERE = pathlib.Path(__file__).parent
OUT = pathlib.Path("out/benchmarks")


class Bound(NamedTuple):
    """A ratio of a record of a benchmark, and how small it must be."""

    name: str
    ratio: Callable[[dict[str, Any]], float]
    most: float


def _runs(record: dict[str, Any], word: str) -> float:
    return max(row["runs_per_s"] for row in record["rows"] if word in row["program"])


RUNS = {
    "gradient": ("--quick", "--rounds", "5", "--loops", "lmi", "latch"),
    "riccati": ("--part", "300"),
    "rollout": ("--lanes", "128"),
    "design": ("--weights", "15"),
}
BOUNDS = {
    "gradient": [
        Bound(f"{loop}: {kind}", lambda r, loop=loop, kind=kind: r["loops"][loop]["rows"][kind]["ratio"], most)
        for loop in ("lmi", "latch")
        for kind, most in (("forward 1", 4.0), ("reverse", 12.0))  # steps end on kinks
    ],
    "riccati": [
        Bound("seconds over SciPy's", lambda r: _seconds(r, "diffabs, vmap") / _seconds(r, "SciPy, loop"), 0.08)
    ],
    "rollout": [Bound("diffrax's runs/s over ours", lambda r: _runs(r, "diffrax") / _runs(r, "diffabs"), 3.0)],
    "design": [
        Bound(
            "ms over those by hand", lambda r: r["rows"]["solve"]["median_ms"] / r["rows"]["by hand"]["median_ms"], 0.5
        )
    ],
}


def _seconds(record: dict[str, Any], name: str) -> float:
    return record["rows"][name]["seconds"]


def _median(record: dict[str, Any], name: str) -> float:
    return record["rows"][name]["median_ms"]


def main(wanted: list[str]) -> int:
    """Run, compare, print. Returns the exit status."""
    if unknown := set(wanted) - set(RUNS):
        print(f"no benchmark is called {', '.join(sorted(unknown))}; there is {', '.join(RUNS)}", file=sys.stderr)
        return 2
    table = Table("benchmark", "ratio", "measured", "bound")
    bad = 0
    for name in wanted or RUNS:
        subprocess.run([sys.executable, HERE / f"bench_{name}.py", *RUNS[name]], check=True, stdout=subprocess.DEVNULL)
        record = json.loads((OUT / f"{name}.json").read_text(encoding="utf-8"))
        for bound in BOUNDS[name]:
            value = bound.ratio(record)
            bad += value > bound.most
            table.add_row(
                name, bound.name, f"{value:.3g}", f"<= {bound.most:g}{' FAILS' if value > bound.most else ''}"
            )
    Console().print(table)
    return min(bad, 1)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
