"""The cores and the devices that this process computes on."""

import functools
import os
from typing import Any

import jax


@functools.cache
def core_count() -> int:
    """Return the number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def default_devices() -> list[Any]:
    """Return the devices of this process on which JAX computes by default: the first one, unless it is told others."""
    home = jax.config.jax_default_device  # pyright: ignore[reportAttributeAccessIssue]  # a device, a platform or None
    return [home] if isinstance(home, jax.Device) else jax.local_devices(backend=home)


def default_platform() -> str:
    """Return the platform of JAX's default device: "cpu", "gpu" or another name of JAX."""
    return default_devices()[0].platform
