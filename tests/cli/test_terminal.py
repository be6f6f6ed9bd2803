"""The long commands on a terminal of 80 columns: progress, Ctrl-C at any moment, TERM=dumb."""

import contextlib
import io
import random
import re
import shlex
import signal
import subprocess
import sys
import time
import types

import pytest
from mutants import killed_by
from rich.console import Console
from rich.table import Table
from seams import replace_seam
from sweeping import SCENARIO, chunks, environment, tune_section
from terminal import COLUMNS, SPINNER, Terminal, assert_fits, assert_orderly, words

from diffabs.cli import console, tables
from diffabs.host import interrupt

TUNED = tune_section(200, 1.0)
SPREAD = "sweep.over.initial.speed={ type = 'normal', mean = 8.3, deviation = 0.3, low = 7.2, high = 11.0 }"


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A scenario of a quarter of a second, and a run of it."""
    folder = tmp_path_factory.mktemp("small")
    (folder / "small.toml").write_text(SCENARIO + TUNED)
    return folder


@pytest.fixture(scope="module")
def measured(folder):
    path = folder / "run.csv"
    words = ["-m", "diffabs", "simulate", folder / "small.toml", "--set", "sensor=direct", "--csv", path]
    subprocess.run([sys.executable, *map(str, words)], check=True, capture_output=True, env=environment())
    return path


def long_commands(folder, out):
    """What each takes: moments, but for `reproduce`, which takes minutes."""
    small = folder / "small.toml"
    free = ("--free", "plant.mass=4:8", "--column", "wheel_speed", "--column", "deceleration")
    return {
        "sweep": ["sweep", small, "--out", out / "sweep", "--samples", 640],
        "rare": ["rare", small, "stop_distance=2.5", "--samples", 200, "--set", SPREAD],
        "tune": ["tune", small, "--set", "tune.iterations=2"],
        "identify": ["identify", small, "--data", folder / "run.csv", "--set", "sensor=direct", *free],
        "design": ["design", "slip-lmi"],
        "reproduce": ["reproduce", "slip-estimator", "--out", out],
    }


LONG = ["sweep", "rare", "tune", "identify", "design", "reproduce"]


@pytest.mark.slow
def test_a_sweep_draws_how_far_it_is(folder, tmp_path):
    with Terminal("sweep", folder / "small.toml", "--out", tmp_path / "out", "--samples", "640") as terminal:
        assert terminal.status() == 0, terminal.text
        assert_orderly(terminal)
        assert SPINNER.search(terminal.text)
        assert "640 of 640" in terminal.text
        assert_fits(terminal)


@pytest.mark.skipif(sys.platform != "linux", reason="looks into /proc for how far the imports are")
def test_control_c_while_it_is_imported(folder, tmp_path):
    """Numpy's core comes first and JAX takes seconds: this is in the midst."""
    with Terminal("sweep", folder / "small.toml", "--out", tmp_path / "out") as terminal:
        assert terminal.loads("_multiarray_umath")
        terminal.press()
        assert terminal.status() == 130
        assert terminal.text == "^Cinterrupted\n"
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
@pytest.mark.parametrize("command", [name for name in LONG if name != "reproduce"])
def test_on_80_columns_no_word_is_broken(folder, measured, tmp_path, command):
    """Everything that a wide pipe gets is on the terminal, word by word."""
    args = list(map(str, long_commands(folder, tmp_path / "a")[command]))
    with Terminal(*args) as terminal:
        assert terminal.status() == 0, terminal.text
        assert_orderly(terminal)
        assert SPINNER.search(terminal.text)
        assert_fits(terminal)
    (tmp_path / "a").rename(tmp_path / "b") if (tmp_path / "a").exists() else None
    piped = [sys.executable, "-m", "diffabs", *args]
    done = subprocess.run(piped, capture_output=True, text=True, check=True, env=environment())
    assert SPINNER.search(done.stdout + done.stderr) is None
    assert words(done.stdout) <= words(terminal.text)


@pytest.mark.slow
def test_what_is_verified_fits_80_columns(tmp_path):
    """The claim of a decay has 87 characters."""
    proof = tmp_path / "proof.json"
    with Terminal("certify", "slip-lmi", "--gain=-11753,-76.7", "--out", proof) as terminal:
        assert terminal.status() == 0, terminal.text
        assert_fits(terminal)
    with Terminal("verify", proof) as terminal:
        assert terminal.status() == 0, terminal.text
        assert_fits(terminal)
    assert re.search(r"proved\s+decay:.*however\s+the\s+system\s+varies", terminal.text, re.DOTALL)


