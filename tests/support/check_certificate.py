"""Prove a certificate again in fractions, without diffabs: python tests/support/check_certificate.py FILE.json

Every vertex (A, B) of the system has the loop C = A + B K, exactly as stored. What a claim says, and why it is true:

    decay       in the hull of the vertices, however they vary, |x| falls like exp(-rate t), in discrete time like
                factor^k: P > 0 and -(C'P + PC) - 2 rate P > 0, or factor^2 P - C'PC > 0; rate >= 0, 0 < factor <= 1
    cost        they are stable, and the integral (sum) of x'Qx + u'Ru from x0 is at most x0'P x0: the same without a
                rate, and also with - Q - K'RK on the left
    infeasible  no P does so with this rate (not given: 0) or factor (1): W >= 0, and the sum of C W + W C' + 2 rate W
                (of C W C' - factor^2 W) > 0

Other kinds are not proved here. Names of states and corners are labels; nothing is proved about them, and they are not
shown. Exit status 0 if all claims are proved, 1 if one is not, 2 if the file is no certificate.
(All kinds, and data rounded outward: tests/support/checker.py.)"""

import json
import math
import sys
from fractions import Fraction

SHAPES = {"decay": {"P": "nn"}, "cost": {"P": "nn", "Q": "nn", "R": "mm", "x0": "n"}, "infeasible": {"W": "Vnn"}}


def check(document):
    """What is not proved of a JSON document, a line for each such claim; nothing if all is. Raises ValueError for what
    is no certificate. Numbers are floats, as in the file: of a whole one, too (`parse_int=float`)."""
    given = members(document, "the file", {"format", "version", "system", "gain", "claims"})
    if given["format"] != "diffabs certificate" or given["version"] != 1 or given["version"] is True:
        raise ValueError("format and version are not 'diffabs certificate' and 1")
    if not isinstance(given["claims"], list):
        raise ValueError("the claims are not a list")
    if isinstance(given["system"], dict) and "cells" in given["system"]:
        return ["claims about a schedule: NOT PROVED here"]
    loops, gain, discrete, sizes = system(given["system"], given["gain"])
    found = [] if given["claims"] else ["no claim: NOTHING PROVED"]
    for claim in given["claims"]:
        kind = members(claim, "a claim", {"kind", "data"})["kind"]
        if not isinstance(kind, str) or kind not in SHAPES:
            found.append(f"{kind!r:.40} is NOT PROVED here, where {', '.join(SHAPES)} are known")
        elif not proved(kind, numbers(kind, claim["data"], discrete, sizes), loops, gain, discrete):
            found.append(f"{said(claim)}: NOT PROVED")
    return found


def said(claim):
    """A claim in a few words."""
    kind = {"infeasible": "infeasible (no common P)"}.get(claim["kind"], claim["kind"])
    return " ".join([kind, *(f"{k} {v!r}" for k, v in claim["data"].items() if isinstance(v, float))])


def members(value, where, names, optional=()):
    """An object with these members and no other. Raises ValueError."""
    if not isinstance(value, dict) or not names - set(optional) <= set(value) <= names:
        raise ValueError(f"{where} needs the members {', '.join(sorted(names))} and no other")
    return value


def array(value, shape, sizes, where):
    """Fractions of finite numbers in lists whose lengths have the letters of `shape`. Raises ValueError."""
    if not shape:
        if type(value) is not float or not math.isfinite(value):
            raise ValueError(f"{where} is not made of finite numbers of shape {sizes}")
        return Fraction(value)
    if not isinstance(value, list) or not 0 < len(value) == sizes.setdefault(shape[0], len(value)):
        raise ValueError(f"{where} has not the shape of the rest, {sizes}")
    return [array(each, shape[1:], sizes, where) for each in value]


