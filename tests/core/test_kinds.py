"""What is no number of a run is refused by `check` and by every run, with its field and value. What is one is used
as it is: nothing is taken for something else in silence."""

import decimal
import fractions
import re
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from mutants import killed_by

import diffabs as d
from diffabs import controllers, objectives, plants, roads, stops
from diffabs.core.pytree import canonical_dtypes
from diffabs.core.validity import check_part
from diffabs.scenario.defaults import braking

SOLVER = d.FixedStep(1e-3, 0.25)
RIG = braking(
    plant=plants.MirroredRig(),
    initial=d.BrakeStart(speed=30 / 3.6),
    stop=stops.SpeedReached(speed=29 / 3.6),
    controller=controllers.StateFeedback(low=0.0),
    feedforward=controllers.HoldingInput(),
)
MEASURED = {"iae": objectives.IAE()}


def iae(loop, solver=SOLVER, measured=MEASURED):
    return d.measure(loop, solver, measured).metrics["iae"]


KINDS = {
    "text": ("5.3", "plant.mass = '5.3' is text; a number in (0, inf) kg is needed"),
    "bytes": (b"5.3", "plant.mass = b'5.3' is text;"),
    "text of NumPy": (np.array("5.3"), "plant.mass = 5.3 is text;"),
    "nothing": (None, "plant.mass = None is of type NoneType;"),
    "complex": (5.3 + 1j, "plant.mass = (5.3+1j) is complex;"),
    "complex of NumPy": (np.array(5.3 + 1j), "plant.mass = (5.3+1j) is complex;"),
    "complex of JAX": (jnp.array(5.3 + 1j), "plant.mass = (5.3+1j) is complex;"),
    "truth": (True, "plant.mass = True is a truth value;"),
    "truth of JAX": (jnp.array(True), "plant.mass = True is a truth value;"),
    "bfloat16": (jnp.bfloat16(5.3), "is of type bfloat16, a float of fewer than 32 bits;"),
    "float16": (jnp.array(5.3, jnp.float16), "is of type float16, a float of fewer than 32 bits;"),
    "float16 of NumPy": (np.float16(5.3), "is of type float16, a float of fewer than 32 bits;"),
    "float8": (jnp.array(5.3, jnp.float8_e4m3fn), "is of type float8_e4m3fn, a float of fewer than 32 bits;"),
    "object": (np.array(5.3, dtype=object), "plant.mass = 5.3 is of type object;"),
    "decimal": (decimal.Decimal("5.3"), "is of type Decimal;"),
    "time": (np.timedelta64(5, "s"), "is of type timedelta64[s];"),
    "key": (jax.random.key(3), "is of type key<fry>;"),
    "part": (plants.QuarterCar(), "is of type QuarterCar;"),
    "huge": (10**400, "is too large;"),
    "text in a list": (["5.3"], "plant.mass = ['5.3'] is text;"),
}


@pytest.mark.parametrize("kind", KINDS)
def test_what_is_no_number_is_refused_by_name(kind):
    value, message = KINDS[kind]
    loop = d.replace(RIG, {"plant.mass": value})
    for use in (check_part, iae):
        with pytest.raises(ValueError, match=re.escape(message)):
            use(loop)
    if kind not in ("nothing", "part", "text in a list"):  # which are no leaf, or other leaves
        with pytest.raises(ValueError, match=re.escape(message.partition(";")[0])):
            canonical_dtypes(loop)


@pytest.mark.parametrize(
    "value", [5, np.int32(5), jnp.array(5), np.float32(5.0), np.longdouble(5), fractions.Fraction(5)]
)
def test_every_kind_of_number_is_that_number(value):
    """In double precision; a JAX array of single precision asks for a run in it."""
    found = iae(check_part(d.replace(RIG, {"plant.mass": value})))
    assert found == iae(d.replace(RIG, {"plant.mass": 5.0}))
    assert found.dtype == jnp.float64


def test_a_list_is_an_array():
    listed, tupled = (iae(d.replace(RIG, {"controller.gain": kind([-9e3, -40.0])})) for kind in (list, tuple))
    assert listed == tupled == iae(d.replace(RIG, {"controller.gain": np.array([-9e3, -40.0])}))


@killed_by("core.validity", "spec.shape in (None, shape)", "True")
@pytest.mark.parametrize(
    ("path", "value", "message"),
    [
        ("controller.gain", np.array([-9e3, -40.0, 5.0]), "has shape (3,); it needs (2,)"),
        (
            "controller.gain",
            [-9e3, -40.0, 5.0],
            "controller.gain = [-9000.0, -40.0, 5.0] has shape (3,); it needs (2,)",
        ),
        ("controller.gain", np.array([-9e3]), "controller.gain = [-9000.] has shape (1,); it needs (2,)"),
        ("controller.gain", -9e3, "controller.gain = -9000.0 has shape (); it needs (2,)"),
        ("controller.gain", np.ones((2, 2)), "has shape (2, 2); it needs (2,)"),
        ("plant.mass", np.array([5.3, 6.2]), "plant.mass = [5.3 6.2] has shape (2,); it needs ()"),
        ("plant.road", roads.Patches(edges=np.array([1.0, 2.0])), "edges has shape (2,); 2 roads need (1,)"),
        ("plant.road", roads.Tabulated(mu=np.array([0.0, 1.0])), "slip and mu have shapes (17,) and (2,)"),
        (
            "controller",
            controllers.ScheduledFeedback(gains=np.array([-50.0, -60.0, -70.0])),
            "speeds, integral_gains and gains have shapes (2,), (2,), (3,)",
        ),
    ],
)
def test_wrong_shapes_are_refused_under_transformations_too(path, value, message):
    loop = d.replace(RIG, {path: value})
    with pytest.raises(ValueError, match=re.escape(message)):
        iae(loop)
    traced = message.rpartition("has shape")[2]  # a traced value has no digits
    with pytest.raises(ValueError, match=re.escape(traced)):
        jax.jit(lambda speed: iae(d.replace(loop, {"initial.speed": speed})))(30 / 3.6)
    batch = jax.tree.map(lambda x: jnp.stack([jnp.asarray(x)] * 2), loop, is_leaf=lambda x: isinstance(x, list))
    with pytest.raises(ValueError, match=re.escape(traced)):
        jax.vmap(iae)(batch)


