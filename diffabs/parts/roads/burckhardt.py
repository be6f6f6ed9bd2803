"""Burckhardt's friction curve.

    mu(s, v) = (c1 (1 - exp(-c2 s)) - c3 s) exp(-c4 s v)        for s >= 0, odd in s

Kiencke and Nielsen give c1..c3 for each surface, and 0.02 to 0.04 s/m as the range of c4 on all surfaces. The named
roads use the middle of this range, c4 = 0.03 s/m. The value 0 gives the curve at walking speed, which is the curve
usually plotted.

Source: M. Burckhardt, Fahrwerktechnik: Radschlupf-Regelsysteme, Vogel 1993. Coefficients as tabulated by Kiencke and
Nielsen, Automotive Control Systems, Springer 2005, ch. 8.
"""

from collections.abc import Iterator

import jax.numpy as jnp
from jax.tree_util import Partial

from diffabs.core.numerics import odd
from diffabs.core.pytree import param, pytree
from diffabs.core.rules import Rule
from diffabs.core.types import Scalar
from diffabs.parts.roads.sign import opposes


@pytree
class Burckhardt:
    """mu(s, v) = (c1 (1 - exp(-c2 s)) - c3 s) exp(-c4 s v); the defaults are dry asphalt.

    >>> from diffabs.parts.roads import DRY_ASPHALT, ICE
    >>> print(f"{DRY_ASPHALT.friction(0.15, speed=20.0):.3f} {ICE.friction(0.15, speed=20.0):.3f}")
    1.067 0.046
    """

    c1: Scalar = param(default=1.2801, unit="1", low=0.0)
    """Friction that the rise with the slip approaches."""
    c2: Scalar = param(default=23.99, unit="1", above=0.0)
    """Rate of that rise."""
    c3: Scalar = param(default=0.52, unit="1", low=0.0)
    """Fall of the friction per slip."""
    c4: Scalar = param(default=0.03, unit="s/m", low=0.0)
    """Rate of the fall with slip and speed."""

    def friction(self, slip: Scalar, speed: Scalar, distance: Scalar = 0.0) -> Scalar:
        """Return mu [1] at a `slip` [1] and vehicle `speed` [m/s]; `distance` has no effect."""
        del distance

        def curve(s: Scalar) -> Scalar:
            return (-self.c1 * jnp.expm1(-self.c2 * s) - self.c3 * s) * jnp.exp(-self.c4 * s * speed)

        return odd(curve, slip)

    def rules(self) -> Iterator[Rule]:
        """Yield the rule that friction is not negative; the sign does not depend on the speed."""
        yield opposes(Partial(type(self).friction, self, speed=0.0))


DRY_ASPHALT = Burckhardt()
WET_ASPHALT = Burckhardt(c1=0.857, c2=33.822, c3=0.347)
DRY_CONCRETE = Burckhardt(c1=1.1973, c2=25.168, c3=0.5373)
DRY_COBBLESTONE = Burckhardt(c1=1.3713, c2=6.4565, c3=0.6691)
WET_COBBLESTONE = Burckhardt(c1=0.4004, c2=33.7080, c3=0.1204)
SNOW = Burckhardt(c1=0.1946, c2=94.129, c3=0.0646)
ICE = Burckhardt(c1=0.05, c2=306.39, c3=0.0)
