"""The step of a run: `advance` makes one attempt. The carry of a run, and the interface of stepping methods.

    propose    which step to attempt, in which mode
    attempt    `attempt.attempt_step`: the same for every method
    report     what the method finds in it
    decide     accept the step, search within it, or end the run
    commit     `attempt.commit_step`: the same for every method
    conclude   the status after it, and the search for an event
    plan_next  the length and status of the next attempt

`FixedStepping`, `AdaptiveStepping` and `ReplayStepping` differ in these and in the coefficients of their step.
"""

from collections.abc import Callable
from functools import partial, reduce
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
from jax.typing import DTypeLike

from diffabs.core.lanes import jit_barrier, keep_decision, select
from diffabs.core.log import borrow, log_rows, write_last_rows
from diffabs.core.protocols import Clock
from diffabs.core.types import Array, Bool, Int, Key, PyTree, Scalar
from diffabs.engine.hybrid import HybridState, HybridSystem, Margins
from diffabs.engine.step.attempt import (
    Attempt,
    Point,
    StepRequest,
    attempt_step,
    commit_step,
    evaluate_point,
    start_state,
)
from diffabs.engine.step.event_location import (
    EventSearch,
    RunStatus,
    init_search,
    is_running,
)
from diffabs.engine.step.modes import Mode
from diffabs.engine.step.runge_kutta import Tableau
from diffabs.engine.step.slides import (
    Landing,
    SlideWatch,
    along_of,
    begins_along,
    lose_mode,
    watch_landing,
)
from diffabs.engine.step.system import UNCONSTRAINED, Evaluation, Objectives, ObservedSystem, build_system


class Carry(NamedTuple):
    """State of a run between two attempts.

    Attributes:
        point: Point of the run that the last accepted attempt reached.
        k: Number of the last instant of the grid at which a clock struck. With fixed steps one strikes at each instant.
        since: Time since that instant [s]. It is summed, because the difference of two large times would lose digits.
        length: Length of the next attempt [s].
        strikes: True if the next attempt ends where a clock strikes next, or with the run.
        base: Length of the regular attempt [s], the scale of a search within it. Adaptive steps begin it at this point;
            with fixed steps it is the step of the grid.
        search: Search for an event.
        unrestricted: True if each stage evaluates its comparisons, in a run whose steps otherwise keep to a mode.
        slides: Watch for slides (`SlideWatch`); () if switching surfaces are not located.
        control: Numbers of the stepping method.
        status: Status of the run, a `RunStatus`.
    """

    point: Point
    k: Int
    since: Scalar
    length: Scalar
    strikes: Bool
    base: Array
    search: EventSearch
    unrestricted: Bool
    slides: PyTree
    control: PyTree
    status: Array

    @property
    def running(self) -> Array:
        """True if the run needs another attempt."""
        return is_running(self)


class Decision(NamedTuple):
    """Decision on an attempt.

    Attributes:
        valid: True if its numbers are finite and plausible.
        accepted: True if the attempt is accepted.
        searches: True if the search for an event or a switching surface begins or goes on.
        crosses_surface: True if an accepted attempt ends on a switching surface.
        triggered: True for each event at its end.
        mode: Mode after the changes at its end.
        over: True if the run ends there.
    """

    valid: Bool
    accepted: Bool
    searches: Bool
    crosses_surface: Bool
    triggered: Margins
    mode: Mode
    over: Bool


class Judged(NamedTuple):
    """An attempt from a run in a system, with the decision on it."""

    system: ObservedSystem
    carry: Carry
    attempt: Attempt
    decision: Decision


