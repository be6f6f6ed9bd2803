"""Measured runs in the files of data loggers: separators, decimal commas, other names of columns."""

import re

import pytest
from commands import assert_one_error_line, run
from mutants import killed_by
from small_scenarios import IDENTIFY as SMALL

from diffabs.core.protocols import BrakeOutput
from diffabs.parts.plants import QuadrupleTank, QuarterCar
from diffabs.scenario.measurements import loop_columns, read_measurements
from diffabs.scenario.scenario import ScenarioError

UNITS = BrakeOutput.units
T, SLIP, SPEED = [0.0, 0.25, 1.5], [0.0, 0.125, 1e-3], [13.5, 12.0, 0.5]


@pytest.fixture
def csv(tmp_path):
    def write(text: str):
        (tmp_path / "run.csv").write_bytes(text.encode())
        return tmp_path / "run.csv"

    return write


LOGGERS = {
    "semicolon and comma": "t [s];slip [1];speed [m/s]\n0;0,0;13,5\n0,25;0,125;12\n1,5;1e-3;0,5\n",
    "semicolon and point": "t [s];slip [1];speed [m/s]\n0;0;13.5\n0.25;0.125;12\n1.5;1e-3;0.5\n",
    "tab and comma": "time\tslip [-]\tspeed (m/s)\n0\t0,0\t13,5\n,25\t0,125\t12,\n1,5\t1,0E-3\t0,5\n",
    "quoted commas": 't [s],slip [1],speed [m/s]\n0,0,"13,5"\n"0,25","0,125",12\n"1,5",1e-3,"0,5"\n',
    "a byte-order mark, CRLF, a last separator": "\ufeffTime [s];slip;speed [m/s];\r\n0;0;13,5;\r\n0,25;0,125;12;\r\n"
    "1,5;0,001;0,5;\r\n",
    "spaces": "Time ; slip [1] ; speed[m/s]\n 0 ; 0 ; 13,5\n 0,25 ; 0,125 ; 12\n 1,5 ; 1e-3 ; 0,5\n",
    "a comma in a name": "time;slip [1];speed [m/s];note, if any\n0;0;13,5;a\n0,25;0,125;12;b\n1,5;1e-3;0,5;c\n",
}


@killed_by("host.separated", "    return fits[0]\n", '    return ","\n')
@killed_by("scenario.measurements", 'return "," in first', "return False")
@pytest.mark.parametrize("name", LOGGERS)
def test_files_of_loggers(csv, name):
    found = read_measurements(csv(LOGGERS[name]), UNITS, renamed={"slip": "slip"} if "slip;" in LOGGERS[name] else {},
                              strict="note" not in LOGGERS[name])  # fmt: skip
    assert found.t.tolist() == T
    assert found.columns["slip"].tolist() == SLIP
    assert found.columns["speed"].tolist() == SPEED
    assert found.unread == (("note, if any",) if "note" in LOGGERS[name] else ())


def test_columns_are_renamed(csv):
    path = csv("Zeit;Schlupf;v_Fzg;Temp\n0;0;13,5;20\n0,25;0,125;12;21\n")
    renamed = {"Zeit": "t", "Schlupf": "slip", "v_Fzg": "speed [m/s]"}
    found = read_measurements(path, UNITS, renamed=renamed, strict=False)
    assert (found.t.tolist(), found.columns["slip"].tolist(), found.columns["speed"].tolist()) == (
        [0, 0.25], [0, 0.125], [13.5, 12]
    )  # fmt: skip
    assert found.unread == ("Temp",)


def test_a_separator_that_cannot_be_guessed(csv):
    path = csv("t [s];slip [1], raw\n0;0,5\n1;0,25\n")
    with pytest.raises(ScenarioError, match="comma and semicolon both fit; name one of them with --separator"):
        read_measurements(path, UNITS)
    found = read_measurements(path, UNITS, renamed={"slip [1], raw": "slip"}, separator=";")
    assert found.columns["slip"].tolist() == [0.5, 0.25]
    found = read_measurements(csv("t [s]|slip [1]\n0|0,5\n1|0.25\n".replace(".", ",")), UNITS, separator="|")
    assert found.columns["slip"].tolist() == [0.5, 0.25]


