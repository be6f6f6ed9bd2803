"""A design note has a date and a status, and what it names in `code` is there.

In a span every word is a name: one that the package, a study, a benchmark or a tool of the tests binds (module, class,
function, argument or field; no local variable), a command, an option, a packaged scenario, a requirement, or a name of
Python or JAX. A dotted name is there as a whole: `step/attempt.attempt_step` is bound in that file, `Adaptive.step` in
that class, and `jax.lax.scan` in JAX."""

import ast
import builtins
import datetime
import functools
import importlib
import re
from collections import defaultdict

import jax
import pytest
from mutants import killed_by
from project import ROOT

NOTES = sorted((ROOT / "docs" / "design-notes").glob("*.md"))
HEAD = re.compile(r"\A# .+\n\n\*(\d{4}-\d\d-\d\d)\. (?:Holds|Superseded by \[[^\]]+\]\(([\w-]+\.md)\))\.\*\n")
SPAN = re.compile(r"`([^`\n]+)`")
PACKAGE, TOOLS = ("diffabs",), ("benchmarks", "experiments", "tests/support")
LIBRARIES = {"jnp": "jax.numpy", "lax": "jax.lax", "d": "diffabs"}
WORDS = re.compile(r"--[\w-]+|[A-Za-z_][\w.]*(?:-[a-z]\w*)*")
PLACE = re.compile(r"\w[\w-]*(?:/[\w-]+)+(?:\.[\w.]+)?/?|\w+/(?!\w)|\b\w+\.(?:py|h)\b")
REQUIREMENTS = re.findall(r'"([\w-]+)[>=]=', (ROOT / "pyproject.toml").read_text(encoding="utf-8"))
OTHERS = {*dir(builtins), *dir(jax), *REQUIREMENTS, "diffabs", "python", "import"}


@functools.cache
def files():
    """The files of the repository that a note may name, by their paths from the root."""
    tops = [ROOT / top for top in (*PACKAGE, "benchmarks", "experiments", "tests", "docs")]
    places = [*tops, *(path for top in tops for path in top.rglob("*"))]
    return {path.relative_to(ROOT).as_posix(): path for path in places if "__pycache__" not in path.parts}


def bound_in(body):
    """The names that statements bind, and the same of each class among them."""
    names, classes = set(), {}
    for node in body:
        if isinstance(node, ast.ClassDef | ast.FunctionDef):
            names.add(node.name)
        if isinstance(node, ast.ClassDef):
            classes[node.name], inner = bound_in(node.body)
            classes |= inner
        targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", None)]
        names |= {name.id for target in targets if target for name in ast.walk(target) if isinstance(name, ast.Name)}
        if isinstance(node, ast.Import | ast.ImportFrom):
            names |= {(alias.asname or alias.name).partition(".")[0] for alias in node.names}
    return names, classes


@functools.cache
def bindings():
    """Return the single names, and by module (its last part) or class the names that are bound in it."""
    words, members = set(), defaultdict(set)
    for place, path in files().items():
        if path.is_dir():
            words.add(path.name)
            members[path.name] |= {inner.stem for inner in path.iterdir()}
        if path.suffix != ".py" or not place.startswith((*PACKAGE, *TOOLS)):
            continue
        tree = ast.parse(path.read_text(encoding="utf-8"))
        names, classes = bound_in(tree.body)
        members[path.parent.name if path.stem == "__init__" else path.stem] |= names
        for name, inner in classes.items():
            members[name] |= inner
        words |= {path.stem, *names, *(name for inner in classes.values() for name in inner)}
        for node in ast.walk(tree):
            if isinstance(node, ast.FunctionDef):
                words |= {
                    node.name,
                    *(argument.arg for argument in ast.walk(node.args) if isinstance(argument, ast.arg)),
                }
            if isinstance(node, ast.Constant) and isinstance(node.value, str) and not place.startswith(PACKAGE):
                words.add(node.value)  # rows of a table that a tool prints
    return words, members


@functools.cache
def command_words():
    """Commands and options of `diffabs`, and packaged scenarios."""
    from diffabs.cli.main import app

    texts = [path.read_text(encoding="utf-8") for path in (ROOT / "diffabs" / "cli").glob("*.py")]
    options = {option for text in texts for option in re.findall(r'"(--[\w-]+)', text)}
    scenarios = {path.stem for path in (ROOT / "diffabs").rglob("*.toml")}
    commands = {command.name or command.callback.__name__ for command in app.registered_commands}
    return options | scenarios | commands


def is_there(dotted):
    """Whether a dotted name is one of the package, or of a library."""
    words, members = bindings()
    first, *rest = dotted.split(".")
    if first in LIBRARIES or (first in ("jax", "scipy", "distributed", "diffabs") and rest):
        return is_imported(LIBRARIES.get(first, first), rest)
    if first not in words | OTHERS | command_words():
        return False
    return all(name in members[owner] for owner, name in zip([first, *rest], rest, strict=False)) or is_path(dotted)


def is_path(dotted):
    """Whether it is the path of a parameter: fields, from one of a loop."""
    words, members = bindings()
    first, *rest = dotted.split(".")
    return first in members["Loop"] and set(rest) <= words


def is_imported(module, names):
    value = importlib.import_module(module)
    for name in names:
        try:
            value = getattr(value, name, None) or importlib.import_module(f"{value.__name__}.{name}")
        except (ImportError, AttributeError):
            return False
    return True


def is_a_place(place):
    """Whether a file or folder has this end of a path, with or without ending, and binds the names after a point."""
    end, point, rest = place.rstrip("/").partition(".")
    for path in files():
        if path == place.rstrip("/") or path.endswith(f"/{place.rstrip('/')}"):
            return True
        stem = path.removesuffix(".py")
        if (stem == end or stem.endswith(f"/{end}")) and (not point or is_there(f"{stem.rpartition('/')[2]}.{rest}")):
            return True
    return False


def missing(text):
    """Return the names in the spans of a note that are not there."""
    lost = []
    for span in SPAN.findall(re.sub(r"```.*?```", "", text, flags=re.DOTALL)):
        places = PLACE.findall(span)
        lost += [place for place in places if not is_a_place(place)]
        quoted = re.sub(r'"[^"]*"', "", PLACE.sub("", span))
        lost += [word for word in WORDS.findall(quoted) if word not in command_words() and not is_there(word)]
    return lost


@killed_by("../docs/design-notes/one-step.md", "attempt.attempt_step", "attempt.try_step")
@pytest.mark.parametrize("note", NOTES, ids=lambda path: path.stem)
def test_what_a_note_names_is_there(note):
    assert missing(note.read_text(encoding="utf-8")) == []


@pytest.mark.parametrize(
    "span",
    [
        "try_step",
        "step/attempt.try_step",
        "Adaptive.tolerance",
        "core/ghosts",
        "jax.lax.scam",
        "--resumed",
        "plant.mas",
    ],
)
def test_a_name_that_is_gone_is_noticed(span):
    assert len(missing(f"By `{span}`.")) == 1


@killed_by("../docs/design-notes/one-step.md", ". Holds.*", ". Holds*")
@pytest.mark.parametrize("note", NOTES, ids=lambda path: path.stem)
def test_a_note_begins_with_its_date_and_status(note):
    head = HEAD.match(note.read_text(encoding="utf-8"))
    assert head
    assert datetime.date.fromisoformat(head[1]) >= datetime.date(2026, 11, 1)
    assert head[2] is None or (note.parent / head[2]).exists()
