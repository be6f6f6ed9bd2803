"""Some random loops of `gradients_random.py`, and what its judgement sees; 200 loops by hand and nightly."""

import jax
import numpy as np
import pytest
import random_loops
from gradients_random import WIDTHS, Found, Program, judge, line, offenders, studied
from parts import inside

from diffabs import actuators, controllers, plants, references, roads, sensors
from diffabs.core.validity import check_part

COUNTS = dict.fromkeys(random_loops.STRUCTURES, 3) | {"relay, latch, lag": 6}  # loops of a structure
# Parts whose derivative says nothing of their jumps, as they document; and one of `test_gradients`.
LEFT_OUT = {"Quantisation", "PeakLiteral", "Cascade"}


@pytest.mark.slow
@pytest.mark.parametrize("name", COUNTS)
def test_gradients_are_those_of_wide_differences(name):
    founds = studied(name, range(COUNTS[name]), seed=1, told=False)
    assert all(found.ended for found in founds)
    wrong = offenders(founds)
    assert not wrong, "\n".join(line(row) for row in wrong)
    compared = sum(judge(found).agree.sum() for found in founds)
    assert compared > 0.5 * sum(found.gradient.size for found in founds)


@pytest.mark.slow
def test_adaptive_gradients_are_wide_differences():
    wrong = offenders(studied("rig, limited, clamped", range(3), seed=1, told=False, rtol=1e-6))
    assert not wrong, "\n".join(line(row) for row in wrong)


@pytest.mark.parametrize("name", random_loops.STRUCTURES)
def test_random_loops_are_allowed(name):
    for number in range(20):
        check_part(random_loops.drawn(name, number, 0))


@pytest.mark.slow
@pytest.mark.parametrize("name", random_loops.CHANNELS)
def test_engines_and_modes_agree_on_loops_of_channels(name, monkeypatch):
    found = {}
    for engine in ("xla", "kernel"):
        monkeypatch.setenv("DIFFABS_ENGINE", engine)
        found[engine] = Program(name).along(0, 5)
    np.testing.assert_allclose(found["kernel"], found["xla"], rtol=1e-9)
    for _, forward, reverse in found.values():
        np.testing.assert_allclose(reverse, forward, rtol=1e-9)


# Of scenarios with several inputs: test_channels.py, test_half_car.py and test_car.py compare their derivatives.
# Parts of a car: test_threshold_logic.py, test_brake_distribution.py, test_car.py and the tests of sensors and
# actuators differentiate them.
OF_A_CAR = {"BrakeDistribution", "FivePhase", "HoldCourse", "HydraulicBrake", "OutputError", "SelectHigh"}
ONE_PLANT = {
    "QuadrupleTank",
    "TankStart",
    "HalfCar",
    "Car",
    "RoadTyre",
    "PacejkaTyre",
    "RelaxedTyre",
    "ConstantPads",
    "FadingPads",
} | OF_A_CAR


def test_random_loops_have_every_part():
    used = {type(part).__name__ for name in random_loops.STRUCTURES for part in inside(random_loops.drawn(name, 0, 0))}
    families = (plants, roads, controllers, references, actuators, sensors)
    offered = {
        type(part).__name__ if not isinstance(part, type) else part.__name__
        for family in families
        for part in vars(family).values()
        if hasattr(part, "__dataclass_fields__")
    }
    assert offered - used == LEFT_OUT | ONE_PLANT


def found(function, gradient, at=1.0):
    """A study of one entry: a function of one number."""
    sides = [[[[function(at + sign * width)]] for sign in (1, -1)] for width in WIDTHS]
    names = (["objective"], ["number"])
    value = np.array([function(at)])
    return Found("", 0, *names, value, np.array([[gradient]]), np.array(sides), True, value, value)


JUDGED = {
    "right": (lambda x: x**3, 3.0, "right"),
    "wrong": (lambda x: x**3, 3.01, "wrong"),
    "not a number": (lambda x: x**3, np.nan, "wrong"),
    "small beside the objective": (lambda x: 1e3 + 1e-4 * x, 2e-4, "right"),
    "zero where it is not": (lambda x: x, 0.0, "wrong"),
    "not zero where it is": (lambda x: 1.0, 0.01, "wrong"),
    "kink": (lambda x: max(x - 1.0, 0.0), 0.5, "kink"),
    "kink on which central differences agree": (lambda x: abs(x - 1.0) + x, 1.0, "kink"),
    "jump": (lambda x: x + (x > 1.0), 1.0, "kink"),
    "jump nearby": (lambda x: x + (x > 1.005), 1.0, "nearby"),
    "kink nearby": (lambda x: x + 10 * max(x - 1.005, 0.0), 1.0, "nearby"),
    "curved": (lambda x: np.sin(20 * x), 20 * np.cos(20.0), "curved"),
    "grid": (lambda x: x + 3e-3 * np.sin(1e4 * x), 1.0, "scatter"),
    "no run": (lambda x: x if x < 1.005 else np.nan, 1.0, "diverged"),
}


@pytest.mark.parametrize("name", JUDGED)
def test_what_is_said_of_an_entry(name):
    function, gradient, expected = JUDGED[name]
    v = judge(found(function, gradient))
    said = "wrong" if v.wrong[0, 0] else "right" if v.agree[0, 0] else v.kind[0, 0]
    assert said == expected


def test_a_gradient_is_known_where_the_widths_do_not_agree():
    for function, slope in ((JUDGED["curved"][0], 20 * np.cos(20.0)), (JUDGED["jump nearby"][0], 1.0)):
        assert judge(found(function, slope)).known[0, 0]
        assert not judge(found(function, 1.1 * slope)).known[0, 0]


def test_a_loop_of_a_seed_is_always_the_same():
    a, b, c = (jax.tree.leaves(random_loops.drawn("relay", number, 0)) for number in (4, 4, 5))
    assert all(np.array_equal(x, y) for x, y in zip(a, b, strict=True))
    assert not all(np.array_equal(x, y) for x, y in zip(a, c, strict=True))
