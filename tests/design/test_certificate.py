"""Claims about matrices are proved exactly, by the package and by the checker that shares no code with it."""

import contextlib
import copy
import importlib.util
import json
import math
import pathlib
import subprocess
import sys
import tempfile
import warnings
from fractions import Fraction

import checker
import numpy as np
import pytest
from marks import cases
from mutants import killed_by
from project import ROOT
from seams import replace_seam

from diffabs.robust.design.analysis import certify
from diffabs.robust.design.polytopes import Polytope, Schedule
from diffabs.robust.design.proof import exact
from diffabs.robust.design.proof.certificate import Certificate, Claim
from diffabs.robust.design.spec import L2Gain, Spec
from diffabs.robust.design.verify import verify_file

OUTSIDERS = ROOT / "tests" / "support" / "check_certificate.py"
spec = importlib.util.spec_from_file_location("check_certificate", OUTSIDERS)
outsiders = importlib.util.module_from_spec(spec)
spec.loader.exec_module(outsiders)

KINDS = ("decay", "cost", "damping", "l2", "input", "infeasible", "scheduled")


def scalar(a, period=None, b=0.0):
    return Polytope([[[a]]], [[[b]]], period)


def both(system, gain, kind, **data):
    """The verdict of both verifiers, which must agree."""
    one = Certificate(system, gain, (Claim(kind, data),))
    stored = json.loads(json.dumps(plain(one)), parse_int=float)
    verdict = checker.proved(stored["system"], stored["gain"], kind, stored["claims"][0]["data"])
    assert one.verified_exactly == verdict, (kind, data)
    return verdict


def short(certificate, folder):
    """The verdict of the checker for outsiders."""
    certificate.save(folder / "short.json")
    return subprocess.run([sys.executable, OUTSIDERS, folder / "short.json"], capture_output=True, text=True)


def plain(certificate):
    with tempfile.TemporaryDirectory() as folder:
        certificate.save(pathlib.Path(folder) / "x.json")
        return json.loads((pathlib.Path(folder) / "x.json").read_text())


def test_numbers_are_exact():
    rng = np.random.default_rng(0)
    x = rng.standard_normal((2, 3, 3)) * 10.0 ** rng.integers(-300, 300, (2, 3, 3))
    x[0, 0, :2] = 0.0, 5e-324
    y = rng.standard_normal((3, 3))
    rational = np.vectorize(Fraction, [object])
    a, b = exact.as_dyadic(x), exact.as_dyadic(y)
    for ours, truth in (
        (a, rational(x)),
        (a @ b - 3 * a, rational(x) @ rational(y) - 3 * rational(x)),
        (exact.block_matrix([[a.mT, b], [b, 0.1 * a]]), np.block([[rational(x).mT, rational([y, y])],
                                                          [rational([y, y]), Fraction(0.1) * rational(x)]])),
    ):  # fmt: skip
        assert (rational(ours.ints) * Fraction(2) ** -ours.bits == truth).all()
    a, b = exact.as_uncertain_dyadic(x), exact.as_uncertain_dyadic(y)
    rho = Fraction(1, 2**40)
    error = (2 * rho + rho**2) * (abs(rational(x)) @ abs(rational(y)))
    assert (rational((a @ b).error) * Fraction(2) ** -(a @ b).bits == error).all()


def test_positive_is_sylvester_and_knows_singular_matrices():
    rng = np.random.default_rng(1)
    for n in (1, 2, 3, 5):
        for rank in range(n + 1):
            factor = rng.integers(-4, 5, (n, rank))
            full = np.linalg.matrix_rank(factor) == n
            square = factor @ factor.T
            assert exact.is_positive_definite(square.tolist(), strict=False)
            assert exact.is_positive_definite(square.tolist()) == full
            square[0, 0] -= 1 if not full else 10**6
            np.testing.assert_equal(
                exact.is_positive_definite(square.tolist(), strict=False), np.linalg.eigvalsh(square)[0] > -1e-9
            )
    assert not exact.is_positive_definite([[0, 1], [1, 0]], strict=False)
    assert not exact.is_positive_definite([[0, 0], [0, -1]], strict=False)


@pytest.mark.parametrize(
    ("system", "kind", "data", "name", "critical", "sign"),
    [
        # the field `name` proves at critical + sign * 1e-9 and not at critical - sign * 1e-9
        (scalar(-1.0), "decay", {"P": [[3.0]]}, "rate", 1.0, -1),
        (scalar(0.5, 0.1), "decay", {"P": [[3.0]]}, "factor", 0.5, 1),
        (scalar(-1.0), "cost", {"Q": [[1.0]], "R": [[1.0]]}, "P", [[0.5]], 1),
        (scalar(0.5, 0.1), "cost", {"Q": [[3.0]], "R": [[1.0]]}, "P", [[4.0]], 1),
        (scalar(-1.0), "l2", {"P": [[1.0]], "Bw": [[1.0]], "C": [[1.0]], "D": [[0.0]]}, "gamma", 1.0, 1),
        (scalar(0.5, 0.1), "l2", {"P": [[2.0]], "Bw": [[1.0]], "C": [[1.0]], "D": [[0.0]]}, "gamma", 2.0, 1),
        (scalar(1.0), "infeasible", {"W": [[[1.0]]]}, "rate", -1.0, 1),
        (scalar(2.0, 0.1), "infeasible", {"W": [[[1.0]]]}, "factor", 2.0, -1),
    ],
)
def test_scalar_truths(system, kind, data, name, critical, sign):
    critical = np.array(critical)
    assert both(system, [[0.0]], kind, **data, **{name: critical + sign * 1e-9})
    assert not both(system, [[0.0]], kind, **data, **{name: critical - sign * 1e-9})


def test_damping_is_that_of_the_pole():
    system = Polytope([[[-0.6, 0.8], [-0.8, -0.6]]], np.zeros((1, 2, 1)))  # pole -0.6 + 0.8 i

    def proved(zeta, spare=1.0):
        cot = np.nextafter(np.nextafter(zeta / np.sqrt(1 - zeta**2), 1), 1) * spare
        return both(system, [[0.0, 0.0]], "damping", P=np.eye(2), zeta=zeta, cot=cot)

    assert proved(0.6 - 1e-9)
    assert not proved(0.6 + 1e-9)
    assert not proved(0.5, spare=1 - 1e-12)  # a cotangent that is too small for its zeta


def test_input_is_bounded_on_the_ellipse():
    system = scalar(1.0, b=1.0)  # u = -2 x on |x| <= 1

    def proved(limit, start):
        return both(system, [[-2.0]], "input", P=[[1.0]], limit=[limit], points=[[-1.0], [start]])

    assert proved(2 + 1e-9, 1.0)
    assert not proved(2.0, 1.0)
    assert not proved(2 + 1e-9, 1 + 1e-9)
    assert not both(scalar(1.0, b=1.0), [[-0.9]], "input", P=[[1.0]], limit=[2.0], points=[[1.0]])


