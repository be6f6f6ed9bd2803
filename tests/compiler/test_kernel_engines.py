"""Wherever batches run, a kernel makes the runs that XLA makes, and says what stands against it."""

import dataclasses
import inspect
import json
import logging
import os
import subprocess
import sys
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from commands import run
from decaying import decay_loop
from kernels import FOLDER
from mutants import killed_by
from seams import replace_seam

import diffabs as d
from diffabs import actuators, controllers, plants, roads, scenario, stops, sweep, tune
from diffabs.compiler import pipeline
from diffabs.compiler.runtime import library_cache, toolchain
from diffabs.core.protocols import Memory, no_flow
from diffabs.core.pytree import get, param, pytree
from diffabs.engine.drive import kernel as native
from diffabs.engine.drive.batches import describe_placement, run_on_all_cores
from diffabs.engine.drive.engine import (
    ENGINE_VARIABLE,
    EngineError,
    log_own_choice,
    log_xla_reason,
    resolve_request,
)
from diffabs.parts.objectives import IAE, StopTime
from diffabs.robust.design import attraction
from diffabs.robust.design.attraction import Cells, region_of_attraction
from diffabs.scenario.defaults import braking
from diffabs.tune.method import DerivativeMode
from diffabs.uncertainty import reliability

pytestmark = pytest.mark.xdist_group("kernel engines")

LOOP = braking(
    plant=plants.QuarterCar(road=roads.DRY_ASPHALT),
    stop=stops.SpeedReached(speed=15.0),
    controller=controllers.ConstantTorque(torque=20.0),
)
TUNED = {
    "free": {"controller.torque": (10.0, 100.0)},
    "objective": {"iae": 1.0},
    "measured": {"iae": IAE()},
    "over": d.Batch({"plant.mass": [14.0, 15.0, 16.0]}),
    "solver": d.FixedStep(2e-3, 3.0),
}
LOCKED = braking(
    initial=d.BrakeStart(speed=10.0, slip=1.0),
    controller=controllers.ConstantTorque(torque=500.0),
    stop=stops.SpeedReached(speed=5.0),
)
SPACE = {"initial.speed": sweep.Normal(10.0, 0.5, low=6.0, high=14.0)}
STUDY = sweep.Study(
    LOCKED,
    sweep.Space(SPACE),
    samples=1,
    solver=d.FixedStep(5e-3, 3.0),
    objectives={"stop_time": StopTime()},
    engine="xla",
)
DELAYED = d.replace(LOOP, {"actuator": actuators.Delay(capacity=1024)})


@pytree
class SortedTorque:
    """A controller with an operation for which a kernel has no rule."""

    torque: Any = param(default=20.0, unit="N m")

    flow = no_flow

    def start(self, signal):
        return Memory(held=self.torque + 0.0 * signal.target)

    def output(self, t, memory, signal):
        return memory.held

    def tick(self, clock, memory, signal):
        return Memory(held=jax.lax.sort(jnp.stack([self.torque, signal.target]))[1])


@pytree
class Arrived:
    """The run ends at x = 0.4."""

    far: Any = param(default=0.4, unit="m")
    success, remainder = True, stops.NoStop.remainder

    def margin(self, output):
        return self.far - output.x


STARTS = ("classify_starts", "region_of_attraction", "largest_recovered_multiples", "recoverable_multiple")
NONE = f"{toolchain.COMPILER} is empty"


@pytest.fixture(autouse=True)
def _own_folder(monkeypatch):
    monkeypatch.setenv(library_cache.CACHE, FOLDER)


@pytest.fixture
def no_compiler(monkeypatch):
    monkeypatch.setenv(toolchain.COMPILER, "")
    log_xla_reason.cache_clear()
    jax.clear_caches()
    yield
    jax.clear_caches()


