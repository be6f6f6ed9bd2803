"""FMUs of plants: run by an importer of the tests' own and by FMPy, against the simulation."""

import copy
import ctypes
import dataclasses
import math
import shutil
import zipfile

import jax
import numpy as np
import pytest
from commands import assert_one_error_line, left_in
from commands import run as command
from fmi import Fmu
from marks import cases
from mutants import killed_by
from structured_text import Block

import diffabs as d
from diffabs.compiler.runtime.toolchain import COMPILER
from diffabs.core.types import Vector
from diffabs.output.export import NotExported, build_fmu, computer_program, structured_text
from diffabs.output.export.plant_c import plant_source
from diffabs.parts.controllers import PID, ConstantInput, ConstantTorque, PerChannel, Sampled
from diffabs.parts.plants import MirroredRig, QuadrupleTank
from diffabs.parts.references import FixedSlip
from diffabs.scenario.defaults import braking
from diffabs.scenario.scenario import load

pytestmark = pytest.mark.skipif(shutil.which("c++") is None, reason="no compiler")
STEP, PERIOD, SAMPLES = 1e-4, 1e-3, 400


def imported(loop, folder, step=STEP, name="plant"):
    path = folder / f"{name}.fmu"
    path.write_bytes(build_fmu(loop, name, step=step))
    return Fmu(path, folder / name)


def trajectory(loop, duration, every=10, step=STEP):
    """What is shown at multiples of `every` steps."""
    run = d.rollout(loop, d.FixedStep(step, duration, every=every, kinks=False), {})
    return jax.tree.map(np.asarray, run.trajectory.sample.output)


def followed(one, count, control, names, period=PERIOD):
    """What an FMU shows while it is given control(k), k = 0, 1, ..."""
    rows = [one.get(*names)]
    for k in range(count):
        assert one.set("control", control(k)) == 0
        assert one.step(k * period, period) == 0
        rows.append(one.get(*names))
    return np.array(rows)


PLANTS = {
    "mirrored rig": braking(plant=MirroredRig(), controller=ConstantTorque(torque=2.0)),
    "a wheel that locks": braking(plant=MirroredRig(), controller=ConstantTorque(torque=20.0)),
    "quarter car": braking(controller=ConstantTorque(torque=600.0)),
    "laboratory rig": load("lab-rig", integrated=False).loop,
    "balance": load("arm-hanging", integrated=False).loop,
}


@killed_by("output.export.plant_c", "plant.project(rk4_step(", "(lambda x: x)(rk4_step(", case="a wheel that locks")
@killed_by(
    "output.export.plant_c",
    'm->{array}[{k}] = {name};"',
    'm->{array}[{k}] = {names[(k + 1) % len(names)]};"',
    case="balance",
)
@pytest.mark.parametrize("name", cases(PLANTS, "laboratory rig", "balance", "quarter car"))
def test_an_fmu_runs_as_the_simulation_does(name, tmp_path):
    """To rounding, and so to 1e-6: the control of a whole run goes in, what was shown comes out."""
    loop = PLANTS[name]
    if not isinstance(loop.controller, ConstantTorque):  # then one that is held for a period
        loop = dataclasses.replace(loop, controller=Sampled(controller=loop.controller, period=PERIOD))
    run = d.rollout(loop, d.FixedStep(STEP, 0.2, every=10, kinks=False), {})
    kept = jax.tree.map(np.asarray, run.trajectory.sample)
    count = int(run.trajectory.running.sum()) - 1
    assert count > 150
    one = imported(loop, tmp_path).begin()
    found = followed(one, count, lambda k: float(kept.control[k]), kept.output._fields)
    for column, field in zip(found.T, kept.output._fields, strict=True):
        wanted = getattr(kept.output, field)[: count + 1]
        np.testing.assert_allclose(column, wanted, rtol=1e-6, atol=1e-9, err_msg=field)
    assert np.ptp(found[:, 0]) > 1e-3