def test_a_schedule_may_be_as_fast_as_its_function_allows():
    cells = (scalar(-1.0), scalar(-2.0))
    P = [[[1.0]], [[2.0]], [[2.0]]]  # (-2 P + s dP/dp) < 0 is s < 2 at the first node

    def proved(high, **data):
        system = Schedule("speed", [0.0, 1.0, 3.0], cells)
        return both(system, [[0.0]], "scheduled", P=P, rates=[-5.0, high], **data)

    assert proved(2 - 1e-9)
    assert not proved(2 + 1e-9)
    assert proved(1 - 1e-9, Q=[[1.0]], R=[[1.0]])
    assert not proved(1 + 1e-9, Q=[[1.0]], R=[[1.0]])
    assert not proved(1 + 1e-9, rate=0.5)
    gains = np.array([[[1.0]], [[-1.0]], [[1.0]]])  # K'RK is 1, -1, 1 times R: the middle coefficient is the lowest
    system = Schedule("speed", [0.0, 1.0, 3.0], (scalar(-1.0, b=0.0),) * 2)
    for r, verdict in ((2 - 1e-9, True), (2 + 1e-9, False)):
        assert both(system, gains, "scheduled", P=np.ones((3, 1, 1)), rates=[0.0, 0.0], R=[[r]]) == verdict


def test_a_witness_is_not_negative():
    assert both(scalar(1.0), [[0.0]], "infeasible", W=[[[1.0]]])
    assert not both(scalar(-1.0), [[0.0]], "infeasible", W=[[[-1.0]]])
    swap = np.array([[0.0, 1.0], [1.0, 0.0]])
    assert not both(Polytope([swap], np.zeros((1, 2, 1))), [[0.0, 0.0]], "infeasible", W=[swap])
    system = Polytope([np.eye(2)] * 2, np.zeros((2, 2, 1)))
    assert both(system, [[0.0, 0.0]], "infeasible", W=[np.diag([1.0, 0.0]), np.diag([0.0, 1.0])])


def test_bernstein_coefficients_are_those_of_the_inequality():
    rng = np.random.default_rng(8)
    system, _, data = random_claim(rng, "scheduled", False, 1.0)
    n, m = system.cells[0].order, system.cells[0].inputs
    M, K = rng.standard_normal((3, n, n)), rng.standard_normal((3, m, n))
    data |= {"P": M @ M.mT, "Q": np.eye(n), "R": np.eye(m) + 0.1}
    found = [sum(each.terms) for each in exact.conditions("scheduled", system, K, data, proof=False)][1:]
    assert len(found) == 2 * 3 * 2 * 2  # cells, coefficients, ends of the rates, without and with Q and R
    for c, l, s, spent in np.ndindex(2, 3, 2, 2):
        weight = l / 3 + 0.1
        aa, ab, bb = (np.asarray(found[12 * c + 4 * i + 2 * s + spent]) for i in range(3))
        P, gain = [(1 - weight) * x[c] + weight * x[c + 1] for x in (data["P"], K)]
        width = system.nodes[c + 1] - system.nodes[c]
        V = P @ (system.cells[c].A + system.cells[c].B @ gain) + data["rate"] * P
        V = V + V.mT + data["rates"][s] * (data["P"][c + 1] - data["P"][c]) / width
        V = V + spent * (data["Q"] + gain.T @ data["R"] @ gain)
        ours = (1 - weight) ** 2 * aa + 2 * weight * (1 - weight) * ab + weight**2 * bb
        np.testing.assert_allclose(ours, -width * V, rtol=0, atol=1e-12 * abs(V).max())


A_LOW, A_HIGH, B, W_LOW, W_HIGH = 83.8796606703, 84.6321445666, 133.472842636189, 14.0291806958, 140.291806958


def rig():
    corners = [(a, w) for a in (A_LOW, A_HIGH) for w in (W_LOW, W_HIGH)]
    return Polytope(
        [[[0, 1], [0, a / w]] for a, w in corners],
        [[[0], [B / w]] for _, w in corners],
        corners=tuple({"a": a, "w": w} for a, w in corners),
    )


def lyapunov(k1, k2):
    """P = [[p, q], [q, 1]] by a search over q: a vertex allows p within 2 sqrt(q c u (d u - q)) of (c + q d) u."""
    c = B * abs(k1)
    u, d = np.array([(1 / w, B * abs(k2) - a) for a in (A_LOW, A_HIGH) for w in (W_LOW, W_HIGH)]).T
    q = np.linspace(0, 1, 100001)[1:-1, None] * np.min(u * d)
    middle, half = (c + q * d) * u, 2 * np.sqrt(q * c * u * (d * u - q))
    low, high = (middle - half).max(axis=1), (middle + half).min(axis=1)
    best = np.argmax((high - low) / high)
    return np.array([[(low + high)[best] / 2, q[best, 0]], [q[best, 0], 1.0]]), high[best] > low[best]


@pytest.mark.parametrize("k1", [-1.0, -20.0, -300.0])
def test_the_rig_has_a_common_function_where_the_formula_says(k1):
    critical = (np.sqrt(B * abs(k1)) * (np.sqrt(W_HIGH) - np.sqrt(W_LOW)) + A_HIGH) / B
    for factor in (1.001, 1.5, 4.0):
        P, found = lyapunov(k1, -critical * factor)
        assert found
        assert both(rig(), [[k1, -critical * factor]], "decay", P=P)
    P, found = lyapunov(k1, -critical * 0.999)
    assert not found
    assert not both(rig(), [[k1, -critical * 0.999]], "decay", P=P)


def test_no_common_function_is_proved_too():
    cp = pytest.importorskip("cvxpy")
    critical = (np.sqrt(B * 20) * (np.sqrt(W_HIGH) - np.sqrt(W_LOW)) + A_HIGH) / B
    gain = np.array([[-20.0, -0.98 * critical]])
    scale = np.diag([1.0, 5.0])  # x2 is larger than x1
    W = [cp.Variable((2, 2), PSD=True) for _ in range(4)]
    t = cp.Variable()
    loops = [np.linalg.inv(scale) @ C @ scale for C in rig().closed_loop(gain)]
    S = sum(C @ w + w @ C.T for C, w in zip(loops, W, strict=True))
    cp.Problem(cp.Maximize(t), [S >> t * np.eye(2), sum(cp.trace(w) for w in W) == 1]).solve(solver="CLARABEL")
    witness = [scale @ (w.value + w.value.T + 1e-7 * np.eye(2)) @ scale for w in W]
    assert both(rig(), gain, "infeasible", W=witness)
    certificate = Certificate(rig(), gain, (Claim("infeasible", {"W": witness}),))
    assert certificate.quadratically_stable is False
    assert max(certificate.frozen) < 0
    slower = np.array([[-20.0, -1.02 * critical]])
    assert not both(rig(), slower, "infeasible", W=witness)


