"""Exported controllers: compiled, and against the parts themselves and against whole runs."""

import collections
import dataclasses
import math
import re
import shutil
import subprocess

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from commands import assert_one_error_line
from commands import run as command
from marks import cases
from mutants import killed_by
from structured_text import Block

import diffabs as d
from diffabs.compiler.lower.labels import Labelled
from diffabs.core.protocols import BalanceOutput, BrakeOutput
from diffabs.output.export import (
    NotExported,
    c_source,
    computer_program,
    difference_equations,
    sample_controller,
    structured_text,
)
from diffabs.output.export.device import Input
from diffabs.output.export.lowered import MEMORY, name_memory, number_leaves
from diffabs.output.export.plant_c import plant_source
from diffabs.parts.controllers import (
    PID,
    BackCalculation,
    Cascade,
    Clamping,
    ConstantInput,
    FourPhase,
    HoldingInput,
    MatrixFeedback,
    ObserverFeedback,
    PerChannel,
    ProportionalFeedback,
    Sampled,
    SampledOnGrid,
    ScheduledFeedback,
    SelectLow,
    SlidingMode,
    StateFeedback,
)
from diffabs.parts.plants import ArmBalance, LabRig, MirroredRig, QuadrupleTank, QuarterCar
from diffabs.parts.references import FilteredSlip, FixedSlip, PeakLatch, PerTarget, Setpoint
from diffabs.parts.roads import PiecewiseLinear, Tabulated
from diffabs.scenario.defaults import balancing, braking
from diffabs.scenario.scenario import load

needs_cc = pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler")
SAMPLES = 10_000
SANITIZED = ("-fsanitize=undefined,float-cast-overflow", "-fno-sanitize-recover=all")
FLAGS = ("-std=c99", "-O2", "-pedantic", "-Wall", "-Wextra", "-Werror", "-Wconversion", "-Wshadow", *SANITIZED)


def rig(controller, **parts):
    usual = {"plant": MirroredRig(), "reference": FixedSlip(slip=0.2), "feedforward": ConstantInput(value=2.7)}
    return braking(**{**usual, "controller": Sampled(controller=controller, period=1e-3), **parts})


def observer():
    draw = np.random.default_rng(5)
    transition = np.eye(6) * 0.8 + 0.02 * draw.normal(size=(6, 6))
    matrices = {"transition": transition, "entry": draw.normal(size=6), "correction": draw.normal(size=(6, 2)) * 0.05}
    return ObserverFeedback(gain=draw.normal(size=6), predicted_high=3.0, **matrices)


@d.core.pytree.pytree
class Approach:
    """A target that moves from the first measured output to a value."""

    value: float = d.core.pytree.param(default=0.3, unit="signal")

    def start(self, signal):
        return d.core.protocols.Memory(flow=signal[0])

    def flow(self, t, memory, signal):
        return (self.value - memory.flow) / 0.035

    def output(self, t, memory, signal):
        return memory.flow

    def setpoint(self, memory):
        return self.value


def tank(controller, **parts):
    """A loop with two pumps, whose second target moves by itself."""
    reference = PerTarget(reference={"level_1": Setpoint(value=0.134), "level_2": Approach()})
    plant = QuadrupleTank()
    usual = {**plant.usual_parts(), "reference": reference, "controller": Sampled(controller=controller, period=1e-3)}
    return d.Loop(plant=plant, **{**usual, **parts})


PUMPS = {"pump_1": "level_1", "pump_2": "level_2"}
K = ((-5.0, 0.3, -60.0, 7.0), (0.2, -3.4, 5.0, -40.0))
MOVING = {"filtered target", "two channels", "least of two commands"}
DTYPES = [pytest.param(np.float64, id="float64"), pytest.param(np.float32, id="float32", marks=pytest.mark.slow)]
LOOPS = {
    "state feedback": rig(StateFeedback(gain=(-300.0, -48.0))),
    "PID, filtered derivative": rig(PID(kp=60.0, ki=400.0, kd=0.3, high=9.03, low=0.0)),
    "conditional integration": rig(PID(kp=30.0, ki=900.0, high=9.03, antiwindup=Clamping(), low=0.0)),
    "back-calculation": rig(PID(kp=30.0, ki=900.0, high=9.03, antiwindup=BackCalculation(), low=0.0)),
    "schedule": rig(ScheduledFeedback(speeds=(2.0, 6.0, 14.0), integral_gains=(-90.0, -200.0, -300.0),
                                      gains=(-9.0, -40.0, -58.0), low=0.0, high=9.03)),
    "proportional to the speed": rig(ProportionalFeedback(gain=(-300.0, -48.0), low=0.0, high=9.03)),
    "filtered target": rig(StateFeedback(gain=(-300.0, -48.0)), reference=FilteredSlip()),
    "holding torque": rig(StateFeedback(gain=(-300.0, -48.0)), feedforward=HoldingInput()),
    "holding command, table of friction": rig(SlidingMode(gain=0.2, low=0.0, high=90.0), feedforward=HoldingInput(),
        plant=LabRig(road=Tabulated())),
    "cascade": rig(Cascade(outer=PID(kp=60.0, ki=40.0, low=0.0, high=30.0), inner_signal="speed",
        inner=PID(kp=0.8, ki=9.0, kd=0.01, low=0.0, high=9.03, antiwindup=BackCalculation()))),
    "observer": balancing(controller=Sampled(controller=observer(), period=0.01)),
    "four phases": rig(FourPhase(torque_low=3.0, torque_high=9.0, rate=900.0)),
    "two channels": tank(PerChannel({"pump_1": PID(kp=15.0, ki=400.0, low=0.0, high=9.0, antiwindup=Clamping()),
        "pump_2": PID(kp=9.0, ki=200.0, kd=0.03, low=0.0, high=8.0)}, PUMPS)),
    "the same gains": tank(PerChannel(PID(kp=9.0, ki=40.0, low=0.0, high=9.0), PUMPS),
        reference=PerTarget(reference={"level_1": Setpoint(value=0.134), "level_2": Setpoint(value=0.127)})),
    "least of two commands": tank(SelectLow(groups=(("pump_1", "pump_2"),),
        controller=MatrixFeedback(gain=K, low=(0.0, 1.0), high=(9.0, 8.0), outputs_at_rest=(0.13, 0.12),
        windup=np.zeros((2, 2)), states=("level_1", "level_2")))),
}  # fmt: skip


