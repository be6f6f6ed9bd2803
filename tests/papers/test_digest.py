"""What `reproduce` shows a person: counted and judged from the record, and fit for 80 columns."""

import io
import re

import pytest
from mutants import killed_by
from rich.console import Console

from diffabs import papers
from diffabs.cli import show
from diffabs.papers import arm_balance, lmi_design, record, slip_estimator, slip_lmi
from diffabs.papers.digest import Refuted, count_computed, count_published, decimals, is_close, verdict


def estimator(**changed):
    """A record of [est] with our numbers a little off the printed ones; others by place."""
    rows = []
    for number, method in ((1, "conventional"), (2, "proposed")):
        for name in ("no ABS", *(f"{method} {controller}" for controller in slip_estimator.PID_GAINS)):
            for quantity, unit, value in zip(("stopping time", "stopping distance"), "sm",
                                             slip_estimator.PUBLISHED_STOPS[name], strict=True):  # fmt: skip
                label = f"Table {number}: {name}"
                rows.append(record.printed_row(label, quantity, unit, value + changed.get(name, 0.004), value))
    rows += [{**row, "name": f"{row['name']} (Magic Formula)", "matches": False} for row in rows]
    rows.append(
        record.computed_row(
            "estimator as printed, step 0.0001 s, after 10 s", "distance", "m", changed.get("rolls", 277)
        )
    )
    locked = changed.get("locked", 1.224)
    rows.append(record.computed_row("no ABS, from lock to stop", "time", "s", locked, published=1.4))
    rows.append(record.computed_row("bound, torque 90 N m", "distance", "m", 42.1808, reference=42.1808))
    return {"paper": "slip-estimator", "title": slip_estimator.TITLE, "rows": rows, "figures": ["a.png"] * 9}


def rig():
    rows = [
        record.computed_row(name, quantity, slip_lmi.QUANTITY_UNITS[quantity], value * (1 + 3e-8), reference=value)
        for name, values in slip_lmi.REFERENCE_RUNS.items()
        for quantity, value in zip(slip_lmi.COMPARED_QUANTITIES, values, strict=True)
    ]
    for name, values in slip_lmi.REFERENCE_CAR.items():
        for quantity, value in zip(("stop_time", "stop_distance"), values, strict=True):
            rows.append(record.computed_row(name, quantity, "", value, reference=value))
    rows.append(record.computed_row("order of the step: 5.3 kg, from slip 0.1", "stop_time", "1", 3.8, reference=4.0))
    known = {
        ("friction curve, local peak", "slip"): 0.1875,
        ("K = [-11753, -48], 5..50 km/h", "common Lyapunov matrix"): 0.0,
        ("k1 = -11753", "least |k2| with a common one"): 76.63,
        ("LMI, Q = diag(1, 1), (31) as printed", "trace Z"): 20.8,
        ("LMI, Q = diag(1, 1)", "trace Z"): 4.59,
    }
    rows += [record.computed_row(*place, "", value, reference=value) for place, value in known.items()]
    return {"paper": "slip-lmi", "title": slip_lmi.TITLE, "rows": rows, "figures": ["a.png"] * 11}


def arm():
    rows = [
        record.computed_row("correct, no limit", "fell", "1", 1.0),
        record.computed_row("correct, 48 V", "fell", "1", 1.0),
        record.computed_row("hanging", "fell", "1", 0.0),
        record.computed_row("hanging arm", "bound, multiple at 48 V", "1", 0.0933),
        record.computed_row("hanging arm, LQR", "recovered multiple at 24 V", "1", 0.045, reference=0.046),
        record.computed_row("printed model, Fig. 3", "peak_voltage", "V", 479.405, reference=479.0),
        record.computed_row("map, weights tuned by gradients", "share", "1", 0.4818),
    ]
    rows += [
        record.computed_row("Acrobot, LQR", f"-K of {i}", "", k + 2e-7, published=k)
        for i, k in enumerate(arm_balance.SPONG)
    ]
    return {"paper": "arm-balance", "title": arm_balance.TITLE, "rows": rows, "figures": ["a.png"] * 4}


def drawn(summary, width=80, **options):
    file = io.StringIO()
    Console(file=file, width=width, markup=False, highlight=False, **options).print(
        show.show_digest(papers.compact(summary))
    )
    return file.getvalue()


def words(digest):
    """Every word that must be found whole."""
    cells = [*digest.headings, *(cell for line in digest.lines for cell in line)]
    return {w for text in [digest.title, *cells, *digest.agreement, *sum(digest.verdicts, ())] for w in text.split()}


SUMMARIES = {"slip-estimator": estimator, "slip-lmi": rig, "arm-balance": arm}


