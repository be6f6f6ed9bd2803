"""`diffabs design` and `diffabs certify`: what scripts read, what is proved, and how they fail."""

import json
import pathlib
import subprocess
import sys
import types

import jax.numpy as jnp
import numpy as np
import pytest
from commands import assert_one_error_line, left_in, run
from mutants import killed_by
from project import ROOT
from seams import replace_seam

from diffabs.core.pytree import param, pytree
from diffabs.core.types import Scalar
from diffabs.linear.linearization import StateSpace
from diffabs.robust.design import Certificate, DesignError, findings
from diffabs.robust.design.frozen import analyse_frozen_loops
from diffabs.robust.design.sdp import solver
from diffabs.scenario import proving
from diffabs.scenario.scenario import load

CHECKER = ROOT / "tests" / "support" / "check_certificate.py"
KEYS = [
    *(
        "format",
        "scenario",
        "model",
        "made",
        "gain",
        "states",
        "quadratically_stable",
        "stable",
        "verified_exactly",
        "decay_rate",
        "damping",
    ),
    *("trace_cost", "guaranteed_cost", "worst_vertex", "margins", "claims", "lower_bound", "gap", "residual", "reason"),
    *(
        "besides",
        "period",
        "over",
        "units",
        "vertices",
        "corners",
        "poles",
        "coverage",
        "exact",
        "neglected",
        "versions",
        "files",
    ),
]


@pytree
class Spring:
    """x'' = -stiffness x - x' + u."""

    period = None
    states = ("x", "x'")
    stiffness: Scalar = param(default=1.0, unit="1/s^2")

    def matrices(self):
        return StateSpace(jnp.array([[0.0, 1.0], [-self.stiffness, -1.0]]), jnp.array([[0.0], [1.0]]))


CORNERS = [{"plant.mass": m, "speed": v / 3.6} for m in (5.3, 6.2) for v in (5.0, 50.0)]


@pytest.fixture(autouse=True, scope="module")
def no_stable_step():
    """Nothing is integrated, so no step need be stable."""
    with pytest.MonkeyPatch.context() as patch:
        replace_seam(patch, "stable_step", lambda loop: pytest.fail("asked for a stable step"))
        yield


@pytest.fixture
def no_polytope(monkeypatch):
    """What is wrong must be said before anything dear is computed."""
    replace_seam(monkeypatch, "polytope", lambda *_: pytest.fail("computed a polytope first"))


def checked(path: pathlib.Path) -> subprocess.CompletedProcess:
    return subprocess.run([sys.executable, CHECKER, path], capture_output=True, text=True, check=False)


# design


@pytest.fixture(scope="module")
def designed(tmp_path_factory):
    folder = tmp_path_factory.mktemp("designed")
    result = run("design", "slip-lmi", "--json", "--out", folder / "c.json")
    return folder, result, json.loads(result.stdout)


def test_design_has_what_scripts_rely_on(designed):
    folder, result, document = designed
    assert list(document) == KEYS
    assert document["scenario"] == "slip-lmi"
    np.testing.assert_allclose(document["gain"], [-11752.95, -158.170], atol=0.5)
    assert document["trace_cost"] == pytest.approx(1847633.09, rel=1e-6)
    assert document["guaranteed_cost"] == pytest.approx(1847633.09, rel=1e-5)
    assert document["lower_bound"] == pytest.approx(1847604.955, rel=1e-6)
    assert 0 <= document["gap"] < 1e-6
    assert abs(document["residual"]) < 1e-6
    assert document["quadratically_stable"] is True
    assert document["verified_exactly"] is True
    assert document["decay_rate"] > 1
    assert document["worst_vertex"]["corner"] in CORNERS
    assert {"decay", "cost"} <= set(document["margins"])
    assert document["reason"] is None
    assert document["states"] == ["integral of slip error", "slip error"]
    assert document["vertices"] == 4
    assert document["coverage"]["spread"] == 1
    assert document["neglected"] == ["The fall of the speed: it is frozen."]
    assert set(document["versions"]) == {"diffabs", "jax", "python", "cvxpy", "clarabel", "scipy"}
    assert document["files"] == {"out": str(folder / "c.json")}
    assert result.stderr.splitlines() == [
        "neglected: The fall of the speed: it is frozen.",
        f"certificate: {folder}/c.json; check it with: diffabs verify {folder}/c.json",
    ]


def test_vertices_are_the_papers(designed):
    document = designed[2]
    assert document["over"] == {"plant.mass": [5.3, 6.2], "speed": [5 / 3.6, 50 / 3.6]}
    assert document["corners"] == CORNERS
    assert all(pole < 0 for pole in document["poles"])


