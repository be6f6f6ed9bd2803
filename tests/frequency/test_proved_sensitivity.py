"""Proofs of the greatest sensitivity: closed forms, dense samples, files, and claims that are wrong."""

import dataclasses
import json
import math
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
import pytest
from commands import assert_one_error_line
from commands import run as command
from mutants import killed_by

import diffabs as d
from diffabs.cli import show_margins
from diffabs.core.protocols import no_flow, no_memory
from diffabs.core.pytree import param, pytree
from diffabs.linear import margins, open_loop
from diffabs.parts.actuators import Delay
from diffabs.parts.controllers import Sampled
from diffabs.parts.references import Setpoint
from diffabs.parts.stops import NoStop
from diffabs.robust.frequency import FrequencyClaim, SensitivityProof, prove_sensitivity
from diffabs.robust.frequency.certificate import frequency_document, verify_frequency
from diffabs.robust.frequency.coefficients import Polynomials, list_forms
from diffabs.robust.frequency.intervals import Enclosure
from diffabs.robust.frequency.opened import derive_opened
from diffabs.robust.frequency.sensitivity import _respond, _slopes, prove_claim, square_form
from diffabs.robust.reach.equations import NoRule
from diffabs.scenario.scenario import load

RIG = {"plant.mass": (5.3, 6.2), "initial.speed": (1.4, 13.9)}
LAG_PEAK = 2.486659913635076  # of L = 25/(s^3 + 10 s^2 + 10 s + 10), by an independent root finder


class Shown(NamedTuple):
    """The position."""

    position: Any
    units = {"position": "m"}  # noqa: RUF012


class Chain(NamedTuple):
    """Position, its rate, and the rate of that."""

    position: Any
    rate: Any
    second: Any


@pytree
class ThirdOrder:
    """gain/(s^3 + c2 s^2 + c1 s + c0)."""

    gain: Any = param(default=25.0, unit="1")
    c2: Any = param(default=10.0, unit="1")
    c1: Any = param(default=10.0, unit="1")
    c0: Any = param(default=10.0, unit="1")

    shows = Shown
    control_unit = "N"

    def start(self, initial):
        return Chain(1.0 * initial, 0.0 * initial, 0.0 * initial)

    def derivative(self, t, state, control):
        x, v, a = state
        return Chain(v, a, self.gain * control - self.c2 * a - self.c1 * v - self.c0 * x)

    def project(self, state):
        return state

    def output(self, state):
        return Shown(state.position)

    def holding(self, output, target):
        return self.c0 * target / self.gain


@pytree
class Integrator:
    """gain/s."""

    gain: Any = param(default=1.0, unit="1")

    shows = Shown
    control_unit = "N"

    def start(self, initial):
        return 1.0 * initial

    def derivative(self, t, state, control):
        return self.gain * control + 0.0 * state

    def project(self, state):
        return state

    def output(self, state):
        return Shown(state)

    def holding(self, output, target):
        return 0.0 * target


@pytree
class Proportional:
    """u = k (target - y)."""

    k: Any = param(default=1.0, unit="1")

    start = no_memory
    flow = no_flow

    def output(self, t, memory, signal):
        return self.k * (signal.target - signal.measured.position)


def loop_of(plant, controller=None, **parts):
    controller = Proportional() if controller is None else controller
    reference = Setpoint(value=0.0)
    return d.Loop(plant=plant, initial=0.0, reference=reference, controller=controller, stop=NoStop(), **parts)


def integrator_peak(gain: float, delay: float) -> float:
    """The greatest 1/|1 + gain e^(-jw delay)/(jw)|, on a fine grid."""
    w = np.linspace(1e-3, 60 / delay, 2_000_001)
    return float((1 / np.abs(1 + gain / (1j * w) * np.exp(-1j * w * delay))).max())


def rig_samples(loop, count: int = 9) -> float:
    """The greatest sensitivity on a grid of the box that includes its corners."""
    speeds = np.geomspace(*RIG["initial.speed"], count)
    points = [(m, v) for m in np.linspace(*RIG["plant.mass"], 3) for v in speeds]
    values = [d.replace(loop, {"plant.mass": m, "initial.speed": v}) for m, v in points]
    return max(margins(open_loop(value)).sensitivity for value in values)