@killed_by(
    "engine.drive.loops", "return i + 1, any_lane(jnp.any(sample.running))", "return i + 1, sample.running.all()"
)
@killed_by("loop.ensemble", "return cut_trajectory(run, solver, solver.every, axis=1)", "return run")
def test_a_kernel_keeps_trajectories():
    """Until each run ends at its own time, here of x = (1 - exp(-rate t))/rate; the second run is refused."""
    loop, solver = dataclasses.replace(decay_loop(), stop=Arrived()), d.FixedStep(0.01, 1.0, every=3)
    rates, accepted = np.array([1.0, 2.0, 3.0]), np.array([True, False, True])
    lanes = d.Batch({"plant.rate": rates})
    run = jax.device_get(d.run_batch(loop, lanes, solver, trajectories=True, accepted=accepted, engine="kernel"))
    assert run.diverged.tolist() == [False, True, False]
    assert run.stopped.tolist() == [True, False, False]
    assert run.trajectory.running.sum(axis=1).tolist() == [18, 0, 34]
    for i, end in ((0, -np.log(1.0 - 0.4)), (2, 1.0)):
        t = np.minimum(0.03 * np.arange(35), end)
        np.testing.assert_allclose(run.trajectory.sample.t[i], t, atol=1e-7)
        expected = (1.0 - np.exp(-rates[i] * t)) / rates[i]
        np.testing.assert_allclose(run.trajectory.sample.output.x[i], expected, atol=1e-7)


@pytest.mark.slow
@killed_by("engine.drive.kernel", "until=until)", "until=None)")
@killed_by("engine.drive.kernel", "return method.keep_steps(_stop_unaccepted(accepted, begins))", "return begins")
def test_a_kernel_keeps_trajectories_of_adaptive_steps():
    lanes, solver = d.Batch({"initial.speed": [20.0, 25.0]}), d.Adaptive(1e-6, 3.0, 1e-3, every=7)
    run = jax.device_get(d.run_batch(LOOP, lanes, solver, trajectories=True, engine="kernel"))
    for i in range(2):
        expected = jax.device_get(d.rollout(lanes.lane(LOOP, i), solver)).trajectory
        jax.tree.map(
            lambda x, y: np.testing.assert_allclose(x[i], y, rtol=1e-8, atol=1e-8),  # noqa: B023
            *(run.trajectory, expected),
        )


class TestDefault:
    """Nobody names an engine."""

    @killed_by("engine.drive.engine", "and (why_not or why_xla):", "and why_not:")
    @killed_by("engine.drive.engine", "log_own_choice(why_not or why_xla)", "log_xla_reason(why_not or why_xla)")
    def test_trajectories_are_those_of_xla(self, users_engine, caplog):
        """With no warning: a kernel makes them on request only."""
        log_own_choice.cache_clear()
        with caplog.at_level(logging.INFO, "diffabs"):
            d.run_batch(decay_loop(), d.Batch({"plant.rate": [1.0, 2.0]}), d.FixedStep(0.1, 0.2), trajectories=True)
        assert [record.levelname for record in caplog.records] == ["INFO"]

    @killed_by("tune.tuning", 'engine: str = "auto",', 'engine: str = "xla",')
    @killed_by("tune.worst", 'engine: str = "auto",', 'engine: str = "xla",')
    @killed_by("robust.design.attraction", 'engine: str = "auto",', 'engine: str = "xla",')
    @killed_by("uncertainty.sweep.study", 'engine: str = "auto"', 'engine: str = "xla"')
    def test_is_the_same_everywhere(self):
        functions = [d.run_batch, tune.build_problem, tune.worst_case, sweep.Study]
        functions += [getattr(attraction, name) for name in STARTS]
        assert {inspect.signature(function).parameters["engine"].default for function in functions} == {"auto"}

    @killed_by("engine.drive.engine", "meant = os.environ.get(ENGINE_VARIABLE) or engine", "meant = engine")
    def test_is_replaced_by_the_environment(self, monkeypatch):
        assert resolve_request("auto") == "xla"  # of these tests
        monkeypatch.setenv(ENGINE_VARIABLE, "kernel")
        assert resolve_request("auto") == "kernel"
        assert resolve_request("xla") == "xla"
        monkeypatch.setenv(ENGINE_VARIABLE, "gpu")
        with pytest.raises(ValueError, match="DIFFABS_ENGINE = 'gpu' is unknown; there is auto, xla, kernel"):
            resolve_request("auto")
        assert "DIFFABS_ENGINE = 'gpu' is unknown" in run("tune", "slip-lmi", status=2).stderr


