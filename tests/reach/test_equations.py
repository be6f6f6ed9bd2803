"""What the equations of a proof take for granted about a loop, and refuse where it does not hold."""

import pytest
from mutants import killed_by

from diffabs.reach import NoRule
from diffabs.reach.equations import derive_equations
from diffabs.scenario.scenario import load


@killed_by("reach/equations.py", "for speed in (SLOWEST, FASTEST)", "for speed in (FASTEST,)")
def test_a_plant_whose_slip_is_another_one_at_low_speed_is_refused() -> None:
    """The slip of the rig is (v - w)/max(v, w, crawl speed)."""
    assert derive_equations(load("slip-lmi").loop, ["plant.mass"]).params == ("plant.mass",)
    for crawl in (0.02001, 3.0):
        with pytest.raises(NoRule, match=r"its slip is not 1 - w/v"):
            derive_equations(load("slip-lmi", [f"plant.crawl_speed={crawl}"]).loop, ["plant.mass"])


@killed_by("reach/equations.py", "check_slip_chart(self.loop, self.paths)", "check_slip_chart(self.loop)")
def test_a_parameter_of_the_box_must_not_change_the_slip() -> None:
    radii = ["plant.wheel_radius", "plant.body_radius"]
    assert derive_equations(load("slip-lmi").loop, radii).params == tuple(radii)
    with pytest.raises(NoRule, match=r"its slip is not 1 - w/v"):
        derive_equations(load("slip-lmi").loop, ["plant.crawl_speed"])


@killed_by("reach/equations.py", 'in ("period", "delay"):', 'in ("delay",):', case="controller.period")
@pytest.mark.parametrize("path", ["controller.period", "controller.delay"])
def test_a_range_of_periods_or_delays_is_refused(path: str) -> None:
    """The equations have one period, that of the scenario."""
    with pytest.raises(NoRule, match="range of periods or delays"):
        derive_equations(load("slip-cured").loop, [path])
