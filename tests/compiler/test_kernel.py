"""A kernel makes the runs that XLA makes, says why it cannot, and its library is there for several processes."""

import dataclasses
import json
import logging
import os
import pathlib
import subprocess
import sys
import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from commands import run
from kernels import FOLDER, applied, both, same
from mutants import killed_by
from seams import replace_seam

import diffabs as d
from diffabs import controllers, plants, scenario, sensors
from diffabs.compiler.ir import Graph, UpdateLevel
from diffabs.compiler.lower.rules import Unsupported, constant_array, lower_jaxpr
from diffabs.compiler.pipeline import run_lanes
from diffabs.compiler.runtime import cpu, library_cache, toolchain
from diffabs.core.lanes import any_lane
from diffabs.engine.drive import kernel as native
from diffabs.engine.drive.engine import ENGINE_VARIABLE, log_kernel, log_xla_reason
from diffabs.loop import ensemble
from diffabs.parts.objectives import BRAKING
from diffabs.parts.stops import SpeedReached
from diffabs.scenario import section_sweep
from diffabs.scenario.defaults import braking
from diffabs.uncertainty.sweep import Local, SweepError, sweep
from diffabs.uncertainty.sweep.selection import REMOTE_REASON, choose_study_engine

pytestmark = pytest.mark.xdist_group("kernel")  # one worker compiles what these share

LOOP = braking(
    plant=plants.MirroredRig(),
    initial=d.BrakeStart(speed=30 / 3.6),
    controller=controllers.StateFeedback(gain=np.array([-4000.0, -40.0])),
    feedforward=controllers.HoldingInput(),
    stop=SpeedReached(speed=25 / 3.6),
    sensor=sensors.Noise(slip=0.01, period=4e-3),
)
MEASURED = {name: BRAKING[name] for name in ("stop_distance", "iae")}
SOLVER = d.FixedStep(2e-3, 0.5)
LANES = 41  # of blocks of 16: some lanes are put in where others have ended
SPEEDS = np.linspace(26.0, 33.0, LANES) / 3.6
AT_ONCE, NEVER, DIVERGING = 4, 7, 11
SPEEDS[AT_ONCE], SPEEDS[NEVER] = 24.0 / 3.6, 90.0 / 3.6
GAINS = np.where(np.arange(LANES) == DIVERGING, 1e308, -40.0)
VALUES = {"initial.speed": SPEEDS, "controller.gain.1": GAINS}
KEYS = np.arange(LANES)


OTHER_KEY = jax.random.key(1, impl="rbg")


@jax.custom_batching.custom_vmap
def _every(x):
    return x


@_every.def_vmap
def _(size, batched, x):
    return jnp.all(x), False


@pytest.fixture(autouse=True)
def _own_folder(monkeypatch):
    monkeypatch.setenv(library_cache.CACHE, FOLDER)
    replace_seam(monkeypatch, "vectors_per_block", 2)


def run_lanes_by(engine):
    lanes = d.Batch(VALUES, KEYS)
    return jax.device_get(d.run_batch(LOOP, lanes, SOLVER, MEASURED, together=False, accepted=True, engine=engine))