def test_certificate_is_proved_by_who_shares_nothing(designed, tmp_path):
    """Also where another program has written its members in another order."""
    folder, _, document = designed
    assert left_in(folder) == {"c.json"}
    assert checked(folder / "c.json").returncode == 0
    content = json.loads((folder / "c.json").read_text())
    (tmp_path / "sorted.json").write_text(json.dumps(content, sort_keys=True))
    assert checked(tmp_path / "sorted.json").returncode == 0
    assert run("verify", folder / "c.json").stdout.count("proved  ") == 2
    assert Certificate.load(folder / "c.json").gain.ravel().tolist() == document["gain"]


@pytest.mark.slow
def test_changes_reach_the_design():
    changes = ("--set", "design.Q=1e6,1e4", "--set", "design.over.plant.mass=5.3,5.3")
    document = json.loads(run("design", "slip-lmi", "--json", *changes).stdout)
    assert document["vertices"] == 2
    np.testing.assert_allclose(document["gain"], [-1000, -111], rtol=0.01)


@killed_by("cli.show", "The guaranteed cost has a P of its own", "The guaranteed cost is this bound")
def test_table_for_people():
    result = run("design", "slip-lmi")
    assert "common Lyapunov" not in result.stdout
    rows = [[cell.strip() for cell in line.split("│")[1:-1]] for line in result.stdout.splitlines() if "│" in line]
    found = {row[0]: row[1] for row in rows}
    assert float(found["slip error"]) == pytest.approx(-158.17, abs=0.01)
    assert (found["quadratically stable"], found["verified exactly"]) == ("proved", "yes")
    assert float(found["trace cost"]) == pytest.approx(1847633.1, rel=1e-6)
    assert "The guaranteed cost has a P of its own and may be lower." in " ".join(result.stdout.split())
    assert [row[1:3] for row in rows[-4:]] == [
        ["5.3", "1.38889"],
        ["5.3", "13.8889"],
        ["6.2", "1.38889"],
        ["6.2", "13.8889"],
    ]
    assert "speed [m/s]" in result.stdout
    assert "4 vertices; their hull covers 4374 systems" in result.stdout
    assert result.stderr == "neglected: The fall of the speed: it is frozen.\n"


@pytest.fixture
def infeasible(monkeypatch):
    def none(polytope, spec):
        raise DesignError("no gain passes its checks. CLARABEL: the solver says infeasible")

    replace_seam(monkeypatch, "design", none)


@killed_by(
    "cli.design",
    "                    show.as_json(certificates.proof_document(setup, task, reason=str(error)))\n",
    "                    pass\n",
)
def test_no_gain_could_not_be_done(tmp_path, infeasible):
    (tmp_path / "c.json").write_text("old")
    result = run("design", "slip-lmi", "--json", "--out", tmp_path / "c.json", status=1)
    document = json.loads(result.stdout)
    assert list(document) == KEYS
    assert (document["gain"], document["quadratically_stable"], document["trace_cost"]) == (None, None, None)
    assert document["reason"] == "no gain passes its checks. CLARABEL: the solver says infeasible"
    assert document["files"] == {}
    assert result.stderr == f"error: slip-lmi: {document['reason']}\n"
    assert left_in(tmp_path) == {"c.json"}
    assert (tmp_path / "c.json").read_text() == "old"


def test_no_gain_is_one_line_for_people(infeasible):
    assert_one_error_line(run("design", "slip-lmi", status=1))


def test_design_needs_weights(no_polytope):
    result = run("design", "slip-estimator", status=2)
    assert_one_error_line(result)
    assert "design.Q and design.R are missing" in result.stderr


# certify


@pytest.mark.slow
def test_published_gain_has_no_common_lyapunov_matrix(tmp_path):
    result = run("certify", "slip-lmi", "--json", "--out", tmp_path / "c.json", status=1)
    document = json.loads(result.stdout)
    assert list(document) == KEYS
    assert document["gain"] == [-11753, -48]
    assert document["quadratically_stable"] is False
    assert document["verified_exactly"] is True
    assert document["trace_cost"] is None
    assert document["worst_vertex"]["corner"] == {"plant.mass": 6.2, "speed": 50 / 3.6}
    assert document["worst_vertex"]["claim"] == "poles"
    assert document["worst_vertex"]["margin"] == pytest.approx(22.53, abs=0.01)
    assert "quadratic stability is disproved: no common Lyapunov matrix exists for the 4 vertices" in document["reason"]
    assert "no Q and R give this gain" in document["reason"]
    assert result.stderr.splitlines()[-1] == f"verdict: slip-lmi: {document['reason']}"
    assert left_in(tmp_path) == {"c.json"}
    assert checked(tmp_path / "c.json").returncode == 0
    assert run("verify", tmp_path / "c.json").stdout == "proved  infeasible: no common Lyapunov matrix exists\n"


