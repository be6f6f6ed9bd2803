"""The papers' numbers: to the printed digit where they print any, to 1e-6 of an independent solution where not."""

import io
import json
import math
import struct
from typing import Any

import numpy as np
import pytest
from seams import replace_seam

pytest.importorskip("matplotlib")

from mutants import killed_by
from reports import Page
from rich.console import Console

from diffabs import FixedStep, rollout
from diffabs.cli import show
from diffabs.output import plot
from diffabs.output.report import build_report, find_documents
from diffabs.papers import PAPERS, REPRODUCTIONS, arm_balance, compact, lmi_design, record, slip_estimator, slip_lmi
from diffabs.parts.objectives import BRAKING
from diffabs.parts.references import FixedSlip
from diffabs.scenario.defaults import braking

pytestmark = pytest.mark.slow  # each reproduces a paper; `make demo` does, too

SMALLEST_FIGURE = 10_000  # bytes: an empty sheet takes less than 6,000


class Reproduced(dict):
    """A summary, with the folder it was written into and what was said meanwhile."""

    folder: Any
    said: list[str]


def _reproduced(name: str, folder: Any) -> Reproduced:
    said: list[str] = []
    summary = Reproduced(REPRODUCTIONS[name](folder, said.append))
    summary.folder, summary.said = folder, said
    return summary


@pytest.fixture(scope="module")
def lmi(tmp_path_factory):
    return _reproduced("slip-lmi", tmp_path_factory.mktemp("slip-lmi"))


@pytest.fixture(scope="module")
def estimator(tmp_path_factory):
    return _reproduced("slip-estimator", tmp_path_factory.mktemp("slip-estimator"))


@pytest.fixture(scope="module")
def arm(tmp_path_factory):
    return _reproduced("arm-balance", tmp_path_factory.mktemp("arm-balance"))


FIXTURES = {"slip-lmi": "lmi", "slip-estimator": "estimator", "arm-balance": "arm"}
SLOW = ("arm-balance", "slip-estimator")  # two maps of 10,000 runs; twenty braking tests


@pytest.fixture(
    params=[pytest.param(name, marks=pytest.mark.slow) if name in SLOW else name for name in sorted(PAPERS)]
)
def paper(request):
    return request.getfixturevalue(FIXTURES[request.param])


def _rows(summary: dict[str, Any], start: str) -> list[dict[str, Any]]:
    found = [row for row in summary["rows"] if row["name"].startswith(start)]
    assert found, start
    return found


@pytest.mark.parametrize("case", slip_lmi.REFERENCE_RUNS)
def test_the_braking_table_is_the_independent_solution(lmi, case):
    rows = {row["quantity"]: row for row in lmi["rows"] if row["name"] == case}
    assert set(rows) == set(slip_lmi.COMPARED_QUANTITIES)
    for row in rows.values():
        # At the torque limits 2e-5 s leaves 5e-8 of the greatest slip; the rest is closer.
        assert row["ours"] == pytest.approx(row["reference"], rel=1e-6), row


def test_a_car_of_the_same_mass_brakes_twice_as_long(lmi):
    for row in _rows(lmi, "5.3 kg, J2") + _rows(lmi, "6.2 kg, J2"):
        assert row["ours"] == pytest.approx(row["reference"], rel=1e-9), row


def test_the_friction_curve_peaks_before_the_target(lmi):
    for row in _rows(lmi, "friction curve"):
        assert row["ours"] == pytest.approx(row["reference"], rel=1e-10), row


def test_filtering_the_reference_cures_the_overshoot(lmi):
    (row,) = _rows(lmi, "reference filter")
    assert row["ours"] == 0.0


def test_the_order_of_the_step(lmi):
    """Four where all is smooth; slip^2.1 at slip 0 leaves 3.1. Both slopes are of few points, hence the width."""
    for row in _rows(lmi, "order of the step: 5.3 kg, from slip 0.1"):
        assert row["ours"] == pytest.approx(4.0, abs=0.3), row
    for row in _rows(lmi, "order of the step: 5.3 kg, torque unlimited"):
        assert row["ours"] == pytest.approx(3.1, abs=0.1), row


