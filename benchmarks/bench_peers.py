"""Closed loops per second: diffabs, C, and other people's programs, on one problem, in one run, at equal accuracy.

The problem and the error are in peers/problem.py: the rig of [lmi] with its torque limits, masses 5.3 to 6.2 kg from 30
to 60 km/h; the worst relative error of stopping time, distance, greatest slip and IAE over ALL lanes, against a
reference made in the same run (peers/reference.py). Each peer is a process of its own with the same number of threads.
It gets the first setting of its ladder, coarse to fine, that is accurate; one that never is gets its finest, and the
table says so. Times are taken in turn, round by round, of every setting tried; medians. On a machine that does
something else only ratios mean anything.

A peer that needs other versions than diffabs lives in an environment of its own: --python jaxonomy_event=.../bin/python

    python benchmarks/bench_peers.py [--lanes 4096] [--dtype float32] [--threads 2] [--peers c_adaptive diffrax_event]
"""

import argparse
import contextlib
import json
import os
import pathlib
import selectors
import statistics
import subprocess
import sys
import tempfile
from typing import Any

import numpy as np
import record
from peers import problem, reference
from peers.serve import chosen
from rich.console import Console
from rich.table import Table

HERE = pathlib.Path(__file__).parent
PEERS = ("diffabs_adaptive", "diffabs_fixed", "kernel_adaptive", "kernel_fixed", "c_adaptive", "c_fixed", "jax_scan")
PEERS += ("numba_adaptive", "diffrax_event", "jaxonomy_event", "scipy_loop", "torchdiffeq_event")
PATIENCE = 300.0  # seconds for one answer
FACTOR = 10.0  # a setting so many times finer in error than asked ends the ladder


class Peer:
    """A peer's process, and what it answered."""

    def __init__(self, name: str, python: str, options: Any) -> None:
        """Start it."""
        command = [python, "-m", "peers.serve", name, "--threads", str(options.threads), "--dtype", options.dtype]
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join(paths(python))}
        pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.DEVNULL}
        self.name, self.options, self.points = name, options, {}
        self.process = subprocess.Popen(command, text=True, env=environment, cwd=HERE, **pipes)
        told = self.answer()
        self.refused = told.get("refused")
        self.title, self.ladder = told.get("title", name), told.get("ladder", [])
        self.any_factor, self.versions = min(told.get("many") or options.lanes, options.lanes), told.get("versions", {})

    def answer(self) -> dict[str, Any]:
        """The next reply; {"refused": why} where there is none."""
        with selectors.DefaultSelector() as waiting:
            waiting.register(self.process.stdout, selectors.EVENT_READ)
            if not waiting.select(PATIENCE):
                self.process.kill()
                return {"refused": f"no answer within {PATIENCE:g} s"}
        line = self.process.stdout.readline()
        return json.loads(line) if line else {"refused": f"its process ended, with status {self.process.wait()}"}

    def asked(self, **request: Any) -> dict[str, Any]:
        """The reply to a request."""
        with contextlib.suppress(BrokenPipeError):
            print(json.dumps(request), file=self.process.stdin, flush=True)
        return self.answer()

    def climbed(self, answers: np.ndarray, folder: str) -> None:
        """Try the ladder until one setting is accurate, and on to one that is much more so, for the curve."""
        out = f"{folder}/{self.name}.npy"
        for setting in self.ladder:
            asked = {
                "do": "prepare",
                "lanes": self.options.lanes,
                "some": self.any_factor,
                "setting": setting,
                "out": out,
            }
            reply = self.asked(**asked)
            if "refused" in reply:
                self.refused = reply["refused"]
                return
            errors = problem.errors(np.load(out), answers[:, chosen(self.options.lanes, self.any_factor)])
            each = dict(zip(problem.METRICS, errors.tolist(), strict=True))
            self.points[setting] = {"error": max(each.values()), "errors": each, **reply}
            if self.points[setting]["error"] <= self.options.accuracy / FACTOR:
                return

    def end(self) -> None:
        """End its process."""
        self.process.kill()
        with contextlib.suppress(BrokenPipeError):
            self.process.communicate()

    def best(self) -> dict[str, Any] | None:
        """The point of the first setting that is accurate, or of the most accurate; None if there is none."""
        return record.best(self.points.values(), self.options.accuracy)


def paths(python: str) -> list[str]:
    """Where a peer finds its modules: here; and diffabs, if it is run by this Python."""
    own = [str(HERE.parent)] if python == sys.executable else []
    return [str(HERE), *own]