@killed_by(
    "output.export.plant_c", "for name, unit in control_units(plant).items()]", 'for name, unit in [("control", "V")]]'
)
def test_a_plant_with_two_inputs_has_both(tmp_path):
    """Constant voltages, which the controllers' limits keep, give the run of the simulation."""
    pumps = {name: PID(kp=0.0, cutoff=1.0, low=volts, high=volts) for name, volts in (("pump_1", 3.0), ("pump_2", 2.5))}
    tank = QuadrupleTank()
    channels = {"pump_1": "level_1", "pump_2": "level_2"}
    loop = d.Loop(plant=tank, **{**tank.usual_parts(), "controller": PerChannel(pumps, channels)})
    wanted = trajectory(loop, 20.0, every=1, step=0.1)
    fmu = imported(loop, tmp_path, step=0.1).begin()
    assert fmu.set("pump_1", 3.0) == fmu.set("pump_2", 2.5) == 0
    for k in range(200):
        assert fmu.step(0.1 * k, 0.1) == 0
    np.testing.assert_allclose(fmu.get(*wanted._fields), [values[-1] for values in wanted], rtol=1e-9)


@pytest.mark.slow
def test_a_loop_closed_outside_is_the_loop(tmp_path):
    """The plant as FMU, the controller as Structured Text: together what was simulated, to 1e-6."""
    loop = braking(
        plant=MirroredRig(),
        controller=Sampled(controller=PID(kp=60.0, ki=400.0, kd=0.3, high=9.03, low=0.0), period=PERIOD),
        reference=FixedSlip(slip=0.2),
        feedforward=ConstantInput(value=2.7),
    )
    one = imported(loop, tmp_path).begin()
    block = Block(structured_text(computer_program(loop), "Law"))
    wanted = trajectory(loop, SAMPLES * PERIOD)
    names = ("slip", "speed", "wheel_speed", "distance")
    found = followed(one, SAMPLES, lambda k: block(slip=one.get("slip")[0]), names)
    for column, name in zip(found.T, names, strict=True):
        np.testing.assert_allclose(column, getattr(wanted, name)[: SAMPLES + 1], rtol=1e-6, atol=1e-9, err_msg=name)
    assert found[-1, 0] == pytest.approx(0.2, abs=0.02)


@pytest.mark.slow
@killed_by(
    "output.export.plant_c",
    'm->v[{self.places[path]}]" if where',
    'begun[{self.places[path]}]" if where == "v" and path != "control" else f"m->v[{self.places[path]}]" if where',
)
@killed_by("output/export/fmi2.c", "(m->phase == RUNNING && at[i] >= OUTPUTS + INPUTS)", "0")
def test_parameters_are_the_importers(tmp_path):
    changed = d.core.pytree.replace(PLANTS["mirrored rig"], {"plant.mass": 6.2, "initial.slip": 0.1})
    one = imported(PLANTS["mirrored rig"], tmp_path)
    assert one.get("plant.mass", "plant.road.w4") == [5.3, 0.407]
    one.begin(plant__mass=6.2, initial__slip=0.1)
    found = followed(one, 100, lambda k: 2.0, ("slip", "speed"))
    wanted = trajectory(changed, 0.1)
    np.testing.assert_allclose(found[:, 0], wanted.slip[:101], rtol=1e-9)
    np.testing.assert_allclose(found[:, 1], wanted.speed[:101], rtol=1e-9)
    assert found[0, 0] == pytest.approx(0.1)
    assert one.set("plant.mass", 5.0) == 3  # an error: it runs
    assert one.set("slip", 0.3) == 3  # an output


@killed_by("output/export/fmi2.c", "{ return copied(c, state); }", "{ return copied(c, c); }")
def test_a_state_can_be_kept_and_taken_again(tmp_path):
    one = imported(PLANTS["mirrored rig"], tmp_path).begin()
    followed(one, 20, lambda k: 2.0, ("slip",))
    kept = one.state()
    first = followed(one, 20, lambda k: 3.0, ("slip", "speed", "distance"))
    one.restore(kept)
    np.testing.assert_array_equal(followed(one, 20, lambda k: 3.0, ("slip", "speed", "distance")), first)