def test_the_design_is_that_of_other_solvers(lmi):
    for weights in lmi_design.REFERENCE_GAINS:
        rows = {
            r["quantity"]: r for r in lmi["rows"] if r["name"] == f"LMI, Q = diag({weights[0]:.6g}, {weights[1]:g})"
        }
        assert rows["trace Z"]["ours"] == pytest.approx(rows["trace Z"]["reference"], rel=1e-6)
        for name in ("k1", "k2"):
            assert rows[name]["ours"] == pytest.approx(rows[name]["reference"], rel=1e-3)
    for answer in lmi["design"]["designs"]:
        assert answer["certificate"]["verified_exactly"]
        assert answer["lower_bound"] <= answer["trace_cost"]


def test_the_verdicts_on_the_published_gain(lmi):
    rows = [row for row in lmi["rows"] if row["quantity"] in ("common Lyapunov matrix", "proved stable")]
    assert [row["ours"] for row in rows] == [0.0, 0.0, 1.0, 1.0, 1.0]
    assert all(verdict["verified_exactly"] for verdict in lmi["design"]["verdicts"])
    (row,) = _rows(lmi, "k1 = -11753")
    assert row["ours"] == pytest.approx(76.63, abs=5e-3)
    for row in _rows(lmi, "published gain at 50 km/h"):
        assert row["ours"] == pytest.approx(row["reference"], rel=1e-3)


def test_printed_inequalities_cost_more(lmi):
    """Eq. (31) as printed covers systems that do not exist, so its cost is higher."""
    costs = [[answer["trace_cost"] for answer in lmi["design"][name]] for name in ("designs", "as_printed")]
    assert all(printed > right * 1.005 for right, printed in zip(*costs, strict=True))


def test_overshoot_under_other_gains(lmi):
    (same,), (gentle,) = _rows(lmi, "LMI, same k1"), _rows(lmi, "K = [-121.8, -158.2]")
    assert round(same["ours"], 3) == 0.205
    assert round(gentle["ours"], 4) == 0.0049


@pytest.mark.slow
def test_all_twenty_numbers_round_to_the_printed_ones(estimator):
    rows = [row for row in _rows(estimator, "Table") if "Magic" not in row["name"]]
    assert len(rows) == 20
    assert [f"{row['ours']:.2f}" for row in rows] == [f"{row['published']:.2f}" for row in rows]
    assert estimator["matches"] == {"of": 20, "to the printed digit": 20}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("quantity", "bound"), [("stopping time", 0.0094 + 0.001), ("stopping distance", 0.056 + 0.005)]
)
def test_five_parameters_come_close_to_all_twenty(estimator, quantity, bound):
    rows = [row for row in estimator["rows"] if "(Magic" in row["name"] and row["quantity"] == quantity]
    assert len(rows) == 10
    assert max(abs(row["difference"]) for row in rows) <= bound


@pytest.mark.slow
def test_the_estimator_as_printed_does_not_brake(estimator):
    fine, coarse = (
        next(row["ours"] for row in _rows(estimator, f"estimator as printed, step {step}") if row["unit"] == "m")
        for step in ("0.0001", "0.001")
    )
    rolling = 10 * 100 / 3.6
    assert rolling - 1 < fine < rolling
    # What it brakes is the delay of one sample, so ten times the step brakes ten times as much, to first order.
    assert (rolling - coarse) / (rolling - fine) == pytest.approx(10, rel=0.02)


@pytest.mark.slow
def test_physical_bounds_of_the_distance(estimator):
    for row in _rows(estimator, "bound"):
        assert row["ours"] == pytest.approx(row["reference"], abs=1e-3), row
    best = min(row["ours"] for row in _rows(estimator, "Table 2") if row["unit"] == "m" and "Magic" not in row["name"])
    assert best > max(row["ours"] for row in _rows(estimator, "bound"))


@pytest.mark.slow
def test_passing_remarks_are_judged_in_the_summary(lmi, estimator):
    """What they are worth: test_papers_verdicts.py. Here: that they are written down."""
    abrupt = {r["name"]: r["ours"] for r in estimator["judged"] if r["quantity"] == "variation of the torque"}
    assert len(abrupt) == 8
    assert abrupt["proposed P"] > 3 * abrupt["proposed PI"]
    (nearest,) = [r["ours"] for r in lmi["judged"] if r["name"] == "speed whose LQ gain is the published one"]
    assert nearest == pytest.approx(4.54, abs=5e-3)


@pytest.mark.slow
def test_what_does_not_agree_is_said(estimator):
    (row,) = _rows(estimator, "no ABS, from lock to stop")
    assert row["ours"] == pytest.approx(1.224, abs=1e-3)
    assert any("1.4 s" in note for note in estimator["notes"])
    assert any("true curve stays unknown" in note for note in estimator["notes"])


