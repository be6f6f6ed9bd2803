"""Pacejka's Magic Formula.

    mu(s) = D sin(C arctan(x - E (x - arctan x))),  x = B s        odd in s without an extension

Source: H. B. Pacejka, Tire and Vehicle Dynamics, 3rd ed., eq. (4.49), without shifts, force divided by load.
"""

import jax.numpy as jnp

from diffabs.core.pytree import param, pytree
from diffabs.core.types import Scalar


@pytree
class MagicFormula:
    """mu(s) = D sin(C arctan(x - E (x - arctan x))), x = B s.

    The defaults reproduce Tables 1 and 2 of Aoki and Nakamura within 0.01 s and 0.06 m. They were identified from these
    tables with J = 1.0539 kg m^2, because the paper does not give its curve.

    >>> from diffabs.parts.roads import MagicFormula
    >>> print(f"{MagicFormula(D=0.5).friction(0.1):.3f}")
    0.500
    """

    B: Scalar = param(default=13.00891, unit="1", above=0.0)
    """Stiffness factor."""
    C: Scalar = param(default=1.47692, unit="1", low=1.0, high=2.0)
    """Shape factor."""
    D: Scalar = param(default=0.98483, unit="1", low=0.0)
    """Peak factor: greatest friction."""
    E: Scalar = param(default=-1.08841, unit="1", high=1.0)
    """Curvature factor."""

    def friction(self, slip: Scalar, speed: Scalar = 0.0, distance: Scalar = 0.0) -> Scalar:
        """Return mu [1] at a `slip` [1]; `speed` and `distance` have no effect."""
        del speed, distance
        x = self.B * slip
        return self.D * jnp.sin(self.C * jnp.arctan(x - self.E * (x - jnp.arctan(x))))
