"""Every public function of the package says what it returns, and describes each of its arguments. Examples run. What
texts name is there."""

import ast
import doctest
import functools
import importlib
import inspect
import pathlib
import re

import pytest
from mutants import killed_by

import diffabs

PACKAGES = """
linear parts.controllers parts.roads robust.design robust.reach scenario tune tune.identify uncertainty.reliability
uncertainty.sweep
"""
PACKAGES = ("diffabs", *(f"diffabs.{name}" for name in PACKAGES.split()))


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


HOME = pathlib.Path(diffabs.__file__).parent
FILES = sorted(str(path.relative_to(HOME)) for path in HOME.rglob("*.py"))
NO_VERBS = {
    *("A", "An", "The", "What", "Whether", "How", "Which", "Why", "Where", "When", "Those", "That", "This", "If"),
    *("For", "By", "In", "Of", "One", "All", "Each", "Every"),
}
ENTRY = re.compile(r"^    \**([\w, *]+?)(?: \(.*?\))?:", re.MULTILINE)


def public_functions(path):
    """Yield the public functions and classes at the top of a module, and the public methods of such classes."""
    for node in ast.parse((HOME / path).read_text(encoding="utf-8")).body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef) and not node.name.startswith("_"):
            yield node, ""
            if isinstance(node, ast.ClassDef):
                inner = [one for one in node.body if isinstance(one, ast.FunctionDef) and not one.name.startswith("_")]
                yield from ((one, f"{node.name}.") for one in inner)


def described_in_a_base(path):
    """Return "Class.method" of each method whose text stands in a base class of the same module, as `help` shows it."""
    tree = ast.parse((HOME / path).read_text(encoding="utf-8"))
    classes = {node.name: node for node in tree.body if isinstance(node, ast.ClassDef)}

    def methods_with_text(name):
        bases = [methods_with_text(base.id) for base in classes[name].bases if getattr(base, "id", "") in classes]
        methods = [node for node in classes[name].body if isinstance(node, ast.FunctionDef)]
        return set().union(*bases) | {method.name for method in methods if ast.get_docstring(method)}

    return {f"{name}.{method}" for name in classes for method in methods_with_text(name)}


@functools.cache
def contract_methods():
    """Return the names of the methods that contracts describe, in protocols.py: parts need not say it again."""
    tree = ast.parse((HOME / "core/protocols.py").read_text(encoding="utf-8"))
    offered = re.findall(r"(\w+)\(", ast.get_docstring(tree) or "")
    classes = [node for node in tree.body if isinstance(node, ast.ClassDef)]
    return {one.name for node in classes for one in node.body if isinstance(one, ast.FunctionDef)} | set(offered)


@killed_by("core.cubic", '"""Return dp/dx at', '"""The slope dp/dx at')
@pytest.mark.parametrize("path", FILES)
def test_a_docstring_begins_with_a_sentence(path):
    """Of a function with a verb, of a property or a class with a noun."""
    contract, inherited = contract_methods(), described_in_a_base(path)
    for node, owner in public_functions(path):
        text = ast.get_docstring(node) or ""
        decorators = " ".join(map(ast.unparse, getattr(node, "decorator_list", [])))
        described = (owner and node.name in contract) or owner + node.name in inherited
        if not text and (described or "overload" in decorators):
            continue
        assert re.search(r"[.:;]($|\s)", text.split("\n\n")[0]), owner + node.name
        if isinstance(node, ast.FunctionDef) and "property" not in decorators and not (owner and node.name in contract):
            assert text.split()[0] not in NO_VERBS, f"{owner}{node.name}: {text.splitlines()[0]}"


@killed_by("parts.roads.optimum", "        speed: Vehicle", "        velocity: Vehicle")
@pytest.mark.parametrize("name", [name for name, item in EXPORTED.items() if inspect.isfunction(item)])
def test_every_argument_of_an_exported_function_is_described(name):
    """Under Args. An internal function describes what its names and types do not say."""
    text = inspect.getdoc(EXPORTED[name]) or ""
    listed = re.search(r"^Args:\n((?:    .*\n?|\n)*)", text + "\n", re.MULTILINE)
    entries = ENTRY.findall(listed[1]) if listed else []
    named = {argument.strip(" *") for entry in entries for argument in entry.split(",")}
    assert [argument for argument in inspect.signature(EXPORTED[name]).parameters if argument not in named] == []


