"""What data are: something that can be compared with a loop."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, Protocol

import numpy as np

from diffabs.core.loop import Loop
from diffabs.identify.residuals import Residuals
from diffabs.simulate.solution import Solver


class Comparison(NamedTuple):
    """Data against a loop: residuals(loop, *data), (n,); sigma (n,) or None; the batches of loops that are run."""

    residuals: Residuals
    data: tuple[Any, ...]
    sigma: np.ndarray | None
    loops: Callable[[Any], list[Any]]


class Data(Protocol):
    """`Traces`, `Table`."""

    def against(self, loop: Loop, free: Sequence[str], solver: Solver) -> Comparison:
        """Set up the comparison. Raises ValueError for data that do not fit the loop, the solver or each other."""
        ...


def check_positive(name: str, value: Any, unit: str) -> None:
    """Raises ValueError for a standard deviation that is not positive and finite."""
    if not (np.isfinite(value) & (np.asarray(value) > 0)).all():
        raise ValueError(f"{name} = {np.min(value):g} is outside (0, inf) {'' if unit == '1' else unit}".rstrip())
