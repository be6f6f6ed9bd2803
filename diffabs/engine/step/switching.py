"""What a stepping method does about switches: comparisons of the flow, and margins of events.

    Unswitched     there are none: each attempt is a step
    FreeModes      events are located, and each stage evaluates its comparisons
    KeptModes      switching surfaces are located, too, and a step keeps to its mode
    WatchedModes   turns of all margins are looked for, too; a run that slides or grazes is over

Each is a subclass of the one before and replaces a part of it. `Replayed` is the rule of a log, which has all
decisions.
"""

import dataclasses
from functools import reduce
from typing import ClassVar, NamedTuple

import jax
import jax.numpy as jnp

from diffabs.core.lanes import any_lane, keep_decision, select
from diffabs.core.types import Any, Array, Bool, Int, PyTree, Scalar
from diffabs.engine.hybrid import HybridState
from diffabs.engine.step.advance import Carry, Decision, Judged
from diffabs.engine.step.attempt import Attempt, StepRequest
from diffabs.engine.step.event_location import (
    MAX_LOCATION_ATTEMPTS,
    RunStatus,
    SearchPlan,
    continue_search,
    falls_through,
    find_crossings,
    status_after_step,
)
from diffabs.engine.step.modes import (
    ComparisonAnswers,
    Mode,
    ModeBits,
    SlidingSurface,
    SurfaceCrossing,
    find_contradicted,
    find_imminent,
    find_return,
    flip_answers,
    forecast_crossing,
    is_surface_moving,
    mode_after_changes,
    mode_in_step,
    single_bit,
    time_since_crossing,
)
from diffabs.engine.step.outlook import Outlook, Turns, look_ahead, margin_error, watch_margins
from diffabs.engine.step.slides import (
    MAX_SURFACES,
    SlideWatch,
    along_of,
    decided_answers,
    has_slid,
    init_watch,
    slide_of,
)
from diffabs.engine.step.system import UNCONSTRAINED, Evaluation, ObservedSystem

# A return with a smaller error, as a multiple of the allowed one, is rounding.
MIN_RETURN_ERROR = 1e-3
# A step that keeps its mode goes 1.5 times as far as the predicted crossing, so that the crossing lies within the step.
CROSSING_OVERREACH = 1.5


class Horizon(NamedTuple):
    """An instant from which a run looks ahead.

    Attributes:
        natural: Length that the error allows [s].
        shortest: Length of a step within which nothing is located [s].
        unrestricted: True if the next step has no mode.
        fresh: True if the numbers there have just chosen the mode of the next step.
        ended: Surface along which a slide ends there.
        along: Surfaces along which the next step slides.
    """

    natural: Scalar
    shortest: Scalar
    unrestricted: Bool
    fresh: Bool
    ended: SlidingSurface
    along: tuple[SlidingSurface, ...]


class Trial(NamedTuple):
    """An attempt to look into.

    Attributes:
        h: Length [s].
        dynamics: Dynamics at its end.
        state: State there.
        changed: Answers that differ from those at its beginning.
        error: Error of the states and signals as a multiple of the allowed error.
        resolved: True if it is long enough to locate something within it.
    """

    h: Scalar
    dynamics: Evaluation
    state: HybridState
    changed: ModeBits
    error: Scalar
    resolved: Bool


class Checks(NamedTuple):
    """What a method says of an attempt, before the decision on it.

    Attributes:
        active: False if the run needs no attempt.
        valid: True if its numbers are finite and plausible.
        exact: True if it is accurate enough, too, or cannot be made shorter.
        last: True if the run ends with it.
    """

    active: Bool
    valid: Bool
    exact: Bool
    last: Bool


class Strain(NamedTuple):
    """What a method says of steps with a mode, after an attempt.

    Attributes:
        crowded: True if searches for switching surfaces take too many attempts.
        leaves: True if the next steps should have no mode, for another reason.
        calm: True for a regular step.
        stuck: True if no step is short enough for its mode: one without a mode is attempted.
    """

    crowded: Bool
    leaves: Bool
    calm: Bool
    stuck: Bool


