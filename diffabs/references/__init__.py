"""References: blocks that map the measured output to the target for the plant's first signal."""

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
