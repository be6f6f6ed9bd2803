"""`diffabs rare`: the library's numbers as a document and as tables; one line for what cannot be asked."""

import dataclasses
import json
import re
import shlex

import numpy as np
import pytest
from commands import assert_one_error_line, run
from marks import cases
from mutants import killed_by
from project import ROOT
from scipy.stats import norm
from seams import replace_seam
from small_scenarios import RARE
from sweeping import described

from diffabs.cli.show_samples import show_rare_event
from diffabs.loop.batch import Batch
from diffabs.loop.ensemble import run_batch
from diffabs.output.report.documents import find_documents
from diffabs.output.report.studies import rare_section
from diffabs.scenario.scenario import load
from diffabs.uncertainty.reliability.failure import failure_probability

pytestmark = pytest.mark.usefixtures("any_step_is_stable", "without_load")

PAGE = (ROOT / "docs" / "sweeps.md").read_text()
NUMBER = r"\d\S*"


@pytest.fixture
def scenario(file):
    return file(f"{RARE}[sweep.failures]\nstop_distance = 2.8\n")


@pytest.mark.slow
def test_the_document_is_the_librarys_answer(scenario):
    result = json.loads(run("rare", scenario, "stop_distance", "--samples", 200, "--seed", 5, "--json").stdout)
    study = dataclasses.replace(described(RARE), seed=5)  # of the noise, too
    found = failure_probability(study, "stop_distance", 2.8, samples=200, seed=5)
    assert result["probability"] == found.probability
    assert 1e-6 < found.probability < 1e-2
    assert result["interval"] == list(found.interval)
    assert [row["threshold"] for row in result["levels"]] == [level.threshold for level in found.levels]
    assert (result["bound"], result["unit"], result["runs"]) == (2.8, "m", found.evaluations)
    assert len(result["failures"]["plant.mass"]) == 5
    assert min(result["failures"]["initial.speed"]) > 32 / 3.6


@pytest.mark.slow
@pytest.mark.parametrize("runs", cases(["invented", "real"], "real"))
def test_tables_for_a_person(scenario, runs, monkeypatch):
    if runs == "invented":  # 8.5 m/s^2 from each speed to 25 km/h: nothing is compiled
        replace_seam(monkeypatch, "measure_metric", lambda study, metric, at: (at["initial.speed"] ** 2 - 48.2) / 17)
    text = run("rare", scenario, "stop_distance=2.8", "--samples", 200, "--seed", 5).stdout  # as above: compiled
    assert "stop_distance > 2.8 m" in text
    assert re.search(rf"probability {NUMBER}, 95 % interval {NUMBER} to {NUMBER}", text)
    assert re.search(r"initial\.speed +\S +\d", text)


@killed_by("cli.show_samples", "'>' if row['strict'] else '>='", "'>='")
@killed_by("uncertainty.reliability.subset_simulation", "'>' if last.strict else '>='", "'>='")
@killed_by("output.report.studies", '"above" if row.get("strict") else "at least"', '"at least"')
@pytest.mark.slow
def test_a_level_at_the_bound_is_above_it(scenario, tmp_path, capsys, monkeypatch):
    interrupts = [KeyboardInterrupt()]

    def measure(study, metric, at):
        if len(at["initial.speed"]) > 1000 and interrupts:  # importance sampling: after the last level
            raise interrupts.pop()
        return (at["initial.speed"] ** 2 - 48.2) / 17

    replace_seam(monkeypatch, "measure_metric", measure)
    words = ("rare", scenario, "stop_distance=1.75", "--samples", 200, "--engine", "xla")
    assert "interrupted: stop_distance > 1.75 has a probability" in run(*words, status=130).stderr
    path = tmp_path / "rare.json"
    path.write_text(run(*words, "--json").stdout)
    (table,) = [one for one in rare_section(*find_documents(path)).tables if one.title == "Levels"]
    assert [row[1] for row in table.rows] == ["at least", "above"]
    show_rare_event(json.loads(path.read_text()), load(scenario))
    assert re.findall(r"│ \d +│ (>=? 1)", capsys.readouterr().out) == [">= 1", "> 1"]


@killed_by("cli.show_samples", '"undecided" if math.isnan(probability) else ', "")
def test_without_a_failure_the_probability_is_undecided(scenario, monkeypatch):
    replace_seam(monkeypatch, "measure_metric", lambda study, metric, at: np.tanh(at["initial.speed"]))
    text = run("rare", scenario, "stop_distance=2.8", "--samples", 200, "--seed", 5)
    # Clopper and Pearson for 0 of 200: 1 - 0.025^(1/200)
    assert "probability undecided, 95 % interval 0 to 0.0183" in text.stdout
    assert "no sample failed" in text.stderr
    document = json.loads(run("rare", scenario, "stop_distance=2.8", "--samples", 200, "--seed", 5, "--json").stdout)
    assert document["probability"] is None
    assert document["interval"] == [0, pytest.approx(1 - 0.025 ** (1 / 200))]


@pytest.mark.slow
def test_runs_that_diverge_are_an_answer_that_cannot_be_had(scenario):
    result = run("rare", scenario, "overshoot=1", "--samples", 20, "--set", "controller.gain=1e308,1e308", status=1)
    assert_one_error_line(result)
    assert "of 20 runs diverged: " in result.stderr


def conditioned(words, count=2048):
    """P[stop_time > 2.2] another way: given speed, mass and peak, it is that of a normal w4 below what a bisection of
    runs finds; a mean over speeds above 52 km/h, below which w4 would have to be more than 8 deviations away."""
    rig = load(words[1], [word for word in words if "solver" in word])
    rng = np.random.default_rng(1)
    speed = (52 + 8 * (np.arange(count) + rng.random(count)) / count) / 3.6
    values = {
        "initial.speed": speed,
        "plant.mass": rng.uniform(5.3, 6.2, count),
        "plant.road.a": rng.uniform(2e-4, 3.3e-4, count),
    }
    low, high = np.full(count, 0.3), np.full(count, 0.4)
    for _ in range(20):
        middle = (low + high) / 2
        lanes = Batch({**values, "plant.road.w4": middle})
        done = run_batch(rig.loop, lanes, rig.solver, {"t": rig.objectives["stop_time"]})
        late = np.asarray(done.metrics["t"]) >= 2.2
        low, high = np.where(late, middle, low), np.where(late, high, middle)
    return 8 / 40 * np.mean(norm.cdf((low - 0.4) / 0.01))


@pytest.mark.slow
def test_the_example_of_the_page_on_sweeps():
    (command,) = re.findall(r"^    diffabs (rare (?:.*\\\n)*.*)$", PAGE, re.MULTILINE)
    words = shlex.split(command.replace("\\\n", " "))
    result = json.loads(run(*words, "--json").stdout)
    printed = re.search(r"probability of ([\d.e-]+)\s+\(([\d.e-]+) to\s+([\d.e-]+)\)", PAGE)
    expected = [float(text) for text in printed.groups()]
    assert [result["probability"], *result["interval"]] == pytest.approx(expected, rel=0.005)
    assert result["interval"][0] < conditioned(words) < result["interval"][1]