@pytest.mark.slow
@pytest.mark.parametrize("command", LONG)
@pytest.mark.parametrize("moment", ["checking", "working"])
def test_control_c_at_any_moment(folder, measured, tmp_path, command, moment):
    """Of a command that goes on for long."""
    longer = {
        "sweep": ["--samples", "1000000"],
        "rare": ["--samples", "20000"],
        "tune": ["--set", "tune.iterations=100000", "--set", "solver.step=1e-5", "--out", tmp_path / "tuned.toml"],
        "identify": ["--set", "solver.step=1e-5", "--out", tmp_path / "found.toml"],
    }
    begun = {
        "sweep": r"[1-9][\d,]* of 1,000,000",
        "rare": "level 2",
        "tune": r"[1-9]\d* evaluations",
        "identify": "identifying",
        "design": "designing",
        "reproduce": "reproducing",
    }
    args = long_commands(folder, tmp_path)[command]
    if command == "tune":
        args = args[:2]
    with Terminal(*args, *longer.get(command, [])) as terminal:
        wanted = begun[command] if moment == "working" or command == "reproduce" else "checking the scenario"
        assert terminal.until(lambda: re.search(wanted, terminal.text)), terminal.text
        time.sleep(0.3 if moment == "working" and command != "design" else 0.0)  # a design takes 0.3 s
        terminal.press()
        assert terminal.status() == 130, terminal.text
        assert_orderly(terminal)
        assert_fits(terminal)
        text = terminal.text
    assert "interrupted" in text
    if moment == "working" and command == "sweep":
        assert chunks(tmp_path / "sweep")
        again = re.split(r"continue\s+with:\n", text)[1].replace("\\\n", " ")  # folded where the folder's name has it
        assert shlex.split(again)[1:] == [*map(str, args), *longer["sweep"], "--resume"]
    if moment == "working" and command == "tune":
        assert "this is the best so far, not a minimum" in text
        assert "free parameters" in text
        assert (tmp_path / "tuned.toml").exists()
    if moment == "working" and command == "rare":
        assert re.search(r"stop_distance >= \S+ has a\s+probability\s+of\s+about\s+0\.\d", text)
    assert {path.name for path in tmp_path.iterdir()} <= {"sweep", "tuned.toml"}


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(8))
def test_control_c_in_the_first_seconds(folder, tmp_path, seed):
    """From when Python has begun with this package, which a signal of its own tells, to well after the imports."""
    with Terminal("tune", folder / "small.toml") as terminal:
        assert terminal.loads("_multiarray_umath")
        time.sleep(random.Random(seed).uniform(0.0, 4.0))
        terminal.press()
        status = terminal.status()
        assert_orderly(terminal)
        assert status == 130, terminal.text
        assert "interrupted" in terminal.text


@pytest.mark.slow
@pytest.mark.parametrize("command", ["sweep", "tune"])
def test_a_dumb_terminal_gets_lines(folder, tmp_path, command):
    with Terminal(*long_commands(folder, tmp_path)[command], term="dumb") as terminal:
        assert terminal.status() == 0, terminal.text
        assert "\x1b" not in terminal.raw
        assert SPINNER.search(terminal.text) is None
        assert_fits(terminal)


# In this process


LINES = {
    "a line": ("word " * 16, True),
    "one word more": ("word " * 16 + "word", False),
    "a long path": ("  /tmp/" + 80 * "x", True),
    "where a command goes on": ("    /tmp/" + 80 * "x" + " \\", True),
    "a long path and a word": ("in /tmp/" + 80 * "x", False),
    "a long word": (81 * "x", False),
}


@pytest.mark.parametrize("name", LINES)
def test_what_fits(name):
    """A path of somebody who has long ones cannot be folded; it stands alone."""
    line, fits = LINES[name]
    with contextlib.nullcontext() if fits else pytest.raises(AssertionError):
        assert_fits(types.SimpleNamespace(raw=f"before\r\n{line}\r\n"))


def test_a_library_leaves_control_c_alone():
    interrupt.end_early_on_interrupt()
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