@pytest.mark.slow
@killed_by("output/export/fmi2.c", ": ceil(whole);", ": 1.0;")
def test_steps_of_any_length_are_taken_by_whole_ones(tmp_path):
    """A step of the importer that is no multiple is divided into equal ones, none longer than that of the plant."""
    one = imported(PLANTS["mirrored rig"], tmp_path).begin()
    length, count = 0.02551, 256  # so many are needed
    found = followed(one, 4, lambda k: 2.0, ("slip", "distance"), period=length)
    wanted = trajectory(PLANTS["mirrored rig"], 4 * length, every=count, step=length / count)
    np.testing.assert_allclose(found[:, 0], wanted.slip[:5], rtol=1e-11)
    np.testing.assert_allclose(found[:, 1], wanted.distance[:5], rtol=1e-11)
    assert one.step(1.0, 0.0) == 3
    assert one.step(1.0, math.nan) == 3


@killed_by("output/export/fmi2.c", "|| strcmp(guid, GUID) != 0", "")
def test_who_asks_for_another_is_given_none(tmp_path):
    path = tmp_path / "plant.fmu"
    path.write_bytes(build_fmu(PLANTS["mirrored rig"], "plant", step=STEP))
    assert Fmu(path, tmp_path / "a", guid="{no}").instance.value is None


@killed_by("output.export.plant_c", "unit_at(spec.unit, k, numbers.size)", "unit_at(spec.unit, 0, numbers.size)")
def test_a_number_of_a_list_has_its_own_unit():
    """Each of two units is for a half of the list."""

    @d.core.pytree.pytree
    class Laden(MirroredRig):
        loads: Vector = d.core.pytree.param(default=(1.0, 2.0, 3.0, 4.0), unit="kg, m")

    found = {one.name: one.unit for one in plant_source(braking(plant=Laden())).variables}
    assert [found[f"plant.loads.{k}"] for k in range(4)] == ["kg", "kg", "m", "m"]


@killed_by("output.export.plant_c", 'f"n{k}_"', 'f"n{k}"')
@killed_by("output.export.mockup", "static const double STEP = {step!r};", "#define STEP {step!r}")
def test_a_plant_may_use_the_names_of_the_glue():
    """Names that the C around the plant's code has: of a result, of two constants and of a type."""

    @d.core.pytree.pytree
    class Named(MirroredRig):
        def derivative(self, t, state, control):
            n0 = control * 2.0
            STEP = n0 * n0
            GUID = STEP * n0
            model = GUID * n0
            return MirroredRig.derivative(self, t, state, model)

    text = plant_source(braking(plant=Named())).text
    assert all(f"double {name} =" in text for name in ("n0", "STEP_", "GUID_", "model"))  # capitals may be a macro
    assert build_fmu(braking(plant=Named()), "plant", step=STEP)


@killed_by("output.export.mockup", "enumerate(plant.variables, 1)", "enumerate(plant.variables)")
@killed_by("output.export.mockup", '{"unit": make_printable(variable.unit)}', "{}")
@killed_by("output.export.mockup", "zipfile.ZipInfo(path, LONG_AGO)", "path")
def test_the_description_says_what_is_what(tmp_path):
    one = imported(PLANTS["mirrored rig"], tmp_path)
    assert one.description.get("fmiVersion") == "2.0"
    assert one.description.get("variableNamingConvention", "flat") == "flat"  # a.0 is no structured name
    variables = {scalar.get("name"): scalar for scalar in one.description.iter("ScalarVariable")}
    roles = {name: scalar.get("causality") for name, scalar in variables.items()}
    assert {name for name, role in roles.items() if role == "input"} == {"control"}
    assert {name for name, role in roles.items() if role == "output"} == set(MirroredRig.shows._fields)
    assert roles["plant.road.w1"] == roles["initial.speed"] == "parameter"
    assert variables["control"].find("Real").get("unit") == "N m"
    assert variables["plant.wheel_inertia"].find("Real").get("unit") == "kg m^2"
    assert {unit.get("name") for unit in one.description.iter("Unit")} >= {"N m", "kg m^2", "m/s"}
    listed = [int(one.get("index")) for one in one.description.find("ModelStructure/Outputs")]
    order = [*variables]
    assert [order[index - 1] for index in listed] == list(MirroredRig.shows._fields)
    assert (tmp_path / "plant" / "sources" / "plant.c").is_file()
    with zipfile.ZipFile(tmp_path / "plant.fmu") as archive:
        assert {info.date_time[0] for info in archive.infolist()} == {1980}
    again = build_fmu(PLANTS["mirrored rig"], "plant", step=STEP)
    assert again == (tmp_path / "plant.fmu").read_bytes()


