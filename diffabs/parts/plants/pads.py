"""Brake pads of a car: which torque a command makes, and how hot the discs become.

    C T' = torque omega - h (T - T_a),   torque = command (1 - loss/(1 + exp((T_h - T)/w)))

for the disc of each wheel. It is one body of the temperature T, which the brake's whole power heats. Fade is the
friction that hot pads lose: half of the loss at T_h, and nearly all of it some w above.

Source: R. Limpert, Brake Design and Safety, 3rd ed., ch. 3, for the heat balance. The curve of the fade is a smooth
step of no particular pad.
"""

from collections.abc import Sequence
from typing import ClassVar

import jax

from diffabs.core.numerics import quotient
from diffabs.core.pytree import param, pytree
from diffabs.core.types import Scalar

CELSIUS = 273.15  # K


@pytree
class ConstantPads:
    """Pads with the same friction at every temperature, which is not computed."""

    heated: ClassVar[bool] = False

    def start(self, brakes: int) -> tuple[Scalar, ...]:
        """Return nothing: there are no temperatures."""
        del brakes
        return ()

    def torques(self, temperatures: Sequence[Scalar], commands: Sequence[Scalar]) -> tuple[Scalar, ...]:
        """Return the brake torques [N m]: the commands, at every temperature."""
        del temperatures
        return tuple(commands)

    def commands(self, temperatures: Sequence[Scalar], torques: Sequence[Scalar]) -> tuple[Scalar, ...]:
        """Return the commands [N m]: the torques, at every temperature."""
        del temperatures
        return tuple(torques)

    def heat_rates(self, temperatures: Sequence[Scalar], powers: Sequence[Scalar]) -> tuple[Scalar, ...]:
        """Return nothing: there are no temperatures."""
        del temperatures, powers
        return ()


@pytree
class FadingPads:
    """Pads that lose friction as their discs become hot; the car shows the temperature of each disc.

    The defaults are of the size of a compact car's discs, of no particular one.

    >>> from diffabs.parts.plants import FadingPads
    >>> hot, cold = 800.0, 300.0
    >>> [round(float(torque)) for torque in FadingPads().torques((hot, cold), (1000.0, 1000.0))]
    [646, 1000]
    """

    front_capacity: Scalar = param(default=3500.0, unit="J/K", above=0.0)
    """Heat capacity C of each front disc."""
    rear_capacity: Scalar = param(default=2500.0, unit="J/K", above=0.0)
    """Heat capacity of each rear disc."""
    cooling: Scalar = param(default=12.0, unit="W/K", low=0.0)
    """Heat h that a disc gives to the air per kelvin above it."""
    air: Scalar = param(default=CELSIUS + 20, unit="K", above=0.0)
    """Temperature T_a of the air."""
    initial: Scalar = param(default=CELSIUS + 20, unit="K", above=0.0, high=2000.0)
    """Temperature of the discs at t = 0."""
    loss: Scalar = param(default=0.4, unit="1", low=0.0, below=1.0)
    """Share of the friction that very hot pads lose."""
    middle: Scalar = param(default=CELSIUS + 425, unit="K", above=0.0)
    """Temperature T_h at which half of it is lost."""
    spread: Scalar = param(default=50.0, unit="K", above=0.0)
    """Temperature w over which the friction falls."""

    heated: ClassVar[bool] = True

    def start(self, brakes: int) -> tuple[Scalar, ...]:
        """Return the temperature of each disc [K]."""
        return (self.initial,) * brakes

    def torques(self, temperatures: Sequence[Scalar], commands: Sequence[Scalar]) -> tuple[Scalar, ...]:
        """Return the brake torques [N m] that the commands [N m], of cold pads, make at these temperatures [K]."""
        shares = map(self._friction_left, temperatures)
        return tuple(share * command for share, command in zip(shares, commands, strict=True))

    def commands(self, temperatures: Sequence[Scalar], torques: Sequence[Scalar]) -> tuple[Scalar, ...]:
        """Return the commands [N m] at which pads at these temperatures [K] make the torques [N m]."""
        shares = map(self._friction_left, temperatures)
        return tuple(quotient(torque, share) for share, torque in zip(shares, torques, strict=True))

    def heat_rates(self, temperatures: Sequence[Scalar], powers: Sequence[Scalar]) -> tuple[Scalar, ...]:
        """Return the rate of each temperature [K/s] under the power of its brake [W]; the first half is the front."""
        half = len(powers) // 2
        capacities = [self.front_capacity] * half + [self.rear_capacity] * half
        return tuple(
            quotient(power - self.cooling * (temperature - self.air), capacity)
            for temperature, power, capacity in zip(temperatures, powers, capacities, strict=True)
        )

    def _friction_left(self, temperature: Scalar) -> Scalar:
        """Return the friction at a temperature [K] over that of cold pads."""
        return 1 - self.loss * jax.nn.sigmoid((temperature - self.middle) / self.spread)
