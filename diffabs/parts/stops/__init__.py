"""Stops: conditions that end a run."""

from diffabs.parts.stops.stops import Fallen as Fallen
from diffabs.parts.stops.stops import NoStop as NoStop
from diffabs.parts.stops.stops import SpeedReached as SpeedReached
from diffabs.parts.stops.stops import Standstill as Standstill
