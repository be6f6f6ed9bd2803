"""Actuators: blocks that map the controller's command to the plant's control."""

from diffabs.actuators.dead_time import DeadTime as DeadTime
from diffabs.actuators.delay import Delay as Delay
from diffabs.actuators.lag import AsymmetricLag as AsymmetricLag
from diffabs.actuators.lag import Lag as Lag
from diffabs.actuators.lag import Limits as Limits
from diffabs.actuators.lag import RateLimit as RateLimit
from diffabs.actuators.motor import VoltageLimit as VoltageLimit
from diffabs.actuators.valve import IntegratingValve as IntegratingValve
