"""One peer in a process of its own, which solves and takes times when it is asked to: one line of JSON each.

    python -m peers.serve NAME --threads 2 --dtype float32

    {"do": "prepare", "lanes": 4096, "some": 4096, "setting": 1e-6, "out": "answers.npy"}   solves, keeps the solver
    {"do": "time", "setting": 1e-6}                                                         solves again, takes time

A peer is an entry of PEERS in ours.py or c.py, or else a module of this package. It has TITLE, PACKAGES (whose versions
are stated), LADDER (settings, coarse to fine), MANY (the most lanes that it is run on, from which its time for all is
extrapolated; None: all) and

    prepared(masses, speeds, setting, dtype, threads) -> a function without arguments that returns (4, lanes)
"""

import argparse
import importlib
import importlib.metadata
import json
import os
import platform
import sys
import time

import numpy as np

from peers import problem

FAMILIES = {"diffabs": "ours", "kernel": "ours", "c": "c"}  # modules by the first word of a peer's name
THREADS = ("OMP_NUM_THREADS", "NUMBA_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS")


def main() -> None:
    """Answer until the standard input ends."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("peer")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--dtype", choices=("float32", "float64"), default="float32")
    options = parser.parse_args()
    replies = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)  # what libraries print is no reply
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[: options.threads])
    os.environ |= {"JAX_NUM_CPU_DEVICES": str(options.threads), "JAX_ENABLE_X64": str(int(options.dtype == "float64"))}
    os.environ |= {name: str(options.threads) for name in THREADS}
    try:
        family = FAMILIES.get(options.peer.split("_")[0])
        there = importlib.import_module(f"peers.{family or options.peer}")
        peer = there.PEERS[options.peer] if family else there
        print(json.dumps(described(peer)), file=replies)
    except (ImportError, KeyError) as missing:
        print(
            json.dumps(
                {"refused": f"{missing}: not installed in this environment, see the groups bench of pyproject.toml"}
            ),
            file=replies,
        )
        return
    solvers = {}
    for line in sys.stdin:
        asked = json.loads(line)
        try:
            reply = answered(peer, asked, solvers, options)
        except Exception as reason:  # what a peer cannot do is a result
            reply = {"refused": f"{type(reason).__name__}: {str(reason).strip()[:300]}"}
        print(json.dumps(reply), file=replies)


def described(peer) -> dict:
    """What a peer is: title, ladder, versions."""
    versions = {name: importlib.metadata.version(name) for name in peer.PACKAGES}
    return {
        "title": peer.TITLE,
        "ladder": list(peer.LADDER),
        "many": peer.MANY,
        "versions": {"python": platform.python_version(), **versions},
    }


def answered(peer, asked: dict, solvers: dict, options) -> dict:
    """Seconds of one thing asked for: {"prepare_s"}, tracing and compiling and one run; or {"run_s"}."""
    begun = time.perf_counter()
    if asked["do"] == "time":
        solvers[asked["setting"]]()
        return {"run_s": time.perf_counter() - begun}
    masses, speeds = (x[chosen(asked["lanes"], asked["some"])] for x in problem.lanes(asked["lanes"]))
    solve = peer.prepared(masses, speeds, asked["setting"], options.dtype, options.threads)
    found = np.asarray(solve(), float)
    solvers[asked["setting"]] = solve
    np.save(asked["out"], found)
    return {"prepare_s": time.perf_counter() - begun}


def chosen(lanes: int, some: int) -> np.ndarray:
    """The numbers of `some` of the lanes, spread evenly."""
    return np.linspace(0, lanes - 1, min(some, lanes)).round().astype(int)


if __name__ == "__main__":
    main()
