"""The search for a tail: pieces from slow to fast, each proved by the native prover.

Single runs give the centres, the weights of Lohner's axes the widths. A poor choice cannot make the proof wrong. If a
piece is not proved, the search ends, and faster runs are followed until they enter a slower piece.
"""

import math
import time
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from diffabs.robust.reach.engine import CellBounds, Prover, read_by
from diffabs.robust.reach.tail import Ends, RunTail, TailPiece, equations_from, stop_speed

SPACING = 1.1  # lowest speed of the next faster piece, over that of this one
SPAN = 1.135  # highest speed of a piece, over its lowest; pieces overlap
SMOOTHED = 1.5  # the weights are averaged over speeds from middle/1.5 to 1.5 middle
PATIENCE = 2.5  # horizon of the proof of a piece, over the time to brake from its highest speed to low/SPAN
ABOVE_STOP = 1.02  # lowest speed of the slowest piece, at least, over that of the stop
MOST_CELLS = 256  # of a piece; with more, the search ends
CLOCKWORK_SHARE = 0.1  # relative width of a state in `Prover.clockwork`, over that of the slip
RANGE_SLACK = 0.03  # share of a range that is added at each end, because the checker's enclosures are wider
WIDEST = 6.0  # range of the slip in a cell up to its entry, in half widths of the piece; a wider cell is halved
SLIP_ROOM = 5.0  # least distance of the settled slip from its bound, in half widths of a piece


class _Model(NamedTuple):
    """Settled states by speed and parameters, from single runs."""

    speeds: np.ndarray
    states: np.ndarray  # of the run in the middle, shape (speeds, settled states)
    by_param: np.ndarray  # shape (speeds, settled states, parameters)

    def at(self, table: np.ndarray, speed: float) -> np.ndarray:
        """Return `states` or `by_param` at a speed, by linear interpolation."""
        flat = table.reshape(len(self.speeds), -1)
        return np.array([np.interp(speed, self.speeds, column) for column in flat.T]).reshape(table.shape[1:])


class _Cut(NamedTuple):
    """A cell of a piece, as its path of halvings: pairs (side, 0 for the low or 1 for the high half)."""

    path: tuple[tuple[int, int], ...] = ()

    def ends(self, over: Sequence[Ends], piece: TailPiece) -> list[Ends]:
        ends = [*over, (piece.low, piece.high)]
        for side, upper in self.path:
            low, high = ends[side]
            middle = 0.5 * (low + high)
            ends[side] = (middle, high) if upper else (low, middle)
        return ends

    def halves(self, over: Sequence[Ends], piece: TailPiece, sides: Sequence[int]) -> list["_Cut"]:
        """Return the two halves along the longest of some sides, relative to its largest magnitude."""
        ends = self.ends(over, piece)
        side = max(sides, key=lambda i: (ends[i][1] - ends[i][0]) / max(abs(ends[i][0]), abs(ends[i][1]), 1e-300))
        return [_Cut((*self.path, (side, upper))) for upper in (0, 1)]


def _join_halves(cuts: Sequence[_Cut]) -> list[_Cut]:
    """Return the cells, with each pair of sibling halves joined: the next piece may need fewer."""
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
) -> RunTail | None:
    """Return a proved tail of the runs over a box, or None if two pieces are not proved.

    There is none for a loop without slip, or without a speed at which it stops.

    Args:
        width: Greatest half width of the pieces in the slip [1].
        greatest: Bound of the slip, which limits the width too [1].
        until: Time of `time.monotonic` at which the search ends [s].
    """
    e = prover.equations
    end = stop_speed(e)
    if end is None or end <= 0 or e.clock in prover.persistent or not e.nonnegative:
        return None
    settled = [i for i in prover.persistent if i != e.speed]
    slip = e.nonnegative[0]
    if slip not in settled or e.travelled in settled or not read_by(e, [e.acceleration])[0] <= set(prover.moving):
        return None
    fastest = np.array([high if path == "initial.speed" else 0.5 * (low + high) for path, (low, high) in over.items()])
    alone = prover.prove(np.repeat(fastest[None, :, None], 2, 2), threads)
    lasting = sorted(read_by(e, [*e.flow, *e.tick, *e.signals.values(), e.margin])[1])
    model = _model_settled_states(prover, over, settled, lasting, fastest)
    if alone.status[0] != 1 or model is None:
        return None
    width = min(width, (greatest - model.states[0, settled.index(slip)]) / SLIP_ROOM)
    deceleration = (float(model.speeds[-1]) - end) / float(alone.time[0, 1])
    middle = tuple(0.5 * (low + high) for low, high in over.values())
    tail = RunTail(tuple(e.states[i] for i in settled), middle, ())
    cuts = [_Cut()]
    low = max(end * ABOVE_STOP, float(model.speeds[0]))
    while width > 0 and low * SPAN <= model.speeds[-1] and time.monotonic() < until:
        piece = _place_piece(prover, model, tail, low, width)
        patience = PATIENCE * (piece.high - piece.low / SPAN) / deceleration
        proved = _prove_piece(
            prover, tail, piece, over, _join_halves(cuts), [*lasting, len(over)], patience, until, threads
        )
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
    places = [prover.persistent.index(i) for i in settled]

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
            start = fastest.copy()
            start[j] = value
            v, y = run(start)
            if not len(v):
                return None
            ends.append(np.stack([np.interp(speeds, v, column) for column in y.T], 1))
        by_param[:, :, j] = (ends[1] - ends[0]) / (high - low)
    return _Model(speeds, states, by_param) if len(speeds) else None