@pytest.fixture(scope="module")
def runs():
    """The runs by a kernel."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(library_cache.CACHE, FOLDER)
        replace_seam(patch, "vectors_per_block", 2)
        return run_lanes_by("kernel")


class TestRuns:
    @killed_by("compiler/native/drive.h", "lane[p] >= 0 && !get(on[q], p - q*LANES)", "lane[p] >= 0 && !get(on[q], 0)")
    @killed_by("compiler/native/drive.h", "if (fresh) begin(b, s, q);", "")
    @pytest.mark.slow
    def test_are_those_of_xla(self, runs):
        """Lanes that begin beyond their stop, diverge and run out of time among them; noise to the last digits."""
        expected = run_lanes_by("xla")
        assert np.flatnonzero(expected.diverged).tolist() == [AT_ONCE, DIVERGING]
        assert expected.timed_out[NEVER]
        assert len(np.unique(expected.metrics["iae"])) == LANES - 1  # NaN once
        same(runs, expected, rtol=1e-13, atol=1e-15)

    @killed_by("loop.ensemble", 'engine: str = "auto",', 'engine: str = "xla",')
    @killed_by("engine.drive.engine", "            log_kernel()\n", "")
    def test_are_made_by_default(self, runs, users_engine, caplog):
        log_kernel.cache_clear()
        with caplog.at_level(logging.INFO, "diffabs"):
            found = [d.run_batch(LOOP, d.Batch(VALUES, KEYS), SOLVER, MEASURED, accepted=True) for _ in range(2)]
        line = f"runs are made by a kernel ({toolchain.find_compiler().version})"
        assert [record.getMessage() for record in caplog.records] == [line]
        for name, value in runs.metrics.items():
            np.testing.assert_array_equal(found[0].metrics[name], value)

    @pytest.mark.slow
    def test_do_not_depend_on_their_order_nor_on_threads(self, runs, monkeypatch):
        replace_seam(monkeypatch, "thread_count", lambda: 3)
        native._run.clear_cache()
        order = np.random.default_rng(1).permutation(LANES)
        values = {path: column[order] for path, column in VALUES.items()}
        found, _ = (lambda run: (run, None))(self._by_kernel(values, KEYS[order]))
        for name, value in runs.metrics.items():
            np.testing.assert_array_equal(found.metrics[name], value[order])

    def test_of_new_numbers_are_the_same_program(self, runs, monkeypatch):
        replace_seam(monkeypatch, "build_library", None)
        loop = d.replace(LOOP, {"controller.gain.0": -3900.0, "plant.mass": 6.0})
        found = jax.device_get(self._by_kernel(VALUES, KEYS, loop))
        assert not np.any(found.metrics["iae"] == runs.metrics["iae"])

    @pytest.mark.slow
    def test_under_jit_and_vmap(self, runs):
        def at(mass):
            return self._by_kernel(VALUES, KEYS, d.replace(LOOP, {"plant.mass": mass}), live=True).metrics["iae"]

        mass = float(LOOP.plant.mass)
        found = jax.device_get(jax.jit(jax.vmap(at))(jnp.array([0.97 * mass, mass])))
        np.testing.assert_allclose(found[1], runs.metrics["iae"], rtol=1e-13)
        assert not np.any(found[0] == found[1])

    @pytest.mark.slow
    def test_of_lanes_in_two_parts(self, runs, monkeypatch):
        replace_seam(monkeypatch, "max_lanes_per_launch", 32)
        found = jax.device_get(self._by_kernel(VALUES, KEYS))
        for name, value in runs.metrics.items():
            np.testing.assert_array_equal(found.metrics[name], value)

    @staticmethod
    def _by_kernel(values, keys, loop=LOOP, live=False):
        lanes = d.Batch(values, keys)
        run = d.run_batch(loop, lanes, SOLVER, MEASURED, together=False, accepted=True, engine="kernel")
        return run if live else jax.device_get(run)


@pytest.mark.slow
def test_adaptive_steps_are_those_of_xla():
    """Steps end on kinks, which are looked for by what rounding says: the solver's own reproducibility."""
    loop = d.replace(LOOP, {"sensor": braking(plant=LOOP.plant).sensor})
    solver = d.Adaptive(rtol=1e-6, duration=0.5, step=2e-3)
    found, expected = both(loop, VALUES, solver, MEASURED)
    same(found, expected, rtol=1e-9, atol=1e-12)