def measured(loop, seed, lost=True):
    """Random signals (SAMPLES,) of whatever the plant shows: of a brake within what it can show. Some samples of each
    are `lost`, a NaN."""
    draw = np.random.default_rng(seed)
    if loop.plant.shows is BalanceOutput:
        found = BalanceOutput(*(0.3 * draw.normal(size=SAMPLES) for _ in BalanceOutput._fields))
    elif hasattr(loop.plant, "controls"):
        found = type(loop.plant.output(loop.start().plant))(*draw.uniform(0.0, 0.3, (4, SAMPLES)))
    else:
        speed = draw.uniform(0.5, 20.0, SAMPLES)
        slip = np.clip(0.2 + 0.15 * draw.normal(size=SAMPLES), 0.0, 1.0)
        found = BrakeOutput(slip, speed, speed * (1 - slip), 6 * draw.uniform(size=SAMPLES), 0 * slip)
    for k, column in enumerate(found if lost else ()):
        column[[10 + 4 * k, 11 + 4 * k, 5000 + 4 * k]] = np.nan
    return found


def commands_of_parts(loop, seen, dtype, step=None):
    """What the parts themselves command, (SAMPLES,) or a column for each control: reference, feed-forward, `Sampled`'s
    own tick."""
    with jax.enable_x64(dtype == np.float64):
        loop, seen = jax.tree.map(lambda x: jnp.asarray(x, dtype), (d.core.pytree.canonical_dtypes(loop), seen))
        h = loop.controller.period / (step or 1)

        def tracking(reference, y):
            target, setpoint = loop.reference.output(0.0, reference, y), loop.reference.setpoint(reference)
            return d.core.protocols.Tracking(target, y, loop.feedforward.input(loop.plant, y, setpoint))

        def moved(reference, y):
            return d.engine.step.runge_kutta.rk4_step(
                lambda t, x: loop.reference.flow(t, reference._replace(flow=x), y), 0.0, reference.flow, h
            )

        def sample(carry, row):
            (reference, memory), (k, y) = carry, row
            signal = tracking(reference, y)
            clock = d.core.protocols.Clock(k * loop.controller.period, loop.controller.period, k, None, before=signal)
            memory = loop.controller.tick(clock, memory, signal)
            command = loop.controller.output(0.0, memory, signal)
            for _ in range(step or 1):
                if jax.tree.leaves(reference.flow):
                    reference = reference._replace(flow=moved(reference, y))
            return (reference, memory), command

        @jax.jit
        def run():
            first = jax.tree.map(lambda x: x[0], seen)
            reference = loop.reference.start(first)
            memory = loop.controller.start(tracking(reference, first))
            return jax.lax.scan(sample, (reference, memory), (jnp.arange(SAMPLES), seen))[1]

        commands = run()
        return np.stack(commands, axis=-1) if isinstance(commands, tuple) else np.asarray(commands)


def compiled(text, name, folder):
    """The program of an exported text."""
    source, program = folder / f"{name}.c", folder / name
    source.write_text(text)
    subprocess.run(["cc", *FLAGS, f"-D{name.upper()}_MAIN", source, "-o", program, "-lm"], check=True)
    return program


def commands_of_c(found, text, name, seen, folder):
    """What the compiled text commands; its inputs are found by the names in its struct."""
    struct = text.partition("typedef struct {")[2].partition("}")[0]
    names = [line.split()[1].rstrip(";") for line in struct.splitlines() if f"{name}_real" in line]
    columns = [np.asarray(getattr(seen, name), found.dtype) for name in names]
    lines = "\n".join(" ".join(f"{value:.17g}" for value in row) for row in zip(*columns, strict=True))
    program = compiled(text, name, folder)
    said = subprocess.run([program], input=lines + "\n", capture_output=True, text=True, check=True).stdout
    return np.array([line.split() for line in said.splitlines()], float).squeeze()


@pytest.mark.slow
@killed_by(
    "compiler.operations",
    '"lower({0}, {1})", "{0} < {1} ? {0} : {1}"',
    '"lower({0}, {1})", "{0} > {1} ? {0} : {1}"',
    case="PID, filtered derivative-float64",
)
@killed_by(
    "compiler.emit.c99_words",
    'return f"{args[0]} ? {args[2]} : {args[1]}"',
    'return f"{args[0]} ? {args[1]} : {args[2]}"',
    case="conditional integration-float64",
)
@killed_by("output.export.c99", "i < {self.device.moves}", "i < 1", case="filtered target-float64")
@killed_by(
    "output.export.device",
    "return inner, state.samples + 1, command",
    "return inner, state.samples, command",
    case="observer-float64",
)
@needs_cc
@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("name", LOOPS)
def test_what_is_exported_commands_what_the_parts_do(name, dtype, tmp_path):
    loop, seen = LOOPS[name], measured(LOOPS[name], seed=11)
    step = 4 if name in MOVING else None
    found = computer_program(loop, step=1e-3 / 4 if step else None, dtype=dtype)
    text = c_source(found, "unit")
    wanted = commands_of_parts(loop, seen, dtype, step)
    result = commands_of_c(found, text, "unit", seen, tmp_path)
    assert len(result) == SAMPLES
    assert np.all(np.ptp(wanted, axis=0) > 0)
    tolerance = 1e-11 if dtype == np.float64 else 3e-3  # an integral over 10,000 samples gathers roundings
    np.testing.assert_allclose(result, wanted, rtol=tolerance, atol=tolerance * np.max(np.abs(wanted)))
    early = slice(0, 50)
    tight = 1e-13 if dtype == np.float64 else 2e-5
    np.testing.assert_allclose(result[early], wanted[early], rtol=tight, atol=tight * np.max(np.abs(wanted)))


CALLER = """
#include "unit.c"
#include <stdio.h>

int main(void)
{
  unit_parameters p = unit_defaults;
  const unit_input in[] = {{0.1}, {NAN}, {0.1}, {0.3}};
  unit_state s;
  unit_start(&s, &p, &in[1]);
  for (int k = 0; k < 4; k++) {
    printf("%.17g", unit_step(&s, &p, &in[k]));
    printf(" %d\\n", s.held);
    p.kp = 80.0;
    p.high = 4.0;
  }
  return 0;
}
"""


def limited():
    """A PID whose numbers are changed after the first sample; what it then commands, by hand, and whether it holds."""
    first = 2.7 + 60.0 * 0.1
    integral = 1e-3 * 0.1
    then = [min(2.7 + 80.0 * 0.1 + 400.0 * integral, 4.0), max(2.7 - 80.0 * 0.1 + 400.0 * 2 * integral, 0.0)]
    pid = PID(kp=60.0, ki=400.0, low=0.0, high=9.03)
    return rig(pid), [first, first, *then], [0, 1, 0, 0]


