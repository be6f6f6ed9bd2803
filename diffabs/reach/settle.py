"""The search for a tail: pieces from slow to fast, each proved by the native prover.

Centres come from single runs, widths from the units of Lohner's axes. A wrong choice costs time, and no more: a piece
whose claim is not proved ends the tail, and runs are then followed to their stop above its speed.
"""

import math
import time
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from diffabs.reach.engine import CellBounds, Prover, read_by
from diffabs.reach.tail import Ends, Tail, TailPiece, equations_from, stop_speed

SPACING, HELD = 1.1, 1.135  # ratios of speeds: of one piece to the next, and within a piece
SMOOTHED = 1.5  # ratio of speeds
PATIENCE = 2.5  # durations of a piece, after which a run should be in a slower one
ABOVE_STOP = 1.02  # lowest speed of the tail, in speeds of the stop
MOST_CELLS = 256  # of a piece
CLOCKWORK_SHARE = (
    0.1  # width of a state that is the same in all runs, over that of the slip, both relative to the state
)
SLACK = 0.03  # by which the ranges of a piece are wider than proved, in their widths: the checker's are wider
WIDEST = 6.0  # of the slip's range in a piece, in half widths: beyond, the runs have not settled
ROOM = 5.0  # between the settled slip and its bound, in half widths of a piece


class _Model(NamedTuple):
    """Settled states by speed and parameters, from single runs."""

    speeds: np.ndarray
    states: np.ndarray  # of the run in the middle, shape (speeds, settled states)
    by_param: np.ndarray  # shape (speeds, settled states, parameters)

    def at(self, table: np.ndarray, speed: float) -> np.ndarray:
        flat = table.reshape(len(self.speeds), -1)
        return np.array([np.interp(speed, self.speeds, column) for column in flat.T]).reshape(table.shape[1:])


class _Cut(NamedTuple):
    """A cell of a piece, by the halvings that lead to it: each has a side, and 0 for its low or 1 for its high half."""

    path: tuple[tuple[int, int], ...] = ()

    def ends(self, over: Sequence[Ends], piece: TailPiece) -> list[Ends]:
        """Return the ranges of parameters and speed."""
        ends = [*over, (piece.low, piece.high)]
        for side, upper in self.path:
            low, high = ends[side]
            middle = 0.5 * (low + high)
            ends[side] = (middle, high) if upper else (low, middle)
        return ends

    def halves(self, over: Sequence[Ends], piece: TailPiece, sides: Sequence[int]) -> list["_Cut"]:
        """Return the two halves along the longest of some sides, relative to the parameter."""
        ends = self.ends(over, piece)
        side = max(sides, key=lambda i: (ends[i][1] - ends[i][0]) / max(abs(ends[i][0]), abs(ends[i][1]), 1e-300))
        return [_Cut((*self.path, (side, upper))) for upper in (0, 1)]


def _join_halves(cuts: Sequence[_Cut]) -> list[_Cut]:
    """Return cells, each pair of halves as one."""
    whole = {(*cut.path[:-1], (cut.path[-1][0], 1 - cut.path[-1][1])) for cut in cuts if cut.path}
    return list(dict.fromkeys(_Cut(cut.path[:-1]) if cut.path in whole else cut for cut in cuts))


def find_tail(
    prover: Prover,
    over: Mapping[str, Ends],
    width: float,
    greatest: float,
    *,
    until: float = math.inf,
    threads: int | None = None,
) -> Tail | None:
    """Return a proved tail of the runs over a box, or None if the search finds none.

    Args:
        prover: Prover of the loop, with weights.
        over: Range of each parameter of the box.
        width: Greatest half width of the pieces in the slip [1].
        greatest: Slip that the runs in the tail should not exceed [1].
        until: Time of `time.monotonic` at which the search ends [s].
        threads: Number of threads; None for one for each core.
    """
    e = prover.equations
    end = stop_speed(e)
    if end is None or end <= 0 or e.clock in prover.kept or not e.nonnegative:
        return None
    settled = [i for i in prover.kept if i != e.speed]
    slip = e.nonnegative[0]
    if slip not in settled or not read_by(e, [e.acceleration])[0] <= set(prover.moving):
        return None
    fastest = np.array([high if path == "initial.speed" else 0.5 * (low + high) for path, (low, high) in over.items()])
    alone = prover.prove(np.repeat(fastest[None, :, None], 2, 2), threads)
    lasting = sorted(read_by(e, [*e.flow, *e.tick, *e.signals.values(), e.margin])[1])
    model = _model_settled_states(prover, over, settled, lasting, fastest)
    if alone.status[0] != 1 or model is None:
        return None
    width = min(width, (greatest - model.states[0, settled.index(slip)]) / ROOM)
    deceleration = (float(model.speeds[-1]) - end) / float(alone.time[0, 1])
    middle = tuple(0.5 * (low + high) for low, high in over.values())
    tail = Tail(tuple(e.states[i] for i in settled), middle, ())
    cuts = [_Cut(((len(over), upper),)) for upper in (0, 1)]
    low = max(end * ABOVE_STOP, float(model.speeds[0]))
    while width > 0 and low * HELD <= model.speeds[-1] and time.monotonic() < until:
        piece = _place_piece(prover, model, tail, low, width)
        patience = PATIENCE * (piece.high - piece.low / HELD) / deceleration
        proved = _prove_piece(prover, tail, piece, over, _join_halves(cuts), [*lasting, len(over)], patience, threads)
        if proved is None:
            break
        piece, cuts = proved
        tail = tail._replace(pieces=(*tail.pieces, piece))
        low *= SPACING
    return tail if len(tail.pieces) > 1 else None


