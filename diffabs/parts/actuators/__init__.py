"""Actuators: blocks that map the controller's command to the plant's control."""

from diffabs.parts.actuators.dead_time import DeadTime as DeadTime
from diffabs.parts.actuators.delay import Delay as Delay
from diffabs.parts.actuators.hydraulics import HydraulicBrake as HydraulicBrake
from diffabs.parts.actuators.lag import AsymmetricLag as AsymmetricLag
from diffabs.parts.actuators.lag import Lag as Lag
from diffabs.parts.actuators.lag import Limits as Limits
from diffabs.parts.actuators.lag import RateLimit as RateLimit
from diffabs.parts.actuators.motor import VoltageLimit as VoltageLimit
from diffabs.parts.actuators.per_control import PerControl as PerControl
from diffabs.parts.actuators.valve import IntegratingValve as IntegratingValve