SEVERAL = """
import jax
import numpy as np
import diffabs as d
from diffabs.host.process import core_count
from diffabs.compiler.runtime.cpu import thread_count
from diffabs.engine.drive.batches import describe_placement

assert jax.local_device_count() == 2
print(thread_count() == core_count())
print(repr(describe_placement(np.zeros(4))))
mesh = jax.make_mesh((2,), ("lanes",), axis_types=(jax.sharding.AxisType.Auto,))
print(describe_placement(jax.device_put(np.zeros(4), jax.NamedSharding(mesh, jax.P("lanes")))))
"""


@pytest.mark.slow
@killed_by("compiler.runtime.cpu", "    return core_count()\n", "    return 1\n")
@killed_by("engine.drive.batches", "if any(len(devices) > 1 for devices in places):", "if False:")
def test_several_devices_of_one_processor():
    """A kernel uses all cores. Runs that lie on several devices are left to XLA."""
    flags = os.environ.get("XLA_FLAGS", "") + " --xla_force_host_platform_device_count=2"
    words = [sys.executable, "-c", SEVERAL]
    done = subprocess.run(words, env=os.environ | {"XLA_FLAGS": flags}, capture_output=True, text=True, check=True)
    assert done.stdout.splitlines() == ["True", "''", "the runs lie on several devices"]


@killed_by("engine.drive.batches", "- {default_platform()}", '- {"cpu"}')
@killed_by("engine.drive.batches", ' or default_platform() != "cpu"', "")
def test_runs_on_a_gpu(monkeypatch):
    """A kernel can run them where JAX runs on a GPU by default, and they are not dealt to the processor's cores."""
    replace_seam(monkeypatch, "default_platform", lambda: "gpu")
    assert describe_placement(np.zeros(3)) == ""
    assert describe_placement(jnp.zeros(3)) == ""  # JAX moves it
    there = jax.device_put(np.zeros(3), jax.devices("cpu")[0])
    assert describe_placement(there) == "the runs lie on a device (cpu) of another kind than JAX's default"
    dealt = []
    run_on_all_cores(lambda _, numbers: dealt.append(len(numbers)) or numbers, np.zeros(4096), 4096)
    assert dealt == [4096]


