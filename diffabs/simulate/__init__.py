"""Simulation of a loop: Runge-Kutta steps, event location, single runs and batches, admissibility checks, error
estimates.
"""

import sys
from typing import NoReturn

from diffabs.core.types import PyTree
from diffabs.runtime.exports import CallablePackage


def simulate(*args: PyTree, **options: PyTree) -> NoReturn:
    """Raise a TypeError that names the functions of a run."""
    raise TypeError(
        "diffabs.simulate is a package; a run is d.rollout(loop, solver), its metrics d.measure(loop, solver,"
        " objectives), many runs d.run_batch(loop, batch, solver, objectives)"
    )


sys.modules[__name__].__class__ = CallablePackage  # a call says which function makes a run
