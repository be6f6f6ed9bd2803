"""The command line of a study: `python experiments/STUDY/run.py [PART] [WORD ...]`."""

import argparse
import time
from collections.abc import Callable, Mapping
from typing import Any

import jax


def run_part(parts: Mapping[str, Callable[[list[str]], Any]]) -> None:
    """Run the part that the command line names, in float64, with the words behind its name; by default the first."""
    parser = argparse.ArgumentParser(description=f"The first part is {next(iter(parts))}.")
    parser.add_argument("part", nargs="?", default=next(iter(parts)), choices=list(parts))
    options, words = parser.parse_known_args()
    jax.config.update("jax_enable_x64", True)
    parts[options.part](words)


def with_times() -> Callable[[str], None]:
    """Return a function that prints a line behind the wall time and processor time since now [s]."""
    clock, used = time.perf_counter(), time.process_time()

    def report(line: str) -> None:
        wall, processors = time.perf_counter() - clock, time.process_time() - used
        print(f"{wall:5.0f} s, {processors:5.0f} s of processors  {line}", flush=True)

    return report
