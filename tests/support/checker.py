"""Prove the claims of a saved certificate again, with fractions only: python tests/support/checker.py FILE.json

Shares nothing with the package; `diffabs.robust.design.proof.exact` says what the claims mean. Floats are the rationals
that they are; entries of A, B and Bw may be off by a relative 2^-40: `Matrix` carries such errors along. Says what was
proved; exits with 0 if all was, 1 if something was not, 2 if the file cannot be read.
"""

import json
import sys
from fractions import Fraction
from typing import Any

# a letter for each axis: n states, m inputs, V vertices, N nodes, 2 itself; "?" need not be there
FIELDS = {"decay": "P:nn rate?: factor?:", "cost": "P:nn Q:nn R:mm x0?:n", "damping": "P:nn cot: zeta:"}
FIELDS |= {"l2": "P:nn gamma: Bw:nw|Vnw C:zn D:zm", "input": "P:nn limit:m points:kn"}
FIELDS |= {"unstable": "P:nn x:n vertex: rate?: factor?:"}
FIELDS |= {"infeasible": "W:Vnn rate?: factor?:", "scheduled": "P:Nnn rates:2 rate?: Q?:nn R?:mm"}
RANGES = {"rate": lambda x: x >= 0, "factor": lambda x: 0 < x <= 1, "zeta": lambda x: 0 <= x < 1}
RANGES |= {"cot": lambda x: x >= 0, "gamma": lambda x: x > 0, "limit": lambda x: min(x) > 0}
RANGES |= {"rates": lambda x: x[0] <= x[1]}


class Matrix(list):
    """Rows of pairs: a number and how far it may be off."""

    T = property(lambda self: Matrix([list(column) for column in zip(*self, strict=True)]))

    def __add__(self, other):
        pairs = [zip(x, y, strict=True) for x, y in zip(self, other, strict=True)]
        return Matrix([[(a + b, da + db) for (a, da), (b, db) in row] for row in pairs])

    def __rmul__(self, k):
        return Matrix([[(k * a, abs(k) * da) for a, da in row] for row in self])

    def __neg__(self):
        return -1 * self

    def __sub__(self, other):
        return self + -other

    def __matmul__(self, other):
        return Matrix([[dot(row, column) for column in other.T] for row in self])


def dot(x, y):
    """Sum of products, and of their errors."""
    pairs = [(a * b, abs(a) * db + da * abs(b) + da * db) for (a, da), (b, db) in zip(x, y, strict=True)]
    return sum(p for p, _ in pairs), sum(e for _, e in pairs)


def numbers(value) -> Any:
    """Fractions of the floats in nested lists. Raises ValueError for anything else."""
    if not isinstance(value, (list, float)):
        raise ValueError(f"{value!r} is not a number")
    return Fraction(value) if isinstance(value, float) else [numbers(each) for each in value]


def matrix(rows, error=Fraction(0)):
    """Rows of fractions, each off by a relative `error`."""
    return Matrix([[(a, abs(a) * error) for a in row] for row in rows])


def block(*rows):
    """Matrices put together."""
    return Matrix([[pair for part in parts for pair in part] for row in rows for parts in zip(*row, strict=True)])


def he(M):
    """M + M'."""
    return M + M.T


