"""A saved certificate proved again, in fractions, by code that shares nothing with what made it. This file needs no
other: whoever doubts the rest can take it out, read it and run it alone.

Floats are the rationals that they are, and nothing is rounded: what is proved is about the stored matrices A, B and
everything in their hull, C = A + B K. A file's words are not believed: names of corners and states are not read, and
what a claim must contain, in which range, is part of what is checked. In discrete time V falls by factor^2 a period.

    decay       P > 0, -He(P C) - 2 rate P > 0                      infeasible  W >= 0, sum He(C W) + 2 rate W > 0
    cost        the same without a rate, and with -Q - K'RK         damping, l2, input, scheduled: as in `exact`
"""

import contextvars
import itertools
import json
import math
import operator
import os
import pathlib
import stat
import time
from collections.abc import Iterable, Iterator, Mapping
from fractions import Fraction
from typing import Any, NamedTuple

Matrix = list[list[Fraction]]
LARGEST_FILE, LARGEST_ORDER, LARGEST_SET = 2**24, 64, 2**12  # bytes; states or inputs; vertices, cells, points
LONGEST = 6.0  # s, so that the command answers within 10
_deadline: contextvars.ContextVar[tuple[float, float]] = contextvars.ContextVar(
    "deadline", default=(math.inf, math.inf)
)
SHAPES = {  # an axis a letter: n states, m inputs, V vertices, N nodes; "?" need not be there
    "decay": {"P": "nn", "rate?": "", "factor?": ""},
    "cost": {"P": "nn", "Q": "nn", "R": "mm", "x0?": "n"},
    "damping": {"P": "nn", "cot": "", "zeta": ""},
    "l2": {"P": "nn", "gamma": "", "Bw": "nw|Vnw", "C": "zn", "D": "zm"},
    "input": {"P": "nn", "limit": "m", "points": "kn"},
    "infeasible": {"W": "Vnn", "rate?": "", "factor?": ""},
    "scheduled": {"P": "Nnn", "rates": "2", "rate?": "", "Q?": "nn", "R?": "mm"},
}
RANGES = {
    "rate": ("[0, inf)", lambda x: x >= 0),
    "factor": ("(0, 1]", lambda x: 0 < x <= 1),
    "zeta": ("[0, 1)", lambda x: 0 <= x < 1),
    "cot": ("[0, inf)", lambda x: x >= 0),
    "gamma": ("(0, inf)", lambda x: x > 0),
    "limit": ("(0, inf)", lambda x: min(x) > 0),
    "rates": ("low <= high", lambda x: x[0] <= x[1]),
    "Q": ("a weight: no diagonal entry below 0", lambda x: min(row[i] for i, row in enumerate(x)) >= 0),
    "R": ("a weight: all diagonal entries above 0", lambda x: min(row[i] for i, row in enumerate(x)) > 0),
}


class Verdict(NamedTuple):
    """What a claim says, and why it is not proved; an empty reason if it is."""

    kind: str
    says: str
    reason: str


class Cell(NamedTuple):
    """Vertices A (V, n, n) and B (V, n, m)."""

    A: list[Matrix]
    B: list[Matrix]


class Stored(NamedTuple):
    """A file: cells (one, without nodes, of a polytope), the gain (or one for each node), the claims' numbers."""

    cells: list[Cell]
    nodes: list[Fraction]
    gains: list[Matrix]
    discrete: bool
    claims: list[tuple[str, dict[str, Any]]]


def verify(path: str | os.PathLike[str], seconds: float = LONGEST) -> list[Verdict]:
    """A verdict for each claim of a file.

    path: of the file; seconds: after which an undecided file is refused
    Raises ValueError, in one line that names the field, for what is no certificate: not readable, not of the format, a
    claim that does not fit its system or is outside of its range; and for one that is not decided in time.
    """
    given = _deadline.set((time.monotonic() + seconds, seconds))
    try:
        stored = _stored(_parsed(pathlib.Path(path)))
        return [Verdict(kind, _says(kind, d, stored.discrete), _reason(kind, d, stored)) for kind, d in stored.claims]
    except OSError as error:
        raise ValueError(f"cannot be read: {error.strerror or error}") from None
    except RecursionError:
        raise ValueError("is nested too deeply") from None
    except OverflowError:
        raise ValueError("has numbers whose sum is beyond the largest double") from None
    finally:
        _deadline.reset(given)