class TestObjections:
    """Each is said by `objection`, refused with engine = "kernel", and said once with "auto"."""

    def test_there_is_none(self):
        assert ensemble.kernel_objection(LOOP, VALUES, SOLVER, MEASURED) is None

    @pytest.mark.slow
    @killed_by("compiler.runtime.toolchain", "if configured is not None and not configured.strip():", "if False:")
    @killed_by("engine.drive.engine", "    log_xla_reason(why_not)\n", "")
    @killed_by("engine.drive.engine", "    _refused[structure] = why_not\n", "")
    def test_without_a_compiler(self, users_engine, monkeypatch, caplog):
        monkeypatch.setenv(toolchain.COMPILER, "")
        log_xla_reason.cache_clear()
        native._run.clear_cache()
        loop = d.replace(LOOP, {"sensor": braking(plant=LOOP.plant).sensor})
        line = ensemble.kernel_objection(loop, VALUES, SOLVER, {})
        assert line == f"{toolchain.COMPILER} is empty"
        with pytest.raises(ValueError, match=f"engine = 'kernel' is not possible: {line}"):
            d.run_batch(loop, d.Batch(VALUES), SOLVER, {}, accepted=True, engine="kernel")
        with caplog.at_level(logging.WARNING, "diffabs"):
            runs = [d.run_batch(loop, d.Batch(VALUES), SOLVER, {}, accepted=True, engine="auto") for _ in range(2)]
        assert [record.getMessage() for record in caplog.records] == [f"runs are made by XLA, not by a kernel: {line}"]
        assert runs[0].stopped.tolist() == runs[1].stopped.tolist()
        replace_seam(monkeypatch, "find_compiler", None)  # not looked for again
        loop = d.replace(loop, {"plant.mass": 6.0})
        d.run_batch(loop, d.Batch(VALUES), SOLVER, {}, accepted=True)

    @killed_by("compiler.runtime.toolchain", "            _check_loads(command)\n", "", case="false")
    @pytest.mark.parametrize("command", ["false", "/no/such/compiler"])
    def test_of_a_compiler_that_does_not_work(self, command, monkeypatch, tmp_path):
        """In a cache of its own: a mutant that finds it working would leave that in the shared one."""
        monkeypatch.setenv(library_cache.CACHE, str(tmp_path))
        monkeypatch.setenv(toolchain.COMPILER, command)
        with pytest.raises(toolchain.NoCompiler, match=command):
            toolchain.find_compiler()

    @killed_by("engine.drive.engine", "if engine not in REQUESTABLE_ENGINES:", "if False:")
    def test_of_another_name(self):
        with pytest.raises(ValueError, match="engine = 'gpu' is unknown; there is auto, xla, kernel"):
            d.run_batch(LOOP, d.Batch(VALUES, KEYS), SOLVER, MEASURED, engine="gpu")

    @killed_by("loop.ensemble", 'why_not = TOGETHER_REASON if together else ""', 'why_not = ""')
    def test_of_lanes_that_run_together(self):
        with pytest.raises(ValueError, match="together, for trajectories or for derivatives"):
            d.run_batch(LOOP, d.Batch(VALUES, KEYS), SOLVER, MEASURED, engine="kernel", accepted=True, together=True)

    @killed_by("loop.ensemble", "if trajectories and (traced or", "if trajectories and (False or")
    def test_of_trajectories_with_derivatives(self):
        def slip(gain):
            loop = d.replace(LOOP, {"controller.gain.0": gain})
            return d.run_batch(loop, d.Batch(VALUES, KEYS), SOLVER, trajectories=True, engine="kernel").metrics

        with pytest.raises(ValueError, match="trajectories on a processor only, and of a call that is not traced"):
            jax.jit(slip)(-4000.0)

    @pytest.mark.slow
    def test_of_reverse_mode_where_runs_make_room_for_others(self):
        def iae(gain):
            loop = d.replace(LOOP, {"controller.gain.0": gain})
            run = d.run_batch(loop, d.Batch(VALUES, KEYS), SOLVER, MEASURED, engine="kernel", together=False)
            return jnp.nanmean(run.metrics["iae"])

        with pytest.raises(ValueError, match="a kernel has no reverse mode: forward mode"):
            jax.grad(iae)(-4000.0)

    @killed_by("compiler.lower.control_flow", "or not _is_any_rule(eqn)", "")
    @killed_by(
        "compiler.lower.rules",
        "if name not in LOWERING_RULES:",
        'if name not in LOWERING_RULES and name != "while":',
    )
    @killed_by("compiler.lower.control_flow", 'if p["length"] > MAX_UNROLLED_STEPS:', "if False:")
    @killed_by("compiler.lower.indexing", "if count > MAX_COMPARED_ENTRIES:", "if False:")
    @killed_by("compiler.lower.indexing", "if len(column) > MAX_COMPARED_ENTRIES and", "if False and")
    @killed_by("compiler.lower.random", 'if str(aval.dtype) != "key<fry>":', "if False:")
    @pytest.mark.parametrize(
        ("function", "line"),
        [
            (lambda x: jax.lax.while_loop(lambda y: y > 1.0, lambda y: 0.5 * y, x), "while: there is no rule for it"),
            (lambda x: jax.lax.scan(lambda y, _: (0.5 * y, None), x, length=65)[0], "scan: of 65 steps within a step"),
            (lambda x: jnp.zeros(65).at[x.astype(int)].set(x)[3], "scatter: into 65 entries; 64 are the most"),
            (lambda x: jnp.linalg.inv(x * jnp.eye(2))[0, 0], "lu: there is no rule for it"),
            (lambda x: x * jax.random.uniform(OTHER_KEY), "of the generator key<rbg>"),
            (lambda x: jnp.stack([x * i for i in range(65)])[(x > 1).astype(int)], "of 65 entries that differ"),
            (lambda x: _every(x > 0), "custom_vmap_call: its rule for batches is not `any`"),
        ],
    )
    def test_of_an_operation(self, function, line):
        with pytest.raises(Unsupported, match=line.replace("(", r"\(")):
            applied({"f": function}, np.ones(3))

    @killed_by("core.tracing", "if len(groups) != 3 or", "if False and")
    @pytest.mark.parametrize("structure", [None, (1, 1, 1), {}])
    def test_of_a_scan_whose_inputs_are_told_otherwise(self, structure):
        """As JAX 0.11 began to do: a still later one may do so again."""
        jaxpr = jax.make_jaxpr(lambda x: jax.lax.fori_loop(0, 3, lambda i, y: x * y, x))(1.0).jaxpr
        (eqn,) = (eqn for eqn in jaxpr.eqns if eqn.primitive.name == "scan")
        params = {name: x for name, x in eqn.params.items() if name not in ("num_consts", "num_carry")}
        new = jaxpr.replace(eqns=[eqn.replace(params=params | {"ft_in": structure})])
        with pytest.raises(Unsupported, match="scan: its parameter ft_in is not known"):
            lower_jaxpr(Graph(), new, [], [constant_array(Graph(), 1.0)])

    @killed_by("compiler.lower.rules", "sorted(set(eqn.params) - LOWERING_RULES[name].parameters)", "[]")
    def test_of_a_parameter_that_is_not_known(self):
        """A later JAX may say something with it."""
        jaxpr = jax.make_jaxpr(lambda x: jnp.exp(x))(1.0).jaxpr
        eqn = jaxpr.eqns[0]
        new = jaxpr.replace(eqns=[eqn.replace(params=eqn.params | {"colour": "red"})])
        with pytest.raises(Unsupported, match="exp: its parameter colour is not known"):
            lower_jaxpr(Graph(), new, [], [constant_array(Graph(), 1.0)])