@needs_cc
def test_c_code_takes_parameters_and_lost_samples(tmp_path):
    """Also the first measurement, at the start, may be lost."""
    loop, wanted, held = limited()
    (tmp_path / "unit.c").write_text(c_source(computer_program(loop), "unit"))
    (tmp_path / "caller.c").write_text(CALLER)
    flags = [flag for flag in FLAGS if flag != "-pedantic"]
    subprocess.run(["cc", *flags, "caller.c", "-o", "caller", "-lm"], check=True, cwd=tmp_path)
    said = subprocess.run([tmp_path / "caller"], capture_output=True, text=True, check=True).stdout
    rows = np.array([line.split() for line in said.splitlines()], float)
    np.testing.assert_allclose(rows[:, 0], wanted, rtol=1e-12)
    assert rows[:, 1].tolist() == held


def test_structured_text_takes_parameters_and_lost_samples():
    loop, wanted, held = limited()
    text = structured_text(computer_program(loop), "Unit")
    block, found = Block(text), []
    for slip in (0.1, np.nan, 0.1, 0.3):
        found.append((block(slip=slip), int(block.values["HELD"])))
        block.values |= {"KP": 80.0, "HIGH": 4.0}
    np.testing.assert_allclose([command for command, _ in found], wanted, rtol=1e-12)
    assert [flag for _, flag in found] == held
    assert "kp : LREAL := 60.0; (* [N m] in (-inf, inf) *)" in text


HOSTILE = [
    "a *\\\n/ int x = 1/0; /* b",
    "a *??/\n/ int x = 1/0; /* b",
    "a */ #error b",
    "a /* b",
    "a (* b *) x := 1; (* {pragma} $N",
    "// ??/ \\",
    "\u202e\x1b[2J \0 \u65e5\u672c \r\n #include",
]


@needs_cc
@pytest.mark.parametrize("text", HOSTILE)
def test_a_comment_ends_where_it_should(text, tmp_path):
    """Whatever stands in a title, in the unit of a part from outside, or in that of its control."""

    @d.core.pytree.pytree
    class Gain:
        start, flow = d.core.protocols.no_memory, d.core.protocols.no_flow
        k: float = d.core.pytree.param(default=3.0, unit=text)

        def output(self, t, memory, signal):
            return self.k * signal.measured.slip

    found = computer_program(rig(Gain()))
    found = dataclasses.replace(found, commands={"command": text}, units={name: text for name in found.units})
    program = compiled(c_source(found, "unit", [text]), "unit", tmp_path)
    said = subprocess.run([program], input="0.5\n", capture_output=True, text=True, check=True).stdout
    assert float(said) == 1.5
    written = structured_text(found, "Unit", [text])
    assert Block(written)(slip=0.5) == 1.5
    assert written.isascii()
    assert not re.search(r"[{}$]", written)


# Of IEC 61131-3, table of keywords.
ST_RESERVED = """
ABSTRACT CONTINUE DATE_AND_TIME END_IF END_VAR EN ENO F_EDGE IMPLEMENTS LTOD NON_RETAIN R_EDGE TIME_OF_DAY TOD VAR_INPUT
WCHAR"""
# Of the headers that the C text includes, of compilers without -std=c99, and of the texts themselves.
C_RESERVED = """
NAN INFINITY HUGE_VAL FP_NAN EOF NULL BUFSIZ SEEK_SET INT64_MAX math_errhandling stdin errno linux unix asm typeof
double exp isnan printf main s p held command reset started i first n0_ x_table
"""


@needs_cc
@killed_by("compiler.emit.c99_words", "or C_MACRO.fullmatch(name)", "")
@killed_by("output.export.structured_text", 'or name.lower().startswith("end_")', "")
@pytest.mark.parametrize("standard", ["c99", "gnu17"])
def test_names_that_a_language_has_taken_get_others(standard, tmp_path):
    """Fields of a part, and entries of its memory, whose text could also end a comment."""
    reserved = [*ST_RESERVED.split(), *C_RESERVED.split()]
    memory = ("*/", "*)", 'a"b', "line\nbreak", "x" * 5000)
    fields = {name: d.core.pytree.param(default=float(k), unit="1") for k, name in enumerate(reserved, 1)}

    def start(self, signal):
        return d.core.protocols.Memory({name: jnp.asarray(signal.measured.slip) for name in memory}, ())

    def flow(self, t, kept, signal):
        return jax.tree.map(jnp.zeros_like, kept.flow)

    def output(self, t, kept, signal):
        return sum(getattr(self, name) for name in fields) * signal.measured.slip + sum(kept.flow.values())

    methods = {"start": start, "flow": flow, "output": output, "limits": lambda self: (-1e9, 1e9)}
    part = type("Taken", (), {"__annotations__": dict.fromkeys(fields, float), **fields, **methods})
    found = computer_program(rig(d.core.pytree.pytree(part)()))
    (tmp_path / "a.c").write_text(c_source(found, "unit"))
    subprocess.run(["cc", f"-std={standard}", "-DUNIT_MAIN", "-o", tmp_path / "a", tmp_path / "a.c", "-lm"], check=True)
    said = subprocess.run([tmp_path / "a"], input="0.5\n", capture_output=True, text=True, check=True).stdout
    command = 0.5 * sum(range(1, len(reserved) + 1)) + 0.5 * len(memory)
    assert float(said) == pytest.approx(command, rel=1e-14)  # sums of a few ten numbers in another order
    written = structured_text(found, "Unit")
    assert Block(written)(slip=0.5) == pytest.approx(command, rel=1e-14)
    declared = set(re.findall(r"^  (\w+) :", written, re.MULTILINE)) - {"reset", "command", "held", "started"}
    assert not {name.lower() for name in declared} & set(ST_RESERVED.lower().split())


@needs_cc
def test_names_that_c_does_not_have_get_others(tmp_path):
    """Fields whose letters are not of ASCII, two of which would be called the same."""

    @d.core.pytree.pytree
    class Greek:
        start, flow = d.core.protocols.no_memory, d.core.protocols.no_flow
        α: float = d.core.pytree.param(default=3.0, unit="1")
        β: float = d.core.pytree.param(default=0.5, unit="1")

        def output(self, t, memory, signal):
            return self.α * signal.measured.slip + self.β

    found = computer_program(rig(Greek()))
    program = compiled(c_source(found, "unit"), "unit", tmp_path)
    said = subprocess.run([program], input="0.5\n", capture_output=True, text=True, check=True).stdout
    assert float(said) == 2.0
    assert Block(structured_text(found, "Unit"))(slip=0.5) == 2.0