@killed_by("host.interrupt", "signal.SIG_IGN if is_child else _leave", "_leave", case="a child")
@killed_by("host.interrupt", 'program.parts[-2:] == ("diffabs", "__main__.py")', "False", case="child of -m")
@pytest.mark.parametrize(
    ("program", "words", "answer"),
    [
        pytest.param("diffabs", [], "_leave", id="the command"),
        pytest.param("diffabs", [interrupt.CHILD_FLAG], "SIG_IGN", id="a child"),
        pytest.param("diffabs/__main__.py", [interrupt.CHILD_FLAG], "SIG_IGN", id="child of -m"),
        pytest.param("mine/__main__.py", [interrupt.CHILD_FLAG], "default_int_handler", id="child of another program"),
    ],
)
def test_control_c_while_a_process_imports(program, words, answer, monkeypatch):
    """The command ends; its children leave it to the command, which says once that it was interrupted."""
    monkeypatch.setattr(sys, "argv", [program])
    monkeypatch.setattr(sys, "orig_argv", ["python", program, *words])
    interrupt.end_early_on_interrupt()
    assert answer in repr(signal.getsignal(signal.SIGINT))


def test_what_is_to_be_ignored_stays_ignored():
    """As a shell has it for what runs behind it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    interrupt.begin_hearing()
    assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN


def test_a_press_interrupts_where_work_is_waited_for():
    """Not where the signal finds the program, which may be anywhere."""
    interrupt.begin_hearing()
    signal.raise_signal(signal.SIGINT)
    with pytest.raises(KeyboardInterrupt):
        console.run_with_progress(lambda: time.sleep(5), "working")
    assert not interrupt.take_interrupt()


def test_work_that_can_end_early_is_asked_first(capsys):
    interrupt.begin_hearing()
    ending = console.InterruptibleEnd("this")

    def work():
        interrupt._press()
        end = time.monotonic() + 30
        while not ending() and time.monotonic() < end:
            time.sleep(0.01)
        return "what there is"

    assert console.run_with_progress(work, "working", ending=ending) == "what there is"
    assert "interrupted: finishing this (Ctrl-C again: at once)" in capsys.readouterr().err
    interrupt._press()
    with pytest.raises(KeyboardInterrupt):
        console.run_with_progress(lambda: time.sleep(5), "working", ending=ending)


def test_nothing_to_show_is_not_waited_for():
    interrupt.begin_hearing()
    interrupt._press()
    with pytest.raises(KeyboardInterrupt):
        console.run_with_progress(
            lambda: time.sleep(5), "working", ending=console.InterruptibleEnd("this", nothing=lambda: True)
        )


def printed(*tables):
    out = Console(width=COLUMNS, file=io.StringIO())
    out.print(*tables)
    return out.file.getvalue()


@pytest.mark.parametrize("seed", range(20))
def test_tables_fit_and_keep_their_words(seed):
    """Any table whose widest pair of columns fits."""
    rng = random.Random(seed)

    def word():
        return "".join(rng.choices("abcdefgh", k=rng.randint(1, 24)))

    names = [word() for _ in range(rng.randint(1, 9))]
    table = Table(*names)
    rows = [[" ".join(word() for _ in range(rng.randint(0, 4))) for _ in names] for _ in range(4)]
    for row in rows:
        table.add_row(*row)
    text = printed(*tables.fit_table(table, COLUMNS))
    assert max(map(len, text.splitlines())) <= COLUMNS
    assert words(text) == {word for row in [names, *rows] for cell in row for word in cell.split()}


def test_a_table_that_fits_is_as_it_was():
    table = Table("metric", "value", "unit")
    table.add_row("stop_distance", "12.3264", "m")
    assert printed(*tables.fit_table(table, COLUMNS)) == printed(table)


def test_lines_fold_between_words_and_commands_stay_whole(monkeypatch, capsys):
    replace_seam(monkeypatch, "terminal_width", lambda: 40)
    line = "error: a line that is far too long for such a narrow terminal, controller.controller.gain"
    console.say(line)
    told = capsys.readouterr().err
    assert max(map(len, told.splitlines())) <= 40
    assert told.split() == line.split()
    command = ["diffabs", "sweep", "slip-lmi", "--set", "title=a b", "--samples", "100000", "--resume"]
    console.say_command("continue with:", command)
    head, *rest = capsys.readouterr().err.splitlines()
    assert head == "continue with:"
    assert max(map(len, rest)) <= 40
    assert shlex.split("\n".join(rest).replace("\\\n", " ")) == command  # as a shell joins them
