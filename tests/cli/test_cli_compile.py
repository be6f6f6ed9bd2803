"""`compile`: the program of a scenario's kernel after each pass."""

import json

import jax
import pytest
from commands import run
from mutants import killed_by
from project import ROOT

from diffabs.compiler.passes import PASSES


@pytest.mark.slow
@killed_by("compiler.listing", "sum(node.level == level and", "sum(node.level >= level and")
def test_the_numbers_of_operations():
    """Elimination computes no number that nothing reads, and a tangent with fewer operations than jvp gives."""
    result = json.loads(run("compile", "slip-lmi", "--json").stdout)
    counts = result["operations"]
    assert result["by"] == ["plant.mass"]
    assert set(counts) == {"lower", "eliminate", "lower, for derivatives", "jvp", "eliminate, with tangents"}
    assert counts["eliminate"]["step"] < counts["lower"]["step"] < counts["lower, for derivatives"]["step"]
    assert counts["eliminate, with tangents"]["step"] < counts["jvp"]["step"]
    if jax.__version_info__[:2] == (0, 10):  # other versions trace other operations
        page = (ROOT / "docs" / "compiler.md").read_text(encoding="utf-8")
        for name, row in counts.items():
            assert f"| {name} | {row['uniform']} | {row['lane']} | {row['step']} |" in page
    listed = run("compile", "slip-lmi", "--show", "lower").stdout.splitlines()
    assert sum(line.endswith(", step") for line in listed) == counts["lower"]["step"]


@pytest.mark.slow
@killed_by("loop.kernel_programs", 'self.derivative if tangents or name == "jvp" else self.values', "self.values")
def test_a_program_is_shown_after_every_pass(tmp_path):
    texts = {name: run("compile", "slip-lmi", "--show", name).stdout for name in PASSES}
    assert len(set(texts.values())) == len(PASSES)
    assert "point.state.plant.wheel" in texts["lower"]
    assert "d point.state.plant.wheel" in texts["jvp"]
    assert "BODY void step" in texts["c"]
    path = tmp_path / "text"
    run("compile", "slip-lmi", "--show", "eliminate", "--by", "plant.road.w4", "--by", "plant.mass", "-o", path)
    assert "d point.state.plant.wheel" in path.read_text()
