"""Prove a certificate again in fractions, without diffabs: python experiments/check_certificate.py FILE.json

For every vertex C = A + B K, exactly as stored. decay: P > 0 and -(C'P + PC) - 2 rate P > 0. cost: P > 0 and
-(C'P + PC) - Q - K'RK > 0. In discrete time: factor^2 P - C'PC in place of -(C'P + PC) - 2 rate P. infeasible: no P > 0
exists, because all W > 0 and the sum of C W + W C' + 2 rate W (of C W C' - factor^2 W) > 0. Other kinds are not proved
here. Exit status 0 if all is proved, else 1. (All kinds, and data rounded outward: tests/checker.py.)"""

import json
import sys
from fractions import Fraction


def exact(x):
    """A float is a fraction."""
    return [exact(y) for y in x] if isinstance(x, list) else Fraction(x)


def mul(a, b):
    """A B."""
    return [[sum(x * y for x, y in zip(row, column, strict=True)) for column in transposed(b)] for row in a]


def transposed(a):
    """A'."""
    return [list(row) for row in zip(*a, strict=True)]


def add(*terms):
    """Sum of factor times matrix over pairs of these."""
    return [[sum(k * m[i][j] for k, m in terms) for j in range(len(terms[0][1]))] for i in range(len(terms[0][1]))]


def positive(m):
    """Whether M is symmetric and every pivot of Gauss's elimination positive."""
    if m != transposed(m) or m[0][0] <= 0:
        return False
    rest = [[x - row[0] * y / m[0][0] for x, y in zip(row[1:], m[0][1:], strict=True)] for row in m[1:]]
    return not rest or positive(rest)


def left(m, c, d, discrete):
    """-dV/dt - 2 rate V for V = x'Mx, or factor^2 V - V+."""
    mc = mul(m, c)
    rest = mul(transposed(c), mc) if discrete else add((1, mc), (1, transposed(mc)))
    return add((d.get("factor", 1) ** 2 if discrete else -2 * d.get("rate", 0), m), (-1, rest))


def proved(kind, d, loops, k, discrete):
    """Whether a claim is."""
    if kind == "infeasible":
        parts = [left(w, transposed(c), d, discrete) for w, c in zip(d["W"], loops, strict=True)]
        return all(map(positive, d["W"])) and positive(add(*((-1, part) for part in parts)))
    if kind not in ("decay", "cost") or not positive(d["P"]):
        return False
    price = [(-1, d["Q"]), (-1, mul(transposed(k), mul(d["R"], k)))] if kind == "cost" else []
    return all(positive(add((1, left(d["P"], c, d, discrete)), *price)) for c in loops)


if __name__ == "__main__":
    with open(sys.argv[1], encoding="utf-8") as file:
        stored = json.load(file)
    system, gain, answers = stored["system"], exact(stored["gain"]), []
    ab = [mul(exact(b), gain) for b in system["B"]] if "B" in system else []
    loops = [add((1, exact(a)), (1, bk)) for a, bk in zip(system.get("A", []), ab, strict=True)]
    for claim in stored["claims"]:
        data = {name: exact(value) for name, value in claim["data"].items()}
        answers.append(proved(claim["kind"], data, loops, gain, system.get("period") is not None))
        print(claim["kind"], "proved" if answers[-1] else "NOT PROVED HERE")
    sys.exit(0 if answers and all(answers) else 1)
