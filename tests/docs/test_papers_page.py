"""docs/papers.md: complete, and every test and command that it names exists."""

import ast
import re
import shlex

import pytest
import typer
from project import ROOT

from diffabs.cli.main import app
from diffabs.papers import REPRODUCTIONS
from diffabs.scenario.scenario import names

PAGE = (ROOT / "docs" / "papers.md").read_text(encoding="utf-8")
SECTIONS = dict(re.findall(r"^## (\[\w+\]).*?$(.*?)(?=^## |\Z)", PAGE, re.DOTALL | re.MULTILINE))
PRINTED = {  # what each paper has: equations, figures, tables
    "[est]": (range(1, 14), range(1, 13), range(1, 3)),
    "[lmi]": (range(1, 33), range(1, 8), range(0)),
    "[arm]": (range(1, 12), range(1, 4), range(1, 2)),
}
VERDICTS = ("Reproduced", "reproduced", "Refuted", "refuted", "In part", "Not decidable", "not decidable")
PLAIN = ("Built", "Integrals", "Done", "0/0")  # rows that say what was done with what has no verdict


def rows(section):
    found = [[cell.strip() for cell in line.strip("|").split("|")] for line in section.splitlines() if line[:1] == "|"]
    assert found[0] == ["what", "verdict", "shown by"]
    return found[2:]


def expanded(text):
    """1-3, 5 or (1)-(3), (5) as a set of numbers."""
    found = set()
    for first, last in re.findall(r"(\d+)\)?(?:\s*-\s*\(?(\d+))?", text):
        found |= set(range(int(first), int(last or first) + 1))
    return found


@pytest.mark.parametrize("paper", PRINTED)
def test_nothing_printed_is_left_out(paper):
    first = [row[0] for row in rows(SECTIONS[paper])]
    kinds = (
        r"(?:[Ee]qs?\. )((?:\(\d+\)(?:-|, )?)+)",
        r"(?:Figs?\. )((?:\d+(?:-|, )?)+)",
        r"(?:Tables? )((?:\d+(?:-|, | and )?)+)",
    )
    for kind, there in zip(kinds, PRINTED[paper], strict=True):
        named = set().union(*(expanded(m) for text in first for m in re.findall(kind, text)))
        assert named == set(there), kind


@pytest.mark.parametrize("paper", PRINTED)
def test_each_row_has_a_verdict_and_shows_it(paper):
    for what, verdict, shown in rows(SECTIONS[paper]):
        assert re.search(r"\*\*(" + "|".join(VERDICTS) + r")\*\*", verdict) or verdict.startswith(PLAIN), what
        assert re.fullmatch(r"`[^`]+`(, `[^`]+`)*", shown), what


def test_every_test_that_is_named_exists():
    named = set(re.findall(r"`(\w+/test_\w+\.py)::(\w+)`", PAGE))
    assert len(named) > 50
    for file, name in named:
        tree = ast.parse((ROOT / "tests" / file).read_text(encoding="utf-8"))
        assert name in {node.name for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)}, f"{file}::{name}"


def test_every_command_that_is_named_exists():
    commands = {c for c in re.findall(r"`([^`]+)`", PAGE) if c.startswith(("diffabs ", "python "))}
    assert len(commands) >= 7
    known = typer.main.get_command(app).commands  # pyright: ignore[reportAttributeAccessIssue]
    for command in commands:
        program, *words = shlex.split(command)
        if program == "python" and words[0] != "-m":
            assert (ROOT / words[0]).is_file(), command
        elif program == "diffabs":
            assert words[0] in known, command
            options = {name for parameter in known[words[0]].params for name in parameter.opts}
            assert {w.partition("=")[0] for w in words if w.startswith("--")} <= options, command
            assert words[1] in ((*REPRODUCTIONS, "all") if words[0] == "reproduce" else names()), command


def test_every_verdict_computed_for_this_page_is_on_it():
    tree = ast.parse((ROOT / "tests" / "papers" / "test_papers_verdicts.py").read_text(encoding="utf-8"))
    there = {node.name for node in tree.body if isinstance(node, ast.FunctionDef) and node.name.startswith("test_")}
    assert {name for name in there if f"test_papers_verdicts.py::{name}`" not in PAGE} == set()


def test_the_readme_leads_to_the_page():
    assert "docs/papers.md" in (ROOT / "README.md").read_text(encoding="utf-8")
