"""What every part must satisfy, run over tests/support/parts.py."""

import dataclasses
import inspect
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import parts
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from jax.flatten_util import ravel_pytree
from marks import cases
from mutants import killed_by
from parts import BLOCKS, PARTS, PLANTS, ROADS, WITH_CHANNELS, differences, jacobian, leaves, struct, value

from diffabs.core import protocols
from diffabs.core.protocols import BrakeOutput, Clock, Memory, Tracking
from diffabs.core.pytree import canonical_dtypes, get, parameters, replace
from diffabs.core.validity import check_part
from diffabs.parts.plants import BrakeStart

EVERY = [
    pytest.param(family, part, id=f"{family}: {name}")
    for family_parts in (PARTS, WITH_CHANNELS)
    for family in family_parts
    for name, part in family_parts[family].items()
]
# of the families that have no Protocol
SIGNATURES = {"initial": {}, "antiwindup": {"rate": ["self", "error", "gain", "raw", "limited"]}}


def signatures(family):
    if family in SIGNATURES:
        return SIGNATURES[family]
    protocol = getattr(protocols, family.capitalize(), protocols.Block)  # of sensors, controllers and actuators
    methods = inspect.getmembers(protocol, inspect.isfunction)
    return {n: list(inspect.signature(f).parameters) for n, f in methods if not n.startswith("_")}


# Every part


@killed_by(
    "parts.roads.__init__",
    "from diffabs.parts.roads.tabulated import Tabulated as Tabulated\n",
    "from diffabs.parts.roads.tabulated import PiecewiseCubic as PiecewiseCubic, Tabulated as Tabulated\n",
)
def test_every_exported_part_has_an_instance():
    """The list above the tests is the test's reach: a part missing from it would be tested by nothing."""
    exported = {c for module in parts.FAMILIES for c in vars(module).values() if dataclasses.is_dataclass(c)}
    exported = {c.__name__ for c in exported if isinstance(c, type)}
    assert len(exported) > 40
    assert exported - {type(p).__name__ for each in EVERY for p in parts.inside(each.values[1])} == set()


@pytest.mark.parametrize(("family", "part"), EVERY)
def test_contract(family, part):
    """The methods of its Protocol, with the Protocol's argument names, and a docstring that a person wrote."""
    for method, names in signatures(family).items():
        assert list(inspect.signature(getattr(type(part), method)).parameters) == names
    doc = type(part).__doc__
    assert doc
    assert not doc.startswith(f"{type(part).__name__}(")  # what `dataclass` writes in place of none


@pytest.mark.parametrize(("family", "part"), EVERY)
def test_leaves(family, part):
    """Floats that survive flattening, vmap and copying, one for each declared parameter."""
    before = leaves(part)
    assert all(np.issubdtype(x.dtype, np.floating) for x in before)
    assert len(before) == len(list(parameters(part)))
    flat, tree = jax.tree.flatten(part)
    twice = jax.tree.map(lambda x: np.stack([x, x]), part)
    copies = [
        jax.tree.unflatten(tree, flat),
        dataclasses.replace(part),
        *([jax.tree.map(lambda x: x[1], jax.vmap(lambda p: p)(twice))] if before else []),
    ]
    for copy in copies:
        assert type(copy) is type(part)
        for a, b in zip(leaves(copy), before, strict=True):
            np.testing.assert_allclose(a, b, rtol=0, atol=0)


@pytest.mark.parametrize(("family", "part"), EVERY)
def test_ranges(family, part):
    """Good as it is; NaN and either side of each range are refused, by path, range and unit."""
    assert check_part(part) is part
    for path, spec, old in parameters(part):
        assert spec.unit
        assert spec.low < spec.high
        bad = [np.nan] if spec.infinite else [np.nan, np.inf, -np.inf]
        bad += [spec.low - (0 if spec.open_low else 1e-3)] if np.isfinite(spec.low) else []
        bad += [spec.high + (0 if spec.open_high else 1e-3)] if np.isfinite(spec.high) else []
        for x in bad:
            new = replace(part, {path: np.where(np.arange(np.size(old)).reshape(np.shape(old)) == 0, x, old)})
            with pytest.raises(ValueError, match="is outside") as error:
                check_part(new)
            assert str(error.value).startswith(f"{path} = ")
            assert str(error.value).endswith(f"is outside {spec.interval()}")


