"""The native prover: enclosures of all runs of cells, in upward rounding, several cells at a time."""

import concurrent.futures
import ctypes
import functools
import pathlib
import re
from fractions import Fraction
from typing import NamedTuple

import numpy as np

from diffabs.compiler.runtime import toolchain
from diffabs.reach.equations import Equations, Operation
from diffabs.runtime.process import core_count

NATIVE_FOLDER = pathlib.Path(__file__).parent / "native"
FLAGS = ("-std=c++17", "-O2", "-march=native", "-frounding-math", "-ffp-contract=off", "-shared", "-fPIC", "-w")
CODES = ("const", "truth", "param", "state", "add", "sub", "neg", "mul", "inv", "clamp", "select", "meet", "lt", "le", "eq", "ne",
         "and", "or", "not", "exp", "log", "sin", "cos", "atan", "power")  # fmt: skip
TABLES = 400  # parts of the horizon with weights of their own
LANES = 8


class _Tape(ctypes.Structure):
    _fields_ = [("count", ctypes.c_long), *((x, ctypes.c_void_p) for x in ("code", "a", "b", "c", "low", "high", "index")),
                ("params", ctypes.c_long), ("states", ctypes.c_long)]  # fmt: skip


class _Task(ctypes.Structure):
    _fields_ = [
        ("tape", _Tape), ("states", ctypes.c_long), ("kept", ctypes.c_long), ("quadratures", ctypes.c_long),
        ("start", ctypes.c_void_p), ("flow", ctypes.c_void_p), ("tick", ctypes.c_void_p), ("signals", ctypes.c_long),
        ("signal", ctypes.c_void_p), ("margin", ctypes.c_long), ("travelled", ctypes.c_long), ("clock", ctypes.c_long),
        ("nonnegative", ctypes.c_long), ("speed", ctypes.c_long),
        *((x, ctypes.c_double) for x in ("slowest", "period_low", "period_high", "horizon", "tolerance", "longest", "shortest", "first")),
        ("order", ctypes.c_long), ("tables", ctypes.c_long), ("weights", ctypes.c_void_p),
        ("keys_low", ctypes.c_double), ("keys_high", ctypes.c_double),
    ]  # fmt: skip


def decimal_ends(value: float) -> tuple[float, float]:
    """Return an interval that contains a double and the decimal number that its shortest text shows.

    Args:
        value: Finite number.
    """
    if Fraction(repr(float(value))) == Fraction(float(value)):
        return float(value), float(value)
    return float(np.nextafter(value, -np.inf)), float(np.nextafter(value, np.inf))


@functools.cache
def library() -> ctypes.CDLL:
    """Return the compiled prover, after a test that its compiler keeps the rounding mode.

    Raises:
        NoCompiler: No C++ compiler of this machine works, or it ignores the rounding mode.
    """
    sources = [(NATIVE_FOLDER / name).read_text() for name in ("interval.h", "series.h", "prove.cpp")]
    text = "\n".join(re.sub(r'#include "[a-z.]*"|#pragma once', "", source) for source in sources)
    try:
        found = ctypes.CDLL(str(toolchain.build_library(text, FLAGS)))
    except OSError as error:
        raise toolchain.NoCompiler(str(error)) from None
    found.prove.restype = ctypes.c_long
    if found.rounds_upward() != 1:
        raise toolchain.NoCompiler(f"{toolchain.find_compiler().version} ignores the rounding mode")
    return found


def apply_operation(name: str, a: np.ndarray, b: np.ndarray | None = None) -> np.ndarray:
    """Return an operation of the prover on intervals, shape (count, 2); an interval without a value is infinite.

    Args:
        name: add, sub, mul, inv, exp, log, sin, cos, atan or power.
        a: First operands, shape (count, 2).
        b: Second operands, shape (count, 2); the exponents of power.
    """
    a = np.ascontiguousarray(a, float)
    b = np.ascontiguousarray(a if b is None else b, float)
    out = np.empty_like(a)
    library().apply(CODES.index(name), ctypes.c_long(len(a)), *(x.ctypes.data_as(ctypes.c_void_p) for x in (a, b, out)))
    return out


class Cells(NamedTuple):
    """Proved bounds of cells of parameters, one row for each.

    Attributes:
        status: 1 if every run of the cell ends, 2 if it is proved up to the horizon, 0 if nothing is proved.
        time: Stop time, low and high [s].
        distance: Stop distance, low and high [m].
        least: Lower bounds of the signals.
        greatest: Upper bounds of the signals.
        below: Values that the signals of every run of the cell fall below, or reach.
        above: Values that the signals of every run of the cell rise above, or reach.
        reach: Greatest half width of the first signal that each parameter causes.
        reached: Time up to which the cell was proved [s].
        steps: Steps of the cell's group.
        across: Steps or ticks across a limit.
    """

    status: np.ndarray
    time: np.ndarray
    distance: np.ndarray
    least: np.ndarray
    greatest: np.ndarray
    below: np.ndarray
    above: np.ndarray
    reach: np.ndarray
    reached: np.ndarray
    steps: np.ndarray
    across: np.ndarray