class Findings(NamedTuple):
    """What happens to comparisons and margins within an attempt.

    Attributes:
        error: Error as a multiple of the allowed error.
        past_crossing: Time from the first change of a comparison inside the step, or the first turn of a margin beyond
            zero, to the end of the step [s]; 0 without one.
        grazes: True if a margin only touches zero, or crosses it twice in a step that is too short to be cut.
        returns: Number of a comparison that has changed and moves back at the end; -1 without one, or within a mode.
        surface: Contradicted comparisons; None if steps keep to no mode.
    """

    error: Scalar
    past_crossing: Scalar
    grazes: Any
    returns: Array
    surface: SurfaceCrossing | None


class ModeGuard(NamedTuple):
    """What becomes of the mode of the next steps.

    Attributes:
        fails: True if a search for a switching surface is given up.
        unrestricted: True if the next step has no mode.
        abandons: True if the next attempt is a regular one, in place of the attempt that had a mode.
        slides: True if the run is over as SLID: it slides, or no surface can be located.
    """

    fails: Bool
    unrestricted: Bool
    abandons: Bool
    slides: Bool


class NextAttempt(NamedTuple):
    """A plan of the next attempt.

    Attributes:
        searches: True if it is one of a search.
        length: Its length [s] if it is not.
        status: Status of the run, a `RunStatus`.
    """

    searches: Bool
    length: Scalar
    status: Scalar


@dataclasses.dataclass(frozen=True)
class SwitchRule:
    """What a stepping method does about switches.

    Attributes:
        isolates: True if the parts of a step are programs of their own: many expressions use their results.
        keeps_mode: True if a step keeps to a mode.
        watches: True if a run that slides or grazes is over.
        follows: True if a run follows the surfaces along which it slides.
    """

    isolates: ClassVar[bool] = True
    keeps_mode: ClassVar[bool] = False
    watches: ClassVar[bool] = False
    follows: bool = False

    def start_watch(self, system: ObservedSystem, t: Scalar) -> SlideWatch | tuple[()]:
        """Return the watch for slides of a run that starts at `t` [s]; () for none."""
        del system, t
        return ()

    def conclude(self, judged: Judged, after: Carry, *, refines: bool) -> Carry:
        """Return the carry `after` an attempt with its next status and, if events are located, the next search.

        A search `refines` for second derivatives of an event's time.
        """
        del judged, refines
        return after


@dataclasses.dataclass(frozen=True)
class Replayed(SwitchRule):
    """A log says where steps end, and in which modes."""


@dataclasses.dataclass(frozen=True)
class Unswitched(SwitchRule):
    """Nothing switches, and no event can happen."""

    isolates: ClassVar[bool] = False

    def propose(self, system: ObservedSystem, carry: Carry, grid: Array, strike: Int) -> StepRequest:
        """Return the step to attempt next; `strike` is the number of the next instant of a clock, or of the end."""
        del system
        return _propose(carry, grid, strike, UNCONSTRAINED, jnp.asarray(False))

    def decide(self, system: ObservedSystem, carry: Carry, attempt: Attempt, checks: Checks) -> Decision:
        """Return the decision on an attempt: accept it, search within it, or end the run."""
        del system, carry
        active, valid, exact, last = checks
        no, accepted = jnp.asarray(False), active & valid & exact
        none = jax.tree.map(lambda margin: no, attempt.point.margins)
        return Decision(valid, accepted, no, no, none, UNCONSTRAINED, accepted & last)

    def conclude(self, judged: Judged, after: Carry, *, refines: bool) -> Carry:
        del refines
        return after._replace(status=_next_status(judged, judged.carry.status))

    def forecast(self, horizon: Horizon, dynamics: Evaluation) -> PyTree:
        """Return the predicted time [s] to the first change of an answer, an `Outlook`, and what else a rule needs."""
        del horizon, dynamics
        return ()

    def time_ahead(self, forecast: PyTree, like: Array) -> Scalar:
        """Return the predicted time [s] to the first change of an answer, in the type of `like`."""
        del forecast
        return jnp.full_like(like, jnp.inf)

    def find(self, system: ObservedSystem, carry: Carry, trial: Trial) -> Findings:
        """Return what happens to comparisons and margins within an attempt."""
        del system, carry
        return Findings(trial.error, jnp.zeros_like(trial.h), jnp.asarray(False), jnp.asarray(-1), None)

    def find_surface(self, carry: Carry, h: Scalar, dynamics: Evaluation) -> SurfaceCrossing | None:
        """Return the comparisons that contradict the mode of an attempt; None if it has none."""
        del carry, h, dynamics
        return None

    def resume(self, plan: NextAttempt, regular: Scalar, carry: Carry, guard: ModeGuard) -> NextAttempt:
        """Return the next attempt as planned or, after a mode has ended, one of the `regular` length [s]."""
        del regular, carry, guard
        return plan

    def judge(self, status: Scalar, slides: Bool, grazes: Bool, after: Carry) -> Scalar:
        """Return the `status`, or that of a run which is over because it slides or grazes."""
        del slides, grazes, after
        return status


