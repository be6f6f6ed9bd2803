"""A run inside JAX's transformations: a kernel makes batches, in forward and reverse mode, and XLA the rest.

The heater y' = p (8 if y < x else 4) - y from y = 0 reaches x at t1 = -log(1 - x/(8 p)). So its end is
y(T) = 4 p + (x - 4 p) exp(-T)/(1 - x/(8 p)), which every nesting of transformations is applied to as well."""

import functools
import logging
import os
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from decaying import decay_loop
from kernels import FOLDER
from marks import cases
from mutants import killed_by
from random_nestings import NESTINGS, field_case, find_differences, find_xla_jacobians, loop_case, score
from seams import replace_seam

import diffabs as d
from diffabs import controllers, plants, sensors
from diffabs.compiler.runtime import library_cache, toolchain
from diffabs.engine.drive import deferred
from diffabs.engine.drive.engine import EngineError
from diffabs.parts.objectives import BRAKING, IAE
from diffabs.parts.stops import SpeedReached
from diffabs.scenario.defaults import braking

END, SOLVER = 2.0, d.FixedStep(0.02)
TARGETS, GAINS = jnp.linspace(2.5, 3.5, 6), jnp.array([0.9, 1.0, 1.2])


@pytest.fixture(autouse=True)
def _kernels_by_default(users_engine, monkeypatch):
    monkeypatch.setenv(library_cache.CACHE, FOLDER)
    deferred._log_choice.cache_clear()


@pytest.fixture
def engines(caplog):
    """The lines in which the package says which engine makes the runs."""
    caplog.set_level(logging.INFO, "diffabs")

    def lines():
        messages = [record.getMessage() for record in caplog.records]
        return [message.split(" (")[0] for message in messages if "kernel" in message]

    return lines


def heater(t, y, args):
    del t
    target, gain = args
    return gain * jnp.where(y < target, 8.0, 4.0) - y


def simulated(target, gain):
    return d.solve(heater, 0.0, 0.0, END, (target, gain), solver=SOLVER).y


def exact(target, gain):
    return 4 * gain + (target - 4 * gain) * jnp.exp(-END) / (1 - target / (8 * gain))


def mean(f):
    return lambda gain: jnp.mean(jax.vmap(lambda x: f(x, gain))(TARGETS))


def over_targets(f, gain=1.0):
    return jax.vmap(lambda x: f(x, gain))(TARGETS)


def in_a_loop(f):
    """Three steps down the gradient, as an optimiser takes them."""
    return jax.lax.scan(lambda gain, _: (gain - 0.01 * jax.grad(mean(f))(gain), gain), 1.0, length=3)[1]


def conditional(f):
    return jax.jit(lambda on: jax.lax.cond(on > 0, lambda: over_targets(f), lambda: 0.0 * TARGETS))(1.0)


