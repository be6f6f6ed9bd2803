"""Batches on all cores of a processor, and on several devices.

XLA computes a program of small steps on one core. A batch of `run_packed` is therefore dealt to threads, each with a
share of the runs (`run_on_all_cores`). Runs that step together are one program. A kernel has threads of its own.

On a mesh XLA divides the runs by itself if the axes are of type Auto. They suit programs that do not specify the
placement of their arrays, and no part of a loop specifies it.
"""

import contextlib
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.sharding import AxisType, Mesh, NamedSharding

from diffabs.core.jax_flags import default_flags
from diffabs.core.types import Array, PyTree, Scalar
from diffabs.host.process import core_count, default_platform

MIN_RUNS_PER_CORE = 256  # a core gets at least so many runs
TRACED_EXPLICIT_AXES = (
    "lanes lie on a mesh with axes of type Explicit, within jit or a derivative; there they need Auto ones:"
    " jax.make_mesh(..., axis_types=(jax.sharding.AxisType.Auto,))"
)


def describe_placement(data: object) -> str:
    """Return the reason why only XLA can run these arrays where they lie, or "" if a kernel can, too.

    A kernel is made for the kind of device that JAX uses by default, and for one device.
    """
    # JAX moves an array that is not committed to its device.
    places = [x.sharding.device_set for x in jax.tree.leaves(data) if isinstance(x, jax.Array) and x.committed]
    if any(len(devices) > 1 for devices in places):
        return "the runs lie on several devices"
    foreign = {device.platform for devices in places for device in devices} - {default_platform()}
    if foreign:
        return f"the runs lie on a device ({', '.join(sorted(foreign))}) of another kind than JAX's default"
    return ""


def run_on_all_cores(run: Callable[[PyTree, Array], PyTree], columns: object, count: int) -> PyTree:
    """Return run(columns, numbers of the runs), computed on all cores of this processor, one thread each.

    All shares have one shape, so one program, and at least `MIN_RUNS_PER_CORE` runs: a small batch uses fewer cores.
    Arrays on several devices, or on another device than a processor, are left to XLA.
    """
    cores = min(core_count(), count // MIN_RUNS_PER_CORE)
    if cores < 2 or default_platform() != "cpu" or describe_placement(columns):
        return run(columns, jnp.arange(count))
    # Threads do not inherit these settings.
    wide, each = jnp.result_type(float) == jnp.float64, -(-count // cores)
    device = jax.config.jax_default_device  # pyright: ignore[reportAttributeAccessIssue]

    def run_share(numbers: np.ndarray) -> PyTree:
        with default_flags(), jax.enable_x64(wide), jax.default_device(device):
            share = jax.tree.map(lambda x: x[numbers], columns)
            return jax.block_until_ready(run(share, jnp.asarray(numbers)))

    # Every `cores`-th run: neighbours take about equally long. Copies of the last run fill shares of one shape, so that
    # all shares have one program.
    shares = [np.minimum(np.arange(i, i + each * cores, cores), count - 1) for i in range(cores)]
    with ThreadPoolExecutor(cores) as pool:
        results = list(pool.map(run_share, shares))
    order = np.arange(each * cores).reshape(cores, each).T.ravel()[:count]
    return jax.tree.map(lambda *x: jnp.concatenate(x)[order], *results)


def run_on_auto_mesh(run: Callable[..., PyTree], arguments: tuple[PyTree, ...]) -> PyTree:
    """Return run(*arguments), with arrays on meshes of Explicit axes moved to Auto axes of the same devices.

    No data move between devices. Results return to the original mesh. A traced array on Explicit axes is a ValueError.
    """
    meshes = {_auto_mesh(x.sharding.mesh): x.sharding.mesh for x in jax.tree.leaves(arguments) if _has_explicit_axes(x)}
    if not meshes:
        return run(*arguments)

    def back(x: Array) -> Array:
        mesh = getattr(getattr(x, "sharding", None), "mesh", None)
        return _put_on_mesh(x, meshes[mesh]) if mesh in meshes else x

    # A mesh set around the call must be replaced, too: it would otherwise conflict with the Auto mesh of the arrays.
    meant = jax.sharding.get_abstract_mesh().axis_names
    with jax.set_mesh(next(iter(meshes))) if meant else contextlib.nullcontext():
        results = run(
            *jax.tree.map(
                lambda x: _put_on_mesh(x, _auto_mesh(x.sharding.mesh)) if _has_explicit_axes(x) else x, arguments
            )
        )
    return jax.tree.map(back, results)


def _has_explicit_axes(x: Scalar) -> bool:
    """Return True if an array lies on a mesh whose axes are part of its type; raise a ValueError if it is traced."""
    if not isinstance(x, jax.Array):
        return False
    sharding = jax.typeof(x).sharding if isinstance(x, Tracer) else x.sharding
    explicit = isinstance(sharding, NamedSharding) and AxisType.Explicit in sharding.mesh.axis_types
    if explicit and isinstance(x, Tracer):
        raise ValueError(TRACED_EXPLICIT_AXES)
    return explicit


def _auto_mesh(mesh: Any) -> Mesh:
    return Mesh(mesh.devices, mesh.axis_names, axis_types=(AxisType.Auto,) * len(mesh.axis_names))


def _put_on_mesh(x: jax.Array, mesh: Mesh) -> jax.Array:
    return jax.device_put(x, NamedSharding(mesh, x.sharding.spec))  # pyright: ignore[reportAttributeAccessIssue]
