"""Periods on the integration grid."""

import jax
import jax.numpy as jnp

from diffabs.core.pytree import Scalar
from diffabs.core.rules import Rule, as_rule_array


def steps_in_period(period: Scalar, h: Scalar) -> Scalar:
    """Return the number of steps of length h in a period, rounded to an integer of at least 1.

    The number has no derivative.

    Args:
        period: Period [s].
        h: Step [s].
    """
    return jnp.maximum(jnp.round(jax.lax.stop_gradient(period / h)), 1).astype(int)


def whole_steps(name: str, period: Scalar, step: float) -> Rule:
    """Return the rule that a period is a whole multiple of the step, to a relative tolerance of 1e-6.

    Args:
        name: Name of the period.
        period: Period [s].
        step: Step [s].
    """
    count = as_rule_array(period) / step
    return Rule(
        (count >= 0.5) & (abs(count - count.round()) <= 1e-6 * count),
        f"{name} is not a multiple of solver.step = {step:g} s",
        lambda: f"{name} = {float(period):g} s is not a multiple of solver.step = {step:g} s",
    )
