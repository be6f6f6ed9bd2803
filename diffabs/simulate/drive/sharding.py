"""Batches on several devices: XLA divides the runs by itself if the axes of the mesh are of type Auto.

Auto axes suit programs that do not specify the placement of their arrays, and no part of a loop specifies it.
"""

import contextlib
from collections.abc import Callable
from typing import Any

import jax
from jax.core import Tracer
from jax.sharding import AxisType, Mesh, NamedSharding

from diffabs.core.types import PyTree, Scalar

TRACED_EXPLICIT_AXES = (
    "lanes lie on a mesh with axes of type Explicit, within jit or a derivative; there they need Auto ones:"
    " jax.make_mesh(..., axis_types=(jax.sharding.AxisType.Auto,))"
)


def run_on_auto_mesh(run: Callable[..., PyTree], given: tuple[PyTree, ...]) -> PyTree:
    """Return run(*given), with arrays on meshes of Explicit axes moved to Auto axes of the same devices.

    No data move between devices. Results return to the original mesh.

    Args:
        run: Function to call.
        given: Positional arguments, pytrees.

    Raises:
        ValueError: An array on Explicit axes is traced.
    """
    meshes = {_auto_mesh(x.sharding.mesh): x.sharding.mesh for x in jax.tree.leaves(given) if _has_explicit_axes(x)}
    if not meshes:
        return run(*given)

    def back(x: Scalar) -> Any:
        mesh = getattr(getattr(x, "sharding", None), "mesh", None)
        return _put_on_mesh(x, meshes[mesh]) if mesh in meshes else x

    # A mesh set around the call must be replaced, too: it would otherwise conflict with the Auto mesh of the arrays.
    meant = jax.sharding.get_abstract_mesh().axis_names
    with jax.set_mesh(next(iter(meshes))) if meant else contextlib.nullcontext():
        found = run(
            *jax.tree.map(lambda x: _put_on_mesh(x, _auto_mesh(x.sharding.mesh)) if _has_explicit_axes(x) else x, given)
        )
    return jax.tree.map(back, found)


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


def _put_on_mesh(x: jax.Array, mesh: Any) -> jax.Array:
    return jax.device_put(x, NamedSharding(mesh, x.sharding.spec))  # pyright: ignore[reportAttributeAccessIssue]
