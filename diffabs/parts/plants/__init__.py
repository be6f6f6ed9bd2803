"""Plants: dx/dt = derivative(t, x, u), y = output(x)."""

from diffabs.parts.plants.arm_balance import ACROBOT as ACROBOT
from diffabs.parts.plants.arm_balance import ArmBalance as ArmBalance
from diffabs.parts.plants.arm_balance import BalanceStart as BalanceStart
from diffabs.parts.plants.car import Car as Car
from diffabs.parts.plants.half_car import HalfCar as HalfCar
from diffabs.parts.plants.lab_rig import LabRig as LabRig
from diffabs.parts.plants.mirrored_rig import MirroredRig as MirroredRig
from diffabs.parts.plants.pads import ConstantPads as ConstantPads
from diffabs.parts.plants.pads import FadingPads as FadingPads
from diffabs.parts.plants.printed_arm import PrintedArm as PrintedArm
from diffabs.parts.plants.quadruple_tank import QuadrupleTank as QuadrupleTank
from diffabs.parts.plants.quadruple_tank import TankStart as TankStart
from diffabs.parts.plants.quarter_car import QuarterCar as QuarterCar
from diffabs.parts.plants.road_vehicle import RoadVehicle as RoadVehicle
from diffabs.parts.plants.wheel import GRAVITY as GRAVITY
from diffabs.parts.plants.wheel import BrakeStart as BrakeStart
