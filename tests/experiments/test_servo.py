"""A plant of a user's own, `examples/dc-servo`: no line of it is in diffabs, and everything is there for it."""

import csv
import dataclasses
import importlib
import json
import pathlib
import re
import shutil
import sys

import jax
import numpy as np
import pytest
import scipy.integrate
import scipy.linalg
from commands import assert_one_error_line, run
from mutants import killed_by
from project import ROOT
from seams import replace_seam

from diffabs import FixedStep, Loop, measure, replace, rollout
from diffabs.core.pytree import parameters
from diffabs.core.units import Units, resolve_unit
from diffabs.core.validity import check_part
from diffabs.linear.operating_point import operating_point
from diffabs.linear.regulator import lqr
from diffabs.loop.stability import stable_step
from diffabs.parts.controllers import PID, Clamping, Sampled
from diffabs.parts.objectives import IAE, ITAE, FinalError, Overshoot, SettlingTime
from diffabs.parts.plants import QuarterCar
from diffabs.parts.references import Setpoint
from diffabs.parts.stops import NoStop
from diffabs.scenario import outside, registry
from diffabs.scenario.scenario import ScenarioError, dump, load, loads

HERE = ROOT / "examples" / "dc-servo"
PARTS = ("--parts", "dc_servo")
FAST = ("--set", "solver.duration=0.5", "--set", "solver.step=2e-3")
OF_PARTS = "from diffabs.core.pytree import part, pytree\n"
METRICS = ["overshoot", "settling_time", "iae", "final_error", "itae", "peak_current"]


@pytest.fixture(autouse=True)
def forgotten(monkeypatch):
    """In the folder of the example; what is known of it, and the Python path, are as before afterwards."""
    monkeypatch.chdir(HERE)
    monkeypatch.setattr(sys, "path", list(sys.path))
    replace_seam(monkeypatch, "outside_named", {})
    yield
    outside.installed_modules.cache_clear()


@pytest.fixture
def servo():
    """The module."""
    outside.register_modules(["dc_servo"])
    return importlib.import_module("dc_servo")


def linear(servo, value=0.2, **parameters):
    """Far from every limit, without dry friction: the loop and its gains (kp, ki, kd, cutoff)."""
    motor = servo.DCMotor(coulomb=0.0, **parameters)
    pid = PID(kp=8.0, ki=5.0, kd=0.3, cutoff=200.0, low=-1e6, high=1e6)
    loop = Loop(
        plant=replace(motor, {"voltage_max": 1e6}),
        initial=servo.ServoStart(),
        reference=Setpoint(value=value),
        controller=pid,
        stop=NoStop(),
    )
    return loop, (8.0, 5.0, 0.3, 200.0)


def by_hand(motor, gains):
    """A, B of angle, speed, current, integral and filter under a voltage, and K of the PID; written anew."""
    kp, ki, kd, wc = gains
    j, b, k, r, ell = (getattr(motor, n) for n in ("inertia", "damping", "constant", "resistance", "inductance"))
    a = np.zeros((5, 5))
    a[0, 1], a[1, 1], a[1, 2], a[2, 1], a[2, 2] = 1.0, -b / j, k / j, -k / ell, -r / ell
    a[3, 0], a[4, 0], a[4, 4] = -1.0, -wc, -wc
    return a, np.array([0, 0, 1 / ell, 0, 0]), np.array([-(kp + kd * wc), 0, 0, ki, -kd * wc])


