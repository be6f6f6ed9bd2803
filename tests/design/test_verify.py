"""`diffabs verify`: proves what is true, in fractions, and nothing that is false or no claim at all."""

import contextlib
import copy
import inspect
import json
import os
import subprocess
import sys
import time
from fractions import Fraction

import checker
import numpy as np
import pytest
from commands import assert_one_error_line, run
from marks import readable_id
from mutants import killed_by
from scipy.linalg import solve_continuous_lyapunov, solve_discrete_lyapunov

from diffabs.cli import verify as command_verify
from diffabs.robust.design import verify
from diffabs.robust.design.polytopes import Polytope, Schedule
from diffabs.robust.design.proof.certificate import Certificate, Claim

C = np.array([[-1.0, 2.0], [-2.0, -1.0]])  # poles -1 +- 2j, damping 1/sqrt(5) = 0.447
STEP = np.array([[0.5, 0.2], [-0.2, 0.5]])  # radius sqrt(0.29) = 0.5385
K = np.zeros((1, 2))
B = np.array([[0.0], [1.0]])


def certificate(kind, a=C, period=None, gain=K, **data):
    return Certificate(Polytope([a], [B], period), gain, (Claim(kind, data),))


def lyapunov(a, q=1.0):
    return solve_continuous_lyapunov(a.T, -q * np.eye(2))


def cases():
    """Of each kind a true claim, and the same just beyond the truth."""
    p, one = lyapunov(C), np.eye(2)
    weights = {"Q": 0.9 * one, "R": np.eye(1)}
    zeta = 1 / np.sqrt(5)
    cone = {"P": one, "zeta": 0.44, "cot": 0.44 / np.sqrt(1 - 0.44**2) * 1.001}
    outside = {"P": one, "zeta": 0.46, "cot": 0.46 / np.sqrt(1 - 0.46**2) * 1.001}
    assert cone["zeta"] < zeta < outside["zeta"]
    gain = {"P": 2 * one, "Bw": B, "C": one[:1], "D": np.zeros((1, 1))}
    points = {"P": one, "points": [[0.5, 0.5]]}
    k = np.array([[0.3, 0.4]])
    yield certificate("decay", P=one, rate=0.999), certificate("decay", P=one, rate=1.0)
    yield certificate("decay", STEP, 0.1, P=one, factor=0.539), certificate("decay", STEP, 0.1, P=one, factor=0.538)
    yield certificate("cost", P=p, **weights), certificate("cost", P=p, Q=1.01 * one, R=np.eye(1))
    yield certificate("damping", **cone), certificate("damping", **outside)
    yield certificate("l2", gamma=2.5, **gain), certificate("l2", gamma=0.05, **gain)
    held = {"gain": k, "a": C - B @ k, **points}
    yield certificate("input", limit=[0.51], **held), certificate("input", limit=[0.49], **held)
    yield certificate("infeasible", -C, W=[one]), certificate("infeasible", C, W=[one])
    yield certificate("infeasible", 2 * STEP, 0.1, W=[one]), certificate("infeasible", STEP, 0.1, W=[one])
    yield chain(rates=(-0.5, 0.5)), chain(rates=(-50.0, 50.0))


def chain(rates, **cost):
    cells = tuple(Polytope([s * C], [B]) for s in (1.0, 1.1))
    forms = np.array([np.eye(2), 1.1 * np.eye(2), 1.2 * np.eye(2)])
    return Certificate(
        Schedule("speed", [1.0, 2.0, 3.0], cells), K, (Claim("scheduled", {"P": forms, "rates": rates, **cost}),)
    )


IDS = ["decay", "decay in steps", "cost", "damping", "l2", "input", "infeasible", "infeasible in steps", "scheduled"]


def saved(proof, folder):
    proof.save(folder / "c.json")
    return folder / "c.json"


@pytest.mark.parametrize("pair", list(cases()), ids=IDS)
def test_each_kind_is_proved_if_it_is_true_and_only_then(tmp_path, pair):
    for proof, true in zip(pair, (True, False), strict=True):
        (verdict,) = verify.verify_file(saved(proof, tmp_path))
        stored = json.loads((tmp_path / "c.json").read_text(), parse_int=float)
        claim = stored["claims"][0]
        assert (not verdict.reason) is true
        assert checker.proved(stored["system"], stored["gain"], claim["kind"], claim["data"]) is true
        assert verdict.says


