"""What a command has computed is shown before a file that cannot be written ends it."""

import json

import invented
import pytest
from commands import file_size_limit, left_in, run
from mutants import killed_by
from seams import replace_seam
from small_scenarios import TUNE

from diffabs.cli import margins, simulate, tune
from diffabs.robust.design.proof.certificate import Certificate
from diffabs.scenario.proving import without_certificate
from diffabs.scenario.scenario import load

pytestmark = pytest.mark.usefixtures("any_step_is_stable", "without_load")


def fill_disk(*_):
    raise OSError(28, "No space left on device")


def shown(*words):
    """The document that a command prints before its error."""
    result = run(*words, "--json", status=1)
    assert result.stderr.endswith("No space left on device\n")
    return json.loads(result.stdout)


@pytest.fixture
def small(file, monkeypatch):
    replace_seam(monkeypatch, "tune_tune", invented.tuned)
    replace_seam(monkeypatch, "certify_result", lambda _: without_certificate("not asked for"))
    return file(TUNE)


@killed_by("cli.console", "        show()\n        raise\n", "        raise\n")
def test_a_tuning_that_cannot_be_drawn_is_written_and_shown(small, tmp_path, monkeypatch):
    monkeypatch.setattr(tune, "_draw", fill_disk)
    out, plot = tmp_path / "tuned.toml", tmp_path / "tuned.png"
    content = shown("tune", small, "--out", out, "--plot", plot)
    assert content["files"] == {"out": str(out)}
    assert load(out).loop.controller.gain[0] == content["free"]["controller.gain"]["after"][0]
    assert not plot.exists()


def test_a_tuning_that_cannot_be_written_is_shown(small, tmp_path, monkeypatch):
    monkeypatch.setattr(tune, "dump", fill_disk)
    content = shown("tune", small, "--out", tmp_path / "tuned.toml")
    assert content["files"] == {}
    assert content["objective"]["after"] == 1.5
    assert not (tmp_path / "tuned.toml").exists()


@killed_by("cli.simulate", "with console.show_before_errors(show_result):", "if True:")
def test_a_run_that_cannot_be_drawn_is_shown(tmp_path, monkeypatch):
    monkeypatch.setattr(simulate, "_draw", fill_disk)
    content = shown("simulate", "slip-lmi", "--plot", tmp_path / "run.png")  # as in test_cli.py: compiled
    assert content["metrics"]["iae"] > 0
    assert content["files"] == {}


@killed_by("cli.margins", "with console.show_before_errors(show_result):", "if True:")
@pytest.mark.slow
def test_margins_that_cannot_be_drawn_are_shown(tmp_path, monkeypatch):
    monkeypatch.setattr(margins, "_draw", fill_disk)
    content = shown("margins", "slip-lmi", "--samples", "2", "--plot", tmp_path / "loop.png")
    assert content["margins"]["stable"] is True
    assert content["files"] == {}


@killed_by(
    "cli.design",
    "with console.show_before_errors(lambda: _show(document(), task, as_json)):\n                    proof.save(file)",
    "proof.save(file)",
)
def test_a_certificate_that_cannot_be_saved_is_shown(tmp_path, monkeypatch):
    pytest.importorskip("cvxpy")
    monkeypatch.setattr(Certificate, "save", fill_disk)
    content = shown("certify", "slip-lmi", "--gain=-11753,-76.7", "--out", tmp_path / "gain.json")
    assert content["quadratically_stable"] is True


def test_a_picture_without_room_is_named(tmp_path):
    plot = tmp_path / "run.png"
    with file_size_limit(4096):  # where nothing is compiled: a test above has the same run
        result = run("simulate", "slip-lmi", "--plot", plot, status=1)
    assert result.stderr.splitlines()[-1] == f"error: {plot}: File too large"
    assert "iae" in result.stdout
    assert left_in(tmp_path) == set()