def _check_time() -> None:
    """Raises ValueError where the time for this file is over."""
    end, seconds = _deadline.get()
    if time.monotonic() > end:
        raise ValueError(
            f"is not decided within {seconds:g} s, so nothing is proved: fewer states, vertices or claims, numbers of"
            " fewer digits, or more time are needed"
        )


# The file


def _parsed(path: pathlib.Path) -> Any:
    about = path.stat()
    if not stat.S_ISREG(about.st_mode) or about.st_size > LARGEST_FILE:
        raise ValueError(f"is not a regular file of at most {LARGEST_FILE} bytes")
    try:
        return json.loads(path.read_bytes(), parse_int=float, parse_constant=_no_number, object_pairs_hook=_once)
    except UnicodeDecodeError:
        raise ValueError("is not text") from None
    except json.JSONDecodeError as error:
        raise ValueError(f"is not JSON: {error}") from None


def _no_number(word: str) -> Any:
    raise ValueError(f"{word} is not a number that can be proved anything about")


def _once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) != len(pairs):
        raise ValueError(f"a name comes twice among {', '.join(name for name, _ in pairs)[:200]}")
    return found


def _stored(value: Any) -> Stored:
    file = _members(value, "the file", "format", "version", "system", "gain", "claims")
    if file["format"] != "diffabs certificate" or file["version"] != 1.0:
        raise ValueError("format and version are not those of a diffabs certificate, 1")
    sizes: dict[str, int] = {"2": 2}
    scheduled = isinstance(file["system"], dict) and "cells" in file["system"]
    nodes, parts = _chain(file["system"], sizes) if scheduled else ([], {"system": file["system"]})
    cells, periods = zip(*(_cell(part, where, sizes) for where, part in parts.items()), strict=True)
    if len(set(periods)) != 1:
        raise ValueError("system.cells must have one period")
    tables = scheduled and _depth(file["gain"]) == 3
    gains = _tensor(file["gain"], "Nmn" if tables else "mn", sizes, "gain")
    claims = file["claims"]
    if not isinstance(claims, list) or len(claims) > LARGEST_SET:
        raise ValueError(f"claims must be a list of at most {LARGEST_SET}")
    discrete = periods[0] is not None
    read = [_claim(claim, f"claims[{i}]", sizes, discrete, scheduled) for i, claim in enumerate(claims)]
    return Stored(list(cells), nodes, gains if tables else [gains] * max(len(nodes), 1), discrete, read)


def _chain(value: Any, sizes: dict[str, int]) -> tuple[list[Fraction], dict[str, Any]]:
    """Nodes of a schedule, and its cells by name."""
    system = _members(value, "system", "parameter", "nodes", "cells")
    nodes, cells = _tensor(system["nodes"], "N", sizes, "system.nodes"), system["cells"]
    if not isinstance(cells, list) or not 0 < len(cells) == len(nodes) - 1:
        raise ValueError("system.cells must be a list of one cell between two nodes")
    if not all(a < b for a, b in itertools.pairwise(nodes)):
        raise ValueError("system.nodes must increase")
    return nodes, {f"system.cells[{i}]": cell for i, cell in enumerate(cells)}


def _cell(value: Any, where: str, sizes: dict[str, int]) -> tuple[Cell, float | None]:
    """Vertices and period."""
    part = _members(value, where, "A", "B", "period", "states", "corners")
    sizes.pop("V", None)  # each cell has its own number of vertices
    a, b = (_tensor(part[name], f"Vn{columns}", sizes, f"{where}.{name}") for name, columns in (("A", "n"), ("B", "m")))
    if max(sizes["n"], sizes["m"]) > LARGEST_ORDER:
        raise ValueError(f"{where} has more than {LARGEST_ORDER} states or inputs")
    period = part["period"]
    if period is not None and not (type(period) is float and 0 < period < math.inf):
        raise ValueError(f"{where}.period must be null or in (0, inf) s")
    return Cell(a, b), period