FIRST = {  # transformations of a function of target and gain, and their results
    "vmap": over_targets,
    "jit vmap": jax.jit(over_targets, static_argnums=0),
    "grad of a mean": lambda f: jax.jit(jax.value_and_grad(mean(f)))(1.0),
    "vmap grad": lambda f: jax.vmap(jax.grad(f, (0, 1)), (0, None))(TARGETS, 1.0),
    "jacfwd of a mean": lambda f: jax.jacfwd(mean(f))(1.0),
}
FURTHER = {
    "vmap jit": lambda f: jax.vmap(jax.jit(f), (0, None))(TARGETS, 1.0),
    "vmap vmap": lambda f: jax.vmap(lambda g: over_targets(f, g))(GAINS),
    "vmap out_axes": lambda f: jax.vmap(lambda g: over_targets(f, g), out_axes=1)(GAINS),
    "vmap in_axes 1": lambda f: jax.vmap(lambda a: f(a[0], a[1]), 1)(jnp.stack([TARGETS, 0 * TARGETS + 1.1])),
    "jvp vmap": lambda f: jax.jvp(lambda g: over_targets(f, g), (1.0,), (2.0,)),
    "vmap jvp": lambda f: jax.vmap(lambda x: jax.jvp(lambda x: f(x, 1.0), (x,), (2.0,)))(TARGETS),
    "jacfwd vmap": lambda f: jax.jacfwd(lambda g: over_targets(f, g))(1.0),
    "jacrev vmap": lambda f: jax.jacrev(lambda g: over_targets(f, g))(1.0),
    "jacrev of own inputs": lambda f: jax.jacrev(lambda x: jax.vmap(f, (0, None))(x, 1.0))(TARGETS),
    "linearize": lambda f: jax.linearize(lambda g: over_targets(f, g), 1.0)[1](3.0),
    "vjp": lambda f: jax.vjp(lambda g: over_targets(f, g), 1.0)[1](TARGETS),
    "grad jit": lambda f: jax.grad(jax.jit(mean(f)))(1.0),
    "jit grad jit": lambda f: jax.jit(jax.grad(jax.jit(mean(f))))(1.0),
    "grad vmap jit": lambda f: jax.grad(mean(jax.jit(f)))(1.0),
    "vmap jit grad": lambda f: jax.vmap(jax.jit(jax.grad(f)), (0, None))(TARGETS, 1.0),
    "vmap grad mean": lambda f: jax.vmap(jax.grad(mean(f)))(GAINS),
    "vmap jacfwd jacrev": lambda f: jax.vmap(jax.jacfwd(jax.jacrev(f, (0, 1)), 1), (0, None))(TARGETS, 1.0),
    "checkpoint": lambda f: jax.grad(jax.checkpoint(mean(f)))(1.0),
    "scan": in_a_loop,
    "cond": conditional,
    "map": lambda f: jax.lax.map(lambda x: f(x, 1.0), TARGETS, batch_size=4),
    "hessian": lambda f: jax.hessian(mean(f))(1.0),
    "jvp grad": lambda f: jax.jvp(jax.grad(mean(f)), (1.0,), (1.0,)),
    "grad of grads": lambda f: jax.grad(lambda g: jnp.sum(jax.vmap(jax.grad(f), (0, None))(TARGETS, g)))(1.0),
    "grad of a jvp": lambda f: jax.grad(lambda g: jax.jvp(mean(f), (g,), (1.0,))[1])(1.0),
}


def compare(nesting):
    found, expected = nesting(simulated), nesting(exact)
    # Runge-Kutta steps of 0.02 with errors of h^4, which second derivatives multiply by up to 100
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=2e-6, atol=1e-7), found, expected)


@pytest.mark.parametrize("name", cases(FIRST, *(FIRST.keys() - {"grad of a mean"})))
def test_common_nestings_are_right_and_made_by_a_kernel(name, engines):
    compare(FIRST[name])
    assert engines()
    assert all(line.endswith("a kernel") for line in engines()), engines()


@pytest.mark.slow
@pytest.mark.parametrize("name", FURTHER)
def test_further_nestings_are_right(name):
    compare(FURTHER[name])


SHARDED = """
import jax
import jax.numpy as jnp
import diffabs as d

mesh = jax.make_mesh((2,), ("runs",), axis_types=(jax.sharding.AxisType.Auto,))
rates, shared = jnp.linspace(0.5, 1.5, 4), jax.P()

def decay(rate, gain):
    return d.solve(lambda t, y, a: -a[0] * a[1] * y, 1.0, 0.0, 1.0, (rate, gain), solver=d.FixedStep(0.05)).y

def slopes(f):
    def local(rates, gain):
        return jax.vmap(f, (0, None))(rates, gain)

    def inside(rates, gain):
        return jax.grad(lambda gain: jax.lax.pmean(local(rates, gain).mean(), "runs"))(gain)

    outside = jax.shard_map(local, mesh=mesh, in_specs=(jax.P("runs"), shared), out_specs=jax.P("runs"))
    inside = jax.shard_map(inside, mesh=mesh, in_specs=(jax.P("runs"), shared), out_specs=shared)
    return jnp.stack([jax.jit(jax.grad(lambda gain: outside(rates, gain).mean()))(1.0), jax.jit(inside)(rates, 1.0)])

assert jax.local_device_count() == 2
print(jnp.allclose(slopes(decay), slopes(lambda rate, gain: jnp.exp(-gain * rate)), rtol=1e-5))
"""


