"""Gradient-based tuning of controllers, and the search for worst cases."""

import sys
from typing import TYPE_CHECKING

from diffabs.host.exports import CallablePackage, lazy_getattr

if TYPE_CHECKING:
    from diffabs.core.reason import Reason as Reason
    from diffabs.loop.batch import grid as grid
    from diffabs.loop.batch import latin as latin
    from diffabs.tune.constraints import AtMost as AtMost
    from diffabs.tune.constraints import CertifiedDecay as CertifiedDecay
    from diffabs.tune.constraints import Poles as Poles
    from diffabs.tune.frequency_bounds import FrequencyBounds as FrequencyBounds
    from diffabs.tune.method import DerivativeMode as DerivativeMode
    from diffabs.tune.method import Method as Method
    from diffabs.tune.method import Stopping as Stopping
    from diffabs.tune.problem import Problem as Problem
    from diffabs.tune.result import DescentPoint as DescentPoint
    from diffabs.tune.result import StartError as StartError
    from diffabs.tune.result import Tuned as Tuned
    from diffabs.tune.result import TuningProgress as TuningProgress
    from diffabs.tune.risk import CVaR as CVaR
    from diffabs.tune.risk import Mean as Mean
    from diffabs.tune.risk import Quantile as Quantile
    from diffabs.tune.risk import SmoothWorst as SmoothWorst
    from diffabs.tune.tuning import build_problem as build_problem
    from diffabs.tune.tuning import tune as tune
    from diffabs.tune.worst import WorstCase as WorstCase
    from diffabs.tune.worst import worst_case as worst_case

__getattr__ = lazy_getattr(__name__)
sys.modules[__name__].__class__ = CallablePackage  # `diffabs.tune(...)` is `diffabs.tune.tune(...)`
