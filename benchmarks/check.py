"""Has a ratio become worse? Runs the benchmarks in short, and compares ratios, never times, with those in ratios.json.

    gradient         a forward gradient in one parameter, and one in reverse mode, in rollouts of the same round
    riccati          10,000 equations in one vmap over a loop over SciPy
    design           a program of ours over one written by hand in cvxpy
    peers            seconds of Adaptive over those of C, of diffrax, and of our fixed steps, all to 1e-4 on every lane
    work-precision   seconds of Adaptive over those of fixed steps on our own problems, both to 1e-4 on every lane
    car              seconds of the kernel over those of C++ by hand on the car with four wheels, in float64

The less the better, all of them. One line for each; exit status 1 if one is more than `--factor` times what is stored.
A peer that is not installed is not compared. `--store` keeps what was found instead.

    python benchmarks/check.py [gradient riccati design peers work-precision car] [--store] [--records DIR]
"""

import argparse
import json
import os
import pathlib
import statistics
import subprocess
import sys
from collections.abc import Callable, Iterator
from typing import Any

import record
from rich.console import Console
from rich.table import Table

HERE = pathlib.Path(__file__).parent
STORED = HERE / "ratios.json"
FACTOR = 1.5  # a machine that does something else moves a ratio by as much
LANES = 1024  # of work-precision
ASKED = 1e-4
RUNS = {
    "gradient": ("--quick", "--rounds", "5", "--loops", "lmi", "latch"),
    "riccati": ("--part", "300"),
    "design": ("--weights", "15"),
    "peers": ("--rounds", "3", "--peers", "diffabs_adaptive", "diffabs_fixed", "c_adaptive", "diffrax_event"),
    "work-precision": (
        "--lanes",
        f"{LANES}",
        "--distinct",
        "64",
        "--problems",
        "est-latch",
        "slip-cured",
        "arm",
    ),
    "car": ("--lanes", "1024", "--rounds", "3"),
}
ENVIRONMENTS = {"riccati": {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}}  # SciPy at its best


def gradient(found: dict[str, Any]) -> Iterator[tuple[str, float]]:
    """Yield name and value of each ratio."""
    for loop, each in found["loops"].items():
        for kind in ("forward 1", "reverse"):
            yield f"{loop}: {kind} over value", each["rows"][kind]["ratio"]


def riccati(found: dict[str, Any]) -> Iterator[tuple[str, float]]:
    """Yield name and value of each ratio."""
    yield "vmap over SciPy", found["rows"]["diffabs, vmap"]["seconds"] / found["rows"]["SciPy, loop"]["seconds"]


def design(found: dict[str, Any]) -> Iterator[tuple[str, float]]:
    """Yield name and value of each ratio."""
    yield "program over by hand", found["rows"]["solve"]["median_ms"] / found["rows"]["by hand"]["median_ms"]


def peers(found: dict[str, Any]) -> Iterator[tuple[str, float]]:
    """Yield name and value of each ratio; a peer that failed, or is not accurate, has none."""
    for name, row in found["rows"].items():
        if name != found["first"] and row.get("accurate"):
            yield f"{found['first']} over {name}", row["of_first"]


def work_precision(found: dict[str, Any]) -> Iterator[tuple[str, float]]:
    """Yield name and value of each ratio, in float64."""
    for name, problem in found["found"]["float64"].items():
        best = {}
        for kind in ("adaptive", "fixed"):
            points = [p for p in problem["points"] if p["solver"] == kind and p["lanes"] == LANES]
            point = record.best(points, ASKED)
            if point and point["error"] <= ASKED:
                best[kind] = statistics.median(point["seconds"])
        if len(best) == 2:
            yield f"{name}: adaptive over fixed", best["adaptive"] / best["fixed"]


def car(found: dict[str, Any]) -> Iterator[tuple[str, float]]:
    """Yield name and value of each ratio."""
    for kind, programs in found["rows"].items():
        for name, row in programs.items():
            if name.startswith("C++"):
                yield f"{kind}: kernel over {name}", row["speed_over_kernel"]


READERS: dict[str, Callable[[dict[str, Any]], Iterator[tuple[str, float]]]] = {
    "gradient": gradient,
    "riccati": riccati,
    "design": design,
    "peers": peers,
    "work-precision": work_precision,
    "car": car,
}


def measured(name: str, records: pathlib.Path | None) -> dict[str, float]:
    """Return the ratios of a benchmark: of a run now, or of the record in a folder."""
    path = (records or record.OUT / "check") / f"{name}.json"
    if records is None:
        command = [sys.executable, HERE / f"bench_{name.replace('-', '_')}.py", *RUNS[name], "--out", path]
        environment = {**os.environ, **ENVIRONMENTS.get(name, {})}
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL, env=environment)
    return dict(READERS[name](json.loads(path.read_text(encoding="utf-8"))))


def compared(found: dict[str, float], stored: dict[str, float], factor: float) -> list[tuple[str, str, str, str]]:
    """Return a line for each ratio found or stored: its name, value, what is stored, and the verdict, "worse" for more
    than `factor` times as much (or for no number)."""
    lines = []
    for name in {**stored, **found}:
        value, before = found.get(name), stored.get(name)
        if value is None:
            lines.append((name, "-", f"{before:.3g}", "not measured"))
        elif before is None:
            lines.append((name, f"{value:.3g}", "-", "new"))
        else:
            verdict = "ok" if value <= factor * before else f"worse, {value / before:.2f} times"
            lines.append((name, f"{value:.3g}", f"{before:.3g}", verdict))
    return lines


def main() -> int:
    """Run, compare, print. Returns the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", metavar="benchmark", help=f"of {', '.join(RUNS)}; none is all")
    parser.add_argument("--factor", type=float, default=FACTOR)
    parser.add_argument("--store", action="store_true", help="keep the ratios found as those to compare with")
    parser.add_argument("--records", type=pathlib.Path, help="compare the records in this folder, run nothing")
    parser.add_argument("--stored", type=pathlib.Path, default=STORED, help="the file of ratios")
    options = parser.parse_args()
    if unknown := set(options.names) - set(RUNS):
        parser.error(f"no benchmark is called {', '.join(sorted(unknown))}; there is {', '.join(RUNS)}")
    stored = json.loads(options.stored.read_text(encoding="utf-8")) if options.stored.exists() else {}
    table = Table("benchmark", "ratio", "now", "stored", f"at most {options.factor:g} times", width=80)
    worse = []
    for name in options.names or RUNS:
        found = measured(name, options.records)
        for line in compared(found, stored.get(name, {}), options.factor):
            table.add_row(name, *line)
            worse += [f"{name}, {line[0]}: {line[1]}, was {line[2]}"] if line[3].startswith("worse") else []
        stored[name] = found
    Console(width=80).print(table)
    if options.store:
        rounded = {name: {key: float(f"{x:.3g}") for key, x in each.items()} for name, each in stored.items()}
        options.stored.write_text(json.dumps(rounded, indent=2) + "\n", encoding="utf-8")
        return 0
    for line in worse:
        print(f"worse: {line}", file=sys.stderr)
    return min(len(worse), 1)


if __name__ == "__main__":
    sys.exit(main())
