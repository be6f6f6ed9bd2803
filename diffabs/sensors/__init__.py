"""Sensors: output -> measured output."""

from diffabs.sensors.angles import AngleSensor as AngleSensor
from diffabs.sensors.noise import Bias as Bias
from diffabs.sensors.noise import Noise as Noise
from diffabs.sensors.noise import Quantisation as Quantisation
from diffabs.sensors.speed import IntegratedAccelerometer as IntegratedAccelerometer
from diffabs.sensors.speed import SpeedScale as SpeedScale
from diffabs.sensors.speed import WheelSpeed as WheelSpeed
