"""Derivatives of a kernel's runs, forward: those of XLA, in one launch, and an objection in reverse.

To rounding where steps are those of the grid. Where a step ends on an event or a kink, the derivative of its moment is
divided by how the margin falls there, which is a difference over a thousandth of a step: XLA's own digits end there. In
a loop that switches all the time (slip-cured), a start that is 2e-15 of itself faster changes XLA's derivative of the
IAE by 4e-4 of itself."""

import dataclasses
import os
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from kernels import FOLDER
from marks import cases
from mutants import killed_by
from project import ROOT
from seams import replace_seam
from test_kernel_parts import CASES, VARIED, with_part

import diffabs as d
from diffabs import controllers, plants, scenario
from diffabs.compiler import pipeline
from diffabs.compiler.autodiff import jvp
from diffabs.compiler.ir import UpdateLevel
from diffabs.compiler.pipeline import run_lanes
from diffabs.compiler.runtime import library_cache
from diffabs.core.pytree import get, parameters, stack_lists
from diffabs.parts.objectives import IAE, default_objectives
from diffabs.scenario.defaults import braking

pytestmark = pytest.mark.xdist_group("kernel tangents")

LANES, STEPS = 37, 5
RTOL = 1e-5  # of a run with adaptive steps: ten times that of a step
EXACT, LANDED, SWITCHING = 1e-12, 1e-6, 2e-3  # of the largest derivative among the lanes, or of the metric
# Of a stop that is extrapolated over 400 s or 2,200 s: where the start moves by an ulp, XLA's own derivative moves by
# 1e-12 or 3e-13.
ROUNDED = {"literal": 3e-12, "literature-park": 3e-12}
LEAST = 1e-2  # a final slip error of 3e-4 is a difference of slips near 1, and has their digits
# What last digits decide in XLA as well, and is measured there: which comparisons of the slip hold when the computer of
# slip-real brakes for the first time a wheel that turned freely; how many ticks the noisy computer of lab-rig takes;
# whether the step with the peak of the voltage of arm-hanging ends at its limit or a little behind. The overshoot of
# literature-mathworks moves by 2.5e-12.
BY_ROUNDING, SWAY = (
    {
        ("slip-real", "kinks"),
        ("literature-mathworks", "kinks"),
        ("lab-rig", "adaptive"),
        ("arm-hanging", "adaptive"),
    },
    3,
)
PARTS_HERE = [case for case in CASES if case[0] != "stop"]


@pytest.fixture(autouse=True)
def _own_folder(monkeypatch):
    monkeypatch.setenv(library_cache.CACHE, FOLDER)
    replace_seam(monkeypatch, "vectors_per_block", 2)


def chain(gain, rates, engine="kernel", wanted=None):
    """What follows from what, step by step: y from the gain, z from y, w from z; and what moves with nothing."""

    def step(rate, carry):
        i, y, z, w, still = carry
        new = (y + 0.1 * gain * jnp.sin(rate * y), z + y / (1 + z * z), w + jnp.where(z > 1.5, z * w, w), still + 1.0)
        return (i + (i < STEPS), *(jnp.where(i < STEPS, a, b) for a, b in zip(new, carry[1:], strict=True)))

    ones = jnp.ones(len(rates))
    carry = (jnp.zeros(len(rates), int), ones, ones, ones, ones)
    if engine == "kernel":
        carry = run_lanes(
            lambda _, c: c, step, lambda _, c: c[0] < STEPS, rates, carry, steps=2, rounds=1, tangents_read=wanted
        )
    else:
        for _ in range(STEPS):
            carry = jax.vmap(step)(rates, carry)
    return jnp.stack(carry[1:])


