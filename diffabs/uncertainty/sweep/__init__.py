"""Monte-Carlo sweeps: variables, sampling designs, engines, results and statistics. Needs the extra `sweep`."""

import sys
from typing import TYPE_CHECKING

from diffabs.host.exports import CallablePackage, lazy_getattr

if TYPE_CHECKING:
    from diffabs.uncertainty.sweep.discrete import Categorical as Categorical
    from diffabs.uncertainty.sweep.discrete import Empirical as Empirical
    from diffabs.uncertainty.sweep.discrete import Rows as Rows
    from diffabs.uncertainty.sweep.distributions import LogNormal as LogNormal
    from diffabs.uncertainty.sweep.distributions import Normal as Normal
    from diffabs.uncertainty.sweep.distributions import Triangular as Triangular
    from diffabs.uncertainty.sweep.distributions import Uniform as Uniform
    from diffabs.uncertainty.sweep.engines import Local as Local
    from diffabs.uncertainty.sweep.results import Results as Results
    from diffabs.uncertainty.sweep.run import SweepProgress as SweepProgress
    from diffabs.uncertainty.sweep.run import sweep as sweep
    from diffabs.uncertainty.sweep.sampling import Corners as Corners
    from diffabs.uncertainty.sweep.sampling import Grid as Grid
    from diffabs.uncertainty.sweep.sampling import LatinHypercube as LatinHypercube
    from diffabs.uncertainty.sweep.sampling import Random as Random
    from diffabs.uncertainty.sweep.sampling import Saltelli as Saltelli
    from diffabs.uncertainty.sweep.sampling import Sobol as Sobol
    from diffabs.uncertainty.sweep.statistics.comparison import compare_sweeps as compare_sweeps
    from diffabs.uncertainty.sweep.store import SweepError as SweepError
    from diffabs.uncertainty.sweep.study import Study as Study
    from diffabs.uncertainty.sweep.variables import Correlation as Correlation
    from diffabs.uncertainty.sweep.variables import Space as Space

__getattr__ = lazy_getattr(__name__)
sys.modules[__name__].__class__ = CallablePackage  # `diffabs.sweep(...)` is `diffabs.uncertainty.sweep.sweep(...)`
