"""One step of a run: `attempt_step` integrates, `commit_step` changes the blocks at the end.

    attempt_step   integrates over the step within one mode, lets the plant project its state, evaluates the dynamics at
                   the end, and updates the objectives over the step
    commit_step    lets the events and ticks of the blocks happen at the end of an accepted step

After t = 0 nothing else integrates, projects or accumulates, and nothing else changes what a state holds. What chooses
the steps is a `Stepping` (`advance`).
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from diffabs.core.cubic import HermiteStep
from diffabs.core.lanes import any_lane, select
from diffabs.core.log import borrow
from diffabs.core.numerics import axpy
from diffabs.core.protocols import Clock, Memory, Segment
from diffabs.core.types import Any, Array, Bool, Int, PyTree, Scalar
from diffabs.engine.hybrid import HybridSignals, HybridState, HybridSystem, Margins, Objectives
from diffabs.engine.step.modes import Mode, ModeBits, valid_end_rates
from diffabs.engine.step.runge_kutta import Tableau, runge_kutta_scan, runge_kutta_step
from diffabs.engine.step.system import (
    Accumulators,
    Evaluation,
    ObservedSystem,
    split_flow_and_held,
    with_flow,
)


class Point(NamedTuple):
    """A run at an instant.

    Attributes:
        t: Time [s].
        state: State of the system.
        accumulators: Accumulators of the objectives.
        sample: Sample of the signals.
        signal_rates: Rates of the signals, as `ObservedSystem.signal_rates` says.
        recorded: Recorded signals, and their rates, each by name.
        rates: Rates of the loop's flow and of the objectives' integrals.
        margins: Margins of the stop and of the blocks' events.
        words: Answers to the comparisons: the mode of the next step.
        forecast: Prediction of the stepping method from here (`Stepping.forecast`).
    """

    t: Array
    state: HybridState
    accumulators: Accumulators
    sample: PyTree
    signal_rates: PyTree
    recorded: tuple[dict[str, PyTree], dict[str, PyTree]]
    rates: tuple[PyTree, PyTree]
    margins: Margins
    words: ModeBits
    forecast: PyTree


class StepRequest(NamedTuple):
    """A step to attempt.

    Attributes:
        h: Length [s].
        end: Time at the end [s].
        grid: Step of the grid [s].
        mode: Mode of the step.
        refresh: True for a step of length 0 that evaluates the rates after an event or a switching surface.
        strikes: True if the step ends where a clock strikes, or with the run.
        strike: Number of that instant of the grid.
        shift_end: Function that returns the time [s] to add to the step, from the dynamics at its requested end; None
            for none. For an event the time is zero to rounding, for a comparison minus the time beyond the surface. It
            has the derivative of the event's time.
    """

    h: Scalar
    end: Scalar
    grid: Scalar
    mode: Mode
    refresh: Bool
    strikes: Bool
    strike: Int
    shift_end: Callable[[Evaluation], Scalar] | None = None


class Attempt(NamedTuple):
    """The end of an attempted step.

    Attributes:
        point: The end, before the changes there.
        signals: Signals of the system.
        shift: Time [s] by which the end lies later than requested.
        shares: Shares of the other answer along each surface; () if the run cannot slide (`slides`).
        report: What the stepping method needs for its decision.
    """

    point: Point
    signals: HybridSignals
    shift: Scalar
    shares: tuple[Scalar, ...]
    report: PyTree


Forecast = Callable[[Evaluation], PyTree]  # `Stepping.forecast`, for a run


def start_state(hybrid: HybridSystem, objectives: Objectives, clock: Clock) -> tuple[HybridState, Accumulators]:
    """Return state and accumulators at t = 0, after the first ticks and the events of blocks with a negative margin."""
    state = hybrid.start()
    signals = hybrid.signals(clock.t, state)
    accumulators = {name: objective.start(signals.sample) for name, objective in objectives.items()}
    if hybrid.changes:
        margins = hybrid.margins(clock.t, state, signals, lambda: hybrid.flow(clock.t, state, signals))
        state = hybrid.change(clock, state, signals, margins, jax.tree.map(lambda margin: margin < 0, margins))
    return state, accumulators


def evaluate_point(
    system: ObservedSystem, t: Array, state: HybridState, accumulators: Accumulators, mode: Mode, forecast: Forecast
) -> Point:
    """Return the point at an instant, from the state after the changes there."""
    return _build_point(system.evaluate(t, state, accumulators, mode), t, state, accumulators, forecast)


def attempt_step(
    system: ObservedSystem,
    point: Point,
    request: StepRequest,
    tableau: Tableau,
    forecast: Forecast,
    report: Callable[[Evaluation, HybridState, PyTree], PyTree],
) -> Attempt:
    """Return the end of one Runge-Kutta step from a point.

    `report` returns what the stepping method needs for its decision, from the dynamics at the end, the state there, and
    the shares of the rates in the error.
    """
    hybrid, (t, h), mode = system.hybrid, (request.end, request.h), request.mode
    z, held = split_flow_and_held(point.state, point.accumulators)

    def flow(t: Scalar, z: object, constants: tuple[PyTree, Mode]) -> PyTree:
        return system.rates(t, z, *constants)

    def integrate() -> tuple[PyTree, PyTree]:
        return runge_kutta_step(tableau, flow, point.t, z, point.rates, h, (held, mode))

    def integrate_slide() -> tuple[PyTree, PyTree]:
        rates = lambda t, z: system.sliding_rates(t, z, held, mode)  # noqa: E731
        end, error = runge_kutta_scan(tableau, rates, point.t, z, point.rates, h)
        return system.return_to_surfaces(t, end, held, mode), error

    z, error = jax.lax.cond(any_lane(mode.slides), integrate_slide, integrate) if mode.along else integrate()
    shift = jnp.zeros_like(h)
    if request.shift_end:
        dynamics = system.evaluate(t, *with_flow(point.state, point.accumulators, z), mode)
        shift = request.shift_end(dynamics)
        t, h, z = t + shift, h + shift, axpy(shift, dynamics.rates, z)
    state, accumulators = with_flow(point.state, point.accumulators, z)
    projected = hybrid.project(state)
    # A projection may move the state onto a switching surface, so the end of a frozen mode is evaluated without it.
    frozen = mode.words is not None and system.program is not None
    state = select(mode.free, projected, state) if frozen else projected
    dynamics = system.evaluate(t, state, accumulators, mode)

    smooth, within = system.program is not None, (True, True)
    if frozen:
        smooth, within = ~mode.free, (True, ~mode.free)
    elif system.has_margin_rates:
        changed = tuple(a ^ b for a, b in zip(dynamics.words, point.words, strict=True))
        within = valid_end_rates(dynamics.surfaces, changed, h)
    rates = (point.signal_rates, dynamics.signal_rates)
    segment = Segment(
        *(point.sample, dynamics.signals.sample, h, request.grid),
        shown_rates=lambda: (rates[0].show(), rates[1].show()),
        sample_rates=lambda: rates,
        smooth=smooth,
        within=within,
    )
    updated = {name: Memory(z[1][name], o.update(accumulators[name], segment)) for name, o in system.objectives.items()}
    if not hybrid.ticks and (hybrid.eventful or frozen):
        # A step of length 0 must not count twice in the objectives.
        updated = select(request.refresh, point.accumulators, updated)
    end = _build_point(dynamics, t, projected, updated, forecast)
    return Attempt(end, dynamics.signals, shift, dynamics.shares, report(dynamics, state, error))


def commit_step(
    system: ObservedSystem,
    point: Point,
    attempt: Attempt,
    clock: Clock,
    triggered: Margins,
    mode: Mode,
    logs: list[PyTree],
    forecast: Forecast,
) -> Point:
    """Return the point at which the run continues, after the events and the ticks at the end of a step.

    In a loop without ticks a later step of length 0 (`StepRequest.refresh`) evaluates the rates after an event. Events
    are rare, so this is cheaper than an evaluation after every step. `logs` are the rows that `advance` has taken out
    of the state (`core.log`).
    """
    hybrid, end = system.hybrid, attempt.point
    state = end.state
    if hybrid.changes:
        (values, rates), (last, last_rates) = point.recorded, end.recorded
        passed = {
            name: HermiteStep(point.t, end.t, (values[name], last[name]), (rates[name], last_rates[name]))
            for name in values
        }
        lent = borrow(state, logs)
        state = borrow(hybrid.change(clock, lent, attempt.signals, end.margins, triggered, passed), None)
    if hybrid.ticks:
        return evaluate_point(system, end.t, state, end.accumulators, mode, forecast)
    return end._replace(state=state, words=end.words if mode.words is None else mode.words)


def _build_point(
    dynamics: Evaluation, t: Any, state: HybridState, accumulators: Accumulators, forecast: Forecast
) -> Point:
    signals = dynamics.signals
    return Point(
        *(t, state, accumulators, signals.sample, dynamics.signal_rates, (signals.recorded, dynamics.recorded_rates)),
        *(dynamics.rates, dynamics.margins, dynamics.words, forecast(dynamics)),
    )