def _model_settled_states(
    prover: Prover, over: Mapping[str, Ends], settled: Sequence[int], lasting: Sequence[int], fastest: np.ndarray
) -> _Model | None:
    """Return the settled states by speed, from a run in the middle of the box and runs at the ends of each parameter.

    All start at the greatest speed, so that one model serves all starts. Parameters that are not `lasting` have no
    effect after the start.
    """
    places = [prover.kept.index(i) for i in settled]

    def run(at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        speeds, states, _ = prover.scout(at)
        order = np.argsort(speeds, kind="stable")
        return speeds[order], states[order][:, places]

    speeds, states = run(fastest)
    by_param = np.zeros((len(speeds), len(settled), len(over)))
    for j, (low, high) in enumerate(over.values()):
        if j not in lasting or not low < high:
            continue
        ends = []
        for value in (low, high):
            there = fastest.copy()
            there[j] = value
            v, y = run(there)
            if not len(v):
                return None
            ends.append(np.stack([np.interp(speeds, v, column) for column in y.T], 1))
        by_param[:, :, j] = (ends[1] - ends[0]) / (high - low)
    return _Model(speeds, states, by_param) if len(speeds) else None


def _place_piece(prover: Prover, model: _Model, tail: Tail, low: float, width: float) -> TailPiece:
    """Return a piece above a speed, whose ranges up to the stop are still unknown."""
    high = low * HELD
    middle = 0.5 * (low + high)
    centre = model.at(model.states, middle)
    by_speed = (model.at(model.states, high) - model.at(model.states, low)) / (high - low)
    by_param = model.at(model.by_param, middle)
    e = prover.equations
    places = [prover.kept.index(e.states.index(name)) for name in tail.states]
    slip = tail.states.index(e.states[e.nonnegative[0]])
    # The units are powers of two. Their mean over nearby speeds changes little from one piece to the next.
    near = [prover.weights_at(middle * factor)[places] for factor in np.geomspace(1 / SMOOTHED, SMOOTHED, 15)]
    units = np.exp(np.log(near).mean(0))
    widths = width * units[slip] / units
    for i, place in enumerate(places):
        if place in prover.clockwork:
            widths[i] = CLOCKWORK_SHARE * width / max(abs(centre[slip]), 1e-3) * abs(centre[i])
    rows = tuple(tuple(map(float, row)) for row in by_param)
    centre, by_speed, widths = (tuple(map(float, x)) for x in (centre, by_speed, widths))
    return TailPiece(low, high, centre, by_speed, rows, widths, {}, {}, ())


def _prove_piece(
    prover: Prover,
    slower: Tail,
    piece: TailPiece,
    over: Mapping[str, Ends],
    cuts: list[_Cut],
    sides: Sequence[int],
    patience: float,
    threads: int | None,
) -> tuple[TailPiece, list[_Cut]] | None:
    """Return a piece with its ranges up to the stop, and its proved cells; None without a proof.

    Cells that fail are halved along the longest of `sides`, relative to the parameter.
    """
    e, slip = prover.equations, prover.equations.states[prover.equations.nonnegative[0]]
    read = sorted(e.states[i] for i in read_by(e, [e.acceleration])[0] - {e.speed})
    shown = list(dict.fromkeys([slip, *read]))
    own = Prover(equations_from(e, slower, piece, shown), (*prover.signals, *shown), patience)
    own.share_weights(prover)
    own.use_tail(slower.entries(len(slower.pieces), own.signals), math.inf)
    places = np.tile([-1.0, 1.0], (len(slower.states), 1))
    column, widest = len(prover.signals), WIDEST * piece.width[slower.states.index(slip)]
    done: list[_Cut] = []
    rows: list[CellBounds] = []
    left = cuts
    while left:
        if len(left) + len(done) > MOST_CELLS:
            return None
        cells = np.array([cut.ends(tuple(over.values()), piece) for cut in left])
        found = own.prove(np.concatenate([cells, np.tile(places, (len(cells), 1, 1))], 1), threads)
        fine = (found.status == 1) & (found.greatest[:, column] - found.least[:, column] <= widest)
        done += [cut for cut, is_fine in zip(left, fine, strict=True) if is_fine]
        rows.append(CellBounds(*(column[fine] for column in found)))
        left = [
            half
            for cut, is_fine in zip(left, fine, strict=True)
            if not is_fine
            for half in cut.halves(tuple(over.values()), piece, sides)
        ]
    least = np.concatenate([x.least for x in rows]).min(0)
    greatest = np.concatenate([x.greatest for x in rows]).max(0)
    slack = SLACK * (greatest - least)
    ends = dict(zip(own.signals, zip((least - slack).tolist(), (greatest + slack).tolist(), strict=True), strict=True))
    signals, states = ({name: ends[name] for name in names} for names in (prover.signals, read))
    if slower.pieces:
        before = slower.pieces[-1]
        signals = {name: _hull(x, before.later_signals[name]) for name, x in signals.items()}
        states = {name: _hull(x, before.later_states[name]) for name, x in states.items()}
    cells = tuple(tuple((float(a), float(b)) for a, b in cut.ends(tuple(over.values()), piece)) for cut in done)
    return piece._replace(later_states=states, later_signals=signals, cells=cells), done


def _hull(x: Ends, y: Ends) -> Ends:
    return min(x[0], y[0]), max(x[1], y[1])
