"""A hook of MkDocs: `<!-- exported: diffabs.linear -->` in a page becomes the reference of every name that the package
exports, in its order. Read from the text of its `__init__.py`: nothing is imported."""

import ast
import pathlib
import re
from typing import Any

ROOT = pathlib.Path(__file__).parent.parent.parent
MARK = re.compile(r"<!-- exported: ([\w.]+) -->")
FAMILIES = ("plants", "roads", "controllers", "references", "actuators", "sensors", "objectives", "stops")
TABLE_ONLY = "\n    options: {members: false, heading_level: 2}"  # the methods of a part are those of its contract


def exported(package: str) -> dict[str, str]:
    """Return where each exported name is defined, by name. Raises ValueError for a package that exports nothing."""
    text = (ROOT / package.replace(".", "/") / "__init__.py").read_text(encoding="utf-8")
    found = {}
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.FunctionDef) and not node.name.startswith("_"):
            found[node.name] = f"{package}.{node.name}"
        if isinstance(node, ast.ImportFrom) and node.module and node.module.startswith("diffabs"):
            found |= {one.name: f"{node.module}.{one.name}" for one in node.names if one.asname == one.name}
    if not found:
        raise ValueError(f"{package} exports nothing")
    return dict(sorted(found.items(), key=lambda item: item[0].lower()))


def on_page_markdown(markdown: str, **given: Any) -> str:
    """Return the page with the marks replaced. Names are those that users import: `diffabs.parts.controllers.PID` has
    an anchor."""
    del given
    return MARK.sub(lambda mark: _reference(mark[1]), markdown)


def _reference(package: str) -> str:
    options = TABLE_ONLY if package.rpartition(".")[2] in FAMILIES else ""
    return "\n\n".join(f"::: {package}.{name}{options}" for name in exported(package))