def _place_piece(prover: Prover, model: _Model, tail: RunTail, low: float, width: float) -> TailPiece:
    """Return an unproved piece from a speed on, without cells or later ranges."""
    high = low * SPAN
    middle = 0.5 * (low + high)
    centre = model.at(model.states, middle)
    by_speed = (model.at(model.states, high) - model.at(model.states, low)) / (high - low)
    by_param = model.at(model.by_param, middle)
    e = prover.equations
    places = [prover.persistent.index(e.states.index(name)) for name in tail.states]
    slip = tail.states.index(e.states[e.nonnegative[0]])
    # The weights are powers of two. Their mean over nearby speeds changes little from one piece to the next.
    near = [prover.weights_at(middle * factor)[places] for factor in np.geomspace(1 / SMOOTHED, SMOOTHED, 15)]
    weights = np.exp(np.log(near).mean(0))
    widths = width * weights[slip] / weights
    for i, place in enumerate(places):
        if place in prover.clockwork:
            widths[i] = CLOCKWORK_SHARE * width / max(abs(centre[slip]), 1e-3) * abs(centre[i])
    rows = tuple(tuple(map(float, row)) for row in by_param)
    centre, by_speed, widths = (tuple(map(float, x)) for x in (centre, by_speed, widths))
    return TailPiece(low, high, centre, by_speed, rows, widths, {}, {}, ())


def _prove_piece(
    prover: Prover,
    slower: RunTail,
    piece: TailPiece,
    over: Mapping[str, Ends],
    cuts: list[_Cut],
    sides: Sequence[int],
    patience: float,
    until: float,
    threads: int | None,
) -> tuple[TailPiece, list[_Cut]] | None:
    """Return a piece with its later ranges, and its proved cells; None without a proof.

    A cell fails if its runs enter no slower piece within `patience` [s], or if its slip is wider than WIDEST. It is
    then halved along the longest of `sides`.
    """
    e, slip = prover.equations, prover.equations.states[prover.equations.nonnegative[0]]
    read = sorted(e.states[i] for i in read_by(e, [e.acceleration])[0] - {e.speed})
    shown = list(dict.fromkeys([slip, *read]))
    piece_prover = Prover(equations_from(e, slower, piece, shown), (*prover.signals, *shown), patience)
    piece_prover.share_weights(prover)
    piece_prover.use_tail(slower.without_signals(len(slower.pieces), piece_prover.signals), math.inf)
    places = np.tile([-1.0, 1.0], (len(slower.states), 1))
    column, widest = len(prover.signals), WIDEST * piece.width[slower.states.index(slip)]
    proved: list[_Cut] = []
    rows: list[CellBounds] = []
    pending = cuts
    while pending:
        if len(pending) + len(proved) > MOST_CELLS or time.monotonic() > until:
            return None
        cells = np.array([cut.ends(tuple(over.values()), piece) for cut in pending])
        cell_bounds = piece_prover.prove(np.concatenate([cells, np.tile(places, (len(cells), 1, 1))], 1), threads)
        narrow = (cell_bounds.status == 1) & (cell_bounds.upper[:, column] - cell_bounds.lower[:, column] <= widest)
        proved += [cut for cut, is_narrow in zip(pending, narrow, strict=True) if is_narrow]
        rows.append(CellBounds(*(column[narrow] for column in cell_bounds)))
        pending = [
            half
            for cut, is_narrow in zip(pending, narrow, strict=True)
            if not is_narrow
            for half in cut.halves(tuple(over.values()), piece, sides)
        ]
    smallest = np.concatenate([x.lower for x in rows]).min(0)
    greatest = np.concatenate([x.upper for x in rows]).max(0)
    slack = RANGE_SLACK * (greatest - smallest)
    ranges = zip((smallest - slack).tolist(), (greatest + slack).tolist(), strict=True)
    ends = dict(zip(piece_prover.signals, ranges, strict=True))
    signals, states = ({name: ends[name] for name in names} for names in (prover.signals, read))
    if slower.pieces:
        before = slower.pieces[-1]
        signals = {name: _hull(x, before.later_signals[name]) for name, x in signals.items()}
        states = {name: _hull(x, before.later_states[name]) for name, x in states.items()}
    cells = tuple(tuple((float(a), float(b)) for a, b in cut.ends(tuple(over.values()), piece)) for cut in proved)
    return piece._replace(later_states=states, later_signals=signals, cells=cells), proved


def _hull(x: Ends, y: Ends) -> Ends:
    return min(x[0], y[0]), max(x[1], y[1])