@pytest.mark.slow
def test_what_is_known_besides_of_the_published_gain():
    """Not unstable: poles of every frozen loop in closed form, s^2 = ..., and the proof that follows the speed."""
    result = run("certify", "slip-lmi", "--json", status=1)
    besides, reason = (json.loads(result.stdout)[name] for name in ("besides", "reason"))
    frozen = besides["frozen"]
    assert frozen["systems"] == frozen["stable"] == 17**2
    assert frozen["slowest"] == pytest.approx(22.5318, abs=1e-4)  # REFERENCE: 22.5345 at 5.3 kg, and 6.2 kg is slower
    assert frozen["at"] == {"plant.mass": 6.2, "speed": pytest.approx(50 / 3.6)}
    friction = 2 * 0.399595428169 * 9.81  # of a locked wheel, and of a disk whose inertia is half of its mass
    assert friction < besides["proved_for_a_speed_falling_by"] < 1.011 * friction
    assert "that is not instability: each of 289 frozen systems is stable by its poles" in reason
    assert "proves stability while the speed falls by at most 7.918 m/s^2, the most that friction allows" in reason
    table = run("certify", "slip-lmi", status=1).stdout
    assert "quadratically stable" not in table
    rows = {r[0]: r[1] for line in table.splitlines() if len(r := [c.strip() for c in line.split("│")[1:-1]]) == 3}
    assert rows["common Lyapunov matrix"] == "disproved"
    assert rows["systems of the ranges, each fixed"] == "289 of 289 stable"
    assert rows["proved stable for a speed falling by no more than"] == "7.918"


VEHICLE = """
[plant]
type = "road-vehicle"
[road]
type = "magic-formula"
D = 0.3
[initial]
speed_kmh = 180.0
slip = 0.0
[reference]
type = "fixed-slip"
slip = 0.1
[feedforward]
type = "holding-input"
[controller]
type = "sampled"
period = 1e-3
[controller.controller]
type = "proportional-feedback"
gain = [-50000.0, -9000.0]
[design.over]
"initial.speed_kmh" = [144.0, 198.0]
"""
ONE_GAIN = ("proportional-feedback", "state-feedback")


def greatest_deceleration(speed):
    """[m/s^2] on the friction curve's peak, 0.3: friction, air drag and rolling resistance."""
    return (4316.4 * 0.3 + 0.856 * speed**2) / 440.0 + 0.01 * 9.81


@killed_by("robust.design.loop_task", "i = int(np.argmax(decelerations / speeds))", "i = 0")
@killed_by("robust.design.speed_scaled", "if not deceleration * period < speed:", "if False:")
@pytest.mark.slow
def test_the_relative_fall_counts_air_drag_at_every_speed(tmp_path):
    path = tmp_path / "vehicle.toml"
    path.write_text(VEHICLE)
    task = proving.build_proof_task(load(path))
    fall = 1.01e-3 * greatest_deceleration(55.0)
    np.testing.assert_allclose(task.over["fall"][1], fall / (55.0 - fall), rtol=1e-4)
    assert task.gain.tolist() == [-50000.0, -9000.0, 0.0]  # at the controller's reference speed
    path.write_text(VEHICLE.replace("[144.0, 198.0]", "[0.01, 198.0]"))
    with pytest.raises(ValueError, match=r"speed = 0.00277778 m/s ends in a period of 0.001 s"):
        proving.build_proof_task(load(path))


@killed_by("robust.design.findings", "speeds_of_box(task.over, low)).max()", "speeds_of_box(task.over, low)).min()")
@pytest.mark.slow
def test_the_greatest_fall_is_at_one_end_of_the_speeds(tmp_path, monkeypatch):
    path = tmp_path / "vehicle.toml"
    path.write_text(VEHICLE.replace("[144.0, 198.0]", "[18.0, 198.0]"))
    fall = 1.01e-3 * greatest_deceleration(5.0)
    np.testing.assert_allclose(proving.build_proof_task(load(path)).over["fall"][1], fall / (5.0 - fall), rtol=1e-4)
    continuous = VEHICLE.replace('type = "sampled"\nperiod = 1e-3\n[controller.controller]\n', "").replace(*ONE_GAIN)
    path.write_text(continuous)
    task, proof = proving.build_proof_task(load(path)), types.SimpleNamespace(quadratically_stable=None)
    replace_seam(monkeypatch, "certify", lambda gain, cells, spec: types.SimpleNamespace(stable=True))
    found = findings.find_further(task, proof)
    np.testing.assert_allclose(found.fall, 1.01 * greatest_deceleration(55.0), rtol=1e-4)


