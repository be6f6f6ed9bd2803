"""Sensors: blocks that map the plant's output to the measured output."""

from diffabs.parts.sensors.angles import AngleSensor as AngleSensor
from diffabs.parts.sensors.encoder import EncoderSlip as EncoderSlip
from diffabs.parts.sensors.noise import Bias as Bias
from diffabs.parts.sensors.noise import Noise as Noise
from diffabs.parts.sensors.noise import PlayedWheelNoise as PlayedWheelNoise
from diffabs.parts.sensors.noise import Quantisation as Quantisation
from diffabs.parts.sensors.noise import WheelNoise as WheelNoise
from diffabs.parts.sensors.per_output import OutputError as OutputError
from diffabs.parts.sensors.per_output import OutputNoise as OutputNoise
from diffabs.parts.sensors.per_output import PerOutput as PerOutput
from diffabs.parts.sensors.reference_speed import SelectHigh as SelectHigh
from diffabs.parts.sensors.speed import DriftingSpeed as DriftingSpeed
from diffabs.parts.sensors.speed import IntegratedAccelerometer as IntegratedAccelerometer
from diffabs.parts.sensors.speed import SpeedScale as SpeedScale
from diffabs.parts.sensors.speed import WheelSpeed as WheelSpeed
from diffabs.parts.sensors.speed_estimator import SpeedEstimator as SpeedEstimator
