"""Reports: complete, equal to the documents they are made of, and safe to open."""

import base64
import itertools
import json
import math
import re
import shlex

import invented
import numpy as np
import pytest
from commands import assert_one_error_line, left_in
from commands import run as command
from marks import cases
from reports import Page
from seams import replace_seam
from sweeping import SCENARIO, manifest, tune_section
from terminal import Terminal, assert_fits, assert_orderly

pytest.importorskip("jinja2")
pytest.importorskip("matplotlib")

from mutants import killed_by

from diffabs.output.report import ReportError, build_report, find_documents, writing
from diffabs.output.report.charts import draw_lines
from diffabs.output.report.writing import SECTION_BY_KIND
from diffabs.uncertainty.sweep import Results as SweepResults
from diffabs.uncertainty.sweep.manifest import Seals
from diffabs.uncertainty.sweep.seal import encode_chunk
from diffabs.uncertainty.sweep.statistics.summary import summarise_sweep
from diffabs.uncertainty.sweep.store import Store

TUNED = tune_section(2, 1.0)
HOSTILE = '<script>alert("x")</script><img src=http://x.test/a.png onerror=alert(1)>'
HEADINGS = ["Question", "Model", "Provenance", "Run it again"]


class Results:
    """What the commands write, made when it is asked for: files as a shell redirects them, and a sweep's folder."""

    def __init__(self, folder):
        self.folder, self.scenario = folder, folder / "small.toml"
        self.scenario.write_text(SCENARIO + TUNED)

    def __truediv__(self, name):
        kind = name.partition(".")[0]
        if kind in KINDS and not (self.folder / f"{kind}.json").exists():
            self.make(kind)
        if kind == "certificate" and not (self.folder / name).exists():
            self.make("design")
        return self.folder / name

    def make(self, kind):
        still = ("--set", "sensor=direct")
        if kind == "identify":
            command("simulate", self.scenario, *still, "--csv", self.folder / "run.csv")
        words = {
            "sweep": [self.scenario, "--samples", 128, "--out", self.folder / "sweep", "--figures"],
            "tune": [self.scenario],
            "design": ["slip-lmi", "--out", self.folder / "certificate.json"],
            "identify": [self.scenario, *still, "--data", self.folder / "run.csv", "--free", "plant.mass=4:8",
                         "--column", "wheel_speed"],
            "rare": [self.scenario, "stop_distance=2.5", "--samples", 100],
            "assess": ["half-car"],
        }[kind]  # fmt: skip
        with pytest.MonkeyPatch.context() as patch:
            replace_seam(patch, "tune_tune", invented.tuned)  # what it writes is as of a real one
            (self.folder / f"{kind}.json").write_text(command(kind, *words, "--json").stdout)

    def all(self):
        """The folder with everything in it."""
        for kind in KINDS:
            _ = self / f"{kind}.json"
        return self.folder


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    return Results(tmp_path_factory.mktemp("results"))


KINDS = ("sweep", "tune", "design", "identify", "rare", "assess")
LONG = ("sweep", "tune", "identify", "rare", "assess")
SOURCES = {"sweep": "sweep", "certificate": "certificate.json", **{kind: f"{kind}.json" for kind in
           ("tune", "design", "identify", "rare", "assess")}}  # fmt: skip


def page(results, kind):
    return Page(build_report(find_documents(results / SOURCES[kind])))


def leaves(value):
    """All numbers of a document, as they are written."""
    if isinstance(value, dict | list):
        return {x for one in (value.values() if isinstance(value, dict) else value) for x in leaves(one)}
    return {repr(value)} if isinstance(value, int | float) and not isinstance(value, bool) else set()


@killed_by("output.report.page", 'f"data:{kind};base64,{text}"', "path.as_uri()", case="sweep")
@pytest.mark.parametrize("kind", cases(SOURCES, *LONG))
def test_a_report_stands_for_itself(results, kind):
    found = page(results, kind)
    assert [one for one in found.headings if one in HEADINGS] == HEADINGS
    assert found.foreign == []
    assert "main" in found.tags
    assert "None" not in found.text.split()
    assert {"tune": 0, "sweep": 5}.get(kind, 0) == len(found.images)
    assert ("svg" in found.tags) == (kind == "tune")
    (document,) = find_documents(results / SOURCES[kind])
    assert document.kind == kind
    if kind not in ("certificate", "sweep"):
        assert f"diffabs {kind} " in found.text
        assert document.content["made"]["date"] in found.text
        assert document.content["versions"]["jax"] in found.text


