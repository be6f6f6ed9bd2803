"""One run of a scenario, with its warnings and its record."""

import json
from types import SimpleNamespace

import numpy as np
import pytest
from mutants import killed_by

from diffabs.scenario import load, simulate
from diffabs.scenario.simulation import Simulation

pytestmark = pytest.mark.usefixtures("any_step_is_stable")
SHORT = ["solver.duration=0.02", "solver.step=1e-3", "solver.every=1"]


@killed_by("scenario.simulation", "if self.at_limit > WARNED_LIMIT_SHARE:", "if False:")
@killed_by("scenario.simulation", "math.ceil(steps / max_rows)", "1")
def test_a_run_at_its_limit_says_so_and_keeps_few_rows() -> None:
    weak = ["controller.low=0", "controller.high=0.1"]  # far below the demand
    simulation = simulate(load("slip-lmi", [*SHORT, *weak]), max_rows=5)
    late, *infinite, limited = simulation.warnings()
    assert late.startswith("NOT STOPPED within solver.duration = 0.02 s; ")
    assert limited.startswith("the control is at a limit (0 to 0.1 N m) for 100 % of the run")
    assert simulation.at_limit == pytest.approx(1.0)
    np.testing.assert_allclose(simulation.run.trajectory.sample.t, [0.0, 0.004, 0.008, 0.012, 0.016, 0.02], rtol=1e-12)
    record = json.loads(json.dumps(simulation.record()))
    assert record["warnings"] == [late, *infinite, limited]
    assert list(record["metrics"]) == list(simulation.scenario.objectives)
    assert (record["stopped"], record["solver"]["seed"]) == (False, 0)
    assert (simulation.slide(), simulation.loose_metrics()) == ("", [])


@killed_by("parts.plants.car", '{"yaw": math.pi / 2}', '{"yaw": 9.0}')
def test_a_car_that_turns_beyond_its_model_has_a_warning():
    scenario = load("car-split")
    metrics = dict.fromkeys(scenario.objectives, 0.0)

    def warnings(yaw):
        run = SimpleNamespace(stopped=True, diverged=False, metrics={**metrics, "max_yaw": yaw})
        return list(Simulation(scenario, run, 0.0, None, 0).warnings())

    assert warnings(1.5) == []
    assert warnings(3.05) == ["max_yaw = 3.05 is beyond 1.571 rad, where the plant's model ends"]