def _claim(
    value: Any, where: str, sizes: dict[str, int], discrete: bool, scheduled: bool
) -> tuple[str, dict[str, Any]]:
    claim = _members(value, where, "kind", "data")
    kind, data = claim["kind"], claim["data"]
    if not isinstance(kind, str) or kind not in SHAPES or not isinstance(data, dict):
        raise ValueError(f"{where} needs a kind, one of {', '.join(SHAPES)}, and data")
    if (kind == "scheduled") != scheduled or (discrete and kind in ("damping", "scheduled")):
        raise ValueError(f"{where}: a claim of kind {kind} does not fit the system")
    fields = {name.rstrip("?"): shape for name, shape in SHAPES[kind].items()}
    fields.pop("rate" if discrete else "factor", None)
    needed = {name for name in fields if name in SHAPES[kind]}
    for name in sorted((set(data) - set(fields)) | (needed - set(data))):
        word = "not a field of" if name in data else "missing in"
        raise ValueError(f"{where}.data.{name} is {word} a claim of kind {kind}")
    found, own = {}, dict(sizes)
    for name, given in data.items():
        shapes = [shape for shape in fields[name].split("|") if len(shape) == _depth(given)]
        found[name] = _tensor(given, (shapes or fields[name].split("|"))[0], own, f"{where}.data.{name}")
        says, holds = RANGES.get(name, ("", lambda _: True))
        if kind != "infeasible" and not holds(found[name]):
            raise ValueError(f"{where}.data.{name} is outside {says}")
    return kind, found


def _members(value: Any, where: str, *names: str) -> dict[str, Any]:
    if not isinstance(value, dict) or set(value) != set(names):
        raise ValueError(f"{where} must have the members {', '.join(names)} and no other")
    return value


def _depth(value: Any) -> int:
    return 1 + _depth(value[0]) if isinstance(value, list) and value else 0


def _tensor(value: Any, letters: str, sizes: dict[str, int], where: str) -> Any:
    """Fractions in nested lists whose axes have the sizes of the letters; one not seen yet gets its size."""
    if not letters:
        if type(value) is not float or not math.isfinite(value):
            raise ValueError(f"{where} must be a finite number")
        return Fraction(value)
    if not isinstance(value, list) or not 0 < len(value) <= LARGEST_SET:
        raise ValueError(f"{where} must be a list of 1 to {LARGEST_SET}")
    _check_time()
    if len(value) != sizes.setdefault(letters[0], len(value)):
        raise ValueError(f"{where} has {len(value)} entries; {sizes[letters[0]]} are needed")
    return [_tensor(each, letters[1:], sizes, f"{where}[{i}]") for i, each in enumerate(value)]


# The checker


def mul(*factors: Matrix) -> Matrix:
    """A B ..., each product in integers over a common denominator."""
    a, *rest = factors
    for b in rest:
        (rows, below), (columns, under) = _integers(a), _integers(turned(b))
        a = [[_quotient(map(operator.mul, row, column), below * under) for column in columns] for row in rows]
    return a