class Prover:
    """A loop's equations, arranged for the native prover."""

    def __init__(self, equations: Equations, signals: tuple[str, ...], horizon: float, *, order: int = 7, tolerance: float = 1e-7,
                 slowest: float = 0.02, longest: float = np.inf, first: float = 1e-5, shortest: float = 1e-8):
        e = self.equations = equations
        self.signals = signals
        kept, passing, quadratures = arrange_states(e, signals)
        order_of = [*kept, *passing, *quadratures]
        place = {state: i for i, state in enumerate(order_of)}
        self.states = tuple(e.states[i] for i in order_of)
        self.kept = len(kept)
        self.clockwork = [place[i] for i in clockwork_states(e, kept) if place[i] < len(kept)]
        ops = e.operations
        arrays = {name: np.full(len(ops), -1, np.int32) for name in ("code", "a", "b", "c", "index")}
        low, high = np.zeros(len(ops)), np.zeros(len(ops))
        for i, o in enumerate(ops):
            arrays["code"][i] = CODES.index(o.name)
            for key, arg in zip("abc", o.args):
                arrays[key][i] = arg
            if o.name == "const":
                low[i], high[i] = decimal_ends(o.value) if np.isfinite(o.value) else (o.value, o.value)
            if o.name == "truth":
                low[i] = float(o.value)
            if o.name == "param":
                arrays["index"][i] = o.value
            if o.name == "state":
                arrays["index"][i] = place.get(o.value, len(order_of) + o.value)
        n = len(kept) + len(passing)
        roots = {
            "start": np.array([e.start[i] for i in order_of], np.int32),
            "flow": np.array([e.flow[i] for i in order_of], np.int32),
            "tick": np.array([e.tick[i] if e.tick else -1 for i in order_of[:n]], np.int32),
            "signal": np.array([e.signals[s] for s in signals], np.int32),
        }
        self._keep = [*arrays.values(), low, high, *roots.values()]
        at = lambda a: a.ctypes.data
        tape = _Tape(len(ops), *(at(arrays[x]) for x in ("code", "a", "b", "c")), at(low), at(high), at(arrays["index"]), len(e.params), n)
        period = decimal_ends(e.period) if e.period else (0.0, 0.0)
        travelled = place.get(e.travelled, -1)
        self.weights = np.ones((TABLES, max(1, len(kept))))
        self.task = _Task(
            tape, n, len(kept), len(quadratures), at(roots["start"]), at(roots["flow"]), at(roots["tick"]), len(signals),
            at(roots["signal"]), e.margin, travelled, place.get(e.clock, -1) if e.paced else -1, place.get(e.nonnegative[0], -1) if e.nonnegative else -1, place.get(e.speed, -1),
            slowest, *period, horizon, tolerance, min(longest, horizon), shortest, first, order, TABLES, at(self.weights), 0.0, horizon,
        )

    def prove(self, cells: np.ndarray, threads: int | None = None) -> Cells:
        """Return the bounds of cells, shape (cells, parameters, 2)."""
        cells = np.ascontiguousarray(cells, float)
        count, np_, ns = len(cells), len(self.equations.params), len(self.signals)
        out = np.zeros((count, 8 + 4 * ns + np_))
        groups = [(i, min(i + LANES, count)) for i in range(0, count, LANES)]
        lib = library()

        def one(span: tuple[int, int]) -> None:
            part, result = np.ascontiguousarray(cells[span[0] : span[1]]), np.zeros((span[1] - span[0], out.shape[1]))
            lib.prove(ctypes.byref(self.task), ctypes.c_long(len(part)), part.ctypes.data_as(ctypes.c_void_p), result.ctypes.data_as(ctypes.c_void_p), None, ctypes.c_long(0))
            out[span[0] : span[1]] = result

        with concurrent.futures.ThreadPoolExecutor(threads or core_count()) as pool:
            list(pool.map(one, groups))
        return Cells(out[:, 0].astype(int), out[:, 1:3], out[:, 3:5], out[:, 8 : 8 + 2 * ns : 2], out[:, 9 : 9 + 2 * ns : 2],
                     out[:, 8 + 2 * ns : 8 + 4 * ns : 2], out[:, 9 + 2 * ns : 9 + 4 * ns : 2], out[:, 8 + 4 * ns :], out[:, 5], out[:, 6], out[:, 7])

    def balance(self, centre: np.ndarray, scouts: int = 20000) -> None:
        """Choose the weights of Lohner's step along the run of the middle of the box."""
        nb = self.kept
        found = np.zeros((scouts, 2 + nb * nb))
        cell = np.ascontiguousarray(np.repeat(np.asarray(centre, float)[:, None], 2, 1))[None]
        out = np.zeros((1, 8 + 4 * len(self.signals) + len(self.equations.params)))
        count = library().prove(ctypes.byref(self.task), ctypes.c_long(1), np.ascontiguousarray(cell).ctypes.data_as(ctypes.c_void_p), out.ctypes.data_as(ctypes.c_void_p), found.ctypes.data_as(ctypes.c_void_p), ctypes.c_long(scouts))
        self.scout = found[:count].copy(), out
        found = found[:count][np.isfinite(found[:count]).all(1)]  # the first has no axes yet
        count, keys = len(found), found[:, 0]
        if self.task.speed >= 0:
            keys = np.log(np.maximum(keys, 1e-3))
        self.task.keys_low, self.task.keys_high = min(keys[0], keys[-1]), max(keys[0], keys[-1])
        window = 0.3 if self.task.speed >= 0 else 0.1 * (self.task.keys_high - self.task.keys_low)
        jacobians = np.abs(found[:count, 2:]).reshape(count, nb, nb)
        for k in range(TABLES):
            key = self.task.keys_low + (k + 0.5) / TABLES * (self.task.keys_high - self.task.keys_low)
            self.weights[k] = balance_weights(jacobians[np.abs(keys - key) < window].max(0))
            for state in self.clockwork:
                self.weights[k, state] = 2.0**20
            if self.task.speed >= 0:  # the speed drifts: an error in it matters less than the couplings of a period say
                self.weights[k, self.task.speed] = self.weights[k, self.task.nonnegative] / 8