def test_objectives_are_looked_at_too():
    for measured, message in (
        ({"cost": objectives.QuadraticCost(q=np.ones(3))}, "objectives.cost.q = [1. 1. 1.] has shape (3,)"),
        ({"rest": objectives.SettlingTime(band="0.01")}, "objectives.rest.band = '0.01' is text"),
    ):
        with pytest.raises(ValueError, match=re.escape(message)):
            iae(RIG, measured=measured)


@pytest.mark.parametrize(
    ("solver", "message"),
    [
        (d.FixedStep(1.0, 0.5), "solver.step = 1 s is outside (0, 0.5] s: longer than solver.duration = 0.5 s"),
        (d.FixedStep("1e-3", 0.5), "solver.step = '1e-3' is text"),
        (d.FixedStep(1e-3, None), "solver.duration = None is of type NoneType"),
        (d.FixedStep(True, 2.0), "solver.step = True is a truth value"),
        (d.FixedStep(np.array([1e-3]), 2.0), "solver.step = [0.001] has shape (1,)"),
        (d.FixedStep(1e-3, 0.5, 1.5), "solver.every = 1.5 is no whole number"),
        (d.FixedStep(1e-3, 0.5, True), "solver.every = True is a truth value"),
        (d.FixedStep(1e-3, 0.5, 0), "solver.every = 0 is not positive and finite"),
        (d.FixedStep(-1e-3, 0.5), "solver.step = -0.001 is not positive and finite"),
        (d.FixedStep(1e-3, float("nan")), "solver.duration = nan is not positive and finite"),
        (d.FixedStep(0.0, 0.5), "solver.step = 0.0 is not positive and finite"),
        (d.FixedStep(1e-9, 0.5), "solver.step = 1e-09 s is outside [5e-09, 0.5] s: too many steps"),
        (d.Adaptive(-1.0), "solver.rtol = -1.0 is not positive and finite"),
        (d.Adaptive(50.0), "solver.rtol = 50.0 is outside (0, 1)"),
        ((1e-3, 0.5), "solver = (0.001, 0.5) is no solver; d.FixedStep(step=..., duration=...) or d.Adaptive(rtol="),
    ],
)
@killed_by("engine.solvers", "if not 0 < value < math.inf:", "if False:")
@killed_by("engine.solvers", '"rtol" and value >= 1', '"rtol" and value >= 99')
def test_a_solver_that_no_run_can_have(solver, message):
    """A run, a check of one loop, and a check of a batch say the same."""
    batch = d.Batch({"plant.mass": [5.3]})
    for use in (lambda: iae(RIG, solver), lambda: d.check(RIG, solver), lambda: batch.check(RIG, solver)):
        with pytest.raises(ValueError, match=re.escape(message)):
            use()


def test_a_solver_of_traced_numbers_is_named():
    with pytest.raises(ValueError, match=r"solver.rtol is traced; a number that is known before the trace is needed"):
        jax.jit(lambda rtol: iae(RIG, d.Adaptive(rtol, 0.25)))(1e-5)


def test_one_step_may_be_the_whole_run():
    assert np.isfinite(iae(RIG, d.FixedStep(1e-3, 1e-3)))


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"plant.mass": np.array(["5.3", "6.2"])}, "plant.mass = ['5.3' '6.2'] is text"),
        ({"plant.mass": np.array([5.3, 6.2], np.float16)}, "float16"),
        ({"plant.mass": np.ones((2, 2))}, "plant.mass = [1. 1.] has shape (2,); it needs ()"),
        ({"controller.gain": np.ones((2, 3))}, "has shape (3,); it needs (2,)"),
    ],
)
def test_lanes_are_looked_at(values, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        d.run_batch(RIG, d.Batch(values), SOLVER, MEASURED)


@pytest.mark.slow
def test_arrays_of_double_precision_where_single_is_the_default():
    """NumPy's and Python's numbers are of the default precision; an array of JAX says which one is meant."""
    double = jnp.array(5.3)
    with jax.enable_x64(False), warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        assert iae(d.replace(RIG, {"plant.mass": np.float64(5.3)})).dtype == jnp.float32
        # Other warnings, such as those of files that the garbage collector closes, may come at any time.
        assert not any("truncated" in str(line.message) for line in told)
        found = iae(d.replace(RIG, {"plant.mass": double}))
    assert found.dtype == jnp.float64 or any("truncated to dtype float32" in str(line.message) for line in told)


def test_a_number_is_no_objective():
    with pytest.raises(ValueError, match=r"objectives\.x = 1\.0 is no objective: it needs start, flow, update, value$"):
        d.rollout(d.braking(), d.FixedStep(1e-3, 1.0), {"x": 1.0})
