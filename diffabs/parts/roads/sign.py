"""Rules on friction curves: friction is not negative, and it stays below a limit of the machine."""

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.tree_util import Partial

from diffabs.core.compiling import QUICK_COMPILE_OPTIONS, compile_once
from diffabs.core.protocols import Road
from diffabs.core.rules import Rule
from diffabs.core.types import AnyArray, Scalar

SPEED = 10.0  # m/s, at which the sign of a road's friction is checked
MAX_FRICTION_AT_REST = 1e-6  # |mu| at slip 0, more than rounding

# At smaller slips a fitted polynomial may be negative by a millionth, as the rig's is.
SLIPS = np.linspace(0.05, 1.0, 20)


def opposes(friction: Partial) -> Rule:
    """Return the rule that mu(s) >= 0 at 20 slips from 0.05 to 1: negative friction would accelerate the car.

    A violation raises nothing here: the check of the loop's rules reports it.
    """
    mu = _at_slips(friction)

    def says() -> str:
        worst = int(np.argmin(mu))
        return f"friction = {float(mu[worst]):.3g} at slip {SLIPS[worst]:g} is negative: such a road drives"

    return Rule((mu >= 0).all(), "friction is negative at some slip: such a road drives", says)


def stays_below(friction: Partial, limit: Scalar, name: str, then: str) -> Rule:
    """Return the rule that mu(s) < limit at 20 slips from 0.05 to 1; `then` names the consequence in its message."""
    mu = _at_slips(friction)

    def says() -> str:
        worst = int(np.argmax(mu))
        return f"friction = {float(mu[worst]):.3g} at slip {SLIPS[worst]:g} is not below {name} = {limit:.3g}: {then}"

    return Rule((mu < limit).all(), f"friction is not below {name} at some slip: {then}", says)


def find_wrong_sign(road: object) -> str:
    """Return a line about the first slip at which friction has the opposite sign or is NaN; empty without such a slip.

    20 slips from 0.05 to 1, their negatives and 0 are checked, at 10 m/s and distance 0.
    """
    slips = np.concatenate([SLIPS, -SLIPS, [0.0]])
    mu = np.asarray(_along(Partial(_friction_of, road), slips.astype(jnp.result_type(float))))
    right = np.where(slips == 0, abs(mu) <= MAX_FRICTION_AT_REST, mu * slips >= 0)  # NaN is wrong
    if right.all():
        return ""
    first = int(np.argmin(right))
    slip = slips[first]
    needed = "0 is needed" if slip == 0 else f"at {'most' if slip < 0 else 'least'} 0 is needed: such a road drives"
    return f"friction = {mu[first]:.3g} at slip {slip:g}; {needed}"


def _friction_of(road: Road, slip: Scalar) -> Scalar:
    return road.friction(slip, SPEED, 0.0)


def _at_slips(friction: Partial) -> AnyArray:
    """Return mu at SLIPS in the active precision, as a NumPy array unless traced."""
    mu = _along(friction, SLIPS.astype(jnp.result_type(float)))
    return mu if isinstance(mu, Tracer) else np.asarray(mu)


@compile_once(options=QUICK_COMPILE_OPTIONS)
def _along(friction: Partial, slips: Scalar) -> Scalar:
    """Return the friction at these slips, compiled as one program: one operation alone takes as long to compile."""
    return jax.vmap(friction)(slips)
