"""Sets of settled states of a brake. From each set, every run enters a set at lower speeds or stops.

After its transient a run hardly depends on its start. A few sets contain the later states of nearly all runs. The
prover proves the runs from these sets once. The proof of a cell then ends when its set lies in one of them.

A piece of the tail is the set of all states with a speed v in [low, high] and, for every settled state i,

    | x_i - centre_i - by_speed_i (v - middle) - sum_j by_param_ij (p_j - middle_j) | <= width_i.

A settled state is one that the next tick or a rate reads, but not the speed. Here p are the parameters of the box. The
claim of a piece: every run from it, for all parameters, enters an earlier piece or stops. Until its stop, states and
signals stay in the ranges `later_states` and `later_signals`. These contain the ranges of every earlier piece. So a
piece needs a proof only up to the entry into an earlier one (induction from the slowest).
"""

import dataclasses
import math
from collections.abc import Iterable
from typing import NamedTuple

from diffabs.robust.reach.equations import Equations, RealOperation

Ends = tuple[float, float]


class TailPiece(NamedTuple):
    """One set of settled states.

    Attributes:
        low: Least speed [m/s].
        high: Greatest speed [m/s].
        centre: Each settled state at the middle speed and parameters.
        by_speed: Its change by the speed [per m/s].
        by_param: Its change by each parameter, shape (settled states, parameters).
        width: Half width of the set in each settled state.
        later_states: Range, from here to the stop, of each state that decides the deceleration, but the speed.
        later_signals: Range of each signal from here to the stop, by name.
        cells: Cells that prove the claim, shape (cells, parameters + 1, 2); the speed is the last side.
    """

    low: float
    high: float
    centre: tuple[float, ...]
    by_speed: tuple[float, ...]
    by_param: tuple[tuple[float, ...], ...]
    width: tuple[float, ...]
    later_states: dict[str, Ends]
    later_signals: dict[str, Ends]
    cells: tuple[tuple[Ends, ...], ...]

    @property
    def middle(self) -> float:
        """The middle speed [m/s]."""
        return 0.5 * (self.low + self.high)


class RunTail(NamedTuple):
    """The pieces of all runs of a box, up to the speed at which these have settled.

    Attributes:
        states: Names of the settled states, without the speed.
        middle: Middle of each parameter of the box.
        pieces: The slowest first. Every run from a piece enters an earlier piece or stops.
    """

    states: tuple[str, ...]
    middle: tuple[float, ...]
    pieces: tuple[TailPiece, ...]

    def without_signals(self, count: int, signals: Iterable[str]) -> "RunTail":
        """Return the first pieces without ranges of signals: the bounds of a run then end with its entry."""
        nothing = dict.fromkeys(signals, (math.inf, -math.inf))
        return self._replace(pieces=tuple(x._replace(later_signals=nothing) for x in self.pieces[:count]))


def stop_speed(e: Equations) -> float | None:
    """Return the speed at which the runs end [m/s], or None if the margin is not the speed minus a constant."""
    margin = e.operations[e.margin]
    if e.speed < 0 or margin.name != "sub" or e.operations[margin.args[0]] != RealOperation("state", (), e.speed):
        return None
    speed = e.operations[margin.args[1]]
    return float(speed.value) if speed.name == "const" else None


def equations_from(e: Equations, tail: RunTail, piece: TailPiece, shown: Iterable[str] = ()) -> Equations:
    """Return the equations of all runs that start in a piece; only `states` and `middle` of the tail are read.

    Further parameters are the speed and, for each settled state, its place in [-1, 1] across the piece. The other
    states start as in the loop. States in `shown` become signals of the same name.
    """
    operations = list(e.operations)

    def make(name: str, *args: int, value: float | int | None = None) -> int:
        operations.append(RealOperation(name, args, value))
        return len(operations) - 1

    def number(value: float) -> int:
        return make("const", value=float(value))

    speed = make("param", value=len(e.params))
    faster = make("sub", speed, number(piece.middle))
    beyond = [
        make("sub", make("param", value=j), number(middle)) if any(row[j] for row in piece.by_param) else -1
        for j, middle in enumerate(tail.middle)
    ]
    start = list(e.start)
    start[e.speed] = speed
    for i, name in enumerate(tail.states):
        total = make("add", number(piece.centre[i]), make("mul", number(piece.by_speed[i]), faster))
        for change, by in zip(beyond, piece.by_param[i], strict=True):
            if by:
                total = make("add", total, make("mul", number(by), change))
        place = make("param", value=len(e.params) + 1 + i)
        start[e.states.index(name)] = make("add", total, make("mul", number(piece.width[i]), place))
    also = {name: e.operations.index(RealOperation("state", (), e.states.index(name))) for name in shown}
    names = ("tail.speed", *(f"tail.{name}" for name in tail.states))
    return dataclasses.replace(
        e,
        operations=tuple(operations),
        params=(*e.params, *names),
        start=tuple(start),
        signals={**e.signals, **also},
    )
