"""SIGTERM and SIGHUP are an orderly end: exit status 143, 129; what is whole stays, nothing else does."""

import os
import pty
import signal
import subprocess
import sys
import time

import psutil
import pytest
from commands import left_in
from mutants import killed_by
from project import ROOT
from sweeping import PATIENCE, SCENARIO, chunks, command, started, until

from diffabs.host import interrupt

LONG = ("--samples", "640000")


@pytest.fixture
def room(tmp_path, monkeypatch):
    """Where a process keeps what is temporary."""
    (tmp_path / "temporary").mkdir()
    monkeypatch.setenv("TMPDIR", str(tmp_path / "temporary"))
    return tmp_path


def ended(process, children=(), status=143):
    out, err = process.communicate(timeout=PATIENCE)
    assert process.returncode == status, err
    assert "Traceback" not in err
    assert not psutil.wait_procs(children, timeout=PATIENCE)[1]
    return out, err


def nothing_temporary(folder):
    there = {path.name for path in (folder / "temporary").iterdir()}
    return there <= {"dask-scratch-space"} and not list(folder.rglob("*.tmp"))


@pytest.mark.slow
def test_a_sweep_finishes_its_chunks_and_says_how_to_go_on(file, room):
    out = room / "out"
    with started(*command(file(SCENARIO), out, *LONG)) as process:
        assert until(lambda: chunks(out), process)
        process.send_signal(signal.SIGTERM)
        stdout, stderr = ended(process)
    assert stdout == ""
    assert stderr.splitlines()[-1].startswith(f"interrupted: finished chunks are in {out}; continue with: ")
    assert left_in(out) == {".lock", "manifest.json", "chunks"}
    assert nothing_temporary(room)


@pytest.mark.slow
@pytest.mark.parametrize("times", [1, 2])
def test_workers_end_with_their_sweep(file, room, times):
    """Sent once the chunks in hand are finished, sent twice nothing is waited for."""
    out = room / "out"
    with started(*command(file(SCENARIO), out, *LONG, "--on", "dask", "--workers", "2")) as process:
        assert until(lambda: chunks(out), process)
        children = psutil.Process(process.pid).children(recursive=True)
        assert len(children) >= 2
        for _ in range(times):
            process.send_signal(signal.SIGTERM)
            time.sleep(0.3)
        ended(process, children)
    assert nothing_temporary(room)


LEAVING = """
import pathlib, sys, time
from diffabs.cli import console
from diffabs.host import files
from diffabs.host import interrupt

def work():
    with files.temporary_path(pathlib.Path(sys.argv[1]) / "half.tmp") as path:
        path.mkdir()
        (path / "data").write_text("half")
        print("begun", flush=True, file=sys.__stdout__)  # stdout itself is not of a command's work
        time.sleep(100)

interrupt.begin_hearing()
try:
    console.run_with_progress(work, "working")
except KeyboardInterrupt:
    console.leave(console.INTERRUPTED)
"""


@pytest.mark.slow
@killed_by("cli.console", "        files.remove_unfinished()\n", "", case="SIGTERM")
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP], ids=lambda number: number.name)
def test_what_a_thread_was_writing_goes_with_it(tmp_path, number):
    with started(sys.executable, "-c", LEAVING, str(tmp_path)) as process:
        assert process.stdout.readline() == "begun\n"
        assert left_in(tmp_path) == {"half.tmp"}
        process.send_signal(number)
        ended(process, status=128 + number)
    assert left_in(tmp_path) == set()


@pytest.mark.slow
def test_a_run_leaves_no_half_file(room):
    words = ("simulate", "slip-lmi", "--set", "solver.step=1e-7", "--csv", room / "run.csv", "--plot", room / "run.png")
    with started(*command("x", "y")[:3], *map(str, words), cwd=room) as process:
        assert until(lambda: len(left_in(room)) >= 3, process)
        time.sleep(0.5)
        process.send_signal(signal.SIGTERM)
        out, err = ended(process)
    assert (out, err.splitlines()[-1]) == ("", "interrupted")
    assert left_in(room) == {"temporary"}


# The module alone, as it is before JAX is imported.
ALONE = """
import importlib.util, os, signal, sys, time
spec = importlib.util.spec_from_file_location("interrupt", sys.argv[1])
interrupt = importlib.util.module_from_spec(spec)
spec.loader.exec_module(interrupt)
sys.argv = ["diffabs"]
"""
EARLY = f"""{ALONE}
interrupt.end_early_on_interrupt()
print("begun", flush=True)
time.sleep(100)
"""
HUNG_UP = f"""{ALONE}
interrupt.begin_hearing()
print("begun", flush=True)
while not interrupt.take_interrupt():
    time.sleep(0.01)
print("a line for a terminal that is gone", file=sys.stderr, flush=True)
os._exit(interrupt.exit_status())
"""
INTERRUPT = ROOT / "diffabs" / "host" / "interrupt.py"


@killed_by("host.interrupt", "_answer_end(number, _leave)", "pass", case="SIGTERM")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP], ids=lambda number: number.name)
def test_a_signal_during_the_imports(number):
    with started(sys.executable, "-c", EARLY, str(INTERRUPT)) as process:
        assert process.stdout.readline() == "begun\n"
        process.send_signal(number)
        assert ended(process, status=128 + number) == ("", "interrupted\n")


@killed_by("host.interrupt", "os.dup2(nowhere, stream)", "pass")
def test_what_is_written_to_a_closed_terminal_is_no_error():
    terminal, line = pty.openpty()
    command = [sys.executable, "-c", HUNG_UP, str(INTERRUPT)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=line, text=True) as process:
        os.close(line)
        assert process.stdout.readline() == "begun\n"
        os.close(terminal)
        process.send_signal(signal.SIGHUP)
        assert process.wait(timeout=PATIENCE) == 129


@killed_by("host.interrupt", "in (signal.SIG_DFL, _leave):", "is not None:")
def test_under_nohup_a_closed_terminal_is_nothing():
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        interrupt.begin_hearing()
        assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGHUP, before)
