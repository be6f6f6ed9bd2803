"""Changed certificates, for `fuzz_files`: whoever still calls one proved must be right, by eigenvalues in floats."""

import contextlib
import io
import json
import os
import pathlib
import subprocess
import sys
import tempfile

import checker
import numpy as np
from fuzz_files import damaged, edited, in_a_line
from project import ROOT
from scipy.linalg import expm, solve_continuous_lyapunov, solve_discrete_lyapunov

from diffabs.robust.design.polytopes import Polytope, Schedule
from diffabs.robust.design.proof.certificate import Certificate, Claim

ARRAYS = {"A", "B", "gain", "nodes", "P", "Q", "R", "W", "x0", "Bw", "C", "D", "limit", "points", "rates"}
ROUNDING = 1e-7  # of the norm of a matrix, for its eigenvalues
SHORT = ROOT / "tests" / "support" / "check_certificate.py"


def lyapunov(C, Q, discrete=False):
    """P of C'P + PC = -Q, or P - C'PC = Q."""
    P = solve_discrete_lyapunov(C.T, Q) if discrete else solve_continuous_lyapunov(C.T, -Q)
    return (P + P.T) / 2


def originals():
    """Certificates of every kind, proved, about two vertices of order 2."""
    A = np.array([[[0.0, 1.0], [-2.0, 0.5]], [[0.0, 1.0], [-2.4, 0.4]]])
    B = np.array([[[0.0], [1.0]], [[0.0], [1.1]]])
    K, eye = np.array([[-2.0, -3.5]]), np.eye(2)
    loops = A + B @ K
    P = lyapunov(loops.mean(axis=0), eye)
    system, names = Polytope(A, B), ("position", "speed")
    named = Polytope(A, B, None, names, ({"mass": 1.0}, {"mass": 1.2}))
    price = {"Q": 0.1 * eye, "R": np.array([[0.01]])}
    yield named, K, [("decay", {"P": P, "rate": 0.1}), ("cost", {"P": P, **price, "x0": np.array([1.0, 0.0])})]
    yield system, K, [("damping", {"P": P, "zeta": 0.3, "cot": 0.32}), ("decay", {"P": P})]
    yield system, K, [("l2", {"P": 4 * P, "gamma": 9.0, "Bw": B[0], "C": eye[:1], "D": np.zeros((1, 1))})]
    scaled = P / P[0, 0]
    limit = np.array([1.01 * np.abs(K @ np.linalg.inv(scaled) @ K.T)[0, 0] ** 0.5])
    yield system, K, [("input", {"P": scaled, "limit": limit, "points": np.array([[0.9, 0.0], [-0.9, 0.0]])})]
    discrete = np.array([expm(0.1 * C) for C in loops])
    step = Polytope(discrete, 0 * B, 0.1)
    Pd = lyapunov(discrete.mean(axis=0), eye, True)
    yield step, 0 * K, [("decay", {"P": Pd, "factor": 0.995}), ("cost", {"P": Pd, "Q": 0.1 * eye, "R": np.eye(1)})]
    bad = Polytope(-loops, 0 * B)
    W = np.array([solve_continuous_lyapunov(-C, eye) for C in loops])
    yield bad, 0 * K, [("infeasible", {"W": (W + W.transpose(0, 2, 1)) / 2, "rate": 0.0})]
    cells = (Polytope(A, B), Polytope(A, B))
    nodes = {"P": np.array([P, 1.01 * P, 1.02 * P]), "rates": np.array([-1.0, 1.0]), "rate": 0.05}
    yield Schedule("speed", np.array([0.0, 1.0, 2.0]), cells), K, [("scheduled", nodes)]


