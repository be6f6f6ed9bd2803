"""Bounds of the sensitivity of linearised loops, over a whole box of parameters and all frequencies."""

from diffabs.robust.frequency.peaks import PeakBounds as PeakBounds
from diffabs.robust.frequency.peaks import bound_peaks as bound_peaks
from diffabs.robust.frequency.sensitivity import FrequencyClaim as FrequencyClaim
from diffabs.robust.frequency.sensitivity import SensitivityProof as SensitivityProof
from diffabs.robust.frequency.sensitivity import prove_sensitivity as prove_sensitivity
