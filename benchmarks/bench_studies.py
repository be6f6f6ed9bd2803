"""How long studies of many runs take by XLA and by a kernel, beside each other: a rare event, a map, a worst case.

    rare         slip-lmi, the road's w4 normal: P(stop_time > 2.26 s) by subset simulation, near 1e-7
    attraction   arm-hanging: which of 10,000 starts are recovered, 60 s at the latest
    worst        slip-cured: the longest way over 100,000 points of a box and its corners, then gradients

Each study and engine is a process of its own. "First" has tracing and compiling in it, "median" those after it. Both
engines see the same points, so that what they find is to agree: a rare event exactly as far as no sample changes sides
by a rounding.

    python benchmarks/bench_studies.py [--rounds 3] [--studies rare attraction worst] [--dtype float32]
"""

import argparse
import dataclasses
import json
import pathlib
import resource
import statistics
import subprocess
import sys

import jax
import numpy as np
import record
from rich.console import Console
from rich.table import Table

from diffabs import FixedStep
from diffabs.robust.design.attraction import Cells, region_of_attraction
from diffabs.scenario import load, section_sweep
from diffabs.tune.worst import worst_case
from diffabs.uncertainty.reliability.failure import failure_probability

ENGINES = ("xla", "kernel")
W4 = 'sweep.over.road.w4={type="normal",mean=0.4,deviation=0.01,low=0.3}'
SLOWEST = 2.26  # [s]
BOX = {"plant.mass": (5.3, 6.2), "initial.speed": (5.6, 19.4), "plant.road.w4": (0.36, 0.44)}


def rare(engine, size):
    """The probability, its interval, and how many runs it took."""
    study = section_sweep.build_study(load("slip-lmi", ["solver.step=1e-3", "solver.duration=4", W4]))
    study = dataclasses.replace(study, engine=engine, dtype=str(jax.numpy.result_type(float)))
    found = failure_probability(study, "stop_time", SLOWEST, samples=size or 2800)
    return {"found": found.probability, "interval": [float(x) for x in found.interval], "runs": found.evaluations}


def map_(engine, size):
    """The share that is recovered."""
    cells = Cells(-0.1, 0.1, round((size or 10_000) ** 0.5))
    found = region_of_attraction(
        load("arm-hanging").loop, cells, cells, FixedStep(step=1e-3, duration=60.0), engine=engine
    )
    return {"found": found.share, "undecided": found.undecided, "runs": cells.number**2}


def worst(engine, size):
    """The longest stop."""
    one = load("slip-cured")
    given = {"over": BOX, "metric": "stop_distance", "solver": one.solver, "measured": one.objectives, "engine": engine}
    found = worst_case(one.loop, **given, screen=size or 100_000)
    return {"found": found.value, "corner": found.corner, "runs": int(found.rollouts)}


STUDIES = {"rare": rare, "attraction": map_, "worst": worst}


def child(options):
    """One study by one engine, in this process: prints a line of JSON."""
    jax.config.update("jax_enable_x64", options.dtype == "float64")
    study, seen, times = STUDIES[options.studies[0]], {}, []
    for _ in range(options.rounds + 1):
        times.append(record.timed(lambda: seen.update(study(options.engine, options.size))))
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(json.dumps({"first": times[0], "times": times[1:], "memory [MB]": memory, **seen}))


def main():
    """Measure, print, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--studies", nargs="+", choices=STUDIES, default=list(STUDIES))
    parser.add_argument("--size", type=int, help="runs, or samples of a level, where not the usual ones")
    parser.add_argument("--dtype", choices=("float64", "float32"), default="float64")
    parser.add_argument("--out", type=pathlib.Path)
    parser.add_argument("--engine", choices=ENGINES, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.engine:
        return child(options)
    found = {}
    for study in options.studies:
        settings = ["--dtype", options.dtype, *([] if options.size is None else ["--size", str(options.size)])]
        for engine in ENGINES:
            command = [sys.executable, __file__, "--rounds", str(options.rounds), *settings, "--studies", study]
            done = subprocess.run([*command, "--engine", engine], stdout=subprocess.PIPE, text=True, check=True)
            found[f"{study}, {engine}"] = json.loads(done.stdout.splitlines()[-1])
    table = Table("", "found", "runs", "first [s]", "median [s]", "memory [MB]")
    for name, one in found.items():
        median = statistics.median(one["times"]) if one["times"] else np.nan
        cells = (f"{one['found']:.6g}", f"{one['runs']:,}", f"{one['first']:.2f}", f"{median:.2f}")
        table.add_row(name, *cells, f"{one['memory [MB]']:.0f}")
    Console().print(table)
    path = record.written(f"studies-{options.dtype}", found, options.out)
    Console().print(f"written to {path}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
