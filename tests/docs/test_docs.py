"""The site's reference: every package that exports names has a place there, every name of it comes, and every
parameter with unit and range."""

import dataclasses
import importlib
import importlib.util
import inspect
import json
import re
import shutil
import subprocess
from types import SimpleNamespace

import pytest
from mutants import killed_by
from project import ROOT

DOCS = ROOT / "docs"


def loaded(name):
    spec = importlib.util.spec_from_file_location(name, DOCS / "_build" / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


exported, parameters, studies = loaded("exported"), loaded("parameters"), loaded("studies")

ROOMS = ("parts", "robust", "uncertainty", "output", "tune")  # rings of packages that users import
INNER = {"output.explore", "output.plot", "output.report"}  # not for import by their names, or figures


def packages():
    inits = [path for ring in ROOMS for path in (ROOT / "diffabs" / ring).glob("*/__init__.py")]
    rooms = {f"{path.parents[1].name}.{path.parent.name}" for path in inits} - INNER
    return {
        "diffabs",
        *(f"diffabs.{name}" for name in {"assess", "engine.interop", "linear", "linear.responses", "tune", *rooms}),
    }


def pages():
    return {path: path.read_text(encoding="utf-8") for path in (DOCS / "reference").glob("*.md")}


def test_every_package_is_in_the_reference():
    marks = [mark for text in pages().values() for mark in exported.MARK.findall(text)]
    assert set(marks) == packages()
    assert len(marks) == len(set(marks))


@pytest.mark.parametrize("package", sorted(packages()))
def test_every_exported_name_comes_from_where_it_is_defined(package):
    module = importlib.import_module(package)
    names = exported.exported(package)
    own = {name: getattr(value, "__module__", None) or "" for name, value in vars(module).items()}
    made = {name for name, home in own.items() if not name.startswith("_") and home.startswith(package)}
    assert made - {"simulate"} <= names.keys()  # the package `diffabs.engine`, which says that it is no function
    for name, path in names.items():
        home, _, last = path.rpartition(".")
        assert getattr(importlib.import_module(home), last) is getattr(module, name)


def parts():
    """Every exported class with parameters, by where it is defined."""
    paths = {path for package in packages() for path in exported.exported(package).values()}
    classes = {
        path: getattr(importlib.import_module(path.rpartition(".")[0]), path.rpartition(".")[2]) for path in paths
    }
    made = {path: one for path, one in classes.items() if inspect.isclass(one) and dataclasses.is_dataclass(one)}
    return {
        path: one for path, one in sorted(made.items()) if any("spec" in f.metadata for f in dataclasses.fields(one))
    }


@killed_by("../docs/_build/parameters.py", 'left = "(" if "above" in bound or low', 'left = "(" if low')
def test_the_reference_shows_unit_and_range_of_every_parameter():
    """Its tables are read from the text of the classes, and the classes say the same."""
    assert len(parts()) > 60
    for path, one in parts().items():
        said = {p.name: (p.unit, p.interval) for p in parameters.parameters(inspect.getsource(one))}
        fields = {f.name: f.metadata["spec"] for f in dataclasses.fields(one) if "spec" in f.metadata}
        plain = {name: dataclasses.replace(spec, unit="1").interval() for name, spec in fields.items()}
        assert said == {name: (fields[name].unit, plain[name]) for name in fields}, path
        assert all(unit for unit, _ in said.values()), path


@killed_by("../docs/_build/parameters.py", 'named = {"unit": "Unit of the value", ', "named = {")
def test_a_part_becomes_a_table():
    text = parameters.table(inspect.getsource(importlib.import_module("diffabs.parts.controllers").PID))
    assert "| `b` | `1.0` | 1 | [0, inf) | Set-point weight of the proportional part. |" in text.splitlines()
    assert "| `antiwindup` | `NoAntiWindup` |  | Part | Anti-windup strategy of the integral. |" in text.splitlines()
    assert parameters.table("def f():\n    return 1\n") == ""
    assert parameters.table("class A:\n    unit = 'm'\n") == "Unit of the value: m."


def test_a_class_shows_how_it_is_called():
    pid = importlib.import_module("diffabs.parts.controllers").PID
    lines = parameters.signature(inspect.getsource(pid)).splitlines()
    assert lines[1:3] == ["PID(", "    *,"]
    assert [line.strip(" ,").partition("=")[0] for line in lines[3:-2]] == [f.name for f in dataclasses.fields(pid)]
    assert "rtol=1e-05" in parameters.signature(inspect.getsource(importlib.import_module("diffabs").Adaptive))
    assert parameters.signature("class A:\n    x: int = 1\n") == ""


def test_a_line_about_a_parameter_keeps_its_name():
    """A line `name: ...` that Google's style would read as the head of a section."""
    pytest.importorskip("griffe", reason="griffe is in the group `docs`")
    doctests = loaded("doctests")
    text = "What it is.\n\nrtol: the error\n    of a step\nstep, h: a length\nNote: no field."
    assert doctests.listed(text, {"rtol", "step", "h"}).splitlines() == [
        "What it is.", "", "", "- `rtol`: the error", "    of a step", "- `step`, `h`: a length", "Note: no field.",
    ]  # fmt: skip


def test_a_mark_becomes_the_names():
    text = exported.on_page_markdown("before\n\n<!-- exported: diffabs.parts.stops -->\n", page=None)
    assert text.startswith("before\n\n::: diffabs.parts.stops.")
    assert "::: diffabs.parts.stops.Standstill" in text
    with pytest.raises(ValueError, match="exports nothing"):
        exported.exported("diffabs.cli")


def test_a_formula_becomes_mathml_without_any_script():
    pytest.importorskip("latex2mathml", reason="latex2mathml is in the group `docs`")
    formulas = loaded("formulas")
    for formula in ("$$\n\\dot v = -g\n$$", "$$ \\dot v =\n-g $$"):
        text = formulas.on_page_markdown(f"Let\n\n{formula}\n\nbe; a price of $5.")
        assert text.startswith("Let\n\n<math")
        assert text.endswith("</math>\n\nbe; a price of $5.")
        assert "<mover><mi>v</mi>" in text


def test_a_formula_that_is_left_as_latex_ends_the_build():
    page = SimpleNamespace(file=SimpleNamespace(src_uri="a.md"))
    on_page_content = loaded("formulas").on_page_content
    assert on_page_content("<p>5 $</p><pre>$$ x $$</pre><code>$$</code>", page=page)
    with pytest.raises(ValueError, match=r"a.md: \$\$ is left"):
        on_page_content("<p>Let $$x = 1$$ be.</p>", page=page)


def test_every_page_is_in_the_navigation():
    text = (ROOT / "mkdocs.yml").read_text(encoding="utf-8")
    listed = set(re.findall(r"^ +- ([\w/-]+\.md)$", text, re.MULTILINE))
    of_studies = {uri for uri in studies.study_files() if uri.endswith(".md")}
    assert listed == {str(path.relative_to(DOCS)) for path in DOCS.rglob("*.md")} | of_studies


@killed_by("../docs/_build/studies.py", '.removeprefix("docs/")', "")
def test_a_link_between_docs_and_a_study_is_that_of_the_site():
    """The site has `docs` at its top, the repository beside `experiments`."""
    links = {
        "index.md": {"../experiments/a/README.md#b": "experiments/a/README.md#b", "faq.md": "faq.md"},
        "design-notes/a.md": {"../../experiments/a/b.png": "../experiments/a/b.png", "../faq.md#a": "../faq.md#a"},
        "experiments/a/README.md": {"../../docs/faq.md": "../../faq.md", "../b/README.md": "../b/README.md"},
    }
    for uri, pairs in links.items():
        for link, site in pairs.items():
            assert studies.site_links(f"see [it]({link}).", uri) == f"see [it]({site})."
    assert studies.site_links("[a](https://b.org/c.md)", "index.md") == "[a](https://b.org/c.md)"


def test_every_study_has_an_entry_and_a_page():
    """`literature` is a command: `diffabs reproduce literature`."""
    folders = {path.parent for path in (ROOT / "experiments").glob("[a-z]*/*") if path.suffix in (".py", ".md")}
    assert {folder.name for folder in folders if not (folder / "README.md").exists()} == set()
    assert {folder.name for folder in folders if not (folder / "run.py").exists()} == {"literature"}


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """The built site; a warning is an error, for `make docs` as well, which CI runs beside the fast tests."""
    if shutil.which("mkdocs") is None:
        pytest.skip("mkdocs is in the group `docs`")
    folder = tmp_path_factory.mktemp("site")
    built = subprocess.run(
        ["mkdocs", "build", "--strict", "--site-dir", folder], cwd=ROOT, capture_output=True, text=True
    )
    assert built.returncode == 0, built.stderr
    return folder


@pytest.mark.slow
def test_the_site_builds_strictly(site):
    assert "margins" in (site / "reference" / "linear" / "index.html").read_text()
    assert re.search(
        r"<td>control/signal/s</td>\s*<td>\(-inf, inf\)</td>", (site / "reference/controllers/index.html").read_text()
    )


@pytest.mark.slow
def test_no_page_shows_latex(site):
    page = (site / "plant-in-15-minutes" / "index.html").read_text()
    assert "<math" in page
    assert "\\dot" not in page


@pytest.mark.slow
def test_a_part_has_one_table_and_no_signature(site):
    page = (site / "reference" / "controllers" / "index.html").read_text()
    (pid,) = re.findall(r'<h2 id="diffabs.parts.controllers.PID".*?(?=<h2 )', page, re.DOTALL)
    assert pid.count("<table>") == 1
    assert "Proportional gain" in pid
    assert "antiwindup" in pid
    assert "PID(</span>" not in pid.partition("<details")[0]
    assert "<h3" not in pid  # no methods


@pytest.mark.slow
def test_see_also_is_a_list_of_links(site):
    page = (site / "reference" / "loops" / "index.html").read_text()
    (measure,) = re.findall(r'<h3 id="diffabs.measure".*?(?=<h3 )', page, re.DOTALL)
    links = re.findall(r'<a [^>]*href="([^"]+)"', measure.partition("See also")[2].partition("</details>")[0])
    assert links == ["#diffabs.rollout", "#diffabs.run_batch", "#diffabs.replace", "../tuning/#diffabs.tune.tune"]


# a query of a newcomer, and pages of which one is among the first three
QUERIES = {
    "time": {"reference/linear"},
    "settling time": {"reference/objectives"},
    "stop time": {"reference/objectives"},
    "stop_time": {"reference/objectives"},
    "overshoot": {"reference/objectives", "results"},
    "first run slow": {"faq"},
    "what is a limit": {"faq"},
    "where": {"compiler", "fields"},
    "FixedStep": {"reference/loops"},
    "fixedstep": {"reference/loops"},
    "plant.mass": {"reference/plants"},
    "phase margin": {"margins", "reference/linear"},
    "gain schedule": {"reference/controllers"},
    "PID": {"reference/controllers"},
    "export C code": {"export", "journeys/c-export", "reference/export"},
    "structured text": {"export", "reference/export"},
    "GPU": {"journeys/gpu", "performance"},
    "matlab": {"howto/matlab"},
    "vmap": {"library", "reference/loops"},
    "anti-windup": {"reference/controllers"},
    "sensor noise": {"reference/sensors", "sweeps"},
    "float32": {"howto/precision"},
    "Lyapunov": {"reference/linear"},
    "how do I plot a run": {"faq"},
}


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("node") is None, reason="the search script runs in node")
def test_the_search_answers(site):
    """By the site's own script, on its own index."""
    script = ROOT / "tests" / "support" / "site_search.cjs"
    ran = subprocess.run(["node", script, site], input=json.dumps([*QUERIES, "a", "i"]), capture_output=True, text=True)
    assert (ran.returncode, ran.stderr) == (0, "")  # a query that fails says so
    answers = json.loads(ran.stdout)
    pages = {
        query: [page[0].partition("#")[0].strip("/") or "index" for page in found] for query, found in answers.items()
    }
    assert {query: pages[query][:3] for query, wanted in QUERIES.items() if not wanted & set(pages[query][:3])} == {}
    assert len(pages["time"]) > 60
    assert "reference/objectives" in pages["time"]


@killed_by("../docs/_build/site_search.py", "count != 1", "False")
def test_a_search_script_without_the_fault_is_noticed():
    repaired = loaded("site_search").repaired
    assert repaired("e=e+s+o.id}") == 'e=e+s+o.id+","}'
    with pytest.raises(ValueError, match="0 places"):
        repaired("e=e+s+o.id+','}")