@killed_by("parts.objectives.tracking", "jnp.where(step > 0, highest", "jnp.where(step != 0, highest")
@killed_by(
    "parts.objectives.tracking", 'getattr(output, "highest", math.inf)', 'getattr(output, "highest_signal", 1.0)'
)
@pytest.mark.slow
def test_the_linear_servo_follows_its_closed_form(servo):
    """exp(A t) with the closed loop written by hand, at every instant; and what is measured, from that curve."""
    loop, gains = linear(servo)
    a, b, k = by_hand(loop.plant, gains)
    closed, entry = a + np.outer(b, k), b * (gains[0] + gains[2] * gains[3]) + np.array([0, 0, 0, 1, gains[3]])
    modes, vectors = np.linalg.eig(closed)
    solver = FixedStep(step=5e-4, duration=1.0)
    metrics = {"overshoot": Overshoot(), "iae": IAE(), "itae": ITAE(), "end": FinalError(), "rest": SettlingTime()}
    found = rollout(loop, solver, metrics)
    t = np.linspace(0, 1, 200_001)
    forced = np.linalg.solve(closed, 0.2 * entry)  # x(t) = (exp(A t) - 1) A^-1 w
    angle = ((vectors * np.linalg.solve(vectors, forced))[0] @ np.exp(np.outer(modes, t))).real - forced[0]
    error, h = angle - 0.2, t[1]
    seen = np.interp(found.trajectory.sample.t, t, angle)
    np.testing.assert_allclose(found.trajectory.sample.output.angle, seen, rtol=0, atol=1e-7)
    expected = {
        "overshoot": angle.max() / 0.2 - 1,
        "iae": np.trapezoid(np.abs(error), dx=h),
        "itae": np.trapezoid(t * np.abs(error), dx=h),
        "end": abs(error[-1]),
        "rest": t[np.flatnonzero(np.abs(error) > 0.02 * 0.2)[-1]],  # 2 % of the step,
    }
    assert expected["overshoot"] > 0.2
    for name, value in expected.items():
        np.testing.assert_allclose(found.metrics[name], value, rtol=1e-4, err_msg=name)
    assert not found.stopped
    coarse = replace(loop, {"reference.value": 2.0}), FixedStep(step=3e-3, duration=0.4)
    peak = measure(*coarse, {"overshoot": Overshoot()}).metrics["overshoot"]  # between samples, and beyond 1
    np.testing.assert_allclose(peak, expected["overshoot"], rtol=1e-4)
    mirrored = measure(replace(loop, {"reference.value": -0.2}), solver, metrics).metrics
    for name in metrics:
        np.testing.assert_allclose(mirrored[name], found.metrics[name], rtol=1e-9, err_msg=name)


@pytest.mark.slow
def test_the_servo_at_its_limits_agrees_with_scipy(servo):
    """Dry friction, load, limited voltage and a clamped integral; above 1 rad the peak has no limit of a slip."""
    motor = servo.DCMotor(load=0.05)
    pid = PID(kp=10.0, ki=10.0, kd=0.2, cutoff=200.0, low=-24.0, high=24.0, antiwindup=Clamping())
    loop = Loop(
        plant=motor, initial=servo.ServoStart(speed=-3.0), reference=Setpoint(value=2.5), controller=pid, stop=NoStop()
    )

    def rates(t, x):
        angle, speed, current, integral, filtered = x
        e = 2.5 - angle
        raw = 10 * e + 10 * integral + 0.2 * 200 * (e - filtered)
        u = min(max(raw, -24), 24)
        torque = 0.1 * current - 1e-3 * speed - 0.01 * np.tanh(speed / 0.5) - 0.05
        held = np.clip((raw - u) / (10 * 0.01), min(e, 0.0), max(e, 0.0))
        return [speed, torque / 2e-3, (u - current - 0.1 * speed) / 2e-3, e - held, 200 * (e - filtered)]

    oracle = scipy.integrate.solve_ivp(
        rates, (0, 0.4), [0, -3, 0, 0, 0], rtol=1e-10, atol=1e-12, max_step=1e-3, dense_output=True
    )
    found = rollout(loop, FixedStep(step=1e-4, duration=0.4), {"peak": servo.PeakCurrent(), "over": Overshoot()})
    sample = found.trajectory.sample
    angle, speed, current = oracle.sol(np.asarray(sample.t))[:3]
    np.testing.assert_allclose(sample.output.angle, angle, atol=2e-4)
    np.testing.assert_allclose(sample.output.speed, speed, atol=5e-3)
    np.testing.assert_allclose(found.metrics["peak"], np.abs(current).max(), rtol=1e-3)
    np.testing.assert_allclose(found.metrics["over"], angle.max() / 2.5 - 1, rtol=1e-3)
    assert angle.max() > 2.6
    assert np.ptp(sample.control[:20]) == 0  # at the limit


