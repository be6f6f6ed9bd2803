"""The unit of a control is what its plant says: the lab rig's is a command between 0 and 1, no torque."""

import pytest
from commands import run
from matplotlib.figure import Figure
from matplotlib.text import Text
from mutants import killed_by

from diffabs import plants
from diffabs.loop.run import rollout
from diffabs.output import plot
from diffabs.parts.objectives import Effort, TorqueRate, Variation
from diffabs.scenario import scenario
from diffabs.scenario.registry import unit_of
from diffabs.uncertainty.sweep.trajectories import write_trajectories

pytestmark = pytest.mark.usefixtures("any_step_is_stable", "without_load")

SHORT = ("--set", "solver.step=5e-5", "--set", "solver.duration=1e-3", "--set", "solver.every=1")


@pytest.mark.parametrize(
    ("plant", "unit"),
    [(plants.QuarterCar(), "N m"), (plants.MirroredRig(), "N m"), (plants.LabRig(), "1"), (plants.ArmBalance(), "V")],
)
def test_a_plant_says_the_unit_of_its_control(plant, unit):
    assert plant.control_unit == unit


@pytest.mark.slow
@killed_by(
    "loop.convert",
    "controls = control_units(plant) if plant is not None else",
    'controls = {"control": "N m"} if plant is not None else',
)
def test_the_csv_file_of_the_lab_rig(tmp_path):
    run("simulate", "lab-rig", *SHORT, "--csv", tmp_path / "run.csv")
    header = (tmp_path / "run.csv").read_text().splitlines()[0].split(",")
    assert header[-2:] == ["command [1]", "control [1]"]


@pytest.mark.slow
def test_figure_and_trajectories_of_the_lab_rig(tmp_path, monkeypatch):
    import zarr

    from diffabs.scenario import section_sweep

    drawn = []
    monkeypatch.setattr(Figure, "savefig", lambda figure, path, **_: drawn.append(figure))
    run("simulate", "lab-rig", *SHORT, "--plot", tmp_path / "run.png")
    texts = {text.get_text() for text in drawn[0].findobj(Text)}
    assert "control [1]" in texts
    assert not any("N m" in text for text in texts)
    over = 'sweep.over={"plant.road.w4"={low=0.3,high=0.4}}'
    study = section_sweep.build_study(scenario.load("lab-rig", [*SHORT[1::2], over]))
    kept = zarr.open_group(write_trajectories(study, tmp_path, [0]), mode="r")
    assert (kept["control"].attrs["units"], kept["command"].attrs["units"]) == ("1", "1")


def test_what_is_measured_of_a_control_has_its_unit():
    rig, car = plants.LabRig(), plants.QuarterCar()
    assert [unit_of(Effort(), plant) for plant in (None, car, rig)] == ["N^2 m^2 s", "N^2 m^2 s", "s"]
    assert [unit_of(Variation(), plant) for plant in (car, rig)] == ["N m", "1"]
    assert [unit_of(TorqueRate(), plant) for plant in (car, rig)] == ["N m/s", "1/s"]


@pytest.mark.slow
def test_the_usual_figure_is_of_a_torque():
    chosen = scenario.load("slip-lmi", SHORT[1::2])
    texts = {text.get_text() for text in plot.draw_braking(rollout(chosen.loop, chosen.solver)).findobj(Text)}
    assert "brake torque [N m]" in texts
