"""The native prover: enclosures of all runs of cells, in upward rounding, several cells at a time."""

import ctypes
import functools
import pathlib
import re
import threading
from collections.abc import Callable, Sequence
from fractions import Fraction
from typing import NamedTuple

import numpy as np

from diffabs.compiler.runtime import toolchain
from diffabs.host.process import core_count
from diffabs.robust.reach.equations import Equations, NoRule, RealOperation
from diffabs.robust.reach.tail import RunTail, stop_speed

PROVER_FOLDER = pathlib.Path(__file__).parent / "native"
# -frounding-math: nothing is folded or moved as if rounding were to nearest. -ffp-contract=off: a product is a product.
FLAGS = (
    *("-std=c++17", "-O2", "-march=native", "-frounding-math", "-ffp-contract=off"),
    *("-shared", "-fPIC", "-w"),
)
CODES = (
    *("const", "truth", "param", "state", "add", "sub", "neg", "mul", "inv", "clamp", "round", "select", "meet"),
    *("lt", "le", "eq", "ne", "and", "or", "not", "exp", "log", "sin", "cos", "atan", "power"),
)  # in the order of `Code` in series.h
FAILURES = (
    "",
    "a condition or a number is undecided over a set of states",
    "the slip may become negative",
    "no step encloses the runs, with a slip below 1 and above the least speed",
    "a set of states grows too wide",
    "the stop's margin may rise near the end",
    "the cell needs too many steps",
    "a run may have ended at its start",
)  # in the order of `Why` in prove.cpp
WEIGHT_TABLES = 400  # parts of the range of speeds, or of the horizon, with weights of their own
SPEED_WEIGHT = 256.0  # of the speed over the slip: an error of the speed stays, and must not turn into one of the slip
NEAR = 0.3  # logarithm of the ratio of speeds whose couplings count together
CLOCKWORK_WEIGHT = 2.0**20  # of states that are the same in all runs: nothing else mixes with them
SCOUTED = 20_000  # periods, or steps, of the run that the weights are chosen by
# Orders of the Taylor polynomials. With 8, one step lasts from one tick to the next; without ticks, limits need steps
# that are shorter than order 6 allows.
SAMPLED_ORDER, CONTINUOUS_ORDER = 8, 6
TAIL_ARRAYS = (
    *("slow", "fast", "middle", "settled_centre", "settled_by_speed", "settled_width"),
    *("settled_by_param", "settled_at", "later_states", "later_signals"),
)


class _Tape(ctypes.Structure):
    """The struct `Tape` of series.h."""

    _fields_ = [
        ("count", ctypes.c_long),
        *((name, ctypes.c_void_p) for name in ("code", "a", "b", "c", "low", "high", "index")),
        *((name, ctypes.c_long) for name in ("params", "states")),
    ]


class _Task(ctypes.Structure):
    """The struct `Task` of prove.cpp."""

    _fields_ = [
        ("tape", _Tape),
        *((name, ctypes.c_long) for name in ("states", "kept", "quadratures")),
        *((name, ctypes.c_void_p) for name in ("start", "flow", "tick")),
        ("signals", ctypes.c_long),
        ("signal", ctypes.c_void_p),
        *((name, ctypes.c_long) for name in ("margin", "travelled", "clock", "nonnegative", "speed", "acceleration")),
        *((name, ctypes.c_double) for name in ("slowest", "period_low", "period_high", "horizon", "tolerance")),
        *((name, ctypes.c_double) for name in ("longest", "shortest", "first")),
        *((name, ctypes.c_long) for name in ("order", "tables")),
        ("weights", ctypes.c_void_p),
        *((name, ctypes.c_double) for name in ("keys_low", "keys_high")),
        *((name, ctypes.c_long) for name in ("pieces", "settled_params")),
        *((name, ctypes.c_void_p) for name in TAIL_ARRAYS),
        *((name, ctypes.c_double) for name in ("stop_low", "stop_high", "latest")),
    ]


def decimal_ends(value: float) -> tuple[float, float]:
    """Return an interval that contains a double and the decimal number that its shortest text shows."""
    if Fraction(repr(float(value))) == Fraction(float(value)):
        return float(value), float(value)
    return float(np.nextafter(value, -np.inf)), float(np.nextafter(value, np.inf))


