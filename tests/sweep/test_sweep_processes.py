"""Several processes of one JAX program sweep into one folder: the documented commands, and what a death leaves."""

import re
import shlex
import sys

import pytest
from mutants import killed_by
from project import ROOT
from sweeping import PATIENCE, SCENARIO, chunks, described, free_port, started, until

from diffabs.sweep import sweep

pytestmark = [
    pytest.mark.slow,  # processes that wait for each other
    pytest.mark.usefixtures("any_step_is_stable"),
]

PAGE = (ROOT / "docs" / "sweeps.md").read_text()
SCRIPT = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)[1]
COMMANDS = re.findall(r"^      python (many\.py .*?)  +#", PAGE, re.MULTILINE)
FULL = """
from diffabs.sweep.store import Store

def full(*_):
    raise OSError(28, "No space left on device")

if number == "1":
    Store.write = full
"""


@pytest.fixture(scope="module")
def digest(tmp_path_factory):
    """Of the table as this process computes it."""
    return sweep(described(SCENARIO), tmp_path_factory.mktemp("alone") / "out").digest


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "many.py").write_text(SCRIPT)
    (tmp_path / "study.toml").write_text(SCENARIO)
    return tmp_path


def all_started(folder):
    """The documented commands, all on this machine."""
    there = f"127.0.0.1:{free_port()}"
    words = [shlex.split(re.sub(r"\d+\.\d+\.\d+\.\d+:\d+", there, command)) for command in COMMANDS]
    assert [each[-2:] for each in words] == [["2", "0"], ["2", "1"]]
    return [started(sys.executable, *each, cwd=folder) for each in words]


def ended(processes):
    """Their outputs. Nobody is left behind, whatever happens."""
    try:
        return [process.communicate(timeout=PATIENCE) for process in processes]
    finally:
        for process in processes:
            process.kill()
            process.wait()


def test_two_processes_make_the_table_of_one(folder, digest):
    for _ in range(2):  # the second time everything is there
        processes = all_started(folder)
        outputs = ended(processes)
        assert [process.returncode for process in processes] == [0, 0], outputs
        assert [stdout.split()[-1] for stdout, _ in outputs] == [digest] * 2  # the first words are Gloo's
    assert len(chunks(folder / "noisy")) == 50


@pytest.mark.parametrize("victim", [0, 1])
def test_a_process_that_dies_ends_the_others(folder, digest, victim):
    """Process p computes the chunks p, p + 2, ...; the first one coordinates."""
    longer = SCENARIO.replace("samples = 3200", "samples = 32000")
    (folder / "study.toml").write_text(longer)
    processes = all_started(folder)
    try:
        own = f"noisy/chunks/part-*{victim}-*.parquet"
        assert until(lambda: list(folder.glob(own)), processes[victim])
        processes[victim].kill()
        other = processes[1 - victim]
        if victim == 1:  # JAX ends this one only when it has missed the heart beats of 100 s
            assert any(
                "another process died; finished chunks stay; --resume continues the sweep" in line
                for line in other.stderr
            )
            other.kill()
        assert other.wait(PATIENCE) != 0
    finally:
        ended(processes)
    assert 0 < len(chunks(folder / "noisy")) < 500
    again = all_started(folder)
    outputs = ended(again)
    assert [process.returncode for process in again] == [0, 0], outputs
    alone = sweep(described(longer), folder / "alone")
    assert [stdout.split()[-1] for stdout, _ in outputs] == [alone.digest] * 2  # the first words are Gloo's
    assert alone.digest != digest


@killed_by("sweep/run.py", "        except Exception:", "        except ZeroDivisionError:")
def test_a_full_disk_of_one_process_is_reported_at_the_end(folder):
    broken = SCRIPT.replace("\nprint(", f"{FULL}print(")
    (folder / "many.py").write_text(broken.replace(".digest", ".complete"))
    processes = all_started(folder)
    outputs = ended(processes)
    assert [process.returncode for process in processes] == [0, 1], outputs
    assert outputs[0][0].split()[-1] == "False"
    assert outputs[1][1].splitlines()[-1] == "OSError: [Errno 28] No space left on device"
    assert len(chunks(folder / "noisy")) == 25


def test_a_folder_that_cannot_be_used_ends_both(folder):
    (folder / "noisy").mkdir()
    (folder / "noisy" / "thesis.tex").write_text("mine")
    processes = all_started(folder)
    outputs = ended(processes)
    assert all(process.returncode == 1 for process in processes), outputs
    assert "noisy is no sweep, but holds thesis.tex" in outputs[0][1]
    assert "noisy: the first process could not begin, and says why" in outputs[1][1]
    assert [path.name for path in (folder / "noisy").iterdir() if not path.name.startswith(".")] == ["thesis.tex"]
