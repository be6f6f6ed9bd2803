"""What commands refuse: one table of command, exit status and the texts that the message contains.

A refusal is one line on stderr, nothing on stdout, no file, and nothing dear is computed first."""

import shlex
import types
from pathlib import Path
from typing import get_type_hints

import pytest
import typer
from commands import assert_one_error_line, run
from marks import readable_id
from mutants import killed_by
from seams import replace_seam
from small_scenarios import IDENTIFY, MEASUREMENTS, RARE, SWEEP, TUNE

from diffabs.cli import main, targets

FILES = {
    "identify.toml": IDENTIFY,
    "rare.toml": f"{RARE}[sweep.failures]\nstop_distance = 2.8\n",
    "run.csv": MEASUREMENTS,
    "sweep.toml": SWEEP,
    "tune.toml": TUNE,
}
# Options that a command is given if it has none of its own: a file that must not be written.
TARGETS = {
    "certify": "--out c.json --json",
    "identify": "--out c.toml --json",
    "simulate": "--csv c.csv --json",
    "sweep": "--out out",
    "tune": "--out c.toml --json",
}
REFUSALS = [
    # usage
    ("sweep slip-lmi --workers 0 --on dask", 2, ["--workers 0 is outside [1, 8]"]),
    ("sweep slip-lmi --devices 0", 2, ["--devices 0 is outside [1, 8]"]),
    ("rare slip-lmi iae --samples many", 2, ["--samples", "many"]),
    ("simulate --nonsense", 2, ["no such option: --nonsense"]),
    ("design", 2, ["missing argument"]),
    ("simulat", 2, ["Did you mean 'simulate'?"]),
    ("simulate a 'b\nc'", 2, ["unexpected extra argument"]),
    # files that are inputs or that other options name
    ("simulate tune.toml --mat ./tune.toml", 2, ["--mat tune.toml is the scenario itself"]),
    ("design tune.toml --out tune.toml", 2, ["--out tune.toml is the scenario itself"]),
    ("export tune.toml -o tune.toml", 2, ["--out tune.toml is the scenario itself"]),
    ("show tune.toml --out tune.toml", 2, ["--out tune.toml is the scenario itself"]),
    ("tune tune.toml --out tune.toml", 2, ["--out tune.toml is the scenario itself"]),
    ("sweep sweep.toml --out sweep.toml", 2, ["--out sweep.toml is the scenario itself"]),
    (
        "identify identify.toml --data run.csv --free plant.mass --out run.csv",
        2,
        ["--out run.csv is the file of --data itself"],
    ),
    (
        "prove slip-lmi --over plant.mass=5:6 --out a.png --plot ./a.png",
        2,
        ["--out and --plot are the same file, a.png"],
    ),
    # prove
    ("prove slip-lmi", 2, ["missing option '--over'"]),
    ("prove slip-lmi --over plant.mass", 2, ['--over "plant.mass" is not of the form path=low:high']),
    ("prove slip-lmi --over plant.mas=5:6", 2, ["did you mean plant.mass?"]),
    ("prove slip-lmi --over plant.mass=6:5", 2, ["is inverted"]),
    ("prove slip-lmi --over plant.mass=-1:5", 2, ["outside (0, inf) kg"]),
    (
        "prove slip-lmi --over controller.high=9:inf",
        2,
        ["--over controller.high = [9.0, inf]: both ends must be finite"],
    ),
    ("prove slip-lmi --over plant.mass=5:6 --claim max_slp=1", 2, ["did you mean max_slip?"]),
    ("prove slip-lmi --over plant.mass=5:6 --claim max_slip=x", 2, ["needs a finite number: max_slip=BOUND"]),
    ("prove slip-lmi --over plant.mass=5:6 --claim overshoot=nan", 2, ["needs a finite number: overshoot=BOUND"]),
    ("prove slip-lmi --over plant.mass=5:6 --claim overshoot=-1", 2, ["--claim overshoot = -1 is outside [0, inf)"]),
    ("prove slip-lmi --over plant.mass=5:6 --claim no_lock=1", 2, ["no_lock has no bound"]),
    ("prove slip-lmi --over plant.mass=5:6 --budget 0", 2, ["--budget = 0 is outside (0, inf) s"]),
    (
        "prove slip-lmi --over plant.mass=5:6 --over initial.speed=5:6 --over reference.slip=0.1:0.2 --plot a.png",
        2,
        ["--plot draws one or two parameters; 3 of --over have more than one value"],
    ),
    ("prove slip-lmi --over plant.mass=5:6 --plot a.txt", 2, ["the name must end in .png, .pdf, .svg"]),
    ("prove slip-cured --over controller.period=1e-3:2e-3", 2, ["no rule for a range of periods or delays"]),
    ("prove slip-real --over plant.mass=5:6", 2, ["ticks with the integration grid"]),
    ("prove slip-estimator --over plant.mass=12:13", 2, ["has events"]),
    # margins
    (
        "margins slip-lmi --set reference=setpoint --set reference.value=0.2 --set design.over.reference.slip=0.1,0.2",
        2,
        ["parameter of the linear model, but not of this loop: remove it from [design.over]"],
    ),
    ("margins quadruple-tank --over plant.share_1=0.6:0.7", 2, ["margins --over without --bounds"]),
    ("margins slip-lmi --bounds --over plant.mass=5:6 --at plant.mass=5", 2, ["--at fixes plant.mass"]),
    ("margins slip-lmi --bounds --at target=0.2 --over plant.mass=5:6", 2, ["--at target does not go with --bounds"]),
    ("margins quadruple-tank --bounds", 2, ["--bounds needs ranges: --over PATH=LOW:HIGH, or [design.over]"]),
    # export
    ("export slip-cured --to cc", 2, ["error: --to: 'cc' is not one of 'c', 'st', 'fmu'"]),
    ("export slip-cured --given slip", 2, ["error: --given: 'slip' is not one of 'target'"]),
    # compile
    ("compile slip-lmi --show jpv", 2, ["--show jpv is unknown; did you mean jvp?"]),
    (
        "compile slip-lmi --by plant.mas",
        2,
        ["--by plant.mas is no tunable number of this loop; did you mean plant.mass?"],
    ),
    ("compile slip-lmi --by plant.mass --by plant.mass", 2, ["a parameter is given twice"]),
    ("compile slip-lmi --show c --json", 2, ["--json is for the numbers of operations"]),
    ("compile slip-lmi --out c.txt", 2, ["--out is for the text of --show"]),
    # simulate
    ("simulate slip-lim", 2, ["did you mean slip-lmi?"]),
    ("simulate none.toml", 2, ["No such file"]),
    ("simulate ''", 2, ["the name of the scenario is empty"]),
    ("simulate slip-lmi --set plant.mass=-1", 2, ["plant.mass = -1 is outside (0, inf) kg"]),
    ("simulate slip-lmi --set road.w4=nan", 2, ["road.w4 = nan is outside [0, inf)"]),
    ("simulate slip-lmi --set contrller.gain=1,2", 2, ["did you mean controller?"]),
    ("simulate slip-lmi --set controller.gain=hello", 2, ['controller.gain = "hello" is text; a list of numbers']),
    ("simulate slip-lmi --set controller.torque_max=9", 2, ["state-feedback; it is now high"]),
    ("prove slip-lmi --over controller.torque_max=8:9", 2, ["it is now controller.high"]),
    ("simulate slip-lmi --set plant.mass", 2, ["section.field=value"]),
    ("simulate slip-lmi --seed -1", 2, ["solver.seed = -1 is outside [0, 4294967295]"]),
    ("simulate arm-hanging --set plant.body_inertia=-1", 2, ["plant.body_inertia = -1 is outside [0, inf) kg m^2"]),
    ("simulate arm-hanging --set plant.arm_inertia=-1", 2, ["plant.arm_inertia = -1 is outside (0, inf) kg m^2"]),
    ("simulate arm-hanging --set plant.resistance=0", 2, ["plant.resistance = 0 is outside (0, inf) ohm"]),
    ("simulate arm-hanging --set actuator.high=-48", 2, ["actuator.high = -48 is outside (0, inf) V"]),
    ("simulate arm-hanging --set controller=proportional-feedback", 2, ["proportional-feedback needs speed"]),
    ("simulate arm-hanging --set stop=standstill", 2, ["standstill needs speed"]),
    ("simulate arm-hanging --set objective.overshoot=max-slip", 2, ["objective.overshoot: max-slip needs slip"]),
    ("simulate arm-hanging --set initial=brake-start", 2, ["arm-balance needs theta; there is only speed, slip"]),
    # identify
    (
        "identify identify.toml --data run.csv --free plant.mas",
        2,
        ["--free plant.mas is not a parameter of this loop; did you mean plant.mass?"],
    ),
    (
        "identify identify.toml --data run.csv --free plant.mass=5",
        2,
        ['--free "plant.mass=5" is not of the form path or path=low:high'],
    ),
    ("identify identify.toml --data run.csv --free =1:2", 2, ['--free "=1:2" is not of the form']),
    (
        "identify identify.toml --data run.csv --free plant.mass=a:8",
        2,
        ['--free plant.mass.low = "a" is text; a number in (0, inf) kg is needed'],
    ),
    (
        "identify identify.toml --data run.csv --free plant.mass=8:4",
        2,
        ["--free plant.mass = [8.0, 4.0] is empty: a range { low, high } in (0, inf) kg"],
    ),
    (
        "identify identify.toml --data run.csv --free plant.mass=-1:4",
        2,
        ["--free plant.mass = [-1.0, 4.0] is outside (0, inf) kg"],
    ),
    (
        "identify identify.toml --data run.csv --free plant.mass=6:8",
        2,
        ["plant.mass = 5.3 is outside (6, 8) kg, its range in --free"],
    ),
    ("identify identify.toml --data run.csv --free road.w4 --free plant.road.w4", 2, ["--free road.w4 is given twice"]),
    (
        "identify identify.toml --data run.csv --free plant.mass=4:8 --free road.w4 --sigma slip",
        2,
        ['--sigma "slip" is not of the form column=number'],
    ),
    (
        "identify identify.toml --data run.csv --free plant.mass=4:8 --free road.w4 --sigma slp=1",
        2,
        ['--sigma "slp" is not a column of the data; did you mean slip?'],
    ),
    (
        "identify identify.toml --data run.csv --free plant.mass=4:8 --free road.w4 --sigma slip=0",
        2,
        ["--sigma slip = 0 is outside (0, inf)"],
    ),
    (
        "identify identify.toml --data run.csv --free plant.mass=4:8 --free road.w4 --sigma wheel_speed=much",
        2,
        ['--sigma wheel_speed = "much" is text; a number in (0, inf) m/s is needed'],
    ),
    (
        "identify identify.toml --data run.csv --free plant.mass=4:8 --free road.w4 --sigma slip=0.1 --sigma slip=5",
        2,
        ["--sigma slip is given twice"],
    ),
    (
        "identify identify.toml --data run.csv --free plant.mass=4:8 --free road.w4 --column speed",
        2,
        ['--column "speed" is not in the data; did you mean wheel_speed?'],
    ),
    (
        "identify identify.toml --data run.csv --free plant.mass=4:8 --free road.w4 --out found",
        2,
        ["--out found: the name must end in .toml"],
    ),
    (
        "identify identify.toml --data run.csv --free plant.mass=4:8 --free road.w4 --set plant.mass=0",
        2,
        ["plant.mass = 0 is outside (0, inf) kg"],
    ),
    (
        "identify identify.toml --data run.csv --free plant.mass=4:8 --free road.w4 --set solver.duration=0.1",
        2,
        ["t = 0 ... 0.3 s leaves [0, 0.1] s, the solver's duration"],
    ),
    # certify
    (
        "certify slip-lmi --gain=1,2,3",
        2,
        ['--gain "1,2,3" has 3 of 2 numbers, one for each of integral of slip error, slip error'],
    ),
    ("certify slip-lmi '--gain=1;2'", 2, ['--gain "1;2": numbers are needed, as in --gain=-11753,-48']),
    ("certify slip-lmi --gain=", 2, ['--gain "": numbers are needed']),
    ("certify slip-lmi --gain=nan,1", 2, ['--gain "nan,1" is outside (-inf, inf)']),
    (
        "certify slip-lmi --set design.Q=1,1,1",
        2,
        ["design.Q has shape (3,); it needs (2, 2), or its diagonal (2,); the states are"],
    ),
    ("certify slip-lmi --set design.R=1,1", 2, ["design.R has shape (2,); it needs (1, 1)"]),
    ("certify slip-cured --set design.damping=0.5", 2, ["design.damping = 0.5 needs continuous time"]),
    ("certify slip-cured --set design.decay=9e6", 2, ["design.decay = 9e+06 is outside [0, 700000] 1/s"]),
    ("certify slip-lmi -q --set controller=relay", 2, ["controller relay is not linear"]),
    ("certify slip-lmi --set design.over.plant.mas=1,2", 2, ["did you mean plant.mass?"]),
    ("certify slip-lmi --out none/c.json", 2, ["No such file or directory"]),
    ("certify slip-lmi --out .", 2, ["is not a regular file"]),
    # tune
    ("tune tune.toml --set 'tune.free={}'", 2, ["tune.free is empty", '"controller.gain" = ']),
    (
        "tune tune.toml --set tune.samples=9 --set tune.over={}",
        2,
        ["tune.samples = 9 needs ranges to draw from: tune.over is empty"],
    ),
    ("tune tune.toml --set 'tune.objective={}'", 2, ["tune.objective is empty", "iae = 1.0"]),
    ("tune tune.toml -q --set controller=relay", 2, ["tune.free is empty"]),
    (
        "tune tune.toml --set controller.gain=-4000,-70",
        2,
        ["controller.gain.1 = -70 is outside (-60, -20) N m/s, N m, its range in"],
    ),
    (
        "tune tune.toml --set tune.over={} --set tune.free.plant.mass=5.3,6",
        2,
        ["plant.mass = 5.3 is outside (5.3, 6) kg, its range in tune.free"],
    ),
    (
        "tune tune.toml --set tune.over.initial.speed_kmh=30,50",
        2,
        ["tune.over.initial.speed = 8.33333 m/s is not above stop.speed"],
    ),
    ("tune tune.toml --starts 0", 2, ["tune.starts = 0 is outside [1, 1000]"]),
    (
        "tune tune.toml --set tune.limits.overshot=1",
        2,
        ["tune.limits.overshot is not a metric of this scenario; did you mean overshoot?"],
    ),
    ("tune tune.toml --plot a.bmp", 2, ["--plot a.bmp: the name must end in .png, .pdf, .svg"]),
    ("tune tune.toml --out tuned", 2, ["--out tuned: the name must end in .toml"]),
    ("tune tune.toml --out none/c.toml", 2, ["No such file or directory"]),
    (
        "tune tune.toml -q --set tune.decay=9 --set controller=relay --set tune.free.reference.slip=0.1,0.3",
        2,
        ["not linear"],
    ),
    # sweep
    ("sweep sweep.toml --samples 0", 2, ["--samples 0 is outside [1, 4294967295]"]),
    ("sweep sweep.toml --samples -5", 2, ["--samples -5 is outside [1, 4294967295]"]),
    ("sweep sweep.toml --set sweep.samples=-5", 2, ["sweep.samples = -5 is outside [0, 4294967295]"]),
    ("sweep sweep.toml --set sweep.chunk=0", 2, ["sweep.chunk = 0 is outside [1, 1048576]"]),
    ("sweep sweep.toml --seed -1", 2, ["sweep.seed = -1 is outside"]),
    (
        "sweep sweep.toml --set sweep.over.plant.mas=1:2",
        2,
        ["sweep.over.plant.mas is not a parameter of this loop; did you mean"],
    ),
    ("sweep sweep.toml --set sweep.over.plant.mass=-1:2", 2, ["sweep.over.plant.mass", "(0, inf) kg"]),
    ("sweep sweep.toml --set 'sweep.over.plant.mass={low=6,high=5}'", 2, ["sweep.over.plant.mass"]),
    (
        "sweep sweep.toml --set sweep.over.controller.gain.7=1:2",
        2,
        ["sweep.over.controller.gain.7 is not a parameter of this loop"],
    ),
    ("sweep sweep.toml --set 'sweep.over.road=[\"glass\"]'", 2, ["sweep.over.road.0"]),
    (
        "sweep sweep.toml --set sweep.failures.overshot=1",
        2,
        ["sweep.failures.overshot is not a metric of this scenario; did you mean overshoot?"],
    ),
    ("sweep sweep.toml --engine spark", 2, ["--engine spark is unknown"]),
    ("sweep sweep.toml --on mars", 2, ["--on mars is unknown"]),
    ("sweep sweep.toml --scheduler tcp://127.0.0.1:1", 2, ["--scheduler tcp://127.0.0.1:1 needs --on dask"]),
    ("sweep sweep.toml --devices 2 --on dask", 2, ["--devices 2 needs --on local"]),
    ("sweep sweep.toml --keep 1,150", 2, ["--keep 150 is outside [0, 149]"]),
    ("sweep sweep.toml --keep first", 2, ["--keep first is no list of sample numbers"]),
    # rare
    (
        "rare rare.toml stop_distanc=3",
        2,
        ["stop_distanc is not a metric of this scenario; did you mean stop_distance? There is "],
    ),
    ("rare rare.toml overshoot", 2, ["overshoot has no bound in [sweep.failures]: say overshoot=BOUND"]),
    ("rare rare.toml overshoot=nan", 2, ["overshoot = nan is outside (-inf, inf)"]),
    ("rare rare.toml overshoot=much", 2, ['overshoot = "much" is text; a number in (-inf, inf) is needed']),
    ("rare rare.toml overshoot=1 --samples 7", 2, ["--samples 7 is not a multiple of 10 in [20, inf)"]),
    ("rare rare.toml overshoot=1 --samples -20", 2, ["--samples -20 is not a multiple of 10 in [20, inf)"]),
    ("rare rare.toml overshoot=1 --seed -1", 2, ["sweep.seed = -1 is outside [0, "]),
    (
        "rare rare.toml overshoot=1 --set sweep.over.plant.mas=1:2",
        2,
        ["sweep.over.plant.mas is not a parameter of this loop"],
    ),
    (
        "rare rare.toml overshoot=1 --set 'sweep.over.road=[\"rig\"]'",
        2,
        ["plant.road: alternatives of parts have no normal coord"],
    ),
]


