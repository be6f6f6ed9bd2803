"""Ten thousand Riccati equations of six states: one `vmap` of `diffabs.linear.care` against a loop over SciPy.

One run, the same problems: A (6, 6) and B (6, 2) normal, Q = I, R = I. SciPy solves a part of them, and its time is
scaled. Errors are against SciPy's P after two Newton-Kleinman steps. Set OMP_NUM_THREADS=1 to see SciPy without BLAS
threads, which mostly get in its way. Prints a table, writes JSON with machine and versions.

    python benchmarks/bench_riccati.py [--lanes 10000] [--part 1000]
"""

import argparse
import os
import pathlib
import statistics
import time

import jax
import numpy as np
import record
from rich.console import Console
from rich.table import Table
from scipy.linalg import solve_continuous_are, solve_continuous_lyapunov

from diffabs.linear.riccati import care

REPEATS = 5
Q, R = np.eye(6), np.eye(2)


def polished(a, b, p):
    """P after two Newton-Kleinman steps."""
    for _ in range(2):
        k = b.T @ p
        p = solve_continuous_lyapunov((a - b @ k).T, -(Q + k.T @ k))
    return p


def main():
    """Solve, compare, print, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--lanes", type=int, default=10_000)
    parser.add_argument("--part", type=int, default=1000)
    parser.add_argument("--out", type=pathlib.Path)
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    random = np.random.default_rng(0)
    a, b = random.normal(size=(options.lanes, 6, 6)), random.normal(size=(options.lanes, 6, 2))
    many = jax.jit(jax.vmap(lambda a, b: care(a, b, Q, R)))
    begun = time.perf_counter()
    found = jax.block_until_ready(many(a, b))
    compiled = time.perf_counter() - begun
    times = []
    for _ in range(REPEATS):
        begun = time.perf_counter()
        jax.block_until_ready(many(a, b))
        times.append(time.perf_counter() - begun)
    begun = time.perf_counter()
    theirs = [solve_continuous_are(a[i], b[i], Q, R) for i in range(options.part)]
    loop = (time.perf_counter() - begun) * options.lanes / options.part
    exact = [polished(a[i], b[i], p) for i, p in enumerate(theirs)]
    ours = statistics.median(times)
    rows = {
        "diffabs, vmap": {"seconds": ours, "worst_error": worst(found.P, exact), "compile_seconds": compiled - ours},
        "SciPy, loop": {"seconds": loop, "worst_error": worst(theirs, exact)},
    }
    report(rows, int(np.sum(~np.asarray(found.stabilising))), options)


def worst(found, exact):
    """Largest relative difference."""
    return float(max(np.linalg.norm(p - e) / np.linalg.norm(e) for p, e in zip(found, exact, strict=False)))


def report(rows, refused, options):
    """A table, and JSON."""
    table = Table("", "seconds", "SciPy / this", "worst relative error")
    loop = rows["SciPy, loop"]["seconds"]
    for name, row in rows.items():
        table.add_row(name, f"{row['seconds']:.3f}", f"{loop / row['seconds']:.1f}", f"{row['worst_error']:.1e}")
    Console().print(table, f"{refused} of {options.lanes} reported as not solved")
    found = {"rows": rows, "lanes": options.lanes, "reported": refused, "threads": os.environ.get("OMP_NUM_THREADS")}
    print(record.written("riccati", found, options.out, ("jaxlib", "numpy", "scipy")))


if __name__ == "__main__":
    main()