@functools.cache
def library() -> ctypes.CDLL:
    """Return the compiled prover, after a test that its compiler keeps the rounding mode."""
    sources = [(PROVER_FOLDER / name).read_text() for name in ("interval.h", "set.h", "series.h", "prove.cpp")]
    text = "\n".join(re.sub(r'#include "[a-z.]*"|#pragma once', "", source) for source in sources)
    try:
        native = ctypes.CDLL(str(toolchain.build_library(text, FLAGS)))
    except OSError as error:
        raise toolchain.NoCompiler(str(error)) from None
    native.prove.restype = ctypes.c_long
    if native.rounds_upward() != 1:
        raise toolchain.NoCompiler(f"{toolchain.find_compiler().version} ignores the rounding mode")
    return native


def apply_operation(name: str, a: np.ndarray, b: np.ndarray | None = None) -> np.ndarray:
    """Return an operation of the prover on intervals, shape (count, 2); an interval without a value is infinite.

    Args:
        name: add, sub, mul, inv, exp, log, sin, cos, atan or power.
    """
    a = np.ascontiguousarray(a, float)
    b = np.ascontiguousarray(a if b is None else b, float)
    out = np.empty_like(a)
    library().apply(CODES.index(name), ctypes.c_long(len(a)), *(x.ctypes.data_as(ctypes.c_void_p) for x in (a, b, out)))
    return out


class CellBounds(NamedTuple):
    """Proved bounds of cells of parameters, one row for each.

    Attributes:
        status: 1 if every run of the cell ends, 2 if it is proved up to the horizon, 0 if nothing is proved.
        time: Stop time, low and high [s].
        distance: Stop distance, low and high [m].
        lower: Lower bounds of the signals.
        upper: Upper bounds of the signals.
        below: Values that the signals of every run of the cell fall below, or reach.
        above: Values that the signals of every run of the cell rise above, or reach.
        reach: About the half widths that each parameter causes: of the slip at its greatest (of state 0
            without a slip), of the stop time, and of the stop distance, shape (cells, 3, parameters).
        failure: Why nothing is proved, as the index of `FAILURES`.
    """

    status: np.ndarray
    time: np.ndarray
    distance: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    below: np.ndarray
    above: np.ndarray
    reach: np.ndarray
    failure: np.ndarray


class CellTube(NamedTuple):
    """Bounds of all runs of a cell during each step, one row for each step.

    Attributes:
        time: Earliest beginning and latest end of the step, shape (steps, 2) [s].
        lower: Lower bounds of the signals, shape (steps, signals).
        upper: Upper bounds of the signals, shape (steps, signals).
    """

    time: np.ndarray
    lower: np.ndarray
    upper: np.ndarray


