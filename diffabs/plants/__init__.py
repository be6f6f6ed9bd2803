"""Plants: dx/dt = derivative(t, x, u), y = output(x)."""

from diffabs.plants.lab_rig import LabRig as LabRig
from diffabs.plants.mirrored_rig import MirroredRig as MirroredRig
from diffabs.plants.quarter_car import QuarterCar as QuarterCar
from diffabs.plants.wheel import GRAVITY as GRAVITY
from diffabs.plants.wheel import BrakeStart as BrakeStart
