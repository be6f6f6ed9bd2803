"""References: blocks that map the measured output to the target for the plant's first signal."""

from diffabs.parts.references.by_deceleration import SlipByDeceleration as SlipByDeceleration
from diffabs.parts.references.extremum_seeking import ExtremumSeeking as ExtremumSeeking
from diffabs.parts.references.limited import LimitedSlip as LimitedSlip
from diffabs.parts.references.peak_slip import PeakLatch as PeakLatch
from diffabs.parts.references.peak_slip import PeakLiteral as PeakLiteral
from diffabs.parts.references.peak_slip import PeakRobust as PeakRobust
from diffabs.parts.references.per_target import PerTarget as PerTarget
from diffabs.parts.references.setpoint import FilteredSlip as FilteredSlip
from diffabs.parts.references.setpoint import FixedSlip as FixedSlip
from diffabs.parts.references.setpoint import Setpoint as Setpoint
from diffabs.parts.references.upright import Upright as Upright