MOST_USED = {
    *("core.pytree.replace", "loop.run.rollout", "loop.run.measure", "loop.ensemble.run_batch"),
    *("engine.solve.solve", "engine.solvers.FixedStep", "engine.solvers.Adaptive", "parts.controllers.pid.PID"),
    *("linear.regulator.lqr", "linear.riccati.care", "linear.stability_margins.margins"),
    *("robust.design.synthesis.design", "robust.design.analysis.certify", "scenario.proofs.prove_box"),
    *("tune.tuning.tune", "tune.tuning.build_problem", "tune.worst.worst_case"),
    *(
        "tune.identify.identification.identify",
        "uncertainty.sweep.run.sweep",
        "uncertainty.reliability.failure.failure_probability",
    ),
}
SHOWN = MOST_USED | {
    *(
        "linear.linearization.linearize",
        "linear.regulator.dlqr",
        "robust.design.parameter_box.polytope",
        "parts.roads.optimum.peak",
    ),
    *(f"parts.roads.{part}" for part in ("burckhardt.Burckhardt", "magic_formula.MagicFormula", "tabulated.Tabulated")),
    "parts.roads.patches.Patches",
}
EXAMPLES = {
    test.name: test
    for name, item in EXPORTED.items()
    for test in doctest.DocTestFinder(recurse=False).find(item, name)
    if test.examples
}


def test_what_is_used_most_has_an_example():
    assert {name.removeprefix("diffabs.") for name in EXAMPLES} >= SHOWN


@killed_by("linear.regulator", "    Notes:\n", "    Remarks:\n", case="linear.regulator.lqr")
@pytest.mark.parametrize("name", sorted(MOST_USED))
def test_what_is_used_most_is_explained(name):
    """With what is similar, and with formulas and their sources."""
    text = inspect.getdoc(EXPORTED[f"diffabs.{name}"])
    sections = re.findall(r"^(See also|Notes|Examples):$", text, re.MULTILINE)
    assert sections == ["See also", "Notes", "Examples"]


DEAR = (  # some seconds of compiling
    *(
        "diffabs.linear.regulator.lqr",
        "diffabs.linear.riccati.care",
        "diffabs.linear.regulator.dlqr",
        "diffabs.scenario.simulation.simulate",
        "diffabs.uncertainty.reliability.failure.failure_probability",
    ),
    *("diffabs.loop.ensemble.run_batch", "diffabs.loop.run.measure", "diffabs.linear.linearization.linearize"),
    *("diffabs.parts.roads.optimum.peak", "diffabs.tune.tuning.tune", "diffabs.tune.worst.worst_case"),
    *(
        "diffabs.uncertainty.sweep.run.sweep",
        "diffabs.tune.identify.identification.identify",
        "diffabs.robust.reach.cover.cover_box",
        "diffabs.robust.frequency.peaks.bound_peaks",
        "diffabs.scenario.proofs.prove_box",
    ),
    *("diffabs.engine.solve.solve", "diffabs.loop.run.rollout"),
)


@pytest.mark.parametrize("name", [pytest.param(x, marks=pytest.mark.slow) if x in DEAR else x for x in EXAMPLES])
def test_the_example_prints_what_it_says(name):
    told = []
    assert doctest.DocTestRunner().run(EXAMPLES[name], out=told.append).failed == 0, "".join(told)


WORDS = {"loop", "output", "parts", "uncertainty"}  # rings whose names are words of ours, too
RINGS = {path.parent.name: path.parent.name for path in HOME.glob("*/__init__.py")}
ROOMS = {path.parent.name: f"{path.parts[-3]}/{path.parts[-2]}" for path in HOME.glob("*/*/__init__.py")}
HOMES = {**ROOMS, **RINGS}  # a room may be named without its ring
OURS = "|".join(sorted(HOMES.keys() - WORDS - {"step", "native", "proof", "runtime", "statistics"}))
DOTTED = re.compile(rf"`(?:diffabs\.)?((?:{OURS})(?:\.[A-Za-z_]\w*)+)[`(]")
PLACE = re.compile(rf"`(?:diffabs/)?((?:{OURS})/\w[\w/]*\w)")
ENDINGS = {"html"}  # endings of files that have a package's name


def is_there(dotted):
    """Whether a name of the package leads to a module or to what is in one."""
    first, *rest = dotted.split(".")
    found = diffabs
    for name in (*HOMES[first].split("/"), *rest):
        try:
            found = getattr(found, name, None) or importlib.import_module(f"{found.__name__}.{name}")
        except ImportError:
            return False
    return True


def is_a_place(place):
    """Whether a module, a package, a test or another file stands there."""
    first, _, rest = place.partition("/")
    homes = (HOME / HOMES[first] / rest, HOME.parent / "tests" / place)
    return any(home.is_dir() or any(home.parent.glob(f"{home.name}.*")) for home in homes)


@killed_by("tune.constraints", "`design.interior.decay_rate`", "`design.sensitivity`")
def test_what_is_named_is_there():
    """In the text of the package and on the pages: dotted names, and places such as `loop/batch`."""
    for path in [*HOME.rglob("*.py"), *(HOME.parent / "docs").rglob("*.md")]:
        text = path.read_text(encoding="utf-8")
        names = [name for name in DOTTED.findall(text) if name.rpartition(".")[2] not in ENDINGS]
        assert [name for name in names if not is_there(name)] == [], path
        assert [place for place in PLACE.findall(text) if not is_a_place(place)] == [], path
