"""Samples that a scenario has in a file: drawn again, kept with the sweep, and refused in one line."""

import decimal
import json

import numpy as np
import pandas as pd
import pyarrow as pa
import pytest
from commands import assert_one_error_line, run
from mutants import killed_by
from sweeping import SCENARIO

from diffabs.scenario import section_sweep
from diffabs.scenario.scenario import ScenarioError, dump, load, loads
from diffabs.uncertainty.sweep import Empirical, Results, sample_files

pytestmark = pytest.mark.usefixtures("any_step_is_stable", "without_load")

MASSES = [5.4, 5.9, 5.5, 6.1]
SPEEDS = [28, 31, 33]  # km/h
MEASURED = SCENARIO.replace(
    "{ low = 5.3, high = 6.2 }", '{ type = "empirical", file = "day/masses.csv", column = "mass [kg]" }'
)
MEASURED = MEASURED.replace(
    "{ low = 28.0, high = 34.0 }", '{ type = "empirical", file = "speeds.parquet", column = "v" }'
)


@pytest.fixture
def scenario(file, tmp_path):
    (tmp_path / "day").mkdir()
    pd.DataFrame({"day": ["mon", "tue", "wed", "thu"], "mass [kg]": MASSES}).to_csv(tmp_path / "day" / "masses.csv")
    pd.DataFrame({"v": list(map(decimal.Decimal, SPEEDS))}).to_parquet(tmp_path / "speeds.parquet")
    return file(MEASURED)


@killed_by("uncertainty.sweep.distributions", "return tuple(x / scale for x in value)", "return tuple(value)")
def test_a_file_is_its_numbers(scenario):
    """In the unit of the path, from the folder of the scenario; the dump holds the numbers themselves."""
    chosen = load(scenario)
    study = section_sweep.build_study(chosen)
    mass, speed = study.space.variables.values()
    assert mass == Empirical(tuple(MASSES))
    np.testing.assert_allclose(speed.values, np.array(SPEEDS) / 3.6, rtol=1e-15)
    assert set(study.draw(0, 200)["plant.mass"]) == set(MASSES)
    again = section_sweep.build_study(loads(dump(chosen).encode(), "again", "again"))
    assert again.table() == study.table()


@pytest.mark.slow
def test_another_file_is_another_sweep(scenario, tmp_path):
    out, args = tmp_path / "out", ("--samples", 64, "--json")
    digest = json.loads(run("sweep", scenario, "--out", out, *args).stdout)["digest"]
    assert set(Results(out).column("plant.mass")) == set(MASSES)
    (tmp_path / "day" / "masses.csv").write_text("mass [kg]\n5.5\n5.6\n")
    result = run("sweep", scenario, "--out", out, *args, "--resume", status=2)
    assert_one_error_line(result)
    assert "holds another sweep: study.space.variables.plant.mass.values is [5.4, 5.9, 5.5, 6.1] there" in result.stderr
    (tmp_path / "day" / "masses.csv").unlink()
    run("simulate", "--from-sweep", out, "--sample", 3)
    assert Results(out).digest == digest


@pytest.mark.slow
def test_it_may_be_set_on_the_command_line_and_interpolated(scenario):
    change = 'sweep.over.plant.mass={type="empirical", file="day/masses.csv", column="mass [kg]", interpolated=true}'
    chosen = section_sweep.build_study(load(scenario, [change]))
    assert chosen.space.variables["plant.mass"] == Empirical(tuple(MASSES), interpolated=True)
    assert not set(chosen.draw(0, 20)["plant.mass"]) <= set(MASSES)


def written(folder, text):
    (folder / "day" / "masses.csv").write_text(text)


