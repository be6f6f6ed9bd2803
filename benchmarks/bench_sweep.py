"""How fast a Monte-Carlo sweep runs, and what it needs: devices and Dask workers against one device, memory.

The rig of [lmi] under its published gain, noise on the slip sensor at 1 kHz, RK4 at 1 ms; mass, speed, friction and its
peak vary. Every case is a process of its own, so that its peak memory is its own; its rate is that between its first
and its last chunk, without start and compilation. Cases are run `--rounds` times, interleaved; medians are shown, and
ratios within a round. All cases must end with the same table: digests are compared.

    python benchmarks/bench_sweep.py [--samples 65536] [--rounds 3] [--cases "1 device" "2 devices" "2 Dask workers"]
    python benchmarks/bench_sweep.py --samples 1000000 --rounds 1 --cases "2 devices" --dtype float32
"""

import argparse
import dataclasses
import json
import pathlib
import resource
import shutil
import statistics
import subprocess
import sys
import tempfile
import time

import jax
import record
from rich.console import Console
from rich.table import Table

from diffabs.scenario import section_sweep
from diffabs.scenario.scenario import load

CASES = ("1 device", "2 devices", "2 Dask workers", "1 Dask worker")
CHANGES = ("solver.step=1e-3", "solver.duration=4.0", "sensor=noise", "sensor.slip=0.005")


def child(options):
    """One case, in this process: prints a line of JSON."""
    from diffabs.uncertainty.sweep import Local, sweep

    count = int(options.case.split()[0])
    if "device" in options.case:
        jax.config.update("jax_num_cpu_devices", count)
        engine = Local(jax.devices())  # one chunk for each device
    else:
        from diffabs.uncertainty.sweep.cluster import Dask

        engine = Dask(workers=count)
    sizes = (f"sweep.samples={options.samples}", f"sweep.chunk={options.chunk}", f'sweep.dtype="{options.dtype}"')
    study = section_sweep.build_study(load("slip-lmi", (*CHANGES, *sizes)))
    study = dataclasses.replace(study, engine="xla")
    seen, begun = [], time.perf_counter()
    found = sweep(
        study,
        options.folder,
        on=engine,
        progress=lambda at: seen.append((time.perf_counter(), at.here, at.failed, at.diverged)),
    )
    first = next(point for point in seen if point[1] > 0)
    last = seen[-1]
    own, workers = (resource.getrusage(who).ru_maxrss for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    result = {
        "rate": (last[1] - first[1]) / (last[0] - first[0]),
        "whole_s": time.perf_counter() - begun,
        "first_chunk_s": first[0] - begun,
        "peak_MB": own / 1e3,
        "largest_worker_MB": workers / 1e3 if "Dask" in options.case else None,
        "failed": last[2],
        "diverged": last[3],
        "table": found.digest,
    }
    print(json.dumps(result))


def measured(case, options):
    """One case in a process of its own."""
    folder = tempfile.mkdtemp(prefix="diffabs-bench-")
    sizes = ["--samples", options.samples, "--chunk", options.chunk, "--dtype", options.dtype]
    command = [sys.executable, __file__, *map(str, sizes), "--case", case, "--folder", folder]
    try:
        done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True)
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    return json.loads(done.stdout.splitlines()[-1])


def main():
    """Measure, print, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--samples", type=int, default=65536)
    parser.add_argument("--chunk", type=int, default=8192)
    parser.add_argument("--dtype", default="float64", choices=("float32", "float64"))
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--cases", nargs="+", choices=CASES, default=list(CASES))
    parser.add_argument("--out", type=pathlib.Path)
    parser.add_argument("--case", help=argparse.SUPPRESS)
    parser.add_argument("--folder", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.case:
        return child(options)
    rounds = [{case: measured(case, options) for case in options.cases} for _ in range(options.rounds)]
    show(rounds, options)
    tables = {one["table"] for each in rounds for one in each.values()}
    said = {name: str(value) for name, value in vars(options).items()}
    found = {"rounds": rounds, "options": said, "same table": len(tables) == 1}
    path = record.written("sweep", found, options.out, ("jaxlib", "numpy", "pyarrow"))
    Console().print(f"{'the same table' if len(tables) == 1 else 'DIFFERENT TABLES'}; written to {path}")
    return 0 if len(tables) == 1 else 1


def show(rounds, options):
    """Medians over the rounds, ratios to the first case."""
    table = Table(title=f"{options.samples:,} samples in chunks of {options.chunk}, {options.dtype}")
    for heading in ("", "runs/s", "ratio", "whole [s]", "peak [MB]", "largest worker [MB]"):
        table.add_column(heading)
    for case in options.cases:
        first = options.cases[0]
        worker = rounds[0][case]["largest_worker_MB"]
        table.add_row(
            case,
            f"{statistics.median(r[case]['rate'] for r in rounds):,.0f}",
            f"{statistics.median(r[case]['rate'] / r[first]['rate'] for r in rounds):.2f}",
            f"{statistics.median(r[case]['whole_s'] for r in rounds):.1f}",
            f"{max(r[case]['peak_MB'] for r in rounds):.0f}",
            "" if worker is None else f"{worker:.0f}",
        )
    Console().print(table)


if __name__ == "__main__":
    sys.exit(main())
