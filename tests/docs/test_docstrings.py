"""Every function that a package exports says what it returns, and names each of its arguments. Examples run. What texts
name is there."""

import ast
import doctest
import importlib
import inspect
import pathlib
import re

import pytest
from mutants import killed_by

import diffabs

PACKAGES = ("design", "identify", "linear", "reliability", "roads", "scenario", "sweep", "tune")
PACKAGES = ("diffabs", *(f"diffabs.{name}" for name in PACKAGES))


def exported():
    """Functions and classes of ours by their names, in one order; what is exported lazily is imported for type checkers
    in the text of the package."""
    found = {}
    for package in map(importlib.import_module, PACKAGES):
        imports = [x for x in ast.walk(ast.parse(inspect.getsource(package))) if isinstance(x, ast.ImportFrom)]
        for name in (alias.asname or alias.name for line in imports for alias in line.names):
            item = getattr(package, name, None)
            ours = not name.startswith("_") and getattr(item, "__module__", "").startswith("diffabs")
            if ours and (inspect.isfunction(item) or inspect.isclass(item)):
                found[f"{item.__module__}.{item.__qualname__}"] = item
    return dict(sorted(found.items()))


EXPORTED = exported()


@pytest.mark.parametrize("name", EXPORTED)
def test_it_has_a_docstring_that_begins_with_a_sentence(name):
    first = (inspect.getdoc(EXPORTED[name]) or "").split("\n\n")[0]
    assert re.search(r"[.:;]($|\s)", first), first


@pytest.mark.parametrize("name", [name for name, item in EXPORTED.items() if inspect.isfunction(item)])
def test_every_argument_is_named(name):
    """As python-control asks it of its own functions. What a run is asked for stands in the contract, protocols.py."""
    text = inspect.getdoc(EXPORTED[name])
    missing = [arg for arg in inspect.signature(EXPORTED[name]).parameters if not re.search(rf"\b{arg}\b", text)]
    assert missing == []


SHOWN = {
    *("core.pytree.replace", "simulate.run.rollout", "simulate.run.measure", "simulate.batch.run_batch"),
    *("linear.linearization.linearize", "linear.regulator.lqr", "linear.regulator.dlqr"),
    *("design.parameter_box.polytope", "design.synthesis.design", "design.analysis.certify"),
    *("tune.tuning.tune", "reliability.failure.failure_probability", "roads.optimum.peak"),
    *(f"roads.{part}" for part in ("burckhardt.Burckhardt", "magic_formula.MagicFormula", "tabulated.Tabulated")),
    "roads.patches.Patches",
}
EXAMPLES = {
    test.name: test
    for name, item in EXPORTED.items()
    for test in doctest.DocTestFinder(recurse=False).find(item, name)
    if test.examples
}


def test_what_is_used_most_has_an_example():
    assert {name.removeprefix("diffabs.") for name in EXAMPLES} >= SHOWN


DEAR = (  # some seconds of compiling
    *("diffabs.tune.tuning.tune", "diffabs.reliability.failure.failure_probability"),
    "diffabs.simulate.batch.run_batch",
)


@pytest.mark.parametrize("name", [pytest.param(x, marks=pytest.mark.slow) if x in DEAR else x for x in EXAMPLES])
def test_the_example_prints_what_it_says(name):
    told = []
    assert doctest.DocTestRunner().run(EXAMPLES[name], out=told.append).failed == 0, "".join(told)


HOME = pathlib.Path(diffabs.__file__).parent
OURS = "|".join(sorted(path.parent.name for path in HOME.glob("*/__init__.py")))
DOTTED = re.compile(rf"`(?:diffabs\.)?((?:{OURS})(?:\.[A-Za-z_]\w*)+)[`(]")
PLACE = re.compile(rf"`(?:diffabs/)?((?:{OURS})/\w[\w/]*\w)")
FILES = {"html"}  # endings of files that have a package's name


def is_there(dotted):
    """Whether a name of the package leads to a module or to what is in one."""
    found = diffabs
    for name in dotted.split("."):
        try:
            found = getattr(found, name, None) or importlib.import_module(f"{found.__name__}.{name}")
        except ImportError:
            return False
    return True


def is_a_place(place):
    """Whether a module, a package, a test or another file stands there."""
    homes = (HOME / place, HOME.parent / "tests" / place)
    return any(home.is_dir() or any(home.parent.glob(f"{home.name}.*")) for home in homes)


@killed_by("tune/constraints.py", "`design.interior.differentiable`", "`design.sensitivity`")
def test_what_is_named_is_there():
    """In the text of the package and on the pages: dotted names, and places such as `simulate/batch`."""
    for path in [*HOME.rglob("*.py"), *(HOME.parent / "docs").rglob("*.md")]:
        text = path.read_text(encoding="utf-8")
        names = [name for name in DOTTED.findall(text) if name.rpartition(".")[2] not in FILES]
        assert [name for name in names if not is_there(name)] == [], path
        assert [place for place in PLACE.findall(text) if not is_a_place(place)] == [], path