@dataclasses.dataclass(frozen=True)
class FreeModes(Unswitched):
    """Events are located, and each stage evaluates its comparisons."""

    isolates: ClassVar[bool] = True

    def start_watch(self, system: ObservedSystem, t: Scalar) -> SlideWatch | tuple[()]:
        if not system.bit_count:
            return ()
        surfaces = min(system.bit_count, MAX_SURFACES) if self.follows else 0
        return init_watch(system.word_count, surfaces, t)

    def propose(self, system: ObservedSystem, carry: Carry, grid: Array, strike: Int) -> StepRequest:
        refresh = carry.status == RunStatus.REFRESHING
        return _propose(carry, grid, strike, self._mode_of_step(system, carry, refresh), refresh)

    def decide(self, system: ObservedSystem, carry: Carry, attempt: Attempt, checks: Checks) -> Decision:
        active, valid, exact, last = checks
        running, landing, refreshing = (
            carry.status == status for status in (RunStatus.RUNNING, RunStatus.LANDING, RunStatus.REFRESHING)
        )
        number = carry.search.number
        crossed = falls_through(jax.tree.leaves(carry.point.margins), jax.tree.leaves(attempt.point.margins))
        crosses = jnp.any(jnp.stack([*crossed, *self._crossed_surfaces(attempt)]))
        accepted = active & valid & (landing | refreshing | (running & exact & ~crosses))
        searches = active & ~landing & ~refreshing & (~running | (exact & crosses))
        triggered = [accepted & landing & ((number == system.bit_count + i) | falls) for i, falls in enumerate(crossed)]
        triggered = jax.tree.unflatten(jax.tree.structure(attempt.point.margins), triggered)
        over = reduce(jnp.logical_or, triggered["stop"]) | (accepted & last)
        lands, mode = self._land(system, carry, attempt, accepted & landing)
        return Decision(valid, accepted, searches, lands, triggered, mode, over)

    def conclude(self, judged: Judged, after: Carry, *, refines: bool) -> Carry:
        system, carry, attempt, decision = judged
        plan = SearchPlan(carry.search, carry.length, carry.status)

        def next_plan() -> SearchPlan:
            margins = (jax.tree.leaves(point.margins) for point in (carry.point, attempt.point))
            crossings = find_crossings(carry.search.number, system.bit_count, attempt.report.surface, *margins)
            next_search = continue_search(plan, crossings, carry.base, system.bit_count, refines=refines)
            return select(decision.searches, next_search, plan)

        # Few attempts search, so a batch skips the search unless one of its runs needs it.
        search, length, status = jax.lax.cond(any_lane(decision.searches), next_plan, lambda: plan)
        number, located, at_once = keep_decision((search.number, search.located, search.at_once))
        search = search._replace(number=number, located=located, at_once=at_once)
        status = _next_status(judged, status)
        return after._replace(search=search, length=length, status=status)

    def forecast(self, horizon: Horizon, dynamics: Evaluation) -> PyTree:
        ahead = forecast_crossing(dynamics.surfaces, horizon.natural, horizon.shortest)
        return ahead, self.look_ahead(horizon, dynamics), find_imminent(dynamics.surfaces, horizon.natural)

    def time_ahead(self, forecast: PyTree, like: Array) -> Scalar:
        del like
        return forecast[0]

    def look_ahead(self, horizon: Horizon, dynamics: Evaluation) -> Outlook:
        """Return the margins whose turns are looked for."""
        return look_ahead(horizon.fresh, horizon.ended, horizon.along, self._select_watched(dynamics))

    def find_turns(self, system: ObservedSystem, carry: Carry, h: Scalar, dynamics: Evaluation) -> Turns:
        """Return where these margins turn back in an attempt."""
        return watch_margins(carry, h, self._select_watched(dynamics), system.bit_count)

    def find(self, system: ObservedSystem, carry: Carry, trial: Trial) -> Findings:
        h, dynamics, _, changed, error, resolved = trial
        turns = self.find_turns(system, carry, h, dynamics)
        past_crossing = jnp.maximum(time_since_crossing(dynamics.surfaces, changed, h), turns.time_since)
        grazes = turns.grazes | (~resolved & (turns.time_since > 0))
        grazes |= carry.unrestricted & is_surface_moving(dynamics.surfaces, changed)
        surface, returns = self.find_surface(carry, h, dynamics), jnp.asarray(-1)
        if surface is None:
            number = find_return(carry.point.forecast[2], dynamics.surfaces, changed, h)
            returns = jnp.where(error > MIN_RETURN_ERROR, number, -1)
        return Findings(error, jnp.where(resolved, past_crossing, 0.0), grazes, returns, surface)

    def judge(self, status: Scalar, slides: Bool, grazes: Bool, after: Carry) -> Scalar:
        del slides, grazes
        return jnp.where(has_slid(slide_of(after)), RunStatus.SLID, status)

    def _select_watched(self, dynamics: Evaluation) -> Evaluation:
        """Return the dynamics with those margins only whose turns are looked for: those of events."""
        return dynamics._replace(surfaces=dynamics.surfaces.take_none())

    def _mode_of_step(self, system: ObservedSystem, carry: Carry, refresh: Bool) -> Mode:
        del system, carry, refresh
        return UNCONSTRAINED

    def _crossed_surfaces(self, attempt: Attempt) -> list[Bool]:
        del attempt
        return []

    def _land(self, system: ObservedSystem, carry: Carry, attempt: Attempt, landing: Bool) -> tuple[Bool, Mode]:
        """Return whether a `landing` is one on a switching surface, and the mode after the changes there."""
        del system, carry, attempt, landing
        return jnp.asarray(False), UNCONSTRAINED


