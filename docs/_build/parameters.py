"""The parameters of a part, with default, unit, range and meaning, as a table for the reference. Read from the text of
its class: nothing is imported."""

import ast
import itertools
import math
import textwrap
from collections.abc import Iterator
from types import SimpleNamespace
from typing import NamedTuple

KNOWN = {"math": math, "np": SimpleNamespace(inf=math.inf)}  # what bounds are computed with
LONGEST = 24  # characters of a default
WIDTH = 90  # characters of a line
FIELDS = ("param", "part", "static", "entry", "dataclasses.field")  # what makes a field with a default


class Parameter(NamedTuple):
    """A field that is made by `param`, as a person reads it."""

    name: str
    default: str
    unit: str
    interval: str


def parameters(source: str) -> list[Parameter]:
    """Return the parameters of the class whose text this is, in its order; none for anything else."""
    (tree, *_) = ast.parse(textwrap.dedent(source)).body or [None]
    return list(_found(tree)) if isinstance(tree, ast.ClassDef) else []


def _found(tree: ast.ClassDef) -> Iterator[Parameter]:
    for line in tree.body:
        call = line.value if isinstance(line, ast.AnnAssign) else None
        if isinstance(call, ast.Call) and ast.unparse(call.func) == "param":
            said = {one.arg: one.value for one in call.keywords if one.arg}
            yield Parameter(ast.unparse(line.target), _default(said), _unit(said), _interval(said))


def _default(said: dict[str, ast.expr]) -> str:
    if "default" not in said:
        return "must be given"
    text = ast.unparse(said["default"]).replace("np.inf", "inf").replace("math.inf", "inf")
    return text if len(text) <= LONGEST else text[:LONGEST] + " ..."


def _unit(said: dict[str, ast.expr]) -> str:
    return str(ast.literal_eval(said["unit"]))


def _interval(said: dict[str, ast.expr]) -> str:
    """As `Spec.interval` has it, without the unit."""
    bound = {name: _number(said[name]) for name in ("low", "high", "above", "below") if name in said}
    low, high = bound.get("above", bound.get("low", -math.inf)), bound.get("below", bound.get("high", math.inf))
    left = "(" if "above" in bound or low == -math.inf else "["
    right = ")" if "below" in bound or high == math.inf else "]"
    return f"{left}{low:g}, {high:g}{right}"


def _number(node: ast.expr) -> float:
    return float(eval(ast.unparse(node), {"__builtins__": {}}, KNOWN))


def signature(source: str) -> str:
    """Return how a class is called, from its fields, as a block of Python in Markdown; nothing if it has no fields."""
    (tree, *_) = ast.parse(textwrap.dedent(source)).body or [None]
    if not isinstance(tree, ast.ClassDef) or not any(_makes_fields(one) for one in tree.decorator_list):
        return ""
    lines = [line for line in tree.body if isinstance(line, ast.AnnAssign)]
    fields = [f"{ast.unparse(line.target)}{_after(line.value)}" for line in lines]
    named = ["*"] if any(ast.unparse(one).startswith("pytree") for one in tree.decorator_list) else []
    call = f"{tree.name}({', '.join(named + fields)})"
    if len(call) > WIDTH:
        call = f"{tree.name}(\n    " + ",\n    ".join(named + fields) + ",\n)"
    return f"```python\n{call}\n```" if fields else ""


def _makes_fields(decorator: ast.expr) -> bool:
    return ast.unparse(decorator).partition("(")[0] in ("pytree", "dataclass", "dataclasses.dataclass")


def _after(value: ast.expr | None) -> str:
    """What follows the name of a field: its default, if it has one."""
    if isinstance(value, ast.Call) and ast.unparse(value.func) in FIELDS:
        said = {one.arg: one.value for one in value.keywords}
        default = said.get("default") or said.get("default_factory")
        return f"={_default({'default': default})}" if default else ""
    return f"={ast.unparse(value)}" if value else ""


def meanings(source: str) -> dict[str, str]:
    """Return the string below each field of the class whose text this is, by field."""
    (tree, *_) = ast.parse(textwrap.dedent(source)).body or [None]
    texts = {}
    for line, below in itertools.pairwise(tree.body if isinstance(tree, ast.ClassDef) else ()):
        match line, below:
            case ast.AnnAssign(target=ast.Name(name)), ast.Expr(value=ast.Constant(str(text))):
                texts[name] = " ".join(text.split()).replace("|", "\\|")
    return texts


def table(source: str) -> str:
    """Return the fields of a class with parameters, or with meanings, as a table in Markdown, empty for any other; and
    what its class attributes say of units."""
    numeric, texts, rows = {p.name: p for p in parameters(source)}, meanings(source), []
    for name, default, kind in _fields(source) if numeric or texts else ():
        p = numeric.get(name) or Parameter(name, default, "", kind)
        cells = (f"`{p.name}`", f"`{p.default}`" if p.default else "", p.unit, p.interval, texts.get(name, ""))
        rows.append("| " + " | ".join(cells) + " |")
    head = ["| parameter | default | unit | range | meaning |", "|---|---|---|---|---|"]
    units = [f"{what}: {unit}." for what, unit in _units(source)]
    return "\n".join(["\n".join(head + rows) if rows else "", *([""] if rows and units else []), *units]).strip()


def _fields(source: str) -> Iterator[tuple[str, str, str]]:
    """Name, default and type of each field of a class, in its order."""
    (tree, *_) = ast.parse(textwrap.dedent(source)).body or [None]
    for line in tree.body if isinstance(tree, ast.ClassDef) else ():
        if isinstance(line, ast.AnnAssign):
            kind = ast.unparse(line.annotation).strip("'").replace("|", "or")
            yield ast.unparse(line.target), _after(line.value).removeprefix("="), kind


def _units(source: str) -> Iterator[tuple[str, str]]:
    """The unit of an objective's value, that of a plant's control."""
    (tree, *_) = ast.parse(textwrap.dedent(source)).body or [None]
    named = {"unit": "Unit of the value", "control_unit": "Unit of the control"}
    for line in tree.body if isinstance(tree, ast.ClassDef) else ():
        if isinstance(line, ast.Assign) and isinstance(line.value, ast.Constant):
            for name in (target.id for target in line.targets if isinstance(target, ast.Name)):
                if name in named and line.value.value:
                    yield named[name], str(line.value.value)