RATES = jnp.linspace(0.5, 2.0, LANES)
WAYS = {
    "of what is the same for all": lambda f: jax.jvp(lambda g: f(g, RATES), (2.0,), (1.0,))[1],
    "of the lanes": lambda f: jax.jvp(lambda r: f(2.0, r), (RATES,), (RATES**2,))[1],
    "of both": lambda f: jax.jvp(f, (2.0, RATES), (1.0, RATES))[1],
    "three tangents": lambda f: jax.jacfwd(lambda x: f(x[0] * x[1], x[2] * RATES))(jnp.array([2.0, 1.0, 1.0])),
    "eleven tangents": lambda f: jax.jacfwd(lambda x: f(jnp.sum(jnp.sin(x)), x[3] * RATES))(jnp.arange(1.0, 12.0) / 9),
    "under jit": lambda f: jax.jit(jax.jacfwd(lambda x: f(x[0], x[1] * RATES)))(jnp.array([2.0, 1.0])),
    "for several gains": lambda f: jax.vmap(lambda g: f(g, RATES))(jnp.array([1.0, 2.0, 3.0])),
    "several tangents for several gains": lambda f: jax.vmap(jax.jacfwd(lambda x: f(x[0], x[1] * RATES)))(
        jnp.array([[2.0, 1.0], [1.0, 1.5], [0.5, 1.0]])
    ),
    "along a batch": lambda f: jax.jacfwd(jax.vmap(lambda x: f(x, RATES[:3])))(jnp.array([1.0, 2.0])),
    "of lanes in a batch": lambda f: jax.vmap(lambda r, s: jax.jvp(lambda r: f(2.0, r), (r,), (s,))[1], (1, None), 2)(
        jnp.stack([RATES, 2 * RATES], 1), RATES
    ),
}