@killed_by("robust.design.frozen", "int((rates > 0).sum())", "len(grid)")
def test_frozen_loops_are_counted_at_their_poles():
    """x'' = u, u = -a x - x' with a between -1 and 3: stable for a > 0, 4 of 17 points and the one at 0 are not."""
    found = analyse_frozen_loops([0.0, 0.0], Spring(), {"stiffness": (-1.0, 3.0)})
    assert (found.systems, found.stable) == (17, 12)
    assert found.slowest == pytest.approx(-(np.sqrt(5) - 1) / 2)  # s^2 + s - 1
    assert found.at == {"stiffness": -1.0}


@pytest.mark.parametrize(
    ("gain", "proved"),
    [(("--gain=-11753,-76.6",), False), (("--gain=-11753,-76.7",), True), (("--gain", "[-11753, -76.7]"), True),
     (("--gain", "-11753,-76.7"), True)],
)  # fmt: skip
def test_threshold_of_quadratic_stability(gain, proved):
    document = json.loads(run("certify", "slip-lmi", *gain, "--json", status=0 if proved else 1).stdout)
    assert document["quadratically_stable"] is proved


@pytest.mark.slow
def test_where_two_vertices_refute_at_once(tmp_path):
    """The solver's best P is 0 with a margin of +1e-14; the product of two closed loops has a negative eigenvalue."""
    ranges = ("design.over.plant.mass=[5.11,5.87]", "design.over.initial.speed_kmh=[3.9,50.4]")
    changes = [word for change in ranges for word in ("--set", change)]
    changes += ["--gain=-1162,-5.922", "--json", "--out", tmp_path / "c.json"]
    document = json.loads(run("certify", "slip-lmi", *changes, status=1).stdout)
    assert document["quadratically_stable"] is False
    assert checked(tmp_path / "c.json").returncode == 0


@killed_by("robust.design.loop_task", "fastest=True", "fastest=False")
def test_fastest_decay_and_least_cost_of_a_gain():
    document = json.loads(run("certify", "slip-lmi", "--gain=-11753,-158.17", "--json").stdout)
    assert document["trace_cost"] == pytest.approx(1847633.09, rel=1e-5)
    slowest_mode = -max(document["poles"])
    assert 0.997 * slowest_mode < document["decay_rate"] <= slowest_mode
    assert document["reason"] is None


@killed_by("cli.console", 'say(f"verdict: {line}")', 'say(f"error: {line}")')
@killed_by("cli.console", '"warning:", "verdict:",', '"warning:",')
def test_a_verdict_is_no_error():
    """The command did its work; the status lets a script stop, and -q silences no verdict."""
    (line,) = run("certify", "slip-lmi", "-q", "--gain=11753,158", status=1).stderr.splitlines()
    assert line.startswith("verdict: slip-lmi: quadratic stability is disproved")
    assert line.endswith("vertex 2 (plant.mass 6.2, speed 1.38889) is unstable even with fixed parameters")


@killed_by("cli.design", "        if reason:\n            console.c", "        if False:\n            console.c")
@killed_by("robust.design.findings", '"damping": (spec.damping > 0,', '"damping": (False,')
@pytest.mark.parametrize(
    ("change", "said"),
    [("design.decay=500", "decay = 500 1/s is disproved"), ("design.damping=0.95", "damping = 0.95 is undecided")],
)
def test_specification_that_is_not_proved(change, said):
    result = run("certify", "slip-lmi", "--gain=-11753,-158", "--set", change, "--json", status=1)
    document = json.loads(result.stdout)
    assert document["quadratically_stable"] is True
    assert document["reason"].startswith(said)


def test_specifications_that_are_proved():
    changes = ("--set", "design.decay=50", "--set", "design.damping=0.3")
    document = json.loads(run("certify", "slip-lmi", "--gain=-11753,-158", *changes, "--json").stdout)
    assert document["damping"] == 0.3
    assert document["decay_rate"] > 50