def test_right_in_floats_is_not_enough():
    rng, found = np.random.default_rng(3), 0
    for _ in range(800):
        v = rng.standard_normal((3, 2))
        P = v @ v.T  # of rank 2, then rounded
        P = (P + P.T) / 2
        if np.linalg.eigvalsh(P)[0] > 0 and not exact.is_positive_definite(exact.as_dyadic(P).ints.tolist()):
            found += 1
            assert not both(Polytope([-np.eye(3)], np.zeros((1, 3, 1))), np.zeros((1, 3)), "decay", P=P)
    assert found > 8
    assert not both(scalar(-1.0), [[0.0]], "decay", P=[[1.0]], rate=1.0)  # singular, and equal in floats


def test_vertices_may_be_off_by_a_relative_2_to_the_minus_40():
    assert both(scalar(-1.0), [[0.0]], "decay", P=[[1.0]], rate=1 - 2.0**-39)
    assert not both(scalar(-1.0), [[0.0]], "decay", P=[[1.0]], rate=1 - 2.0**-40)  # the worst vertex is singular
    assert both(scalar(0.5, 1.0), [[0.0]], "decay", P=[[1.0]], factor=0.5 + 2.0**-40)
    assert not both(scalar(0.5, 1.0), [[0.0]], "decay", P=[[1.0]], factor=0.5 + 2.0**-41)


def random_claim(rng, kind, discrete, stretch):
    """A system and data whose claim holds with much room where `stretch` is small."""
    n, m, V, N = rng.integers(1, 4), rng.integers(1, 3), rng.integers(1, 4), 3
    centre = {"infeasible": (1.0, 1.0)}.get(kind, (-1.0, 0.3))[discrete]
    units = 10.0 ** rng.integers(-3, 4, n)

    def symmetric(k):
        M = np.eye(k) + 0.1 * rng.standard_normal((k, k))
        return M @ M.T

    def polytope():
        A = centre * np.eye(n) + 0.3 * stretch * rng.standard_normal((V, n, n))
        B = 0.2 * stretch * rng.standard_normal((V, n, m))
        return Polytope(units[:, None] * A / units, units[:, None] * B, 0.01 if discrete else None)

    K = rng.standard_normal((m, n)) / units
    P = symmetric(n) / units / units[:, None]
    P = (P + P.T) / 2
    Q, R = 0.3 * P, 0.1 * stretch * symmetric(m)
    P_nodes = P * (1 + 0.2 * rng.random((N, 1, 1)))
    work = {"Q": Q, "R": R} if rng.random() < 0.7 else {}
    speed = {"factor": 0.6} if discrete else {"rate": 0.3}
    system = polytope() if kind != "scheduled" else Schedule("speed", [1.0, 1.5, 4.0], (polytope(), polytope()))
    gain = rng.standard_normal((N, m, n)) / units if kind == "scheduled" and rng.random() < 0.7 else K
    width = (V, n, 2) if rng.random() < 0.5 else (n, 2)
    W = np.stack([symmetric(n) * units * units[:, None] for _ in range(V)])
    data = {
        "decay": {"P": P, **speed},
        "cost": {"P": P, "Q": Q, "R": R, "x0": units},
        "damping": {"P": P, "zeta": 0.6, "cot": 0.7500001},
        "l2": {"P": P, "gamma": 4.0, "Bw": units[:, None] * 0.3 * rng.standard_normal(width),
               "C": 0.3 * np.eye(n) / units, "D": 0.1 * rng.standard_normal((n, m))},
        "input": {"P": P, "limit": np.full(m, 4.0), "points": 0.3 * rng.standard_normal((3, n)) * units},
        "infeasible": {"W": (W + W.mT) / 2} | ({"factor": 0.6 + 0.2 * stretch} if discrete else speed),
        "scheduled": {"P": P_nodes, "rates": [-0.5, 0.4], "rate": 0.2} | work,
    }  # fmt: skip
    return system, gain, data[kind]


@pytest.mark.parametrize(("kind", "discrete"), [(kind, False) for kind in KINDS if kind != "scheduled"]
                         + [pytest.param("scheduled", False, marks=pytest.mark.slow)]
                         + [pytest.param(kind, True, marks=pytest.mark.slow)
                            for kind in KINDS if kind not in ("damping", "scheduled")])  # fmt: skip
def test_both_verifiers_agree(kind, discrete):
    rng = np.random.default_rng(KINDS.index(kind))
    verdicts = []
    for stretch in np.linspace(0.1, 12.0 if kind == "infeasible" else 3.0, 40):
        system, gain, data = random_claim(rng, kind, discrete, stretch)
        verdicts.append(both(system, gain, kind, **data))
        margins = exact.vertex_margins(kind, system, np.array(gain), data).values()
        assert not verdicts[-1] or min(margins) > 0
    assert 8 <= sum(verdicts) <= 36


def example(kind, discrete=False, seed=0):
    """A proved certificate."""
    system, gain, data = random_claim(np.random.default_rng(seed), kind, discrete, 0.3)
    certificate = Certificate(system, gain, (Claim(kind, data),))
    assert certificate.verified_exactly
    return certificate


def leaves(node, field=""):
    for key, value in list(node.items() if isinstance(node, dict) else enumerate(node)):
        name = key if isinstance(key, str) else field
        if isinstance(value, (list, dict)):
            yield from leaves(value, name)
        elif isinstance(value, float):
            yield node, key, name


def changed(number):
    """The number with one digit changed, with digits too many, and with the other sign."""
    text = repr(abs(number))
    places = [i for i, each in enumerate(text) if each.isdigit()]
    for i in (places[0], places[1], places[-1]):
        yield float(f"{text[:i]}{(int(text[i]) + 5) % 10}{text[i + 1 :]}") * np.sign(number)
    yield float("9999" + text) * np.sign(number)
    yield -number


