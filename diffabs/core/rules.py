"""What must hold between the numbers of a part, said once: of one loop with its numbers, of many lanes as an array.

A part has a method `rules()` that yields them, and `grid_rules(step)` for those that concern the integration step [s].
They are evaluated with concrete numbers, and traced, for all lanes of a batch in one compiled call."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from diffabs.core.units import Units, insert_unit

MAX_SHOWN_NUMBERS = 8  # numbers of a list in a message


class Rule(NamedTuple):
    """holds: bool, an expression of the part's numbers; broken: what is said of lanes that break it, without numbers;
    says: the same of one part, with its numbers, for which they must be concrete; ` {control}` in it is the unit of the
    loop's control."""

    holds: Any
    broken: str
    says: Callable[[], str]

    def under(self, prefix: str, units: Units | None = None) -> "Rule":
        """The same rule, of a part at this place, in a loop with these units."""
        return Rule(self.holds, prefix + self.broken, lambda: prefix + insert_unit(self.says(), units))


def as_rule_array(x: Any) -> Any:
    """An array to calculate with: traced numbers as they are, others in float64 whatever JAX's default type is."""
    if any(isinstance(leaf, jax.Array) for leaf in jax.tree.leaves(x)):
        return jnp.asarray(x)
    return np.asarray(x, float)


def order_rule(low: tuple[str, Any], high: tuple[str, Any], unit: str, *, equal: bool = True) -> Rule:
    """A lower limit that does not exceed the upper one, or lies below it; both (name, value)."""
    (below, a), (above, b) = low, high
    relation = "exceeds" if equal else "is not below"
    return Rule(
        as_rule_array(a) <= as_rule_array(b) if equal else as_rule_array(a) < as_rule_array(b),
        f"{below} {relation} {above}",
        lambda: f"{below} = {a:g} {unit} {relation} {above} = {b:g} {unit}",
    )


def increase_rule(name: str, values: Any, broken: str, unit: str) -> Rule:
    """Numbers (n,) each of which is greater than the one before."""
    x = as_rule_array(values)
    return Rule(
        (x[1:] > x[:-1]).all(),
        f"{name} {broken}",
        lambda: (
            f"{name} = {np.asarray(x).tolist()} {unit} {broken}" if len(x) <= MAX_SHOWN_NUMBERS else f"{name} {broken}"
        ),
    )
