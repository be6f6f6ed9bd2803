"""Plants: dx/dt = derivative(t, x, u), y = output(x)."""

from diffabs.plants.arm_balance import ACROBOT as ACROBOT
from diffabs.plants.arm_balance import ArmBalance as ArmBalance
from diffabs.plants.arm_balance import BalanceStart as BalanceStart
from diffabs.plants.lab_rig import LabRig as LabRig
from diffabs.plants.mirrored_rig import MirroredRig as MirroredRig
from diffabs.plants.printed_arm import PrintedArm as PrintedArm
from diffabs.plants.quarter_car import QuarterCar as QuarterCar
from diffabs.plants.road_vehicle import RoadVehicle as RoadVehicle
from diffabs.plants.wheel import GRAVITY as GRAVITY
from diffabs.plants.wheel import BrakeStart as BrakeStart
