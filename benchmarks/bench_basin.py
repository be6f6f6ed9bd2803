"""How long a map of a region of attraction takes, 10,000 nonlinear closed loops of 10 s at 1 ms; will float32 do?

The hanging arm under its LQR at 48 V, frame and rider from -0.1 to 0.1 rad. Each data type is a process of its own;
times include everything but compilation, which is shown beside them.

    python benchmarks/bench_basin.py [--rounds 3] [--points 100]
"""

import argparse
import json
import os
import pathlib
import statistics
import subprocess
import sys
import time

import jax
import numpy as np
from rich.console import Console
from rich.table import Table

from diffabs import FixedStep, provenance
from diffabs.basin import attraction
from diffabs.scenario import load

DTYPES = ("float64", "float32")


def child(options):
    """One data type, in this process: prints a line of JSON."""
    jax.config.update("jax_enable_x64", options.dtype == "float64")
    loop = load("arm-hanging").loop
    axis = np.linspace(-0.1, 0.1, options.points)
    times = []
    for _ in range(options.rounds + 1):
        begun = time.perf_counter()
        found = attraction(loop, axis, axis, FixedStep(step=1e-3, duration=10.0))
        times.append(time.perf_counter() - begun)
    cells = np.packbits(found.recovered).tolist()
    first, *rest = times
    print(json.dumps({"first": first, "times": rest, "share": found.share, "cells": cells, "diverged": found.diverged}))


def main():
    """Measure, print, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--points", type=int, default=100)
    parser.add_argument("--out", type=pathlib.Path, default=pathlib.Path("out/benchmarks/basin.json"))
    parser.add_argument("--dtype", choices=DTYPES, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.dtype:
        return child(options)
    found, sizes = {}, ["--rounds", str(options.rounds), "--points", str(options.points)]
    for dtype in DTYPES:
        command = [sys.executable, __file__, *sizes, "--dtype", dtype]
        done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True)
        found[dtype] = json.loads(done.stdout.splitlines()[-1])
    bits = [np.unpackbits(np.array(found[dtype].pop("cells"), np.uint8)) for dtype in DTYPES]
    agree = float(np.mean((bits[0] == bits[1])[: options.points**2]))
    table = Table("", "median [s]", "with compilation [s]", "share", "diverged", title=f"{options.points**2:,} starts")
    for dtype, one in found.items():
        median = statistics.median(one["times"])
        table.add_row(dtype, f"{median:.1f}", f"{one['first']:.1f}", f"{one['share']:.4f}", str(one["diverged"]))
    Console().print(table)
    options.out.parent.mkdir(parents=True, exist_ok=True)
    record = {
        **found,
        "cells that agree": agree,
        "machine": {"cores": os.cpu_count(), "load": os.getloadavg()},
        "versions": {**provenance.versions("jax", "jaxlib", "numpy"), **provenance.commit()},
    }
    options.out.write_text(json.dumps(record, indent=2) + "\n", encoding="utf-8")
    Console().print(f"{100 * agree:.2f} % of the cells agree; written to {options.out}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
