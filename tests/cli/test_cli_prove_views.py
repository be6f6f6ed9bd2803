"""What `prove` draws, and what its files become in a report and in the explorer."""

import json
import pathlib
from typing import NamedTuple

import pytest
from commands import run
from mutants import killed_by
from seams import replace_seam

from diffabs.plot.proofs import ProofMap, draw_proof

pytestmark = pytest.mark.usefixtures("native_prover")
LIMITS = ["--set", "controller.torque_min=0", "--set", "controller.torque_max=9.03"]
BOX = ["--over", "plant.mass=5.3:5.4", "--over", "initial.speed_kmh=5.2:5.3"]


class Proved(NamedTuple):
    """The folder of a proof, with its document, its certificate and its map, and what the map shows."""

    folder: pathlib.Path
    shown: ProofMap


def prove_and_draw(folder: pathlib.Path, *words: str | pathlib.Path, status: int = 0) -> Proved:
    """Return a proof over the box."""
    drawn: list[ProofMap] = []
    with pytest.MonkeyPatch.context() as patch:
        replace_seam(patch, "draw_proof", lambda shown: drawn.append(shown) or draw_proof(shown))
        files = ["--out", folder / "certificate.proof", "--plot", folder / "map.png"]
        found = run("prove", "slip-lmi", *LIMITS, *BOX, *words, *files, "--budget", "20", "--json", status=status)
    (folder / "proof.json").write_text(found.stdout)
    return Proved(folder, drawn[0])


@pytest.fixture(scope="module")
def proved(native_prover: None, tmp_path_factory: pytest.TempPathFactory) -> Proved:
    """A claim that holds."""
    del native_prover
    return prove_and_draw(tmp_path_factory.mktemp("proved"), "--claim", "max_slip=0.2515")


@killed_by("cli/prove.py", "sides[i].scale for i in axes", "1.0 for i in axes")
def test_a_map_has_the_units_of_the_command(proved: Proved) -> None:
    folder, shown = proved
    assert (folder / "map.png").stat().st_size > 10_000
    assert json.loads((folder / "proof.json").read_text())["files"]["plot"].endswith("map.png")
    assert shown.labels == ["plant.mass [kg]", "initial.speed [km/h]"]
    assert shown.box.ravel() == pytest.approx([5.3, 5.4, 5.2, 5.3], rel=1e-12)
    assert shown.quantity == "proved upper bound of slip [1]"
    assert shown.bounds.max() <= shown.claimed == 0.2515
    assert shown.worst == pytest.approx([5.4, 5.3], rel=1e-12)


@pytest.mark.slow
def test_a_map_marks_the_cell_that_refutes(native_prover: None, tmp_path: pathlib.Path) -> None:
    del native_prover
    shown = prove_and_draw(tmp_path, "--claim", "stop_time=0.0105", "--claim", "max_slip=0.3", status=1).shown
    assert shown.quantity == "proved upper bound of stop time [s]"
    assert shown.claimed == 0.0105
    for speed in (shown.refuting[1, 0], shown.worst[1]):  # the fastest run of the box stops last
        assert speed == pytest.approx(5.3, rel=1e-12)