@killed_by("uncertainty.sweep.sample_files", "(pa.ArrowException, UnicodeDecodeError)", "pa.ArrowException")
@killed_by("uncertainty.sweep.sample_files", "return read_decimal(value)", "return float(value)")
@killed_by("uncertainty.sweep.sample_files", "decimal.Decimal) else np.nan", "decimal.Decimal) else 0.0")
@pytest.mark.parametrize(
    ("change", "needed"),
    [
        (lambda f: (f / "day" / "masses.csv").unlink(), "cannot read {f}/day/masses.csv: No such file or directory"),
        (lambda f: written(f, "mas [kg]\n5\n"), "masses.csv has no column mass [kg]; did you mean mas [kg]? There is "),
        (lambda f: written(f, "mass [kg]\n5.5\nheavy\n"), "column mass [kg]: 'heavy' in row 2 is no finite number"),
        (lambda f: written(f, "mass [kg],b\n5.5,1\n,2\n"), "column mass [kg]: None in row 2 is no finite number"),
        (lambda f: written(f, "mass [kg]\n\uff16\n6\n"), "column mass [kg]: '\uff16' in row 1 is no finite number"),
        (lambda f: written(f, "mass [kg]\n1_000\n6\n"), "column mass [kg]: '1_000' in row 1 is no finite number"),
        (lambda f: (f / "day/masses.csv").write_bytes(b"mass [kg],\xfc\n5,6\n"), "masses.csv is no csv file: 'utf-8' "),
        (lambda f: written(f, "mass [kg]\n5.5\ninf\n"), "column mass [kg]: inf in row 2 is no finite number"),
        (lambda f: written(f, "mass [kg]\n"), "column mass [kg] is empty"),
        (
            lambda f: written(f, "mass [kg],mass [kg]\n5,6\n"),
            "masses.csv has 2 columns called mass [kg]; one is needed",
        ),
        (lambda f: written(f, ""), "masses.csv is no csv file: "),
        (lambda f: written(f, "mass [kg],b\n1,2\n1,2,3\n"), "masses.csv is no csv file: "),
        (lambda f: written(f, "mass [kg]\n-5.5\n6\n"), "reaches [-5.5, 6], outside (0, inf) kg"),
        (lambda f: (f / "speeds.parquet").write_bytes(b"PAR1 not"), "speeds.parquet is no parquet file: "),
        (lambda f: pd.DataFrame({"v": ["a"]}).to_parquet(f / "speeds.parquet"), "column v: 'a' in row 1 is no finite"),
    ],
)
def test_what_is_wrong_with_a_file_is_said(scenario, tmp_path, change, needed):
    change(tmp_path)
    result = run("sweep", scenario, "--out", tmp_path / "out", status=2)
    assert_one_error_line(result)
    assert result.stderr.startswith("error: sweep.over.")
    assert needed.format(f=tmp_path) in result.stderr


@pytest.mark.parametrize(
    ("given", "needed"),
    [
        ('{type="empirical", file="day/masses.csv"}', 'column is missing: name a column of "day/masses.csv"'),
        ('{type="empirical", file=3, column="v"}', "plant.mass.file = 3 is a number; text is needed"),
        ('{type="empirical", file="day/masses.csv", column=["v"]}', "is a list; text is needed"),
        ('{type="empirical", file="day/masses.txt", column="v"}', "day/masses.txt is neither .csv nor .parquet"),
        ('{type="empirical", file="day", column="v"}', "day is neither .csv nor .parquet"),
        ('{type="empirical", file="a.csv", column="v", values=[5.5]}', "has values and a file; one of them is needed"),
        ('{type="uniform", file="a.csv", column="v"}', "plant.mass"),
    ],
)
def test_what_is_wrong_with_the_table_is_said(scenario, given, needed):
    with pytest.raises(ScenarioError) as error:
        section_sweep.build_study(load(scenario, [f"sweep.over.plant.mass={given}"]))
    assert needed in str(error.value)
    assert "\n" not in str(error.value)


@killed_by("uncertainty.sweep.sample_files", "pa.BufferReader(file.read())", "file")
@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
def test_no_thread_of_the_reader_holds_a_python_file(suffix, tmp_path, monkeypatch):
    """Such a thread ends the process by an abort if it is alive when Python ends, often with one core."""
    (tmp_path / f"gap{suffix}").write_bytes(b"")
    sources = []
    monkeypatch.setitem(
        sample_files.TABLE_READERS, suffix, lambda source: sources.append(source) or pa.table({"v": []})
    )
    with pytest.raises(ValueError, match="column v is empty"):
        sample_files.read_column(tmp_path / f"gap{suffix}", "v")
    assert isinstance(sources[0], pa.BufferReader)
