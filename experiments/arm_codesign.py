"""What machine would make the paper's claim true? Arm, mount, motor, gear and weights designed together, by gradients.

Maximised is the multiple c of the paper's start, frame c 0.5 rad and rider c 0.2 rad, that 48 V recover whoever rides,
40 to 100 kg. Two ways, one after the other:

    bound      the largest multiple that any control recovers in the linear model, 2 U/sqrt((B'PB)(d'Pd)), maximised over
               machines: it costs a Riccati equation, and says what a machine is good for before it has a controller
    rollouts   mean of `SoftLoss` over riders and multiples, through the nonlinear closed loop, the Riccati equation of
               the LQR and the machine, in the machine and the weights together, from there

What the machine may be. The arm is a uniform rod, as in the paper (I2 = m2 Lg^2/3), that hangs from the mount and stays
0.05 m clear of the ground; 5 to 40 kg; the mount, at which the rider sits too, 0.4 to 1.0 m high. The motor has
k = 0.05 to 0.2 N m/A, a rotor of 2e-4 kg m^2, and a gear of 5 to 400. Its winding decides what power 48 V give: the
paper's 3 ohm (192 W at the most), and less, with a current of 60 A at the most.

    python experiments/arm_codesign.py
"""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import minimize

from diffabs import FixedStep, Loop, plot
from diffabs.balance_model import BalanceModel
from diffabs.basin import recovered
from diffabs.design import certify
from diffabs.design.gridded import gridded
from diffabs.design.recovery import recoverable_bound
from diffabs.design.regulator import lqr
from diffabs.objectives import BALANCE, SoftLoss
from diffabs.papers import record
from diffabs.plants import ArmBalance
from diffabs.pytree import Scalar, Vector, param, part, pytree, replace, static
from diffabs.rollout import rollout
from diffabs.scenario import load
from diffabs.tune import Batch, Method, Stopping, tune

START = np.array([0.5, 0.0, 0.2, 0.0, 0.0, 0.0])
CLEAR = 0.05  # m, between the hanging arm and the ground
ROTOR = 2e-4  # kg m^2


@dataclasses.dataclass(frozen=True)
class Config:
    """Every number of the experiment."""

    windings: tuple[tuple[float, float], ...] = ((3.0, 16.0), (1.0, 48.0), (0.3, 60.0), (0.1, 60.0))  # ohm, A
    tuned: tuple[int, ...] = (0, 2)  # of these, the machines that are tuned by rollouts
    voltage: float = 48.0
    riders: tuple[float, ...] = (40.0, 55.0, 70.0, 85.0, 100.0)  # kg
    mount: tuple[float, float] = (0.4, 1.0)  # m
    reach: tuple[float, float] = (0.2, 1.0)  # of the way from the mount to the ground, less the clearance
    offset: tuple[float, float] = (0.005, 0.5)  # of the rod's centre below the mount, relative to the rod's reach
    arm_mass: tuple[float, float] = (5.0, 40.0)  # kg
    constant: tuple[float, float] = (0.05, 0.2)  # N m/A
    gear: tuple[float, float] = (5.0, 400.0)
    step: float = 2e-3  # s, of the rollouts that are differentiated
    duration: float = 5.0
    counted: tuple[float, ...] = (1.0, 0.01, 1.0, 1.0, 0.0, 1.0)  # of the squares in SoftLoss: the arm may still turn
    radius: float = 0.1  # of SoftLoss
    softness: float = 0.5
    multiples: int = 16  # of the start, up to 1.2 times the bound
    iterations: int = 30
    judged_step: float = 1e-3
    judged_duration: float = 10.0
    judged_multiples: int = 60
    out: str = "out/experiments/arm_codesign"


