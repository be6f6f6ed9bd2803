"""References: measured output -> target, of the first signal that the plant shows."""

from diffabs.references.by_deceleration import SlipByDeceleration as SlipByDeceleration
from diffabs.references.extremum_seeking import ExtremumSeeking as ExtremumSeeking
from diffabs.references.limited import LimitedSlip as LimitedSlip
from diffabs.references.peak_slip import PeakLatch as PeakLatch
from diffabs.references.peak_slip import PeakLiteral as PeakLiteral
from diffabs.references.peak_slip import PeakRobust as PeakRobust
from diffabs.references.setpoint import FilteredSlip as FilteredSlip
from diffabs.references.setpoint import FixedSlip as FixedSlip
from diffabs.references.setpoint import Setpoint as Setpoint
from diffabs.references.upright import Upright as Upright