class TestTune:
    @pytest.mark.slow
    def test_is_that_of_xla(self):
        """Two starts, each with its lanes, in one launch; the values of what is tuned to the last digits."""
        method = tune.Method(starts=2)
        found, expected = (
            tune.tune(tune.build_problem(LOOP, **TUNED, engine=e), method=method) for e in ("kernel", "xla")
        )
        assert found.engine == {"name": "kernel", **toolchain.describe_compiler()}
        assert expected.engine == {"name": "xla"}
        np.testing.assert_allclose(found.objective, expected.objective, rtol=1e-9)
        np.testing.assert_allclose(found.values["controller.torque"], expected.values["controller.torque"], rtol=1e-6)

    @pytest.mark.slow
    def test_without_lanes_of_its_own_and_of_many_parameters(self):
        """One lane; and reverse mode, which a kernel computes by forward directions."""
        given = {**TUNED, "over": None}
        paths = ["controller.torque", "plant.mass", "plant.inertia", "initial.speed", "plant.road.c1", "plant.radius"]
        paths += ["plant.road.c2", "plant.road.c3", "stop.speed"]
        ranges = {path: (0.9 * float(get(LOOP, path)), 1.1 * float(get(LOOP, path))) for path in paths}
        problems = [
            tune.build_problem(LOOP, **{**given, "free": ranges}, engine=e, mode=m)
            for e, m in (("kernel", None), ("xla", DerivativeMode.REVERSE))
        ]
        z = problems[0].space.place(LOOP)[None]
        none = tune.problem.Multipliers(np.zeros((1, 0)), np.ones(1))
        found, expected = (jax.device_get(problem.evaluator(1.0)(z, none)) for problem in problems)
        np.testing.assert_allclose(found.gradient, expected.gradient, rtol=1e-7, atol=1e-12)

    @killed_by("engine.drive.engine", "    if engine not in REQUESTABLE_ENGINES:", "    if False:")
    def test_of_another_name(self):
        with pytest.raises(ValueError, match="engine = 'gpu' is unknown; there is auto, xla, kernel"):
            tune.tune(tune.build_problem(LOOP, **TUNED, engine="gpu"))

    @killed_by("tune.problem", "self.measured, engine=self.engine)", "self.measured)")
    @pytest.mark.slow
    def test_without_a_compiler(self, users_engine, no_compiler):
        with pytest.raises(EngineError, match=NONE):
            tune.tune(tune.build_problem(LOOP, **TUNED, engine="kernel"))
        assert tune.build_problem(LOOP, **TUNED).find_engine() == ("xla", NONE)

    @killed_by("compiler.lower.rules", "error.method = error.method or _calling_method(eqn)", "pass")
    def test_of_what_has_no_rule_names_the_part(self):
        why = r"engine = 'kernel' is not possible: sort: there is no rule for it \(in SortedTorque.tick\)"
        with pytest.raises(EngineError, match=why):
            tune.build_problem(braking(controller=SortedTorque()), **TUNED, engine="kernel").find_engine()

    @killed_by("engine.drive.kernel", "if rows.shape[1] > MAX_COMPARED_ENTRIES:", "if False:")
    @pytest.mark.slow
    def test_of_a_long_past_names_the_part(self):
        why = r"engine = 'kernel' is not possible: log: of 1296 rows; 64 are the most \(in Delay.record\)"
        with pytest.raises(EngineError, match=why):
            tune.build_problem(DELAYED, **TUNED, engine="kernel").find_engine()

    @pytest.mark.slow
    def test_by_the_command(self, users_engine, tmp_path, monkeypatch):
        """It writes what made it; without a compiler it is an objection, or XLA, and says so."""
        few = ("--set", "tune.iterations=1", "--json")
        document = json.loads(run("tune", "slip-lmi", *few).stdout)
        assert document["engine"] == {"name": "kernel", **toolchain.describe_compiler()}
        monkeypatch.setenv(toolchain.COMPILER, "")
        assert NONE in run("tune", "slip-lmi", *few, "--engine", "kernel", status=2).stderr
        done = run("tune", "slip-lmi", *few)
        assert f"note: runs are made by XLA: {NONE}" in done.stderr
        assert json.loads(done.stdout)["engine"] == {"name": "xla"}

    @killed_by("cli.engine", "        resolve_request(engine)\n    except", "        pass\n    except")
    @pytest.mark.parametrize("command", [("tune", "slip-lmi"), ("rare", "slip-lmi", "overshoot")])
    def test_another_engine_is_refused_by_the_command(self, command):
        assert "--engine gpu is unknown" in run(*command, "--engine", "gpu", status=2).stderr


