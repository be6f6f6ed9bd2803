"""The numbers beside the pages of the studies are those that the studies print."""

import dataclasses
import importlib
import json

import pytest
from project import ROOT

from experiments._shared import numbers

STUDIES = ROOT / "experiments"
SHORTER = "shorter than the paper's [%]"
QUICK = {  # parts that take up to three minutes each on an idle machine; the others take up to hours
    "lab_rig": {"": "run"},
    "mean_intervals": {"": "run"},
    "slip_estimator": {"sampled": "sampled", "changing-road": "changing_road"},
}


def test_a_number_beyond_the_tolerance_is_named(tmp_path):
    results = {"rows": [{"law": "normal", "length": 1.25, "even": True, "last": None}], "versions": {"jax": "1"}}
    path = numbers.store_numbers(str(tmp_path / "run.py"), results)
    assert numbers.find_differences(path, results | {"versions": {"jax": "2"}}) == []
    rows = [{"law": "normal", "length": 1.25 * (1 + 1e-7), "even": True, "last": None}]
    assert numbers.find_differences(path, {"rows": rows}) == []
    rows[0] |= {"length": 1.2501, "even": False}
    lines = ["rows.0.length: 1.25 in the file, 1.2501 here", "rows.0.even: True in the file, False here"]
    assert numbers.find_differences(path, {"rows": rows}) == lines
    assert len(numbers.find_differences(path, {"rows": []})) == 1
    assert json.loads(path.read_text())["tolerance"] == numbers.TOLERANCE


def test_each_part_of_a_study_keeps_its_numbers(tmp_path):
    parts = {"b": lambda: {"x": 1.0}, "a": lambda: {"x": 2.0}}
    for run in numbers.store_parts(str(tmp_path / "run.py"), parts).values():
        run([])
    path = tmp_path / numbers.FILE
    assert json.loads(path.read_text())["tables"] == {"a": {"x": 2.0}, "b": {"x": 1.0}}
    assert numbers.find_differences(path, {"x": 2.001}, "a") == []
    assert numbers.find_differences(path, {"x": 2.001}, "b") == ["x: 1.0 in the file, 2.001 here"]


@pytest.mark.parametrize("name", [folder.parent.name for folder in sorted(STUDIES.glob(f"*/{numbers.FILE}"))])
def test_numbers_have_tables_and_a_tolerance(name):
    stored = json.loads((STUDIES / name / numbers.FILE).read_text())
    assert stored["format"] == "diffabs numbers 1"
    assert 0 < stored["tolerance"] <= 0.01
    assert stored["tables"]


@pytest.mark.slow
@pytest.mark.parametrize(("name", "part"), [(name, part) for name, parts in QUICK.items() for part in parts])
def test_a_study_prints_the_numbers_of_its_file(name, part, tmp_path):
    pytest.importorskip("matplotlib")
    study = importlib.import_module(f"experiments.{name}.{QUICK[name][part]}")
    results = study.main(dataclasses.replace(study.Config(), out=str(tmp_path)))
    assert numbers.find_differences(STUDIES / name / numbers.FILE, results, part) == []


def critical_lags(tables):
    return {row["at"]: [f"{row['formula [ms]']:.3g} ms"] for row in tables["critical_lag"] if row["at"] != "20 km/h"}


def coverages(tables):
    laws = {
        "log-normal, sigma 1": "log-normal, deviation 1 of the logarithm",
        "exponential": "exponential",
        "log-normal, sigma 0.5": "log-normal, deviation 0.5 of the logarithm",
        "gamma, shape 4": "gamma, shape 4",
        "log-normal, sigma 1.5": "log-normal, deviation 1.5 of the logarithm",
    }
    return {
        words: [f"{row['ours [%]']:.0f} %" for row in tables["rows"] if row["law"] == law]
        for law, words in laws.items()
    }


def two_digits(percent):
    return f"{percent:#.2g}".rstrip(".") + " %"


def distances_behind_an_edge(tables):
    names, tables = {"proposed, latch": "latch", "conventional, slip 0.2": "fixed slip of 0.2"}, tables["changing-road"]
    places = {row["place of the peak"]: row for row in tables["by place"]}
    rows = {}
    for row in tables["table"]:
        at_one, further = (two_digits(places[place][row["rule"]]) for place in (1.0, 1.7))
        only = "" if row["rule"] != "proposed, latch" else at_one
        rows[names[row["rule"]]] = [two_digits(row["mean [%]"]), f"{row['worst [%]']:.0f} %", only, further]
    return rows


def distances_over_roads(tables):
    names = {"slip estimator": "proposed", "slip estimator, noise": "proposed, noise 0.1 m/s2"}
    rows, printed = {row["control"]: row for row in tables["table"]}, {}
    for words, name in names.items():
        row, paper = rows[name], "" if words == "slip estimator" else ", paper's gains {:.3f}"
        paper_worst = row["worst lane, paper's"]
        printed[words] = [
            f"{abs(row['shorter [%]']):.2f} +- {row['+- [%]']:.2f} % longer",
            f"{row['tuned']:.3f}" + paper.format(row["paper's gains: distance/shortest"]),
            f"{row['worst lane, tuned']:.2f}, paper's gains {paper_worst:.2f}",
            str(row["not stopped"]),
        ]
    return printed


