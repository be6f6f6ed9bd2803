"""Identification of parameters from measured runs, with their uncertainty. Needs SciPy."""

from diffabs.identify.fit import Identified as Identified
from diffabs.identify.fit import Tolerances as Tolerances
from diffabs.identify.fit import fit as fit
from diffabs.identify.identification import identify as identify
from diffabs.identify.residuals import gaussian as gaussian
from diffabs.identify.table import Table as Table
from diffabs.identify.traces import Traces as Traces
from diffabs.identify.uncertainty import Direction as Direction
from diffabs.identify.uncertainty import Uncertainty as Uncertainty
