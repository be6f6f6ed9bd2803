"""Rules between the numbers of a part, written once for a single loop and for the runs of a batch.

A part yields its rules from a method `rules()`, and from `grid_rules(step)` the rules on the integration step [s]. They
are evaluated with concrete numbers, or traced, for all runs of a batch in one compiled call.
"""

from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np

from diffabs.core.arrays import as_rule_array
from diffabs.core.types import Bool, Part, PyTree, Scalar
from diffabs.core.units import Units, insert_unit

MAX_SHOWN_NUMBERS = 8  # numbers of a list in a message


class Rule(NamedTuple):
    """A condition on the numbers of a part.

    Attributes:
        holds: Boolean or boolean array, True where the condition holds.
        broken: Message for the runs of a batch that break the rule, without numbers.
        says: Function that returns the message for a single part, with its numbers, which must be concrete. The text
            `{control}` or `{signal}` in it stands for the unit of the loop's control or signal.
    """

    holds: Bool
    broken: str
    says: Callable[[], str]

    def under(self, prefix: str, units: Units | None = None) -> "Rule":
        """Return the same rule for a part at the path `prefix`, in a loop with these `units`."""
        return Rule(self.holds, prefix + self.broken, lambda: prefix + insert_unit(self.says(), units))


def order_rule(low: tuple[str, PyTree], high: tuple[str, PyTree], unit: str, *, equal: bool = True) -> Rule:
    """Return the rule low <= high of two limits (name, value), or low < high if they may not be equal."""
    (below, a), (above, b) = low, high
    relation = "exceeds" if equal else "is not below"
    unit = "" if unit == "1" else f" {unit}"
    return Rule(
        as_rule_array(a) <= as_rule_array(b) if equal else as_rule_array(a) < as_rule_array(b),
        f"{below} {relation} {above}",
        lambda: f"{below} = {a:g}{unit} {relation} {above} = {b:g}{unit}",
    )


def increase_rule(name: str, values: object, broken: str, unit: str) -> Rule:
    """Return the rule that each number is greater than the one before; `broken` is the message after the name."""
    x = as_rule_array(values)
    return Rule(
        (x[1:] > x[:-1]).all(),
        f"{name} {broken}",
        lambda: (
            f"{name} = {np.asarray(x).tolist()} {unit} {broken}" if len(x) <= MAX_SHOWN_NUMBERS else f"{name} {broken}"
        ),
    )


def whole_steps(name: str, period: Scalar, step: Scalar, called: str = "") -> Rule:
    """Return the rule that a period [s] is a whole multiple of the step [s], to a relative tolerance of 1e-6.

    The message calls the step `called`, or else names that of the solver with its number.
    """
    count, called = as_rule_array(period) / step, called or f"solver.step = {step:g} s"
    return Rule(
        (count >= 0.5) & (abs(count - count.round()) <= 1e-6 * count),
        f"{name} is not a multiple of {called}",
        lambda: f"{name} = {float(period):g} s is not a multiple of {called}",
    )


def period_on_grid(self: Part, step: float) -> Iterator[Rule]:
    """Yield the rule that a block's period is a multiple of the step [s]: its method `grid_rules`."""
    yield whole_steps("period", self.period, step)
