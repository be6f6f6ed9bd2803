"""The cores and the devices that this process computes on."""

import functools
import os

import jax


@functools.cache
def core_count() -> int:
    """Return the number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def default_platform() -> str:
    """Return the platform of the device on which JAX computes by default: "cpu", "gpu" or another name of JAX."""
    home = jax.config.jax_default_device or jax.devices()[0]  # pyright: ignore[reportAttributeAccessIssue]
    return home if isinstance(home, str) else home.platform