@pytest.mark.parametrize(("family", "part"), EVERY)
def test_replace_changes_one_parameter(family, part):
    paths = [path for path, _, _ in parameters(part)]
    for path in paths:
        new = replace(part, {path: np.full(np.shape(get(part, path)), 1.25)})
        assert np.all(np.asarray(get(new, path)) == 1.25)
        for other in set(paths) - {path}:
            np.testing.assert_allclose(get(new, other), get(part, other), rtol=0, atol=0)


@killed_by(
    "core.pytree",
    "return structure.unflatten([as_array(x, dtype) for x in leaves])",
    "return tree",
    case="plant: quarter car",
)
@pytest.mark.parametrize(("family", "part"), EVERY)
def test_new_values_do_not_compile_again(family, part):
    """Whether they come as Python floats, NumPy arrays or JAX scalars; and jit gives back what it was given."""
    identity = jax.jit(lambda p: p)
    same, other = (
        identity(canonical_dtypes(part)),
        identity(canonical_dtypes(jax.tree.map(lambda x: jnp.asarray(1.5 * x), part))),
    )
    assert identity._cache_size() == 1
    assert type(same) is type(part)
    for a, b, before in zip(leaves(same), leaves(other), leaves(part), strict=True):
        np.testing.assert_allclose(a, before, rtol=0, atol=0)
        np.testing.assert_allclose(b, 1.5 * before, rtol=0, atol=0)


# Roads


@jax.jit
def road_slopes(road, slip, speed, distance):
    """mu and its derivatives in the road, slip, speed and distance; in reverse mode, the blocks below in forward."""
    mu = jax.value_and_grad(lambda *a: a[0].friction(*a[1:]), (0, 1, 2, 3))
    return jax.vmap(mu, (None, 0, 0, 0))(road, slip, speed, distance)


@killed_by("core.numerics", "return s * curve(s * x)", "return curve(s * x)", case="SNOW")
@killed_by("core.numerics", "jnp.log(jnp.where(nonzero, square, 1.0))", "jnp.log(square)", case="RIG")
@pytest.mark.parametrize("name", cases(ROADS, "SPLINE_B", "patches, three", "scaled along, once"))
def test_road(name):
    """mu(0) = 0, odd, bounded, C1 at 0, and finite with its derivatives where curves are in danger of not being."""
    road = canonical_dtypes(ROADS[name])
    grid = np.linspace(0.0, 1.0, 501)
    constant = np.full_like(grid, 10.0)
    mu, _ = road_slopes(road, grid, constant, constant)
    best = grid[np.argmax(mu)]
    assert mu[0] == 0
    assert np.max(np.abs(mu)) < 1.3
    np.testing.assert_allclose(road_slopes(road, -grid, constant, constant)[0], -mu, rtol=1e-15, atol=0)
    corners = np.meshgrid([-1.0, -best, 0.0, 1e-12, best, 1.0], [0.0, 40.0], [0.0, 9.95, 10.0, 10.05])
    corners = [np.resize(c.ravel(), grid.shape) for c in corners]  # the shape that is compiled
    assert all(np.all(np.isfinite(x)) for x in leaves(road_slopes(road, *corners)))
    # mu(0) = 0, so a quotient at 1e-9 has only the error of the curvature: c2/2 = 153 times 1e-9 for ice
    tiny = np.resize([1e-9, -1e-9, 0.0], grid.shape)
    mu, (_, slope, _, _) = road_slopes(road, tiny, constant, constant)
    np.testing.assert_allclose(mu[:2] / tiny[:2], slope[2], rtol=1e-6, atol=1e-6)


def road_at_points(arguments):
    road, point = arguments
    return jax.vmap(lambda s, v, x: road.friction(s + point[0], v + point[1], x + point[2]))(
        jnp.array([0.031, 0.117, 0.48, 0.93, -0.27]), jnp.array([25.0, 9.0, 0.5, 13.0, 30.0]), jnp.full(5, 9.98)
    )


@pytest.mark.parametrize("name", cases(ROADS, *set(ROADS) - {"DRY_ASPHALT", "RIG", "patches", "tabulated"}))
def test_road_gradient(name):
    """In every parameter, slip, speed and distance. A step of 3e-6 leaves 1e-7 of the gradient in slip (third
    derivative 306^2 times the first) and a rounding of 1e-10."""
    point = (ROADS[name], jnp.zeros(3))
    exact, differenced = jacobian(road_at_points, point), differences(road_at_points, point, 3e-6)
    np.testing.assert_allclose(exact, differenced, rtol=1e-6, atol=1e-9)


# Plants


def plant_at(arguments):
    plant, state, control = arguments
    return plant.derivative(0.0, state, control), plant.output(state)