def test_numbers_are_called_as_in_the_source():
    """No number has a name that says nothing."""
    text = c_source(computer_program(LOOPS["PID, filtered derivative"]), "unit")
    assert "filter_rate_4 = p->cutoff * filter_rate_3;" in text
    assert not re.search(r"\b[a-z]\d+\b", text.replace("int64_t", ""))


@needs_cc
def test_a_compiler_without_nan_is_refused(tmp_path):
    (tmp_path / "unit.c").write_text(c_source(computer_program(LOOPS["state feedback"]), "unit"))
    result = subprocess.run(["cc", "-ffast-math", "-c", "unit.c"], cwd=tmp_path, capture_output=True, text=True)
    assert result.returncode != 0
    assert "compile without -ffast-math" in result.stderr


@pytest.mark.slow
@killed_by(
    "compiler.emit.c99_words",
    'np.format_float_positional(x, trim="0")',
    'np.format_float_positional(x, precision=7, trim="0")',
)
@needs_cc
@pytest.mark.parametrize("name", ["slip-cured", "literature-four-phase"])
def test_a_whole_run_is_what_the_exported_controller_does(name, tmp_path):
    """Sample by sample: what it measured goes in, what it commanded comes out."""
    chosen = load(name, ["initial.speed_kmh=40"], integrated=False)
    loop = chosen.loop
    if not isinstance(loop.controller, Sampled):
        loop = dataclasses.replace(loop, controller=Sampled(controller=loop.controller, period=1e-3))
    every = round(float(loop.controller.period) / chosen.solver.step)
    run = d.rollout(loop, d.FixedStep(chosen.solver.step, 0.8, every=every), chosen.objectives)
    count = int(run.trajectory.running.sum())
    seen = jax.tree.map(lambda x: np.asarray(x)[:count], run.trajectory.sample.output)
    found = computer_program(loop, step=chosen.solver.step)
    result = commands_of_c(found, c_source(found, "unit"), "unit", seen, tmp_path)
    assert count > 300
    np.testing.assert_allclose(result, np.asarray(run.trajectory.sample.command)[:count], rtol=1e-12, atol=1e-12)


@killed_by("output.export.device", 'if offers(reference, "tick", "margins") or moves:', "if False:")
@needs_cc
def test_the_target_can_come_from_outside(tmp_path):
    loop = rig(PID(kp=60.0, ki=400.0, low=0.0, high=90.0), reference=PeakLatch())
    with pytest.raises(NotExported, match="PeakLatch follows what is measured"):
        computer_program(loop)
    found = computer_program(loop, given_target=True)
    text = c_source(found, "given")
    program = compiled(text, "given", tmp_path)
    said = subprocess.run([program], input="0.1 0.2\n0.1 0.3\n", capture_output=True, text=True, check=True).stdout
    first, second = map(float, said.split())
    assert first == pytest.approx(2.7 + 60.0 * 0.1)
    assert second == pytest.approx(2.7 + 60.0 * 0.2 + 400.0 * 1e-3 * 0.1)
    assert "target; /* [1] */" in text


@killed_by("output.export.lowered", "where == NUMBERS and isinstance", "where == INPUTS and isinstance")
@killed_by("output.export.device", "outputs_like(measured, setpoint) if", "measured[0] if")
@needs_cc
def test_commands_and_targets_are_members_by_name(tmp_path):
    """The quadruple tank's two PI controllers, the first of them at its limit, by hand."""
    path = tmp_path / "tank.c"
    command("export", "quadruple-tank", "--period", "0.5", "--given", "target", "-o", path)
    text = path.read_text()
    for member in ("level_2; /* [m] */", "target_level_2; /* [m] */", "pump_2; /* [V] */", "pump_1_kp; /* [V/m] in"):
        assert f"  tank_real {member}" in text
    assert "  tank_real pump_1; /* [V] */\n  tank_real pump_2; /* [V] */\n} tank_command;" in text
    program = compiled(text, "tank", tmp_path)
    order = re.findall(r"tank_real (\w+);", text.partition("} tank_input")[0])
    values = {"level_1": 0.10, "level_2": 0.13, "target_level_1": 0.2, "target_level_2": 0.12}
    line = " ".join(str(values[name]) for name in order)
    said = subprocess.run([program], input=f"{line}\n" * 2, capture_output=True, text=True, check=True).stdout
    plant = QuadrupleTank()
    pumps = plant.holding(None, collections.namedtuple("Target", ["level_1", "level_2"])(0.2, 0.12))
    first = float(pumps.pump_2) - 135.0 * 0.01
    wanted = [[10.0, first], [10.0, first - 3.375 * 0.5 * 0.01]]
    np.testing.assert_allclose([[*map(float, row.split())] for row in said.splitlines()], wanted, rtol=1e-6)


def test_a_control_may_have_the_name_of_a_field_of_memory():
    """Controls called flow and held, words that other names of memory lack."""
    state = computer_program(LOOPS["two channels"]).state
    state = state._replace(command=collections.namedtuple("Valves", ["flow", "held"])(*state.command))
    names = number_leaves(state, Labelled(), MEMORY, name_memory)
    assert {"command.flow", "command.held", "controller.pump_1.integral"} < {*names}


def test_difference_equations_of_two_channels():
    found = difference_equations(sample_controller(load("quadruple-tank").loop, 0.5))
    levels, pumps = ("level_1", "level_2"), ("pump_1", "pump_2")
    assert found["inputs"] == [
        *(f"target.{name}" for name in levels),
        *levels,
        *(f"feedforward.{name}" for name in pumps),
    ]
    np.testing.assert_allclose(found["H"], [[5.0, 0.0, 0.0, 0.0], [0.0, 0.0, 3.375, 0.0]], rtol=1e-12)
    rows = [[150.0, 0.0, -150.0, 0.0, 1.0, 0.0], [0.0, 135.0, 0.0, -135.0, 0.0, 1.0]]
    np.testing.assert_allclose(found["J"], rows, rtol=1e-12)


@pytest.mark.slow
@killed_by("output.export.difference_equations", "with jax.enable_x64(True):", "if True:")
@killed_by("output.export.difference_equations", "jax.tree.map(lambda x: jnp.asarray(x, float), loop)", "loop")
def test_difference_equations_are_the_controllers():
    """In double precision, also where a session and the loop's own numbers have single precision."""
    pid = PID(kp=60.0, ki=400.0, kd=0.25, cutoff=55.0, high=np.inf, low=0.0)
    with jax.enable_x64(False):
        found = difference_equations(d.arrays(rig(pid, feedforward=HoldingInput())))
    assert found["inputs"] == ["target", "slip", "feedforward"]
    T, wc, kd = float(np.float32(1e-3)), 55.0, 0.25
    np.testing.assert_allclose(found["F"], [[1.0, 0.0], [0.0, 1 - T * wc]], rtol=1e-12)
    np.testing.assert_allclose(found["G"], [[T, -T, 0.0], [T * wc, -T * wc, 0.0]], rtol=1e-12)
    np.testing.assert_allclose(found["H"], [400.0, -kd * wc], rtol=1e-12)
    np.testing.assert_allclose(found["J"], [60 + kd * wc, -60 - kd * wc, 1.0], rtol=1e-12)
    with pytest.raises(NotExported, match="continuous time"):
        difference_equations(braking(plant=MirroredRig(), controller=StateFeedback(), feedforward=HoldingInput()))