STRICT = ("-O1", "-Wall", "-Wextra", "-Werror", "-Wshadow", "-fsanitize=undefined", "-fno-sanitize-recover=all")


@pytest.fixture(scope="module")
def strict(tmp_path_factory):
    """A function that makes an instance of the mirrored rig, compiled with all warnings as errors, and with checks."""
    folder = tmp_path_factory.mktemp("strict")
    path = folder / "plant.fmu"
    path.write_bytes(build_fmu(PLANTS["mirrored rig"], "plant", step=STEP))
    first = Fmu(path, folder / "in", flags=STRICT)
    return lambda: _another(first)


def _another(one):
    """A new instance of the same library."""
    new = copy.copy(one)
    given = (b"one", 1, one.description.get("guid").encode(), b"", None, 0, 0)
    new.instance = ctypes.c_void_p(one.library.fmi2Instantiate(*given))
    return new


ZERO = ctypes.c_double(0.0)
CALLS = {
    "setup": ("SetupExperiment", 0, ZERO, ZERO, 0, ZERO),
    "enter": ("EnterInitializationMode",),
    "exit": ("ExitInitializationMode",),
    "step": ("DoStep", ZERO, ctypes.c_double(1e-3), 1),
    "terminate": ("Terminate",),
    "reset": ("Reset",),
}


@pytest.mark.parametrize(
    ("calls", "refused"),
    [
        ("enter", "enter"),  # before the experiment is set up
        ("setup exit", "exit"),
        ("setup step", "step"),
        ("setup terminate", "terminate"),
        ("setup enter step", "step"),
        ("setup enter enter", "enter"),
        ("setup enter setup", "setup"),
        ("setup enter terminate", "terminate"),
        ("setup enter exit exit", "exit"),
        ("setup enter exit enter", "enter"),
        ("setup enter exit setup", "setup"),
        ("setup enter exit step terminate step", "step"),
        ("setup enter exit step terminate terminate", "terminate"),
        ("setup enter exit reset step", "step"),
        ("setup enter exit step step terminate reset setup enter exit step", ""),
    ],
)
def test_calls_out_of_order_are_errors(calls, refused, strict):
    one = strict()
    *before, last = calls.split()
    assert [one.call(*CALLS[name]) for name in before] == [0] * len(before)
    assert one.call(*CALLS[last]) == (3 if refused else 0)


@killed_by("output/export/fmi2.c", "if (isfinite(m->stop) && from + length", "if (0 && from + length")
@killed_by("output/export/fmi2.c", "m->stop + 1e-9 * (fabs(m->stop) + length)", "m->stop")
def test_no_step_passes_the_stop_time(strict):
    """FMI 2.0, 2.1.6: an error. Times that an importer adds up differ from the stop time by rounding."""
    one = strict()
    assert one.call("SetupExperiment", 0, ZERO, ZERO, 1, ctypes.c_double(0.1)) == 0
    assert [one.call(*CALLS[name]) for name in ("enter", "exit")] == [0, 0]
    assert one.step(0.0, 0.2) == 3
    time, length = 0.0, 0.01 * (1 + 1e-12)
    for _ in range(10):
        assert one.step(time, length) == 0  # the refused step changed nothing
        time += length
    assert time > 0.1
    assert one.step(time, length) == 3
    assert one.call("Reset") == 0
    assert [one.call(*CALLS[name]) for name in ("setup", "enter", "exit")] == [0, 0, 0]
    assert one.step(0.0, 0.2) == 0  # no stop time is declared


