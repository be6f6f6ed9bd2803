"""Proofs of shipped scenarios: near the worst margins found, verified by the checker, and refuted where they are wrong.

Behind a delay |S| has a peak above 1, so a false claim exists for each loop.
"""

import dataclasses
import json
import math
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
import pytest
from mutants import killed_by
from test_proved_sensitivity import LAG_PEAK, Proportional, ThirdOrder, loop_of

import diffabs as d
from diffabs.core.blocks import Series
from diffabs.core.numerics import searchsorted
from diffabs.core.pytree import param, pytree
from diffabs.linear import margins, open_loop
from diffabs.parts.actuators import Delay
from diffabs.parts.controllers import PID
from diffabs.robust.frequency import FrequencyClaim, prove_sensitivity
from diffabs.robust.frequency.certificate import frequency_document, verify_frequency
from diffabs.robust.frequency.opened import derive_opened
from diffabs.robust.frequency.sensitivity import prove_claim
from diffabs.scenario.scenario import load


class Case(NamedTuple):
    """A scenario behind a delay [s], a range of one parameter, and frequencies around the peak [rad/s]."""

    scenario: str
    path: str
    low: float
    high: float
    delay: float
    frequencies: tuple[float, float]


CASES = {
    "a table in the road": Case("slip-estimator", "initial.speed", 8.0, 13.0, 0.006, (10.0, 1000.0)),
    "a limit without end": Case("arm-hanging", "plant.rider_mass", 49.9, 50.1, 0.05, (1.0, 100.0)),
    "a plant with a brake of its own": Case("lab-rig", "initial.speed", 8.0, 13.0, 0.005, (1.0, 100.0)),
    "two controls": Case("quadruple-tank", "plant.share_1", 0.69, 0.71, 6.0, (0.01, 1.0)),
}


def loop_behind_delay(case: Case) -> Any:
    loop = load(case.scenario).loop
    if case.scenario == "lab-rig":  # its brake command is constant; a PID makes a loop of it
        controller = PID(kp=1.0, ki=5.0, kd=0.0, low=0.0, high=1.0)
        loop = dataclasses.replace(loop, controller=controller)
    return dataclasses.replace(loop, actuator=Series(blocks=(loop.actuator, Delay(time=case.delay))))


def peak(loop: Any, w: np.ndarray) -> float:
    """The greatest singular value of S at frequencies, from the float response alone."""
    response = open_loop(loop).transfer().response(w)
    return float(np.linalg.svd(np.linalg.inv(np.eye(response.shape[1]) + response), compute_uv=False).max())


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_a_scenario_is_bounded_near_its_worst_margins(name: str) -> None:
    case = CASES[name]
    loop, box = loop_behind_delay(case), {case.path: (case.low, case.high)}
    w = np.geomspace(*case.frequencies, 20_001)
    worst = max(peak(d.replace(loop, {case.path: value}), w) for value in np.linspace(case.low, case.high, 5))
    assert worst > 1.2
    equations = derive_opened(loop, box)
    proof = prove_claim(equations, box, FrequencyClaim(worst * 1.005))
    assert proof.verdict == "proved"
    assert proof.worst is not None
    assert worst * 0.99 < proof.worst.sensitivity <= worst * 1.005
    refuted = prove_claim(equations, box, FrequencyClaim(worst * 0.999))
    assert refuted.verdict == "refuted"
    place = refuted.witness
    assert place is not None
    size = peak(d.replace(loop, {case.path: place.params[0]}), np.array([place.frequency]))
    assert size == pytest.approx(place.sensitivity, rel=1e-8)
    pytest.importorskip("flint")
    document = json.loads(json.dumps(frequency_document([proof], "", box, None)))
    assert verify_frequency(loop, document, share=0.02).reason == ""
    document["claims"][0]["sensitivity"] = worst * 0.999
    assert verify_frequency(loop, document).reason


@pytree
class Jumping(Proportional):
    """A gain that jumps where k passes an edge."""

    edge: Any = param(default=1.0, unit="1")

    def output(self, t, memory, signal):
        return jnp.where(self.k > self.edge, 3.0, 0.1) * super().output(t, memory, signal)


@killed_by("robust.frequency.coefficients", "if decided.all() else variables", "if True else variables")
def test_a_jump_of_the_gain_in_the_box_is_no_slope():
    """Both sides of the jump are constants; the peak is 1.1 before it and 20.28 behind it."""
    loop, box = loop_of(ThirdOrder(), Jumping()), {"controller.k": (0.5, 1.02)}
    assert prove_sensitivity(loop, box, 2.0).verdict == "refuted"
    assert prove_sensitivity(loop, box, 30.0, budget=1.0).verdict == "undecided"
    assert prove_sensitivity(loop, {"controller.k": (1.001, 1.02)}, 30.0).verdict == "proved"
    assert math.isclose(margins(open_loop(d.replace(loop, {"controller.k": 1.02}))).sensitivity, 20.28, rel_tol=1e-3)


@pytree
class Chosen(Proportional):
    """A gain from a table with the knots 1 and 2."""

    def output(self, t, memory, signal):
        gain = jnp.array([0.1, 1.0, 3.0])[searchsorted(jnp.array([1.0, 2.0]), self.k)]
        return gain * (signal.target - signal.measured.position)


@killed_by("robust.reach.equations", "self.const(i + 0.5)", "self.const(i - 0.5)")
def test_an_entry_of_a_table():
    loop = loop_of(ThirdOrder(), Chosen())
    for box, peak in (((1.2, 1.9), LAG_PEAK), ((2.1, 3.0), 18.065724)):
        assert prove_sensitivity(loop, {"controller.k": box}, peak * 1.001).verdict == "proved"
        assert prove_sensitivity(loop, {"controller.k": box}, peak * 0.999).verdict == "refuted"