@pytest.mark.slow
@killed_by("linear.opened_loop", "_open(loop, target, plant=False)", "_open(loop, target, plant=True)")
def test_a_kink_of_the_plant_does_not_matter_to_a_controller():
    """The friction has a knot at the target; the equations of the PI are its own."""
    rig_at_knot = {"plant": QuarterCar(road=PiecewiseLinear()), "reference": FixedSlip(slip=0.2)}
    pi = PID(kp=60.0, ki=400.0, high=np.inf, low=0.0)
    found = difference_equations(braking(**rig_at_knot, controller=Sampled(controller=pi, period=2e-3)))
    assert dict(zip(found["inputs"], found["J"], strict=True)) == {"target": 60.0, "slip": -60.0, "feedforward": 1.0}
    assert (found["G"][0], found["H"]) == ([2e-3, -2e-3, 0.0], [400.0, 0.0])


@pytest.mark.parametrize("name", ["2fast", "a b", "float", "while"])
def test_a_name_that_c_does_not_have_is_refused(name):
    with pytest.raises(NotExported, match="no name that C has"):
        c_source(computer_program(LOOPS["state feedback"]), name)


def test_an_operation_without_translation_is_named():
    @d.core.pytree.pytree
    class Sorted:
        start, flow = d.core.protocols.no_memory, d.core.protocols.no_flow

        def output(self, t, memory, signal):
            return jax.lax.lgamma(signal.measured.slip)

    with pytest.raises(NotExported, match="lgamma has no translation to C"):
        c_source(computer_program(rig(Sorted())), "unit")


@killed_by("output.export.difference_equations", "ENTRY_ROUNDING = 1e-12", "ENTRY_ROUNDING = 0.0")
@pytest.mark.slow
def test_difference_equations_leave_out_inputs_of_rounding_errors():
    found = difference_equations(load("slip-cured", integrated=False).loop)
    assert found["H"] == [pytest.approx(-17300.0)]
    assert found["inputs"] == ["target", "slip", "feedforward"]  # the speed has a coefficient of 7e-18


@needs_cc
@pytest.mark.slow
def test_the_command_writes_a_file_that_compiles(tmp_path):
    path = tmp_path / "controller.c"
    command("export", "slip-cured", "--float32", "-o", path)
    text = path.read_text()
    assert "typedef float controller_real;" in text
    assert str(tmp_path) not in text
    program = compiled(text, "controller", tmp_path)
    said = subprocess.run([program], input="0.0 13.9\n", capture_output=True, text=True, check=True).stdout
    assert float(said) == pytest.approx(2.6912710579228354, rel=1e-6)
    assert command("export", "slip-cured").stdout.startswith(
        "/* slip_cured: the controller, to be called every 0.001 s"
    )


@killed_by("output.export.device", "{period / MAX_STEPS_PER_SAMPLE:g} s", "{step:g} s")
@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["slip-lmi"], "controller StateFeedback runs in continuous time"),
        (["slip-lmi"], "say --period SECONDS"),
        (["slip-estimator", "--period", "1e-3"], "say --given target"),
        (["slip-estimator", "--set", 'controller={type="sampled"}'], "controller.controller is missing"),
        (["slip-lmi", "--period", "0"], "controller.period = 0 is outside (0, inf) s"),
        (["slip-estimator", "--period", "0.1"], "controller.cutoff = 55 rad/s is outside (0, 20) rad/s"),
        (["slip-cured", "--period", "1e-3"], "--period: the controller is sampled; it has a period of its own"),
        (["slip-lmi", "--to", "st"], "controller StateFeedback runs in continuous time"),
        (["slip-lmi", "--to", "fmu", "--float32"], "are for --to c and --to st"),
        (["slip-cured", "--to", "table"], "table"),
        (["slip-cured", "--to", "fortran"], "fortran"),
        (
            ["lab-rig-measured", "--set", 'reference={type="filtered-slip"}'],
            "80 steps of the solver, more than 64: choose a solver.step of at least 0.00015625 s",
        ),
    ],
)
def test_the_command_refuses_in_one_line(arguments, words, tmp_path):
    path = tmp_path / "x.c"
    result = command("export", *arguments, "-o", path, status=2)
    assert words in result.stderr
    assert_one_error_line(result)
    assert not list(tmp_path.iterdir())


@needs_cc
def test_the_controller_of_the_scenario_is_exported(tmp_path):
    """A period wraps the controller that is there, with the user's gains: against the PID's difference equations."""
    path, gains = tmp_path / "pid.c", {"kp": 20003.0, "ki": 5000.0, "kd": 5.67, "cutoff": 55.0}
    tuned = ["--set", f"controller.kp={gains['kp']}"]
    command("export", "slip-estimator", *tuned, "--period", "1e-3", "--given", "target", "-o", path)
    text = path.read_text()
    head = text[: text.index("*/")]
    for name, value in gains.items():
        assert re.search(rf"\bcontroller\.controller\.{name} = {value:g}\b", head)
    limits = load("slip-estimator", integrated=False).loop.controller
    low, high = float(limits.low), float(limits.high)
    slips = 0.2 - 0.003 * np.cos(np.arange(40.0))
    lines = "".join(f"{slip!r} 0.2\n" for slip in slips.tolist())
    program = compiled(text, "pid", tmp_path)
    said = subprocess.run([program], input=lines, capture_output=True, text=True, check=True).stdout
    integral, filtered, wanted = 0.0, 0.0, []
    for slip in slips:
        error = 0.2 - slip
        rate = gains["cutoff"] * (error - filtered)
        raw = gains["kp"] * error + gains["ki"] * integral + gains["kd"] * rate
        wanted.append(min(max(raw, low), high))
        integral, filtered = integral + 1e-3 * error, filtered + 1e-3 * rate
    np.testing.assert_allclose([*map(float, said.split())], wanted, rtol=1e-12)
    assert low < np.median(wanted) < high


