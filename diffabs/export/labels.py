"""Names for the numbers of a traced program: those of the variables in the source that it was traced from.

JAX notes with each operation the lines of the source that asked for it. The innermost line of a part, below which are
only JAX and this package's own helpers, either assigns a variable, whose name is taken, or returns, and then the
function's is. A program whose source cannot be read gets the names of its operations."""

import ast
import functools
import pathlib
from typing import Any

import jax

from diffabs.kernel.graph import Graph, Node, UpdateLevel

PACKAGE = pathlib.Path(__file__).parents[1]
INTERNAL_PATHS = (pathlib.Path(jax.__file__).parent, *(PACKAGE / name for name in ("core", "kernel", "export")))
ANONYMOUS = ("<lambda>", "<listcomp>", "<genexpr>", "<module>")


class Labelled(Graph):
    """A graph whose nodes are called as their source calls them; `labels` are those of the program that is translated,
    by the id of its operations. What is within an operation, such as a call, has the label of the whole."""

    def __init__(self) -> None:
        """Without nodes."""
        super().__init__()
        self.labels: dict[int, str] = {}
        self._label = ""

    def begins(self, eqn: Any) -> None:
        """Take its label for what follows."""
        self._label = self.labels.get(id(eqn), self._label)

    def _make(
        self, op: str, args: tuple[Node, ...], dtype: Any, attr: Any = None, level: UpdateLevel | None = None
    ) -> Node:
        node = super()._make(op, args, dtype, attr, level)
        node.label = node.label or self._label
        return node


def source_label(eqn: Any) -> str:
    """Return what the source calls the result of an operation; empty where that cannot be told."""
    traceback = getattr(getattr(eqn, "source_info", None), "traceback", None)
    for frame in getattr(traceback, "frames", ()):
        place = pathlib.Path(frame.file_name)
        function = frame.function_name.rpartition(".")[2]
        if any(folder in place.parents for folder in INTERNAL_PATHS) or function in ANONYMOUS:
            continue
        return (_assigned_variables(frame.file_name).get(frame.line_num) or function).strip("_")
    return ""


@functools.cache
def _assigned_variables(file: str) -> dict[int, str]:
    """The variables that the statements of a file assign, by the number of each of their lines."""
    try:
        tree = ast.parse(pathlib.Path(file).read_bytes())
    except (OSError, SyntaxError, ValueError):
        return {}
    found = {}
    for node in ast.walk(tree):
        targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", None)]
        if isinstance(node, ast.Assign | ast.AugAssign | ast.AnnAssign) and isinstance(targets[0], ast.Name):
            found |= dict.fromkeys(range(node.lineno, (node.end_lineno or node.lineno) + 1), targets[0].id)
    return found
