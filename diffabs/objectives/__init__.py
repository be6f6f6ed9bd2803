"""Objectives: what is measured on a run, streamed. `BRAKING` are those every braking report shows."""

from diffabs.objectives.accuracy import IAE as IAE
from diffabs.objectives.accuracy import ITAE as ITAE
from diffabs.objectives.accuracy import FinalSlipError as FinalSlipError
from diffabs.objectives.accuracy import MaxSlip as MaxSlip
from diffabs.objectives.accuracy import Overshoot as Overshoot
from diffabs.objectives.accuracy import QuadraticCost as QuadraticCost
from diffabs.objectives.accuracy import SettlingTime as SettlingTime
from diffabs.objectives.braking import Effort as Effort
from diffabs.objectives.braking import LockedTime as LockedTime
from diffabs.objectives.braking import StopDistance as StopDistance
from diffabs.objectives.braking import StopTime as StopTime
from diffabs.objectives.braking import TorqueRate as TorqueRate
from diffabs.objectives.braking import Variation as Variation

BRAKING = {
    "stop_time": StopTime(),
    "stop_distance": StopDistance(),
    "max_slip": MaxSlip(),
    "overshoot": Overshoot(),
    "settling_time": SettlingTime(),
    "iae": IAE(),
    "final_slip_error": FinalSlipError(),
    "locked_time": LockedTime(),
}
