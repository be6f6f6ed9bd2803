"""Actuators: command -> control."""

from diffabs.actuators.analogue import Lag as Lag
from diffabs.actuators.analogue import Limits as Limits
from diffabs.actuators.analogue import RateLimit as RateLimit
from diffabs.actuators.delay import Delay as Delay
from diffabs.actuators.motor import VoltageLimit as VoltageLimit
