"""Protocol of measured data that `identify` can compare with a loop."""

from collections.abc import Callable, Sequence
from typing import NamedTuple, Protocol

import numpy as np

from diffabs.core.kinds import format_value
from diffabs.core.types import PyTree, Scalar
from diffabs.engine.solvers import Solver
from diffabs.loop.closed_loop import Loop
from diffabs.tune.identify.residuals import Residuals


class Comparison(NamedTuple):
    """A least-squares comparison of data with a loop.

    Attributes:
        residuals: Function residuals(loop, *data), which returns simulated minus measured values, shape (n,).
        data: Arrays that are passed to `residuals`.
        sigma: Standard deviations of the residuals, shape (n,), or None if they are unknown.
        loops: Function of a loop that returns the loops of all runs, stacked into batches of equal structure.
    """

    residuals: Residuals
    data: tuple[PyTree, ...]
    sigma: np.ndarray | None
    loops: Callable[[PyTree], list[PyTree]]


class Data(Protocol):
    """Measured data: `Traces` or `Table`."""

    def against(self, loop: Loop, free: Sequence[str], solver: Solver) -> Comparison:
        """Return the comparison of these data with a loop.

        Args:
            loop: Loop whose parameters are identified.
            free: Paths of the free parameters.
            solver: Solver of every run.

        Raises:
            ValueError: The data do not fit the loop, the solver or each other.
        """
        ...


def check_sigma_table(sigma: object, of: str) -> None:
    """Check that standard deviations are given by name: in a mapping, or what behaves as one, like a pandas Series."""
    if not hasattr(sigma, "keys"):
        raise ValueError(f"sigma = {format_value(sigma)} is no mapping from {of} to standard deviations")


def check_positive(name: str, value: Scalar, unit: str) -> None:
    """Check that a standard deviation is positive and finite."""
    if not (np.isfinite(value) & (np.asarray(value) > 0)).all():
        raise ValueError(f"{name} = {np.min(value):g} is outside (0, inf) {'' if unit == '1' else unit}".rstrip())