@killed_by("output/report/report.html.j2", "</main>", "</main><script></script>", case="tune")
@killed_by("output/report/report.html.j2", "default-src 'none'", "default-src 'unsafe-inline'", case="tune")
@pytest.mark.parametrize("kind", cases(SOURCES, *LONG))
def test_a_report_executes_nothing(results, kind):
    """It has no script, and its policy lets none run."""
    found = page(results, kind)
    assert "<script" not in found.source.lower()
    assert "javascript:" not in found.source.lower()
    assert found.policy == "default-src 'none'; img-src data:; style-src 'unsafe-inline'"


def test_every_kind_of_document_has_a_section(results):
    assert set(SECTION_BY_KIND) == {*SOURCES, "reproduce", "prove"}  # cli/test_cli_prove_views.py has the last one


SAID = {
    "tune": ["free", "objective", "constraints", "starts"],
    "identify": ["values", "residuals"],
    "design": ["gain", "decay_rate", "guaranteed_cost", "poles", "corners"],
    "rare": ["levels", "failures"],
    "sweep": ["failures", "metrics"],
}
OWN = {"sweep": {"least", "greatest", "samples"}, "rare": {"spread"}, "tune": {"missed"}}  # that only the document has


@killed_by("output.report.page", "repr(value))]", "round_for_table(value))]", case="tune")
@killed_by("output.report.findings", "value - NORMAL * deviation", "value", case="identify")
@pytest.mark.parametrize("kind", cases(SAID, *LONG))
def test_numbers_are_those_of_the_document(results, kind):
    """All of what matters is there with all its digits, and nothing that is nowhere in the document."""
    found = page(results, kind)
    path = results / SOURCES[kind]
    content = json.loads((path / "summary.json" if path.is_dir() else path).read_text())

    def kept(value):
        if isinstance(value, dict):
            return {key: kept(one) for key, one in value.items() if key not in OWN.get(kind, ())}
        return [kept(one) for one in value] if isinstance(value, list) else value

    wanted = leaves([kept(content[key]) for key in SAID[kind]])
    if kind == "tune":  # the sentence has them
        wanted -= leaves(content["objective"])
        assert f"{content['objective']['after']:.6g}" in found.text
    assert wanted <= set(found.numbers)
    manifest = json.loads((path / "manifest.json").read_text()) if path.is_dir() else {}
    known = leaves([content, manifest]) | {str(i) for i in range(20)}
    if kind == "identify":
        row = content["values"]["plant.mass"]
        ends = {repr(row["value"] + sign * 1.959964 * row["deviation"]) for sign in (-1, 1)}
        assert ends <= set(found.numbers)
        assert len(ends - {repr(row["value"])}) == 2
        known |= ends
    if kind == "sweep":  # the scenario's text says them in its own way
        known |= {number for number in found.numbers if float(number) in {math.inf, -math.inf}}
        from diffabs.scenario.model import describe_numbers
        from diffabs.scenario.scenario import loads

        known |= leaves(describe_numbers(loads(manifest["source"]["scenario"].encode(), "small", "manifest")))
    assert set(found.numbers) <= known


@killed_by("output.report.proofs", "sum(not claim.reason for claim in proved)", "len(proved)")
def test_a_certificate_says_what_is_proved(results):
    found = page(results, "design")
    content = json.loads((results / "design.json").read_text())
    assert content["quadratically_stable"] is True
    assert "proved one Lyapunov matrix for all 4 vertices" in found.text
    again = page(results, "certificate")
    assert "2 of 2 claims are proved." in again.text
    text = (results / "certificate.json").read_text()
    wrong = results.folder / "wrong.json"
    wrong.write_text(text.replace(repr(content["decay_rate"]), "1e3"))
    try:
        assert "1 of 2 claims are proved." in Page(build_report(find_documents(wrong))).text
    finally:
        wrong.unlink()