@killed_by("robust.design.verify", "((kx, ky), (ky, kx)) if", "((kx, ky), (kx, ky)) if")
@killed_by(
    "robust.design.proof.exact", '(Kx.mT @ data["R"] @ Ky + Ky.mT @ data["R"] @ Kx)', 'he(Kx.mT @ data["R"] @ Ky)'
)
def test_an_effort_that_is_not_symmetric_is_counted_whole(tmp_path):
    """Half way V' + x'(Q + K'RK)x = 0.049 x^2, though the symmetric part of Ka'R Kb alone would leave it negative."""
    k, p, q = np.array([[[-4.11], [0.0]], [[-2.23], [0.01]]]), np.array([2.0, 1.0]), 1e-6
    r = np.eye(2) + 1e3 * np.array([[0.0, 1.0], [-1.0, 0.0]])
    a, b = -4 + 4.11 * 2 / 1.88, np.array([[2 / 1.88, 0.0]])
    middle, gain = p.mean(), k.mean(axis=0)
    grown = 2 * middle * (a + (b @ gain).item()) + (p[1] - p[0]) + q + (gain.T @ r @ gain).item()
    np.testing.assert_allclose(grown, 0.049, atol=1e-3)
    data = {"P": p[:, None, None], "rates": (1.0, 1.0), "Q": [[q]]}
    system = Schedule("speed", [0.0, 1.0], (Polytope([[[a]]], [b]),))
    for scale, true in ((1.0, False), (0.9, True)):
        proof = Certificate(system, k, (Claim("scheduled", data | {"R": scale * r}),))
        (verdict,) = verify.verify_file(saved(proof, tmp_path))
        stored = json.loads((tmp_path / "c.json").read_text(), parse_int=float)
        claim = stored["claims"][0]
        assert (not verdict.reason) is proof.verified_exactly is true
        assert checker.proved(stored["system"], stored["gain"], claim["kind"], claim["data"]) is true


def test_it_agrees_with_the_checker_of_the_tests(tmp_path):
    """Random P, from SciPy's Lyapunov equation and beside it, in continuous time and in steps."""
    rng, seen = np.random.default_rng(0), []
    for _ in range(60):
        a, period = rng.standard_normal((2, 2)), rng.choice([None, 0.1])
        off = rng.standard_normal((2, 2)) * rng.choice([0.0, 0.05, 0.5])
        try:
            p = lyapunov(a) if period is None else solve_discrete_lyapunov(a.T, np.eye(2))
        except np.linalg.LinAlgError:
            continue
        proof = certificate("decay", a, period, P=(p + p.T + off + off.T) / 2)
        (verdict,) = verify.verify_file(saved(proof, tmp_path))
        stored = json.loads((tmp_path / "c.json").read_text(), parse_int=float)
        claim = stored["claims"][0]
        seen.append(not verdict.reason)
        assert seen[-1] is checker.proved(stored["system"], stored["gain"], claim["kind"], claim["data"])
    assert 10 < sum(seen) < len(seen) - 10


# What a claim must contain: an unstable gain, x' = +x


UNSTABLE = {"A": [[[1.0]]], "B": [[[1.0]]], "period": None, "states": [], "corners": []}


def document(kind="decay", system=UNSTABLE, gain=((0.0,),), **data):
    claims = [{"kind": kind, "data": data}]
    return {"format": "diffabs certificate", "version": 1, "system": system, "gain": gain, "claims": claims}


def stepping(radius):
    return {**UNSTABLE, "A": [[[radius]]], "period": 0.1}


