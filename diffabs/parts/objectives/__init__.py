"""Objectives: streamed measures of a run.

By default a run has the objectives `BRAKING` for a braked wheel, `BALANCE` for a balance, and `TRACKING` for any other
plant.
"""

from diffabs.core.protocols import Objective, Plant
from diffabs.parts.objectives.balance import BalanceCost as BalanceCost
from diffabs.parts.objectives.balance import Fell as Fell
from diffabs.parts.objectives.balance import FinalNorm as FinalNorm
from diffabs.parts.objectives.balance import PeakArmAngle as PeakArmAngle
from diffabs.parts.objectives.balance import PeakLean as PeakLean
from diffabs.parts.objectives.balance import PeakTorque as PeakTorque
from diffabs.parts.objectives.balance import PeakVoltage as PeakVoltage
from diffabs.parts.objectives.balance import RestTime as RestTime
from diffabs.parts.objectives.balance import SoftLoss as SoftLoss
from diffabs.parts.objectives.braking import BrakeWork as BrakeWork
from diffabs.parts.objectives.braking import Effort as Effort
from diffabs.parts.objectives.braking import LockedTime as LockedTime
from diffabs.parts.objectives.braking import RiseTime as RiseTime
from diffabs.parts.objectives.braking import StopDistance as StopDistance
from diffabs.parts.objectives.braking import StopTime as StopTime
from diffabs.parts.objectives.braking import TimeBetweenSpeeds as TimeBetweenSpeeds
from diffabs.parts.objectives.braking import TorqueRate as TorqueRate
from diffabs.parts.objectives.braking import Variation as Variation
from diffabs.parts.objectives.channels import InChannel as InChannel
from diffabs.parts.objectives.channels import OverChannels as OverChannels
from diffabs.parts.objectives.tracking import IAE as IAE
from diffabs.parts.objectives.tracking import ITAE as ITAE
from diffabs.parts.objectives.tracking import FinalError as FinalError
from diffabs.parts.objectives.tracking import MaxSlip as MaxSlip
from diffabs.parts.objectives.tracking import Overshoot as Overshoot
from diffabs.parts.objectives.tracking import PeakOutput as PeakOutput
from diffabs.parts.objectives.tracking import QuadraticCost as QuadraticCost
from diffabs.parts.objectives.tracking import SettlingTime as SettlingTime
from diffabs.parts.objectives.tracking import ShareAtLimit as ShareAtLimit
from diffabs.parts.objectives.tracking import at_limits as at_limits

# The papers on brakes use a band of +-0.01 in slip for every target.
BRAKING: dict[str, Objective] = {
    "stop_time": StopTime(),
    "stop_distance": StopDistance(),
    "max_slip": MaxSlip(),
    "overshoot": Overshoot(),
    "settling_time": SettlingTime(share=0.0, band=0.01),
    "iae": IAE(),
    "final_slip_error": FinalError(),
    "locked_time": LockedTime(),
}

BALANCE: dict[str, Objective] = {
    "settling_time": RestTime(),
    "peak_lean": PeakLean(),
    "peak_arm_angle": PeakArmAngle(),
    "peak_voltage": PeakVoltage(),
    "peak_torque": PeakTorque(),
    "final_norm": FinalNorm(),
    "fell": Fell(),
}

TRACKING: dict[str, Objective] = {
    "overshoot": Overshoot(),
    "settling_time": SettlingTime(),
    "iae": IAE(),
    "final_error": FinalError(),
}


def default_objectives(plant: Plant) -> dict[str, Objective]:
    """Return the default objectives of a run on a plant, by the names of their metrics.

    A plant may choose them by a method `usual_objectives`, as braked wheels and balances do. Any other plant gets a
    copy of `TRACKING`, which compares its first signal with the setpoint.
    """
    usual = getattr(plant, "usual_objectives", None)
    return usual() if usual else dict(TRACKING)