@killed_by(
    "linear.operating_point", "contained = plant | (linear.K != 0)", "contained = plant | (linear.K != linear.K)"
)
@pytest.mark.slow
def test_the_linear_model_is_the_one_written_by_hand(servo):
    loop, gains = linear(servo, load=0.03)
    model = operating_point(loop)
    a, b, k = by_hand(loop.plant, gains)
    names = ("angle", "speed", "current", "controller.integral", "controller.filtered")
    assert model.states == names
    np.testing.assert_allclose(model.matrices().A, a, atol=1e-9)
    np.testing.assert_allclose(model.matrices().B[:, 0], b, atol=1e-9)
    np.testing.assert_allclose(model.gain(), k, atol=1e-9)
    alone = operating_point(replace(loop, {"controller.ki": 0.0, "controller.kd": 0.0}))
    assert alone.states == ("angle", "speed", "current")
    found = lqr(*alone.matrices(), np.eye(3), np.eye(1))
    riccati = scipy.linalg.solve_continuous_are(a[:3, :3], b[:3, None], np.eye(3), np.eye(1))
    np.testing.assert_allclose(found.gain[0], -b[:3] @ riccati, rtol=1e-6)
    slow = jax.grad(lambda j: operating_point_speed(replace(loop, {"plant.inertia": j}), model))(2e-3)
    np.testing.assert_allclose(slow, -1e-3 * -1 / 2e-3**2, rtol=1e-9)  # d(-b/J)/dJ


def operating_point_speed(loop, model):
    """How the speed damps itself, in the model with the parameters of another loop."""
    return dataclasses.replace(model, plant=loop.plant).matrices().A[1, 1]


@pytest.mark.slow
@killed_by("linear.operating_point", "if not linear.residue < MAX_REST_RESIDUE:", "if False:")
def test_what_has_no_linear_model_says_so(servo):
    loop, _ = linear(servo)
    with pytest.raises(ValueError, match="controller Sampled acts at instants"):
        operating_point(dataclasses.replace(loop, controller=Sampled(controller=loop.controller)))
    with pytest.raises(ValueError, match="at a limit at the setpoint"):
        operating_point(replace(loop, {"plant.load": 0.03, "controller.high": 0.1}))
    with pytest.raises(ValueError, match="plant DCMotor does not come to rest at the setpoint"):
        operating_point(replace(loop, {"plant.load": 3.0, "plant.voltage_max": 24.0}))


@killed_by("core.units", "exponent = int(power or 1) * (-1 if slash else 1)", "exponent = int(power or 1)")
def test_units_are_those_of_the_loop(servo):
    loop, _ = linear(servo)
    units = {path: spec.unit for path, spec, _ in parameters(loop)}
    expected = {"kp": "V/rad", "ki": "V/rad/s", "kd": "V s/rad", "high": "V", "cutoff": "rad/s"}
    assert {name: units[f"controller.{name}"] for name in expected} == expected
    assert units["reference.value"] == "rad"
    assert [registry.unit_of(o, loop.plant) for o in (IAE(), FinalError(), servo.PeakCurrent())] == [
        "rad s",
        "rad",
        "A",
    ]
    assert [registry.unit_of(o, QuarterCar()) for o in (IAE(), FinalError())] == ["s", "1"]
    with pytest.raises(ValueError, match=r"controller.kp = inf is outside \(-inf, inf\) V/rad$"):
        check_part(replace(loop, {"controller.kp": np.inf}))
    with pytest.raises(ValueError, match=r"low = 5 V exceeds high = 2 V$"):
        check_part(replace(loop, {"controller.low": 5.0, "controller.high": 2.0}))
    assert resolve_unit("control^2 s/signal", Units("N m/A", "m/s^2")) == "N^2 m s^3/A^2"


@killed_by("loop.stability", "for base in (loop, arrived)", "for base in (loop,)")
def test_the_step_is_judged_with_an_unsaturated_controller(servo):
    """At the start the PID commands 24 V whatever happens; its own fast mode is only seen on the target."""
    loop, _ = linear(servo, value=1.0)
    limited = replace(loop, {"controller.high": 24.0, "controller.low": -24.0, "controller.kd": 5.0})
    a, b, k = by_hand(loop.plant, (8.0, 5.0, 5.0, 200.0))
    z = stable_step(limited) * np.linalg.eigvals(a + np.outer(b, k))
    growth = np.abs(1 + z * (1 + z / 2 * (1 + z / 3 * (1 + z / 4))))
    assert growth.max() == pytest.approx(1.0, abs=2e-3)