def numbers(rng, document):
    """Other numbers in the place of an array or a number. What changed."""
    homes = [*document["system"].get("cells", [document["system"]]), document["system"], document]
    homes += [claim["data"] for claim in document["claims"]] * 3
    home = rng.choice(homes)
    fit = [name for name, value in home.items() if isinstance(value, float | int) or name in ARRAYS]
    if not fit:
        return "nothing"
    name, how = (
        rng.choice(fit),
        rng.choice(["scale", "scale", "near", "near", "negate", "zero", "turn", "huge", "fewer"]),
    )
    value = np.array(home[name], float)
    noise = np.array([rng.gauss(0, 1) for _ in range(value.size)]).reshape(value.shape)
    if value.ndim >= 2 and value.shape[-1] == value.shape[-2]:
        noise = noise + noise.swapaxes(-1, -2)  # what is symmetric stays so
    factor = 10.0 ** rng.choice([-9, -2, -0.3, -1e-3, 1e-3, 0.3, 2, 9])
    made = {
        "scale": factor * value,
        "near": value + rng.choice([1e-12, 1e-3, 0.1, 1.0]) * noise,
        "negate": -value,
        "zero": 0 * value,
        "turn": value[::-1] if value.ndim else -100.0 * value,
        "huge": 1e200 * value,
        "fewer": value[:-1] if value.ndim else value + 1.0,
    }
    home[name] = made[how].tolist()
    return f"{how} {name}"


class Certificates:
    """A call changes one of the originals and asks everyone who verifies."""

    def __init__(self, outsiders=True):
        self.outsiders, self.texts = outsiders, []
        for system, gain, claims in originals():
            made = Certificate(system, gain, tuple(Claim(kind, data) for kind, data in claims))
            assert made.verified_exactly, str(made)
            with tempfile.TemporaryDirectory() as room:
                made.save(pathlib.Path(room) / "x.json")
                self.texts.append((pathlib.Path(room) / "x.json").read_text())

    def __call__(self, rng, room):
        text, path = rng.choice(self.texts), room / "x.json"
        if rng.random() < 0.15:
            data, what = damaged(rng, text.encode())
        else:
            document = json.loads(text)
            change = numbers if rng.random() < 0.7 else edited
            what = "; ".join([change(rng, document) for _ in range(rng.choice([1, 1, 2]))])
            data = json.dumps(document).encode()
        path.write_bytes(data)
        name = "no reader yet"
        try:
            asked = [("certificate", self.package), ("tests/support/checker.py", self.exact)]
            asked += [("check_certificate.py", self.short)] if self.outsiders else []
            outcomes = []
            for name, reader in asked:
                outcomes.append((name, reader(path)))
            return what, outcomes
        except Exception as error:
            error.mutation = f"{what} ({name})"
            raise

    def package(self, path):
        try:
            found = Certificate.load(path)
        except ValueError as error:
            return in_a_line(error)
        verdicts = found.verify()
        document = json.loads(path.read_text(), parse_int=float)
        for claim, verdict in zip(document["claims"], verdicts, strict=True):
            if verdict:
                assert_true(document, claim)
        assert all(map(str, (found.summary(), found)))
        return "proved, and true" if all(verdicts) and verdicts else "not proved"

    def exact(self, path):
        with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()) as said:
            status = checker.main(path)
        return self._judged(path, status, said.getvalue())

    def short(self, path):
        done = subprocess.run(
            [sys.executable, "-S", SHORT, path], capture_output=True, text=True, env={"PATH": os.environ["PATH"]}
        )
        assert "Traceback" not in done.stderr, done.stderr.strip().splitlines()[-1]
        return self._judged(path, done.returncode, done.stderr)

    def _judged(self, path, status, said):
        assert said.count("\n") <= 1, said
        if status == 0:
            document = json.loads(path.read_text(), parse_int=float)
            assert document["claims"], "a false proof: of nothing"
            for claim in document["claims"]:
                assert_true(document, claim)
        return {0: "proved, and true", 1: "not proved"}.get(status, "refused in a line")


