"""A loop as linear systems: the greatest decelerations, and loops whose gain has no permitted fall of the speed."""

from typing import Any

import numpy as np
import pytest
from mutants import killed_by

from diffabs.parts.plants import RoadVehicle
from diffabs.parts.roads import MagicFormula
from diffabs.robust.design import findings
from diffabs.robust.design.loop_task import greatest_decelerations


@killed_by("robust.design.loop_task", "MARGIN * np.max(", "np.max(")
@killed_by("robust.design.loop_task", "jnp.max(every", "jnp.min(every")
@killed_by("robust.design.loop_task", "itertools.product(*inside.values())", "[[ends[1] for ends in inside.values()]]")
def test_the_lightest_vehicle_brakes_hardest() -> None:
    """The peak of friction, with air drag and rolling resistance, and 1 % more."""
    speeds = np.array([5.0, 55.0])
    plant = RoadVehicle(road=MagicFormula(D=0.3))
    bounds = greatest_decelerations(plant, {"plant.mass": (400.0, 500.0), "speed": (5.0, 55.0)}, speeds)
    exact = (4316.4 * 0.3 + 0.856 * speeds**2) / 400.0 + 0.01 * 9.81
    np.testing.assert_allclose(bounds, 1.01 * exact, rtol=1e-4)


@killed_by("robust.design.findings", "if not 0 < low < high or task", "if task")
@killed_by("robust.design.findings", " or task.polytope.period is not None", "")
@pytest.mark.parametrize(("over", "period"), [({}, None), ({"speed": (5.0, 5.0)}, None), ({"speed": (5.0, 9.0)}, 1e-3)])
def test_a_sampled_loop_or_one_speed_has_no_permitted_fall(
    over: dict[str, tuple[float, float]], period: float | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Task:
        polytope: Any = type("Polytope", (), {"period": period})

    Task.over = over  # pyright: ignore
    monkeypatch.setattr(findings, "greatest_decelerations", lambda *_: pytest.fail("computed a fall"))
    assert findings.permitted_speed_fall(Task()) is None  # pyright: ignore