def test_calls_without_an_instance_are_errors(strict):
    one = strict()
    one.instance = None
    value, size, nothing = ctypes.c_double(), ctypes.c_size_t(), ctypes.c_void_p(None)
    more = {
        "get": ("GetReal", None, size, ctypes.byref(value)),
        "set": ("SetReal", None, size, ctypes.byref(value)),
        "keep": ("GetFMUstate", ctypes.byref(nothing)),
        "restore": ("SetFMUstate", nothing),
        "size": ("SerializedFMUstateSize", nothing, ctypes.byref(size)),
        "time": ("GetRealStatus", 2, ctypes.byref(value)),
    }
    for name, call in (CALLS | more).items():
        assert one.call(*call) == 3, name


def test_parameters_have_limits(strict):
    """In the description and in the library, the same, from the ranges of the parts."""
    one = strict()
    variables = {scalar.get("name"): scalar.find("Real") for scalar in one.description.iter("ScalarVariable")}
    specs = d.core.pytree.elements(PLANTS["mirrored rig"].plant)
    assert float(variables["plant.mass"].get("min")) > 0
    assert variables["plant.mass"].get("max") is None
    assert (variables["initial.slip"].get("min"), variables["initial.slip"].get("max")) == ("0.0", "1.0")
    assert variables["control"].get("min") is variables["slip"].get("min") is None
    assert one.call(*CALLS["setup"]) == one.call(*CALLS["enter"]) == 0
    for name, spec in specs.items():
        real = variables[f"plant.{name}"]
        low, high = float(real.get("min", -math.inf)), float(real.get("max", math.inf))
        start = float(real.get("start"))
        assert spec.holds(start)
        for value in (low, high, start, -1.0, 0.0, 2.0, 1e300, math.inf, -math.inf, math.nan):
            assert one.set(f"plant.{name}", value) == (0 if spec.holds(value) else 3), (name, value)
        assert all(spec.holds(x) for x in (low, high) if math.isfinite(x))
        assert one.set(f"plant.{name}", start) == 0
    assert one.set("control", math.nan) == 3
    assert one.call(*CALLS["exit"]) == 0
    assert one.set("control", math.inf) == 3
    assert one.set("control", 2.0) == 0
    assert one.step(0.0, 1e-3) == 0


def test_a_value_out_of_range_changes_nothing(strict):
    one = strict()
    both = (ctypes.c_uint * 2)(one.references["plant.wheel_radius"], one.references["plant.mass"])
    values = (ctypes.c_double * 2)(0.2, -1.0)
    before = one.get("plant.wheel_radius", "plant.mass")
    assert one.call("SetReal", both, ctypes.c_size_t(2), values) == 3
    assert one.get("plant.wheel_radius", "plant.mass") == before


def test_what_is_no_state_of_this_plant_is_refused(strict):
    one = strict().begin()
    kept, size = one.state(), ctypes.c_size_t()
    assert one.call("SerializedFMUstateSize", kept, ctypes.byref(size)) == 0
    data, restored = (ctypes.c_char * size.value)(), ctypes.c_void_p(None)
    assert one.call("SerializeFMUstate", kept, data, size) == 0
    assert one.call("DeSerializeFMUstate", data, size, ctypes.byref(restored)) == 0
    one.restore(restored)
    assert one.step(0.0, 1e-3) == 0
    data[:] = b"\xff" * size.value
    assert one.call("DeSerializeFMUstate", data, size, ctypes.byref(ctypes.c_void_p(None))) == 3
    one.restore(kept)


@pytest.mark.slow
@pytest.mark.parametrize("about", ["bell \x07, null \0", "\x1b[2J", "<a b='&'> ]]>", "\ud800", "\ufffe"])
def test_a_description_is_xml_whatever_the_title(about, tmp_path):
    path = tmp_path / "plant.fmu"
    path.write_bytes(build_fmu(PLANTS["mirrored rig"], "plant", step=STEP, about=about))
    one = Fmu(path, tmp_path / "in")  # reads it
    assert len(one.description.get("description")) == len(about)
    assert one.description.get("description").isprintable()