@killed_by(
    "scenario.registry",
    'usual_parts, units = getattr(plant, "usual_parts", dict), units_of(plant)',
    "usual_parts, units = braking().plant.usual_parts, units_of(plant)",
)
def test_what_a_plant_of_ones_own_needs_is_asked_for_by_name(servo, file):
    text = (HERE / "servo.toml").read_text()
    for section, line in (
        ('stop = "no-stop"\n', "stop is missing: plant dc-motor has no usual one; there is fallen, no-stop"),
        (text[text.index("[reference]") : text.index("[controller]")], "reference is missing: plant dc-motor"),
    ):
        with pytest.raises(ScenarioError, match=re.escape(line)):
            loads(text.replace(section, "").encode(), "mine", "mine")
    chosen = load("servo.toml")
    again = load(file(dump(chosen)))
    assert dump(again) == dump(chosen)


def test_a_scenario_never_imports_code():
    """Whoever names a part from outside without --parts is told that it is unknown; no section names modules."""
    assert_one_error_line(result := run("simulate", "servo.toml", status=2))
    assert 'plant.type = "dc-motor" is unknown' in result.stderr
    with pytest.raises(ScenarioError, match="parts is not a section"):
        loads(b'parts = ["dc_servo"]\n', "mine", "mine")
    assert "dc-motor" not in registry.family_types("plant")


@killed_by("scenario.registry", "if name in _packaged_parts(family) or name in parts:", "if name in parts:")
@pytest.mark.parametrize(
    ("module", "text", "line"),
    [
        ("broken", "1 / 0", "broken.py, line 1: ZeroDivisionError: division by zero"),
        ("lacking", "import nowhere_to_be_found", "--parts lacking: there is no module nowhere_to_be_found"),
        ("absent", None, "--parts absent: there is no module absent, on the Python path or in the working directory"),
        ("os; import sys", None, "--parts os; import sys is not the name of a Python module"),
        ("empty", "from diffabs.parts.controllers import PID", "--parts empty: there is no part in this module"),
        ("leaving", "import sys\nsys.exit(3)", "leaving.py, line 2: SystemExit: 3"),
        (
            "clashing",
            f"from dc_servo import DCMotor\n{OF_PARTS}@pytree\nclass QuarterCar(DCMotor): ...",
            "parts of clashing: a plant quarter-car exists already, in diffabs",
        ),
        (
            "needy",
            f"{OF_PARTS}@pytree\nclass Needy:\n  x: object = part()",
            "missing 1 required keyword-only argument: 'x': every field needs a default",
        ),
    ],
)
def test_a_module_that_cannot_be_used_is_one_line(tmp_path, monkeypatch, module, text, line):
    monkeypatch.syspath_prepend(str(HERE))
    monkeypatch.chdir(tmp_path)
    if text is not None:
        (tmp_path / f"{module}.py").write_text(text)
    assert_one_error_line(result := run("list", "--parts", module, status=2))
    assert line in result.stderr


METHOD = f"""
import sys
print("imported")
{OF_PARTS}
from diffabs.parts.roads import RationalCurve

@pytree
class Talking(RationalCurve):
    def friction(self, slip, speed=0.0, distance=0.0):
        print("called")
        %s
        return super().friction(slip, speed, distance)
"""


@pytest.mark.parametrize(
    ("file", "statement", "said"),
    [
        ("raising.py", "raise KeyError('mu')", "KeyError: 'mu'"),
        ("exiting.py", "sys.exit()", "SystemExit"),
        ("packaged/road.py", "raise KeyError('mu')", "KeyError: 'mu'"),
    ],
)
def test_a_part_that_raises_or_exits_is_one_line(tmp_path, monkeypatch, file, statement, said):
    """Also one whose package only hands it on."""
    monkeypatch.chdir(tmp_path)
    module = file.removesuffix("/road.py").removesuffix(".py")
    if module == "packaged":
        pathlib.Path(module).mkdir()
        pathlib.Path(module, "__init__.py").write_text("from packaged.road import Talking")
    pathlib.Path(file).write_text(METHOD % statement)
    words = ("--set", "road=talking", "--parts", module, "--json")
    result = run("simulate", "slip-lmi", *words, status=2)
    assert f"{file}, line 12: {said}" in result.stderr
    assert result.stdout == ""
    assert "Traceback" not in result.stderr