@killed_by(
    "scenario.proving", "    if len(values) != len(states):", "    if False:", case="certify slip-lmi --gain=1,2,3"
)
@killed_by("scenario.proving", ", reduced.model.period)", ")", case="certify slip-cured --set design.damping=")
@killed_by(
    "cli.targets",
    "if os.path.isfile(source) and",
    "if False and",
    case="design tune.toml --out tune.toml",
)
@killed_by(
    "scenario.section_design",
    "            if path not in paths:",
    "            if False:",
    case="margins slip-lmi --set reference=setpoin",
)
@killed_by("cli.usage", "(Value error, )?", "", case="export slip-cured --to cc")
@killed_by(
    "scenario.section_tune",
    "if self.samples and not self.over:",
    "if False:",
    case="tune tune.toml --set tune.samples=9 --se",
)
@killed_by("scenario.section_sweep", "if not math.isfinite(value):", "if False:", case="rare rare.toml overshoot=nan")
@pytest.mark.usefixtures("any_step_is_stable")
@pytest.mark.parametrize(("command", "status", "needed"), REFUSALS, ids=[readable_id(row[0]) for row in REFUSALS])
def test_a_refusal_is_one_line_and_leaves_nothing(command, status, needed, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for seam in ("tune_tune", "polytope", "launch_lanes"):
        replace_seam(monkeypatch, seam, lambda *_, **__: pytest.fail("computed something first"))
    for name, text in FILES.items():
        (tmp_path / name).write_text(text)
    words = shlex.split(command)
    more = TARGETS.get(words[0], "").split()
    words += more if "--out" not in words else more[2:]
    result = run(*words, status=status)
    assert_one_error_line(result)
    for text in needed:
        assert text.lower() in result.stderr.lower()
    assert {path.name: path.read_text() for path in tmp_path.iterdir()} == FILES


@killed_by("cli.usage", 'options.get("engine", "auto")', '"auto"', case="tune")
@killed_by("cli.usage", 'options.get("engine", "auto")', '"xla"', case="reproduce")
@pytest.mark.parametrize(
    ("command", "needed"),
    [
        ("tune slip-lmi --engine gpu", "--engine gpu is unknown; there is auto, xla, kernel"),
        ("reproduce slip-lmi", "DIFFABS_ENGINE = 'gpu' is unknown; there is auto, xla, kernel"),
        ("prove slip-lmi --over plant.mass=5:6", "DIFFABS_ENGINE = 'gpu' is unknown; there is auto, xla, kernel"),
    ],
    ids=["tune", "reproduce", "prove"],
)
def test_an_engine_that_is_unknown_is_refused_first(command, needed, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    if "--engine" not in command:
        monkeypatch.setenv("DIFFABS_ENGINE", "gpu")
    result = run(*shlex.split(command), status=2)
    assert_one_error_line(result)
    assert needed in result.stderr
    assert not list(tmp_path.iterdir())


FOLDERS_AND_PROOFS = {"file", "first", "from_sweep", "proof", "second"}  # that no command with an output file reads


def test_every_file_of_a_command_is_known_as_read_or_written():
    for command in main.app.registered_commands:
        paths = {name for name, hint in get_type_hints(command.callback).items() if hint in (Path, Path | None)}
        assert paths <= {*targets.OUTPUTS, *targets.INPUTS, *FOLDERS_AND_PROOFS}, command.name


def refuse_outputs(capsys: pytest.CaptureFixture, **given: str | Path) -> str:
    with pytest.raises(typer.Exit):
        targets.check_distinct(given)
    return capsys.readouterr().err


def test_a_link_to_the_scenario_and_a_module_are_inputs(tmp_path, monkeypatch, capsys):
    scenario, link, module = (tmp_path / name for name in ("mine.toml", "link.toml", "mine.py"))
    scenario.write_text("")
    module.write_text("")
    link.symlink_to(scenario)
    assert f"--out {link} is the scenario itself" in refuse_outputs(capsys, scenario=str(scenario), out=link)
    parts = types.ModuleType("mine")
    parts.__file__ = str(module)
    replace_seam(monkeypatch, "outside_named", {"mine": parts})
    assert f"--csv {module} is the module mine itself" in refuse_outputs(capsys, scenario="slip-lmi", csv=module)


def test_a_file_with_a_packaged_name_is_no_input(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("slip-lmi").write_text("old")
    targets.check_distinct({"scenario": "slip-lmi", "csv": Path("slip-lmi")})
