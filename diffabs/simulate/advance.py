"""What happens in one step of a run, whatever chose its length: the only place where that is said.

integrate to t + h;  the plant's projection;  the objectives' update over the step;  at t + h the blocks' events and
ticks;  the rates from there, with which the next step begins"""

from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

import jax

from diffabs.core.loop import Loop, LoopState, Margins, Signals
from diffabs.core.protocols import Clock, Memory, Objective, Sample, Segment
from diffabs.simulate.rk4 import rk4_step_from

Objectives = dict[str, Objective]


class Point(NamedTuple):
    """A run at an instant, after what changes there: the loop's state and the objectives' accumulators, what is seen,
    the rates of both (of what is integrated), and the margins of the stop and of the blocks' events."""

    t: Any
    state: LoopState
    tally: dict[str, Memory]
    sample: Sample
    rate: tuple[Any, Any]
    margins: Margins


class Arrival(NamedTuple):
    """The end of a step, before what changes there: time, state, accumulators, signals, rate of the state, margins."""

    t: Any
    state: LoopState
    tally: dict[str, Memory]
    signals: Signals
    rate: Any
    margins: Margins


def begin(loop: Loop, objectives: Objectives, clock: Clock) -> Point:
    """Return the point at t = 0, after the first ticks; a block whose margin is negative has its event."""
    state = loop.start()
    signals = loop.signals(clock.t, state)
    tally = {name: objective.start(signals.sample) for name, objective in objectives.items()}
    margins = loop.margins(clock.t, state, signals, lambda: loop.flow(clock.t, state, signals))
    here = Arrival(clock.t, state, tally, signals, None, margins)
    return depart(loop, objectives, clock, here, jax.tree.map(lambda margin: margin < 0, margins))


def arrive(loop: Loop, objectives: Objectives, point: Point, h: Any, end: Any, step: Any) -> Arrival:
    """Return what a step of length h [s] from this point leads to, at the time `end`, by one Runge-Kutta step. The
    grid has the `step`."""
    z = (point.state.flow(), {name: memory.flow for name, memory in point.tally.items()})
    held = {name: memory.held for name, memory in point.tally.items()}

    def flow(t: Any, z: Any) -> Any:
        state = point.state.with_flow(z[0])
        signals = loop.signals(t, state)
        return loop.flow(t, state, signals), _tally_rates(objectives, z[1], held, signals.sample)

    z, last = rk4_step_from(flow, point.t, z, point.rate, h)
    state = point.state.with_flow(z[0])
    state = state._replace(plant=loop.plant.project(state.plant))
    signals = loop.signals(end, state)
    exact = cache(lambda: loop.flow(end, state, signals))
    rate = last[0] if loop.changes else exact()  # which is needed anyway where nothing changes: see `depart`
    margins = loop.margins(end, state, signals, exact)
    segment = _segment(loop, point, state, signals.sample, rate, h, step)
    tally = {
        name: Memory(z[1][name], o.update(Memory(z[1][name], held[name]), segment)) for name, o in objectives.items()
    }
    return Arrival(end, state, tally, signals, rate, margins)


def depart(loop: Loop, objectives: Objectives, clock: Clock, here: Arrival, fired: Margins) -> Point:
    """Return the point from which a run goes on, after the events that have `fired` and the ticks of the clock."""
    _, state, tally, signals, rate, margins = here
    if loop.changes or rate is None:
        state = loop.change(clock, state, signals, margins, fired)
        signals = loop.signals(clock.t, state)
        rate = loop.flow(clock.t, state, signals)
        margins = loop.margins(clock.t, state, signals, lambda: rate)
    flow, held = ({name: getattr(memory, part) for name, memory in tally.items()} for part in ("flow", "held"))
    rates = _tally_rates(objectives, flow, held, signals.sample)
    return Point(clock.t, state, tally, signals.sample, (rate, rates), margins)


def _segment(loop: Loop, point: Point, state: LoopState, sample: Sample, rate: Any, h: Any, step: Any) -> Segment:
    ends = ((point.sample.t, point.state, point.rate[0]), (sample.t, state, rate))

    def each(of: Callable[[Any, LoopState, Any], Any]) -> Any:
        return cache(lambda: tuple(of(*end) for end in ends))

    def output(t: Any, state: LoopState, rate: Any) -> Any:
        del t
        return jax.jvp(loop.plant.output, (state.plant,), (rate[0],))[1]

    def seen(t: Any, state: LoopState, rate: Any) -> Sample:
        return loop.signal_rates(t, state, rate).sample

    return Segment(point.sample, sample, h, step, each(output), each(seen))


def _tally_rates(objectives: Objectives, flow: dict[str, Any], held: dict[str, Any], sample: Sample) -> dict[str, Any]:
    """d/dt of the objectives' integrals."""
    return {name: o.flow(Memory(flow[name], held[name]), sample) for name, o in objectives.items()}
