"""How long a map of a region of attraction takes, 10,000 nonlinear closed loops at 1 ms; will float32 do?

The hanging arm under its LQR at 48 V, frame and rider from -0.1 to 0.1 rad; under `--gain slow` another, Q = I, R =
0.01, whose slowest pole is -0.47 /s. A run ends when it is decided, after 60 s at the latest. Each data type is a
process of its own; times include everything but compilation, which is shown beside them.

    python benchmarks/bench_basin.py [--rounds 3] [--points 100] [--gain slow]
"""

import argparse
import json
import pathlib
import statistics
import subprocess
import sys
import time

import jax
import numpy as np
import record
from rich.console import Console
from rich.table import Table

from diffabs import FixedStep
from diffabs.core.pytree import replace
from diffabs.design.attraction import Cells, region_of_attraction
from diffabs.scenario.scenario import load

DTYPES = ("float64", "float32")
SLOW = (1929.4576, -200.43085, 765.68752, 679.60827, -7.4582343, 282.76553)  # K of Q = I, R = 0.01


def child(options):
    """One data type, in this process: prints a line of JSON."""
    jax.config.update("jax_enable_x64", options.dtype == "float64")
    loop = load("arm-hanging").loop
    if options.gain == "slow":
        loop = replace(loop, {"controller.gain": np.array(SLOW)})
    cells = Cells(-0.1, 0.1, options.points)
    times = []
    for _ in range(options.rounds + 1):
        begun = time.perf_counter()
        found = region_of_attraction(loop, cells, cells, FixedStep(step=1e-3, duration=60.0), engine="xla")
        times.append(time.perf_counter() - begun)
    first, *rest = times
    seen = {
        "share": found.share,
        "undecided": found.undecided,
        "diverged": int(found.outcomes.diverged.sum()),
        "simulated [s]": float(found.outcomes.time.mean()),
        "cells": np.packbits(found.outcomes.recovered).tolist(),
    }
    print(json.dumps({"first": first, "times": rest, **seen}))


def main():
    """Measure, print, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--points", type=int, default=100)
    parser.add_argument("--gain", choices=("LQR", "slow"), default="LQR")
    parser.add_argument("--out", type=pathlib.Path)
    parser.add_argument("--dtype", choices=DTYPES, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.dtype:
        return child(options)
    found, sizes = {}, ["--rounds", str(options.rounds), "--points", str(options.points), "--gain", options.gain]
    for dtype in DTYPES:
        command = [sys.executable, __file__, *sizes, "--dtype", dtype]
        done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True)
        found[dtype] = json.loads(done.stdout.splitlines()[-1])
    bits = [np.unpackbits(np.array(found[dtype].pop("cells"), np.uint8)) for dtype in DTYPES]
    agree = float(np.mean((bits[0] == bits[1])[: options.points**2]))
    columns = ("", "median [s]", "with compilation [s]", "share", "undecided", "diverged")
    table = Table(*columns, title=f"{options.points**2:,} starts")
    for dtype, one in found.items():
        median = statistics.median(one["times"])
        shares = (f"{one['share']:.4f}", f"{one['undecided']:.4f}", str(one["diverged"]))
        table.add_row(dtype, f"{median:.1f}", f"{one['first']:.1f}", *shares)
    Console().print(table)
    path = record.written("basin", {**found, "cells that agree": agree}, options.out)
    Console().print(f"{100 * agree:.2f} % of the cells agree; written to {path}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