class TestSweep:
    SETTINGS = ("sweep.samples=40", "sweep.chunk=16", "solver.step=2e-3", "solver.duration=0.4", "stop.speed_kmh=40.0")

    @killed_by("uncertainty.sweep.study", 'if self.engine == "kernel":', "if False:")
    @pytest.mark.slow
    def test_is_that_of_xla_and_says_what_made_it(self, tmp_path):
        """Another engine does not go on with it."""
        study = section_sweep.build_study(scenario.load("slip-lmi", self.SETTINGS))
        tables = {}
        for engine in ("xla", "kernel"):
            one = dataclasses.replace(study, engine=engine)
            tables[engine] = sweep(one, tmp_path / engine).table().to_pandas().sort_values("sample")
        for name in study.objectives:
            columns = [table[name].to_numpy() for table in tables.values()]
            np.testing.assert_allclose(*columns, rtol=1e-12, atol=1e-14, err_msg=name)
        written = json.loads((tmp_path / "kernel" / "manifest.json").read_text())["study"]["engine"]
        assert written == {"name": "kernel", **toolchain.describe_compiler()}
        assert "engine" not in json.loads((tmp_path / "xla" / "manifest.json").read_text())["study"]
        with pytest.raises(SweepError, match="engine"):
            sweep(dataclasses.replace(study, engine="xla"), tmp_path / "kernel", resume=True)

    @killed_by(
        "uncertainty.sweep.run", "choose_study_engine(study, out, resume=resume,", "choose_study_engine(study, out,"
    )
    @killed_by("uncertainty.sweep.selection", "if resume and (", "if False and (")
    @pytest.mark.slow
    def test_resumed_keeps_its_engine(self, users_engine, tmp_path, monkeypatch):
        """The manifest decides, also where the default engine would now be another one."""
        study = section_sweep.build_study(scenario.load("slip-lmi", self.SETTINGS))
        assert study.engine == "auto"
        xla = dataclasses.replace(study, engine="xla")
        for folder, first in (("one", study), ("other", xla)):
            part = sweep(first, tmp_path / folder, on=Local(jax.local_devices()), stopping=lambda: True)
            assert not part.complete
        monkeypatch.setenv(ENGINE_VARIABLE, "xla")
        assert sweep(study, tmp_path / "one", resume=True).complete
        monkeypatch.delenv(ENGINE_VARIABLE)
        assert sweep(study, tmp_path / "other", resume=True).complete
        engines = [
            json.loads((tmp_path / name / "manifest.json").read_text())["study"].get("engine")
            for name in ("one", "other")
        ]
        assert engines == [{"name": "kernel", **toolchain.describe_compiler()}, None]

    @killed_by(
        "uncertainty.sweep.selection", "if remote else describe_placement(())", "if False else describe_placement(())"
    )
    def test_of_other_machines_is_made_by_xla(self, users_engine, tmp_path):
        """Their compilers and processors are not known."""
        study = section_sweep.build_study(scenario.load("slip-lmi", self.SETTINGS))
        chosen, why = choose_study_engine(study, tmp_path, remote=True)
        assert (chosen.engine, why) == ("xla", REMOTE_REASON)

    @killed_by("uncertainty.sweep.selection", 'if study.engine == "kernel" and', "if False and")
    def test_is_refused_before_anything_is_written(self, tmp_path, monkeypatch):
        monkeypatch.setenv(toolchain.COMPILER, "")
        native._run.clear_cache()
        study = section_sweep.build_study(scenario.load("slip-lmi", self.SETTINGS))
        with pytest.raises(ValueError, match=f"engine = 'kernel' is not possible: {toolchain.COMPILER} is empty"):
            sweep(dataclasses.replace(study, engine="kernel"), tmp_path / "out")
        assert not (tmp_path / "out").exists()

    @killed_by("cli.sweep", "build_study(setup), engine=engine)", "build_study(setup))", case="kernel-")
    @killed_by("cli.engine", "    if why:\n", "    if False:\n", case="auto-note: runs are made by XLA:")
    @pytest.mark.slow
    @pytest.mark.parametrize(("engine", "line"), [("auto", "note: runs are made by XLA:"), ("kernel", "")])
    def test_by_the_command(self, engine, line, users_engine, tmp_path, monkeypatch):
        monkeypatch.setenv(toolchain.COMPILER, "")
        native._run.clear_cache()
        changes = [part for setting in self.SETTINGS for part in ("--set", setting)]
        status = 0 if line else 2
        done = run("sweep", "slip-lmi", *changes, "--out", tmp_path / "out", "--engine", engine, status=status)
        why_not = f"engine = 'kernel' is not possible: {toolchain.COMPILER} is empty"
        assert f"{line} {why_not}".lstrip() in done.stderr
        assert (tmp_path / "out").exists() == bool(line)


