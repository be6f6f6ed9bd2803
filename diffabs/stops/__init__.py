"""Stops: conditions that end a run."""

from diffabs.stops.stops import Fallen as Fallen
from diffabs.stops.stops import NoStop as NoStop
from diffabs.stops.stops import SpeedReached as SpeedReached
from diffabs.stops.stops import Standstill as Standstill