def assert_true(document, claim):
    """A claim that was called proved, checked in floats. Raises AssertionError, `a false proof`, where it is not so."""
    system, kind = document["system"], claim["kind"]
    try:
        data = {name: np.array(value, float) for name, value in claim["data"].items()}
        parts, K = system.get("cells", [system]), np.atleast_2d(np.array(document["gain"], float))
    except (TypeError, ValueError):
        raise AssertionError("a false proof: of no matrix") from None
    assert parts, "a false proof: about nothing"
    discrete = parts[0].get("period") is not None
    for i, part in enumerate(parts):
        A, B = np.array(part["A"], float), np.array(part["B"], float)
        assert A.size, "a false proof: about nothing"
        gains = K[i : i + 2] if K.ndim == 3 else [K]
        for gain in gains:
            loops = A + B @ gain
            if not np.isfinite(loops).all() or np.abs(loops).max() > 1e100:
                return  # floats cannot say
            if kind == "infeasible":
                assert_refuted(loops, data, discrete)
            else:
                mean = loops.mean(axis=0)
                for C in (*loops, mean):
                    assert_of_loop(C, gain, kind, data, discrete)


def assert_of_loop(C, K, kind, data, discrete):
    """What a claim says of one system of the hull."""
    poles, spare = np.linalg.eigvals(C), ROUNDING * np.linalg.norm(C)
    spare = max(spare, (1e-15 * np.linalg.norm(C)) ** 0.5)  # of a double pole
    if discrete:
        assert np.abs(poles).max() < 1 + spare, "a false proof: unstable"
        assert np.abs(poles).max() <= data.get("factor", 1.0) + spare, "a false proof: slower"
    else:
        assert poles.real.max() < spare, "a false proof: unstable"
        if "rates" not in data or data["rates"][0] <= 0 <= data["rates"][1]:
            assert poles.real.max() <= -data.get("rate", 0.0) + spare, "a false proof: slower"
    if kind == "damping":
        damping = -poles.real / np.abs(poles)
        assert damping.min() >= data["zeta"] - 1e-6, "a false proof: less damped"
    if kind == "cost" and poles.real.max() < -spare and not discrete:
        paid = lyapunov(C, data["Q"] + K.T @ data["R"] @ K)
        least = np.linalg.eigvalsh(data["P"] - paid).min()
        assert least >= -ROUNDING * np.abs(paid).max(), "a false proof: dearer"
    if kind == "l2" and not discrete and data["Bw"].ndim == 2:
        Z = data["C"] + data["D"] @ K
        for w in np.r_[0.0, np.geomspace(1e-3, 1e3, 60)]:
            G = Z @ np.linalg.solve(1j * w * np.eye(len(C)) - C, data["Bw"])
            assert np.linalg.norm(G, 2) <= data["gamma"] * (1 + 1e-6), "a false proof: a greater gain"
    if kind == "input" and not discrete:
        for x in data["points"]:
            for t in np.linspace(0, 5, 40):
                u = np.abs(K @ expm(t * C) @ x)
                assert (u <= data["limit"] * (1 + 1e-6)).all(), "a false proof: a greater input"


def assert_refuted(loops, data, discrete):
    """No matrix that is easy to find proves what was refuted."""
    rate, factor = data.get("rate", 0.0), data.get("factor", 1.0)
    moved = [C / factor if discrete else C + rate * np.eye(len(C)) for C in loops]
    size = [np.abs(np.linalg.eigvals(C)) - 1 if discrete else np.linalg.eigvals(C).real for C in moved]
    if max(s.max() for s in size) >= 0:
        return
    for start in (*moved, sum(moved) / len(moved)):
        with contextlib.suppress(np.linalg.LinAlgError):
            P = lyapunov(start, np.eye(len(start)), discrete)
            falls = [P - C.T @ P @ C if discrete else -(C.T @ P + P @ C) for C in moved]
            proved = min(np.linalg.eigvalsh(each).min() for each in (P, *falls))
            assert proved < ROUNDING * np.abs(P).max(), "a false proof: refuted, and there is a P"