@dataclasses.dataclass(frozen=True)
class KeptModes(FreeModes):
    """Switching surfaces are located like events, and a step keeps to its mode."""

    keeps_mode: ClassVar[bool] = True

    def forecast(self, horizon: Horizon, dynamics: Evaluation) -> PyTree:
        ahead = forecast_crossing(dynamics.surfaces, horizon.natural, horizon.shortest)
        return jnp.where(horizon.unrestricted, 1.0, CROSSING_OVERREACH) * ahead, self.look_ahead(horizon, dynamics)

    def find_surface(self, carry: Carry, h: Scalar, dynamics: Evaluation) -> SurfaceCrossing | None:
        surfaces = dynamics.surfaces
        answers = ComparisonAnswers(dynamics.words, dynamics.contradicted, surfaces.numbers, surfaces.values)
        return find_contradicted(answers, carry.search.number, h)

    def guard(self, judged: Judged, after: Carry, strain: Strain) -> ModeGuard:
        """Return what becomes of the mode after an attempt.

        A search for a switching surface fails after too many attempts. Then, and under other `strain`, steps have no
        mode until no comparison changes in a calm one.
        """
        fails, leaves, abandons = self._leave_mode(judged, after, strain)
        pairs = zip(judged.attempt.point.words, judged.carry.point.words, strict=True)
        same = jnp.all(jnp.array([a == b for a, b in pairs], bool))
        return ModeGuard(fails, (judged.carry.unrestricted | leaves) & ~(strain.calm & same), abandons, False)

    def resume(self, plan: NextAttempt, regular: Scalar, carry: Carry, guard: ModeGuard) -> NextAttempt:
        del carry
        searches = jnp.logical_and(plan.searches, ~guard.abandons)
        length = jnp.where(guard.abandons, regular, plan.length)
        return NextAttempt(searches, length, jnp.where(guard.abandons, RunStatus.RUNNING, plan.status))

    def _leave_mode(self, judged: Judged, after: Carry, strain: Strain) -> tuple[Bool, Bool, Bool]:
        """Return whether a search fails, whether this or other strain ends a mode, and whether it ends an attempt."""
        system, carry, _, decision = judged
        tries = after.search.tries >= MAX_LOCATION_ATTEMPTS
        fails = (strain.crowded | tries) & decision.searches & (after.search.number < system.bit_count)
        leaves = fails | strain.leaves | strain.stuck
        return fails, leaves, jnp.logical_and(leaves, ~carry.unrestricted) & ~decision.accepted

    def _mode_of_step(self, system: ObservedSystem, carry: Carry, refresh: Bool) -> Mode:
        words, lands = carry.point.words, carry.search.number < system.bit_count
        beyond = mode_after_changes(words, decided_answers(carry, system.word_count), lands)
        mode = select(refresh, beyond, mode_in_step(words, carry.unrestricted))
        return mode._replace(along=along_of(carry))

    def _crossed_surfaces(self, attempt: Attempt) -> list[Bool]:
        surface = attempt.report.surface
        return [surface.contradicted, surface.unsought >= 0]

    def _land(self, system: ObservedSystem, carry: Carry, attempt: Attempt, landing: Bool) -> tuple[Bool, Mode]:
        number = carry.search.number
        lands = landing & (number < system.bit_count)
        # A slide ends with the answer of the side whose share has become 1.
        decided = flips = single_bit(number, system.word_count)
        for surface, share in zip(along_of(carry), attempt.shares, strict=True):
            ends, none = surface.number == number, tuple(jnp.zeros_like(word) for word in flips)
            flips = select(ends, select(share > 0.5, surface.answers, none), flips)
            decided = select(ends, surface.answers, decided)
        return lands, mode_after_changes(flip_answers(attempt.point.words, flips, lands), decided, lands)