# How far each number of the arm may be from its reference: half of the last digit of a reference that is rounded.
ARM = {
    "correct model": {"real pole": 6e-9, "unstable zero of theta": 5e-5},
    "printed model, Fig. 3": {"peak_arm_angle": 5e-3, "peak_voltage": 0.5},
    "hanging arm, 0.06 of it": {"peak_lean": 5.1e-6, "peak_arm_angle": 5.1e-6},
}


@pytest.mark.slow
@pytest.mark.parametrize("name", ARM)
def test_numbers_of_the_arm(arm, name):
    rows = [row for row in _rows(arm, name) if row["reference"] is not None]
    assert {row["quantity"] for row in rows} == set(ARM[name])
    for row in rows:
        assert row["ours"] == pytest.approx(row["reference"], abs=ARM[name][row["quantity"]]), row


@pytest.mark.slow
def test_what_the_arm_recovers(arm):
    """Of multiples 0.001 apart; at 24 and 100 V less than the reference, as SciPy says too (test_arm_basin.py)."""
    rows = {row["quantity"]: row for row in _rows(arm, "hanging arm, LQR")}
    for volts, ours, reference in ((24, 0.045, 0.046), (48, 0.080, 0.080), (100, 0.114, 0.116)):
        row = rows[f"recovered multiple at {volts} V"]
        assert (row["ours"], row["reference"]) == (pytest.approx(ours, abs=1e-9), reference)
    fell = {row["name"]: row["ours"] for row in arm["rows"] if row["quantity"] == "fell"}
    assert fell == {"correct, no limit": 1.0, "correct, 48 V": 1.0, "hanging": 0.0, "hanging, tuned": 0.0}
    (bound,) = [row["ours"] for row in _rows(arm, "hanging arm") if row["quantity"] == "bound, multiple at 48 V"]
    assert bound == pytest.approx(0.0933332, abs=5e-8)
    shares = [row["ours"] for row in _rows(arm, "map") if row["quantity"] == "share by area"]
    assert shares == pytest.approx([0.464, 0.4865], abs=2e-3)
    assert [row["ours"] for row in _rows(arm, "map") if row["quantity"] == "share undecided"] == [0, 0]
    assert rows["heaviest rider held"]["ours"] == pytest.approx(71.229, abs=2e-3)


@pytest.mark.slow
def test_spongs_gain_is_printed(arm):
    rows = _rows(arm, "Acrobot")
    assert len(rows) == 4
    for row in rows:
        assert row["ours"] == pytest.approx(row["published"], rel=1e-8)


@pytest.mark.slow
def test_no_gain_recovers_more_than_any_control_can(arm):
    """For each rider; the LQR of one rider loses the heavy ones, the gain that is proved for all does not."""
    bound, riders = np.array(arm["riders"]["bound"]), arm["riders"]
    for name in arm["gains"]:
        assert np.all(np.array(riders[name]) < bound)
    lqr = dict(zip(riders["mass"], riders["LQR for 50 kg"], strict=True))
    assert [m for m in lqr if lqr[m] == 0] == [75, 80, 85, 90, 95, 100]
    assert (lqr[50], lqr[65], lqr[70]) == pytest.approx((0.080, 0.051, 0.026), abs=1.1e-3)
    assert min(riders["LMI for 40 to 100 kg"]) > 0.03


@pytest.mark.slow
def test_what_is_wrong_in_the_arms_paper_is_said(arm):
    for words in ("theta1 - theta2", "Fig. 3 is true of these equations only", "assumed here", "0.0454 and 0.1146"):
        assert any(words in note for note in arm["notes"]), words
    assert len(arm["figures"]) == 4


def test_summary_is_finite_json_with_provenance(paper):
    text = (paper.folder / "summary.json").read_text(encoding="utf-8")
    assert json.loads(text, parse_constant=pytest.fail) == paper
    assert all(math.isfinite(row["ours"]) for row in paper["rows"] + paper["judged"])
    assert {"paper", "title", "rows", "figures", "notes", "solver", "versions"} <= set(paper)
    assert {"diffabs", "jax", "numpy", "python"} <= set(paper["versions"])
    assert len(paper.said) >= 3
    assert len(set(paper.said)) == len(paper.said)