class TestLaunch:
    @killed_by(
        "compiler.autodiff.linear",
        'self.graph.op("div", self.graph.const(1, node.dtype), value(args[1]))',
        "value(args[1])",
        case="of both",
    )
    @killed_by(
        "compiler.autodiff.linear", 'self.graph.op("mul", x.number, y.number)', "x.number", case="three tangents"
    )
    @killed_by(
        "compiler.autodiff.jvp",
        "tangent_copy(new[x.id], k) for",
        "tangent_copy(new[x.id], 0) for",
        case="three tangents",
    )
    @killed_by(
        "compiler.runtime.jax_primitive",
        "jnp.pad(x, wide), first, first + each,",
        "jnp.pad(x, wide), 0, each,",
        case="eleven tangents",
    )
    @killed_by(
        "compiler.runtime.jax_primitive",
        "x = jnp.moveaxis(x, 0, at)",
        "x = jnp.moveaxis(x[::-1], 0, at)",
        case="three tangents",
    )
    @killed_by(
        "compiler.runtime.jax_primitive",
        "jnp.moveaxis(x, axis, 0)\n            if shared:",
        "0 * x + jnp.moveaxis(x, axis, 0)[:1]\n            if shared:",
        case="for several gains",
    )
    @pytest.mark.parametrize("way", cases(WAYS, *(way for way in WAYS if way != "of the lanes")))
    def test_derivatives_are_those_of_xla(self, way):
        found, expected = (jax.device_get(WAYS[way](lambda g, r, e=e: chain(g, r, e))) for e in ("kernel", "xla"))
        assert np.abs(expected[..., :3]).max() > 0
        np.testing.assert_allclose(found, expected, rtol=2e-13, atol=1e-13)

    @killed_by("compiler.autodiff.jvp", "if reached == moved_arrays[UpdateLevel.STEP]:", "if True:")
    @pytest.mark.slow
    def test_only_what_moves_is_carried(self, monkeypatch):
        """The fourth number moves with nothing, and what comes from no tangent is no operation."""
        seen = []
        spread = jvp.replicate_tangents
        replace_seam(
            monkeypatch,
            "replicate_tangents",
            lambda f, one, *more: seen.append(one.moved_arrays) or spread(f, one, *more),
        )
        jax.jvp(lambda g: chain(g, RATES), (2.0,), (1.0,))
        assert seen[-1][UpdateLevel.STEP] == (1, 2, 3)
        assert seen[-1][UpdateLevel.LANE] == ()

    @pytest.mark.slow
    @killed_by("compiler.autodiff.jvp", "if outputs_needed is not None:", "if False:")
    def test_only_what_is_asked_for_is_carried(self, monkeypatch):
        """The third number leads to nothing but itself, and has no tangent; the second has those that it has anyway."""
        seen = []
        spread = jvp.replicate_tangents
        replace_seam(
            monkeypatch,
            "replicate_tangents",
            lambda f, one, *more: seen.append(one.moved_arrays) or spread(f, one, *more),
        )
        wanted = (False, False, True, False, False)
        found = jax.jvp(lambda g: chain(g, RATES, wanted=wanted), (2.0,), (1.0,))[1]
        known = jax.jvp(lambda g: chain(g, RATES, "xla"), (2.0,), (1.0,))[1]
        assert seen[-1][UpdateLevel.STEP] == (1, 2)
        np.testing.assert_allclose(found[1], known[1], rtol=2e-13)
        assert not np.any(found[2])

    @pytest.mark.slow
    @killed_by(
        "compiler.autodiff.eliminate",
        "x not in self.vertices and self.levels[x] < UpdateLevel.STEP for x in once",
        "True for x in once",
    )
    def test_what_is_not_chosen_does_not_matter(self):
        """A try may lead to what is no number, and is then not taken: neither are its tangents."""

        def step(rate, carry):
            i, y, z, none = carry
            tried, new = none * y + rate * z, (y + 0.1 * rate * y, z + y)
            return i + 1, *(jnp.where(i >= 0, a, b + tried) for a, b in zip(new, (y, z), strict=True)), none

        def run(gains):
            carry = jnp.zeros(LANES, int), jnp.sum(gains) * RATES, jnp.sum(gains) * RATES, jnp.full(LANES, jnp.nan)
            return run_lanes(lambda _, c: c, step, lambda _, c: c[0] < STEPS, RATES, carry, steps=STEPS, rounds=1)[1]

        known = jnp.outer((1 + 0.1 * RATES) ** STEPS * RATES, jnp.ones(3))
        np.testing.assert_allclose(jax.jacfwd(run)(jnp.arange(3.0)), known, rtol=1e-13)

    @pytest.mark.slow
    @killed_by(
        "compiler.runtime.jax_primitive", "MAX_TANGENTS_PER_LAUNCH = 8 ", "MAX_TANGENTS_PER_LAUNCH = 1 ", case="8-1"
    )
    @pytest.mark.parametrize(("many", "launches"), [(8, 1), (9, 2)])
    def test_tangents_are_one_launch(self, many, launches, monkeypatch):
        made = []
        launched = pipeline._launch_lanes
        replace_seam(monkeypatch, "launch_lanes", lambda *args, **how: made.append(1) or launched(*args, **how))
        jax.jacfwd(lambda x: chain(jnp.sum(x), RATES))(jnp.ones(many))
        assert len(made) == launches

    @killed_by(
        "compiler.runtime.jax_primitive",
        "    if lanes.replay is None:\n        raise ValueError(NO_REVERSE_MODE)\n",
        "",
    )
    @pytest.mark.parametrize(
        "reverse",
        [
            lambda f: jax.grad(f)(2.0),
            lambda f: jax.jit(jax.grad(f))(2.0),
            lambda f: jax.grad(jax.jit(f))(2.0),
            lambda f: jax.vmap(jax.grad(f))(jnp.ones(2)),
        ],
    )
    def test_reverse_mode_is_refused(self, reverse):
        with pytest.raises(ValueError, match="a kernel has no reverse mode: forward mode"):
            reverse(lambda g: jnp.sum(chain(g, RATES)))

    @killed_by(
        "compiler.runtime.jax_primitive", "    if seeds is not None:\n        raise", "    if False:\n        raise"
    )
    def test_second_derivatives_are_refused(self):
        with pytest.raises(ValueError, match="a kernel has no second derivatives"):
            jax.jacfwd(jax.jacfwd(lambda g: chain(g, RATES)))(2.0)

    @pytest.mark.slow
    def test_on_two_devices(self):
        """Lanes that lie on two devices, each of which runs its own; and their derivatives. Then those of a batch: on
        either device, and on both."""
        environment = os.environ | {
            "XLA_FLAGS": "--xla_force_host_platform_device_count=2",
            library_cache.CACHE: FOLDER,
        }
        environment["PYTHONPATH"] = os.pathsep.join([str(ROOT / "tests" / "support"), *sys.path])
        done = subprocess.run([sys.executable, "-c", ON_TWO], env=environment, capture_output=True, text=True)
        assert done.stdout == "on two devices\n", done.stderr[-2000:]


