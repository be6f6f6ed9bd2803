"""One name has one meaning in the whole package, and a function's name is a verb or the noun that it returns.

Things have the names of things in the studies too."""

import ast
import collections
import functools
import pathlib
import re

import pytest
from mutants import killed_by
from project import ROOT

PACKAGE = ROOT / "diffabs"
FILES = {path.relative_to(PACKAGE): path for path in sorted(PACKAGE.rglob("*.py"))}
STUDIES = {path.relative_to(ROOT): path for path in sorted((ROOT / "experiments").rglob("*.py"))}

# The same verb, the same meaning: a command and the function that it calls; the methods of a paper's module; a
# formula of a checker that imports nothing of the package.
SHARED_FUNCTIONS = {
    *("certify", "design", "identify", "margins", "simulate", "sweep", "tune"),
    *("compact", "figures", "loop", "reproduce", "run", "table"),
    *("he", "is_positive_definite"),
}
# The parts of a paper's module, and tables of a checker that imports nothing of the package.
SHARED_CONSTANTS = {"TITLE", "SOLVER", "NOTES", "CLAIMS", "FIELD_SHAPES", "FIELD_RANGES"}
# Methods by which a part from outside meets its contract, factories of whole loops, nouns, and a name of NumPy.
PARTICIPLES = {"prepared", "refined", "holding", "braking", "balancing", "damping", "embed", "seed", "searchsorted"}
IRREGULAR = {
    *("given", "taken", "seen", "drawn", "known", "shown", "told", "made", "found", "kept", "said", "held", "sent"),
    *("lent", "built", "left", "chosen", "written", "broken"),
}
FILLERS = {
    *("found", "one", "given", "chosen", "seen", "kept", "asked", "known", "wanted", "there", "off", "most", "least"),
    *("fine", "left", "mine", "own", "which"),
}


@functools.cache  # and not at import: only one worker runs these tests
def parse(file):
    return ast.parse(file.read_text("utf-8"))


def package_trees():
    return {path: parse(file) for path, file in FILES.items()}


def homes(kind, trees=None):
    """Return the files in which each public class or function is defined at the top of a module, by name."""
    found = collections.defaultdict(set)
    for path, tree in (trees or package_trees()).items():
        for node in tree.body:
            if isinstance(node, kind) and not node.name.startswith("_"):
                found[node.name].add(str(path))
    return found


def several(found):
    return {name: sorted(files) for name, files in found.items() if len(files) > 1}


def constants():
    """Return the values of each constant at the top of a module, as written, by name and file."""
    found = collections.defaultdict(dict)
    for path, tree in package_trees().items():
        for node in tree.body:
            if isinstance(node, ast.Assign | ast.AnnAssign) and node.value is not None:
                targets = node.targets if isinstance(node, ast.Assign) else [node.target]
                for target in targets:
                    if isinstance(target, ast.Name) and target.id.isupper():
                        found[target.id][str(path)] = ast.unparse(node.value)
    return found


def functions(tree):
    """Yield every function of a file, methods and inner ones too, but no property."""
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef) and "property" not in " ".join(map(ast.unparse, node.decorator_list)):
            yield node


def test_a_public_class_has_one_home():
    assert several(homes(ast.ClassDef)) == {}


def test_a_public_function_has_one_meaning():
    shared = several(homes(ast.FunctionDef))
    assert {name: files for name, files in shared.items() if name not in SHARED_FUNCTIONS} == {}
    assert set(shared) >= SHARED_FUNCTIONS  # the list names no function that has one home


def test_two_homes_are_found():
    trees = {pathlib.Path(name): ast.parse("def find(x):\n    pass\n") for name in ("a.py", "b.py")}
    assert several(homes(ast.FunctionDef, trees)) == {"find": ["a.py", "b.py"]}


@killed_by("robust.design.parameter_box", "MIN_ENTRY_EXTENT", "CORRELATION_TOLERANCE")
def test_a_constant_has_one_meaning():
    several_values = {name: files for name, files in constants().items() if len(set(files.values())) > 1}
    assert {name: files for name, files in several_values.items() if name not in SHARED_CONSTANTS} == {}


@killed_by("parts.stops.stops", "_rest_of_braking", "_braked")
@pytest.mark.parametrize("path", FILES, ids=str)
def test_no_function_is_named_by_a_participle(path):
    names = {node.name.strip("_") for node in functions(parse(FILES[path]))}
    found = {name for name in names if re.fullmatch(r"[a-z]+(ed|ing)", name) or name in IRREGULAR}
    assert found - PARTICIPLES == set()


def things(tree):
    """Yield the name and the line of every variable, argument, field and attribute that a file makes."""
    for node in ast.walk(tree):
        match node:
            case ast.arg(arg=name) | ast.ExceptHandler(name=str(name)) | ast.MatchAs(name=str(name)):
                yield name, node.lineno
            case ast.Name(id=name, ctx=ast.Store()) | ast.Attribute(attr=name, ctx=ast.Store()):
                yield name, node.lineno


@killed_by("engine.step.slides", "    comparison: shapes", "    which: shapes")
@pytest.mark.parametrize("path", FILES | STUDIES, ids=str)
def test_a_thing_has_the_name_of_a_thing(path):
    tree = parse((FILES | STUDIES)[path])
    assert [f"{name}, line {line}" for name, line in things(tree) if name.strip("_") in FILLERS] == []


@pytest.mark.parametrize(
    "text",
    ["def f(found): pass", "for one in x: pass", "class A:\n    left: int", "self.own = 1", "[most for most in x]"],
)
def test_a_filler_is_found(text):
    assert {name for name, _ in things(ast.parse(text))} & FILLERS
