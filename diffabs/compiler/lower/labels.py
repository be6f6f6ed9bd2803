"""Names for the numbers of a traced program, taken from the variables of its source.

JAX records with each operation the source lines that it comes from. The innermost line outside JAX and this package's
helpers decides. If it assigns a variable, the label is the variable's name. If not, as in a return statement, or if the
source is not readable, the label is the function's name. Without source lines the label is empty.
"""

import ast
import functools
import pathlib

import jax
from jax.extend.core import JaxprEqn
from jax.typing import DTypeLike

from diffabs.compiler.ir import Graph, Node, UpdateLevel

PACKAGE = pathlib.Path(__file__).parents[2]
INTERNAL_PATHS = (
    pathlib.Path(jax.__file__).parent,
    *(PACKAGE / name for name in ("core", "compiler", "output/export")),
)
ANONYMOUS = ("<lambda>", "<listcomp>", "<genexpr>", "<module>")


class Labelled(Graph):
    """A graph whose nodes have labels from the source.

    A node has the label of the equation in the outermost jaxpr that it comes from, such as a call.

    Attributes:
        labels: Labels of the equations of the outermost jaxpr, by `id(eqn)`; the creator fills it.
    """

    def __init__(self) -> None:
        """Create an empty graph."""
        super().__init__()
        self.labels: dict[int, str] = {}
        self._label = ""

    def begin_equation(self, eqn: JaxprEqn) -> None:
        """Use the label of the equation `eqn` for the following nodes."""
        # Equations of an inner program have no label of their own: the one of the call stays.
        self._label = self.labels.get(id(eqn), self._label)

    def _make(
        self, op: str, args: tuple[Node, ...], dtype: DTypeLike, attr: object = None, level: UpdateLevel | None = None
    ) -> Node:
        node = super()._make(op, args, dtype, attr, level)
        # Equal nodes are one, so the first use names it.
        node.label = node.label or self._label
        return node


def source_label(eqn: JaxprEqn) -> str:
    """Return the variable's or function's name that the source gives to an operation's result; empty if unknown."""
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
    """Return the variables that a file's statements assign, by the number of each of their lines."""
    try:
        tree = ast.parse(pathlib.Path(file).read_bytes())
    except (OSError, SyntaxError, ValueError):
        return {}
    variables = {}
    for node in ast.walk(tree):
        targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", None)]
        if isinstance(node, ast.Assign | ast.AugAssign | ast.AnnAssign) and isinstance(targets[0], ast.Name):
            variables |= dict.fromkeys(range(node.lineno, (node.end_lineno or node.lineno) + 1), targets[0].id)
    return variables