@pytest.fixture(scope="module")
def lmi():
    loop = load("slip-lmi").loop
    return loop, derive_opened(loop, RIG)


@killed_by(
    "robust.frequency.sensitivity",
    "_add(rates[i], _scale(_turn_right(at.minors[i]), delay.times(float(d))))",
    "rates[i]",
    case="continuous",
)
@killed_by("robust.frequency.sensitivity", "if k == i else None)", "if k == 0 else None)", case="sampled")
@killed_by("robust.frequency.sensitivity", "sizes[k - 1].times(float(k)) * step", "sizes[k - 1] * step", case="sampled")
@pytest.mark.parametrize("period", [pytest.param(None, id="continuous"), pytest.param(0.1, id="sampled")])
def test_the_derivatives_of_the_form_are_those_of_differences(period):
    """The form is f; the sides are the frequency, the gain, a coefficient and the added delay."""
    controller = Proportional(k=0.8) if period is None else Sampled(controller=Proportional(k=0.8), period=period)
    box = {"plant.gain": (20.0, 25.0), "plant.c1": (9.0, 11.0)}
    equations = derive_opened(loop_of(ThirdOrder(), controller), box)
    polynomials = Polynomials(equations, [22.5, 10.0], 1 if period else 0, broken=period is not None)
    square, index, forms = Enclosure(np.float64(0.2)), np.zeros(1, int), list_forms(1)

    def form(point, slopes=False):
        rows = np.array([point[1:]])
        coefficients = polynomials.over(rows, rows)
        at = _respond(coefficients, forms, Enclosure(np.array([point[0]])), period, index)
        if slopes:
            return [float(np.ravel(x.middle())[0]) for x in _slopes(coefficients, at, forms, square, index, 3)]
        return float(np.ravel(square_form(at, forms, square).middle())[0])

    point = np.array([2.3, 22.0, 10.5, 0.13])
    for side, slope in enumerate(form(point, slopes=True)):
        step = np.zeros(4)
        step[side] = 1e-4 * point[side]
        difference = (form(point + step) - form(point - step)) / (2 * step[side])
        assert slope == pytest.approx(difference, rel=1e-5, abs=1e-9)


def test_the_peak_of_a_third_order_lag_is_that_of_the_closed_form():
    loop = loop_of(ThirdOrder())
    narrow = {"plant.gain": (25.0, 25.0)}
    assert prove_sensitivity(loop, narrow, LAG_PEAK * (1 + 1e-6)).verdict == "proved"
    refuted = prove_sensitivity(loop, narrow, LAG_PEAK * (1 - 1e-6))
    assert refuted.verdict == "refuted"
    assert refuted.witness is not None
    assert refuted.witness.sensitivity == pytest.approx(LAG_PEAK, rel=2e-6)


@killed_by(
    "robust.frequency.sensitivity",
    "turns[d] = (cosine(turned), -sine(turned))",
    "turns[d] = (cosine(turned), sine(turned))",
)
def test_an_integrator_behind_a_delay():
    loop, box = (
        loop_of(Integrator(), actuator=Delay(time=0.05)),
        {"controller.k": (2.0, 8.0), "actuator.time": (0.02, 0.05)},
    )
    peak = integrator_peak(8.0, 0.05)
    assert prove_sensitivity(loop, box, peak * 1.001).verdict == "proved"
    assert prove_sensitivity(loop, box, peak * 0.999).verdict == "refuted"
    # stable up to a delay of pi/(2 gain)
    margin = math.pi / 2 / 8.0 - 0.05
    assert prove_sensitivity(loop, box, added=margin * 0.99).verdict == "proved"
    assert prove_sensitivity(loop, box, added=margin * 1.01).verdict == "refuted"


