"""An independent checker of saved certificates, in fractions, without any code that made them.

The file imports only the standard library: it can be read and run on its own.

Every float is the rational number that it represents, and nothing is rounded. The proof holds for the stored matrices
A, B and everything in their hull, with C = A + B K.

The checker trusts no text of a file: it does not read the names of corners and states. It also checks the fields of a
claim and their ranges. In discrete time V falls by factor^2 a period.

    decay       P > 0, -He(P C) - 2 rate P > 0                      infeasible  W >= 0, sum He(C W) + 2 rate W > 0
    unstable    x'P x < 0, -He(P C) - 2 rate P >= 0 at a vertex
    cost        decay without a rate, and with -Q - K'RK            damping, l2, input, scheduled: see `proof.exact`
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
from typing import Any, NamedTuple, NoReturn

Matrix = list[list[Fraction]]
# Limits of a file: bytes; states or inputs; vertices, cells or points.
MAX_CERTIFICATE_BYTES, MAX_STATES_OR_INPUTS, MAX_LIST_ENTRIES = 2**24, 64, 2**12
MAX_STATED_NUMBERS = 64  # of a matrix in a statement; of a larger one the statement shows the sizes
MAX_SECONDS = 6.0  # s, so that the command answers within 10 s
_deadline: contextvars.ContextVar[tuple[float, float]] = contextvars.ContextVar(
    "deadline", default=(math.inf, math.inf)
)
# A letter for each axis: n states, m inputs, V vertices, N nodes, others free; "|" separates alternatives. A field with
# "?" is optional.
FIELD_SHAPES = {
    "decay": {"P": "nn", "rate?": "", "factor?": ""},
    "cost": {"P": "nn", "Q": "nn", "R": "mm", "x0?": "n"},
    "damping": {"P": "nn", "cot": "", "zeta": ""},
    "l2": {"P": "nn", "gamma": "", "Bw": "nw|Vnw", "C": "zn", "D": "zm"},
    "input": {"P": "nn", "limit": "m", "points": "kn"},
    "infeasible": {"W": "Vnn", "rate?": "", "factor?": ""},
    "unstable": {"P": "nn", "x": "n", "vertex": "", "rate?": "", "factor?": ""},
    "scheduled": {"P": "Nnn", "rates": "2", "rate?": "", "Q?": "nn", "R?": "mm"},
}
FIELD_RANGES = {
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


DISPROOF_KINDS = ("infeasible", "unstable")  # they may also concern growth: a negative rate or a factor above 1


class ClaimVerdict(NamedTuple):
    """The verdict about one claim.

    Attributes:
        kind: Kind of the claim.
        says: Statement of the claim, in words.
        reason: Reason why it is not proved; empty if it is proved.
    """

    kind: str
    says: str
    reason: str


class Cell(NamedTuple):
    """Vertices A (V, n, n) and B (V, n, m)."""

    A: list[Matrix]
    B: list[Matrix]


class StoredCertificate(NamedTuple):
    """The content of a certificate file.

    Attributes:
        cells: Cells of a schedule; a polytope is one cell.
        nodes: Nodes of a schedule; empty for a polytope.
        gains: Gain at each node; one gain for a polytope.
        discrete: Whether the system is in discrete time.
        claims: Kind and data of each claim.
    """

    cells: list[Cell]
    nodes: list[Fraction]
    gains: list[Matrix]
    discrete: bool
    claims: list[tuple[str, dict[str, Any]]]


def verify_file(path: str | os.PathLike[str], seconds: float = MAX_SECONDS) -> list[ClaimVerdict]:
    """Return a verdict for each claim of a certificate file, in its order; one that is not proved has the reason.

    A file that is not decided within `seconds` is refused with ValueError.
    """
    # A context variable carries the deadline through the recursion, and keeps calls in other threads apart.
    token = _deadline.set((time.monotonic() + seconds, seconds))
    try:
        stored = _certificate_from_json(_read_json(pathlib.Path(path)))
        return [
            ClaimVerdict(kind, _describe_claim(kind, d, stored.discrete), _failed_inequality(kind, d, stored))
            for kind, d in stored.claims
        ]
    except OSError as error:
        raise ValueError(f"cannot be read: {error.strerror or error}") from None
    except RecursionError:
        raise ValueError("is nested too deeply") from None
    except OverflowError:
        raise ValueError("has numbers whose sum is beyond the largest double") from None
    finally:
        _deadline.reset(token)


def _check_time() -> None:
    end, seconds = _deadline.get()
    if time.monotonic() > end:
        raise ValueError(
            f"is not decided within {seconds:g} s, so nothing is proved: fewer states, vertices or claims, numbers of"
            " fewer digits, or more time are needed"
        )


# The file


def _read_json(path: pathlib.Path) -> Any:
    about = path.stat()
    if not stat.S_ISREG(about.st_mode) or about.st_size > MAX_CERTIFICATE_BYTES:
        raise ValueError(f"is not a regular file of at most {MAX_CERTIFICATE_BYTES} bytes")
    try:
        return json.loads(
            path.read_bytes(),
            # Integers become floats: a certificate holds doubles only, and a long integer costs no time.
            parse_int=float,
            parse_constant=_reject_constant,
            # json.loads keeps the last of two equal names; another reader may keep the first and see another claim.
            object_pairs_hook=_reject_duplicate_names,
        )
    except UnicodeDecodeError:
        raise ValueError("is not text") from None
    except json.JSONDecodeError as error:
        raise ValueError(f"is not JSON: {error}") from None


def _reject_constant(word: str) -> NoReturn:
    raise ValueError(f"{word} is not a number that can be proved anything about")


def _reject_duplicate_names(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    members = dict(pairs)
    if len(members) != len(pairs):
        raise ValueError(f"a name comes twice among {', '.join(name for name, _ in pairs)[:200]}")
    return members


def _certificate_from_json(value: object) -> StoredCertificate:
    file = _read_members(value, "the file", "format", "version", "system", "gain", "claims")
    for name, needed in (("format", "diffabs certificate"), ("version", 1.0)):
        if type(file[name]) is not type(needed) or file[name] != needed:
            raise ValueError(f"{name} = {json.dumps(file[name])[:60]}; {json.dumps(needed)} is needed")
    sizes: dict[str, int] = {"2": 2}
    scheduled = isinstance(file["system"], dict) and "cells" in file["system"]
    nodes, parts = [], {"system": file["system"]}
    if scheduled:
        system = _read_members(file["system"], "system", "parameter", "nodes", "cells")
        nodes, listed = _read_tensor(system["nodes"], "N", sizes, "system.nodes"), system["cells"]
        if not isinstance(listed, list) or not 0 < len(listed) == len(nodes) - 1:
            raise ValueError("system.cells must be a list of one cell between two nodes")
        if not all(a < b for a, b in itertools.pairwise(nodes)):
            raise ValueError("system.nodes must increase")
        parts = {f"system.cells[{i}]": cell for i, cell in enumerate(listed)}
    cells, periods = zip(*(_read_cell(part, where, sizes) for where, part in parts.items()), strict=True)
    if len(set(periods)) != 1:
        raise ValueError("system.cells must have one period")
    tables = scheduled and _depth(file["gain"]) == 3
    gains = _read_tensor(file["gain"], "Nmn" if tables else "mn", sizes, "gain")
    claims = file["claims"]
    if not isinstance(claims, list) or len(claims) > MAX_LIST_ENTRIES:
        raise ValueError(f"claims must be a list of at most {MAX_LIST_ENTRIES}")
    discrete = periods[0] is not None
    read = [_read_claim(claim, f"claims[{i}]", sizes, discrete, scheduled) for i, claim in enumerate(claims)]
    return StoredCertificate(list(cells), nodes, gains if tables else [gains] * max(len(nodes), 1), discrete, read)


def _read_cell(value: object, where: str, sizes: dict[str, int]) -> tuple[Cell, float | None]:
    part = _read_members(value, where, "A", "B", "period", "states", "corners")
    sizes.pop("V", None)  # every cell has its own number of vertices
    a, b = (
        _read_tensor(part[name], f"Vn{columns}", sizes, f"{where}.{name}") for name, columns in (("A", "n"), ("B", "m"))
    )
    if max(sizes["n"], sizes["m"]) > MAX_STATES_OR_INPUTS:
        raise ValueError(f"{where} has more than {MAX_STATES_OR_INPUTS} states or inputs")
    period = part["period"]
    if period is not None and not (type(period) is float and 0 < period < math.inf):
        raise ValueError(f"{where}.period must be null or in (0, inf) s")
    return Cell(a, b), period


def _read_claim(
    value: object, where: str, sizes: dict[str, int], discrete: bool, scheduled: bool
) -> tuple[str, dict[str, Any]]:
    claim = _read_members(value, where, "kind", "data")
    kind, data = claim["kind"], claim["data"]
    if not isinstance(kind, str) or kind not in FIELD_SHAPES or not isinstance(data, dict):
        raise ValueError(f"{where} needs a kind, one of {', '.join(FIELD_SHAPES)}, and data")
    if (kind == "scheduled") != scheduled or (discrete and kind in ("damping", "scheduled")):
        raise ValueError(f"{where}: a claim of kind {kind} does not fit the system")
    fields = {name.rstrip("?"): shape for name, shape in FIELD_SHAPES[kind].items()}
    # A claim has a rate in continuous time and a factor in discrete time, never both.
    fields.pop("rate" if discrete else "factor", None)
    needed = {name for name in fields if name in FIELD_SHAPES[kind]}
    for name in sorted((set(data) - set(fields)) | (needed - set(data))):
        word = "not a field of" if name in data else "missing in"
        raise ValueError(f"{where}.data.{name} is {word} a claim of kind {kind}")
    tensors, letter_sizes = {}, dict(sizes)
    for name, entry in data.items():
        shapes = [shape for shape in fields[name].split("|") if len(shape) == _depth(entry)]
        tensors[name] = _read_tensor(
            entry, (shapes or fields[name].split("|"))[0], letter_sizes, f"{where}.data.{name}"
        )
        says, holds = FIELD_RANGES.get(name, ("", lambda _: True))
        if kind not in DISPROOF_KINDS and not holds(tensors[name]):
            raise ValueError(f"{where}.data.{name} is outside {says}")
    if kind == "unstable" and tensors["vertex"] not in range(sizes["V"]):
        raise ValueError(f"{where}.data.vertex is outside 0 to {sizes['V'] - 1}")
    if any(x <= 0 for name, x in tensors.items() if name == "factor"):
        raise ValueError(f"{where}.data.factor is outside (0, inf)")
    return kind, tensors


def _read_members(value: object, where: str, *names: str) -> dict[str, Any]:
    if not isinstance(value, dict) or set(value) != set(names):
        raise ValueError(f"{where} must have the members {', '.join(names)} and no other")
    return value


def _depth(value: object) -> int:
    return 1 + _depth(value[0]) if isinstance(value, list) and value else 0


def _read_tensor(value: object, letters: str, sizes: dict[str, int], where: str) -> Any:
    """Return fractions in nested lists whose axes have the sizes of the letters; a new letter gets its size here."""
    if not letters:
        if type(value) is not float or not math.isfinite(value):
            raise ValueError(f"{where} must be a finite number")
        return Fraction(value)
    if not isinstance(value, list) or not 0 < len(value) <= MAX_LIST_ENTRIES:
        raise ValueError(f"{where} must be a list of 1 to {MAX_LIST_ENTRIES}")
    _check_time()
    if len(value) != sizes.setdefault(letters[0], len(value)):
        raise ValueError(f"{where} has {len(value)} entries; {sizes[letters[0]]} are needed")
    return [_read_tensor(each, letters[1:], sizes, f"{where}[{i}]") for i, each in enumerate(value)]


# The checker


def multiply_matrices(*factors: Matrix) -> Matrix:
    """Return the product of matrices, each product in integers over a common denominator."""
    a, *followers = factors
    for b in followers:
        (rows, below), (columns, under) = _integers(a), _integers(transpose_matrix(b))
        a = [[_quotient(map(operator.mul, row, column), below * under) for column in columns] for row in rows]
    return a


def _integers(m: Matrix) -> tuple[list[list[int]], int]:
    """Return M times the common denominator of its entries, and that denominator."""
    below = math.lcm(*(x.denominator for row in m for x in row))
    return [[x.numerator * (below // x.denominator) for x in row] for row in m], below


def _quotient(terms: Iterable[int], below: int) -> Fraction:
    _check_time()
    return Fraction(sum(terms), below)


def transpose_matrix(a: Matrix) -> Matrix:
    """Return A'."""
    return [list(row) for row in zip(*a, strict=True)]