@pytest.mark.parametrize("name", SUMMARIES)
def test_it_fits_80_columns_and_no_word_is_broken(name):
    summary = SUMMARIES[name]()
    text = drawn(summary)
    assert max(map(len, text.splitlines())) <= 80
    assert words(papers.compact(summary)) <= set(text.split())
    assert "…" not in text


@pytest.mark.parametrize("name", SUMMARIES)
def test_each_line_of_the_table_and_each_verdict_is_one_line(name):
    summary = SUMMARIES[name]()
    digest, text = papers.compact(summary), drawn(summary)
    lines = [line.split() for line in text.splitlines()]
    for cells in digest.lines:
        assert " ".join(cells).split() in lines
    for word, sentence in digest.verdicts:
        assert [word, *sentence.split()] in lines
    others = 3 + sum(len(sentence) // 75 + 1 for sentence in digest.agreement)
    assert len(lines) <= others + len(digest.lines) + len(digest.verdicts)


@pytest.mark.parametrize("name", SUMMARIES)
def test_a_dumb_terminal_gets_plain_text(name, monkeypatch):
    monkeypatch.setenv("TERM", "dumb")
    plain = drawn(SUMMARIES[name](), width=None, force_terminal=True)
    assert not re.search(r"\x1b|\r", plain)
    assert plain.split() == drawn(SUMMARIES[name]()).split()


@killed_by("papers.digest", 'return row["matches"] if "matches" in row else', 'return True if "matches" in row else')
def test_published_numbers_are_counted_from_the_record():
    assert "20 of 20 published numbers reproduced (Tables 1, 2: to the printed digit)." in drawn(estimator())
    off = papers.compact(estimator(**{"proposed PI": 0.0051}))
    assert off.agreement[0].startswith("18 of 20 published numbers")
    assert off.agreement[0].endswith("not Table 2: proposed PI, stopping time: 2.9951; "
                                     "Table 2: proposed PI, stopping distance: 42.865.")  # fmt: skip
    assert count_published("Table 1", []) == "The paper prints no number to compare with: Table 1."
    row = record.computed_row("a", "b", "", -98.6903424, published=-98.690342)
    assert count_published("x", [row]).startswith("1 of 1")
    assert count_published("x", [{**row, "ours": -98.6903427}]).startswith("0 of 1")


@pytest.mark.parametrize(
    ("ours", "reference", "agrees"),
    [(0.0, 0.0, True), (0.4, 0.0, False), (1.0, 1.0, True), (0.9, 1.0, False), (0.205277, 0.205, True),
     (479.405, 479.0, True), (480.0, 479.0, False), (0.045, 0.046, False), (4e-6, 1e-5, False), (1.01e-5, 1e-5, True)],
)  # fmt: skip
def test_what_counts_as_an_independent_number_reproduced(ours, reference, agrees):
    row = record.computed_row("a", "b", "", ours, reference=reference)
    assert is_close(row) is agrees
    assert count_computed([row]).startswith("1 of 1" if agrees else "0 of 1")


@killed_by("papers.digest", 'return row["ours"] == reference', "return False")
@killed_by("papers.digest", "not isinstance(number, str) and ", "")
def test_a_word_is_reproduced_by_the_same_word():
    """A stop that is never reached has no difference from a number."""
    rows = [
        record.computed_row(name, "stop", "s", "never", reference=known) for name, known in (("a", 3.0), ("b", "never"))
    ]
    assert count_computed(rows).endswith("not a, stop: never.")
    assert count_computed(rows[1:]).startswith("1 of 1")
    assert count_published("x", [{**rows[0], "published": 3.0}]).startswith("0 of 1")


def test_decimals_are_those_that_are_written():
    assert [decimals(x) for x in (46.5, 479.0, 1000.0, 1e-5, -0.00257, 0.0)] == [1, 0, 0, 5, 5, 0]


@killed_by("papers.digest", "if claim.false(*values)", "if True")
def test_a_claim_is_refuted_by_the_number_or_holds():
    words = dict.fromkeys(word for word, _ in papers.compact(estimator()).verdicts)
    assert list(words) == ["refuted"]
    (rolls, locked) = papers.compact(estimator(rolls=42.0, locked=1.41)).verdicts
    assert rolls == ("holds", "the estimator as printed brakes: it rolls 42 m in 10 s, a latch brakes")
    assert locked[0] == "holds"
    assert verdict([], Refuted("a", "b", [("no row", "x")], lambda x: True)) is None


def test_every_claim_has_its_numbers_in_the_record():
    for summary, claims in (
        (estimator(), slip_estimator.CLAIMS),
        (rig(), lmi_design.CLAIMS),
        (arm(), arm_balance.CLAIMS),
    ):
        found = papers.compact(summary).verdicts
        assert [word for word, _ in found] == ["refuted"] * len(claims)
