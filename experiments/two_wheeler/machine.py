"""A machine of the co-design: arm, mount, motor and gear of a two-wheeler, and the weights of its LQR."""

import dataclasses

import jax.numpy as jnp

from diffabs import Loop
from diffabs.core.pytree import param, part, pytree, replace, static
from diffabs.core.types import Scalar, Vector
from diffabs.linear.balance_model import BalanceModel
from diffabs.linear.regulator import lqr
from diffabs.parts.plants import ArmBalance

CLEAR = 0.05  # m, between the hanging arm and the ground
ROTOR = 2e-4  # kg m^2


@pytree
class Machine:
    """A machine and its LQR weights; `closed_loop()` is the loop."""

    loop: Loop = part(default=Loop)
    mount: Scalar = param(default=0.7, unit="m")
    reach: Scalar = param(default=0.95, unit="1")
    offset: Scalar = param(default=0.5, unit="1")
    arm_mass: Scalar = param(default=30.0, unit="kg")
    constant: Scalar = param(default=0.1, unit="N m/A")
    gear: Scalar = param(default=60.0, unit="1")
    rider: Scalar = param(default=95.0, unit="kg")
    log_q: Vector = param(default=(0.0,) * 6, unit="1")
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

    def closed_loop(self) -> Loop:
        """The loop with the LQR for one rider."""
        plant = self.plant()
        a, b = BalanceModel(plant=dataclasses.replace(plant, rider_mass=self.rider)).matrices()
        gain = lqr(a, b, jnp.diag(jnp.exp(jnp.asarray(self.log_q))), jnp.exp(jnp.asarray(self.log_r))[None, None]).gain[
            0
        ]
        return replace(dataclasses.replace(self.loop, plant=plant), {"controller.gain": gain})
