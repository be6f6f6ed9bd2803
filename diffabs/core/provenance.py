"""Where a number comes from: versions of what computed it, and the commit."""

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
from collections.abc import Sequence

import jax


def versions(*packages: str) -> dict[str, str]:
    """Return the versions of diffabs, JAX, these packages, and Python, by name."""
    found = {name: importlib.metadata.version(name) for name in ("jax", *packages)}
    own = sys.modules[__name__.partition(".")[0]].__version__  # the distribution has another name than the package
    return {"diffabs": own, **found, "python": platform.python_version()}


def describe_platform(*packages: str) -> dict[str, str]:
    """Return what can change a bit of a result: `versions`, JAX's backend, and the processor."""
    return versions(*packages) | {"backend": jax.default_backend(), "machine": platform.machine()}


@functools.cache
def processor() -> str:
    """Return a name of this kind of processor: programs compiled for another may not run here, and homes are shared."""
    known = f"{platform.machine()} {platform.processor()}"
    with contextlib.suppress(OSError):
        lines = pathlib.Path("/proc/cpuinfo").read_text(errors="replace").partition("\n\n")[0].splitlines()
        known += "".join(sorted(line for line in lines if line.startswith(("model name", "flags", "Features", "CPU"))))
    return hashlib.sha256(known.encode()).hexdigest()[:12]


def describe_making(words: Sequence[str]) -> dict[str, str | int]:
    """Return when (UTC) and on which kind of machine something is computed, the commit where there is one, and the
    command, of the words after `diffabs`, that computes it again."""
    now = datetime.datetime.now(datetime.UTC).replace(microsecond=0)
    machine = {"machine": platform.machine(), "system": platform.system(), "processors": os.cpu_count() or 1}
    command = shlex.join(["diffabs", *map(str, words)])
    return {"command": command, "date": now.isoformat(), **machine, "backend": jax.default_backend(), **commit()}


def commit() -> dict[str, str]:
    """The commit of a working copy, marked where files differ from it; nothing for an installed package."""
    root = pathlib.Path(__file__).parents[2]
    if not (root / ".git").exists():
        return {}
    command = ["git", "-C", str(root), "describe", "--always", "--dirty", "--abbrev=12"]
    try:
        answer = subprocess.run(command, capture_output=True, text=True, timeout=10)
    except (OSError, subprocess.TimeoutExpired):
        return {}
    return {"commit": answer.stdout.strip()} if answer.returncode == 0 else {}