def positive(M, semi=False):
    """Whether M > 0 (>= 0) for all errors: what they can take, weighted by s_i near sqrt(M_ii), is taken first."""
    values, errors = [[[pair[k] for pair in row] for row in M] for k in (0, 1)]
    diagonal = [row[i] for i, row in enumerate(values)]
    symmetric = values == [list(column) for column in zip(*values, strict=True)]
    if not M or not symmetric or any(a < 0 or (a == 0 and not semi) for a in diagonal):
        return False
    sizes = [a.numerator.bit_length() - a.denominator.bit_length() for a in diagonal]
    s = [Fraction(2) ** ((size + 1) // 2) for size in sizes]
    taken = [sum(e * s[i] / s[j] for j, e in enumerate(row)) for i, row in enumerate(errors)]
    return definite([[a - taken[i] * (i == j) for j, a in enumerate(row)] for i, row in enumerate(values)], semi)


def definite(M, semi=False):
    """M > 0 (>= 0) by its first pivot and the Schur complement."""
    if not M:
        return True
    (pivot, *row), *rest = M
    if pivot < 0 or (pivot == 0 and (any(row) or not semi)):
        return False
    return definite(
        [[a - (b * first / pivot if first else 0) for a, b in zip(r, row, strict=True)] for first, *r in rest], semi
    )


def of_polytope(kind, loops, K, d, discrete):
    """Yields whether each condition of a claim about one P, or that there is none, holds."""
    rate, factor, P = d.get("rate", 0), d.get("factor", 1), matrix(d.get("P", []))
    if kind == "infeasible":
        W = [matrix(rows) for rows in d["W"]]
        pairs = zip(loops, W, strict=True)
        S = [C @ w @ C.T - factor**2 * w if discrete else he(C @ w) + 2 * rate * w for C, w in pairs]
        yield all(positive(w, semi=True) for w in W) and positive(sum(S[1:], S[0]))
        return
    if kind == "unstable":
        C, x = loops[int(d["vertex"])], matrix([d["x"]])
        yield positive(-(x @ P @ x.T))
        yield positive(factor**2 * P - C.T @ P @ C if discrete else -he(P @ C) - 2 * rate * P, semi=True)
        return
    yield positive(P)
    per_vertex = kind == "l2" and isinstance(d["Bw"][0][0], list)
    for C, Bw in zip(loops, d["Bw"] if per_vertex else [d.get("Bw")] * len(loops), strict=True):
        left = factor**2 * P - C.T @ P @ C if discrete else -he(P @ C) - 2 * rate * P
        yield positive(left)
        if kind == "cost":
            yield positive(left - matrix(d["Q"]) - K.T @ matrix(d["R"]) @ K)
        if kind == "damping":
            skew = d["cot"] * (P @ C - C.T @ P)
            yield positive(block((left, -skew), (skew, left)))
        if kind == "l2":
            Bw, Z = matrix(Bw, Fraction(1, 2**40)), matrix(d["C"]) + matrix(d["D"]) @ K
            supply = matrix([[d["gamma"] ** 2 * (i == j) for j in range(len(Bw.T))] for i in range(len(Bw.T))])
            cross = -(C.T @ P @ Bw) if discrete else -(P @ Bw)
            corner = supply - Bw.T @ P @ Bw if discrete else supply
            yield positive(block((left - Z.T @ Z, cross), (cross.T, corner)))
    if kind == "damping":
        yield 0 <= d["zeta"] < 1 and d["cot"] ** 2 * (1 - d["zeta"] ** 2) >= d["zeta"] ** 2
    if kind == "input":
        yield all((matrix([x]) @ P @ matrix([x]).T)[0][0][0] <= 1 for x in d["points"])
        for row, limit in zip(K, d["limit"], strict=True):
            yield positive(block((P, Matrix([row]).T), (Matrix([row]), matrix([[limit**2]]))))


def of_schedule(cells, nodes, gains, d):
    """Yields whether P > 0 and the Bernstein coefficients of V' + ... are negative, times half the width of a cell."""
    ends, rate, (low, high) = list(zip(nodes, map(matrix, d["P"]), gains, strict=True)), d.get("rate", 0), d["rates"]
    for (A, B), (a, Pa, Ka), (b, Pb, Kb) in zip(cells, ends[:-1], ends[1:], strict=True):
        yield positive(Pa) and positive(Pb) and a < b
        for Ai, Bi in zip(A, B, strict=True):
            one, two = (Pa, Ai + Bi @ Ka, Ka), (Pb, Ai + Bi @ Kb, Kb)
            for (Px, Cx, Kx), (Py, Cy, Ky) in ((one, one), (one, two), (two, two)):
                left = -he(Px @ Cy + Py @ Cx) - 2 * rate * (Px + Py)
                states = 2 * matrix(d["Q"]) if "Q" in d else 0 * Pa
                inputs = Kx.T @ matrix(d["R"]) @ Ky + Ky.T @ matrix(d["R"]) @ Kx if "R" in d else 0 * Pa
                for moved in ((b - a) / 2 * left - s * (Pb - Pa) for s in (low, high)):
                    yield positive(moved) and positive(moved - (b - a) / 2 * (states + inputs))


def fits(value, letters, sizes):
    """Whether nested lists have an axis, not empty, for each letter, of the size that the letter has or now gets."""
    if not letters or not isinstance(value, list):
        return not letters and isinstance(value, Fraction)
    same = 0 < len(value) == sizes.setdefault(letters[0], len(value))
    return same and all(fits(each, letters[1:], sizes) for each in value)


def checked(kind, data, sizes, discrete):
    """The numbers of a claim, which has all that its kind must have and nothing else. Raises ValueError."""
    fields = (each.split(":") for each in FIELDS[kind].split())
    known = {name.rstrip("?"): (shape, "?" in name) for name, shape in fields}
    known.pop("rate" if discrete else "factor", None)
    missing = {name for name, (_, optional) in known.items() if not optional} - set(data)
    if missing or set(data) - set(known):
        raise ValueError(f"{kind} lacks {sorted(missing)} or has what it must not: {sorted(set(data) - set(known))}")
    d = {name: numbers(value) for name, value in data.items()}
    for name, value in d.items():
        if not any(fits(value, letters, dict(sizes)) for letters in known[name][0].split("|")):
            raise ValueError(f"{kind}.{name} has another shape than {known[name][0]!r} of {sizes}")
        growth = kind in ("infeasible", "unstable") and (name == "rate" or (name == "factor" and value > 0))
        if name in RANGES and not growth and not RANGES[name](value):
            raise ValueError(f"{kind}.{name} is out of its range")
    return d


def measured(system, gain):
    """The cells as pairs A, B of numbers, the gain, and sizes by letter. Raises ValueError for what does not fit."""
    parts, K, sizes = system.get("cells", [system]), numbers(gain), {"2": 2}
    cells = [(numbers(part["A"]), numbers(part["B"])) for part in parts]
    if not cells or not all(fits(A, "Vnn", at) and fits(B, "Vnm", at) for A, B in cells for at in [sizes | {}]):
        raise ValueError("A and B of a system are not (V, n, n) and (V, n, m)")
    (A, B), *others = cells
    sizes |= {"n": len(A[0]), "m": len(B[0][0])} | ({"N": len(cells) + 1} if "cells" in system else {"V": len(A)})
    if any((len(a[0]), len(b[0][0])) != (sizes["n"], sizes["m"]) for a, b in others):
        raise ValueError("the cells differ in order or inputs")
    if not fits(K, "mn", dict(sizes)) and not ("cells" in system and fits(K, "Nmn", dict(sizes))):
        raise ValueError("the gain does not fit the system")
    return cells, K, sizes


def proved(system, gain, kind, data):
    """Whether a claim is. Raises ValueError and others for what does not fit."""
    parts = system.get("cells", [system])
    periods = {part["period"] for part in parts}
    if len(periods) != 1 or any(x is not None and not (isinstance(x, float) and x > 0) for x in periods):
        raise ValueError("a period is neither null nor positive, or the cells differ in it")
    discrete = periods != {None}
    if (discrete and kind in ("damping", "scheduled")) or (kind == "scheduled") != ("cells" in system):
        raise ValueError(f"a claim of kind {kind} does not fit the system")
    cells, K, sizes = measured(system, gain)
    d = checked(kind, data, sizes, discrete)
    cells = [[[matrix(M, Fraction(1, 2**40)) for M in part] for part in pair] for pair in cells]
    if kind == "scheduled":
        nodes, K = numbers(system["nodes"]), K if isinstance(K[0][0], list) else [K] * (len(cells) + 1)
        return all(of_schedule(cells, nodes, map(matrix, K), d))
    loops = [A + B @ matrix(K) for A, B in zip(*cells[0], strict=True)]
    return all(of_polytope(kind, loops, matrix(K), d, discrete))


def main(path):
    """Print a line for each claim. Returns the exit status."""
    try:
        with open(path, encoding="utf-8") as file:
            stored, good = json.load(file, parse_int=float), []
        if (stored["format"], stored["version"]) != ("diffabs certificate", 1) or stored["version"] is True:
            raise ValueError("format and version are not 'diffabs certificate' and 1")
        for claim in stored["claims"]:
            good.append(proved(stored["system"], stored["gain"], claim["kind"], claim["data"]))
            said = [f"{name} {value!r}" for name, value in claim["data"].items() if isinstance(value, float)]
            print(claim["kind"], *said, "proved" if good[-1] else "NOT PROVED", sep="  ")
    except (OSError, ValueError, TypeError, LookupError, ArithmeticError, AttributeError, RecursionError) as error:
        print(f"{path}: {type(error).__name__}: {error}", file=sys.stderr)
        return 2
    return 0 if good and all(good) else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1]) if len(sys.argv) == 2 else __doc__)
