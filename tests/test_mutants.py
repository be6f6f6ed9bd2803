"""The marks of mutants are true: each text and file that they name exists."""

import os
import pathlib
import time

import pytest
from mutants import Mutant, find_mutants, judge
from project import ROOT


def test_each_mutant_finds_its_text():
    found = find_mutants()
    assert len(found) > 500
    for mutant in found:
        assert mutant.old != mutant.new, mutant
        assert mutant.old in (ROOT / "diffabs" / mutant.file).read_text(), mutant


TESTS = """
import subprocess, sys, pathlib
from made import number

def test_number():
    if number < 0:
        sleeper = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"])
        pathlib.Path("pid").write_text(str(sleeper.pid))
    while number < 0:
        pass
    assert number == 1
"""


@pytest.fixture
def small(tmp_path):
    """A package of one number, and a test of it that never ends where that is negative."""
    for name in ("diffabs", "tests"):
        (tmp_path / name).mkdir()
    (tmp_path / "diffabs" / "made.py").write_text("number = 1\n")
    (tmp_path / "tests" / "test_made.py").write_text(f"import sys\nsys.path.insert(0, 'diffabs')\n{TESTS}")
    (tmp_path / "pytest.ini").write_text("[pytest]\n")
    return tmp_path


@pytest.mark.slow
@pytest.mark.parametrize(
    ("new", "verdict"), [("= 2", "dies"), ("= 1.0", "SURVIVES"), ("= -1", "dies: no end after 20 s")]
)
def test_a_mutant_has_so_much_time(small, new, verdict):
    """One that never ends is dead, and so is what it has started; the file is left as it was."""
    limit = 20.0 if "no end" in verdict else 200.0  # on a busy machine even what ends at once takes a while
    assert judge(Mutant("made.py", "= 1", new, "test_made.py"), small, limit=limit) == verdict
    assert (small / "diffabs" / "made.py").read_text() == "number = 1\n"
    if "no end" in verdict:
        started = int((small / "pid").read_text())
        assert not _runs(started)


def _runs(process):
    """Whether a process is still there, other than as a dead one that nobody has asked for."""
    for _ in range(50):
        try:
            os.kill(process, 0)
            state = pathlib.Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0]
        except OSError:
            return False
        if state == "Z":
            return False
        time.sleep(0.1)
    return True