ON_TWO = """
import jax, jax.numpy as jnp, numpy as np
from jax.sharding import AxisType, NamedSharding, PartitionSpec

import diffabs as d
from diffabs.parts.objectives import IAE
from diffabs.scenario.defaults import braking
from test_kernel_tangents import chain

jax.config.update("jax_enable_x64", True)
mesh, lanes = jax.make_mesh((2,), ("lanes",)), PartitionSpec("lanes")
rates = jnp.linspace(0.5, 2.0, 38)
apart = jax.device_put(rates, NamedSharding(mesh, lanes))
specs = {"in_specs": (PartitionSpec(), lanes), "out_specs": PartitionSpec(None, "lanes")}
own = jax.jit(jax.shard_map(chain, mesh=mesh, **specs))
known = chain(2.0, rates, "xla"), jax.jacfwd(lambda g: chain(g, rates, "xla"))(2.0)
for f in (own, jax.jit(chain)):
    found = f(2.0, apart), jax.jacfwd(lambda g: f(g, apart))(2.0)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=2e-13, atol=1e-13), found, known)
assert len(own(2.0, apart).sharding.device_set) == 2

loop, masses = braking(), np.linspace(400.0, 420.0, 38)
both = NamedSharding(jax.make_mesh((2,), ("lanes",), axis_types=(AxisType.Auto,)), lanes)

def iae(masses, engine):
    given = loop, d.Batch({"plant.mass": masses}), d.FixedStep(2e-3, 0.1), {"iae": IAE()}
    return np.asarray(d.run_batch(*given, accepted=True, together=False, engine=engine).metrics["iae"])

known = iae(masses, "xla")
for place in (*jax.devices(), both):
    np.testing.assert_allclose(iae(jax.device_put(masses, place), "kernel"), known, rtol=1e-12)
print("on two devices")
"""


def moved(loop, solver, objectives, path, engine, ulps=0):
    """Values and derivatives of all metrics along changes of everything tunable in a loop, and of what its lanes begin
    with. A list of these where lanes begin so many last digits away, each."""
    leaves, tree = jax.tree.flatten(stack_lists(loop))
    tunable = [spec.tunable for _, spec, _ in parameters(loop)]
    ways = [np.random.default_rng(i).uniform(0.5, 1.0, np.shape(x)) for i, x in enumerate(leaves)]
    spread = float(get(loop, path)) * np.linspace(0.96, 1.04, 12) + 1e-3

    def metrics(z, spread):
        drawn = zip(leaves, ways, tunable, strict=True)
        one = tree.unflatten([jnp.asarray(x, float) * (1 + w * z[0]) if moves else x for x, w, moves in drawn])
        lanes = d.Batch({path: spread * (1 + z[1])}, np.arange(12))
        run = d.run_batch(one, lanes, solver, objectives, accepted=True, engine=engine)
        return run.metrics, (run.metrics, run.diverged)

    derived = jax.jit(jax.jacfwd(metrics, has_aux=True))
    found = [jax.device_get(derived(jnp.zeros(2), spread + n * np.spacing(spread))) for n in np.atleast_1d(ulps)]
    return found if np.ndim(ulps) else found[0]


