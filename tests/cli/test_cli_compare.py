"""`diffabs sweep` and `diffabs compare`, in this process: what the tables say, on sweeps of a few lanes."""

import json
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from commands import run
from mutants import killed_by
from scipy.stats import t

from diffabs.cli.show_samples import show_comparison
from diffabs.uncertainty.sweep import Results
from diffabs.uncertainty.sweep.statistics.comparison import _compare_metrics

# one worker makes what these share
pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("any_step_is_stable", "without_load")]

SMALL = ("--samples", "24", "--set", "sweep.chunk=16", "--set", "initial.speed_kmh=30", "--set", "stop.speed_kmh=25")
SMALL += (
    "--set",
    "solver.step=1e-3",
    "--set",
    "solver.duration=1.0",
    "--set",
    "sweep.over.initial.speed_kmh={low=28,high=32}",
)
SMALL += ("--set", "sweep.check=0")


@pytest.fixture(scope="module")
def swept(tmp_path_factory):
    """The same samples under two references, and the JSON of the first."""
    folder = tmp_path_factory.mktemp("swept")
    filtered = ("--set", "reference=filtered-slip", "--set", "reference.time_constant")  # of one structure: one program
    *words, last = ("sweep", "slip-lmi", *SMALL, *filtered)
    document = json.loads(run(*words, f"{last}=1e-3", "--out", folder / "a", "--json").stdout)
    run(*words, f"{last}=0.02", "--out", folder / "b")
    run(*words, f"{last}=1e-3", "--out", folder / "c", "--seed", "1")
    return folder, document


@pytest.mark.slow
def test_the_document_is_about_the_table(swept):
    folder, document = swept
    found = Results(folder / "a")
    assert document["samples"] == 24
    assert document["digest"] == found.digest
    overshoot = found.column("overshoot")
    assert document["metrics"]["overshoot"]["mean"]["value"] == pytest.approx(overshoot.mean(), rel=1e-12)
    assert document["metrics"]["overshoot"]["greatest"] == overshoot.max()
    assert document["worst"]["overshoot"][0] == {"sample": int(overshoot.argmax()), "value": overshoot.max()}
    failed = document["failures"]["overshoot > 0.6"]
    assert failed["count"] == np.sum(overshoot > 0.6)
    assert json.loads((folder / "a" / "summary.json").read_text()) == document


@pytest.mark.slow
def test_a_comparison_is_sample_by_sample(swept):
    folder, _ = swept
    result = json.loads(run("compare", folder / "a", folder / "b", "--metric", "overshoot", "--json").stdout)
    a, b = (Results(folder / name).column("overshoot") for name in "ab")
    row = result["metrics"]["overshoot"]
    assert row["difference"]["value"] == pytest.approx(np.mean(b - a), rel=1e-12)
    assert row["share in which the second is less"]["value"] == 1.0
    half = t.ppf(0.975, 23) * np.std(b - a, ddof=1) / np.sqrt(24)
    below, above = (np.mean(b - a) - row["difference"]["low"], row["difference"]["high"] - np.mean(b - a))
    # The hull of Student's and Hall's intervals, which is longer on one side.
    assert min(below, above) == pytest.approx(half, rel=1e-9)
    assert half < max(below, above) < 1.1 * half


@killed_by("cli.show_samples", 'if row["never"]:', "if False:")
@killed_by("cli.show_samples", "that diverged or were refused", "that diverged")
def test_runs_that_never_reach_an_event_are_said(capsys):
    """Two of seven samples, and one was refused: the other four have statistics."""
    stop = np.array([1.0, np.inf, 2.0, 3.0, 1.5, 2.5, np.inf])
    a, b = (
        SimpleNamespace(
            column={"stop_time": stop + more, "diverged": np.zeros(7, bool)}.__getitem__, accepted=np.arange(7) > 0
        )
        for more in (0.0, 0.1)
    )
    both: Any = (a, b)
    show_comparison({"first": "a", "second": "b", **_compare_metrics(*both, ["stop_time"])})
    line = "warning: stop_time is infinite (never) or not a number in 2 common samples: its statistics leave them out\n"
    shown = capsys.readouterr()
    assert line in shown.err
    assert "7 common samples, 1 left out that diverged or were refused" in " ".join(shown.out.split())


@killed_by("uncertainty.sweep.statistics.comparison", "if len(before) >= MIN_PAIRS:", "if len(before) < MIN_PAIRS:")
def test_a_metric_of_few_runs_has_a_row(capsys):
    """Three of five samples reach the event in both sweeps, and every sample has the other metric."""
    stop = np.array([1.0, np.inf, 2.0, 3.0, 1.5])
    table = {"stop_time": stop, "iae": np.arange(5.0), "diverged": np.zeros(5, bool)}
    a: Any = SimpleNamespace(column=table.__getitem__, accepted=np.ones(5, bool))
    other = table | {"stop_time": np.where(np.arange(5) == 4, np.inf, stop), "iae": np.arange(5.0) + 2}
    b: Any = SimpleNamespace(column=other.__getitem__, accepted=np.ones(5, bool))
    found = _compare_metrics(a, b, ["stop_time", "iae"])
    row = found["metrics"]["stop_time"]
    assert (row["samples"], row["never"], row["difference"], row["first"]) == (3, 2, None, None)
    assert (found["metrics"]["iae"]["samples"], found["metrics"]["iae"]["difference"]["value"]) == (5, 2.0)
    show_comparison({"first": "a", "second": "b", **found})
    shown = capsys.readouterr()
    assert "stop_time" in shown.out
    assert shown.err.startswith("warning: stop_time is finite in 3 common samples: too few for statistics\n")


def test_only_common_samples_are_compared(swept):
    folder, _ = swept
    result = run("compare", folder / "a", folder / "c", status=2)
    assert "the samples are not the same: seed is 0 in the first, 1" in result.stderr
    result = run("compare", folder / "a", folder / "b", "--metric", "overshot", status=2)
    assert "--metric overshot is not in both sweeps; did you mean overshoot?" in result.stderr
    result = run("compare", folder / "a", folder, status=2)
    assert "is no sweep" in result.stderr


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("sweep.samples=-5",), "sweep.samples = -5 is outside [0, 4294967295]"),
        (
            ('sweep.over."plant.mas"=5:6',),
            "sweep.over.plant.mas is not a parameter of this loop; did you mean",
        ),
        (('sweep.over."plant.mass"={type="normal",mean=5.7,deviation=1.0}',), "outside (0, inf) kg"),
        (('sweep.over."plant.mass"={type="norma",mean=5.7}',), "norma"),
        (('sweep.over."plant.mass"={low=6.0,high=5.0}',), "low = 6 is not below high = 5"),
        (('sweep.design="sobols"',), "did you mean sobol"),
        (("sweep.failures.overshot=1.0",), "did you mean overshoot"),
        (('sweep.dtype="float16"',), "sweep.dtype"),
        (("sweep.over={}",), "sweep.over is empty"),
    ],
)
def test_bad_input_is_one_line(tmp_path, options, message):
    changes = [part for option in options for part in ("--set", option)]
    result = run("sweep", "slip-lmi", "--out", tmp_path / "s", *changes, status=2)
    (line,) = [line for line in result.stderr.splitlines() if line.startswith("error: ")]
    assert message in line
    assert not (tmp_path / "s").exists()