@pytest.mark.parametrize("kind", cases(KINDS, *set(KINDS) - {"decay", "infeasible"}))
def test_a_changed_digit_is_found_out(kind, tmp_path, capsys):
    file = tmp_path / "certificate.json"
    example(kind, seed=3).save(file)
    stored, found = json.loads(file.read_text()), set()
    numbers = [leaf for leaf in leaves(stored) if leaf[2] in ("A", "P", "W", "gain")]
    for node, key, field in numbers[:: 1 + len(numbers) // 15]:
        for other in changed(node[key]):
            number, node[key] = node[key], other
            file.write_text(json.dumps(stored))
            node[key] = number
            verdict = Certificate.load(file).verified_exactly
            assert checker.main(file) == (0 if verdict else 1)
            assert ("NOT PROVED" in capsys.readouterr().out) == (not verdict)
            found |= set() if verdict else {field}
    assert found == {"A", "gain", "W" if kind == "infeasible" else "P"}


@pytest.mark.parametrize("kind", ["decay", "cost", "infeasible"])
@pytest.mark.parametrize("seed", [3, 4])
def test_the_checker_for_outsiders(kind, seed, tmp_path):
    certificate = example(kind, seed=seed)
    assert certificate.verified_exactly
    assert short(certificate, tmp_path).returncode == 0
    wrong = dict(certificate.claims[0].data)
    name = "W" if kind == "infeasible" else "P"
    wrong[name] = -wrong[name]
    refused = short(Certificate(certificate.system, certificate.gain, (Claim(kind, wrong),)), tmp_path)
    assert refused.returncode == 1
    assert "NOT PROVED" in refused.stdout


def test_the_independent_checker_refuses_unknown_entries(tmp_path):
    assert short(example("damping", seed=3), tmp_path).returncode == 1


def verdicts(document, file, capsys):
    """Whether the package, the tests' checker and the one for outsiders say that all is proved of a file."""
    file.write_text(json.dumps(document))
    found = [False]
    with contextlib.suppress(ValueError):
        found = [Certificate.load(file).verified_exactly]
    for check in (checker.main, outsiders.main):
        status = check(file)
        said = capsys.readouterr()
        assert len(said.err.splitlines()) == (status == 2)
        found.append(status == 0)
    return found


def unstable(period=None):
    """A certificate's file that claims the stability of x' = x (x+ = 2 x)."""
    system = {"A": [[[2.0 if period else 1.0]]], "B": [[[0.0]]], "period": period, "states": [], "corners": []}
    claim = {"kind": "decay", "data": {"P": [[1.0]]}}
    return {"format": "diffabs certificate", "version": 1, "system": system, "gain": [[0.0]], "claims": [claim]}


@pytest.mark.parametrize(
    ("period", "kind", "data"),
    [
        (None, "decay", {"P": [[1.0]], "rate": -1e9}),
        (None, "decay", {"P": [[1.0]], "rate": -2.0}),
        (None, "decay", {"P": [[-1.0]], "rate": 0.0}),
        (None, "decay", {"P": [[1.0]], "factor": 100.0}),
        (0.1, "decay", {"P": [[1.0]], "factor": 100.0}),
        (0.1, "decay", {"P": [[1.0]], "factor": -100.0}),
        (0.1, "decay", {"P": [[1.0]], "rate": 0.0}),
        (None, "cost", {"P": [[1.0]], "Q": [[-100.0]], "R": [[1.0]]}),
        (0.1, "cost", {"P": [[1.0]], "Q": [[-100.0]], "R": [[1.0]]}),
        (None, "cost", {"P": [[1.0]], "Q": [[-100.0]], "R": [[1.0]], "rate": -9.0}),
        (None, "damping", {"P": [[1.0]], "zeta": -1.0, "cot": 0.0}),
        (None, "input", {"P": [[1.0]], "limit": [-1.0], "points": [[0.0]]}),
        (None, "l2", {"P": [[1.0]], "gamma": -1.0, "Bw": [[0.0]], "C": [[0.0]], "D": [[0.0]]}),
        (None, "decay", {}),
        (None, "decay", {"P": []}),
        (None, "decay", {"P": [[]]}),
        (None, "stable", {}),
        (None, "infeasible", {"W": []}),
        (0.1, "infeasible", {"W": [[[1.0]]], "factor": -1.0}),
        (0.1, "infeasible", {"W": [[[1.0]]], "factor": 0.0}),
    ],
)
def test_an_unstable_loop_is_not_called_proved(period, kind, data, tmp_path, capsys):
    document = unstable(period)
    document["claims"] = [{"kind": kind, "data": data}]
    assert verdicts(document, tmp_path / "x.json", capsys) == [False] * 3


@pytest.mark.parametrize(
    ("keys", "value"),
    [
        (("system",), {}),
        (("system",), []),
        (("system",), {"A": [], "B": [], "period": None, "states": [], "corners": []}),
        (("system", "A"), []),
        (("system", "A"), [[]]),
        (("system", "A"), [[[]]]),
        (("system", "B"), []),
        (("system", "period"), 0.0),
        (("system", "period"), "none"),
        (("system", "cells"), []),
        (("system",), {"parameter": "v", "nodes": [0.0], "cells": []}),
        (("gain",), []),
        (("gain",), [[]]),
        (("gain",), [[0.0], [0.0]]),
        (("claims",), []),
        (("claims",), {}),
        (("claims", 0), {}),
        (("claims", 0), []),
        (("claims", 0, "data"), []),
        (("format",), "none"),
        (("version",), 2),
        (("version",), True),
    ],
)
def test_a_claim_about_nothing_is_not_called_proved(keys, value, tmp_path, capsys):
    document = unstable()
    document["system"]["A"] = [[[-1.0]]]
    assert verdicts(document, tmp_path / "x.json", capsys) == [True] * 3
    node = document
    for key in keys[:-1]:
        node = node[key]
    node[keys[-1]] = value
    assert verdicts(document, tmp_path / "x.json", capsys) == [False] * 3


def test_a_cost_may_have_any_sign_where_the_loop_is_stable(tmp_path, capsys):
    document = unstable()
    document["system"]["A"] = [[[-1.0]]]
    document["claims"] = [{"kind": "cost", "data": {"P": [[1.0]], "Q": [[-100.0]], "R": [[1.0]]}}]
    assert verdicts(document, tmp_path / "x.json", capsys) == [True] * 3


def places(node):
    """Every (container, key) of a document."""
    for key, value in list(node.items()) if isinstance(node, dict) else list(enumerate(node)):
        yield node, key
        if isinstance(value, dict | list):
            yield from places(value)


STRANGE = (0.0, -0.0, 1.0, -1.0, 1e-9, 2.0, 100.0, -100.0, -1e9, 1e300, 5e-324, math.inf, math.nan, 10**400, None,
           True, "1.0", "", [], [[]], [[[]]], {}, [1.0], [[1.0]], "decay", "cost", "infeasible", 0.1)  # fmt: skip


def mutated(document, rng):
    """A copy with one to three places changed: another number, sign or size, something strange, or nothing there."""
    document = copy.deepcopy(document)
    for _ in range(rng.integers(1, 4)):
        found = list(places(document))
        weights = np.array([0.2 if isinstance(key, int) else 1 for _, key in found])  # entries of arrays are many
        node, key = found[rng.choice(len(found), p=weights / weights.sum())]
        value = node[key]
        choice = rng.integers(6)
        if isinstance(value, float) and choice < 4:
            node[key] = (-value, value * 10.0 ** rng.integers(-9, 10), value + rng.normal(), -1e9 * value)[choice]
        elif isinstance(value, list) and choice < 3 and value:
            node[key] = (value[:-1], value + value[-1:], value[::-1])[choice]
        elif choice == 5:
            del node[key]
        else:
            node[key] = STRANGE[rng.integers(len(STRANGE))]
    return document


def proved_document(kind, discrete, rng):
    """A file whose claim is proved."""
    while True:
        system, gain, data = random_claim(rng, kind, discrete, 0.2)
        certificate = Certificate(system, gain, (Claim(kind, data),))
        if certificate.verified_exactly:
            return plain(certificate)


def slowest(system, gain):
    """The spectral abscissa (radius) over vertices and points between them, with each gain of a schedule's cell."""
    K, found = np.array(gain), []
    for c, cell in enumerate(system.get("cells", [system])):
        A, B = np.array(cell["A"]), np.array(cell["B"])
        for k in K[c : c + 2] if K.ndim == 3 else [K]:
            loops = A + B @ k
            loops = np.concatenate([loops, (loops[:, None] + loops[None]).reshape(-1, *loops.shape[1:]) / 2])
            modes = np.linalg.eigvals(loops)
            found.append((np.abs(modes) if cell["period"] is not None else modes.real).max())
    return max(found)


def is_true(document):
    """Whether what a file claims, which somebody called proved, is true as far as poles can tell, in floats."""
    worst, discrete = slowest(document["system"], document["gain"]), document["system"].get("period") is not None
    for claim in document["claims"]:
        data = claim["data"]
        if claim["kind"] != "infeasible":
            most = data.get("factor", 1.0) if discrete else -data.get("rate", 0.0)
            if worst > most + 1e-6 * abs(worst):
                return False
            continue
        A, B, K = (np.array(each) for each in (document["system"]["A"], document["system"]["B"], document["gain"]))
        A = A + B @ K  # were one stable and alone, it would have a P
        if len(A) == 1 and not discrete and worst < -data.get("rate", 0.0) - 1e-6 * abs(worst):
            return False
        if len(A) == 1 and discrete and worst < data.get("factor", 1.0) - 1e-6 * abs(worst):
            return False
    return True


@pytest.mark.parametrize("seed", cases(range(40), *range(1, 40)))
def test_no_mutation_of_a_certificate_is_a_false_proof(seed, tmp_path, capsys):
    rng, called, refused = np.random.default_rng([17, seed]), 0, 0
    for kind in KINDS:
        discrete = kind not in ("damping", "scheduled") and bool(rng.integers(2))
        document = proved_document(kind, discrete, rng)
        assert verdicts(document, tmp_path / "x.json", capsys)[:2] == [True] * 2
        for _ in range(12):
            other = mutated(document, rng)
            package, ours, theirs = verdicts(other, tmp_path / "x.json", capsys)
            assert ours or not package, other  # which asks for labels too
            assert theirs or not package or other["claims"][0]["kind"] not in outsiders.SHAPES, other
            if theirs or ours:
                called += 1
                assert is_true(other), other
            else:
                refused += 1
    assert called > 0
    assert refused > 30


def test_a_proof_holds_for_vertices_that_are_off(monkeypatch):
    """With the bound as tight as it gets, vertices are moved by 2^-40 and the inequality is proved for them as such."""
    rng = np.random.default_rng(5)
    for kind, name, sign, discrete in (("decay", "rate", 1, False), ("decay", "factor", -1, True),
                                       ("infeasible", "rate", -1, False), ("infeasible", "factor", 1, True),
                                       ("l2", "gamma", -1, False), ("l2", "gamma", -1, True)):  # fmt: skip
        system, gain, data = random_claim(rng, kind, discrete, 0.3)
        low, high = sorted((data[name], data[name] + sign * (0.59 if name == "factor" and kind == "decay" else 3.9)))
        good, bad = (low, high) if sign > 0 else (high, low)
        assert exact.is_proved(kind, system, gain, data | {name: good})
        while abs(good - bad) > 1e-15:
            middle = (good + bad) / 2
            good, bad = (middle, bad) if exact.is_proved(kind, system, gain, data | {name: middle}) else (good, middle)
        data = data | {name: good}

        def off(array):
            return array * (1 + 0.999 * 2.0**-40 * rng.choice([-1, 1], array.shape))

        with monkeypatch.context() as patch:
            replace_seam(patch, "as_uncertain_dyadic", exact.as_dyadic)
            for _ in range(50):
                moved = Polytope(off(system.A), off(system.B), system.period)
                other = {"Bw": off(data["Bw"])} if "Bw" in data else {}
                assert exact.is_proved(kind, moved, gain, data | other)


@pytest.mark.parametrize("seed", range(5))
def test_what_is_proved_is_true_of_systems_inside(seed):
    rng = np.random.default_rng(seed)

    def inside(system):
        weights = rng.dirichlet(np.ones(system.vertices))
        return np.tensordot(weights, system.A, 1), np.tensordot(weights, system.B, 1)

    certificate = example("damping", seed=seed)
    for _ in range(20):
        A, B = inside(certificate.system)
        poles = np.linalg.eigvals(A + B @ certificate.gain)
        assert (-poles.real / abs(poles)).min() > certificate.damping
    certificate = example("scheduled", seed=seed)
    data, K, nodes = certificate.claims[0].data, certificate.gain, certificate.system.nodes
    for _ in range(50):
        c, l, s = rng.integers(2), rng.random(), rng.choice(data["rates"])
        A, B = inside(certificate.system.cells[c])
        P, gain = [x[c] * (1 - l) + x[c + 1] * l if x.ndim == 3 else x for x in (data["P"], K)]
        slope = s * (data["P"][c + 1] - data["P"][c]) / (nodes[c + 1] - nodes[c])
        work = data["Q"] + gain.T @ data["R"] @ gain if "Q" in data else 0
        M = P @ (A + B @ gain)
        assert np.linalg.eigvalsh(M + M.T + slope + 2 * data["rate"] * P + work)[-1] < 0
    certificate = example("l2", seed=seed)
    data = certificate.claims[0].data
    for w in np.logspace(-2, 2, 20):
        A, B = inside(certificate.system)
        Bw = data["Bw"] if data["Bw"].ndim == 2 else data["Bw"][0]
        A, B = (A, B) if data["Bw"].ndim == 2 else (certificate.system.A[0], certificate.system.B[0])
        response = np.linalg.solve(1j * w * np.eye(len(A)) - A - B @ certificate.gain, Bw)
        assert np.linalg.norm((data["C"] + data["D"] @ certificate.gain) @ response, 2) < certificate.l2_gain


@pytest.mark.parametrize("kind", KINDS)
def test_a_file_brings_back_every_bit(kind, tmp_path):
    certificate = example(kind)
    certificate.save(tmp_path / "x.json")
    again = Certificate.load(tmp_path / "x.json")
    assert [each.name for each in tmp_path.iterdir()] == ["x.json"]
    assert plain(again) == plain(certificate)
    assert again.gain.tobytes() == certificate.gain.tobytes()
    for name, value in certificate.claims[0].data.items():
        assert np.asarray(again.claims[0].data[name]).tobytes() == np.asarray(value).tobytes()
    for ours, theirs in zip(again.cells, certificate.cells, strict=True):
        assert (ours.A.tobytes(), ours.B.tobytes(), ours.period) == (theirs.A.tobytes(), theirs.B.tobytes(), None)
    assert again.summary() == certificate.summary() == json.loads(json.dumps(certificate.summary(), allow_nan=False))


def test_awkward_numbers_come_back(tmp_path):
    for number in (-0.0, 5e-324, 1.7976931348623157e308, 0.1 + 0.2, 1 / 3):
        Certificate(scalar(number), [[number]], ()).save(tmp_path / "x.json")
        assert Certificate.load(tmp_path / "x.json").gain.tobytes() == np.array(number).tobytes()


def edited(path, *keys, to):
    """The example's file with one value replaced."""
    stored = plain(Certificate(rig(), [[-1.0, -9.0]], (Claim("decay", {"P": np.eye(2), "rate": 0.0}),)))
    node = stored
    for key in keys[:-1]:
        node = node[key]
    node[keys[-1]] = to
    path.write_text(json.dumps(stored))
    return path


@pytest.mark.parametrize(
    ("keys", "to", "field"),
    [
        (("format",), "other", "format"),
        (("version",), 2, "version"),
        (("version",), True, "version"),
        (("extra",), 1, "extra"),
        (("system",), [], "system"),
        (("system",), {"cells": []}, "system"),
        (("system",), {"parameter": "v", "nodes": [0, 1], "cells": [1]}, "system.cells"),
        (("system", "A"), [[[0.0, 1.0], [0.0]]], "system.A"),
        (("system", "A"), [[[0.0, "1"], [0.0, 1.0]]], "system.A"),
        (("system", "A"), [[[0.0, True], [0.0, 1.0]]], "system.A"),
        (("system", "A"), [], "A of shape"),
        (("system", "B"), None, "system.B"),
        (("system", "period"), -1.0, "system.period"),
        (("system", "period"), "1", "system.period"),
        (("system", "states"), [1.0], "system.states"),
        (("system", "states"), ["x"], "system: numbers of corners and of states' names = (0, 1); needed: 0 or 4"),
        (("system", "coverage"), 1.0, "coverage"),
        (("gain",), [[1.0]], "gain"),
        (("gain",), [-1.0, -9.0], "gain must be a list of rows"),
        (("gain",), [[1.0, float("nan")]], "finite"),
        (("gain",), [[1.0, float("inf")]], "finite"),
        (("gain",), [[1.0, 10**400]], "gain"),
        (("claims",), {}, "claims"),
        (("claims", 0), {"kind": "decay"}, "claims[0]"),
        (("claims", 0, "kind"), "proof", "'proof'"),
        (("claims", 0, "kind"), "cost", "cost"),
        (("claims", 0, "kind"), "scheduled", "scheduled"),
        (("claims", 0, "kind"), ["decay"], "claims[0]"),
        (("claims", 0, "data"), [], "claims[0]"),
        (("claims", 0, "data"), {}, "decay.P is missing"),
        (("claims", 0, "data", "P"), [[1.0]], "decay.P"),
        (("claims", 0, "data", "P"), [[[1.0, 0.0], [0.0, 1.0]]] * 4, "decay.P"),  # one for each vertex proves nothing
        (("claims", 0, "data", "P"), [[1.0, None], [0.0, 1.0]], "claims[0].data.P"),
        (("claims", 0, "data", "rate"), -1.0, "decay.rate"),
        (("claims", 0, "data", "rate"), [1.0], "decay.rate"),
        (("claims", 0, "data", "factor"), 0.5, "decay.factor"),
        (("claims", 0, "verified"), True, "verified"),
    ],
)
def test_a_malformed_file_is_refused_in_one_line(tmp_path, keys, to, field):
    with pytest.raises(ValueError, match=r"x\.json: ") as error:
        Certificate.load(edited(tmp_path / "x.json", *keys, to=to))
    assert field in str(error.value)
    assert "\n" not in str(error.value)


def test_labels_of_a_file_are_not_shown_beside_its_proof(tmp_path, capsys):
    system, k1 = rig(), -20.0
    P, _ = lyapunov(k1, k2 := -4 * (np.sqrt(B * abs(k1)) * (np.sqrt(W_HIGH) - np.sqrt(W_LOW)) + A_HIGH) / B)
    certificate = Certificate(system, [[k1, k2]], (Claim("decay", {"P": P}),))
    assert set(certificate.worst_vertex["corner"]) == {"a", "w"}  # where they come from the model
    document = plain(certificate)
    document["system"]["corners"] = [{"mass": 999.0}] * 4
    assert verdicts(document, tmp_path / "x.json", capsys) == [True] * 3
    loaded = Certificate.load(tmp_path / "x.json")
    assert loaded.worst_vertex["corner"] is None
    assert "999" not in str(loaded) + json.dumps(loaded.summary())
    for check in (checker, outsiders):
        check.main(tmp_path / "x.json")
        assert "999" not in capsys.readouterr().out


def test_a_name_that_comes_twice_is_refused(tmp_path):
    file = edited(tmp_path / "x.json", "version", to=1)
    file.write_text(file.read_text().replace('"gain":', '"gain": [[-1.0, -9.5]], "gain":'))
    with pytest.raises(ValueError, match="a name comes twice among format, version, system, gain, gain"):
        Certificate.load(file)


@pytest.mark.parametrize("text", ["", "{", "[" * 10**5, "[1.0]", "null", '{"a": 1, "a": 2}', "\xff"])
def test_what_is_no_certificate_is_refused_by_both(tmp_path, text, capsys):
    file = tmp_path / "x.json"
    file.write_bytes(text.encode("latin-1"))
    with pytest.raises(ValueError, match="json") as error:
        Certificate.load(file)
    assert "\n" not in str(error.value)
    assert checker.main(file) == 2
    assert capsys.readouterr().err.count("\n") == 1


def test_the_checker_refuses_shapes_that_prove_nothing(tmp_path, capsys):
    for keys, to in ((("system", "A"), []), (("claims", 0, "data", "P"), [[1.0]]), (("system", "B"), [[[0.0], [1.0]]]),
                     (("claims", 0, "data", "P"), [[[1.0, 0.0], [0.0, 1.0]]] * 4), (("gain",), [[1.0]]),
                     (("claims", 0, "data", "factor"), 0.5), (("claims", 0, "data", "P"), [["1", 0.0], [0.0, 1.0]]),
                     (("gain",), [[1.0, float("nan")]]), (("claims", 0, "kind"), "proof")):  # fmt: skip
        assert checker.main(edited(tmp_path / "x.json", *keys, to=to)) == 2
    assert checker.main(edited(tmp_path / "x.json", "claims", to=[])) == 1
    assert checker.main(tmp_path / "none.json") == 2
    capsys.readouterr()


def test_large_files_and_systems_are_refused(tmp_path):
    (tmp_path / "x.json").write_text(" " * (2**24 + 1))
    with pytest.raises(ValueError, match="larger than"):
        Certificate.load(tmp_path / "x.json")


@killed_by("robust.design.proof.serialise", "max(cell.order, cell.inputs) >", "cell.order + cell.inputs >")
@killed_by("robust.design.proof.serialise", "max(nodes, len(arrays), *(", "max(nodes, *(")
@killed_by("robust.design.proof.serialise", "if len(content) > MAX_CERTIFICATE_BYTES:", "if False:")
def test_what_is_saved_is_read_by_both_readers(tmp_path):
    """Up to 64 states and 64 inputs; what a reader refuses is not written."""

    def save(states, inputs, vertices=1):
        system = Polytope(np.full((vertices, states, states), 1 / 3), np.zeros((vertices, states, inputs)))
        Certificate(system, np.zeros((inputs, states)), ()).save(tmp_path / "y.json")

    save(40, 30)
    assert Certificate.load(tmp_path / "y.json").gain.shape == (30, 40)
    assert verify_file(tmp_path / "y.json") == []
    for too_many in ((65, 1), (1, 65)):
        with pytest.raises(ValueError, match="more than 64 states or inputs"):
            save(*too_many)
    with pytest.raises(ValueError, match=r"the certificate is larger than 16777216 bytes"):
        save(64, 1, vertices=170)
    for claim in (Claim("input", {"P": [[1.0]], "limit": [2.0], "points": np.zeros((4097, 1))}),), (Claim(
            "decay", {"P": [[1.0]]}),) * 4097:  # fmt: skip
        with pytest.raises(ValueError, match="a list of 4097 claims, nodes or entries, over 4096"):
            Certificate(scalar(-1.0), [[0.0]], claim).save(tmp_path / "y.json")
    given = json.loads((tmp_path / "y.json").read_text())
    given["gain"], system = [[0.0]] * 65, given["system"]
    system["A"], system["B"] = [[[0.0]]], [[[0.0] * 65]]
    (tmp_path / "y.json").write_text(json.dumps(given))
    with pytest.raises(ValueError, match="more than 64 states or inputs"):
        Certificate.load(tmp_path / "y.json")
    with pytest.raises(ValueError, match="more than 64 states or inputs"):
        verify_file(tmp_path / "y.json")


def test_claims_that_do_not_fit_the_time_are_refused():
    with pytest.raises(ValueError, match="scheduled claims are for continuous time"):
        Certificate(Schedule("v", [0.0, 1.0], (scalar(0.5, 0.1),)), [[0.0]],
                    (Claim("scheduled", {"P": np.ones((2, 1, 1)), "rates": [0, 0]}),))  # fmt: skip
    with pytest.raises(ValueError, match="damping claims are for continuous time"):
        Certificate(scalar(0.5, 0.1), [[0.0]], (Claim("damping", {"P": [[1.0]], "zeta": 0.1, "cot": 0.2}),))


@killed_by("robust.design.proof.certificate", "{name} {value!r}", "{name} {value:.6g}")
def test_what_a_certificate_says():
    P, _ = lyapunov(-20.0, -8.0)
    good, wrong = Claim("decay", {"P": P, "rate": 0.01}), Claim("decay", {"P": P, "rate": 1e4})
    certificate = Certificate(rig(), [-20.0, -8.0], (good, wrong))
    assert certificate.verify() == (True, False)
    assert not certificate.verified_exactly
    assert certificate.quadratically_stable is certificate.stable is True
    assert certificate.decay_rate == 0.01
    worst = certificate.worst_vertex
    assert worst is not None
    assert worst["corner"] == {"a": A_HIGH, "w": W_HIGH}
    assert worst["margin"] == certificate.margins["decay"] < 0
    assert certificate.frozen == tuple(np.linalg.eigvals(rig().closed_loop([-20.0, -8.0])).real.max(axis=1))
    assert str(certificate).count("NOT PROVED") == 1
    assert "rate 0.9999999999" in str(
        Certificate(scalar(-1.0), [0.0], (Claim("decay", {"P": [[1.0]], "rate": 1 - 1e-10}),))
    )
    assert Certificate(rig(), [-20.0, -8.0], (wrong,)).quadratically_stable is None
    assert not Certificate(rig(), [-20.0, -8.0], ()).verified_exactly
    with pytest.raises(ValueError, match="read-only"):
        certificate.system.A[0, 0, 0] = 1.0


def test_costs_are_rounded_up_and_only_claimed_until_proved():
    data = {"P": [[0.1, 0.0], [0.0, 0.2]], "Q": 0.01 * np.eye(2), "R": [[1.0]]}
    certificate = Certificate(Polytope([-np.eye(2)], np.zeros((1, 2, 1))), [0.0, 0.0], (Claim("cost", data),))
    trace = Fraction(0.1) + Fraction(0.2)
    below = np.nextafter(certificate.guaranteed_cost, 0)
    assert Fraction(float(below)) < trace <= Fraction(certificate.guaranteed_cost)
    unproved = Certificate(scalar(1.0), [[0.0]], (Claim("cost", {"P": [[7.0]], "Q": [[1.0]], "R": [[1.0]]}),))
    assert unproved.summary()["trace_cost"] == 7.0
    assert unproved.summary()["guaranteed_cost"] is None
    discrete = Certificate(scalar(0.5, 0.1), [[0.0]], (Claim("decay", {"P": [[1.0]], "factor": 0.6}),))
    assert discrete.decay_rate == -np.log(0.6) / 0.1


@killed_by("robust.design.spec", "if find_value_objection(value) or np.ndim(value):", "if False:", case="text")
@killed_by("robust.design.spec", "np.shape(rates) != (2,)", "False", case="one rate")
@killed_by("robust.design.spec", "if not scheduled:", "if False:", case="of a polytope")
@pytest.mark.parametrize(
    ("given", "message"),
    [
        pytest.param({"decay": "2"}, r"decay = '2' is no number in \[0, inf\) 1/s", id="text"),
        pytest.param({"decay": (1.0, 2.0)}, r"decay = \(1.0, 2.0\) is no number in \[0, inf\) 1/s", id="two numbers"),
        pytest.param({"damping": "a"}, r"damping = 'a' is no number in \[0, 1\)", id="damping"),
        pytest.param({"l2": L2Gain([[1.0]], bound="1")}, r"L2 bound = '1' is no number in \(0, inf\)", id="bound"),
        pytest.param({"rates": 1.0}, r"rates = 1.0 is not a pair \(low, high\) of finite numbers", id="one rate"),
        pytest.param({"rates": (1.0, "2")}, r"rates = \(1.0, '2'\) is not a pair", id="rate of text"),
        pytest.param({"rates": (2.0, 1.0)}, r"rates = \(2.0, 1.0\) is not a pair", id="inverted"),
        pytest.param({"rates": (0.0, math.nan)}, r"rates = \(0.0, nan\) is not a pair", id="nan"),
        pytest.param({"rates": (-1.0, 0.0)}, "rates belong to a schedule", id="of a polytope"),
    ],
)
def test_a_specification_says_what_does_not_fit(given, message):
    with pytest.raises(ValueError, match=message):
        Spec(**given).check(1, 1)


@killed_by("robust.design.analysis", "if unstable := self._refute_by_vertex():", "if unstable := None:")
@killed_by("robust.design.instability", "max(0.0, (low + high) / 2)", "0.0", case="None")
@pytest.mark.parametrize("period", [None, 0.1])
def test_a_growing_mode_of_one_vertex_disproves_stability(period, tmp_path):
    """Whatever the other modes and vertices are, and in any units; the growth is 5 % a period, or 0.05 1/s."""
    pytest.importorskip("cvxpy")
    random = np.random.default_rng(3)
    for _ in range(12):
        n = int(random.integers(1, 6))
        a, units = random.standard_normal((n, n)), 10.0 ** random.uniform(-5, 5, n)
        modes = np.linalg.eigvals(a)
        a = 1.05 * a / abs(modes).max() if period else a - (modes.real.max() - 0.05) * np.eye(n)
        vertices = [0.5 * np.eye(n) if period else -np.eye(n), a * units[:, None] / units]
        system, gain = Polytope(vertices, np.ones((2, n, 1)), period), np.zeros((1, n))
        found = certify(gain, system)
        assert (found.quadratically_stable, found.stable, found.claims[0].kind) == (False, None, "unstable")
        assert both(system, gain, "unstable", **found.claims[0].data)
        found.save(tmp_path / "c.json")
        assert [verdict.reason for verdict in verify_file(tmp_path / "c.json")] == [""]


def test_a_sum_of_states_that_stays_disproves_stability():
    """The speed of a mass without a force stays: no rounding of its entries changes that."""
    pytest.importorskip("cvxpy")
    found = certify([0.0, 0.0], Polytope([[[0.0, 1.0], [0.0, 0.0]]], [[[0.0], [1.0]]]))
    assert found.quadratically_stable is False
    assert both(found.system, found.gain, "unstable", **found.claims[0].data)


@killed_by("robust.design.proof.exact", 'yield Inequality((-(row @ data["P"] @ row.mT),))', "pass")
@killed_by("robust.design.verify", 'd["x"]]))[0][0] < 0', 'd["x"]]))[0][0] < 9')
@pytest.mark.parametrize(
    ("a", "period", "data", "proved"),
    [
        (-1.0, None, {"P": [[1.0]], "x": [1.0], "vertex": 0.0}, False),  # P > 0: the loop is stable
        (-1.0, None, {"P": [[-1.0]], "x": [1.0], "vertex": 0.0}, False),
        (-1.0, None, {"P": [[-1.0]], "x": [1.0], "vertex": 0.0, "rate": 1 + 1e-9}, True),  # slower than that rate
        (1.0, None, {"P": [[-1.0]], "x": [0.0], "vertex": 0.0}, False),
        (1.0, None, {"P": [[-1.0]], "x": [1.0], "vertex": 0.0, "rate": -1 + 1e-9}, True),
        (1.0, None, {"P": [[-1.0]], "x": [1.0], "vertex": 0.0, "rate": -1 - 1e-9}, False),
        (2.0, 0.1, {"P": [[-1.0]], "x": [1.0], "vertex": 0.0, "factor": 2 - 1e-9}, True),
        (2.0, 0.1, {"P": [[-1.0]], "x": [1.0], "vertex": 0.0, "factor": 2 + 1e-9}, False),
    ],
)
def test_a_scalar_grows_at_its_rate(a, period, data, proved, tmp_path):
    system = scalar(a, period)
    assert both(system, [[0.0]], "unstable", **data) == proved
    Certificate(system, [[0.0]], (Claim("unstable", data),)).save(tmp_path / "c.json")
    assert [not verdict.reason for verdict in verify_file(tmp_path / "c.json")] == [proved]


def test_a_vertex_that_does_not_exist_is_refused():
    for vertex in (1.0, 0.5, -1.0):
        with pytest.raises(ValueError, match=r"^unstable.vertex must be one of 0 to 0; got "):
            Certificate(scalar(1.0), [[0.0]], (Claim("unstable", {"P": [[-1.0]], "x": [1.0], "vertex": vertex}),))


def is_stable(loop, *, discrete):
    """Of a 2 x 2 matrix of fractions: the conditions of Routh and of Jury, without rounding."""
    trace = loop[0][0] + loop[1][1]
    determinant = loop[0][0] * loop[1][1] - loop[0][1] * loop[1][0]
    return abs(determinant) < 1 and abs(trace) < 1 + determinant if discrete else trace < 0 < determinant


@pytest.mark.slow
@killed_by("robust.design.sdp.scaling", 'warnings.simplefilter("ignore", RuntimeWarning)', "pass")
@pytest.mark.parametrize("discrete", [False, True], ids=["continuous", "discrete"])
def test_ill_conditioned_loops_are_right_or_undecided(discrete):
    """Of condition 1e12, with gains that nearly cancel, in units far apart, and down to 1e-12 from the edge."""
    draw, verdicts = np.random.default_rng(3), []
    for case in range(24):
        one, other = (np.linalg.qr(draw.normal(size=(2, 2)))[0] for _ in range(2))
        change = one @ np.diag([1.0, 10.0 ** draw.choice([2, 12])]) @ other
        margin = draw.choice([-1, 1]) * draw.choice([0.3, 1e-3, 1e-6, 1e-12])
        modes = [1 + margin, draw.uniform(-0.9, 0.9)] if discrete else [margin, -np.exp(draw.uniform(-6, 6))]
        b, k = draw.normal(size=(2, 1)), np.zeros((1, 2))
        if case % 3:
            b, k = (x * 10.0 ** draw.uniform(-6, 6, x.shape) for x in (b, draw.normal(size=(1, 2))))
        a = change @ np.diag(modes) @ np.linalg.inv(change) - b @ k
        loop = [[Fraction(a[i, j]) + Fraction(b[i, 0]) * Fraction(k[0, j]) for j in range(2)] for i in range(2)]
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            found = certify(k, Polytope([a], [b], period=0.01 if discrete else None))
        verdicts.append((found.quadratically_stable, is_stable(loop, discrete=discrete)))
    assert all(found in (None, right) for found, right in verdicts)
    assert {found for found, _ in verdicts} > {None}