@pytest.mark.slow
@pytest.mark.parametrize("command", ["simulate", "design"])
def test_a_part_that_prints_does_not_spoil_the_document(tmp_path, monkeypatch, command):
    monkeypatch.chdir(tmp_path)
    module = f"printing_{command}"
    (tmp_path / f"{module}.py").write_text(METHOD % "pass")
    words = ("--set", "road=talking", "--set", "solver.duration=0.01", "--parts", module, "--json")
    result = run(command, "slip-lmi", *words)
    assert json.loads(result.stdout)["scenario"] == "slip-lmi"
    assert "imported" in result.stderr
    assert "called" in result.stderr


@killed_by("scenario.outside", "entry_points(group=ENTRY_POINT_GROUP)", 'entry_points(group="other")')
def test_an_installed_module_is_known_by_its_entry_point(tmp_path, monkeypatch):
    shutil.copy(HERE / "dc_servo.py", tmp_path / "dc_servo_installed.py")
    folder = tmp_path / "dc_servo_installed-0.1.0.dist-info"
    folder.mkdir()
    (folder / "METADATA").write_text("Metadata-Version: 2.1\nName: dc-servo-installed\nVersion: 0.1.0\n")
    (folder / "entry_points.txt").write_text("[diffabs.parts]\nservo = dc_servo_installed\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    outside.installed_modules.cache_clear()
    listed = json.loads(run("list", "--json").stdout)
    assert listed["plants"]["dc-motor"]["parameters"]["inertia"]["unit"] == "kg m^2"
    assert listed["objectives"]["peak-current"]["unit"] == "A"
    assert "servo-start" in listed["initial"]
    assert load(HERE / "servo.toml", integrated=False).loop.plant.control_unit == "V"
    (tmp_path / "dc_servo_installed.py").write_text("1 / 0")
    sys.modules.pop("dc_servo_installed")
    outside.installed_modules.cache_clear()
    assert_one_error_line(result := run("list", status=2))
    assert "entry point servo of diffabs.parts: cannot be imported" in result.stderr


@pytest.mark.slow
@killed_by("cli.usage", "register_parts(parts or ())", "register_parts(())")
def test_simulate_prints_writes_and_draws(tmp_path, monkeypatch):
    from matplotlib.figure import Figure
    from matplotlib.text import Text

    drawn = []
    monkeypatch.setattr(Figure, "savefig", lambda figure, path, **_: drawn.append(figure))
    files = ("--csv", tmp_path / "run.csv", "--plot", tmp_path / "run.png")
    result = run("simulate", "servo.toml", *PARTS, *FAST, *files, "--json")
    document = json.loads(result.stdout)
    assert list(document["metrics"]) == METRICS
    assert (document["stopped"], document["diverged"]) == (False, False)
    assert "warning" not in result.stderr  # a whole run is a success
    assert document["parameters"]["controller.kd"]["unit"] == "V s/rad"
    with (tmp_path / "run.csv").open() as file:
        header = next(csv.reader(file))
    signals = ["angle [rad]", "speed [rad/s]", "current [A]"]
    assert header == ["t [s]", *signals, "target [rad]", "command [V]", "control [V]"]
    texts = {text.get_text() for text in drawn[0].findobj(Text)}
    assert {*signals, "setpoint", "voltage [V]"} <= texts


@pytest.mark.slow
def test_certify_and_design_prove_a_gain_over_the_box():
    document = json.loads(run("certify", "servo.toml", *PARTS, "--json").stdout)
    assert document["quadratically_stable"] is True
    assert document["verified_exactly"] is True
    assert document["over"] == {"plant.inertia": [1e-3, 4e-3], "plant.load": [0.0, 0.1]}
    np.testing.assert_allclose(document["gain"], [-50.0, 0.0, 0.0, 10.0, -40.0], atol=1e-9)
    found = json.loads(run("design", "servo.toml", *PARTS, "--json").stdout)
    assert found["quadratically_stable"] is True
    assert found["guaranteed_cost"] < document["guaranteed_cost"]


@pytest.mark.slow
def test_tune_is_by_gradients_over_inertia_and_load(tmp_path):
    few = ("--set", "tune.iterations=4", "--set", "tune.limits={}", "--set", "tune.decay=0")
    document = json.loads(run("tune", "servo.toml", *PARTS, *FAST, *few, "--out", tmp_path / "t.toml", "--json").stdout)
    assert document["lanes"] == 6
    assert document["objective"]["after"] < 0.8 * document["objective"]["before"]
    assert document["free"]["controller.kp"]["unit"] == "V/rad"
    tuned = load(tmp_path / "t.toml")  # known since the command
    assert float(tuned.loop.controller.kp) == document["free"]["controller.kp"]["after"]


@pytest.mark.slow
def test_sweep_counts_what_overshoots(tmp_path):
    out = tmp_path / "out"
    document = json.loads(run("sweep", "servo.toml", *PARTS, *FAST, "--samples", 64, "--out", out, "--json").stdout)
    counts = {name: row["count"] for name, row in document["failures"].items()}
    assert counts == {"diverged": 0, "stopped": 0, "overshoot > 0.1": counts["any"], "any": counts["any"]}
    assert counts["any"] > 0
    again = json.loads(run("simulate", *PARTS, "--from-sweep", out, "--sample", 3, "--json").stdout)
    assert list(again["metrics"]) == METRICS


@pytest.mark.slow
def test_workers_know_the_parts_and_rare_events_are_found(tmp_path):
    """A process of its own imports the module too; the sweep is the same to the bit."""
    pytest.importorskip("distributed")
    tables = []
    for name, engine in (("here", ()), ("there", ("--on", "dask", "--workers", 1))):
        out = ("--samples", 32, "--out", tmp_path / name, "--json")
        tables.append(json.loads(run("sweep", "servo.toml", *PARTS, *FAST, *engine, *out).stdout)["digest"])
    assert tables[0] == tables[1]
    found = json.loads(run("rare", "servo.toml", "overshoot=0.54", *PARTS, "--samples", 200, "--json").stdout)
    assert 0 < found["interval"][0] < found["probability"] < found["interval"][1] < 0.1


def test_the_page_is_the_example():
    """What docs/plant-in-15-minutes.md shows is what the example holds, which the tests above run."""
    blocks = re.findall(r"```\w+\n# ([\w.]+)\n(.*?)```", (ROOT / "docs/plant-in-15-minutes.md").read_text(), re.DOTALL)
    files = {}
    for name, text in blocks:
        files[name] = files.get(name, "") + text
    assert set(files) == {"dc_servo.py", "servo.toml", "pyproject.toml"}
    for name, text in files.items():
        assert text.split() == (HERE / name).read_text().split()
    assert len(files["dc_servo.py"].splitlines()) < 130


RESTING = """
from diffabs.core.pytree import param, pytree
from dc_servo import DCMotor, ServoOutput, ServoStart

__all__ = ["Resting"]

@pytree
class Resting(DCMotor):
    def start(self, initial):
        return ServoOutput(*(0.0 * self.inertia for _ in range(3)))

    def usual_parts(self):
        return {"initial": INITIAL}
"""
AT_REST = ("servo.toml", "--set", "plant=resting", "--set", "tune.over={}")


@pytest.fixture
def resting(monkeypatch, tmp_path, request):
    """A module with a plant that has an unusual initial state, and the words that choose it."""
    (tmp_path / "resting.py").write_text(RESTING.replace("INITIAL", request.param))
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "resting", raising=False)
    yield ("--parts", "dc_servo", "--parts", "resting")
    sys.modules.pop("resting", None)


@killed_by("scenario.scenario", "name not in sections and part}", "name not in sections}")
@pytest.mark.parametrize("resting", ["()", "(ServoStart(), ServoStart(angle=0.5))"], indirect=True)
def test_a_plant_whose_usual_state_is_a_tuple_is_written_and_read(resting, tmp_path):
    run("show", *AT_REST, *resting, "--out", tmp_path / "mine.toml")
    outside.register_modules(["dc_servo", "resting"])
    read = load(tmp_path / "mine.toml")
    assert repr(read.loop) == repr(load("servo.toml", ["plant=resting", "tune.over={}"], integrated=False).loop)
    assert dump(read) == (tmp_path / "mine.toml").read_text()


@killed_by("scenario.registry", "not isinstance(part, tuple):", "False:")
@pytest.mark.parametrize("resting", ["None", "{}", "3.0", "[ServoStart()]"], indirect=True)
def test_a_usual_part_that_is_none_is_refused(resting):
    result = run("simulate", *AT_REST, *resting, status=2)
    assert_one_error_line(result)
    assert "usual_parts of plant resting: initial = " in result.stderr
    assert result.stderr.endswith("; a part, or a tuple of parts, is needed\n")