@killed_by("output.report.page", 'False: "disproved"', 'False: "proved"')
def test_a_disproved_gain_is_said_to_be(tmp_path):
    out = command("certify", "slip-lmi", "--gain=-11753,48", "--json", status=1).stdout
    (tmp_path / "bad.json").write_text(out)
    found = Page(build_report(find_documents(tmp_path / "bad.json")))
    assert "disproved one Lyapunov matrix" in found.text
    assert json.loads(out)["reason"] in found.text


def named(value, names):
    """A document whose names, texts and units are hostile."""
    if isinstance(value, dict):
        return {HOSTILE if key in names else key: named(one, names) for key, one in value.items()}
    if isinstance(value, list):
        return [named(one, names) for one in value]
    return HOSTILE if value in names else value


@killed_by("output.report.writing", "autoescape=True", "autoescape=False", case="tune")
@pytest.mark.parametrize("kind", cases(["tune", "identify", "rare", "design"], *LONG))
def test_hostile_names_are_text(results, tmp_path, kind):
    content = json.loads((results / f"{kind}.json").read_text())
    names = {
        content["scenario"],
        "plant.mass",
        "iae",
        "overshoot",
        "kg",
        "stop_distance",
        "wheel_speed",
        "mirrored-rig",
    }
    content = named(content, names)
    content["made"]["command"] = content["reason"] = HOSTILE
    (tmp_path / "x.json").write_text(json.dumps(content))
    found = Page(build_report(find_documents(tmp_path / "x.json")))
    assert found.foreign == []
    assert "script" not in found.tags
    assert found.text.count(HOSTILE) >= 5
    assert HOSTILE in found.headings[0]


@killed_by("output.report.page", "if is_within(path, folder) else None", "")
@killed_by("output.report.page", "IMAGES.get(path.suffix.lower())", 'IMAGES.get(path.suffix.lower(), "image/png")')
def test_figures_outside_of_the_folder_are_not_shown(results, tmp_path):
    """Names in a document are not trusted; and what is no picture is none."""
    content = json.loads((results / "tune.json").read_text())
    folder = tmp_path / "there"
    (folder / "deep").mkdir(parents=True)
    (folder / "secret.txt").write_text("secret")
    (tmp_path / "secret.png").write_text("secret")
    (folder / "link.png").symlink_to(tmp_path / "secret.png")
    (folder / "up").symlink_to(tmp_path)
    for path in (folder / "deep" / "within.png", folder / "drawn.png"):
        path.write_bytes(b"\x89PNG drawn")

    def report_with(plot):
        (folder / "x.json").write_text(json.dumps(content | {"files": {"plot": str(plot)}}))
        return Page(build_report(find_documents(folder / "x.json")))

    outside = [tmp_path / "secret.png", "../secret.png", "link.png", "up/secret.png", "\0.png"]
    for plot in [folder / "secret.txt", *outside]:
        found = report_with(plot)
        assert found.images == []
        assert "is not in the folder of the document." in found.text
        assert base64.b64encode(b"secret").decode() not in found.source
    for plot in ("deep/within.png", folder / "deep" / "within.png", "/somewhere/else/drawn.png"):
        (data,) = report_with(plot).images
        assert base64.b64decode(data.partition(",")[2]) == b"\x89PNG drawn"


@killed_by("output.report.documents", "path = folder / SUMMARY\n", "pass\n")
@pytest.mark.slow
def test_a_folder_of_results_is_one_file(results):
    """What `sweep --json` has printed beside the sweep's folder is the same result, and comes once."""
    read = find_documents(results.all())
    assert sorted(one.kind for one in read) == sorted(SOURCES)
    found = Page(build_report(read))
    assert len([one for one in found.headings if one == "Question"]) == len(SOURCES)
    assert found.headings[0] == f"{len(SOURCES)} results"
    (printed,) = find_documents(results / "sweep.json")
    assert printed.folder == results / "sweep"


SWEEP_KEYS = {"digest": "", "sensitivity": {}, "failures": {}}
PAPER_KEYS = {"paper": "", "rows": [], "figures": ["a.png"]}


