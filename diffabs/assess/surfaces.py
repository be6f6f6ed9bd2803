"""Roads with a coefficient of adhesion k: Burckhardt's curves of dry asphalt and snow, scaled, at every speed alike.

The greatest friction of mu(s) = c1 (1 - exp(-c2 s)) - c3 s is at s* = ln(c1 c2/c3)/c2, and is c1 - c3/c2 - c3 s*.
"""

import jax.numpy as jnp

from diffabs.core.pytree import replace
from diffabs.core.types import Scalar
from diffabs.parts.roads import DRY_ASPHALT, SNOW, Burckhardt


def peak_friction(road: Burckhardt) -> Scalar:
    """Return the greatest friction of a curve [1] at walking speed.

    >>> from diffabs.assess import peak_friction
    >>> from diffabs.parts.roads import DRY_ASPHALT
    >>> print(f"{peak_friction(DRY_ASPHALT):.4f}")
    1.1702
    """
    return road.c1 - road.c3 / road.c2 - road.c3 * peak_slip(road)


def peak_slip(road: Burckhardt) -> Scalar:
    """Return the slip of the greatest friction of a curve [1]."""
    return jnp.log(road.c1 * road.c2 / road.c3) / road.c2


def make_surface(adhesion: Scalar, slippery: bool) -> Burckhardt:
    """Return the curve of snow (slippery) or dry asphalt, scaled to a greatest friction of `adhesion` at all speeds."""
    shape = SNOW if slippery else DRY_ASPHALT
    factor = adhesion / peak_friction(shape)
    return replace(shape, {"c1": factor * shape.c1, "c3": factor * shape.c3, "c4": 0.0})
