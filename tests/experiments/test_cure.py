"""The cured controller where it is weak: against a second version in NumPy, and what its page says of it."""

import importlib
import re

import numpy as np
import pytest
from project import ROOT

from diffabs import FixedStep
from diffabs.scenario.scenario import load

STEP = 2.5e-4  # s
PAGE = (ROOT / "experiments" / "overshoot_cured" / "README.md").read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def module():
    return importlib.import_module("experiments.overshoot_cured.weak_spots")


@pytest.fixture(scope="module")
def cure():
    return load("slip-cured", integrated=False).loop


@pytest.fixture(scope="module")
def corner(module, cure):
    """Overshoot [%] at the box's worst corner, 6.2 kg from 50 km/h, by what is wrong; and as designed for."""
    box, solver = module.Box(masses=(6.2,), speeds=(50.0,)), FixedStep(step=STEP, duration=0.5)
    spots = (*module.SPOTS, module.Spot("as designed for", values=(("sensor.factor", 1.0),)))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "SPOTS", spots)
        return module.weak_spots(cure, box, solver)


def overshoot(speed=50.0, friction=1.0, lag=1e-3, inertia=1.0, delay=0, seen=1.0, target=None):
    """Overshoot [%] of slip-cured at 6.2 kg, written out: eqs. (4), (5), (12), (13) of Maeda and Sugiura, a brake with
    lag, and a program that runs each millisecond. Nothing of diffabs but the tuned numbers, copied here. `delay`: whole
    periods; `target`: where the filter of the target starts, the slip that is seen there unless given."""
    m, r1, j1, period, g, substeps = 6.2, 0.0995, 7.53e-3 * inertia, 1e-3, 9.81, 20
    first = 1 - 1 / seen if target is None else target
    a, q, w = 2.57e-4, 2.1, (-4.24e-2, 2.94e-10, 3.51e-2, 0.407 * friction)

    def mu(s):
        size = abs(s)
        value = w[3] * size**q / (a + size**q) + w[2] * size**3 + w[1] * size**2 + w[0] * size
        return np.copysign(value, s)

    def slip(v, rim):
        return (v - rim) / max(v, rim)

    def rates(x, u):
        v, rim, torque = x
        push = m * g * mu(slip(v, rim))
        return np.array([-2 * push / m, r1 * (push * r1 - torque) / j1, (u - torque) / lag])

    x, integral, waiting, worst = np.array([speed / 3.6, speed / 3.6, 0.0]), 0.0, [0.0] * delay, 0.0
    for k in range(350):
        v, rim, _ = x
        error = (seen * v - rim) / (seen * v) - 0.2 - (first - 0.2) * np.exp(-k * period / 0.01732)
        asked = 2.6912710579228354 + seen * v / (50 / 3.6) * (-17300.0 * integral - 348.6 * error)
        integral += period * error
        waiting.append(np.clip(asked, 0.0, 9.03))
        u, h = waiting.pop(0), period / substeps
        for _ in range(substeps):
            k1 = rates(x, u)
            k2 = rates(x + h / 2 * k1, u)
            k3 = rates(x + h / 2 * k2, u)
            x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + rates(x + h * k3, u))
            worst = max(worst, slip(x[0], x[1]))
    return 100 * (worst / 0.2 - 1)


WRONG = {
    "as designed for": {},
    "51 km/h": {"speed": 51.0},
    "55 km/h": {"speed": 55.0},
    "70 km/h": {"speed": 70.0},
    "friction +10 %": {"friction": 1.1},
    "lag 2 ms": {"lag": 2e-3},
    "inertia +10 %": {"inertia": 1.1},
    "computing 1 ms": {"delay": 1},
    "speed 1 % low": {"seen": 0.99},
    "speed 5 % low": {"seen": 0.95},
}


@pytest.mark.slow
@pytest.mark.parametrize("name", WRONG)
def test_a_weak_spot_is_that_of_a_second_program(corner, name):
    """A peak between two steps of 0.25 ms may be missed by some 0.01 %."""
    assert corner[name] == pytest.approx(overshoot(**WRONG[name]), abs=0.02)


def test_a_target_that_starts_from_zero_overshoots_more():
    """The filter starts from the slip that is seen, -1 and -5 % of a rolling wheel here. An independent computation had
    9.2 and 52 %: those of a filter that starts from 0."""
    assert [round(overshoot(seen=seen, target=0.0), 1) for seen in (0.99, 0.95)] == [9.2, 51.7]


def cells(start):
    (line,) = re.findall(rf"^\| \*\*{start}.*$", PAGE, re.MULTILINE)
    return [cell.strip(" *") for cell in line.strip("|").split("|")]


@pytest.mark.slow
def test_the_readme_says_how_weak_the_cure_is(module, corner):
    """The corner is the worst of the box in all of them but noise, which differs from seed to seed."""
    table = next(line for line in PAGE.splitlines() if line.startswith("| controller | from 51"))
    heads = [cell.strip() for cell in table.strip("|").split("|")]
    assert heads[2:6] == ["friction +10 %", "lag 2 ms", "inertia +10 %", "computing 1 ms"]
    assert heads[6] == module.NOISY
    _, fast, friction, lag, inertia, computing, _, low = cells(r"tuned\*\*")
    said = dict(zip(("51 km/h", "55 km/h", "70 km/h"), fast.split(", "), strict=True))
    said |= {"friction +10 %": friction, "lag 2 ms": lag, "inertia +10 %": inertia, "computing 1 ms": computing}
    said |= dict(zip(("speed 1 % low", "speed 5 % low"), low.split(", "), strict=True))
    assert set(said) == set(WRONG) - {"as designed for"}
    for name, words in said.items():
        digits = len(words.partition(".")[2])
        assert f"{corner[name]:.{digits}f}" == words, name
    assert cells("tuned: ")[1] == f"{corner['as designed for']:.2f} %"


@pytest.mark.slow
def test_more_is_asked_for_than_is_allowed(module, cure):
    """Windup: there is no anti-windup, and with the limits in the actuator nothing else changes."""
    box, solver = module.Box(masses=(6.2,), speeds=(50.0,)), FixedStep(step=STEP, duration=0.2)
    low, high = module.torques(cure, box, solver)
    assert f"asks for {high:.1f} N m where 9.03 are allowed" in " ".join(PAGE.split())
    assert high > 2 * 9.03
    assert low >= 0


def test_the_box_has_its_corners_and_what_was_tuned(module):
    lanes = module.Box().lanes()
    pairs = {(m, round(3.6 * v, 9)) for m, v in zip(lanes["plant.mass"], lanes["initial.speed"], strict=True)}
    assert {(m, v) for m in (5.3, 6.2) for v in (5.0, 50.0)} <= pairs
    assert len(pairs) == 40
    assert np.all(lanes["stop.speed"] < lanes["initial.speed"])
    assert np.max(lanes["stop.speed"]) == pytest.approx(5 / 3.6)