def test_what_a_person_is_shown_fits_and_counts(paper):
    """Of the real record: every claim has its numbers in it, and one paper takes a third of 60 lines."""
    digest = compact(paper)
    claims = {"slip-lmi": lmi_design.CLAIMS, "slip-estimator": slip_estimator.CLAIMS, "arm-balance": arm_balance.CLAIMS}
    assert [word for word, _ in digest.verdicts] == ["refuted"] * len(claims[paper["paper"]])
    console = Console(file=(file := io.StringIO()), width=80)
    console.print(show.show_digest(digest))
    lines = file.getvalue().splitlines()
    assert len(lines) <= 20
    assert max(map(len, lines)) <= 80
    if paper["paper"] == "slip-estimator":
        assert "20 of 20 published numbers reproduced (Tables 1, 2: to the printed digit)." in lines


def test_figures_are_pictures(paper):
    assert sorted(path.name for path in paper.folder.iterdir()) == sorted([*paper["figures"], "summary.json"])
    for name in paper["figures"]:
        data = (paper.folder / name).read_bytes()
        assert data[:8] == b"\x89PNG\r\n\x1a\n"
        width, height = struct.unpack(">II", data[16:24])
        assert min(width, height) >= 400
        assert len(data) > SMALLEST_FIGURE, name


@killed_by("output.report.experiments", "if pathlib.PurePath(name).name == name]", "if False]", case="slip-lmi")
def test_a_report_has_every_number_and_figure(paper):
    """And stands for itself: figures are in it, notes and verdicts are as they were written."""
    page = Page(build_report(find_documents(paper.folder)))
    wanted = {repr(row[key]) for row in paper["rows"] + paper["judged"] for key in ("ours", "difference") if row[key]}
    assert wanted <= set(page.numbers)
    assert len(page.images) == len(paper["figures"])
    assert f"diffabs reproduce {paper['paper']}" in page.text
    for words in (*paper["notes"], *(sentence for _, sentence in compact(paper).verdicts)):
        assert words in page.text
    assert page.foreign == []


def test_rows_say_how_far_they_are():
    assert record.computed_row("a", "q", "m", 3.0, published=2.0)["difference"] == 1.0
    assert record.computed_row("a", "q", "m", 3.0, reference=4.0)["difference"] == -1.0
    assert record.computed_row("a", "q", "m", 3.0)["difference"] is None
    assert record.printed_row("a", "q", "m", 2.994, 2.99)["matches"]
    assert not record.printed_row("a", "q", "m", 2.996, 2.99)["matches"]


def test_a_number_that_is_not_finite_is_not_written(tmp_path):
    with pytest.raises(ValueError, match="not JSON compliant"):
        record.write_summary(tmp_path, {"rows": [math.nan]})
    assert list(tmp_path.iterdir()) == []


@pytest.fixture(scope="module")
def short():
    return rollout(braking(reference=FixedSlip()), FixedStep(step=1e-2, duration=0.1), BRAKING)


@pytest.mark.slow
def test_braking_draws_the_run(short, tmp_path):
    figure = plot.draw_braking(short, title="a run")
    slip, speed, torque, deceleration = figure.axes
    assert [line.get_label() for line in slip.lines] == ["slip", "target", "setpoint"]
    assert speed.get_ylabel() == "speed [km/h]"
    np.testing.assert_allclose(speed.lines[1].get_ydata()[0], 100.0, rtol=1e-12)
    np.testing.assert_allclose(torque.lines[1].get_ydata()[0], 90.0, rtol=1e-12)
    assert deceleration.get_ylabel() == "deceleration [m/s²]"
    assert plot.save_figure(figure, tmp_path / "run.png").stat().st_size > SMALLEST_FIGURE
    assert [path.name for path in tmp_path.iterdir()] == ["run.png"]


def test_a_run_without_a_trajectory_cannot_be_drawn(short):
    with pytest.raises(ValueError, match="rollout"):
        plot.draw_braking(short._replace(trajectory=None))  # what `measure` returns


def test_a_figure_that_fails_leaves_nothing_behind(tmp_path):
    figure, _ = plot.sheet()
    with pytest.raises(ValueError, match="nonsense"):
        plot.save_figure(figure, tmp_path / "x.nonsense")
    assert list(tmp_path.iterdir()) == []


def test_without_a_solver_the_design_is_left_out(monkeypatch):
    def missing():
        raise ModuleNotFoundError('robust design needs cvxpy: pip install ".[design]" in a clone', name="cvxpy")

    replace_seam(monkeypatch, "designed", missing)
    rows, figures, more = slip_lmi._design_section({}, None)
    assert (rows, figures, more["design"]) == ([], {}, None)
    assert 'pip install ".[design]" in a clone' in more["notes"][0]