def clockwork_states(e: Equations, states: list[int]) -> list[int]:
    """Return the states that nothing but the time and such states move: they are the same in all runs."""
    alone = set(states)
    while True:
        ends = [root for i in alone for root in (e.start[i], e.flow[i], *((e.tick[i],) if e.tick else ()))]
        read = {i: _reads(e, [e.start[i], e.flow[i], *([e.tick[i]] if e.tick else [])]) for i in alone}
        fewer = {i for i in alone if read[i][0] <= alone and not read[i][1]}
        del ends
        if fewer == alone:
            return sorted(alone)
        alone = fewer


def _reads(e: Equations, roots: list[int]) -> tuple[set[int], bool]:
    """Return the states that operations read, and whether they read a parameter."""
    found, left, seen, varies = set(), list(roots), set(), False
    while left:
        i = left.pop()
        if i in seen or i < 0:
            continue
        seen.add(i)
        if e.operations[i].name == "state":
            found.add(e.operations[i].value)
        varies |= e.operations[i].name == "param"
        left += list(e.operations[i].args)
    return found, varies


def balance_weights(matrix: np.ndarray) -> np.ndarray:
    """Return powers of two w with which diag(w) matrix diag(1/w) has rows and columns of equal norms."""
    n = len(matrix)
    w, a = np.ones(n), np.abs(np.asarray(matrix, float)) - 0.0
    np.fill_diagonal(a, 0.0)
    for _ in range(50):
        for i in range(n):
            row, column = np.linalg.norm(a[i]), np.linalg.norm(a[:, i])
            if row > 1e-12 and column > 1e-12:
                f = 2.0 ** np.round(0.5 * np.log2(column / row))
                w[i] *= f
                a[i] *= f
                a[:, i] /= f
    return w


def arrange_states(e: Equations, signals: tuple[str, ...]) -> tuple[list[int], list[int], list[int]]:
    """Return the states that a proof needs: those kept over a tick, those that a tick sets anew, and quadratures."""
    def reads(root: int) -> set[int]:
        return _reads(e, [root])[0]

    live: set[int] = reads(e.margin).union(*(reads(e.signals[s]) for s in signals))
    while True:
        more = set(live)
        for i in live:
            more |= reads(e.flow[i])
            if e.tick:
                more |= reads(e.tick[i])
        if more == live:
            break
        live = more
    quadratures = [i for i in (e.travelled, e.clock if e.paced else -1) if i >= 0 and i not in live]
    if not e.tick:
        return sorted(live), [], quadratures
    kept = set().union(*(reads(e.tick[i]) for i in live))
    kept |= reads(e.margin)
    return sorted(kept), sorted(live - kept), quadratures