@killed_by("robust.frequency.sensitivity", "if round(unstable) > 0:", "if False:")
def test_an_unstable_loop_is_refuted_though_its_sensitivity_is_small():
    loop = loop_of(ThirdOrder(), Proportional(k=40.0))  # stable below k = 3.6
    proof = prove_sensitivity(loop, {"plant.gain": (24.0, 26.0)}, 50.0)
    assert proof.verdict == "refuted"
    assert "unstable" in proof.reason
    assert "2 poles" in proof.reason


def test_a_loop_that_is_unstable_in_a_corner_is_refuted():
    loop = loop_of(ThirdOrder(), Proportional(k=3.0))
    assert prove_sensitivity(loop, {"plant.gain": (20.0, 27.0)}).verdict == "proved"
    proof = prove_sensitivity(loop, {"plant.gain": (20.0, 32.0)})  # unstable above a gain of 30
    assert proof.verdict == "refuted"
    assert proof.witness is None or 29.5 < proof.witness.params[0] < 32.0


@pytest.mark.parametrize("delay", [0.0, 0.03, 0.1, 0.14])
def test_a_sampled_loop_has_the_sensitivity_of_its_margins(delay):
    loop = (
        loop_of(ThirdOrder(), Sampled(controller=Proportional(k=0.8), period=0.1), actuator=Delay(time=delay))
        if delay
        else loop_of(ThirdOrder(), Sampled(controller=Proportional(k=0.8), period=0.1))
    )
    peak = max(
        margins(open_loop(d.replace(loop, {"plant.gain": gain}))).sensitivity for gain in np.linspace(20.0, 25.0, 6)
    )
    assert prove_sensitivity(loop, {"plant.gain": (20.0, 25.0)}, peak * (1 + 1e-5)).verdict == "proved"
    assert prove_sensitivity(loop, {"plant.gain": (20.0, 25.0)}, peak * (1 - 1e-5)).verdict == "refuted"


def test_the_delay_margin_of_a_sampled_loop_over_several_periods():
    loop = loop_of(ThirdOrder(), Sampled(controller=Proportional(k=0.8), period=0.1))
    box = {"plant.gain": (20.0, 25.0)}
    margin = margins(open_loop(d.replace(loop, {"plant.gain": 25.0}))).delay
    assert margin > 0.2
    proof = prove_sensitivity(loop, box, added=margin * 0.995)
    assert proof.verdict == "proved"
    assert len(proof.pieces) == math.floor(margin * 0.995 / 0.1) + 1
    assert prove_sensitivity(loop, box, added=margin * 1.005).verdict == "refuted"
    assert verify_frequency(loop, document_of(loop, box, [proof])).reason == ""


def test_samples_of_the_rig_do_not_exceed_the_proved_bound(lmi):
    loop, equations = lmi
    worst = rig_samples(loop)
    assert prove_claim(equations, RIG, FrequencyClaim(worst * 1.001)).verdict == "proved"
    refuted = prove_claim(equations, RIG, FrequencyClaim(worst * 0.9999))
    assert refuted.verdict == "refuted"
    place = refuted.witness
    assert place is not None
    point = dict(zip(RIG, place.params, strict=True))
    response = open_loop(d.replace(loop, point)).transfer().response(np.array([place.frequency]))[0, 0, 0]
    assert 1 / abs(1 + response) == pytest.approx(place.sensitivity, rel=1e-9)


@pytest.mark.slow
def test_the_cured_loop_is_bounded_within_a_thousandth():
    loop = load("slip-cured").loop
    worst = rig_samples(loop)
    equations = derive_opened(loop, RIG)
    assert prove_claim(equations, RIG, FrequencyClaim(worst * 1.001)).verdict == "proved"
    assert prove_claim(equations, RIG, FrequencyClaim(worst * 0.9999)).verdict == "refuted"


