"""Slip references: measured output -> target slip."""

from diffabs.references.estimator import PeakLatch as PeakLatch
from diffabs.references.estimator import PeakLiteral as PeakLiteral
from diffabs.references.estimator import PeakRobust as PeakRobust
from diffabs.references.setpoint import FilteredSlip as FilteredSlip
from diffabs.references.setpoint import FixedSlip as FixedSlip
from diffabs.references.upright import Upright as Upright