def swayed(given):
    """What each metric and its derivatives change by, at most, in XLA, if lanes begin one or two last digits away."""
    (slopes, (known, _)), *others = moved(*given, "xla", ulps=(0, -2, -1, 1, 2))

    def most(name, pick, base):
        settles = np.isfinite(base[name])  # a run that never settles says infinity
        return max(np.max(np.abs(pick(one)[name][settles] - base[name][settles]), initial=0.0) for one in others)

    return {n: (most(n, lambda one: one[1][0], known), most(n, lambda one: one[0], slopes)) for n in known}


def compare(given, close, values=1e-13, sways=None):
    """By a kernel and by XLA. `sways`: of metrics and their derivatives, what last digits make of them."""
    (found, (metrics, diverged)), (expected, (known, lost)) = (moved(*given, engine) for engine in ("kernel", "xla"))
    np.testing.assert_array_equal(diverged, lost)
    assert any(np.nanmax(np.abs(slope)) > 0 for slope in expected.values())
    for name, slope in expected.items():
        least, less = (SWAY * x for x in (sways or {}).get(name, (0.0, 0.0)))
        np.testing.assert_allclose(metrics[name], known[name], rtol=values, atol=1e-12 + least, err_msg=name)
        size = max(np.max(np.abs(x), initial=0.0, where=np.isfinite(x)) for x in (slope, known[name]))
        np.testing.assert_allclose(found[name], slope, rtol=0, atol=close * max(size, LEAST) + less, err_msg=name)


@pytest.mark.slow
@pytest.mark.parametrize(("family", "name"), PARTS_HERE, ids=map("-".join, PARTS_HERE))
def test_a_part(family, name):
    """With steps of the grid alone."""
    loop, path = with_part(family, name)
    compare(
        (loop, d.FixedStep(1e-3, 0.06, kinks=False), default_objectives(loop.plant), path), ROUNDED.get(name, EXACT)
    )


@killed_by("engine.drive.kernel", "else method.for_derivatives()", "else method")
@pytest.mark.slow
def test_steps_end_on_kinks_where_those_of_xla_do():
    """Of a torque that comes to its limits: without, the derivatives would be others."""
    loop = braking(
        plant=plants.MirroredRig(),
        initial=d.BrakeStart(speed=50 / 3.6),
        controller=controllers.StateFeedback(low=0.0, high=9.03),
        feedforward=controllers.HoldingInput(),
    )
    given = {
        kinks: (loop, d.FixedStep(2e-3, 0.2, kinks=kinks), {"iae": IAE()}, "plant.mass") for kinks in (None, False)
    }
    found, known, blunt = (moved(*given[k], e)[0]["iae"] for k, e in ((None, "kernel"), (None, "xla"), (False, "xla")))
    np.testing.assert_allclose(found, known, rtol=0, atol=1e-7 * np.abs(known).max())
    assert np.abs(blunt - known).max() > 1e-5 * np.abs(known).max()


@killed_by(
    "engine.step.replay", "any_lane(after.entry.accepted)", "any_lane(entry.triggered != 0)", case="slip-lmi-adaptive"
)
@pytest.mark.slow
@pytest.mark.parametrize("kind", ["grid", "kinks", "adaptive"])
@pytest.mark.parametrize("name", scenario.names())
def test_a_scenario(name, kind):
    """To its end where steps end on what happens."""
    one = scenario.load(name)
    solver = dataclasses.replace(one.solver, kinks=False, duration=200 * one.solver.step)
    if kind == "kinks":
        solver = one.solver
    if kind == "adaptive":
        solver = d.Adaptive(rtol=0.1 * RTOL, duration=one.solver.duration, step=one.solver.step)
    given = (one.loop, solver, dict(one.objectives), VARIED.get(name, "initial.speed"))
    close = ROUNDED.get(name, EXACT) if kind == "grid" else SWITCHING if name == "slip-cured" else LANDED
    if (name, kind) == ("lab-rig", "adaptive"):
        close = SWITCHING  # noise, by a computer
    values = {"grid": 1e-13, "kinks": 1e-12, "adaptive": SWITCHING if name == "slip-cured" else RTOL}[kind]
    compare(given, close, values, swayed(given) if (name, kind) in BY_ROUNDING else None)