def weighted_sum(*terms: tuple[Any, Matrix]) -> Matrix:
    """Return the sum of number times matrix over pairs of them."""
    first = terms[0][1]
    return [[sum((k * m[i][j] for k, m in terms), Fraction(0)) for j in range(len(row))] for i, row in enumerate(first)]


def he(a: Matrix) -> Matrix:
    """Return A + A'."""
    return weighted_sum((1, a), (1, transpose_matrix(a)))


def identity_matrix(n: int) -> Matrix:
    """Return the unit matrix I of size n."""
    return [[Fraction(int(i == j)) for j in range(n)] for i in range(n)]


def bordered_matrix(a: Matrix, b: Matrix, d: Matrix) -> Matrix:
    """Return [[A, B], [B', D]]."""
    return [[*x, *y] for x, y in zip(a, b, strict=True)] + [
        [*x, *y] for x, y in zip(transpose_matrix(b), d, strict=True)
    ]


def is_positive_definite(m: Matrix, semi: bool = False) -> bool:
    """Return whether M is symmetric and positive definite: all its pivots are positive.

    The method is elimination in integers (Bareiss, 1968) on the upper triangle. Every entry is a minor of M times the
    common denominator. Divisions therefore leave no remainder, and no number grows beyond a minor. With `semi` a zero
    pivot needs a zero row.
    """
    if m != transpose_matrix(m):
        return False
    whole, last = _integers(m)[0], 1
    rows = [row[i:] for i, row in enumerate(whole)]
    while rows:
        (pivot, *row), *rows = rows
        if pivot < 0 or (pivot == 0 and (any(row) or not semi)):
            return False
        if pivot:
            for i, first in enumerate(row):
                _check_time()
                rows[i] = [(pivot * x - first * y) // last for x, y in zip(rows[i], row[i:], strict=True)]
            last = pivot
    return True


def _failed_inequality(kind: str, d: Mapping[str, Any], stored: StoredCertificate) -> str:
    """Return the first inequality that does not hold; empty if all hold."""
    if kind == "scheduled":
        conditions = _schedule_conditions(d, stored)
    else:
        cell, k = stored.cells[0], stored.gains[0]
        loops = [weighted_sum((1, a), (1, multiply_matrices(b, k))) for a, b in zip(cell.A, cell.B, strict=True)]
        conditions = (
            _infeasibility_conditions(d, loops, stored.discrete)
            if kind == "infeasible"
            else _instability_conditions(d, loops, stored.discrete)
            if kind == "unstable"
            else _quadratic_conditions(kind, d, loops, k, stored)
        )
    return next((f"{words} is not positive definite" for words, holds in conditions if not holds), "")


def _decrease_matrix(p: Matrix, c: Matrix, d: Mapping[str, Any], discrete: bool) -> Matrix:
    """Return -V' - 2 rate V for V = x'Px, or factor^2 V - V+."""
    if discrete:
        return weighted_sum((d.get("factor", 1) ** 2, p), (-1, multiply_matrices(transpose_matrix(c), p, c)))
    return weighted_sum((-1, he(multiply_matrices(p, c))), (-2 * d.get("rate", 0), p))


def _infeasibility_conditions(d: Mapping[str, Any], loops: list[Matrix], discrete: bool) -> Iterator[tuple[str, bool]]:
    """Yield the conditions that no P > 0 decreases at all vertices.

    Such a P gives the contradiction 0 >= sum tr(W He(P C)) = tr(P sum He(C W)) > 0.
    """
    yield "W", all(is_positive_definite(w, semi=True) for w in d["W"])
    yield (
        "the sum over the vertices",
        is_positive_definite(
            weighted_sum(
                *(
                    # _decrease_matrix with C' in place of C gives -He(C W) - 2 rate W, or factor^2 W - C W C': the same
                    # code for the dual.
                    (-1, _decrease_matrix(w, transpose_matrix(c), d, discrete))
                    for w, c in zip(d["W"], loops, strict=True)
                )
            )
        ),
    )


def _instability_conditions(d: Mapping[str, Any], loops: list[Matrix], discrete: bool) -> Iterator[tuple[str, bool]]:
    """Yield the conditions that one loop does not fall faster than the rate: V falls, and is negative at x."""
    vertex = int(d["vertex"])
    falls = _decrease_matrix(d["P"], loops[vertex], d, discrete)
    yield "-x'Px", multiply_matrices([d["x"]], d["P"], transpose_matrix([d["x"]]))[0][0] < 0
    yield f"vertex {vertex}: what V falls by", is_positive_definite(falls, semi=True)


def _quadratic_conditions(
    kind: str, d: Mapping[str, Any], loops: list[Matrix], k: Matrix, stored: StoredCertificate
) -> Iterator[tuple[str, bool]]:
    p, discrete = d["P"], stored.discrete
    yield "P", is_positive_definite(p)
    for i, c in enumerate(loops):
        falls = _decrease_matrix(p, c, d, discrete)
        # V also has to fall without the cost: then V -> 0, and the bound needs no sign of Q.
        yield f"vertex {i}: what V falls by", is_positive_definite(falls)
        if kind == "cost":
            spent = (-1, d["Q"]), (-1, multiply_matrices(transpose_matrix(k), d["R"], k))
            yield f"vertex {i}: what V falls by beyond the cost", is_positive_definite(weighted_sum((1, falls), *spent))
        if kind == "damping":
            m = multiply_matrices(p, c)
            # M + M' and cot (M - M') describe the cone of the poles (Chilali and Gahinet 1996).
            skew = weighted_sum((-d["cot"], m), (d["cot"], transpose_matrix(m)))
            yield f"vertex {i}: the cone of the damping", is_positive_definite(bordered_matrix(falls, skew, falls))
        if kind == "l2":
            # -V' - |z|^2 + gamma^2 |w|^2 as a matrix of (x, w).
            bw = d["Bw"] if isinstance(d["Bw"][0][0], Fraction) else d["Bw"][i]
            z = weighted_sum((1, d["C"]), (1, multiply_matrices(d["D"], k)))
            reserve = weighted_sum((1, falls), (-1, multiply_matrices(transpose_matrix(z), z)))
            supply = weighted_sum((d["gamma"] ** 2, identity_matrix(len(bw[0]))))
            cross = multiply_matrices(p, bw)
            if discrete:
                cross = multiply_matrices(transpose_matrix(c), cross)
                supply = weighted_sum((1, supply), (-1, multiply_matrices(transpose_matrix(bw), p, bw)))
            matrix = bordered_matrix(reserve, weighted_sum((-1, cross)), supply)
            yield f"vertex {i}: what is left of the gain", is_positive_definite(matrix)
    if kind == "damping":
        yield "cot^2 (1 - zeta^2) - zeta^2", d["cot"] ** 2 * (1 - d["zeta"] ** 2) >= d["zeta"] ** 2
    if kind == "input":
        yield (
            "1 - x'Px at the points",
            all(multiply_matrices([x], p, transpose_matrix([x]))[0][0] <= 1 for x in d["points"]),
        )
        for row, limit in zip(k, d["limit"], strict=True):
            yield (
                "what is left of the input's limit",
                is_positive_definite(bordered_matrix(p, transpose_matrix([row]), [[limit**2]])),
            )


def _schedule_conditions(d: Mapping[str, Any], stored: StoredCertificate) -> Iterator[tuple[str, bool]]:
    """Yield P(p) > 0 at the nodes, and the Bernstein coefficients of -V' - ... times the width of each cell."""
    rate, nodes, p, k = d.get("rate", 0), stored.nodes, d["P"], stored.gains
    yield "P", all(map(is_positive_definite, p))
    for i, cell in enumerate(stored.cells):
        width, moved = nodes[i + 1] - nodes[i], weighted_sum((1, p[i + 1]), (-1, p[i]))
        for a, b in zip(cell.A, cell.B, strict=True):
            ends = [(p[j], weighted_sum((1, a), (1, multiply_matrices(b, k[j]))), k[j]) for j in (i, i + 1)]
            for (px, cx, kx), (py, cy, ky) in ((ends[0], ends[0]), (ends[0], ends[1]), (ends[1], ends[1])):
                # Twice the coefficient: (X_a Y_b + X_b Y_a)/2 for a product of linear functions, which covers both ends
                # with X = Y.
                flow = he(weighted_sum((1, multiply_matrices(px, cy)), (1, multiply_matrices(py, cx))))
                falls = weighted_sum((-width / 2, flow), (-rate * width, px), (-rate * width, py))
                spent = [(-width, d["Q"])] if "Q" in d else []
                # Both orders: he() of one of them would hide that R is not symmetric.
                for x, y in ((kx, ky), (ky, kx)) if "R" in d else ():
                    spent.append((-width / 2, multiply_matrices(transpose_matrix(x), d["R"], y)))
                for speed in d["rates"]:
                    decrease = weighted_sum((1, falls), (-speed, moved))
                    holds = is_positive_definite(decrease) and (
                        not spent or is_positive_definite(weighted_sum((1, decrease), *spent))
                    )
                    yield f"cell {i}: what V falls by", holds


def _describe_claim(kind: str, d: Mapping[str, Any], discrete: bool) -> str:
    """Return the statement of a claim in words; its numbers keep all digits, as a rounded bound may be no bound."""
    rate, factor = _format_numbers(d.get("rate", 0)), _format_numbers(d.get("factor", 1))
    pace = f"{factor} a period" if discrete else f"{rate} 1/s"
    weights = ", ".join(_describe_numbers(name, d[name]) for name in ("Q", "R") if name in d)
    if kind == "unstable":
        return f"vertex {_format_numbers(d['vertex'])} alone does not decay by {pace} or faster"
    if kind == "infeasible":
        some = d.get("factor", 1) < 1 if discrete else d.get("rate", 0) > 0
        return f"no common Lyapunov matrix {f'proves a decay of {pace}' if some else 'exists'}"
    if kind == "cost":
        trace = f"{float(sum(row[i] for i, row in enumerate(d['P']))):.9g}"
        return f"the cost from x is at most x'Px, trace P about {trace}, for {weights}"
    if kind == "scheduled":
        low, high = map(_format_numbers, d["rates"])
        cost = f", and the cost from x is at most x'P(p)x for {weights}" if weights else ""
        moves = f"while the parameter p stays within the nodes and moves at {low} to {high} a second"
        return f"stable, with a decay of at least {pace}, {moves}{cost}"
    if kind == "l2":
        matrices = ", ".join(_describe_numbers(name, d[name]) for name in ("Bw", "C", "D"))
        gain = f"the L2 gain from w to C x + D u is below {_format_numbers(d['gamma'])}"
        return f"{gain}, where Bw w acts on the states: {matrices}"
    if kind == "input":
        limits, starts = _describe_numbers("limit", d["limit"]), _describe_numbers("points", d["points"])
        return f"each |u| stays below its limit from every start in the hull of the points: {limits}, {starts}"
    if kind == "damping":
        return f"every fixed system is damped by {_format_numbers(d['zeta'])} or more"
    return f"stable, with a decay of at least {pace}, however the system varies"


def _describe_numbers(name: str, value: object) -> str:
    """Return the name and the entries of nested lists, or their sizes if the entries are many."""
    sizes, part = [], value
    while isinstance(part, list):
        sizes.append(len(part))
        part = part[0]
    if math.prod(sizes) > MAX_STATED_NUMBERS:
        return f"{name} of the file ({' by '.join(map(str, sizes))})"
    return f"{name} = {_format_numbers(value)}"


def _format_numbers(value: Any) -> str:
    if isinstance(value, list):
        return f"[{', '.join(map(_format_numbers, value))}]"
    return repr(float(value)).removesuffix(".0")
