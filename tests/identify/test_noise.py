"""The steps that the identification of a measured run needs."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from mutants import killed_by

from diffabs.engine.solvers import FixedStep
from diffabs.parts.controllers import StateFeedback
from diffabs.tune.identify.fit import fit
from diffabs.tune.identify.noise import describe_residuals, match_times


def test_a_trajectory_is_as_long_as_the_data() -> None:
    t = np.array([0.0, 0.1, 0.3])
    assert match_times(FixedStep(1e-3, 1.0), t)[0].steps == 302
    long, _ = match_times(FixedStep(1e-6, 1.0), t)
    assert long.steps == 300_002
    assert long.every == 16
    assert match_times(FixedStep(0.1, 0.3), t)[0].duration == pytest.approx(0.3)


@killed_by("tune.identify.noise", "end * (1 + FILE_ROUNDING)", "end", case="product")
@killed_by("tune.identify.noise", "np.minimum(t, end)", "t")
@pytest.mark.parametrize(
    ("step", "duration"), [(3e-4, 3.0), (2 / 3, 2 / 3), (5 / 3, 5 / 3)], ids=["product", "thirds", "five thirds"]
)
def test_the_last_instant_of_a_file_is_in_the_run(step: float, duration: float) -> None:
    """10,000 times 3e-4 is less than 3, and a file has 1.66666666667 for five thirds."""
    last = float(f"{duration:.12g}")
    solver = FixedStep(step, duration)
    matched, t = match_times(solver, np.array([0.0, last]))
    assert t[1] == pytest.approx(last, rel=1e-11)
    assert t[1] <= matched.duration == pytest.approx(duration, rel=1e-15)
    assert matched.steps == solver.steps == round(duration / step)
    matched, t = match_times(solver, np.array([0.0, 1.01 * duration]))
    assert t[1] > matched.duration  # is refused


@killed_by("tune.identify.fit", "self.values[path], *(ends or", "value, *(ends or")
@killed_by("tune.identify.fit", "> HIGH_CORRELATION", "> 1.0")
def test_a_record_has_a_row_for_each_number_with_its_deviation() -> None:
    controller = StateFeedback(gain=(-100.0, -20.0))
    t = jnp.linspace(0.0, 1.0, 50)

    def residuals(part: StateFeedback) -> jax.Array:
        return part.gain[0] * t + part.gain[1] * (t + 0.01 * t**2) + 130.0 * t + 0.1 * jnp.sin(40.0 * t)

    free = {"gain": ((-200.0, -200.0), (-1.0, -1.0))}
    found = fit(controller, free, residuals)
    record = json.loads(json.dumps(found.record(controller, free)))
    first, second = record["values"]["gain.0"], record["values"]["gain.1"]
    assert (first["before"], second["before"], first["low"], second["high"]) == (-100.0, -20.0, -200.0, -1.0)
    assert [first["value"], second["value"]] == list(found.values["gain"])
    assert first["deviation"] == found.uncertainty.deviations["gain.0"]
    assert record["parameters"]["gain"] == [first["value"], second["value"]]
    (pair,) = record["correlations"]
    assert pair["between"] == ["gain.1", "gain.0"]
    assert pair["correlation"] < -0.95
    statistics = describe_residuals(found, {"low": 1.0, "high": 2.0}, {"low": "1", "high": "m"})
    assert statistics["high"]["largest"] == np.abs(found.residuals[25:]).max()
    assert statistics["low"]["mean"] == np.mean(found.residuals[:25])
