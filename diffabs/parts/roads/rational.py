"""Friction curve of the laboratory rig.

    mu(s) = w4 s^q / (a + s^q) + w3 s^3 + w2 s^2 + w1 s        for s >= 0, odd in s

The paper's statement "0.2 is the slip of greatest friction" is not true of this curve. Its local peak is at slip
0.18754, and a locked wheel (slip 1) has more friction than either. The printed equation is undefined for s < 0; the odd
extension is an addition of diffabs.

Source: Maeda and Sugiura, eq. (13), after INTECO, The Laboratory Anti-lock Braking System, user's manual.
"""

from collections.abc import Iterator

from jax.tree_util import Partial

from diffabs.core.numerics import odd, power, quotient
from diffabs.core.pytree import param, pytree
from diffabs.core.rules import Rule
from diffabs.core.types import Scalar
from diffabs.parts.roads.sign import opposes


@pytree
class RationalCurve:
    """mu(s) = w4 s^q/(a + s^q) + w3 s^3 + w2 s^2 + w1 s, with the coefficients rounded as in eq. (13)."""

    w1: Scalar = param(default=-4.24e-2, unit="1")
    """Coefficient of s."""
    w2: Scalar = param(default=2.94e-10, unit="1")
    """Coefficient of s^2."""
    w3: Scalar = param(default=3.51e-2, unit="1")
    """Coefficient of s^3."""
    w4: Scalar = param(default=0.407, unit="1", low=0.0)
    """Friction that the rise with the slip approaches."""
    a: Scalar = param(default=2.57e-4, unit="1", above=0.0)
    """Value of s^q at which the rise is half over."""
    q: Scalar = param(default=2.10, unit="1", above=1.0)
    """Exponent of the rise."""

    def friction(self, slip: Scalar, speed: Scalar = 0.0, distance: Scalar = 0.0) -> Scalar:
        """Return mu [1] at a `slip` [1]; `speed` and `distance` have no effect."""
        del speed, distance
        return odd(self._curve, slip)

    def rules(self) -> Iterator[Rule]:
        """Yield the rule that friction is not negative."""
        yield opposes(Partial(type(self).friction, self))

    def _curve(self, s: Scalar) -> Scalar:
        p = power(s, self.q)
        return quotient(self.w4 * p, self.a + p) + s * (self.w1 + s * (self.w2 + s * self.w3))


RIG = RationalCurve()
RIG_UNROUNDED = RationalCurve(
    w1=-0.04240011450454,
    w2=2.9375e-10,
    w3=0.03508217905067,
    w4=0.40662691102315,
    a=0.00025724985785,
    q=2.09945271667129,
)