def distances_above_the_bound(tables):
    rows = {row["rule"]: row for row in tables["exact sensors"]["table"]}
    kinds = {row["rule"]: row for row in tables["exact sensors"]["by road"]}
    printed = {}
    for name in ("tuned, latch", "tuned, robust latch", "tuned, fixed slip", "tuned, extremum seeking"):
        row, kind = rows[name], kinds[name]
        one, less, more = kind["one surface"], kind["with an edge, to less friction"], kind["with an edge, to more"]
        printed[name] = [
            f"{row['above the bound [%]']:.2f} +- {row['+- [%]']:.2f}",
            f"{row['median [%]']:.2f}, {row['95 % of them [%]']:.1f}",
            f"{row[SHORTER]:.2f} +- {row['+- of that [%]']:.2f}",
            str(row["not stopped"]),
            f"{one:.2f}" if one < 1 else f"{one:.1f}",
            f"{less:.1f}, {more:.1f}",
        ]
    best = printed.pop("tuned, extremum seeking")  # in bold, as its distances
    printed["**tuned, extremum seeking**"] = [f"**{best[0]}**", best[1], f"**{best[2]}**", *best[3:]]
    return printed


def overshoots_at_weak_spots(tables):
    names = {"published gain": "published gain", "LMI, k1 as published": "LMI, same k1", "**tuned**": "the cure"}
    rows = {row["controller"]: row for row in tables["weak_spots"]}
    printed = {}
    for words, name in names.items():
        spots = [two_places(value) for key, value in rows[name].items() if key != "controller"]
        *others, low_1, low_5, noise = spots[3:]
        printed[words] = [", ".join(spots[:3]), *others, noise, f"{low_1}, {low_5}"]
    return printed


def two_places(percent):
    return f"{percent:.0f}" if percent >= 10 else f"{percent:.1f}"


def recovered_by_two_angles(tables):
    shares = ("95 % of the seeds", "half of the seeds")
    columns = {"multiple": "every seed recovers up to", **dict(zip(shares, shares, strict=True))}
    rows = tables["lqg"]["table"][1:]
    return {words: [f"{row[column]:.3f}" for row in rows] for column, words in columns.items()}


def recovered_by_weights(tables):
    """The page has the tuned gain in bold."""
    words = ("Q = I, R = 1", "Q = I, R = 0.01", "diag(1, 100, 1, 1, 1, 1), R = 0.01")
    rows = tables["weights"]["table"]
    tuned, weights = rows.pop(), tables["weights"]["weights"]
    q = ", ".join(f"{value:.{0 if value > 100 else 1 if value > 0.5 else 2}f}" for value in weights["q"])
    return {
        name: [f"{100 * row['share of the box']:.1f} %", f"{row['multiple of (.5, 0, .2)']:.3g}", "none"]
        for name, row in zip(words, rows, strict=True)
    } | {
        f"tuned: diag({q}), R = {weights['R']:.2g}": [
            f"**{100 * tuned['share of the box']:.1f} %**",
            f"**{tuned['multiple of (.5, 0, .2)']:.3f}**",
            "**proved**" if tuned["common P over the riders"] == "yes" else "none",
        ]
    }


def gains_of_rules(tables):
    rules = ("SIMC PI", "AMIGO PI", "AMIGO PID")
    printed = {}
    for row in tables["table"]:
        cells = [f"{row[f'{rule}: {column}']:.2f}" for rule in rules for column in ("ki / best", "peak")]
        printed[row["family"]] = [str(row["models"]), *cells, f"{row['PID: ki / PI']:.1f}"]
    return printed


def norms_of_static_gains(tables):
    def cells(row):
        sizes = f"{row['states']}, {row['controls']}, {row['measurements']}"
        norms = [f"{row[name]:.5g}" for name in ("HIFOO", "norm")]
        counts = [f"{row[name]:,}" for name in ("evaluations of HIFOO", "evaluations")]
        return [sizes, *norms, f"{row['norm / HIFOO']:.4f}", *counts, str(row["starts that agree"])]

    return {row["plant"]: cells(row) for row in tables["rows"]}


def stops_of_controllers(tables):
    def cells(row):
        percent = [f"{row[name]:.1f} %" for name in row if "over least" in name]
        locked = [f"{row[name]:.2f} s" for name in row if name.startswith("locked")]
        split = [f"{row['split: distance [m]']:.1f} m", f"{row['split: yaw [rad]']:.2f} rad"]
        split += [f"{row['split: lateral [m]']:.2f} m", f"{row['split: steering wheel [deg]']:.0f} deg"]
        lanes = [f"{row[name]:.1f} m" for name in row if name.startswith("lane change")]
        work = f"{row['brake work, good, 120 km/h [kJ]']:.0f} kJ"
        return [*percent, *locked, *split, *lanes, work, f"{row['all clauses [% of cars]']:.1f} %"]

    return {row["controller"]: cells(row) for row in tables["table"]}


@pytest.mark.parametrize(
    ("name", "printed"),
    [
        ("best_slip", distances_above_the_bound),
        ("car_controllers", stops_of_controllers),
        ("lab_rig", critical_lags),
        ("mean_intervals", coverages),
        ("slip_estimator", distances_behind_an_edge),
        ("overshoot_cured", overshoots_at_weak_spots),
        ("pid_over_roads", distances_over_roads),
        ("hinf_published", norms_of_static_gains),
        ("pid_published", gains_of_rules),
        ("two_wheeler", recovered_by_two_angles),
        ("two_wheeler", recovered_by_weights),
    ],
)
def test_the_table_of_a_page_has_the_numbers_of_its_file(name, printed):
    lines = (STUDIES / name / "README.md").read_text(encoding="utf-8").splitlines()
    rows = [[cell.strip() for cell in line[1:-1].split("|")] for line in lines if line.startswith("|")]
    page = {cells[0]: cells[1:] for cells in rows}
    expected = printed(json.loads((STUDIES / name / numbers.FILE).read_text())["tables"])
    assert {words: page.get(words) for words in expected} == expected