plant_at_jit = jax.jit(plant_at)


def plant_states(plant, speeds, slips):
    return [plant.start(BrakeStart(speed=float(v), slip=float(s))) for v, s in zip(speeds, slips, strict=True)]


@pytest.mark.parametrize("name", PLANTS)
@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_plant_keeps_the_structure_of_its_state(name, dtype):
    plant, initial, control = struct((PLANTS[name], BrakeStart(), 1.0), dtype)
    state = jax.eval_shape(lambda p, i: p.start(i), plant, initial)
    assert struct(state, dtype) == struct(state)
    rate, y = jax.eval_shape(plant_at, (plant, state, control))
    assert struct(rate) == struct(state)
    assert struct(y) == BrakeOutput(*[control] * 5)
    assert struct(jax.eval_shape(lambda p, x: p.project(x), plant, state)) == struct(state)
    assert struct(jax.eval_shape(lambda p, y, s: p.holding(y, s), plant, y, control)) == control


@killed_by(
    "parts.plants.mirrored_rig",
    "wheel = quotient(push * self.wheel_radius - control, self.wheel_inertia)",
    'wheel = (__import__("jax").lax.stop_gradient(push) * self.wheel_radius - control) / self.wheel_inertia',
    case="mirrored rig",
)
@pytest.mark.parametrize("name", cases(PLANTS, *set(PLANTS) - {"quarter car", "mirrored rig"}))
def test_plant_jacobian(name):
    """In parameters, state and control, at seeded states, against differences; speeds of 20, rates of 100."""
    plant = PLANTS[name]
    rng = np.random.default_rng(11)
    for state in plant_states(plant, rng.uniform(2, 40, 3), rng.uniform(0.01, 0.9, 3)):
        arguments = (plant, state._replace(distance=9.98), 0.7)
        exact, differenced = jacobian(plant_at, arguments), differences(plant_at, arguments, 1e-6)
        np.testing.assert_allclose(exact, differenced, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("name", PLANTS)
def test_plant_corners(name):
    """Rates and derivatives are finite at standstill, locked, driven, and with a wheel that spins on the spot."""
    plant = PLANTS[name]
    start = plant.start(BrakeStart())
    wheel, car = ("spin", "speed") if "spin" in start._fields else start._fields[:2]
    for v, w in ((0.0, 0.0), (0.0, 5.0), (5.0, 0.0), (5.0, 80.0), (1e-9, 1e-9), (1e-3, 0.0)):
        state = start._replace(**{wheel: w, car: v})
        for control in (0.0, 50.0):
            assert np.all(np.isfinite(value(plant_at, (plant, state, control))))
            assert np.all(np.isfinite(jacobian(plant_at, (plant, state, control))))
        once = plant.project(state)
        assert plant.project(once) == once


@pytest.mark.parametrize("name", PLANTS)
def test_plant_in_float32(name):
    """Slip is a difference of speeds, good to 2^-24 of them; the friction multiplies that by its slope, at most
    c1 c2 ~ 60 for these roads. So rates are good to 60 2^-24 ~ 4e-6 of their scale, and some for the products."""
    rng = np.random.default_rng(11)
    for state in plant_states(PLANTS[name], rng.uniform(2, 40, 3), rng.uniform(0.01, 0.9, 3)):
        arguments = canonical_dtypes((PLANTS[name], state, 0.7))
        exact, rounded = value(plant_at, arguments), plant_at_jit(jax.tree.map(jnp.float32, arguments))
        assert {x.dtype for x in jax.tree.leaves(rounded)} == {jnp.dtype("float32")}
        np.testing.assert_allclose(ravel_pytree(rounded)[0], exact, rtol=1e-5, atol=1e-5 * np.max(np.abs(exact)))


# Blocks: sensors, references, controllers, actuators

GRADIENTS_IN_FAST_TESTS = (
    *("controller: pid", "controller: state feedback, limited", "controller: relay", "controller: sampled pid"),
    *("reference: filtered", "actuator: lag", "sensor: bias"),
)


def every_block(fast=None):
    """Every block as a case. Where some are named fast, the others run at night: together they compile for long."""
    blocks = {": ".join(key): (*key, block) for key, block in BLOCKS.items()}
    return [
        pytest.param(*block, id=name, marks=pytest.mark.slow if fast and name not in fast else ())
        for name, block in blocks.items()
    ]


@pytest.mark.parametrize("dtype", cases([jnp.float32, jnp.float64], jnp.float64))
@pytest.mark.parametrize(("family", "name", "block"), every_block())
def test_block_keeps_the_structure_of_its_memory(family, name, block, dtype):
    """Else a scan over it fails, obscurely."""
    block, signal, t = struct((block, parts.signal_at(family, block, 0.0), 0.0), dtype)
    memory = jax.eval_shape(lambda b, s: b.start(s), block, signal)
    assert struct(memory, dtype) == struct(memory)
    assert struct(jax.eval_shape(lambda b, m, s, t: b.flow(t, m, s), block, memory, signal, t)) == struct(memory.flow)
    after, margins = jax.eval_shape(
        lambda b, m, s, t, k: parts.at_instant(b, Clock(t, t, k, jax.random.key(7)), m, s, s, None),
        *(block, memory, signal, t, struct(1)),
    )
    assert struct(after) == struct(memory)
    assert all(struct(margin) == t for margin in margins)
    output = jax.eval_shape(lambda b, m, s, t: b.output(t, m, s), block, memory, signal, t)
    assert struct(output) == (signal if family == "sensor" else t)
    if family == "reference":
        assert struct(jax.eval_shape(lambda b, m: b.setpoint(m), block, memory)) == t


@pytest.mark.parametrize(("family", "name", "block"), every_block(GRADIENTS_IN_FAST_TESTS))
def test_block_gradient(family, name, block):
    """Finite in every parameter; in those declared tunable, that of differences, which are good to 1e-12 from curvature
    and 1e-10 from rounding, times the size of a derivative."""
    run = parts.RUNS[family]
    exact, differenced = jacobian(run, block), differences(run, block, 1e-6)
    assert np.all(np.isfinite(exact))
    tunable = np.array([spec.tunable for _, spec, x in parameters(block) for _ in range(np.size(x))], bool)
    scale = 1 + np.max(np.abs(exact), axis=1, keepdims=True, initial=0)
    np.testing.assert_allclose((exact / scale)[tunable], (differenced / scale)[tunable], rtol=1e-6, atol=1e-7)


LIMITED = [(family, name) for (family, name), block in BLOCKS.items() if hasattr(block, "low")]
finite = st.floats(-1e12, 1e12)  # above, the terms of a sum can overflow against each other


@partial(jax.jit, static_argnums=0)
def output_for(family, block, slip, target, feedforward, flow):
    tracking = Tracking(target, parts.output_at(0.0 * slip)._replace(slip=slip), feedforward)
    signal = slip if family == "actuator" else tracking
    memory = block.start(signal)
    return block.output(0.0, Memory(jax.tree.map(lambda x: x + flow, memory.flow), memory.held), signal)


@pytest.mark.parametrize(("family", "name"), LIMITED)
@given(st.tuples(finite, finite, finite, finite))
@settings(deadline=None, max_examples=40, derandomize=True)
def test_block_output_stays_within_its_limits(family, name, numbers):
    block = canonical_dtypes(BLOCKS[family, name])
    assert block.low <= output_for(family, block, *numbers) <= block.high


# Objectives

objective_value = jax.jit(parts.objective_run, static_argnames="sample_at")  # without the derivatives of `value`


@pytest.mark.parametrize("name", PARTS["objective"])
def test_objective(name):
    """Against the integrals by hand; RK4 and the cubics of the steps leave 1e-9."""
    objective = PARTS["objective"][name]
    found = objective_value(canonical_dtypes(objective))
    np.testing.assert_allclose(found, parts.VALUES[name], rtol=1e-8, atol=1e-9)


FAST_OBJECTIVES = {"iae", "stop_distance", "time between speeds"}


@pytest.mark.parametrize("name", cases(PARTS["objective"], *set(PARTS["objective"]) - FAST_OBJECTIVES))
def test_objective_gradient(name):
    objective = PARTS["objective"][name]
    exact, differenced = jacobian(parts.objective_run, objective), differences(parts.objective_run, objective)
    np.testing.assert_allclose(exact, differenced, rtol=1e-5, atol=1e-8)


@killed_by("parts.objectives.tracking", "jnp.abs(whole))", "whole)", case="iae")
@pytest.mark.parametrize("name", ["iae", "itae", "final_slip_error", "settling_time", "quadratic"])
def test_errors_count_on_either_side(name):
    found = objective_value(canonical_dtypes(PARTS["objective"][name]), sample_at=parts.mirrored_at)
    np.testing.assert_allclose(found, parts.VALUES[name], rtol=1e-8, atol=1e-9)
