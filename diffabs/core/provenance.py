"""Where a number comes from: versions of what computed it, and the commit."""

import importlib.metadata
import pathlib
import platform
import subprocess

import jax


def versions(*packages: str) -> dict[str, str]:
    """Of diffabs, Python and these packages; the processor and JAX's backend."""
    found = {name: importlib.metadata.version(name) for name in ("diffabs", *packages)}
    platforms = {"python": platform.python_version(), "backend": jax.default_backend(), "machine": platform.machine()}
    return {**found, **platforms}


def commit() -> dict[str, str]:
    """The commit of a working copy, marked where files differ from it; nothing for an installed package."""
    root = pathlib.Path(__file__).parent.parent
    if not (root / ".git").exists():
        return {}
    command = ["git", "-C", str(root), "describe", "--always", "--dirty", "--abbrev=12"]
    try:
        answer = subprocess.run(command, capture_output=True, text=True, timeout=10)
    except (OSError, subprocess.TimeoutExpired):
        return {}
    return {"commit": answer.stdout.strip()} if answer.returncode == 0 else {}