@killed_by(
    "output.report.documents", "places = (path.parent / out, pathlib.Path(out))", "places = (pathlib.Path(out),)"
)
@killed_by(
    "output.report.documents", "places = (path.parent / out, pathlib.Path(out))", "places = (path.parent / out,)"
)
def test_a_folder_is_looked_for_beside_its_document(tmp_path, monkeypatch):
    """What a command printed in one folder is read in another, which has a folder of the same name."""
    there = tmp_path / "there"
    for folder in (there / "out", tmp_path / "out", there / "more"):
        (folder / "one").mkdir(parents=True)
    monkeypatch.chdir(tmp_path)
    for name, wanted in (("out", there / "out"), ("there/more", there / "more")):
        (there / "sweep.json").write_text(json.dumps(SWEEP_KEYS | {"out": name}))
        assert find_documents(there / "sweep.json")[0].folder.resolve() == wanted
        (there / "papers.json").write_text(json.dumps({"out": name, "papers": {"one": PAPER_KEYS}}))
        assert find_documents(there / "papers.json")[0].folder.resolve() == wanted / "one"


@killed_by("output.report.documents", "if is_within(place, path.parent) and place.is_dir()", "if place.is_dir()")
@pytest.mark.parametrize("out", ["{outside}", "../outside", "outside", "link", "\0"])
def test_a_folder_outside_of_the_document_is_not_read(tmp_path, monkeypatch, out):
    """A document of somebody else must not take pictures or a manifest from anywhere."""
    outside, there = tmp_path / "outside", tmp_path / "there"
    (outside / "one").mkdir(parents=True)
    there.mkdir()
    (there / "link").symlink_to(outside)
    monkeypatch.chdir(tmp_path)
    out = out.format(outside=outside)
    (there / "sweep.json").write_text(json.dumps(SWEEP_KEYS | {"out": out}))
    with pytest.raises(ReportError, match=r"its sweep .* is not in the folder of the document; report the sweep$"):
        find_documents(there / "sweep.json")
    for folder, name in ((out, "one"), (".", f"{out}/one")):
        (there / "papers.json").write_text(json.dumps({"out": folder, "papers": {name: PAPER_KEYS}}))
        (document,) = find_documents(there / "papers.json")
        assert (document.folder, document.content["figures"]) == (there, [])


def test_figures_of_a_sweep_do_not_lead_out_of_its_folder(tmp_path):
    (tmp_path / "outside").mkdir()
    (tmp_path / "outside" / "worst.png").write_bytes(b"\x89PNG secret")
    invented_sweep(tmp_path / "s", {"type": "random"})
    (tmp_path / "s" / "figures").symlink_to(tmp_path / "outside")
    assert Page(build_report(find_documents(tmp_path / "s"))).images == []