def measured(options: Any) -> dict[str, Any]:
    """The record: reference, peers, points."""
    answers, apart = reference.answers(*problem.lanes(options.lanes))
    pairs = (pair.partition("=") for pair in options.python)
    pythons = {name: os.path.abspath(path) for name, _, path in pairs}
    peers = []
    try:
        with tempfile.TemporaryDirectory() as folder:
            for name in options.peers:
                peers.append(Peer(name, pythons.get(name, sys.executable), options))
                peers[-1].climbed(answers, folder)
        takers = {
            (peer.name, setting): lambda peer=peer, setting=setting: peer.asked(do="time", setting=setting)["run_s"]
            for peer in peers
            for setting in peer.points
        }
        taken = record.in_turn(takers, options.rounds)
    finally:
        for peer in peers:
            peer.end()
    return summary(peers, taken, apart, options)


def summary(peers: list[Peer], taken: dict[Any, list[float]], apart: float | None, options: Any) -> dict[str, Any]:
    """Rows of the table, and points of the curves. Times of fewer lanes are scaled to all."""
    found = {"rows": {}, "points": {}, "reference": {"method": "C, rtol 1e-10", "DOP853 apart": apart}}
    seconds = {}
    for peer in peers:
        whole = options.lanes / peer.any_factor
        for setting, point in peer.points.items():
            seconds[peer.name, setting] = [whole * t for t in taken[peer.name, setting]]
            median = statistics.median(seconds[peer.name, setting])
            point |= {"setting": setting, "run_s": median, "runs_per_s": options.lanes / median}
        found["points"][peer.name] = list(peer.points.values())
        row = {"title": peer.title, "lanes": peer.any_factor, "refused": peer.refused, "versions": peer.versions}
        if point := peer.best():
            row |= point | {"prepare_s": max(each["prepare_s"] for each in peer.points.values())}
        found["rows"][peer.name] = row
    first = next((name for name, row in found["rows"].items() if "run_s" in row), None)
    for name, row in found["rows"].items():
        if "run_s" in row:
            pair = seconds[first, found["rows"][first]["setting"]], seconds[name, row["setting"]]
            row |= {"of_first": record.ratio(*pair), "accurate": row["error"] <= options.accuracy}
    kept = {key: getattr(options, key) for key in ("lanes", "dtype", "threads", "accuracy", "rounds")}
    return {**found, **kept, "first": first}


def show(found: dict[str, Any]) -> None:
    """The table, 80 columns, and a line for each peer that could not."""
    console = Console(width=80)
    title = f"{found['lanes']:,} lanes, {found['dtype']}, {found['threads']} threads, error over all lanes"
    table = Table(title=f"{title} <= {found['accuracy']:g}", expand=True)
    table.add_column("program", ratio=1)
    for heading in ("setting", "error", "prepare\n[s]", "runs/s", "times\nfirst"):
        table.add_column(heading, justify="right", no_wrap=True)
    for row in found["rows"].values():
        if "run_s" in row:
            note = f" ({row['lanes']} of the lanes)" if row["lanes"] < found["lanes"] else ""
            error = f"{row['error']:.1e}{'' if row['accurate'] else ' !'}"
            figures = (f"{row['setting']:g}", error, f"{row['prepare_s']:.1f}", f"{row['runs_per_s']:,.0f}")
            table.add_row(row["title"] + note, *figures, f"{row['of_first']:.3g}")
    console.print(table)
    if not all(row.get("accurate", True) for row in found["rows"].values()):
        console.print("! the most accurate of its ladder, which is not what is asked")
    for name, row in found["rows"].items():
        if row["refused"]:
            console.print(f"{name}: {row['refused']}", markup=False, soft_wrap=True)
    if (apart := found["reference"]["DOP853 apart"]) is not None:
        console.print(f"reference: C to 1e-10 on all lanes, {apart:.0e} from SciPy's DOP853 on {reference.CHECKED}")


def main() -> None:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--lanes", type=int, default=4096)
    parser.add_argument("--dtype", choices=("float32", "float64"), default="float32")
    parser.add_argument("--threads", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--accuracy", type=float, default=1e-4)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--peers", nargs="+", choices=PEERS, default=PEERS, help="the first is what others are told in")
    parser.add_argument("--python", nargs="*", default=[], metavar="PEER=PYTHON", help="another interpreter for a peer")
    parser.add_argument("--out", type=pathlib.Path)
    options = parser.parse_args()
    found = measured(options)
    show(found)
    name = f"peers-{options.lanes}-{options.dtype}"
    Console().print(f"written to {record.written(name, found, options.out)}", soft_wrap=True)


if __name__ == "__main__":
    main()