@pytree
class Machine:
    """A machine and its LQR weights; `closed()` is the loop."""

    loop: Loop = part(default=Loop)
    mount: Scalar = param(default=0.7, unit="m")
    reach: Scalar = param(default=0.95, unit="1")
    offset: Scalar = param(default=0.5, unit="1")
    arm_mass: Scalar = param(default=30.0, unit="kg")
    constant: Scalar = param(default=0.1, unit="N m/A")
    gear: Scalar = param(default=60.0, unit="1")
    rider: Scalar = param(default=60.0, unit="kg")
    log_q: Vector = param(default=(0.0, 4.6, 0.0, 0.0, 0.0, 0.0), unit="1")
    log_r: Scalar = param(default=-6.0, unit="1")
    resistance: float = static(default=3.0)
    current: float = static(default=16.0)

    def plant(self) -> ArmBalance:
        """The two-wheeler with this arm and motor."""
        span = self.reach * (self.mount - CLEAR)
        length, half = -self.offset * span, (1 - self.offset) * span
        return dataclasses.replace(
            self.loop.plant,
            mount_height=self.mount,
            arm_length=length,
            arm_mass=self.arm_mass,
            arm_inertia=self.arm_mass * half**2 / 3,
            torque_constant=self.constant,
            back_emf=self.constant,
            gear=self.gear,
            rotor_inertia=ROTOR + 0.0 * self.gear,
            resistance=self.resistance + 0.0 * self.gear,
            current_max=self.current + 0.0 * self.gear,
        )

    def closed(self) -> Loop:
        """The loop with the LQR for one rider."""
        plant = self.plant()
        a, b = BalanceModel(plant=dataclasses.replace(plant, rider_mass=self.rider)).matrices()
        gain = lqr(a, b, jnp.diag(jnp.exp(jnp.asarray(self.log_q))), jnp.exp(jnp.asarray(self.log_r))[None, None]).gain[0]
        return replace(dataclasses.replace(self.loop, plant=plant), {"controller.gain": gain})


FREE = ("mount", "reach", "offset", "arm_mass", "constant", "gear")


def bounds(config: Config, machine: Machine) -> Any:
    """For each rider the largest multiple that any control recovers in the linear model: the lesser of what the voltage
    allows without a limit of the current, and the current without one of the voltage."""

    def one(rider: Any) -> Any:
        plant = dataclasses.replace(machine.plant(), rider_mass=rider)
        a, b = BalanceModel(plant=plant).matrices()
        by_voltage = recoverable_bound(a, b, START, config.voltage)
        most = machine.current * machine.resistance  # the voltage that drives this current through a motor without emf
        a, b = BalanceModel(plant=dataclasses.replace(plant, back_emf=0.0 * plant.back_emf)).matrices()
        return jnp.minimum(by_voltage, recoverable_bound(a, b, START, most))

    return jax.vmap(one)(jnp.asarray(config.riders))


def best_bound(config: Config, machine: Machine) -> Machine:
    """The machine with the greatest bound for the worst rider: L-BFGS-B on the gradient of a smooth minimum."""
    ranges = np.log([getattr(config, name) for name in FREE])

    def built(z: Any) -> Machine:
        return replace(machine, dict(zip(FREE, jnp.exp(z), strict=True)))

    @jax.jit
    @jax.value_and_grad
    def loss(z: Any) -> Any:
        return jax.nn.logsumexp(-jnp.log(bounds(config, built(z))) * 40.0) / 40.0

    start = np.log([float(getattr(machine, name)) for name in FREE])
    found = minimize(lambda z: [np.asarray(x, float) for x in loss(z)], start, jac=True, method="L-BFGS-B", bounds=ranges)
    return jax.tree.map(float, replace(built(found.x), {})) if False else built(np.asarray(found.x))


def tuned(config: Config, machine: Machine) -> Any:
    """Machine and weights together, through nonlinear runs."""
    worst = float(jnp.min(bounds(config, machine)))
    multiples = np.linspace(0.1, 1.2, config.multiples) * worst
    riders, multiples = (x.ravel() for x in np.meshgrid(config.riders, multiples, indexing="ij"))
    over = {"plant.rider_mass": riders, "initial.theta": START[0] * multiples, "initial.phi": START[2] * multiples}
    ranges = {name: getattr(config, name) for name in FREE}
    return tune(
        machine,
        free={**ranges, "rider": (min(config.riders), max(config.riders)), "log_q": (-8.0, 12.0), "log_r": (-9.0, 4.0)},
        objective={"loss": 1.0},
        over=Batch(over),
        solver=FixedStep(step=config.step, duration=config.duration),
        measured={"loss": SoftLoss(weight=np.array(config.counted), radius=config.radius, softness=config.softness)},
        method=Method(stopping=Stopping(iterations=config.iterations)),
    )