class Prover:
    """A loop's equations, arranged for the native prover.

    Attributes:
        equations: Equations of the loop.
        signals: Names of the signals whose range is wanted.
        horizon: Duration after which a run is no longer followed [s].
        weights: Units of Lohner's step, shape (WEIGHT_TABLES, persistent states); a choice, no part of the proof.
        persistent: Indices of the states that are kept over a tick.
        moving: Indices of these and of the states that a tick sets.
        clockwork: Places among the persistent states of those that are the same in all runs.
    """

    def __init__(
        self, equations: Equations, signals: Sequence[str], horizon: float, *, tolerance: float = 3e-7,
        slowest: float = 0.02, first: float = 1e-5, shortest: float = 1e-8, longest: float = 1e9, order: int = 0,
    ):  # fmt: skip
        """Arrange the equations.

        Args:
            horizon: Duration after which a run is no longer followed [s].
            tolerance: Greatest remainder of a step, relative to the state.
            slowest: Least speed [m/s].
            first, shortest, longest: Lengths of the first, the shortest and the longest step [s]; paced loop: [s^2/m].
            order: Order of the Taylor polynomials; 0 for the usual one.
        """
        e = equations
        self.equations: Equations = equations
        self.signals: tuple[str, ...] = tuple(signals)
        self.horizon: float = horizon
        order = order or (CONTINUOUS_ORDER if equations.period is None else SAMPLED_ORDER)
        persistent, passing, quadratures = arrange_states(e, self.signals)
        states = [*persistent, *passing, *quadratures]
        place = {state: i for i, state in enumerate(states)}
        if e.paced and place[e.clock] < len(persistent) + len(passing):
            raise NoRule("a continuous loop of a braked wheel that reads the time")
        for operation in e.operations:
            if operation.name == "clamp" and any(e.operations[x].name != "const" for x in operation.args[1:] if x >= 0):
                raise NoRule("a limit that is not a number")
        self.persistent: list[int] = persistent
        self.moving: list[int] = [*persistent, *passing]
        self.clockwork: list[int] = [place[i] for i in clockwork_states(e, persistent)]
        moving = len(persistent) + len(passing)
        roots = {
            "start": [e.start[i] for i in states],
            "flow": [e.flow[i] for i in states],
            "tick": [e.tick[i] if e.tick else -1 for i in states[:moving]],
            "signal": [e.signals[name] for name in self.signals],
        }
        self._arrays = {name: np.array(column, np.int32) for name, column in roots.items()}
        self._arrays |= _tape_arrays(e, place)
        self.weights: np.ndarray = np.ones((WEIGHT_TABLES, max(1, len(persistent))))
        at = {name: column.ctypes.data for name, column in self._arrays.items()}
        columns = (at[name] for name in ("code", "a", "b", "c", "low", "high", "index"))
        low, high = decimal_ends(e.period) if e.period else (0.0, 0.0)
        self.task: _Task = _Task(
            _Tape(len(e.operations), *columns, len(e.params), moving),
            *(moving, len(persistent), len(quadratures)),
            *(at["start"], at["flow"], at["tick"], len(self.signals), at["signal"]),
            *(e.margin, place.get(e.travelled, -1), place.get(e.clock, -1) if e.paced else -1),
            *(place[e.nonnegative[0]] if e.nonnegative else -1, place.get(e.speed, -1), e.acceleration),
            *(slowest, low, high, horizon, tolerance, longest, shortest, first, order, WEIGHT_TABLES),
            *(self.weights.ctypes.data, 0.0, horizon),
        )

    def use_tail(self, tail: RunTail | None, latest: float | None = None) -> None:
        """End a cell once its runs are in a tail, which must be proved for all parameters of the cells.

        None follows every cell to its stop. Runs in the tail must stop by `latest` [s], by default the horizon.
        """
        if tail is None or not tail.pieces:
            self.task.pieces = 0
            return
        pieces, n = tail.pieces, len(self.persistent)
        names = [self.equations.states[i] for i in self.moving]
        settled = [names.index(name) for name in tail.states]
        by_param = np.zeros((len(pieces), n, len(tail.middle)))
        columns = {name: np.zeros((len(pieces), n)) for name in ("centre", "by_speed", "width")}
        later = np.zeros((len(pieces), len(names), 2))
        for k, piece in enumerate(pieces):
            by_param[k, settled] = piece.by_param
            for name, column in columns.items():
                column[k, settled] = getattr(piece, name)
            for name, ends in piece.later_states.items():
                later[k, names.index(name)] = ends
        signals = [[piece.later_signals.get(name, (-np.inf, np.inf)) for name in self.signals] for piece in pieces]
        self._tail_arrays = {
            "slow": np.array([piece.low for piece in pieces]),
            "fast": np.array([piece.high for piece in pieces]),
            "middle": np.array([piece.middle for piece in pieces]),
            **{f"settled_{name}": column for name, column in columns.items()},
            "settled_by_param": by_param,
            "settled_at": np.array(tail.middle, float),
            "later_states": later,
            "later_signals": np.array(signals, float),
        }
        for name in TAIL_ARRAYS:
            setattr(self.task, name, self._tail_arrays[name].ctypes.data)
        self.task.pieces = len(pieces)
        self.task.settled_params, self.task.latest = len(tail.middle), self.horizon if latest is None else latest
        end = stop_speed(self.equations)
        assert end is not None
        self.task.stop_low, self.task.stop_high = decimal_ends(end)

    @property
    def _width(self) -> int:
        return 6 + 4 * len(self.signals) + 3 * len(self.equations.params)

    def prove(self, cells: np.ndarray, threads: int | None = None) -> CellBounds:
        """Return the bounds of cells, whose ends have shape (cells, parameters, 2), in SI units."""
        cells, lanes = np.ascontiguousarray(cells, float), library().lanes()
        out = np.zeros((len(cells), self._width))
        groups = [slice(first, first + lanes) for first in range(0, len(cells), lanes)]
        self._call([(np.ascontiguousarray(cells[group]), out[group]) for group in groups], threads or core_count())
        n = len(self.signals)
        pairs = out[:, 5 : 5 + 4 * n].reshape(len(out), 2, n, 2)
        return CellBounds(
            *(out[:, 0].astype(int), out[:, 1:3], out[:, 3:5]),
            *(pairs[:, 0, :, 0], pairs[:, 0, :, 1], pairs[:, 1, :, 0], pairs[:, 1, :, 1]),
            *(out[:, 5 + 4 * n : -1].reshape(len(out), 3, -1), out[:, -1].astype(int)),
        )

    def follow(self, cell: np.ndarray, steps: int = 100_000) -> CellTube:
        """Return the bounds of one cell (parameters, 2) at every step: a tube that all its runs stay in."""
        n, lanes = len(self.signals), library().lanes()
        trail = np.full((steps, lanes, 2 + 2 * n), np.nan)
        out = np.zeros((1, self._width))
        pieces, self.task.pieces = self.task.pieces, 0
        (count,) = self._call([(np.ascontiguousarray(cell, float)[None], out)], trail=trail)
        self.task.pieces = pieces
        if not out[0, 0] or count == steps:
            raise ValueError(f"the cell {np.asarray(cell).tolist()} is not proved in {steps:,} steps")
        rows = trail[:count, 0][np.isfinite(trail[:count, 0, 0])]
        ends = rows[:, :2]
        begins = np.concatenate([np.zeros((1, 2)), ends])[: len(ends), 0]
        pairs = rows[:, 2:].reshape(len(rows), n, 2)
        return CellTube(np.stack([begins, ends[:, 1]], 1), pairs[:, :, 0], pairs[:, :, 1])

    def _call(
        self, groups: Sequence[tuple[np.ndarray, np.ndarray]], threads: int = 1, *,
        scout: np.ndarray | None = None, trail: np.ndarray | None = None,
    ) -> list[int]:  # fmt: skip
        """Prove groups of (cells, results) in threads; return for each how many rows of `scout` or `trail` it wrote."""
        stop, room = ctypes.c_int32(), max(0 if x is None else len(x) for x in (scout, trail))

        def prove_group(cells: np.ndarray, out: np.ndarray) -> int:
            pointers = [None if x is None else x.ctypes.data_as(ctypes.c_void_p) for x in (cells, out, scout, trail)]
            counts = ctypes.c_long(len(cells)), *pointers, ctypes.c_long(room)
            return library().prove(ctypes.byref(self.task), *counts, ctypes.byref(stop))

        library()  # compiled before there are threads
        return _run_in_threads([lambda group=group: prove_group(*group) for group in groups], threads, stop)

    def scout(self, point: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return speeds [m/s] (or times [s]), persistent states and absolute Jacobians of the periods of one run."""
        n = len(self.persistent)
        rows = np.zeros((SCOUTED, 1 + n + n * n))
        cell = np.repeat(np.asarray(point, float)[None, :, None], 2, 2)
        (count,) = self._call([(cell, np.zeros((1, self._width)))], scout=rows)
        rows = rows[:count][np.isfinite(rows[:count]).all(1)]  # the first has no axes yet
        return rows[:, 0], rows[:, 1 : 1 + n], np.abs(rows[:, 1 + n :]).reshape(len(rows), n, n)

    def share_weights(self, prover: "Prover") -> None:
        """Take the units of the axes from another prover of the same states, whose weights were chosen."""
        self.weights[:] = prover.weights
        self.task.keys_low, self.task.keys_high = prover.task.keys_low, prover.task.keys_high

    def weights_at(self, speed: float) -> np.ndarray:
        """Return the units of the axes at a speed [m/s], shape (persistent states,)."""
        low, high = self.task.keys_low, self.task.keys_high
        place = (np.log(max(speed, 1e-3)) - low) / max(high - low, 1e-9) * WEIGHT_TABLES
        return self.weights[int(np.clip(place, 0, WEIGHT_TABLES - 1))]

    def choose_weights(self, point: np.ndarray) -> None:
        """Choose the units of Lohner's step from the Jacobians along the run of one point.

        Without them a contracting map wraps the set and lets it grow.
        """
        if not self.persistent:
            return
        keys, _, jacobians = self.scout(point)
        if not len(keys):
            return
        if self.task.speed >= 0:
            keys = np.log(np.maximum(keys, 1e-3))
        self.task.keys_low, self.task.keys_high = low, high = float(keys.min()), float(keys.max())
        near = NEAR if self.task.speed >= 0 else 0.1 * (high - low)
        for k in range(WEIGHT_TABLES):
            key = low + (k + 0.5) / WEIGHT_TABLES * (high - low)
            close = np.abs(keys - key) <= max(near, float(np.abs(keys - key).min()))
            self.weights[k] = balance_weights(jacobians[close].max(0))
            self.weights[k, self.clockwork] = CLOCKWORK_WEIGHT
            if self.task.speed >= 0:
                self.weights[k, self.task.speed] = self.weights[k, self.task.nonnegative] * SPEED_WEIGHT


def _run_in_threads(calls: Sequence[Callable[[], int]], threads: int, stop: ctypes.c_int32) -> list[int]:
    """Return the results of native calls; an exception in this thread, such as Ctrl-C, sets `stop`.

    No signal reaches Python during a native call in the main thread, and a process waits at its end for the threads of
    an executor. So the calls run in daemon threads.
    """
    results, errors, pending = [0] * len(calls), list[BaseException](), iter(range(len(calls)))

    def work() -> None:
        try:
            for i in pending:
                if stop.value:
                    return
                results[i] = calls[i]()
        except BaseException as error:
            errors.append(error)

    workers = [threading.Thread(target=work, daemon=True) for _ in range(min(threads, len(calls)))]
    try:
        for worker in workers:
            worker.start()
        for worker in workers:
            worker.join()
    except BaseException:
        stop.value = 1
        raise
    if errors:
        raise errors[0]
    return results


def _tape_arrays(e: Equations, place: dict[int, int]) -> dict[str, np.ndarray]:
    """Return the columns of the operations. States have the places that `place` says; the others come after them."""
    count = len(e.operations)
    columns: dict[str, np.ndarray] = {name: np.full(count, -1, np.int32) for name in ("code", "a", "b", "c", "index")}
    columns |= {"low": np.zeros(count), "high": np.zeros(count)}
    for i, operation in enumerate(e.operations):
        columns["code"][i] = CODES.index(operation.name)
        for name, arg in zip("abc", operation.args, strict=False):
            columns[name][i] = arg
        match operation.name:
            case "const" if np.isfinite(operation.value):
                columns["low"][i], columns["high"][i] = decimal_ends(operation.value)
            case "const" | "truth":
                columns["low"][i] = columns["high"][i] = float(operation.value)
            case "param":
                columns["index"][i] = operation.value
            case "state":
                columns["index"][i] = place.get(operation.value, len(place) + operation.value)
    return columns


def clockwork_states(e: Equations, states: list[int]) -> list[int]:
    """Return those of `states` that only such states move: they are the same in all runs."""
    alone = set(states)
    while True:
        read = {i: read_by(e, [e.start[i], e.flow[i], *([e.tick[i]] if e.tick else [])]) for i in alone}
        fewer = {i for i in alone if read[i][0] <= alone and not read[i][1]}
        if fewer == alone:
            return sorted(alone)
        alone = fewer


def read_by(e: Equations, roots: Sequence[int]) -> tuple[set[int], set[int]]:
    """Return the states and the parameters that operations read, through their operands."""
    states, params, pending, visited = set(), set(), list(roots), set()
    while pending:
        i = pending.pop()
        if i in visited or i < 0:
            continue
        visited.add(i)
        if e.operations[i].name == "state":
            states.add(e.operations[i].value)
        if e.operations[i].name == "param":
            params.add(e.operations[i].value)
        pending += list(e.operations[i].args)
    return states, params


def balance_weights(matrix: np.ndarray) -> np.ndarray:
    """Return powers of two w with which diag(w) |matrix| diag(1/w) has rows and columns of equal norms.

    The diagonal counts for nothing. This is Osborne's balancing, row by row.
    """
    w, a = np.ones(len(matrix)), np.abs(np.asarray(matrix, float))
    np.fill_diagonal(a, 0.0)
    for _ in range(50):
        for i in range(len(a)):
            row, column = np.linalg.norm(a[i]), np.linalg.norm(a[:, i])
            if row > 1e-12 and column > 1e-12:
                factor = 2.0 ** np.round(0.5 * np.log2(column / row))
                w[i] *= factor
                a[i] *= factor
                a[:, i] /= factor
    return w


def arrange_states(e: Equations, signals: Sequence[str]) -> tuple[list[int], list[int], list[int]]:
    """Return the states that a proof needs: kept over a tick, set by a tick, and quadratures.

    A quadrature is a state that nothing reads, such as the distance. There is no rule for a tick that changes a state
    that the stop reads.
    """
    margin_states = read_by(e, [e.margin])[0]
    integrals = [i for i in (e.travelled, e.clock if e.paced else -1) if i >= 0]
    live = read_by(e, [e.margin, *(e.signals[name] for name in signals), *(e.flow[i] for i in integrals)])[0]
    live |= set(e.nonnegative)  # the equations hold only where these are not negative
    while True:
        more = live | read_by(e, [root for i in live for root in (e.flow[i], *((e.tick[i],) if e.tick else ()))])[0]
        if more == live:
            break
        live = more
    quadratures = [i for i in integrals if i not in live]
    if not e.tick:
        return sorted(live), [], quadratures
    for i in margin_states:
        if e.operations[e.tick[i]] != RealOperation("state", (), i):
            raise NoRule(f"the stop reads {e.states[i]}, which a tick changes")
    persistent = read_by(e, [e.tick[i] for i in live])[0] | margin_states
    return sorted(persistent), sorted(live - persistent), quadratures
