"""The pages of the site: their code runs, one block after the other, and prints what stands below it; what they name is
there."""

import importlib.util
import re
import shutil
import warnings

import matplotlib
import pages
import pytest
import typer
from marks import cases
from mutants import killed_by
from project import ROOT

from diffabs.cli.main import app
from diffabs.scenario.scenario import load

matplotlib.use("Agg")
DOCS = ROOT / "docs"
JOURNEYS = sorted(f"journeys/{path.name}" for path in (DOCS / "journeys").glob("*.md"))
WANTED = (
    *("pandas", "pid-over-roads", "own-plant", "own-curve", "lanes", "lq-against-lmi", "python-control", "c-export"),
    *("own-objective", "own-optax", "gpu", "duckdb", "own-reference", "own-sensor", "own-actuator"),
    *("with-equinox", "with-optimistix", "with-numpyro", "with-blackjax", "with-casadi", "with-botorch"),
)
EXECUTED = [*JOURNEYS, "quick-start.md", "tutorials.md", "identify.md", "gradients.md", "howto/precision.md", "car.md"]
SLOW = (  # which compile derivatives of many runs, or several loops, or solve programs
    *("journeys/pid-over-roads.md", "journeys/lq-against-lmi.md", "journeys/own-optax.md", "journeys/duckdb.md"),
    *("journeys/python-control.md", "journeys/own-objective.md", "journeys/pandas.md", "journeys/own-plant.md"),
    *("journeys/lanes.md", "tutorials.md", "identify.md", "gradients.md", "quick-start.md"),
    *("journeys/gpu.md", "journeys/own-curve.md", "howto/precision.md", "car.md"),
    *("journeys/own-reference.md", "journeys/own-sensor.md", "journeys/own-actuator.md"),
)
needs = {"journeys/c-export.md": "cc"}
ECOSYSTEM = {page: page.removeprefix("journeys/with-").removesuffix(".md") for page in JOURNEYS if "/with-" in page}


def text(page):
    return (DOCS / page).read_text(encoding="utf-8")


def test_there_are_these_journeys_of_at_most_40_lines():
    assert {f"journeys/{name}.md" for name in WANTED} == set(JOURNEYS)
    lines = {page: sum(map(bool, map(str.strip, text(page).splitlines()))) for page in JOURNEYS}  # not the empty ones
    assert {page: count for page, count in lines.items() if count > 40} == {}


@killed_by("loop.convert", '.set_index("t")', "", case="journeys/pandas.md")
@killed_by(
    "linear.transfer",
    "period=float(model.dt) if model.dt else None",
    "period=None",
    case="journeys/python-control.md",
)
@killed_by("loop.convert", "good.min(), good.max()", "good.max(), good.min()", case="journeys/lanes.md")
@pytest.mark.parametrize("page", cases(EXECUTED, *SLOW, *ECOSYSTEM))
def test_its_code_prints_what_the_page_says(page, tmp_path, monkeypatch):
    if page in needs and shutil.which(needs[page]) is None:
        pytest.skip(f"no {needs[page]}")
    if page in ECOSYSTEM and importlib.util.find_spec(ECOSYSTEM[page]) is None:
        pytest.skip(f"{ECOSYSTEM[page]} is in the group `ecosystem`")
    monkeypatch.chdir(tmp_path)
    blocks = pages.blocks(text(page))
    assert any(block.said for block in blocks)
    with warnings.catch_warnings():
        if page in ECOSYSTEM:
            warnings.simplefilter("ignore")  # other packages warn of themselves and of each other
        outputs = pages.printed(text(page), page)
    for block, out in zip(blocks, outputs, strict=True):
        assert out == (block.said or "")


@killed_by("../tests/support/pages.py", "for block in blocks(text):", "for block in blocks(text)[:1]:")
def test_what_a_page_says_it_prints_is_seen_and_written():
    page = "a\n\n```python\nprint(1)\n```\n\n```text\n2\n```\n\n```python\nprint(3 )\n```\n"
    assert [block.said for block in pages.blocks(page)] == ["2\n", None]
    assert pages.printed(page, "page") == ["1\n", "3\n"]
    assert pages.written(page, ["1\n", "3\n"]) == page.replace("2\n", "1\n")


def test_every_page_with_code_and_its_output_is_executed():
    """By these tests or by those of the page's own."""
    own = {"margins.md", "library.md", "sweeps.md", "adding.md", "plant-in-15-minutes.md", "export.md"}
    own |= {"compiler.md"}
    said = {str(path.relative_to(DOCS)) for path in DOCS.rglob("*.md") if "```text" in path.read_text(encoding="utf-8")}
    assert said - own <= set(EXECUTED)


COMMANDS = typer.main.get_command(app).commands  # pyright: ignore[reportAttributeAccessIssue]


def named(cell):
    """Each name in backticks, without its arguments."""
    return [name.partition("(")[0] for name in re.findall(r"`([^`]+)`", cell)]


def found(name):
    """Whether a command, or a dotted name of a package, exists."""
    if name.startswith("diffabs "):
        _, command, *words = name.split()
        known = {opt for one in COMMANDS[command].params for opt in one.opts} if command in COMMANDS else set()
        return command in COMMANDS and {word.partition("=")[0] for word in words if word.startswith("-")} <= known
    first, *rest = re.sub(r"^d\.", "diffabs.", name).split(".")
    thing, path = importlib.import_module(first), first
    for part in rest:
        path = f"{path}.{part}"
        if not hasattr(thing, part):
            try:
                importlib.import_module(path)
            except ModuleNotFoundError:
                return False
        thing = getattr(thing, part)
    return True


def test_every_name_in_the_phrase_book_for_matlab_exists():
    rows = [row.split(" | ") for row in text("howto/matlab.md").splitlines() if row.startswith("| ")][1:]
    names = [name for row in rows for name in named(row[1])]
    assert len(rows) > 30
    assert len(names) > 60
    assert [name for name in names if not found(name)] == []
    assert not found("diffabs.linear.lqrr")
    assert not found("diffabs simulat")
    assert not found("diffabs margins --plod")


@pytest.mark.parametrize("page", EXECUTED + ["howto/cluster.md", "index.md", "faq.md"])
def test_every_command_of_the_page_exists(page):
    lines = re.findall(r"^(?: {4})?(diffabs \w.*?)(?: {2,}#.*)?$", text(page), re.MULTILINE)
    for line in [*lines, *re.findall(r"`(diffabs [^`]+)`", text(page))]:
        assert found(line), line
        changes = re.findall(r"--set ([\w.]+=\S+)", line)
        scenario = re.match(r"diffabs \w+ ((?:slip|arm|lab)-\w+)", line)
        if scenario and changes:
            load(scenario[1], changes, integrated=False)


def test_every_check_that_the_page_on_validation_names_exists():
    checks = re.findall(r"`((?:\w+/)?test_\w+\.py)(?:::(\w+))?`", text("validation.md"))
    assert len(checks) >= 20
    for file, test in checks:
        page = (ROOT / "tests" / file).read_text(encoding="utf-8")
        assert not test or f"def {test}(" in page, (file, test)


def test_the_glossary_has_each_term_once_and_both_languages():
    rows = [row.strip("|").split("|") for row in text("glossary.md").splitlines() if row.startswith("| ")][1:]
    english = [row[0].strip() for row in rows]
    assert len(rows) > 50
    assert len(set(english)) == len(english)
    for row in rows:
        assert row[0].isascii(), row
        assert re.search(r"[\u3040-\u30ff\u4e00-\u9fff]|PID", row[1]), row