WRONG = {
    "Zeit;Schlupf\n0;0,5\n": 'has no column t [s]; the file has "Zeit", "Schlupf"; there is t [s], slip [1]',
    "time;Schlupf\n0;0,5\n": 'column "Schlupf" is unknown; there is t [s], slip [1]',
    "time;slip\n0;0,5\n": 'the file has "time", "slip"; --rename "COLUMN=NAME" gives a column the name',
    "time;slip [%]\n0;0,5\n": 'column "slip [%]" is unknown; did you mean slip [1]?',
    "time [ms];slip [1]\n0;0,5\n": 'has no column t [s]; the file has "time [ms]", "slip [1]"',
    "time;slip [1]\n0,5;0.25\n": 'line 2: "0.25" has another decimal mark than "0,5"',
    "time;slip [1]\n0;0.25\n0,5;1\n": 'line 3: "0,5" has another decimal mark than "0.25"',
    "time;speed [m/s]\n0;1.234,5\n": 'line 2: "1.234,5" has another decimal mark',
    "time;speed [m/s]\n0;1,234,5\n": 'line 2: speed [m/s] = "1,234,5" is text',
    "time;speed [m/s]\n0;1_000\n": 'line 2: speed [m/s] = "1_000" is text',
    "time;speed [m/s]\n0;\uff11\n": "is text; a number is needed",
    "time;t [s];slip [1]\n0;0;0,5\n": 'column "t [s]" occurs twice',
    "time,slip [1]\n0,0,5\n": "line 2: has 3 cells; the header has 2",
}


@pytest.mark.parametrize("text", WRONG)
def test_a_file_that_cannot_be_read_is_one_line(csv, text):
    with pytest.raises(ScenarioError) as caught:
        read_measurements(csv(text), UNITS)
    assert WRONG[text] in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("options", "line"),
    [
        (("--rename", "Zeit"), '--rename "Zeit" is not of the form column=name'),
        (("--rename", "Zeit=t", "--rename", "Zeit=slip"), '--rename "Zeit" is given twice'),
        (("--rename", "Zeit=slop"), '--rename "slop" is not a signal; did you mean slip?'),
        (("--rename", "Ziet=t"), '--rename "Ziet" is no column of'),
        (("--separator", ""), '--separator "" is no separator'),
        (("--separator", "7"), '--separator "7" is no separator'),
        (("--separator", ";;"), '--separator ";;" is no separator'),
    ],
)
@pytest.mark.usefixtures("any_step_is_stable")
def test_options_that_fit_no_file(file, csv, options, line):
    path = csv("Zeit;Schlupf\n0;0,5\n1;0,4\n")
    result = run("identify", file(SMALL), "--data", path, "--free", "plant.mass", *options, status=2)
    assert_one_error_line(result)
    assert line in result.stderr


def test_readings_have_a_record(csv):
    readings = read_measurements(csv("t [s],slip [1],speed [m/s]\n0,0,13.5\n0.25,0.125,12\n1.5,1e-3,0.5\n"), UNITS)
    assert readings.select(["slip"]).record() == {"samples": 3, "columns": ["slip"], "until": 1.5}


@pytest.mark.parametrize(
    ("plant", "own", "other"),
    [
        (QuadrupleTank(), "control_pump_1 [V],target_level_2 [m]", "control_pump_3 [V]"),
        (QuadrupleTank(), "feedforward_pump_2 [V]", "setpoint [m]"),
        (QuarterCar(), "control [N m],target [1]", "control_pump_1 [V]"),
    ],
)
def test_only_columns_of_the_plants_own_channels_are_left_out(csv, plant, own, other):
    output, unit = next(iter(plant.shows.units.items()))
    ignored, cells = loop_columns(plant), ",".join("1" for _ in own.split(","))
    text = f"t [s],{output} [{unit}],{own}\n0,0.1,{cells}\n1,0.2,{cells}\n"
    assert [*read_measurements(csv(text), plant.shows.units, ignored=ignored).columns] == [output]
    with pytest.raises(ScenarioError, match=re.escape(f'column "{other}" is unknown')):
        read_measurements(csv(text.replace(own, f"{other},{own}")), plant.shows.units, ignored=ignored)