@pytest.mark.slow
@killed_by("engine.drive.deferred", "    words = _vary_alike(words)\n", "")
def test_a_number_that_devices_share_has_the_derivative_by_all_runs():
    """Of exp(-gain rate); Runge-Kutta steps of 0.05 have errors below 1e-6."""
    flags = os.environ.get("XLA_FLAGS", "") + " --xla_force_host_platform_device_count=2"
    words = [sys.executable, "-c", SHARDED]
    done = subprocess.run(words, env=os.environ | {"XLA_FLAGS": flags}, capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["True"]


def test_only_the_values_of_a_single_run_stay_with_xla(engines):
    start, slope = jax.jit(decay)(3.0, 0.5), jax.jit(jax.grad(decay))(3.0, 0.5)
    np.testing.assert_allclose([start, slope], np.exp(-0.5) * np.array([3.0, 1.0]), rtol=1e-4)
    why = "XLA, not a kernel: the values of a single run would wait for its compiler"
    assert engines() == [f"1 run: {why}", "1 run with 1 derivative: a kernel"]


@killed_by("engine.drive.deferred", ' and default_platform() == "cpu"', "")
def test_a_single_run_on_a_gpu_is_a_kernels(monkeypatch):
    program = jax.make_jaxpr(decay)(3.0, 0.5)
    assert deferred.find_kernels(program)[0][1]
    replace_seam(monkeypatch, "deferred_platform", lambda: "gpu")
    assert [objection for _, objection in deferred.find_kernels(program)] == [""]


@pytest.mark.slow
def test_second_derivatives_are_xlas(engines):
    compare(lambda f: jax.hessian(f, (0, 1))(3.0, 1.0))
    assert engines()[0] == "reverse mode: XLA, not a kernel: it has second derivatives"


@killed_by("engine.drive.deferred", "and directions > MAX_DIRECTIONS:", "and False:")
@pytest.mark.slow
def test_a_run_with_many_inputs_has_xlas_reverse_mode(engines):
    """y' = -a y with equal states: each moves their sum by exp(-a)."""
    rates = jnp.linspace(0.5, 1.0, 2)

    def total(start, rate):
        return d.solve(lambda t, y, a: -a * y, start, 0.0, 1.0, rate, solver=d.FixedStep(0.1)).y.sum()

    starts = jnp.ones((2, deferred.MAX_DIRECTIONS + 1))
    slopes = jax.jit(jax.vmap(jax.grad(total)))(starts, rates)
    np.testing.assert_allclose(slopes, np.exp(-rates)[:, None] * starts, rtol=1e-6)
    assert engines() == ["reverse mode: XLA, not a kernel: a run has more than 32 inputs"]


@pytest.fixture
def no_compiler(monkeypatch):
    """Without a C++ compiler, and with a step for which no program is kept."""
    monkeypatch.setenv("DIFFABS_KERNEL_COMPILER", "")
    return d.FixedStep(0.025)


@killed_by("engine.drive.deferred", "        return str(error)\n", "        raise\n")
def test_without_a_compiler_xla_makes_the_runs(no_compiler, engines):
    rates = jnp.linspace(0.5, 1.0, 6)
    found = jax.vmap(lambda a: d.solve(lambda t, y, a: -a * y, 1.0, 0.0, 1.0, a, solver=no_compiler).y)(rates)
    np.testing.assert_allclose(found, np.exp(-rates), rtol=2e-6)
    assert engines() == ["6 runs: XLA, not a kernel: DIFFABS_KERNEL_COMPILER is empty"]


def test_a_required_kernel_that_is_impossible_is_an_error(no_compiler):
    with pytest.raises(EngineError, match="engine = 'kernel' is not possible: DIFFABS_KERNEL_COMPILER is empty"):
        over_targets(lambda x, gain: d.solve(heater, 0.0, 0.0, END, (x, gain), solver=no_compiler, engine="kernel").y)


@killed_by("engine.drive.deferred", "if without_jit else", "if False else")
@pytest.mark.slow
def test_without_jit_xla_makes_the_runs():
    with jax.disable_jit():
        start = decay(1.0, jnp.asarray(0.5))
    np.testing.assert_allclose(start, np.exp(-0.5), rtol=1e-4)


@pytest.mark.slow
def test_without_jit_xla_makes_the_derivatives():
    with jax.disable_jit():
        rate = jax.grad(lambda a: decay(1.0, a))(jnp.asarray(0.5))
    np.testing.assert_allclose(rate, -np.exp(-0.5), rtol=1e-4)


def decay(start, rate):
    return d.solve(lambda t, y, a: -jnp.real(a) * y, start, 0.0, 1.0, rate, solver=d.FixedStep(0.25)).y


@killed_by("engine.drive.deferred", "return by_xla(plan, run)  # a kernel", "pass  # a kernel")
def test_a_complex_number_has_a_derivative():
    slope = jax.vmap(lambda z: jax.jvp(lambda z: decay(1.0, z), (z,), (1.0 + 0j,))[1])(jnp.array([0.5 + 0j, 1.0]))
    np.testing.assert_allclose(slope, -np.exp(-np.array([0.5, 1.0])), rtol=1e-3)


@pytest.mark.slow
def test_a_derivative_of_known_numbers_inside_a_checkpoint():
    """Here d(x exp(-t))/dx of the known derivative by t: -exp(-t)."""

    @jax.checkpoint
    def product(x, t):
        return x * jax.jvp(lambda a: decay(1.0, a), (t,), (1.0,))[1]

    np.testing.assert_allclose(jax.grad(product)(1.0, 1.0), -np.exp(-1.0), rtol=1e-3)


@pytest.mark.slow
def test_an_empty_argument_has_an_empty_derivative():
    def final(p):
        return d.solve(lambda t, y, p: -p["a"] * y + jnp.sum(p["e"]), 1.0, 0.0, 1.0, p, solver=d.FixedStep(0.25)).y

    slopes = jax.grad(final)({"a": 1.0, "e": jnp.zeros(0)})
    np.testing.assert_allclose(slopes["a"], -np.exp(-1.0), rtol=1e-3)
    assert slopes["e"].shape == (0,)


class TestLoops:
    LOOP = braking(
        plant=plants.MirroredRig(),
        initial=d.BrakeStart(speed=30 / 3.6),
        controller=controllers.StateFeedback(gain=np.array([-4000.0, -40.0])),
        feedforward=controllers.HoldingInput(),
        stop=SpeedReached(speed=25 / 3.6),
        sensor=sensors.Noise(slip=0.01, period=4e-3),
    )
    SPEEDS, KEYS = jnp.linspace(27.0, 33.0, 5) / 3.6, jax.random.split(jax.random.key(3), 5)

    def distances(self, mass, solver, engine=None):
        """The mean over speeds and noise, by `measure` or by a batch of an engine."""
        measured = {"stop_distance": BRAKING["stop_distance"]}
        loop = d.replace(self.LOOP, {"plant.mass": mass})
        if engine:
            batch = d.Batch({"initial.speed": self.SPEEDS}, self.KEYS)
            return d.run_batch(loop, batch, solver, measured, engine=engine).metrics["stop_distance"].mean()

        def distance(speed, key):
            return d.measure(d.replace(loop, {"initial.speed": speed}), solver, measured, key=key).metrics

        return jax.vmap(distance)(self.SPEEDS, self.KEYS)["stop_distance"].mean()

    @pytest.mark.slow
    @pytest.mark.parametrize("solver", [d.FixedStep(2e-3, 0.5), d.Adaptive(1e-6, 0.5)])
    def test_values_and_gradients_are_those_of_xla(self, solver, engines):
        found = jax.jit(jax.value_and_grad(lambda m: self.distances(m, solver)))(5.7)
        assert engines() == ["5 runs with 1 derivative: a kernel"]
        expected = jax.jit(jax.value_and_grad(lambda m: self.distances(m, solver, "xla")))(5.7)
        np.testing.assert_allclose(found, expected, rtol=1e-11)

    @pytest.mark.slow
    def test_a_traced_batch_is_the_same_call(self, engines):
        solver, measured = d.FixedStep(0.05, 1.0), {"iae": IAE()}
        controls = jnp.linspace(1.0, 2.0, 5)

        def errors(rate):
            batch = d.Batch({"controller.torque": controls})
            return d.run_batch(decay_loop(rate), batch, solver, measured).metrics["iae"].mean()

        def exact(rate):
            return controls.mean() * (1 - (1 - jnp.exp(-rate)) / rate) / rate

        found, expected = jax.jit(jax.value_and_grad(errors))(2.0), jax.value_and_grad(exact)(2.0)
        np.testing.assert_allclose(found, expected, rtol=1e-5)
        assert engines() == ["5 runs with 1 derivative: a kernel"]

    @pytest.mark.slow
    def test_a_traced_batch_of_noisy_runs_is_the_same_call(self, engines):
        solver = d.FixedStep(2e-3, 0.5)
        found = jax.jit(jax.value_and_grad(lambda m: self.distances(m, solver, "auto")))(5.7)
        expected = jax.jit(jax.value_and_grad(lambda m: self.distances(m, solver)))(5.7)
        np.testing.assert_array_equal(found, expected)
        assert engines() == ["5 runs with 1 derivative: a kernel"]


@pytest.fixture
def programs(monkeypatch):
    """Names of XLA's programs that are compiled, and texts of kernels that are built."""
    names, texts, build = [], set(), toolchain.build_library

    def record(event, seconds, **told):
        if event.endswith("backend_compile_duration"):
            names.append(told.get("fun_name"))

    def build_recorded(text, flags=()):
        texts.add(text)
        return build(text, flags)

    replace_seam(monkeypatch, "build_library", build_recorded)
    jax.monitoring.register_event_duration_secs_listener(record)
    yield names, texts
    jax.monitoring.unregister_event_duration_listener(record)


@killed_by("engine.drive.deferred", "@functools.lru_cache(MAX_KEPT_PROGRAMS)\ndef _compile_call", "def _compile_call")
def test_nothing_is_compiled_twice(programs):
    """An optimiser calls with new numbers, with equal functions made anew, and with batches of other sizes."""
    names, texts = programs

    def new_slope(targets=TARGETS):
        def field(t, y, args):
            return args[1] * jnp.where(y < args[0], 8.0, 4.0) - y

        def end(x, gain):
            return d.solve(field, 0.0, 0.0, END, (x, gain), solver=SOLVER).y

        return jax.value_and_grad(lambda gain: jnp.mean(jax.vmap(end, (0, None))(targets, gain)))

    compiled = jax.jit(new_slope())
    for slope in (compiled, new_slope()):
        slope(1.0)
        assert names
        names.clear()
        slope(1.1)
        assert names == []
    new_slope()(1.2)
    assert names == []
    jax.jit(new_slope(TARGETS[:3]))(1.0)
    assert len(texts) == 1


@functools.cache
def random_case(kind, name, adaptive):
    """A case, its differences, and XLA's Jacobians where they are wanted."""
    case = (field_case if kind == "field" else loop_case)(name, 3, 4, adaptive)
    return case, find_differences(case)


def check_random(kind, name, adaptive, nesting, engines):
    case, differences = random_case(kind, name, adaptive)
    found = score(case, nesting, differences)
    # A nesting whose program an earlier one has compiled logs nothing.
    assert all(line.endswith("a kernel") for line in engines()), engines()
    assert found.compared > 20
    assert (found.wrong, found.lost) == (0, 0)


@pytest.mark.slow
@pytest.mark.parametrize("nesting", NESTINGS)
def test_random_fields_in_all_nestings(nesting, engines):
    """Fields with switches and events, against differences of their values."""
    check_random("field", 0, False, nesting, engines)


RANDOM = [("field", 1, True), ("field", 2, False), ("loop", "lab rig, relay", False)]


@pytest.mark.slow
@pytest.mark.parametrize("nesting", ["shared, jacrev", "grad in a scan", "vmap jacfwd"])
@pytest.mark.parametrize(("kind", "name", "adaptive"), RANDOM)
def test_more_random_runs_in_some_nestings(kind, name, adaptive, nesting, engines):
    check_random(kind, name, adaptive, nesting, engines)


@pytest.mark.slow
def test_kernel_and_xla_have_one_jacobian():
    case, differences = random_case("field", 1, True)
    assert score(case, "vmap jacfwd", differences, find_xla_jacobians(case)).unlike == 0