def test_a_computer_without_events_is_exported_as_one_with():
    inner = PID(kp=60.0, ki=400.0, low=0.0, high=90.0)
    texts = [
        c_source(computer_program(dataclasses.replace(rig(inner), controller=one)), "unit")
        for one in (Sampled(controller=inner, period=2e-3), SampledOnGrid(controller=inner, sampling_period=2e-3))
    ]
    assert texts[0] == texts[1]


def test_inputs_are_what_the_plant_shows():
    found = computer_program(LOOPS["observer"])
    assert isinstance(found.input, Input)
    assert found.units["theta"] == "rad"
    assert found.period == pytest.approx(0.01)
    assert math.isclose(found.delay, 0.0)
    assert isinstance(LOOPS["observer"].plant, ArmBalance)


@killed_by("output.export.lowered", "flat(full) if flat(full) not in nodes else full", "flat(full)")
@needs_cc
def test_two_memories_of_one_controller_have_two_names(tmp_path):
    """The torque and the phase of the four-phase logic, against the automaton of its module's head in Python."""
    low, high, below, above, step = 3.0, 9.0, 0.08, 0.35, 0.9  # N m in each sample
    logic = FourPhase(torque_low=low, torque_high=high, slip_low=below, slip_high=above, rate=1e3 * step)
    slips = 0.2 + 0.19 * np.sin(0.2 * np.arange(200.0))
    torque, phase, wanted, phases = 0.0, 0, [], set()
    for slip in slips:
        if phase == 0 and torque > high:
            torque, phase = high, 2 if slip >= above else 1
        if phase == 1 and slip > above:
            phase = 2
        if phase == 2 and torque < low:
            torque, phase = low, 0 if slip <= below else 3
        if phase == 3 and slip < below:
            phase = 0
        wanted.append(min(max(torque, 0.0), high))
        torque += {0: step, 2: -step}.get(phase, 0.0)
        phases.add(phase)
    assert phases == {0, 1, 2, 3}
    found = computer_program(rig(logic))
    program = compiled(c_source(found, "unit"), "unit", tmp_path)
    lines = "".join(f"{slip!r}\n" for slip in slips.tolist())
    said = subprocess.run([program], input=lines, capture_output=True, text=True, check=True).stdout
    np.testing.assert_allclose([*map(float, said.split())], wanted, rtol=1e-12)
    block = Block(structured_text(found, "Unit"))
    np.testing.assert_allclose([block(slip=slip) for slip in slips], wanted, rtol=1e-12)


@killed_by("output.export.device", "lines := list(find_problems(part, prefix))", "lines := []", case="delay")
@pytest.mark.parametrize(
    ("controller", "said"),
    [
        pytest.param(PID(kp=np.array([1.0, 2.0])), r"controller.kp.* has shape \(2,\)", id="shape"),
        pytest.param(Sampled(controller=PID(kp=np.nan), period=1e-3), r"controller.kp = nan is outside", id="nan"),
        pytest.param(Sampled(controller=PID(), period=1e-3, delay=1.0), "controller.delay = 1 s exceeds", id="delay"),
    ],
)
def test_numbers_that_make_no_code_are_refused(controller, said):
    for export in (computer_program, difference_equations):
        with pytest.raises(NotExported, match=said):
            export(braking(controller=controller))


@killed_by("output.export.plant_c", 'check_numbers(loop.plant, "plant.")', "check_numbers(loop)")
@killed_by("output.export.plant_c", 'check_numbers(loop.initial, "initial.")', "pass")
def test_only_what_an_fmu_contains_can_be_refused():
    loop = braking(plant=MirroredRig(), controller=PID(kp=np.nan))
    assert plant_source(loop).states == 3
    for name in ("plant.mass", "initial.speed"):
        with pytest.raises(NotExported, match=f"{name} = -1 is outside"):
            plant_source(d.replace(loop, {name: -1.0}))


@killed_by("output.export.device", "0 < step < np.inf", "0 <= step <= np.inf", case="options1")
@killed_by("output.export.device", "not in (np.float32, np.float64)", "== np.int32", case="options4")
@pytest.mark.parametrize(
    "options", [{"step": -1e-4}, {"step": 0.0}, {"step": np.inf}, {"dtype": np.int32}, {"dtype": np.float16}]
)
def test_an_option_out_of_range_is_named(options):
    with pytest.raises(ValueError, match=f"{next(iter(options))} = .*(positive and finite|float32 or float64)"):
        computer_program(LOOPS["state feedback"], **options)


@killed_by("output.export.lowered", "if name in nodes:", "if False:")
def test_numbers_that_would_have_one_name_are_refused():
    """A part of the controller that is called as the loop's reference is."""

    @d.core.pytree.pytree
    class Copy:
        start, flow = d.core.protocols.no_memory, d.core.protocols.no_flow
        reference: FixedSlip = d.core.pytree.part(default=FixedSlip)

        def output(self, t, memory, signal):
            return self.reference.slip - signal.measured.slip

    with pytest.raises(NotExported, match=r"two numbers are called reference\.slip"):
        c_source(computer_program(rig(Copy())), "unit")


@killed_by("output.export.device", "unit_at(self.spec.unit, k, self.value.size)", "unit_at(self.spec.unit, 0, 1)")
def test_each_number_of_a_list_has_its_own_unit():
    """The six gains of a two-wheeler are of three angles and of their rates; declared are only two units."""
    found = computer_program(LOOPS["observer"])
    wanted = ["V/rad"] * 3 + ["V s/rad"] * 3
    c, st = c_source(found, "unit"), structured_text(found, "Unit")
    assert re.findall(r"^  unit_real gain_\d; /\* \[(.*?)\] in", c, re.MULTILINE) == wanted
    assert re.findall(r"^  gain_\d : LREAL := .*?; \(\* \[(.*?)\] in", st, re.MULTILINE) == wanted


@killed_by(
    "output.export.c99",
    'yield from self.words.operations(nodes, "  ")\n        if moving:\n            yield from self._moves(moving)\n',
    'if moving:\n            yield from self._moves(moving)\n        yield from self.words.operations(nodes, "  ")\n',
)
@needs_cc
def test_a_target_that_moves_is_returned_as_it_was(tmp_path):
    """A controller that commands the target itself: what is returned is memory that moves in the same call."""

    @d.core.pytree.pytree
    class Follow:
        start, flow = d.core.protocols.no_memory, d.core.protocols.no_flow

        def output(self, t, memory, signal):
            return signal.target

    loop = rig(Follow(), reference=FilteredSlip(slip=0.2, time_constant=0.01))
    program = compiled(c_source(computer_program(loop), "unit"), "unit", tmp_path)
    said = subprocess.run([program], input="0.1\n0.1\n0.1\n", capture_output=True, text=True, check=True).stdout
    np.testing.assert_allclose([*map(float, said.split())], 0.2 - 0.1 * np.exp(-np.arange(3) / 10), rtol=1e-6)