FALSE = [
    (document("cost", P=[[1.0]], Q=[[-10.0]], R=[[1.0]]), 2, "claims[0].data.Q is outside a weight"),
    (document("cost", P=[[1.0]], Q=[[0.0]], R=[[1.0]]), 1, "vertex 0: what V falls by is not positive definite"),
    (document(P=[[1.0]], rate=-1e9), 2, "claims[0].data.rate is outside [0, inf)"),
    (document(P=[[1.0]], system=stepping(2.0), factor=100.0), 2, "claims[0].data.factor is outside (0, 1]"),
    (document(P=[[1.0]], system=stepping(2.0), factor=-100.0), 2, "claims[0].data.factor is outside (0, 1]"),
    (document(P=[[1.0]], system=stepping(2.0), rate=1.0), 2, "claims[0].data.rate is not a field"),
    (document(P=[[1.0]], system={**UNSTABLE, "A": [], "B": []}), 2, "system.A must be a list of 1 to 4096"),
    (document(P=[[1.0]], system={}), 2, "system must have the members A, B, period, states, corners and no other"),
    (document(P=[[-1.0]]), 1, "P is not positive definite"),
    (document(P=[[0.0]], system={**UNSTABLE, "A": [[[-1.0]]]}), 1, "P is not positive definite"),
    (document(P=[]), 2, "claims[0].data.P must be a list of 1 to 4096"),
    (document(P=[[1.0, 0.0]]), 2, "claims[0].data.P[0] has 2 entries; 1 are needed"),
    (document(P=[[True]]), 2, "claims[0].data.P[0][0] must be a finite number"),
    (document(P=[[1e999]]), 2, "Infinity is not a number"),
    (document(), 2, "claims[0].data.P is missing in a claim of kind decay"),
    (document("stable", P=[[1.0]]), 2, "claims[0] needs a kind, one of decay, cost"),
    (document("infeasible", W=[]), 2, "claims[0].data.W must be a list"),
    (document("infeasible", W=[[[0.0]]]), 1, "the sum over the vertices is not positive definite"),
    (document("infeasible", system={**UNSTABLE, "A": [[[-1.0]]]}, W=[[[-1.0]]]), 1, "W is not positive definite"),
    (document("scheduled", P=[[[1.0]]], rates=[0.0, 1.0]), 2, "a claim of kind scheduled does not fit the system"),
    (document("damping", P=[[1.0]], system=stepping(0.5), zeta=0.1, cot=1.0), 2, "does not fit the system"),
    ({**document(), "claims": []}, 1, "the file has no claims"),
    ({}, 2, "the file must have the members format, version, system, gain, claims and no other"),
    ([], 2, "the file must have the members"),
    ({**document(), "version": 2}, 2, "version = 2.0; 1.0 is needed"),
]


@killed_by(
    "robust.design.verify",
    '"Q": ("a weight: no diagonal entry below 0", lambda x: min(row[i] for i, row in enumerate(x)) >= 0)',
    '"Q": ("", lambda x: True)',
)
@killed_by("robust.design.verify", 'yield f"vertex {i}: what V falls by", is_positive_definite(falls)', "pass")
@killed_by(
    "robust.design.verify",
    '("[0, inf)", lambda x: x >= 0),\n    "factor"',
    '("[0, inf)", lambda x: True),\n    "factor"',
)
@pytest.mark.parametrize(("content", "status", "needed"), FALSE, ids=[readable_id(needed) for *_, needed in FALSE])
def test_nothing_false_and_no_nonsense_is_proved(tmp_path, content, status, needed):
    (tmp_path / "c.json").write_text(json.dumps(content))
    result = run("verify", tmp_path / "c.json", status=status)
    assert needed in result.stderr
    assert result.stderr.startswith("verdict: " if status == 1 else "error: ")
    assert result.stderr.count("\n") == 1
    assert not any(line.startswith("proved") for line in result.stdout.splitlines())


def test_no_file_and_no_json(tmp_path):
    (tmp_path / "deep.json").write_text("[" * 100_000)
    (tmp_path / "binary.json").write_bytes(b"\xff\xfe\x00")
    (tmp_path / "twice.json").write_text('{"format": 1, "format": 2}')
    (tmp_path / "digits.json").write_text("[" + "1" * 5000 + "]")
    os.mkfifo(tmp_path / "fifo")
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    for name in ("none.json", "deep.json", "binary.json", "twice.json", "digits.json", "fifo", "loop", "."):
        assert_one_error_line(run("verify", tmp_path / name, status=2))


def test_one_bit_of_a_proof_matters_or_leaves_it_true(tmp_path):
    """No change of any one number is proved but where the checker of the tests proves it too."""
    stored = json.loads(saved(certificate("cost", P=lyapunov(C), Q=0.9 * np.eye(2), R=np.eye(1)), tmp_path).read_text())
    for factor in (0.0, -1.0, 0.5, 1.2, 1e9):
        for path in [("system", "A", 0, 0, 0), ("system", "A", 0, 0, 1), ("gain", 0, 0), *(
                ("claims", 0, "data", name, 0, 0) for name in "PQR")]:  # fmt: skip
            changed = copy.deepcopy(stored)
            place = changed
            for key in path[:-1]:
                place = place[key]
            place[path[-1]] = float(place[path[-1]] * factor if path[0] != "gain" else factor)
            (tmp_path / "changed.json").write_text(json.dumps(changed))
            try:
                (verdict,) = verify.verify_file(tmp_path / "changed.json")
            except ValueError:
                continue
            claim = json.loads(json.dumps(changed), parse_int=float)
            first = claim["claims"][0]
            assert (not verdict.reason) is checker.proved(claim["system"], claim["gain"], "cost", first["data"])


