"""The origin of a result: versions of the software, the machine, and the commit."""

import contextlib
import datetime
import functools
import hashlib
import importlib.metadata
import os
import pathlib
import platform
import shlex
import subprocess
import sys
import time
from collections.abc import Sequence

import jax

from diffabs.host import stopwatch

_words: tuple[str, ...] = ()  # the words after `diffabs`
_begun = time.monotonic()


def versions(*packages: str) -> dict[str, str]:
    """Return the versions by name: `diffabs`, `jax`, the given packages, and `python`."""
    installed = {name: importlib.metadata.version(name) for name in ("jax", *packages)}
    version = sys.modules[__name__.partition(".")[0]].__version__  # the distribution's name differs from the package's
    return {"diffabs": version, **installed, "python": platform.python_version()}


def describe_platform(*packages: str) -> dict[str, str]:
    """Return `versions`, JAX's `backend`, and the `machine` (x86_64, arm64): each can change a bit of a result."""
    return versions(*packages) | {"backend": jax.default_backend(), "machine": platform.machine()}


@functools.cache
def processor() -> str:
    """Return a hash (12 hexadecimal digits) of the model and the features of the processor.

    Programs compiled for another kind may not run here, and home folders are shared between machines.
    """
    description = f"{platform.machine()} {platform.processor()}"
    with contextlib.suppress(OSError):
        lines = pathlib.Path("/proc/cpuinfo").read_text(errors="replace").partition("\n\n")[0].splitlines()
        description += "".join(
            sorted(line for line in lines if line.startswith(("model name", "flags", "Features", "CPU")))
        )
    return hashlib.sha256(description.encode()).hexdigest()[:12]


def describe_making(words: Sequence[str]) -> dict[str, str | int]:
    """Return how a computation was made: `command`, `date`, `machine`, `system`, `processors`, `backend`, and `commit`.

    The command repeats the computation. The date is UTC. `commit` is absent for an installed package.
    """
    now = datetime.datetime.now(datetime.UTC).replace(microsecond=0)
    machine = {"machine": platform.machine(), "system": platform.system(), "processors": os.cpu_count() or 1}
    command = shlex.join(["diffabs", *map(str, words)])
    return {"command": command, "date": now.isoformat(), **machine, "backend": jax.default_backend(), **source_commit()}


def begin_command(words: Sequence[str]) -> None:
    """Store the words after `diffabs` of the command that begins, and start its clock."""
    global _words, _begun
    _words, _begun = tuple(words), time.monotonic()
    stopwatch.count_compilations()


def describe_command() -> dict[str, str | float]:
    """Return `describe_making` of the command, its time [s] so far, and the part of it that JAX compiled."""
    seconds, compiling = time.monotonic() - _begun, stopwatch.compile_time_since(_begun)
    return {**describe_making(_words), "seconds": round(seconds, 1), "of it compiling": round(compiling, 1)}


def source_commit() -> dict[str, str]:
    """Return `{"commit": hash}` of a working copy; empty for an installed package or without git.

    The hash has the suffix `-dirty` if tracked files differ from the commit.
    """
    root = pathlib.Path(__file__).parents[2]
    if not (root / ".git").exists():
        return {}
    command = ["git", "-C", str(root), "describe", "--always", "--dirty", "--abbrev=12"]
    try:
        answer = subprocess.run(command, capture_output=True, text=True, timeout=10)
    except (OSError, subprocess.TimeoutExpired):
        return {}
    return {"commit": answer.stdout.strip()} if answer.returncode == 0 else {}
