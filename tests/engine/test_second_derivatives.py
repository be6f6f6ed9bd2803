"""Second derivatives against differences of first ones at three widths: through stops, events, limits and peaks; and an
error where there are none. First derivatives have tests of their own."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from mutants import killed_by

import diffabs as d
from diffabs import actuators, controllers, objectives, plants, references, roads, stops
from diffabs.core.first_order import first_order
from diffabs.core.pytree import get
from diffabs.linear.operating_point import find_root
from diffabs.robust.design.interior.decay_rate import certified_decay

WIDTHS = (1e-3, 3e-4, 1e-4)
METRICS = {
    "stop_time": objectives.StopTime(),
    "stop_distance": objectives.StopDistance(),
    "max_slip": objectives.MaxSlip(),
    "settling_time": objectives.SettlingTime(),
    "iae": objectives.IAE(),
    "effort": objectives.Effort(),
    "variation": objectives.Variation(),
}


def rig(controller, **parts):
    begin = d.BrakeStart(speed=6.0, slip=0.02)
    held = controllers.HoldingInput()
    rest = {"reference": references.FixedSlip(slip=0.15), "stop": stops.SpeedReached(speed=5.0), "feedforward": held}
    return d.Loop(**{**rest, "plant": plants.MirroredRig(), "initial": begin, "controller": controller, **parts})


def car(controller, reference, **parts):
    begin = d.BrakeStart(speed=8.0, slip=0.0)
    plant = plants.QuarterCar(road=roads.MagicFormula(), inertia=0.6)
    rest = {"plant": plant, "initial": begin, "stop": stops.SpeedReached(speed=7.0)}
    return d.Loop(**{**rest, "controller": controller, "reference": reference, **parts})


def feedback(low=-100.0, high=100.0, **fields):
    return controllers.StateFeedback(gain=(-3000.0, -90.0), low=low, high=high, **fields)


RELAY = controllers.Relay(band=0.03, low=5.0, high=140.0)
LOOPS = {
    "a stop": (rig(feedback()), "reference.slip"),
    "limits": (rig(feedback(0.3, 4.0, antiwindup=controllers.Clamping())), "reference.slip"),
    "a relay behind a latch": (car(RELAY, references.PeakLatch(slip=0.25)), "controller.high"),
}


def curvature(loop, path, solver, metrics=METRICS, outer=jax.jacfwd, inner=jax.jacfwd):
    """Of each metric by the logarithms of the plant's mass and of a parameter: the second derivatives, and the
    differences of the first ones at each width."""
    paths = ["plant.mass", path]
    start = jnp.array([float(get(loop, one)) for one in paths])

    def measured(z):
        values = {one: start[i] * jnp.exp(z[i]) for i, one in enumerate(paths)}
        found = d.measure(d.replace(loop, values), solver, metrics).metrics
        return jnp.stack([found[name] for name in metrics])

    gradient = jax.jit(jax.vmap(jax.jacfwd(measured)))
    found = np.asarray(jax.jit(outer(inner(measured)))(jnp.zeros(2)))
    steps = np.array([sign * width * row for width in WIDTHS for row in np.eye(2) for sign in (1, -1)])
    up, down = (
        np.asarray(gradient(jnp.asarray(steps)))
        .reshape(len(WIDTHS), 2, 2, len(metrics), 2)
        .swapaxes(0, 2)[[0, 1]]
        .swapaxes(1, 2)
    )
    return found, np.moveaxis((up - down) / (2 * np.array(WIDTHS)[:, None, None, None]), 1, -1)


@killed_by("engine.step.event_location", "return -rises / jnp", "return 0.0 * rises / jnp", case="a stop")
@pytest.mark.parametrize("name", ["a stop", *(pytest.param(n, marks=pytest.mark.slow) for n in list(LOOPS)[1:])])
@pytest.mark.slow
def test_second_derivatives_are_those_of_differences(name):
    """To 1e-4 of the largest of each metric, or to three times what two widths differ by: a kink may move through a
    step between them."""
    found, differences = curvature(*LOOPS[name], d.FixedStep(2e-4, 1.0))
    scale = np.abs(differences[1]).max((1, 2))
    assert np.all(scale[[0, 1, 4]] > 1e-4)  # time, distance and IAE have second derivatives here
    between = np.abs(differences[1] - differences[2]).max((1, 2))
    off = np.abs(found - differences[1:]).min(0).max((1, 2))
    assert np.all(off <= 1e-4 * scale + 3 * between + 1e-9), dict(
        zip(METRICS, off / np.maximum(scale, 1e-12), strict=True)
    )


@pytest.mark.slow
def test_forward_over_reverse_is_forward_over_forward():
    loop, path = LOOPS["a stop"]
    few = {name: METRICS[name] for name in ("stop_distance", "max_slip")}
    one, _ = curvature(loop, path, d.FixedStep(5e-4, 0.5), few)
    other, _ = curvature(loop, path, d.FixedStep(5e-4, 0.5), few, inner=jax.jacrev)
    np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-12 * np.abs(one).max())


DELAYED = rig(feedback(), actuator=actuators.Delay(time=1e-3, capacity=8))


@pytest.mark.parametrize(
    ("loop", "solver", "line"),
    [
        (
            LOOPS["a stop"][0],
            d.Adaptive(1e-4, 0.5, 1e-3),
            r"adaptive steps have no second derivatives; d\.FixedStep has",
        ),
        pytest.param(
            DELAYED, d.FixedStep(1e-3, 0.01), "with a pure delay have no second derivatives", marks=pytest.mark.slow
        ),
    ],
    ids=["adaptive", "delay"],
)
@pytest.mark.slow
def test_a_run_without_second_derivatives_says_so(loop, solver, line):
    """First derivatives it has."""

    def distance(mass):
        return d.measure(d.replace(loop, {"plant.mass": mass}), solver, {"d": objectives.StopDistance()}).metrics["d"]

    with pytest.raises(ValueError, match=line):
        jax.eval_shape(jax.hessian(distance), 5.5)
    assert jax.eval_shape(jax.grad(distance), 5.5).shape == ()


@jax.custom_jvp
def cube(x):
    return x**3


@cube.defjvp
def _slope_of_cube(at, moves):
    return at[0] ** 3, first_order(3 * at[0] ** 2 * first_order(moves[0], "no"), "no")


class TestFirstOrder:
    def test_first_derivatives_pass_in_every_mode(self):
        x = jnp.array([2.0, 3.0])
        for mode in (jax.jacfwd, jax.jacrev):
            np.testing.assert_array_equal(jax.jit(mode(cube))(x), np.diag(3 * np.asarray(x) ** 2))
        np.testing.assert_array_equal(jax.vmap(jax.grad(cube))(x), 3 * np.asarray(x) ** 2)

    @pytest.mark.parametrize("outer", [jax.jacfwd, jax.jacrev])
    @pytest.mark.parametrize("inner", [jax.jacfwd, jax.jacrev])
    def test_second_ones_do_not(self, inner, outer):
        with pytest.raises(ValueError, match="no"):
            jax.jit(outer(inner(cube)))(2.0)


@pytest.mark.slow
def test_the_certified_decay_has_first_derivatives_only():
    A, B = jnp.array([[[0.0, 1.0], [0.0, 0.0]]]), jnp.array([[[0.0], [1.0]]])

    def rate(gain):
        return certified_decay(gain, A, B)

    with pytest.raises(ValueError, match="has no second derivatives"):
        jax.eval_shape(jax.hessian(rate), jnp.array([[-2.0, -2.0]]))


@pytest.mark.slow
@killed_by("parts.roads.optimum", "s0 - _newton_step(residual(s0), rate)", "s0")
def test_a_road_peak_has_closed_form_second_derivatives():
    """mu = s exp(-(a s)^2): the peak is at 1/(sqrt(2) a), its height exp(-1/2)/(sqrt(2) a)."""

    class Hump:
        def __init__(self, a):
            self.a = a

        def friction(self, slip, speed=0.0, distance=0.0):
            return slip * jnp.exp(-((self.a * slip) ** 2))

    for part, factor in (("slip", 0.5**0.5), ("mu", 0.5**0.5 * np.exp(-0.5))):
        found = jax.jacfwd(jax.jacfwd(lambda a, part=part: getattr(roads.peak(Hump(a)), part)))(5.0)
        assert found == pytest.approx(factor * 2 / 5.0**3, rel=1e-6)


@pytest.mark.slow
def test_a_rest_has_the_second_derivatives_of_its_closed_form():
    """x^3 = p has x'' = -2/9 p^(-5/3)."""
    found = jax.jacfwd(jax.jacfwd(lambda p: find_root(lambda x: x**3 - p, jnp.array([1.5]))[0]))(3.0)
    assert found == pytest.approx(-2 / 9 * 3.0 ** (-5 / 3), rel=1e-9)
