"""The steps that the identification of a measured run needs."""

import numpy as np
import pytest
from mutants import killed_by

from diffabs.engine.types import FixedStep
from diffabs.tune.identify.noise import match_times


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