@killed_by("output.export.lowered", "if not more:\n                break", "if names:\n                break")
@needs_cc
def test_memory_behind_memory_is_kept(tmp_path):
    """The command is the double integral of the error: it needs the first integral only a sample later."""

    @d.core.pytree.pytree
    class Twice:
        def start(self, signal):
            return d.core.protocols.Memory(flow=(0.0 * signal.target, 0.0 * signal.target))

        def flow(self, t, memory, signal):
            return memory.flow[1], signal.target - signal.measured.slip

        def output(self, t, memory, signal):
            return memory.flow[0]

    text = c_source(computer_program(rig(Twice())), "unit")
    said = subprocess.run(
        [compiled(text, "unit", tmp_path)], input="0.1\n" * 4, capture_output=True, text=True, check=True
    ).stdout
    np.testing.assert_allclose([*map(float, said.split())], np.array([0.0, 0.0, 1.0, 3.0]) * 1e-6 * 0.1, rtol=1e-12)


# Structured Text


def commands_of_text(text, seen):
    """What the block commands, by a reader of the language of its own."""
    block = Block(text)
    names = [name for name in seen._fields if name.upper() in block.inputs]
    columns = [np.asarray(getattr(seen, name)) for name in names]
    return np.array([block(**dict(zip(names, row, strict=True))) for row in zip(*columns, strict=True)], float)


WITH_MUTANTS = {"conditional integration", "PID, filtered derivative", "filtered target", "two channels"}


@killed_by(
    "output.export.structured_text",
    "return f\"SEL({', '.join(args)})\"",
    'return f"SEL({args[0]}, {args[2]}, {args[1]})"',
    case="conditional integration-float64",
)
@killed_by(
    "compiler.operations",
    '"SEL({0} < {1}, {1}, {0})"',
    '"SEL({0} > {1}, {1}, {0})"',
    case="PID, filtered derivative-float64",
)
@killed_by(
    "output.export.structured_text", "self.device.moves - 1", "self.device.moves", case="filtered target-float64"
)
@pytest.mark.parametrize("dtype", cases(DTYPES, np.float32))
@pytest.mark.parametrize("name", cases(LOOPS, *{*LOOPS} - WITH_MUTANTS))
def test_structured_text_commands_what_the_parts_do(name, dtype):
    """Over 10,000 samples to rounding: an integral gathers some, in single precision as much as C does."""
    loop, seen = LOOPS[name], measured(LOOPS[name], seed=11)
    step = 4 if name in MOVING else None
    found = computer_program(loop, step=1e-3 / 4 if step else None, dtype=dtype)
    result = commands_of_text(structured_text(found, "Unit"), seen)
    wanted = commands_of_parts(loop, seen, dtype, step)
    assert np.all(np.ptp(wanted, axis=0) > 0)
    tolerance = 1e-11 if dtype == np.float64 else 3e-3
    np.testing.assert_allclose(result, wanted, rtol=tolerance, atol=tolerance * np.max(np.abs(wanted)))
    early = slice(0, 50)
    tight = 1e-13 if dtype == np.float64 else 2e-5
    np.testing.assert_allclose(result[early], wanted[early], rtol=tight, atol=tight * np.max(np.abs(wanted)))


@killed_by("output.export.structured_text", '.replace("e", "E")', "")
@pytest.mark.slow
def test_a_whole_run_is_what_the_function_block_does():
    chosen = load("slip-cured", ["initial.speed_kmh=40"])
    every = round(float(chosen.loop.controller.period) / chosen.solver.step)
    run = d.rollout(chosen.loop, d.FixedStep(chosen.solver.step, 0.4, every=every), chosen.objectives)
    count = int(run.trajectory.running.sum())
    seen = jax.tree.map(lambda x: np.asarray(x)[:count], run.trajectory.sample.output)
    text = structured_text(computer_program(chosen.loop, step=chosen.solver.step), "Cured")
    assert count > 300
    result = commands_of_text(text, seen)
    np.testing.assert_allclose(result, np.asarray(run.trajectory.sample.command)[:count], rtol=1e-12, atol=1e-12)


@killed_by("output.export.structured_text", "IF reset OR NOT started", "IF NOT started")
def test_a_block_begins_anew_when_it_is_told_to():
    block = Block(structured_text(computer_program(LOOPS["PID, filtered derivative"]), "Unit"))
    first = [block(slip=slip) for slip in (0.1, 0.15, 0.3)]
    assert [block(slip=slip, reset=k == 0) for k, slip in enumerate((0.1, 0.15, 0.3))] == first
    assert [block(slip=slip, reset=False) for slip in (0.1, 0.15, 0.3)] != first


@killed_by(
    "output.export.structured_text",
    "yield from self._operations(live_nodes([*stored.values(), *more]), indent)",
    "yield from (*self._moves(indent), *self._operations(live_nodes([*stored.values(), *more]), indent))",
)
def test_a_stored_sample_ignores_a_moving_target():
    """A controller that remembers the very number that the target's own movement computes anew."""

    @d.core.pytree.pytree
    class Remember:
        flow = d.core.protocols.no_flow

        def start(self, signal):
            return d.core.protocols.Memory(held=(0.0 * signal.target, 0.0 * signal.target))

        def tick(self, clock, memory, signal):
            return memory._replace(held=(0.2 - signal.target, memory.held[0]))

        def output(self, t, memory, signal):
            return memory.held[1] + 0.0 * signal.measured.slip

    loop = rig(Remember(), reference=FilteredSlip(slip=0.2, time_constant=0.01))
    seen = jax.tree.map(lambda x: x[:50], measured(loop, seed=2, lost=False))
    wanted = (0.2 - seen.slip[0]) * np.exp(-np.arange(-1, 49) / 10)
    wanted[0] = 0.0
    block = Block(structured_text(computer_program(loop, step=1e-3 / 4), "Unit"))
    result = [block(slip=slip) for slip in seen.slip]
    np.testing.assert_allclose(result, wanted, rtol=1e-4)


@d.core.pytree.pytree
class Kinds:
    """A controller with what the usual ones do not have: whole numbers, hyperbolic functions, a table, roundings."""

    start, flow = d.core.protocols.no_memory, d.core.protocols.no_flow

    def output(self, t, memory, signal):
        slip, speed = signal.measured.slip, signal.measured.speed
        place = jnp.clip(speed.astype(int), 0, 3)
        entry = jnp.array([0.1, 0.4, 0.2, 0.9])[place]
        odd = (place % 2 == 1) ^ (slip > 0.2)
        shaped = jnp.tanh(slip) + jnp.sinh(slip) * jnp.cosh(slip) + jnp.ceil(10 * slip) - jnp.round(8 * slip)
        shaped += jnp.floor(7 * slip)
        return jnp.where(odd, entry, -entry) + jnp.minimum(shaped, speed) + jnp.arctan2(slip, speed) + slip**1.5