@pytest.mark.slow
@killed_by("robust.frequency.opened", "    loop = split_off_delays(loop)[0]\n    plant: Any", "    plant: Any")
def test_five_parameters_of_the_rig_behind_a_delay():
    loop = dataclasses.replace(load("slip-lmi").loop, actuator=Delay(time=1e-3))
    more = {"plant.road.w4": (0.39, 0.42), "reference.slip": (0.19, 0.21), "actuator.time": (5e-4, 1e-3)}
    box = RIG | more
    corners = ((6.2, 13.9, w4, slip, 1e-3) for w4 in (0.39, 0.42) for slip in (0.19, 0.21))
    worst = max(margins(open_loop(d.replace(loop, dict(zip(box, x, strict=True))))).sensitivity for x in corners)
    equations = derive_opened(loop, box)
    assert prove_claim(equations, box, FrequencyClaim(worst * 1.02)).verdict == "proved"
    assert prove_claim(equations, box, FrequencyClaim(worst * 0.98)).verdict == "refuted"


# Files.


def document_of(loop, over, proofs) -> dict:
    text = json.dumps(frequency_document(proofs, "", over, None))
    return json.loads(text)


@pytest.fixture(scope="module")
def proved(lmi) -> tuple[Any, SensitivityProof]:
    pytest.importorskip("flint")
    loop, equations = lmi
    return loop, prove_claim(equations, RIG, FrequencyClaim(2.6))


def judge(proved, change=lambda document: None):
    loop, proof = proved
    document = document_of(loop, RIG, [proof])
    change(document)
    return verify_frequency(loop, document)


def test_the_file_of_a_proof_is_verified(proved):
    verdict = judge(proved)
    assert (verdict.reason, verdict.statements) == ("", ("sensitivity <= 2.6",))
    assert verdict.checked == verdict.cells >= 100


def change_bound(document):
    document["claims"][0]["sensitivity"] = 2.3


def lose_cell(document):
    piece = document["claims"][0]["pieces"][0]
    longest = max(range(len(piece["strips"])), key=lambda i: len(piece["strips"][i]))
    piece["strips"][longest] = piece["strips"][longest][:-1]


def shift_box(document):
    document["over"]["initial.speed"] = [1.4, 20.0]


def mark_unproved_cell(document):
    piece = document["claims"][0]["pieces"][0]
    piece["strips"] = ["." for _ in piece["strips"]]
    document["claims"][0]["sensitivity"] = 2.4


def lower_top(document):
    document["claims"][0]["pieces"][0]["top"] = 20.0


def claim_delay(document):
    document["claims"][0]["added_delay"] = 0.02
    document["claims"][0]["pieces"][0]["delays"] = [0.0, 0.02]


@killed_by("robust.frequency.checker", "if reserve.lower() > 0:", "if True:", case="change_bound")
@killed_by(
    "robust.frequency.checker",
    "    if stack:\n        raise ValueError",
    "    if False:\n        raise ValueError",
    case="lose_cell",
)
@killed_by("robust.frequency.checker", "if top > 0 and (", "if True or (", case="lower_top")
@pytest.mark.parametrize("change", [change_bound, lose_cell, shift_box, mark_unproved_cell, lower_top, claim_delay])
def test_an_edited_file_is_refused(proved, change):
    assert judge(proved, change).reason


@killed_by("robust.frequency.checker", 'if not abs(unstable).upper() < arb("0.5"):', "if False:")
def test_a_file_about_an_unstable_loop_is_refused():
    """The cells of the stable loop's mirror image, in which S has the same size, would prove the claim."""
    pytest.importorskip("flint")
    box = {"plant.gain": (24.0, 26.0)}
    unstable = loop_of(ThirdOrder(), Proportional(k=40.0))
    equations = derive_opened(unstable, box)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("diffabs.robust.frequency.sensitivity._Proof.check_stable", lambda *_: None)
        proof = prove_claim(equations, box, FrequencyClaim(50.0))
    assert proof.verdict == "proved"
    assert "unstable poles" in verify_frequency(unstable, document_of(unstable, box, [proof])).reason


# The command.


