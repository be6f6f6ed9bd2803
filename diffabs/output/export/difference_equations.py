"""A sampled controller as linear difference equations, valid while no limit is active."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from diffabs.core.channels import has_channels
from diffabs.core.types import AnyArray, JsonObject, PyTree, Scalar
from diffabs.linear.opened_loop import linear_controller
from diffabs.loop.closed_loop import Loop
from diffabs.output.export.device import NotExported, check_numbers, with_sampled_controller

ENTRY_ROUNDING = 1e-12  # relative to a matrix's largest coefficient; smaller coefficients are rounding errors


def difference_equations(loop: Loop, target: Scalar | None = None) -> JsonObject:
    """Return the coefficients of the controller, linearized at rest on the setpoint.

    x(k+1) = F x(k) + G y(k) and u(k) = H x(k) + J y(k), all as differences from rest.
    The inputs y are not only measurements: "target" and "feedforward" are inputs, too. An input without any nonzero
    coefficient is left out. The computing delay is not in the equations.

    Args:
        loop: Closed loop whose controller is `Sampled` or `SampledOnGrid`.
        target: Setpoint, in the unit of the plant's first output; None for the loop's own.

    Returns:
        A dictionary with lists "F" (n, n), "G" (n, m), "H" (n,), "J" (m,), the m names of y as "inputs", and the
        "period" [s]. With several controls H and J have a row for each, and "target" and "feedforward" are names such
        as "target.level_1".

    Raises:
        NotExported: A parameter is no number or has a wrong value or shape, the controller runs in continuous time, or
            the loop has no linear model at rest on the setpoint.
    """
    check_numbers(loop)
    loop = with_sampled_controller(loop)
    try:
        with jax.enable_x64(True):
            controller = linear_controller(jax.tree.map(lambda x: jnp.asarray(x, float), loop), target)
    except ValueError as error:
        raise NotExported(str(error)) from None
    controller = controller._replace(**{name: _round_entries(getattr(controller, name)) for name in "ABCD"})
    start = jax.eval_shape(lambda: loop.signals(0.0, loop.start()).tracking)
    names = [*_names("target", start.target), *loop.plant.shows._fields, *_names("feedforward", start.feedforward)]
    # Inputs without any coefficient are left out, such as an unused feed-forward.
    used = np.abs(np.vstack([controller.B, controller.D])).max(axis=0) > 0
    columns = [i for i, is_used in enumerate(used) if is_used]
    return {
        "period": controller.period, "inputs": [names[i] for i in columns], "F": controller.A.tolist(),
        "G": controller.B[:, columns].tolist(), "H": _rows(controller.C), "J": _rows(controller.D[:, columns]),
    }  # fmt: skip


def _names(name: str, signal: PyTree) -> list[str]:
    """Return the names of a signal's channels, or its own for a signal with one."""
    return [f"{name}.{channel}" for channel in signal._fields] if has_channels(signal) else [name]


def _rows(matrix: np.ndarray) -> list[Any]:
    """Return the rows of a matrix, or the only one."""
    return matrix.tolist() if len(matrix) > 1 else matrix[0].tolist()


def _round_entries(matrix: AnyArray) -> np.ndarray:
    """Return a matrix with entries that are rounding errors set to 0."""
    return np.where(np.abs(matrix) > ENTRY_ROUNDING * np.max(np.abs(matrix), initial=0.0), matrix, 0.0)