class Stepping(Protocol):
    """A stepping method: what `advance` needs of it."""

    @property
    def h(self) -> Array:
        """Step of the grid [s]."""
        ...

    @property
    def tableau(self) -> Tableau:
        """Coefficients of its Runge-Kutta step."""
        ...

    @property
    def has_margin_rates(self) -> bool:
        """True if the rates of all margins are evaluated."""
        ...

    @property
    def switches(self) -> Any:
        """What it does about switches, a rule of `switching`."""
        ...

    @property
    def shows_comparisons(self) -> bool:
        """True if the comparisons of the flow are visible."""
        ...

    @property
    def second_order(self) -> bool:
        """True if the times of events have second derivatives."""
        ...

    def is_active(self, carry: Carry, until: Int | None) -> Bool:
        """Return True if the run of `carry` goes on and has not reached the instant `until` of the grid."""
        ...

    def is_calm(self, carry: Carry) -> Bool:
        """Return True if the attempt of `carry` is so long that earlier landings are over."""
        ...

    def propose(self, system: ObservedSystem, carry: Carry) -> StepRequest:
        """Return the next step to attempt, by the run of `carry` in `system`."""
        ...

    def forecast(self, carry: Carry, dynamics: Evaluation) -> PyTree:
        """Return what the method foresees from the `dynamics` at an instant, for its own later functions.

        `carry` is the run before the step that ends at the instant.
        """
        ...

    def report(
        self, system: ObservedSystem, carry: Carry, h: Scalar, dynamics: Evaluation, state: HybridState, error: object
    ) -> Any:
        """Return the findings about an attempt, by the run of `carry` in `system`, that the method needs.

        The attempt has the length `h`. The `dynamics` and the `state` are those at its end, and `error` holds the
        shares of the rates in the error.
        """
        ...

    def decide(
        self, system: ObservedSystem, carry: Carry, request: StepRequest, attempt: Attempt, active: Bool
    ) -> Decision:
        """Return the decision on the `attempt` that answers the `request`, by the run of `carry` in `system`.

        `active` is False if the run needs no attempt.
        """
        ...

    def plan_next(
        self, system: ObservedSystem, carry: Carry, attempt: Attempt, decision: Decision, after: Carry
    ) -> Carry:
        """Return the carry `after` an `attempt` with length and status of the next attempt.

        `carry` is the run in `system` before the attempt, and `decision` the decision on it. `after` has the new
        point and what `SwitchRule.conclude` has set: with switches the status, the search and its length.
        """
        ...


def advance(
    stepping: Stepping,
    hybrid: HybridSystem,
    objectives: Objectives,
    key: Key | None,
    carry: Carry,
    until: Int | None = None,
) -> Carry:
    """Return the carry after one attempt of a step.

    Point and status of a run that is over do not change. With `until`, the number of the grid instant at which to
    pause, the whole carry does not change if the run is over or has reached that instant.
    """
    active = stepping.is_active(carry, until)
    # The blocks' logs leave the carry: `select` below would otherwise copy whole tables in every step.
    logs = write_last_rows(carry.point.state)
    start = carry.point._replace(state=borrow(carry.point.state, None))
    carry = carry._replace(point=start)
    system = build_system(
        *(hybrid, objectives, start.t, start.state, start.accumulators),
        switched=stepping.shows_comparisons,
        has_margin_rates=stepping.has_margin_rates,
    )
    request, forecast = stepping.propose(system, carry), partial(stepping.forecast, carry)

    def attempt_request() -> Attempt:
        report = partial(stepping.report, system, carry, request.h)
        return attempt_step(system, start, request, stepping.tableau, forecast, report)

    # Without the barriers, XLA would compile the attempt again into each expression that uses it. A step in which
    # nothing is searched has few such expressions. For derivatives the barrier also skips attempts beyond the end,
    # where reverse mode would multiply 0 by a rate that may be infinite.
    barrier = jit_barrier if stepping.second_order or stepping.switches.isolates else lambda active, work: work()
    attempt = barrier(active, attempt_request)
    decision = keep_decision(barrier(active, lambda: stepping.decide(system, carry, request, attempt, active)))

    slides = carry.slides
    if slides:
        slides = _watch_slides(stepping, hybrid, carry, attempt, decision, request)
        mode = decision.mode
        if slides.followed:  # a slide begins in the mode of the step: either side's mode serves
            words = select(begins_along(carry.slides, slides), attempt.point.words, mode.words)
            mode = mode._replace(words=words, along=slides.followed.along)
        decision = decision._replace(mode=mode)
    strikes = decision.accepted & request.strikes
    k = jnp.where(strikes, request.strike, carry.k)
    clock = Clock(attempt.point.t, stepping.h, k, key, strikes)

    def commit() -> Point:
        return commit_step(system, start, attempt, clock, decision.triggered, decision.mode, logs, forecast)

    # Where a run ends, no block changes any more.
    point = select(decision.over, attempt.point, jit_barrier(active, commit) if hybrid.changes else commit())
    point = select(decision.accepted, point, start)
    since = jnp.where(strikes, 0.0, jnp.where(decision.accepted, carry.since + request.h, carry.since))
    after = carry._replace(point=point, k=k, since=since, slides=slides)
    judged = Judged(system, carry, attempt, decision)
    after = stepping.switches.conclude(judged, after, refines=stepping.second_order)
    after = stepping.plan_next(system, carry, attempt, decision, after)
    if along_of(after):
        gives_up = jnp.logical_and(decision.valid, ~carry.unrestricted)
        unrestricted, number = active & after.unrestricted, after.search.number
        after = after._replace(slides=lose_mode(after.slides, unrestricted, gives_up, number, attempt.point.t))
    status = jnp.where(active, after.status, carry.status).astype(carry.status.dtype)
    status, unrestricted = keep_decision((status, after.unrestricted))
    after = after._replace(status=status, unrestricted=unrestricted)
    if until is not None:  # without a pause, the other fields of a run that is over have no effect
        after = select(active, after, carry)
    return after._replace(point=after.point._replace(state=borrow(after.point.state, logs)))