def system(given, gain):
    """The loops, the gain, whether time is discrete, and the sizes by letter. Raises ValueError."""
    given, sizes = members(given, "system (a polytope)", {"A", "B", "period", "states", "corners"}), {}
    a, b = array(given["A"], "Vnn", sizes, "system.A"), array(given["B"], "Vnm", sizes, "system.B")
    discrete, k = given["period"] is not None, array(gain, "mn", sizes, "gain")
    if discrete and array(given["period"], "", sizes, "system.period") <= 0:
        raise ValueError("system.period is not positive")
    return [add((1, x), (1, mul(y, k))) for x, y in zip(a, b, strict=True)], k, discrete, sizes


def numbers(kind, data, discrete, sizes):
    """Data of a claim: all that it must have, nothing else, each in its range. Raises ValueError."""
    speed = "factor" if discrete else "rate"
    known = SHAPES[kind] | ({} if kind == "cost" else {speed: ""})
    members(data, f"data of {kind}", set(known), (speed, "x0"))
    found = {name: array(value, known[name], sizes, f"{kind}.{name}") for name, value in data.items()}
    value, claimed = found.get(speed, 1), kind != "infeasible"  # what no P proves may be growth, too
    if (discrete and value <= 0) or (claimed and (value > 1 if discrete else value < 0)):
        raise ValueError(f"{kind}.{speed} = {data[speed]!r} is out of its range")
    return found


def mul(a, b):
    """A B."""
    return [[sum(x * y for x, y in zip(row, column, strict=True)) for column in transposed(b)] for row in a]


def transposed(a):
    """A'."""
    return [list(row) for row in zip(*a, strict=True)]


def add(*terms):
    """Sum of factor times matrix over pairs of these."""
    return [[sum(k * m[i][j] for k, m in terms) for j in range(len(terms[0][1]))] for i in range(len(terms[0][1]))]


def positive(m, semi=False):
    """Whether M is symmetric and every pivot of Gauss's elimination positive (or 0 with its row, where `semi`)."""
    if m != transposed(m) or m[0][0] < 0 or (m[0][0] == 0 and (any(m[0]) or not semi)):
        return False
    pivot = m[0][0] or 1
    rest = [[x - row[0] * y / pivot for x, y in zip(row[1:], m[0][1:], strict=True)] for row in m[1:]]
    return not rest or positive(rest, semi)


def left(m, c, d, discrete):
    """-dV/dt - 2 rate V for V = x'Mx, or factor^2 V - V+."""
    mc = mul(m, c)
    rest = mul(transposed(c), mc) if discrete else add((1, mc), (1, transposed(mc)))
    return add((d.get("factor", 1) ** 2 if discrete else -2 * d.get("rate", 0), m), (-1, rest))


def proved(kind, d, loops, k, discrete):
    """Whether a claim is. Stability is asked of a cost as well, whose Q and R may have any sign."""
    if kind == "infeasible":
        parts = [left(w, transposed(c), d, discrete) for w, c in zip(d["W"], loops, strict=True)]
        return all(positive(w, semi=True) for w in d["W"]) and positive(add(*((-1, part) for part in parts)))
    falls = [left(d["P"], c, d, discrete) for c in loops]
    price = [(-1, d["Q"]), (-1, mul(transposed(k), mul(d["R"], k)))] if kind == "cost" else []
    return positive(d["P"]) and all(positive(fall) and positive(add((1, fall), *price)) for fall in falls)


def unique(pairs):
    """A JSON object, of which no name comes twice. Raises ValueError."""
    if len(dict(pairs)) != len(pairs):
        raise ValueError("a name comes twice in an object")
    return dict(pairs)


def main(path):
    """Print a line for each claim. Returns the exit status."""
    try:
        with open(path, encoding="utf-8") as file:
            document = json.load(file, parse_int=float, object_pairs_hook=unique)
        wrong = check(document)
    except (OSError, ValueError, RecursionError) as error:
        print(f"{path}: {' '.join(str(error).split())}", file=sys.stderr)
        return 2
    print("\n".join(wrong or [f"{said(claim)}: proved" for claim in document["claims"]]))
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1]) if len(sys.argv) == 2 else __doc__)