@dataclasses.dataclass(frozen=True)
class WatchedModes(KeptModes):
    """Turns of all margins are looked for, and a run that slides or grazes is over."""

    watches: ClassVar[bool] = True

    def find(self, system: ObservedSystem, carry: Carry, trial: Trial) -> Findings:
        h, dynamics, state, _, error, resolved = trial
        error = jnp.maximum(error, jnp.where(resolved, margin_error(system, carry, h, dynamics, state), 0.0))
        return super().find(system, carry, trial._replace(error=error))

    def guard(self, judged: Judged, after: Carry, strain: Strain) -> ModeGuard:
        # Just before a surface that the run comes to with rate 0, each step may be too long for its mode: the square
        # root of a level. One step without a mode goes there. If the level stays, so does the run.
        fails, _, abandons = self._leave_mode(judged, after, strain)
        unrestricted = jnp.logical_and(strain.stuck, ~judged.carry.unrestricted)
        return ModeGuard(fails, unrestricted, abandons, fails | strain.leaves)

    def resume(self, plan: NextAttempt, regular: Scalar, carry: Carry, guard: ModeGuard) -> NextAttempt:
        # A step without a mode goes as far as the one that failed.
        plan = super().resume(plan, regular, carry, guard)
        return plan._replace(length=jnp.where(guard.unrestricted, carry.length, plan.length))

    def judge(self, status: Scalar, slides: Bool, grazes: Bool, after: Carry) -> Scalar:
        del after
        return jnp.where(slides, RunStatus.SLID, jnp.where(grazes, RunStatus.GRAZED, status))

    def _select_watched(self, dynamics: Evaluation) -> Evaluation:
        return dynamics


UNSWITCHED: Unswitched = Unswitched()
FREE_MODES: FreeModes = FreeModes()
KEPT_MODES: KeptModes = KeptModes()


def _propose(carry: Carry, grid: Array, strike: Int, mode: Mode, refresh: Bool) -> StepRequest:
    end = jnp.where(carry.strikes, strike * grid, carry.point.t + carry.length)
    return StepRequest(carry.length, end, grid, mode, refresh, carry.strikes, strike)


def _next_status(judged: Judged, status: Scalar) -> Scalar:
    """Return the status after an attempt; `status` where it was not accepted."""
    system, carry, attempt, decision = judged
    return jnp.where(decision.accepted, status_after_step(system.hybrid, carry, attempt, decision), status)
