"""What `prove` draws, and what its files become in a report and in the explorer."""

import json
import pathlib
from typing import NamedTuple

import pytest
from commands import run
from mutants import killed_by
from reports import Page
from seams import replace_seam

from diffabs.output.plot.proofs import ProofMap, draw_proof
from diffabs.output.report import build_report, find_documents

pytestmark = pytest.mark.usefixtures("native_prover", "any_step_is_stable")
LIMITS = ["--set", "controller.low=0", "--set", "controller.high=9.03"]
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


@pytest.mark.slow
@killed_by("output.plot.proofs", "side.scale for side in sides", "1.0 for side in sides")
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
@killed_by("output.report.proofs", "table_unit(units.get(path))", "''")
@killed_by("output.report.proofs", 'if verdict == "proved" and "certificate" in files', "if False")
def test_a_report_has_verdict_box_bounds_and_map(proved: Proved) -> None:
    (document,) = find_documents(proved.folder)
    page = Page(build_report([document]))
    assert document.kind == "prove"
    assert "Does every run satisfy greatest slip <= 0.2515, for every plant.mass from 5.3 to 5.4 kg and" in page.text
    assert "proved greatest slip <= 0.2515" in page.text
    for name in ("Box", "Bounds of every run", "Cells"):
        assert name in page.text
    box, bounds = document.content["over"], document.content["bounds"]
    shown = {*map(repr, box["plant.mass"]), repr(bounds["greatest slip"]["high"]), repr(bounds["stop_time"]["low"])}
    assert shown <= set(page.numbers)
    assert "initial.speed 1.44444 1.47222 m/s" in page.text
    assert len(page.images) == 1
    assert page.foreign == []
    assert f"diffabs verify {proved.folder / 'certificate.proof'}" in page.text


@pytest.mark.slow
def test_a_report_of_a_refuted_claim_says_where(proved: Proved, tmp_path: pathlib.Path) -> None:
    document = json.loads((proved.folder / "proof.json").read_text())
    document |= {"verdict": "refuted", "reason": "every run violates the claim where plant.mass = 5.4", "files": {}}
    document["bounds"] = {name: {**row, "low": None, "high": None} for name, row in document["bounds"].items()}
    (tmp_path / "x.json").write_text(json.dumps(document))
    page = Page(build_report(find_documents(tmp_path / "x.json")))
    assert "refuted: every run violates the claim where plant.mass = 5.4." in page.text
    assert "diffabs verify" not in page.text
    assert page.images == []


@pytest.mark.slow
def test_a_map_marks_the_cell_that_refutes(native_prover: None, tmp_path: pathlib.Path) -> None:
    del native_prover
    shown = prove_and_draw(tmp_path, "--claim", "stop_time=0.0105", "--claim", "max_slip=0.3", status=1).shown
    assert shown.quantity == "proved upper bound of stop time [s]"
    assert shown.claimed == 0.0105
    for speed in (shown.refuting[1, 0], shown.worst[1]):  # the fastest run of the box stops last
        assert speed == pytest.approx(5.3, rel=1e-12)