@killed_by("output.export.structured_text", "_TRUNC_{after}", "_TO_{after}")
@killed_by("compiler.operations", "{_ST_RINT} - 1.0", "{_ST_RINT} + 1.0")
def test_structured_text_knows_every_kind_of_operation():
    loop = rig(Kinds())
    seen = measured(loop, seed=3)
    result = commands_of_text(structured_text(computer_program(loop), "Unit"), seen)
    wanted = commands_of_parts(loop, seen, np.float64)
    np.testing.assert_allclose(result, wanted, rtol=1e-12, atol=1e-13)


@killed_by("compiler.operations", 'range(11, 0, -2), "13.0"', 'range(9, 0, -2), "11.0"', case="tanh-float64")
@killed_by("compiler.operations", "range(12, 0, -2)", "range(10, 0, -2)", case="sinh-float64")
@killed_by("compiler.operations", "< 80.0", "< 800.0", case="cosh-float64")
@pytest.mark.parametrize("dtype", [np.float64, np.float32])
@pytest.mark.parametrize("name", ["tanh", "sinh", "cosh"])
def test_hyperbolic_functions_are_right_near_zero_and_up_to_their_overflow(name, dtype):
    """To four roundings, where the exponentials nearly cancel or overflow and where they do not; against NumPy."""

    @d.core.pytree.pytree
    class Shape:
        start, flow = d.core.protocols.no_memory, d.core.protocols.no_flow

        def output(self, t, memory, signal):
            return getattr(jnp, name)(signal.measured.slip)

    block = Block(structured_text(computer_program(rig(Shape()), dtype=dtype), "Unit"))
    largest = {np.float64: [700.0, 709.9, 710.4], np.float32: [88.0, 88.9, 89.3]}[dtype]
    size = np.concatenate([np.geomspace(1e-12, 20.0, 200), [0.49999, 0.5, 79.9, 80.1], largest])
    slips = np.concatenate([-size, [0.0], size]).astype(dtype)
    wanted = getattr(np, name)(slips.astype(np.float64))
    np.testing.assert_allclose([float(block(slip=x)) for x in slips], wanted, rtol=4 * np.finfo(dtype).eps)


@killed_by("compiler.emit.c99_words", 'used_names |= {new, f"{new}_table"}', "used_names.add(new)", case="table first")
@killed_by("compiler.emit.c99_words", 'used_names & {new, f"{new}_table"}', "new in used_names", case="table last")
@killed_by(
    "output.export.structured_text", "used_names & (both", "fresh.lower() in used_names or not (both", case="table last"
)
@pytest.mark.parametrize("order", ["table first", "table last"])
@needs_cc
def test_no_variable_has_the_name_of_a_table(order, tmp_path):
    """The constants of a choice, the sixth number of its line, are an array entry_6_table."""

    @d.core.pytree.pytree
    class Choose:
        start, flow = d.core.protocols.no_memory, d.core.protocols.no_flow

        def output(self, t, memory, signal):
            place = jnp.clip(signal.measured.speed.astype(int), 0, 3)
            if order == "table first":
                entry = jnp.array([0.1, 0.4, 0.2, 0.9])[place]
                entry_6_table = entry * signal.measured.slip
                return entry_6_table + entry
            entry_6_table = jnp.exp(signal.measured.slip)
            entry = jnp.array([0.1, 0.4, 0.2, 0.9])[place]
            return entry_6_table * entry

    found = computer_program(rig(Choose()))
    wanted = 0.2 * 1.5 if order == "table first" else 0.2 * math.exp(0.5)
    assert Block(structured_text(found, "Unit"))(slip=0.5, speed=2.3) == pytest.approx(wanted, rel=1e-14)
    text = c_source(found, "unit")
    assert "entry_6_table" in text
    program = compiled(text, "unit", tmp_path)
    first = text.index(" slip;") < text.index(" speed;")
    line = "0.5 2.3\n" if first else "2.3 0.5\n"
    said = subprocess.run([program], input=line, capture_output=True, text=True, check=True).stdout
    assert float(said) == pytest.approx(wanted, rel=1e-14)


@killed_by("output.export.structured_text", "or _is_reserved(name) or name.lower() in OWN:", "or False:", case="step")
@pytest.mark.parametrize("name", ["2fast", "a b", "a__b", "Function_Block", "step", "Held"])
def test_a_name_that_structured_text_does_not_have_is_refused(name):
    with pytest.raises(NotExported, match="no name that Structured Text has"):
        structured_text(computer_program(LOOPS["state feedback"]), name)


@killed_by("output.export.structured_text", "OWN - {*device.commands} | {name.lower()}", "OWN - {*device.commands}")
def test_no_variable_of_a_block_has_its_name():
    """Identifiers of this language ignore case, and a block's name is one of them."""
    loop, wanted, _ = limited()
    text = structured_text(computer_program(loop), "Kp")
    assert "FUNCTION_BLOCK Kp\n" in text
    assert "kp" not in {name.strip().lower() for name in re.findall(r"^  (\w+) :", text, re.MULTILINE)}
    assert Block(text)(slip=0.1) == pytest.approx(wanted[0], rel=1e-12)


def test_what_structured_text_cannot_say_is_named():
    @d.core.pytree.pytree
    class Expm1:
        start, flow = d.core.protocols.no_memory, d.core.protocols.no_flow

        def output(self, t, memory, signal):
            return jnp.expm1(signal.measured.slip)

    with pytest.raises(NotExported, match="expm1 has no translation to Structured Text"):
        structured_text(computer_program(rig(Expm1())), "unit")


def test_the_command_writes_a_function_block(tmp_path):
    path = tmp_path / "brake--law.st"
    result = command("export", "slip-cured", "--to", "st", "-o", path)
    text = path.read_text()
    assert "FUNCTION_BLOCK brake_law\n" in text
    assert "speed : LREAL; (* [m/s] *)" in text
    assert str(tmp_path) not in text
    assert Block(text)(slip=0.0, speed=13.9) == pytest.approx(2.6912710579228354, rel=1e-12)
    assert "call FUNCTION_BLOCK brake_law once a period" in result.stderr
    assert " : REAL;" in command("export", "slip-cured", "--to", "st", "--float32").stdout