# The command


def test_what_it_says(tmp_path):
    path = saved(certificate("decay", P=np.eye(2), rate=0.5), tmp_path)
    result = run("verify", path)
    assert result.stdout == "proved  decay: stable, with a decay of at least 0.5 1/s, however the system varies\n"
    found = json.loads(run("verify", path, "--json").stdout)
    assert (found["proved"], found["claims"][0]["proved"], found["claims"][0]["reason"]) == (True, True, "")


LARGE = Certificate(Polytope([-np.eye(64)], [np.ones((64, 1))]), np.zeros((1, 64)), (
    Claim("input", {"P": np.eye(64), "limit": [1.0], "points": np.full((2, 64), 0.1)}),
))  # fmt: skip
DISTURBED = {"P": np.eye(2), "gamma": 2.5, "Bw": [[[1 / 3], [0.0]]], "C": np.eye(2), "D": [[0.0], [1.0]]}


@killed_by("robust.design.verify", '("Bw", "C", "D"))', '("C", "D"))', case="l2")
@killed_by("robust.design.verify", "repr(float(value))", 'f"{float(value):.9g}"', case="above 1")
@killed_by("robust.design.verify", "if math.prod(sizes) > MAX_STATED_NUMBERS:", "if False:", case="large")
@pytest.mark.parametrize(
    ("proof", "statement"),
    [
        pytest.param(
            certificate("l2", **DISTURBED),
            "the L2 gain from w to C x + D u is below 2.5, where Bw w acts on the states:"
            " Bw = [[[0.3333333333333333], [0]]], C = [[1, 0], [0, 1]], D = [[0], [1]]",
            id="l2",
        ),
        pytest.param(
            certificate("l2", 0 * C, 1.0, P=(1 + 1e-9) * np.eye(2), gamma=1.00000000104, Bw=B, C=np.eye(2), D=0 * B),
            "the L2 gain from w to C x + D u is below 1.00000000104, where Bw w acts on the states:"
            " Bw = [[0], [1]], C = [[1, 0], [0, 1]], D = [[0], [0]]",
            id="above 1",
        ),
        pytest.param(
            certificate("cost", P=lyapunov(C), Q=0.9 * np.eye(2), R=np.eye(1)),
            "the cost from x is at most x'Px, trace P about 1, for Q = [[0.9, 0], [0, 0.9]], R = [[1]]",
            id="cost",
        ),
        pytest.param(
            certificate("input", P=np.eye(2), limit=[0.123456789], points=[[0.5, -0.5]]),
            "each |u| stays below its limit from every start in the hull of the points:"
            " limit = [0.123456789], points = [[0.5, -0.5]]",
            id="input",
        ),
        pytest.param(
            chain((-0.5, 0.5), Q=0.1 * np.eye(2), R=[[0.1]]),
            "stable, with a decay of at least 0 1/s, while the parameter p stays within the nodes and moves at"
            " -0.5 to 0.5 a second, and the cost from x is at most x'P(p)x for Q = [[0.1, 0], [0, 0.1]], R = [[0.1]]",
            id="scheduled",
        ),
        pytest.param(
            LARGE,
            "each |u| stays below its limit from every start in the hull of the points:"
            " limit = [1], points of the file (2 by 64)",
            id="large",
        ),
    ],
)
def test_a_statement_has_its_numbers(tmp_path, proof, statement):
    """Nothing else in a file ties a claim to its disturbance, output, limits and starts."""
    (verdict,) = verify.verify_file(saved(proof, tmp_path))
    assert (verdict.says, verdict.reason) == (statement, "")


