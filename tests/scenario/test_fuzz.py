"""A few scenarios of the fuzzer, and that it would see what it looks for."""

from types import SimpleNamespace

import fuzz_scenarios as fuzz
import numpy as np
import pytest

from diffabs.scenario.scenario import ScenarioError, load


@pytest.mark.slow
def test_random_scenarios_are_refused_in_a_line_or_run():
    tally = fuzz.fuzz(12, seed=4, per_structure=12)
    assert tally.findings == []
    assert tally.counts["accepted"] + tally.counts["refused"] == 12
    assert tally.counts["accepted"] >= 4
    assert tally.counts["ran"] + tally.counts["diverged"] == tally.counts["accepted"]


@pytest.mark.slow
def test_the_same_seed_makes_the_same_scenarios():
    made = []
    for _ in range(2):
        rng = np.random.default_rng([9, 0])
        text, base = fuzz.structure(rng)
        made.append((text, [fuzz.overrides(rng, base) for _ in range(5)]))
    assert made[0] == made[1]


@pytest.mark.parametrize(
    ("error", "counted"), [(KeyError("mass"), "crashed"), (ScenarioError(""), "refused"), (TypeError("x"), "crashed")]
)
def test_the_fuzzer_sees_a_traceback_and_an_empty_refusal(monkeypatch, error, counted):
    def failing(*_, **__):
        raise error

    monkeypatch.setattr(fuzz, "loads", failing)
    tally = fuzz.Tally()
    assert fuzz.loaded("", ["plant.mass=1"], tally, again=False) is None
    assert tally.counts[counted] == 1
    assert len(tally.findings) == 1
    assert "plant.mass=1" in tally.findings[0]


def test_the_fuzzer_sees_numbers_that_cannot_be():
    chosen = load("slip-estimator", integrated=False)

    def lines(metrics, speed=1.0):
        run = SimpleNamespace(
            metrics=metrics, ending=SimpleNamespace(sample=SimpleNamespace(output=SimpleNamespace(speed=speed)))
        )
        return list(fuzz.wrong(chosen, run))

    assert lines({"iae": 0.1, "max_slip": 1.0, "stop_time": 3.0}) == []
    assert lines({"iae": -0.1, "stop_time": float("inf"), "max_slip": 1.01}) == [
        "iae = -0.1 cannot be",
        "stop_time = inf is not finite",
        "max_slip = 1.01 cannot be",
    ]
    assert "it rose" in lines({}, speed=30.0)[0]
