"""Identification of parameters from measured runs, with their uncertainty. Needs SciPy."""

from diffabs.tune.identify.fit import Identified as Identified
from diffabs.tune.identify.fit import Tolerances as Tolerances
from diffabs.tune.identify.fit import fit as fit
from diffabs.tune.identify.identification import identify as identify
from diffabs.tune.identify.residuals import gaussian as gaussian
from diffabs.tune.identify.table import Table as Table
from diffabs.tune.identify.traces import Traces as Traces
from diffabs.tune.identify.uncertainty import Direction as Direction
from diffabs.tune.identify.uncertainty import Uncertainty as Uncertainty
