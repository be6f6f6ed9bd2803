"""SIGTERM is an orderly end: exit status 143, what is whole stays, nothing else does: no file, no process."""

import signal
import sys
import time

import psutil
import pytest
from commands import left_in
from mutants import killed_by
from sweeping import PATIENCE, SCENARIO, chunks, command, started, until

LONG = ("--samples", "640000")


@pytest.fixture
def room(tmp_path, monkeypatch):
    """Where a process keeps what is temporary."""
    (tmp_path / "temporary").mkdir()
    monkeypatch.setenv("TMPDIR", str(tmp_path / "temporary"))
    return tmp_path


def ended(process, children=()):
    out, err = process.communicate(timeout=PATIENCE)
    assert process.returncode == 143, err
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
from diffabs.runtime import files
from diffabs.runtime import interrupt

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
@killed_by("cli/console.py", "        files.remove_unfinished()\n", "")
def test_what_a_thread_was_writing_goes_with_it(tmp_path):
    with started(sys.executable, "-c", LEAVING, str(tmp_path)) as process:
        assert process.stdout.readline() == "begun\n"
        assert left_in(tmp_path) == {"half.tmp"}
        process.send_signal(signal.SIGTERM)
        ended(process)
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