class TestGraph:
    @killed_by(
        "compiler.operations",
        '"{0} - {1}", "{0} - {1}", "{0} - {1}")',
        '"{0} - {1}", "{0} - {1}", "{0} - {1}", True)',
    )
    def test_equal_operations_are_one(self):
        graph = Graph()
        x, y = (graph.input(float, UpdateLevel.STEP, i) for i in range(2))
        assert graph.op("add", x, y) is graph.op("add", y, x)
        assert graph.op("gt", x, y) is graph.op("lt", y, x)
        assert graph.op("sub", x, y) is not graph.op("sub", y, x)

    def test_what_is_known_is_worked_out(self):
        graph = Graph()
        assert graph.op("add", graph.const(1.0), graph.const(2.0)).attr == 3.0
        assert graph.op("quotient", graph.const(-7), graph.const(2)).attr == -3
        x = graph.input(float, UpdateLevel.STEP, 0)
        assert graph.op("mul", x, graph.const(1.0)) is x
        assert graph.op("mul", x, graph.const(0.0)) is not graph.const(0.0)  # x may be infinite

    @killed_by("compiler.ir", "if _is_factor(inverse) else", "if True else")
    def test_a_divisor_of_before_the_step_is_inverted_there(self):
        graph = Graph()
        x, fixed, tiny = (
            graph.input(float, UpdateLevel.STEP, 0),
            graph.input(float, UpdateLevel.UNIFORM, 1),
            graph.const(1e-310),
        )
        product = graph.op("div", x, fixed)
        assert (product.op, min(arg.level for arg in product.args)) == ("mul", UpdateLevel.UNIFORM)
        assert graph.op("div", x, tiny).op == "div"  # its inverse is infinite
        assert graph.op("div", x, x).op == "div"

    @killed_by("compiler.ir", 'a.level < UpdateLevel.STEP and b.op == "mul"', 'False and b.op == "mul"')
    @killed_by("compiler.ir", " and _is_factor(product := graph", " and (product := graph")
    def test_two_factors_of_before_the_step_are_one(self):
        graph = Graph()
        x, fixed = graph.input(float, UpdateLevel.STEP, 0), graph.input(float, UpdateLevel.UNIFORM, 1)
        product = graph.op("mul", graph.const(0.5), graph.op("mul", x, fixed))
        assert x in product.args
        assert min(arg.level for arg in product.args) == UpdateLevel.UNIFORM
        assert graph.op("mul", x, graph.op("mul", x, fixed)).args != product.args
        large = graph.const(1e200)
        inner = graph.op("mul", large, x)
        assert set(graph.op("mul", large, inner).args) == {large, inner}  # it is finite for a small x