def _watch_slides(
    stepping: Stepping, hybrid: HybridSystem, carry: Carry, attempt: Attempt, decision: Decision, request: StepRequest
) -> SlideWatch:
    """Return the watch for slides after an attempt."""
    regular = carry.status == RunStatus.RUNNING
    calm = decision.accepted & stepping.is_calm(carry) & (regular | decision.crosses_surface)
    reset = reduce(jnp.logical_or, jax.tree.leaves(decision.triggered))
    if hybrid.ticks:  # a block may have changed; fixed steps strike at every instant of the grid
        ticks = hybrid.next_tick(carry.k, request.grid) <= request.strike
        reset |= decision.accepted & request.strikes & ticks
    landed, words, t = decision.crosses_surface, carry.point.words, attempt.point.t
    return watch_landing(carry.slides, Landing(carry.search, words, landed, calm, reset, t))


def start_carry(
    stepping: Stepping,
    hybrid: HybridSystem,
    objectives: Objectives,
    key: Key | None,
    forecast: Callable[[Evaluation], PyTree] = lambda dynamics: (),
) -> Carry:
    """Return the carry of a run at t = 0, without the numbers of the stepping method.

    A run that starts at its stop or beyond is over: MISSED.
    """
    none, zero = 0.0 * stepping.h, jnp.asarray(0)
    # With the types of later steps the loop is traced once for all of them.
    state, accumulators = cast_floats(start_state(hybrid, objectives, Clock(none, stepping.h, zero, key)), none.dtype)
    logs, state = log_rows(state), borrow(state, None)
    system = build_system(
        *(hybrid, objectives, none, state, accumulators),
        switched=stepping.shows_comparisons,
        has_margin_rates=stepping.has_margin_rates,
    )
    point = evaluate_point(system, none, state, accumulators, UNCONSTRAINED, forecast)
    status = jnp.where(point.margins["stop"][0] > 0, zero + RunStatus.RUNNING, zero + RunStatus.MISSED)
    point = point._replace(state=borrow(state, logs))
    search, yes, no = init_search(stepping.h), jnp.asarray(True), jnp.asarray(False)
    slides = stepping.switches.start_watch(system, none)
    return Carry(point, zero, none, stepping.h, yes, stepping.h, search, no, slides, (), status)


def cast_floats(tree: object, dtype: DTypeLike) -> PyTree:
    """Return the tree with strong types throughout, and its floating-point leaves cast to one type."""

    # A scan rejects a carry whose type weakens or strengthens.
    def cast(x: Scalar) -> Array:
        x = jnp.asarray(x)
        return x.astype(dtype) if jnp.issubdtype(x.dtype, jnp.floating) else x.astype(x.dtype)

    return jax.tree.map(cast, tree)