@pytest.mark.slow
def test_the_checker_imports_no_solver_and_no_diffabs(tmp_path):
    path = saved(certificate("decay", P=np.eye(2), rate=0.5), tmp_path)
    code = "import sys; sys.modules.update(dict.fromkeys(['cvxpy', 'scipy', 'clarabel', 'optax'])); "
    code += f"import diffabs.cli.main as c; c.app(['verify', {str(path)!r}])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout.split(":")[0]) == (0, "proved  decay"), done.stderr
    alone = (
        "import sys; sys.modules.update(jax=None, numpy=None, diffabs=None); import runpy; "
        f"m = runpy.run_path({verify.__file__!r}); assert not m['verify_file']({str(path)!r})[0].reason"
    )
    done = subprocess.run([sys.executable, "-c", alone], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


# As long as it may take


def large(n, exponent=2.0, vertices=1):
    """A decay of n states, of numbers over so many decades to both sides: A is about -1000, P about 1e10."""
    rng = np.random.default_rng(n)

    def drawn():
        return rng.uniform(0.1, 1.0, (n, n)) * 10.0 ** rng.uniform(-exponent, exponent, (n, n))

    p = np.tril(1e-3 * drawn(), -1)
    p = p + p.T + 10.0 ** (exponent + 8) * np.eye(n)
    a = [(drawn() * (1 - np.eye(n)) - 1e3 * np.eye(n)).tolist() for _ in range(vertices)]
    system = {**UNSTABLE, "A": a, "B": [[[0.0]] * n] * vertices}
    return document(system=system, gain=[[0.0] * n], P=p.tolist(), rate=0.0)


def test_many_states_are_decided(tmp_path):
    path = tmp_path / "c.json"
    path.write_text(json.dumps(large(32)))
    begun = time.monotonic()
    (verdict,) = verify.verify_file(path)
    assert not verdict.reason
    assert time.monotonic() - begun < 5


@pytest.mark.slow
@pytest.mark.parametrize("given", [(64, 250.0), (64, 2.0, 40)], ids=["digits", "vertices"])
def test_what_takes_too_long_is_refused(given, tmp_path):
    path = tmp_path / "c.json"
    path.write_text(json.dumps(large(*given)))
    begun = time.monotonic()
    result = run("verify", path, "--seconds", "0.5", status=2)
    assert time.monotonic() - begun < 5
    assert "is not decided within 0.5 s, so nothing is proved" in result.stderr
    assert_one_error_line(result)


def test_the_command_takes_as_long_as_the_library():
    (option,) = [
        one.default
        for name, one in inspect.signature(command_verify.verify_certificate).parameters.items()
        if name == "seconds"
    ]
    assert option == verify.MAX_SECONDS


def test_no_time_is_no_answer(tmp_path):
    assert "--seconds = 0 is outside (0, inf) s" in run("verify", tmp_path / "c.json", "--seconds", 0, status=2).stderr


@pytest.mark.slow
@pytest.mark.parametrize("given", [(64,), (24, 280.0), (64, 280.0), (64, 2.0, 40)])
def test_an_answer_or_a_refusal_within_ten_seconds(given, tmp_path):
    path = tmp_path / "c.json"
    path.write_text(json.dumps(large(*given)))
    begun = time.monotonic()
    with contextlib.suppress(ValueError):
        verify.verify_file(path)
    assert time.monotonic() - begun < 10


def test_a_trace_beyond_all_doubles_is_one_line(tmp_path):
    path = tmp_path / "c.json"
    huge = (np.eye(2) * 1.7e308).tolist()
    system = {**UNSTABLE, "A": [(-np.eye(2)).tolist()], "B": [[[0.0], [0.0]]]}
    path.write_text(json.dumps(document("cost", system, [[0.0, 0.0]], P=huge, Q=np.eye(2).tolist(), R=[[1.0]])))
    with pytest.raises(ValueError, match="beyond the largest double"):
        verify.verify_file(path)


def test_elimination_agrees_with_the_eigenvalues():
    """Positive, semidefinite, indefinite and singular matrices of whole numbers, exact in doubles."""
    rng, seen = np.random.default_rng(4), set()
    for _ in range(300):
        n, rank = rng.integers(1, 6), rng.integers(1, 6)
        factor = rng.integers(-2, 3, (n, rank))
        m = factor @ factor.T - rng.choice([0, 0, 1]) * np.diag(rng.integers(0, 2, n))
        least = np.linalg.eigvalsh(m)[0]
        exact = [[Fraction(int(x), 3) for x in row] for row in m]
        for semi in (False, True):
            wanted = least > -1e-9 if semi else least > 1e-9
            assert verify.is_positive_definite(exact, semi) is bool(wanted), m
            seen.add((semi, bool(wanted)))
    assert len(seen) == 4