class TestCarry:
    STEPS = 40

    def runs(self, step, carry, levels, **more):
        """What a kernel makes of the carry, and JAX itself."""

        def native(levels, carry):
            return run_lanes(
                lambda _, c: c, step, lambda _, c: c[0] < self.STEPS, levels, carry, steps=8, rounds=1, **more
            )

        def known(level, carry):
            return jax.lax.scan(lambda c, _: (step(level, c), None), carry, length=self.STEPS)[0]

        return jax.device_get((jax.jit(native)(levels, carry), jax.jit(jax.vmap(known))(levels, carry)))

    @pytest.mark.slow
    @killed_by("compiler.program", "pending += [nodes[i] for nodes in updates]", "pass")
    @killed_by("compiler.program", "i in read else carried[i]", "True else carried[i]")
    def test_what_nothing_reads_stays_as_it_was(self):
        """The last number of these leads to none that is read; those before it lead to the fourth, one by one."""

        def step(level, carry):
            i, x, y, z, unread = carry
            return i + 1, x + level, y + jnp.sin(x), z + y, unread + z

        ones = jnp.ones(5)
        carry = (jnp.zeros(5, int), ones, ones, ones, 7.0 * ones)
        found, expected = self.runs(step, carry, jnp.arange(5.0), read=(False, False, False, True, False))
        np.testing.assert_allclose(found[3], expected[3], rtol=1e-13)
        np.testing.assert_array_equal(found[4], carry[4])

    @pytest.mark.slow
    @killed_by("compiler.emit.cpp", "gate.args[1] is number and ", "")
    @killed_by("compiler.emit.cpp", "if r.id not in self.rare.stored:", "if True:")
    def test_of_a_rare_branch_is_right_with_and_without_it(self):
        """Numbers that only the branch changes: `seen` is read by every step, too, `kept` by the branch alone. The
        last one becomes another number without the branch."""

        def step(level, carry):
            i, x, seen, kept, total, _ = carry
            far = jnp.sin(x) > level

            def look():
                y = kept
                for _ in range(12):
                    y = y + 0.1 * jnp.tanh(y + x)
                return tuple(jnp.where(far, a, b) for a, b in ((seen + y, seen), (y, kept), (total, seen)))

            new, more, end = jax.lax.cond(any_lane(far), look, lambda: (seen, kept, seen))
            return i + 1, x + 0.3, new, more, total + seen, end

        zero, levels = jnp.zeros(70), jnp.linspace(0.5, 1.2, 70)
        carry = (jnp.zeros(70, int), levels, zero, zero, zero, zero)
        found, expected = self.runs(step, carry, levels)
        for a, b in zip(found, expected, strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-12)
        assert (found[2] != 0).any()
        assert (found[2] == 0).any()