@killed_by("robust.design.findings", '[] if stable else [f"quad', '[] if stable is not False else [f"quad')
def test_undecided_is_not_proved(tmp_path, monkeypatch):
    replace_seam(monkeypatch, "certify", lambda gain, polytope, *_, **__: Certificate(polytope, gain, ()))
    result = run("certify", "slip-lmi", "--json", "--out", tmp_path / "c.json", status=1)
    document = json.loads(result.stdout)
    assert document["quadratically_stable"] is None
    assert document["verified_exactly"] is False
    assert "quadratic stability is undecided, a guaranteed cost is undecided; that is not instability" in result.stderr
    assert checked(tmp_path / "c.json").returncode == 1


@pytest.mark.slow
def test_sampled_loop_behind_a_delay():
    controller = "controller={type='sampled',controller={type='state-feedback',gain=[-1000,-50]}}"
    changes = ("--set", controller, "--set", "actuator.type=delay", "--set", "design={}")
    result = run("certify", "slip-lmi", "--gain=-100,-20,0", *changes)
    assert "largest |pole| [1]" in result.stdout
    assert "neglected: The actuator's delay of 0.01 s, which can destabilise." in result.stderr
    assert "note: the linear model differs from the loop's linearisation" in result.stderr


@killed_by(
    "robust.design.loop_task",
    "    if not isinstance(controller, ProportionalFeedback) or not isinstance(reduced.model, SlipModel):",
    "    if True:",
)
@pytest.mark.slow
def test_a_gain_that_follows_the_speed_is_proved_as_one():
    """Fixed at its value for 50 km/h, the same gain is not stable at 5 km/h under 1 kHz; in proportion it is."""
    document = json.loads(run("certify", "slip-cured", "--json", "--gain=-17481,-349,0,0").stdout)
    assert document["over"]["model.plant.mass"] == [5.3, 6.2]
    # friction of 0.3996 decelerates the body by 7.840 m/s^2; with 1 % more, 7.918e-3/(5/3.6 - 7.918e-3) in a period
    assert document["over"]["fall"] == [0.0, pytest.approx(0.005734, rel=1e-3)]
    assert document["decay_rate"] == pytest.approx(62.35, abs=0.1)
    assert "The fall of the speed: it is frozen." not in document["neglected"]
    fixed = ("controller.controller=state-feedback", "controller.controller.gain=-17481,-349")
    result = run("certify", "slip-cured", *(word for change in fixed for word in ("--set", change)), status=1)
    assert "is unstable even with fixed parameters" in result.stderr


# bad input


def test_vertex_without_a_solution_is_bad_input(monkeypatch):
    def none(polytope, spec):
        raise ValueError("vertex 0 has no stabilising Riccati solution")

    replace_seam(monkeypatch, "design", none)
    result = run("design", "slip-lmi", status=2)
    assert_one_error_line(result)
    assert "no stabilising Riccati solution" in result.stderr


def test_failure_of_the_linear_algebra_is_not_bad_input(monkeypatch):
    def none(*_, **__):
        raise np.linalg.LinAlgError("SVD did not converge")

    replace_seam(monkeypatch, "certify", none)
    assert_one_error_line(run("certify", "slip-lmi", status=1))


@killed_by(
    "cli.certificates",
    '    except ModuleNotFoundError as error:\n        console.fail(" ".join(str(error).split()))\n',
    "",
)
@pytest.mark.parametrize("command", ["design", "certify"])
def test_without_the_extra(command, monkeypatch, no_polytope):
    monkeypatch.setitem(sys.modules, "cvxpy", None)
    solver.solvers.cache_clear()
    result = run(command, "slip-lmi", status=2)
    assert_one_error_line(result)
    assert 'pip install ".[design]" in a clone' in result.stderr


@pytest.mark.slow
@killed_by(
    "uncertainty.sweep.distributions",
    "from numpy.typing import ArrayLike\n",
    "from numpy.typing import ArrayLike\nfrom scipy.special import ndtr as _\n",
)
def test_other_commands_do_without_the_extra():
    code = """
import sys
sys.modules.update(dict.fromkeys(['cvxpy', 'scipy', 'clarabel', 'optax', 'pyarrow', 'filelock']))
from diffabs.cli.main import app
from diffabs.scenario.scenario import load
drawn = 'sweep.over.plant.mass={type="normal", mean=5.7, deviation=0.3, low=5}'
load('slip-lmi', [drawn, 'tune.aggregate=cvar', 'tune.free.reference.slip=0.1,0.3'], integrated=False)
app(['list', 'scenarios'])
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "slip-lmi" in done.stdout