def test_the_command_proves_saves_verifies_and_shows(tmp_path):
    pytest.importorskip("flint")
    over = ("--over", "plant.mass=5.3:6.2", "--over", "initial.speed=5:13.9")
    saved = ("--sensitivity", "2.6", "--delay-margin", "0.5 ms", "--out", tmp_path / "p.json", "--json")
    document = json.loads(command("certify", "slip-lmi", *over, *saved).stdout)
    assert document["verdict"] == "proved"
    assert [row["claim"] for row in document["claims"]] == ["sensitivity <= 2.6", "delay margin >= 0.0005 s"]
    shown = command("verify", tmp_path / "p.json").stdout
    assert shown.count("proved  ") == 2
    beside = ("margins", "slip-lmi", "--samples", "0", "--proof", tmp_path / "p.json")
    own = ("--set", "design.over.plant.mass=5.3:6.2", "--set", "design.over.initial.speed=5:13.9")
    content = json.loads(command(*beside, *own, "--json").stdout)
    assert content["proved"] == {"modulus": 1 / 2.6, "sensitivity": 2.6, "delay": 0.5e-3}
    assert content["worst"]["sensitivity"]["value"] <= 2.6


@pytest.mark.slow
def test_margins_refuse_a_proof_of_another_loop_or_box(tmp_path):
    pytest.importorskip("flint")
    own = ("slip-lmi", "--set", "design.over.plant.mass=5.3:6.2", "--set", "design.over.initial.speed=5:13.9")
    command("certify", *own, "--sensitivity", "2.6", "--out", tmp_path / "p.json")
    for more, message in {
        ("--set", "plant.mass=5"): "plant.mass in [5.3, 6.2] kg, and the margins are of 5 to 6.2 kg",
        (
            "--set",
            "design.over.plant.mass=5.3:6.3",
        ): "plant.mass in [5.3, 6.2] kg, and the margins are of 5.3 to 6.3 kg",
        ("--set", "design.over.road.w4=0.4:0.41"): "one value of plant.road.w4, and the margins are of a range",
        ("--at", "target=0.15"): "about another loop",
        ("--set", "actuator.type=lag"): "about another loop",
        ("--set", "controller.gain=[-11000.0, -48.0]"): "about another loop",
    }.items():
        refused = command("margins", *own, "--samples", "0", "--proof", tmp_path / "p.json", *more, status=2)
        assert_one_error_line(refused)
        assert message in refused.stderr


def test_bounds_are_not_rounded_to_more_than_is_proved():
    shown = [show_margins.format_bound(name, 0.123456789) for name in ("sensitivity", "modulus", "delay")]
    assert shown == ["at most 0.12346", "at least 0.12345", "at least 123.45"]
    assert show_margins.format_bound("sensitivity", 2.6) == "at most 2.6"


def test_the_command_refutes():
    result = command("certify", "slip-lmi", "--sensitivity", "2.3", status=1)
    assert "refuted: sensitivity <= 2.3: |S| >= 2.3" in result.stderr


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("slip-lmi", "--sensitivity", "0.9"), "outside (1, inf)"),
        (("slip-lmi", "--delay-margin", "5 hours"), "a time is needed"),
        (("slip-lmi", "--over", "plant.mass=5:6"), "--over goes with --sensitivity"),
        (("slip-lmi", "--sensitivity", "2", "--gain=-1,-1"), "--gain does not go"),
        (("lab-rig", "--sensitivity", "2", "--over", "road.w4=0.3:0.4"), "no linear loop"),
        (("slip-cured", "--sensitivity", "2", "--over", "controller.delay=0:0.001"), "periods or delays"),
    ],
)
def test_the_command_refuses_in_one_line(options, message):
    result = command("certify", *options, status=2)
    assert_one_error_line(result)
    assert message in result.stderr


def test_a_quantiser_has_no_rule():
    @pytree
    class Rounding(Proportional):
        def output(self, t, memory, signal):
            return jnp.rint(100 * super().output(t, memory, signal)) / 100

    with pytest.raises(ValueError, match=r"no linear loop|derivative"):
        derive_opened(loop_of(ThirdOrder(), Rounding()), {"plant.gain": (24.0, 25.0)})
    with pytest.raises(NoRule, match="is not a parameter"):
        derive_opened(loop_of(ThirdOrder()), {"plant.weight": (1.0, 2.0)})
