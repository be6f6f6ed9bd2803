"""Margins that cross zero twice within a step, or only touch it. The signs at both ends of a step do not show them.

The cubic from values and rates at both ends stands for a margin within the step. A margin that turns beyond zero has
two crossings in the step. One that turns near zero has two or none, which rounding and errors decide: it grazes.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from diffabs.core.cubic import Cubic, HermiteStep
from diffabs.core.lanes import any_lane
from diffabs.core.types import Array, Bool, PyTree, Scalar
from diffabs.engine.hybrid import HybridState
from diffabs.engine.step.advance import Carry
from diffabs.engine.step.event_location import RunStatus
from diffabs.engine.step.modes import SlidingSurface, mode_in_step, pick_number, read_bits, stack_flat
from diffabs.engine.step.slides import along_of
from diffabs.engine.step.system import Evaluation, ObservedSystem

# A margin grazes if its least magnitude in the step is below this fraction, or this multiple of the machine epsilon, of
# its greater magnitude at the ends of the step.
GRAZING_DEPTH_FRACTION, GRAZING_DEPTH_EPS = 1e-6, 32
# Allowed error of the cubic in the middle of a step, as a fraction of the greatest value at both ends and there.
MARGIN_TOLERANCE = 1e-6
MAX_SLOPE_EFFECT = 4 / 27  # largest value of the Hermite polynomial x (1 - x)^2


class Outlook(NamedTuple):
    """Margins of comparisons and events at an instant.

    Attributes:
        margins: Margins, shape (n,); infinite for an event that cannot happen.
        rates: Their rates [1/s], shape (n,).
    """

    margins: Array
    rates: Array


class Turns(NamedTuple):
    """Where margins turn back within a step, or just beyond a landing.

    Attributes:
        time_since: Time [s] from the first turn beyond zero to the end of the step; 0 without one.
        grazes: True if a margin turns so near to zero that errors decide whether it is crossed.
    """

    time_since: Scalar
    grazes: Bool


def find_turns(starts: Outlook, ends: Outlook, length: Scalar, landing: Array) -> Turns:
    """Return when margins first turn back beyond zero within a step, and whether one only grazes zero.

    `landing` (n,) is True for the margin on whose zero the step ends.
    """
    # With the sign of the start, each margin is positive before its first crossing.
    sign = jnp.where(starts.margins < 0, -1.0, 1.0).astype(starts.margins.dtype)
    a, b, da, db = (sign * x for x in (starts.margins, ends.margins, length * starts.rates, length * ends.rates))
    greatest = jnp.maximum(jnp.abs(a), jnp.abs(b))
    undecided = max(GRAZING_DEPTH_FRACTION, GRAZING_DEPTH_EPS * float(jnp.finfo(a.dtype).eps)) * greatest

    def find() -> Turns:
        cubic = Cubic(a, b, da, db)
        c1, c2, c3 = cubic.coefficients()
        square = c2 * c2 - 3.0 * c1 * c3
        # Of both extrema this is the minimum: there the second derivative is 2 sqrt(square).
        bend = c2 + jnp.sqrt(jnp.where(square > 0, square, 0.0))
        place = -c1 / jnp.where(bend != 0, bend, jnp.inf)
        inside = (square > 0) & (place > 0) & (place < 1) & (b >= 0) & ~landing
        lowest = cubic(place)
        touches = inside & (jnp.abs(lowest) <= undecided)
        # Beyond a landing the margin is continued as a parabola: its depth is slope^2/(2 curvature).
        curvature = 2.0 * c2 + 6.0 * c3
        shallow = landing & (curvature > 0) & (0.5 * db * db <= undecided * curvature)
        since = jnp.where(inside & (lowest < -undecided), (1.0 - place) * length, 0.0)
        return Turns(jnp.max(since, initial=0.0), jnp.any(touches | shallow))

    # A slope at an end lowers the cubic by at most 4/27 of slope times length, so most steps need no cubic.
    reach = MAX_SLOPE_EFFECT * (jnp.maximum(-da, 0.0) + jnp.maximum(db, 0.0))
    near = landing | (jnp.isfinite(greatest) & (jnp.minimum(a, b) <= reach + undecided))
    return jax.lax.cond(any_lane(jnp.any(near)), find, lambda: Turns(jnp.zeros_like(length), jnp.asarray(False)))


def look_ahead(fresh: Bool, ended: SlidingSurface, along: tuple[SlidingSurface, ...], dynamics: Evaluation) -> Outlook:
    """Return the margins at an instant; it is `fresh` if its numbers have just chosen the mode of the next step.

    `ended` is the surface along which a slide ends here. The run slides `along` surfaces.
    """
    margins, rates, numbers = _list_margins(dynamics, 0)
    surfaces = jnp.arange(numbers.size) < numbers.size - len(jax.tree.leaves(dynamics.margins))
    if ended.answers:
        # A run leaves its surface with the rate 0, whose sign is that of a rounding error. Another comparison may have
        # the same surface, as both of `jnp.sign` do.
        rounding = jnp.abs(pick_number(numbers, ended.number, jnp.where(surfaces, margins, 0.0)))
        same = (numbers == ended.number) | (read_bits(ended.answers, numbers) & (jnp.abs(margins) <= rounding))
        rest = fresh & ended.exists & surfaces & same
        margins, rates = (jnp.where(rest, 0.0, x) for x in (margins, rates))
    # The margin of a newly chosen answer may have any sign. It is turned so that it is positive within the mode. That
    # of a slide is negative where its share has jumped beyond 0 or 1, because another answer has changed.
    for surface in along:
        surfaces &= numbers != surface.number
    turned = fresh & surfaces & ((margins < 0) | ((margins == 0) & (rates < 0)))
    return Outlook(jnp.where(turned, -margins, margins), jnp.where(turned, -rates, rates))


def watch_margins(carry: Carry, h: Scalar, dynamics: Evaluation, bit_count: int) -> Turns:
    """Return where margins turn back in an attempt; nowhere in the attempts of a search, before it lands."""
    margins, rates, numbers = _list_margins(dynamics, bit_count)
    running, landing = (carry.status == status for status in (RunStatus.RUNNING, RunStatus.LANDING))
    start = _outlook(carry)
    # A margin that is negative already is that of a share: its slide ends at once.
    lands = landing & (numbers == carry.search.number) & (start.margins >= 0)
    turns = find_turns(start, Outlook(margins, rates), h, lands)
    return Turns(jnp.where(running, turns.time_since, 0.0), (running | landing) & turns.grazes)


def margin_error(system: ObservedSystem, carry: PyTree, h: Scalar, dynamics: Evaluation, state: HybridState) -> Scalar:
    """Return the error of the margins' cubics in the middle of an attempt, as a multiple of the allowed one.

    A margin may depend on time alone, and then no error of a state shows its error. The result is 0 without margins,
    and unless the run is RUNNING. `dynamics` and `state` are those at the end of the attempt.
    """
    margins, rates, _ = _list_margins(dynamics, 0)
    if margins.size == 1:  # that of a stop which is never reached
        return jnp.zeros_like(h)
    point = carry.point
    step = HermiteStep(point.t, point.t + h, (point.state.flow(), state.flow()), (point.rates[0], dynamics.rates[0]))
    middle = point.t + 0.5 * h
    mode = mode_in_step(point.words, carry.unrestricted)
    middle_margins = system.list_margins(middle, point.state.with_flow(step.at(middle)), point.accumulators, mode)
    middle_margins = jnp.concatenate([jnp.ravel(x) for x in middle_margins])
    start = _outlook(carry)
    greatest = jnp.maximum(jnp.maximum(jnp.abs(start.margins), jnp.abs(margins)), jnp.abs(middle_margins))
    errors = jnp.abs(Cubic(start.margins, margins, h * start.rates, h * rates)(0.5) - middle_margins)
    errors = jnp.where(jnp.isfinite(errors) & (greatest > 0), errors / jnp.where(greatest > 0, greatest, 1.0), 0.0)
    # Along a surface the margins are those of the shares, which this evaluation does not have.
    judged = (carry.status == RunStatus.RUNNING) & ~mode._replace(along=along_of(carry)).slides
    return jnp.where(judged, jnp.max(errors) / MARGIN_TOLERANCE, 0.0)


def _outlook(carry: PyTree) -> Outlook:
    forecast = carry.point.forecast
    return forecast if isinstance(forecast, Outlook) else forecast[1]


def _list_margins(dynamics: Evaluation, bit_count: int) -> tuple[Array, Array, Array]:
    """Return margins, rates and numbers of the comparisons and then of the events, each of shape (n,)."""
    surfaces, events = dynamics.surfaces, jax.tree.leaves(dynamics.margins)
    assert surfaces.rates is not None
    margins = stack_flat([surfaces.values, *events])
    rates = stack_flat([surfaces.rates, *jax.tree.leaves(dynamics.margin_rates)])
    return margins, rates, stack_flat([surfaces.numbers, bit_count + np.arange(len(events))])