def _integers(m: Matrix) -> tuple[list[list[int]], int]:
    """M times the common denominator of its entries, and that."""
    below = math.lcm(*(x.denominator for row in m for x in row))
    return [[x.numerator * (below // x.denominator) for x in row] for row in m], below


def _quotient(terms: Iterable[int], below: int) -> Fraction:
    _check_time()
    return Fraction(sum(terms), below)


def turned(a: Matrix) -> Matrix:
    """A'."""
    return [list(row) for row in zip(*a, strict=True)]


def add(*terms: tuple[Any, Matrix]) -> Matrix:
    """Sum of number times matrix."""
    first = terms[0][1]
    return [[sum((k * m[i][j] for k, m in terms), Fraction(0)) for j in range(len(row))] for i, row in enumerate(first)]


def he(a: Matrix) -> Matrix:
    """A + A'."""
    return add((1, a), (1, turned(a)))


def unit(n: int) -> Matrix:
    """I."""
    return [[Fraction(int(i == j)) for j in range(n)] for i in range(n)]


def block(a: Matrix, b: Matrix, d: Matrix) -> Matrix:
    """[[A, B], [B', D]]."""
    return [[*x, *y] for x, y in zip(a, b, strict=True)] + [[*x, *y] for x, y in zip(turned(b), d, strict=True)]


def positive(m: Matrix, semi: bool = False) -> bool:
    """Whether M is symmetric and its pivots positive; of a semidefinite matrix, a zero pivot's row is zero.

    Elimination in integers (Bareiss, 1968): `rows` are those of the upper triangle, every entry a minor of M times the
    common denominator, so divisions leave no rest, and no number grows beyond a minor."""
    if m != turned(m):
        return False
    whole, last = _integers(m)[0], 1
    rows = [row[i:] for i, row in enumerate(whole)]
    while rows:
        (pivot, *row), *rows = rows
        if pivot < 0 or (pivot == 0 and (any(row) or not semi)):
            return False
        if pivot:
            rows = [_eliminated(pivot, a, row[i:], r, last) for i, (a, r) in enumerate(zip(row, rows, strict=True))]
            last = pivot
    return True


def _eliminated(pivot: int, first: int, above: list[int], row: list[int], last: int) -> list[int]:
    _check_time()
    return [(pivot * x - first * y) // last for x, y in zip(row, above, strict=True)]


def _reason(kind: str, d: Mapping[str, Any], stored: Stored) -> str:
    """The first inequality that does not hold; empty if all do."""
    if kind == "scheduled":
        conditions = _of_schedule(d, stored)
    else:
        cell, k = stored.cells[0], stored.gains[0]
        loops = [add((1, a), (1, mul(b, k))) for a, b in zip(cell.A, cell.B, strict=True)]
        conditions = _of_none(d, loops, stored.discrete) if kind == "infeasible" else _of_one(kind, d, loops, k, stored)
    return next((f"{words} is not positive definite" for words, holds in conditions if not holds), "")


def _falls(p: Matrix, c: Matrix, d: Mapping[str, Any], discrete: bool) -> Matrix:
    """-V' - 2 rate V for V = x'Px, or factor^2 V - V+."""
    if discrete:
        return add((d.get("factor", 1) ** 2, p), (-1, mul(turned(c), p, c)))
    return add((-1, he(mul(p, c))), (-2 * d.get("rate", 0), p))


def _of_none(d: Mapping[str, Any], loops: list[Matrix], discrete: bool) -> Iterator[tuple[str, bool]]:
    """That no P > 0 decreases at all vertices: it would have 0 >= sum tr(W He(P C)) = tr(P sum He(C W)) > 0."""
    yield "W", all(positive(w, semi=True) for w in d["W"])
    yield (
        "the sum over the vertices",
        positive(add(*((-1, _falls(w, turned(c), d, discrete)) for w, c in zip(d["W"], loops, strict=True)))),
    )


def _of_one(
    kind: str, d: Mapping[str, Any], loops: list[Matrix], k: Matrix, stored: Stored
) -> Iterator[tuple[str, bool]]:
    """What a claim about one P says, vertex by vertex."""
    p, discrete = d["P"], stored.discrete
    yield "P", positive(p)
    for i, c in enumerate(loops):
        falls = _falls(p, c, d, discrete)
        yield f"vertex {i}: what V falls by", positive(falls)
        if kind == "cost":
            spent = (-1, d["Q"]), (-1, mul(turned(k), d["R"], k))
            yield f"vertex {i}: what V falls by beyond the cost", positive(add((1, falls), *spent))
        if kind == "damping":
            m = mul(p, c)
            skew = add((-d["cot"], m), (d["cot"], turned(m)))
            yield f"vertex {i}: the cone of the damping", positive(block(falls, skew, falls))
        if kind == "l2":
            w = d["Bw"] if isinstance(d["Bw"][0][0], Fraction) else d["Bw"][i]
            yield f"vertex {i}: what is left of the gain", positive(_gain(p, c, w, falls, d, k, discrete))
    if kind == "damping":
        yield "cot^2 (1 - zeta^2) - zeta^2", d["cot"] ** 2 * (1 - d["zeta"] ** 2) >= d["zeta"] ** 2
    if kind == "input":
        yield "1 - x'Px at the points", all(mul([x], p, turned([x]))[0][0] <= 1 for x in d["points"])
        for row, limit in zip(k, d["limit"], strict=True):
            yield "what is left of the input's limit", positive(block(p, turned([row]), [[limit**2]]))


def _gain(p: Matrix, c: Matrix, w: Matrix, falls: Matrix, d: Mapping[str, Any], k: Matrix, discrete: bool) -> Matrix:
    """-V' - |z|^2 + gamma^2 |w|^2 as a matrix of (x, w)."""
    z = add((1, d["C"]), (1, mul(d["D"], k)))
    supply = add((d["gamma"] ** 2, unit(len(w[0]))), *([(-1, mul(turned(w), p, w))] if discrete else []))
    cross = mul(turned(c), p, w) if discrete else mul(p, w)
    return block(add((1, falls), (-1, mul(turned(z), z))), add((-1, cross)), supply)


def _of_schedule(d: Mapping[str, Any], stored: Stored) -> Iterator[tuple[str, bool]]:
    """P(p) > 0 at the nodes, and in every cell the Bernstein coefficients of -V' - ..., times its width."""
    rate, nodes, p, k = d.get("rate", 0), stored.nodes, d["P"], stored.gains
    yield "P", all(map(positive, p))
    for i, cell in enumerate(stored.cells):
        width, moved = nodes[i + 1] - nodes[i], add((1, p[i + 1]), (-1, p[i]))
        for a, b in zip(cell.A, cell.B, strict=True):
            ends = [(p[j], add((1, a), (1, mul(b, k[j]))), k[j]) for j in (i, i + 1)]
            for (px, cx, kx), (py, cy, ky) in ((ends[0], ends[0]), (ends[0], ends[1]), (ends[1], ends[1])):
                flow = he(add((1, mul(px, cy)), (1, mul(py, cx))))
                falls = add((-width / 2, flow), (-rate * width, px), (-rate * width, py))
                spent = [(-width, d["Q"])] if "Q" in d else []
                spent += [(-width / 2, he(mul(turned(kx), d["R"], ky)))] if "R" in d else []
                for speed in d["rates"]:
                    left = add((1, falls), (-speed, moved))
                    holds = positive(left) and (not spent or positive(add((1, left), *spent)))
                    yield f"cell {i}: what V falls by", holds


def _says(kind: str, d: Mapping[str, Any], discrete: bool) -> str:
    """A claim in words, with its own numbers."""
    number = {name: float(value) for name, value in d.items() if isinstance(value, Fraction)}
    pace = f"{number.get('rate', 0.0):.9g} 1/s"
    if discrete:
        pace = f"{number.get('factor', 1.0):.9g} a period"
    if kind == "infeasible":
        some = number.get("factor", 1.0) < 1 if discrete else number.get("rate", 0.0) > 0
        return f"no common Lyapunov matrix {f'proves a decay of {pace}' if some else 'exists'}"
    if kind == "cost":
        return f"the cost from x is at most x'Px, trace P = {float(sum(row[i] for i, row in enumerate(d['P']))):.9g}"
    if kind == "scheduled":
        low, high = (f"{float(rate):.9g}" for rate in d["rates"])
        return f"stable, with a decay of at least {pace}, while the parameter moves at {low} to {high} a second"
    return {
        "decay": f"stable, with a decay of at least {pace}, however the system varies",
        "damping": f"every fixed system is damped by {number.get('zeta', 0.0):.9g} or more",
        "l2": f"the L2 gain is below {number.get('gamma', 0.0):.9g}",
        "input": "the input stays within its limits from the hull of the points",
    }[kind]