@killed_by("output.report.experiments", "not in names():", "is None:")
def test_a_reproduction_names_no_file_as_its_scenario(tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text("[plant]\nmass = 7.0\n")
    content = PAPER_KEYS | {"paper": "slip-lmi", "scenario": str(path), "digest": {}}
    (tmp_path / "x.json").write_text(json.dumps(content))
    with pytest.raises(ReportError, match=r"KeyError 'scenario .*mine\.toml'"):
        build_report(find_documents(tmp_path / "x.json"))


@killed_by("output/report/report.html.j2", "section.command | printable", "section.command")
def test_the_command_of_a_document_is_said_to_be_its_own(results, tmp_path):
    """It is not a command of this package, and hides nothing behind a line's end or a mark of direction."""
    content = json.loads((results / "tune.json").read_text())
    content["made"]["command"] = "rm -rf ~ #\n diffabs tune\u202esmall"
    (tmp_path / "x.json").write_text(json.dumps(content))
    text = Page(build_report(find_documents(tmp_path / "x.json"))).text
    theirs = "The document says that this command made it. Read it before you run it."
    assert text.endswith(f"{theirs} rm -rf ~ #\N{REPLACEMENT CHARACTER} diffabs tune\N{REPLACEMENT CHARACTER}small")


def test_the_file_of_a_document_is_no_option_of_a_command(results, tmp_path):
    content = json.loads((results / "design.json").read_text())
    content["files"] = {"certificate": "--parts=evil"}
    (tmp_path / "x.json").write_text(json.dumps(content))
    text = Page(build_report(find_documents(tmp_path / "x.json"))).text
    assert text.endswith("diffabs verify ./--parts=evil")


@killed_by("output.report.writing", "except RecursionError:", "except ZeroDivisionError:")
def test_lists_in_lists_are_one_line(results, tmp_path):
    invented_sweep(tmp_path / "s", {"type": "random"})
    (tmp_path / "s" / "manifest.json").write_text("[" * 100_000)
    with pytest.raises(ReportError, match=r"a document of sweep: .*manifest\.json: nested too deeply$"):
        build_report(find_documents(tmp_path / "s"))
    deep = '"evaluations": ' + "[" * 800 + "]" * 800 + ', "x": '
    (tmp_path / "x.json").write_text((results / "tune.json").read_text().replace('"evaluations": ', deep, 1))
    with pytest.raises(ReportError, match=r"x\.json: values are nested too deeply$"):
        build_report(find_documents(tmp_path / "x.json"))


@killed_by("output.report.writing", 'errors="xmlcharrefreplace"', "")
def test_half_of_a_surrogate_pair_is_a_replacement_character(results, tmp_path):
    """It is allowed in JSON and stands for the bytes of a file name that are no UTF-8; UTF-8 itself has none."""
    content = json.loads((results / "tune.json").read_text()) | {"scenario": "small \ud800"}
    path = tmp_path / "a\udcff.json"
    path.write_text(json.dumps(content))
    command("report", path, "-o", tmp_path / "x.html")
    found = Page((tmp_path / "x.html").read_bytes().decode())
    assert found.headings[0] == "Tuning of small \N{REPLACEMENT CHARACTER}"


def test_the_command_says_where_it_is(results, tmp_path):
    out = tmp_path / "mine.html"
    result = command("report", results / "tune.json", "-o", out)
    assert result.stderr == f"report: {out}\n"
    assert result.stdout == ""
    assert Page(out.read_text(encoding="utf-8")).headings[0] == "Tuning of small"
    command("report", results / "tune.json", "-o", out)  # its own is replaced
    assert left_in(tmp_path) == {"mine.html"}


@killed_by("cli.sweep_files", "report.write_report_file([out], out / report.DEFAULT_NAME)", "pass")
@pytest.mark.slow
def test_a_sweep_with_figures_writes_its_report(results):
    text = (results / "sweep" / "report.html").read_text(encoding="utf-8")
    assert Page(text).numbers == page(results, "sweep").numbers
    assert json.loads((results / "sweep.json").read_text())["files"]["report"].endswith("report.html")


def invented_sweep(folder, design, variables=("plant.mass", "plant.road.w4"), n=64, never=()):
    """The page of a sweep that was never run; a run fails if its metric is negative, as one in four is."""
    metric = np.where(np.arange(n) % 16 < 4, -1.0, 1.0 + np.arange(n) % 5)
    metric[[*never]] = np.inf
    table = manifest(n, n, variables, ["margin"], success=True)
    table["study"]["space"]["design"] = design
    columns = {"sample": np.arange(n), **{path: np.linspace(0.0, 1.0, n) for path in variables}, "margin": metric}
    columns |= {"stopped": metric > 0, "diverged": np.zeros(n, bool), "refused": np.full(n, "", object)}
    store = Store(folder)
    folder.mkdir()
    store.begin(table, resume=False)
    store.write(0, encode_chunk(columns, Seals(table).of(0)))
    content = summarise_sweep(SweepResults(folder))  # as from Python: without an origin
    (folder / "summary.json").write_text(json.dumps(content))
    return content, Page(build_report(find_documents(folder))).text


@killed_by("output.report.studies", 'content.get("made", {})', 'content["made"]')
@killed_by("output.report.studies", 'None not in (failures["low"], failures["high"])', "True")
@killed_by(
    "output.report.studies", "return [] if worst is None else [shlex.join(command)]", 'return [" ".join(command)]'
)
def test_a_grid_has_a_report_without_intervals(tmp_path):
    _, text = invented_sweep(tmp_path / "my $sweep", {"type": "grid", "levels": 8})
    assert "failed: a probability of 0.25." in text
    assert "spread while plant.mass and plant.road.w4 vary, and how" in text
    line = text[text.index("diffabs simulate") :]
    assert shlex.split(line)[:4] == ["diffabs", "simulate", "--from-sweep", str(tmp_path / "my $sweep")]


def test_of_a_saltelli_design_the_failures_are_among_the_rows_a(tmp_path):
    """Every fourth row is a row A, and of these every fourth fails."""
    content, text = invented_sweep(tmp_path / "s", {"type": "saltelli"})
    assert content["failures"]["any"]["count"] == 4
    assert "64 runs; 0 diverged, 0 were refused. 4 of 16 failed: a probability of 0.25 (95 % interval" in text


@killed_by("output.report.studies", 'content["never"].items()', "{}.items()")
def test_runs_that_never_settle_are_in_the_report(tmp_path):
    _, text = invented_sweep(tmp_path / "s", {"type": "random"}, never=(7, 9, 40))
    assert "Runs with an infinite margin (never), left out of its statistics: 3, the first is sample 7" in text


@killed_by("output.report.studies", "{content['diverged']:,}", "0")
def test_runs_of_a_rare_event_that_diverged_are_counted(tmp_path):
    content = {"scenario": "small", "metric": "iae", "bound": 1.0, "unit": "s", "probability": 1e-4, "interval": [0, 1],
               "levels": [], "failures": {}, "note": "", "reason": "converged", "model": None, "runs": 5000, "seed": 0,
               "diverged": 1234, "engine": {}, "made": {"command": "diffabs rare small iae=1"}}  # fmt: skip
    (tmp_path / "x.json").write_text(json.dumps(content))
    assert "95 % interval 0 to 1. Diverged runs: 1,234." in Page(build_report(find_documents(tmp_path))).text


@killed_by("output.report.studies", 'yield from describe_turned_metrics(content.get("accuracy") or {})', "pass")
def test_a_metric_that_a_half_step_turns_is_in_the_report(tmp_path):
    content, text = invented_sweep(tmp_path / "s", {"type": "random"})
    assert "never with the other" not in text
    turned = {"margin": {"count": 2, "samples": [5, 8]}}
    content["accuracy"] = {"samples": [3, 5, 8], "metrics": {}, "turned": turned}
    (tmp_path / "s" / "summary.json").write_text(json.dumps(content))
    text = Page(build_report(find_documents(tmp_path / "s"))).text
    assert "margin is finite with one step and never with the other in 2 of 3 runs, the first sample 5" in text


@killed_by("cli.sweep_files", "    _write_summary(out, result)\n    return result", "    return result")
@killed_by("cli.sweep", "with console.show_before_errors(show_result):", "if True:")
@pytest.mark.slow
def test_a_sweep_whose_figure_fails_keeps_its_summary(tmp_path, monkeypatch):
    def fail(figure, path):
        raise OSError(28, "No space left on device")

    replace_seam(monkeypatch, "save_figure", fail)
    (tmp_path / "small.toml").write_text(SCENARIO)
    out, words = tmp_path / "out", ("--samples", 8, "--engine", "xla", "--figures")
    result = command("sweep", tmp_path / "small.toml", *words, "--out", out, status=1)
    assert "No space left" in result.stderr
    assert "iae" in result.stdout
    assert json.loads((out / "summary.json").read_text())["samples"] == 8


@killed_by("output.report.page", '"not known" if value is None', '"0" if value is None')
def test_what_json_has_no_number_for_is_not_known(results, tmp_path):
    """The own start of a tuning may diverge, and a bound may be infinite."""
    content = json.loads((results / "tune.json").read_text())
    content["objective"]["before"] = content["constraints"][0]["bound"] = None
    (tmp_path / "x.json").write_text(json.dumps(content))
    text = Page(build_report(find_documents(tmp_path / "x.json"))).text
    assert f"The objective went from not known to {content['objective']['after']:.6g};" in text
    assert "bound not known" in text


@killed_by("output.report.proofs", 'shlex.join(["diffabs", "verify", path])', 'f"diffabs verify {path}"')
def test_commands_of_a_report_can_be_pasted(results, tmp_path):
    """By a shell's own rules each is one command with the file's name as one word."""
    path = tmp_path / "my $files" / "certificate.json"
    path.parent.mkdir()
    path.write_text((results / "certificate.json").read_text())
    text = Page(build_report(find_documents(path))).text
    line = text[text.index("diffabs verify") :]
    assert shlex.split(line)[:3] == ["diffabs", "verify", str(path)]


@killed_by("output.report.documents", 'content.get("format", CERTIFICATE_FORMAT) == CERTIFICATE_FORMAT', "True")
@killed_by("output.report.documents", '    if kinds != ["sweep"]:', "    if False:")
@pytest.mark.parametrize(
    ("content", "words"),
    [
        (None, "there is no such folder or file"),
        ({}, "has no document that reproduce, sweep"),
        ({"notes.txt": "hello"}, "has no document that reproduce, sweep"),
        ({"manifest.json": "{}"}, "--resume completes it"),
        (
            {"x.json": '{"free": {}, "history": [], "constraints": []}'},
            "cannot be read as a document of tune: KeyError",
        ),
        ({"x.json": '{"papers": 3}', "y.json": "[" * 100_000}, "has no document"),
        ({"x.json": '{"format": "of others", "system": {}, "claims": []}'}, "has no document"),
        (
            {"x.json": '{"format": "diffabs tune 2"}'},
            'format = "diffabs tune 2" was written by a newer diffabs; version 1 is needed',
        ),
        ({"x.json": '{"format": "diffabs design 0"}'}, "was written by an older diffabs; version 1 is needed"),
        ({"x.json": '{"format": "diffabs design 99999999999"}'}, "was written by a newer diffabs; version 1 is needed"),
        (
            {"manifest.json": '{"format": 4}', "summary.json": json.dumps(SWEEP_KEYS)},
            "manifest.json: format = 4 was written by a newer diffabs; version 3 is needed",
        ),
        ({"manifest.json": "{}", "summary.json": ""}, "summary.json: is empty; diffabs sweep ... --resume writes it"),
        ({"manifest.json": "{}", "summary.json": "[1]"}, "summary.json: is not a document that reproduce, sweep"),
        (
            {"manifest.json": "{}", "summary.json": '{"free": {}, "history": [], "constraints": []}'},
            "summary.json: is of tune, and a document of sweep is needed; diffabs sweep ... --resume writes it again",
        ),
        (
            {"x.json": '{"format": "diffabs certificate", "version": true, "system": {}, "gain": [], "claims": []}'},
            "cannot be read as a document of certificate: version = true; 1.0 is needed",
        ),
    ],
)
def test_what_is_no_result_is_refused_in_one_line(tmp_path, content, words):
    folder = tmp_path / "there"
    if content is not None:
        folder.mkdir()
        for name, text in content.items():
            (folder / name).write_text(text)
    result = command("report", folder, status=2)
    assert words in result.stderr
    assert_one_error_line(result)
    assert not (folder / "report.html").exists()


@killed_by("output.report.writing", "        check_tables(document)\n", "")
@pytest.mark.parametrize(
    ("path", "value", "words"),
    [
        ("over", [], "over = [] is a list; a table is needed"),
        ("made", [1], "made = [1] is a list; a table is needed"),
        ("model", None, "model = None is nothing; a table is needed"),
        ("model.parameters", "x", 'model.parameters = "x" is text; a table is needed'),
        ("neglected", 3, "a value in it is of the wrong type"),
        ("over", {"plant.mass": [5.3]}, "ValueError not enough values to unpack (expected 2, got 1)"),
    ],
)
def test_a_member_of_another_type_is_one_line(results, tmp_path, path, value, words):
    content = json.loads((results / "design.json").read_text())
    parent, _, name = path.rpartition(".")
    (content[parent] if parent else content)[name] = value
    (tmp_path / "x.json").write_text(json.dumps(content))
    result = command("report", tmp_path / "x.json", status=2)
    assert result.stderr.endswith(f"x.json: cannot be read as a document of design: {words}\n")
    assert_one_error_line(result)


@killed_by("output.report.documents", "if named and not documents:", "if False:")
@pytest.mark.parametrize(
    "text", ["hello", '{"a": 1}', "[1, 2]", '{"papers": {}, "out": "x"}', '{"format": "diffabs box proof 1"}']
)
def test_a_file_of_others_is_refused_in_one_line(tmp_path, text):
    (tmp_path / "x.json").write_text(text)
    result = command("report", tmp_path / "x.json", status=2)
    assert re.search("document that reproduce, sweep, .* prove --json, .* write$", result.stderr)
    assert_one_error_line(result)
    assert left_in(tmp_path) == {"x.json"}


@killed_by("cli.report", "and not (target.is_file() and is_report(target))", "and False")
def test_files_of_others_stay(results, tmp_path):
    out = tmp_path / "report.html"
    out.write_text("<html>a thesis</html>")
    result = command("report", results / "tune.json", "-o", out, status=2)
    assert "exists and is not an earlier report" in result.stderr
    assert_one_error_line(command("report", results / "tune.json", "-o", tmp_path / "report.pdf", status=2))
    assert_one_error_line(command("report", results / "tune.json", "-o", tmp_path, status=2))
    assert out.read_text() == "<html>a thesis</html>"
    assert left_in(tmp_path) == {"report.html"}


def test_the_old_report_stays_where_the_new_one_cannot_be_made(results, tmp_path, monkeypatch):
    out = tmp_path / "report.html"
    command("report", results / "tune.json", "-o", out)
    before = out.read_bytes()
    (tmp_path / "x.json").write_text('{"free": {}, "history": [], "constraints": []}')
    command("report", tmp_path / "x.json", "-o", out, status=2)
    monkeypatch.setattr(writing.files, "write_file", lambda *_: (_ for _ in ()).throw(OSError(28, "No space left")))
    assert_one_error_line(command("report", results / "tune.json", "-o", out, status=1))
    assert out.read_bytes() == before
    assert left_in(tmp_path) == {"report.html", "x.json"}


@pytest.mark.slow
def test_a_terminal_of_80_columns(results, tmp_path):
    with Terminal("report", results / "tune.json", "-o", tmp_path / "report.html") as terminal:
        assert terminal.status() == 0, terminal.text
        assert_orderly(terminal)
        assert_fits(terminal)
    assert "report:" in terminal.text
    assert left_in(tmp_path) == {"report.html"}


@killed_by("output.report.charts", "HEIGHT - AXIS_BOTTOM - (y - low)", "AXIS_TOP + (y - low)")
def test_a_chart_has_its_points_where_they_are():
    """Of a straight line, the places are on one; a value that is no number has none."""
    text = draw_lines([(0, 1.0), (1, 2.0), (2, math.nan), (3, 4.0)], "x < 1", "y")
    points = [tuple(map(float, point.split(","))) for point in text.split('points="')[1].split('"')[0].split()]
    assert len(points) == 3
    (a, b), (c, d) = itertools.pairwise(points)
    assert (b[1] - a[1]) / (b[0] - a[0]) == pytest.approx((d[1] - c[1]) / (d[0] - c[0]), rel=1e-3)
    assert points[0][1] > points[-1][1]
    assert "x &lt; 1" in text
    assert draw_lines([(0, None)], "x", "y") == ""


def test_what_a_document_lacks_is_named(tmp_path):
    (tmp_path / "x.json").write_text('{"gain": [1.0], "states": ["a"], "over": {}, "poles": []}')
    with pytest.raises(ReportError, match=r"cannot be read as a document of design: KeyError 'lower_bound'"):
        build_report(find_documents(tmp_path))


def test_a_number_that_no_float_can_be_is_one_line(tmp_path):
    path = tmp_path / "summary.json"
    path.write_text(f'{{"samples": {10**400}}}')
    with pytest.raises(ReportError, match=r"summary\.json: a whole number of 401 digits is too large$"):
        find_documents(path)