@killed_by("tune.worst", "accepted=True, engine=engine)", "accepted=True, engine='xla')")
@pytest.mark.slow
def test_the_worst_case_is_that_of_xla(users_engine, monkeypatch):
    """Screened without derivatives and ascended with them, both by a kernel."""
    native._run.clear_cache()
    launches, launched = [], pipeline._launch_lanes
    replace_seam(monkeypatch, "launch_lanes", lambda made, *a, **k: launches.append(made) or launched(made, *a, **k))
    over = {"plant.mass": (14.0, 16.0), "initial.speed": (25.0, 28.0)}
    given = {"over": over, "metric": "iae", "solver": TUNED["solver"], "measured": TUNED["measured"]}
    found, expected = (
        tune.worst_case(LOOP, **given, screen=16, starts=3, iterations=3, engine=e) for e in ("auto", "xla")
    )
    assert found.engine == {"name": "kernel", **toolchain.describe_compiler()}
    assert expected.engine == {"name": "xla"}
    assert found.value == pytest.approx(expected.value, rel=1e-9)
    assert found.values.keys() == expected.values.keys()
    assert {bool(made.tangents) for made in launches} == {False, True}


@killed_by("engine.drive.kernel", "STEPS_PER_EXCHANGE // STEPS_PER_BLOCK", "1")
@pytest.mark.slow
def test_a_map_of_starts_is_that_of_xla():
    """Runs that end inside of an ellipsoid, that fall, and that do neither; known at the same instant."""
    loop = scenario.load("arm-hanging").loop
    cells = Cells(-1.5, 1.5, 9)
    maps = [
        region_of_attraction(loop, cells, cells, d.FixedStep(2e-3, 1.0), engine=e).outcomes for e in ("kernel", "xla")
    ]
    for name in ("recovered", "fell", "unstable", "diverged"):
        np.testing.assert_array_equal(getattr(maps[0], name), getattr(maps[1], name), err_msg=name)
    assert maps[1].recovered.any()
    assert not maps[1].recovered.all()
    np.testing.assert_allclose(maps[0].time, maps[1].time, rtol=1e-12)


class TestSweep:
    @pytest.mark.slow
    def test_a_library_that_cannot_be_written_is_said(self, monkeypatch, tmp_path):
        """As on a full disk: it is compiled after everything was traced."""
        (tmp_path / "file").touch()
        monkeypatch.setenv(library_cache.CACHE, str(tmp_path / "file" / "kernel"))
        study = dataclasses.replace(STUDY, engine="kernel", objectives={"iae": IAE()})
        with pytest.raises(ValueError, match=r"^engine = 'kernel' is not possible: no kernel in .*: Not a directory$"):
            sweep.sweep(study, tmp_path / "out")


class TestRare:
    @killed_by("uncertainty.reliability.failure", 'if engine == "auto":', "if False:", case="True")
    @pytest.mark.slow
    @pytest.mark.parametrize("gradients", [pytest.param(False, marks=pytest.mark.slow), True])
    def test_is_that_of_xla(self, users_engine, gradients):
        """P[stop_time >= 0.878] = 1.1e-3 in closed form. The default engine is a kernel."""
        study = dataclasses.replace(STUDY, engine="auto")
        given = {"gradients": gradients, "samples": 200}
        found, expected = (reliability.failure_probability(s, "stop_time", 0.878, **given) for s in (study, STUDY))
        assert found.engine == {"name": "kernel", **toolchain.describe_compiler()}
        assert expected.engine == {"name": "xla"}
        assert found.probability == pytest.approx(expected.probability, rel=1e-6)
        assert found.evaluations == expected.evaluations
        assert found.gradients == expected.gradients

    @killed_by("uncertainty.reliability.failure", ", engine=study.engine)", ")")
    @pytest.mark.slow
    def test_objection(self, no_compiler):
        assert reliability.failure.find_metric_objection(STUDY, "stop_time") == NONE
        study = dataclasses.replace(STUDY, engine="kernel")
        with pytest.raises(ValueError, match=f"engine = 'kernel' is not possible: {NONE}"):
            reliability.failure_probability(study, "stop_time", 0.878)
