"""Roads made of other roads: a friction scale, and patches along the distance."""

from collections.abc import Iterator
from itertools import pairwise

import jax.numpy as jnp
import numpy as np

from diffabs.core.numerics import clamp
from diffabs.core.protocols import Road
from diffabs.core.pytree import param, part, pytree
from diffabs.core.rules import Rule, increase_rule
from diffabs.core.types import Scalar, Vector
from diffabs.parts.roads.burckhardt import DRY_ASPHALT, SNOW


@pytree
class Scaled:
    """scale * mu of another road: one number for wear, temperature and wetness."""

    road: Road = part(default=DRY_ASPHALT)
    scale: Scalar = param(default=1.0, unit="1", above=0.0, high=10.0)
    """Factor of the friction."""

    def friction(self, slip: Scalar, speed: Scalar, distance: Scalar) -> Scalar:
        """Return scale * mu [1] at a `slip` [1], vehicle `speed` [m/s] and `distance` on the road [m]."""
        return self.scale * self.road.friction(slip, speed, distance)


@pytree
class Patches:
    """Surfaces in sequence, with jumps of mu between them.

        mu = mu_0 + sum_i S((x - edge_i)/width) (mu_(i+1) - mu_i),  S(z) = 3 y^2 - 2 y^3,  y = clamp(z + 1/2, 0, 1)

    A width of about 0.1 m is the length of a tyre's contact patch. With width 0 the jump is sharp. The values are then
    exact, but derivatives through the run miss the movement of the jump time. For derivatives, use a width of a few
    steps.

    >>> from diffabs.parts.roads import DRY_ASPHALT, ICE, Patches
    >>> road = Patches(roads=(DRY_ASPHALT, ICE), edges=(10.0,))
    >>> print(*(f"{road.friction(0.1, 20.0, at):.2f}" for at in (9.0, 10.0, 11.0)))
    1.05 0.55 0.05
    """

    roads: tuple[Road, ...] = part(default=(DRY_ASPHALT, SNOW))
    edges: Vector = param(default=(10.0,), unit="m", low=0.0, free=True)
    """Distances at which one surface ends and the next begins, increasing."""
    width: Scalar = param(default=0.1, unit="m", low=0.0)
    """Length of the transition between two surfaces; 0 is a jump."""

    def friction(self, slip: Scalar, speed: Scalar, distance: Scalar) -> Scalar:
        """Return mu [1] of the surface at a `distance` [m], for a `slip` [1] and vehicle `speed` [m/s].

        Raises:
            ValueError: The number of edges is not the number of roads minus one.
        """
        edges = jnp.asarray(self.edges)
        if edges.shape != (len(self.roads) - 1,):
            raise ValueError(f"edges has shape {edges.shape}; {len(self.roads)} roads need one less")
        mus = [road.friction(slip, speed, distance) for road in self.roads]
        # A width of 0 is replaced by 1: a division by 0 in the branch not taken would put NaN into the derivatives.
        smooth = jnp.greater(self.width, 0)
        width = jnp.where(smooth, self.width, 1.0)
        total = mus[0]
        for i, (before, after) in enumerate(pairwise(mus)):
            beyond = distance - edges[i]
            y = clamp(beyond / width + 0.5, 0.0, 1.0)
            weight = jnp.where(smooth, y * y * (3 - 2 * y), jnp.where(beyond >= 0, 1.0, 0.0))
            total = total + weight * (after - before)
        return total

    def problems(self) -> Iterator[str]:
        """Yield a message if the number of edges is not the number of roads minus one."""
        shape = np.shape(self.edges)
        if shape != (len(self.roads) - 1,):
            yield f"edges has shape {shape}; {len(self.roads)} roads need ({len(self.roads) - 1},)"

    def rules(self) -> Iterator[Rule]:
        """Yield the rule that the edges increase."""
        yield increase_rule("edges", self.edges, "is not increasing", "m")
