"""Sensors: blocks that map the plant's output to the measured output."""

from diffabs.sensors.angles import AngleSensor as AngleSensor
from diffabs.sensors.encoder import EncoderSlip as EncoderSlip
from diffabs.sensors.noise import Bias as Bias
from diffabs.sensors.noise import Noise as Noise
from diffabs.sensors.noise import PlayedWheelNoise as PlayedWheelNoise
from diffabs.sensors.noise import Quantisation as Quantisation
from diffabs.sensors.noise import WheelNoise as WheelNoise
from diffabs.sensors.speed import DriftingSpeed as DriftingSpeed
from diffabs.sensors.speed import IntegratedAccelerometer as IntegratedAccelerometer
from diffabs.sensors.speed import SpeedScale as SpeedScale
from diffabs.sensors.speed import WheelSpeed as WheelSpeed
from diffabs.sensors.speed_estimator import SpeedEstimator as SpeedEstimator
