"""Figures of runs: which curves can be told apart, and what a title says of how a run ended."""

from types import SimpleNamespace

import numpy as np
import pytest
from mutants import killed_by

from diffabs.core.protocols import BalanceOutput, BrakeOutput, Sample
from diffabs.loop.result import Run, Trajectory
from diffabs.output import plot
from diffabs.output.plot import tuning

T = np.linspace(0.0, 1.5, 11)


def trajectory(shows=BrakeOutput):
    sample = Sample(T, shows(*(1.0 + T for _ in shows._fields)), *(0.1 * T for _ in Sample._fields[2:]))
    return Trajectory(sample, sample.output, None, np.arange(11) < 10)


@killed_by("output.plot.runs", '(diverged)".lstrip() if run.diverged', '(diverged)".lstrip() if False')
@pytest.mark.parametrize(
    ("draw", "shows"),
    [(plot.draw_braking, BrakeOutput), (plot.draw_balance, BalanceOutput), (plot.draw_signals, BrakeOutput)],
)
def test_a_title_says_that_a_run_diverged(draw, shows):
    """Its curves end at the last finite sample, and look like those of any other run."""
    run = Run({}, stopped=False, diverged=np.bool_(True), timed_out=False, ending=None, trajectory=trajectory(shows))
    assert draw(run, title="a run").get_suptitle() == "a run (diverged)"
    assert draw(run).get_suptitle() == "(diverged)"
    assert draw(run._replace(diverged=np.bool_(False)), title="a run").get_suptitle() == "a run"


def test_panels_of_speeds_claim_no_stop():
    """A trajectory does not know whether it ended because the vehicle stopped."""
    (panel,) = plot.draw_speeds({"mine": trajectory()}).axes
    assert panel.get_title() == "mine: ends at 1.50 s"


NAMES = [f"run {k}" for k in range(9)]
RUNS = dict.fromkeys(NAMES, trajectory())
NUMBERS = dict.fromkeys(NAMES, np.array([2.0, 1.0]))
ROADS = dict.fromkeys(NAMES, SimpleNamespace(friction=lambda slip, speed, time: slip))
MANY = {
    "slips": lambda: plot.draw_slips(RUNS),
    "positions": lambda: plot.draw_positions([RUNS]),
    "friction": lambda: plot.draw_friction(ROADS),
    "convergence": lambda: plot.draw_convergence({"": NUMBERS}, [0.2, 0.1], orders=[4]),
    "tuning": lambda: tuning.draw_tuning([], RUNS),
}


@killed_by("output.plot.style", "COLOURS[i % 7], ", "COLOURS[i], ", case="slips")
@killed_by("output.plot.style", "DASHES[(i + i // 7) % 7]", "DASHES[i % 7]", case="convergence")
@pytest.mark.parametrize("name", MANY)
def test_nine_curves_are_drawn_and_differ(name):
    drawn = [line for ax in MANY[name]().axes for line in ax.get_lines() if line.get_label().startswith("run ")]
    assert len({(line.get_color(), line.get_linestyle()) for line in drawn}) == len(NAMES)


@killed_by("output.plot.tuning", "color=COLOURS[i % 7], markersize=5", "color=COLOURS[i], markersize=5")
def test_nine_fronts_are_drawn():
    ax = tuning.draw_pareto(dict.fromkeys(NAMES, ([1.0, 2.0], [2.0, 1.0]))).axes[0]
    assert [text.get_text() for text in ax.get_legend().get_texts()] == NAMES