@killed_by("output.export.mockup", "step, duration = float(step), float(duration)", "pass")
def test_numbers_of_numpy_are_numbers():
    """A step as from a list of steps gives the same FMU as one of Python, to the byte."""
    rig = PLANTS["mirrored rig"]
    found = build_fmu(rig, "plant", step=np.float64(STEP), duration=np.float64(2.0))
    assert found == build_fmu(rig, "plant", step=STEP, duration=2.0)


@killed_by("output.export.mockup", "0 < x < math.inf for x in", "0 <= x < math.inf for x in", case="0.0-1.0")
@killed_by("output.export.mockup", "0 < x < math.inf for x in", "0 < x for x in", case="0.0001-inf")
@pytest.mark.parametrize(
    ("step", "duration"), [(0.0, 1.0), (-STEP, 1.0), (math.inf, 1.0), (math.nan, 1.0), (STEP, 0.0), (STEP, math.inf)]
)
def test_times_that_no_importer_can_use_are_refused(step, duration):
    with pytest.raises(ValueError, match=r"^step = .* s, duration = .* s: positive and finite numbers are needed$"):
        build_fmu(PLANTS["mirrored rig"], "plant", step=step, duration=duration)


@pytest.mark.parametrize("name", ["../../x", "a b", "int", "é", ""])
def test_a_name_that_c_does_not_have_is_refused(name):
    with pytest.raises(NotExported, match="no name that C has"):
        build_fmu(PLANTS["mirrored rig"], name, step=STEP)


def test_fmpy_runs_it_to_the_simulation(tmp_path):
    """A library that many use reads the description, validates it, and runs it."""
    fmpy = pytest.importorskip("fmpy")
    validation = pytest.importorskip("fmpy.validation")
    path = tmp_path / "plant.fmu"
    path.write_bytes(build_fmu(PLANTS["mirrored rig"], "plant", step=STEP))
    assert validation.validate_fmu(str(path)) == []
    found = fmpy.simulate_fmu(
        str(path), stop_time=0.2, output_interval=PERIOD, start_values={"control": 2.0}, output=["slip", "speed"]
    )
    wanted = trajectory(PLANTS["mirrored rig"], 0.2)
    for name in ("slip", "speed"):
        np.testing.assert_allclose(found[name], getattr(wanted, name)[: len(found)], rtol=1e-6)
    assert len(found) == 201


def test_the_command_writes_an_fmu(tmp_path):
    result = command("export", "slip-lmi", "--to", "fmu", "--set", "solver.step=1e-3", "-o", tmp_path / "rig-1.fmu")
    assert "FMI 2.0 for co-simulation, input control [N m]" in result.stderr
    assert left_in(tmp_path) == {"rig-1.fmu"}
    one = Fmu(tmp_path / "rig-1.fmu", tmp_path / "in").begin()
    assert one.get("speed") == [pytest.approx(50 / 3.6)]
    assert one.description.get("modelName") == "rig_1"
    assert one.description.find("DefaultExperiment").get("stepSize") == "0.001"


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--to", "fmu"), "--to fmu needs a file: -o plant.fmu"),
        (("--to", "fmu", "-o", "x.fmu", "--set", "solver.type=adaptive"), "an FMU takes fixed steps"),
        (("--to", "fmu", "-o", "x.fmu", "--float32"), "--float32 and --given are for --to c and --to st"),
    ],
)
def test_the_command_refuses_in_one_line(words, said, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    result = command("export", "slip-lmi", *words, status=2)
    assert said in result.stderr
    assert_one_error_line(result)
    assert left_in(tmp_path) == set()


def test_without_a_compiler_it_is_said(tmp_path, monkeypatch):
    monkeypatch.setenv(COMPILER, "")
    with pytest.raises(NotExported, match="needs a C compiler"):
        build_fmu(PLANTS["mirrored rig"], "plant", step=STEP)
    result = command("export", "slip-lmi", "--to", "fmu", "-o", tmp_path / "x.fmu", status=2)
    assert "an FMU needs a C compiler" in result.stderr
    assert left_in(tmp_path) == set()
