"""Monte-Carlo sweeps: variables, sampling designs, engines, results and statistics. Needs the extra `sweep`."""

import sys
from typing import TYPE_CHECKING

from diffabs.runtime.exports import CallablePackage, lazy_getattr

if TYPE_CHECKING:
    from diffabs.sweep.discrete import Categorical as Categorical
    from diffabs.sweep.discrete import Empirical as Empirical
    from diffabs.sweep.discrete import Rows as Rows
    from diffabs.sweep.distributions import LogNormal as LogNormal
    from diffabs.sweep.distributions import Normal as Normal
    from diffabs.sweep.distributions import Triangular as Triangular
    from diffabs.sweep.distributions import Uniform as Uniform
    from diffabs.sweep.engines import Local as Local
    from diffabs.sweep.results import Results as Results
    from diffabs.sweep.run import SweepProgress as SweepProgress
    from diffabs.sweep.run import sweep as sweep
    from diffabs.sweep.sampling import Corners as Corners
    from diffabs.sweep.sampling import Grid as Grid
    from diffabs.sweep.sampling import LatinHypercube as LatinHypercube
    from diffabs.sweep.sampling import Random as Random
    from diffabs.sweep.sampling import Saltelli as Saltelli
    from diffabs.sweep.sampling import Sobol as Sobol
    from diffabs.sweep.store import SweepError as SweepError
    from diffabs.sweep.study import Study as Study
    from diffabs.sweep.variables import Correlation as Correlation
    from diffabs.sweep.variables import Space as Space

__getattr__ = lazy_getattr(__name__)
sys.modules[__name__].__class__ = CallablePackage  # `diffabs.sweep(...)` is `diffabs.sweep.sweep(...)`
