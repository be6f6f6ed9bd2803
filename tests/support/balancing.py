"""What the tests of the two-wheeler share: the hanging arm, its LQR, and its loop."""

import dataclasses

import numpy as np

from diffabs.core.pytree import replace
from diffabs.engine.solvers import FixedStep
from diffabs.linear.balance_model import BalanceModel
from diffabs.parts.controllers import BalanceFeedback
from diffabs.parts.plants import ArmBalance
from diffabs.scenario.defaults import balancing

HANGING = ArmBalance(arm_length=-0.5)
START = np.array([0.5, 0.0, 0.2, 0.0, 0.0, 0.0])  # of the paper's Fig. 3
DIRECTION = {"initial.theta": 0.5, "initial.phi": 0.2}
GAIN = np.array([3518.9528, -300.78828, 1397.0168, 1242.2936, -10.830832, 516.96042])  # LQR of the hanging arm
WEIGHTS, EFFORT = np.diag([1.0, 100.0, 1.0, 1.0, 1.0, 1.0]), 0.01
MULTIPLES = {24.0: 0.0454, 48.0: 0.0801, 100.0: 0.1146}  # of the start that this gain recovers
# LQR with Q = I, R = 0.01: a slow one, whose slowest pole is -0.47 /s
SLOW = np.array([1929.4575697, -200.43085318, 765.68751921, 679.6082651, -7.45823428, 282.76552681])
SOLVER = FixedStep(step=1e-3, duration=60.0)
SHORT = FixedStep(step=2e-3, duration=4.0)


def closed(multiple=0.0, voltage=48.0, **parts):
    """The hanging arm from a multiple of the start."""
    values = {path: multiple * value for path, value in DIRECTION.items()} | {"actuator.high": voltage}
    loop = dataclasses.replace(balancing(), plant=HANGING, controller=BalanceFeedback(gain=GAIN))
    return replace(dataclasses.replace(loop, **parts), values)


def model(plant):
    return BalanceModel(plant=plant).matrices()