class TestLibrary:
    TEXT = "\n".join(  # the least that is one
        [
            '#include "functions.h"',
            'extern "C" double answer(double x) { return k_exp(all(x))[0] + %d; }',
        ]
    )

    def test_is_made_once(self, tmp_path, monkeypatch):
        toolchain.find_compiler()  # has been tried, which is noted
        monkeypatch.setenv(library_cache.CACHE, str(tmp_path))
        path = toolchain.build_library(self.TEXT % 1)
        replace_seam(monkeypatch, "compile", None)
        assert toolchain.build_library(self.TEXT % 1) == path
        assert [file.name for file in tmp_path.iterdir()] == [path.name]

    @pytest.mark.parametrize("how", ["empty", "cut off", "one bit", "another library"])
    def test_that_is_damaged_is_compiled_again(self, how, tmp_path, monkeypatch, caplog):
        """Also one whose file is a library, but another one: no damaged file is ever loaded."""
        toolchain.find_compiler()
        monkeypatch.setenv(library_cache.CACHE, str(tmp_path))
        replace_seam(monkeypatch, "compile", lambda words, source, result, s: result.write_bytes(source.read_bytes()))
        path, other = toolchain.build_library("one library"), toolchain.build_library("another")
        whole = path.read_bytes()
        damaged = {
            "empty": b"",
            "cut off": whole[:-1],
            "one bit": b"p" + whole[1:],
            "another library": other.read_bytes(),
        }
        path.write_bytes(damaged[how])
        assert toolchain.build_library("one library").read_bytes() == whole
        assert [record.message for record in caplog.records] == [f"{path} is damaged; it is compiled again"]
        assert sorted(tmp_path.iterdir()) == sorted([path, other])

    @pytest.mark.skipif(not hasattr(os, "getuid"), reason="Windows has no such modes")
    def test_in_a_folder_that_others_may_write_to_is_refused(self, tmp_path, monkeypatch):
        toolchain.find_compiler()
        tmp_path.chmod(0o770)
        monkeypatch.setenv(library_cache.CACHE, str(tmp_path))
        with pytest.raises(
            toolchain.NoCompiler, match=r"other users may write to it: `chmod go-w` it, or name another"
        ):
            toolchain.build_library(self.TEXT % 1)
        assert list(tmp_path.iterdir()) == []

    @pytest.mark.skipif(sys.platform == "win32", reason="the compiler of this test is a shell script")
    def test_by_a_compiler_that_hangs_says_so(self, tmp_path, monkeypatch):
        """A compiler's own children hold its output: they are ended with it."""
        path = tmp_path / "hangs"
        path.write_text("#!/bin/sh\nsleep 60 &\nwait\n")
        path.chmod(0o755)
        monkeypatch.setenv(toolchain.COMPILER, str(path))
        replace_seam(monkeypatch, "probe_timeout_s", 0.2)
        begun = time.monotonic()
        with pytest.raises(toolchain.NoCompiler, match=rf"{path} did not end within 0\.2 s and was stopped"):
            toolchain.find_compiler()
        assert time.monotonic() - begun < 20

    def test_that_was_not_used_for_longest_goes(self, tmp_path, monkeypatch):
        toolchain.find_compiler()
        monkeypatch.setenv(library_cache.CACHE, str(tmp_path))
        replace_seam(monkeypatch, "compile", lambda words, source, result, s: result.write_bytes(bytes(10)))
        first, second, third = (toolchain.build_library(text) for text in ("first", "second", "third"))
        for i, path in enumerate((first, second, third)):
            os.utime(path, (i, i))
        toolchain.build_library("first")  # is used again
        replace_seam(monkeypatch, "max_cache_bytes", 30)
        fourth = toolchain.build_library("fourth")
        assert set(tmp_path.glob("*.so")) == {first, second, third, fourth}
        replace_seam(monkeypatch, "max_cache_bytes", 39)
        fifth = toolchain.build_library("fifth")
        assert set(tmp_path.glob("*.so")) == {first, fourth, fifth}

    @killed_by("compiler.runtime.toolchain", "repr((compiler, CPP_FLAGS, _processor()))", "repr(compiler)")
    @pytest.mark.parametrize("changed", ["CPP_FLAGS", "_processor"])
    def test_is_another_for_other_flags_and_processors(self, changed, tmp_path, monkeypatch):
        toolchain.find_compiler()
        monkeypatch.setenv(library_cache.CACHE, str(tmp_path))
        replace_seam(monkeypatch, "compile", lambda words, source, result, s: result.write_bytes(b""))
        path, made = toolchain.build_library("one"), toolchain.find_compiler()
        replace_seam(monkeypatch, "find_compiler", lambda: made)
        monkeypatch.setattr(toolchain, changed, ("-O1",) if changed == "CPP_FLAGS" else lambda: "another")
        assert toolchain.build_library("one") != path

    @killed_by(
        "compiler.runtime.toolchain",
        '    except OSError as error:\n        raise NoCompiler(f"no kernel',
        '    except subprocess.TimeoutExpired as error:\n        raise NoCompiler(f"no kernel',
    )
    def test_in_a_folder_that_cannot_be_made(self, tmp_path, monkeypatch):
        (tmp_path / "file").write_text("")
        monkeypatch.setenv(library_cache.CACHE, str(tmp_path / "file" / "kernel"))
        with pytest.raises(toolchain.NoCompiler, match=r"no kernel in .*file.kernel: Not a directory"):
            toolchain.build_library(self.TEXT % 3)

    @killed_by("compiler.runtime.cpu", "except (OSError, AttributeError) as error:", "except AttributeError as error:")
    def test_that_is_none_cannot_be_loaded(self, tmp_path, monkeypatch):
        (tmp_path / "none.so").write_text("nothing")
        with pytest.raises(toolchain.NoCompiler, match=r"invalid ELF header|file too short|not a mach-o"):
            cpu.register_library(tmp_path / "none.so")

    @pytest.mark.slow
    def test_of_two_processes_at_once_and_of_one_that_is_killed(self, tmp_path):
        """Whoever comes first, or is ended in the middle: what has a name is whole."""
        code = "import ctypes; from diffabs.compiler.runtime import toolchain; "
        code += f"p = toolchain.build_library({self.TEXT % 2!r})\n"
        code += (
            "f = ctypes.CDLL(str(p)).answer; f.restype, f.argtypes = ctypes.c_double, [ctypes.c_double]; print(f(0.0))"
        )
        environment = os.environ | {library_cache.CACHE: str(tmp_path)}
        begun = [
            subprocess.Popen([sys.executable, "-c", code], env=environment, stdout=subprocess.PIPE, text=True)
            for _ in range(3)
        ]
        while not any(tmp_path.iterdir()):
            time.sleep(0.01)
        begun[0].kill()
        outputs = [process.communicate()[0] for process in begun]
        assert outputs[1:] == ["3.0\n", "3.0\n"]
        whole = [file for file in tmp_path.iterdir() if not file.name.startswith(".")]
        assert len(whole) == 1

    def test_no_flag_changes_what_is_finite(self):
        assert not any("fast-math" in flag or "finite" in flag or "unsafe" in flag for flag in toolchain.CPP_FLAGS)
        assert pathlib.Path(toolchain.NATIVE_FOLDER / "lanes.h").is_file()
