"""Operations on single numbers as C99: what a controller and a plant have in common.

An operation that C has no word for is an objection that names it."""

import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any

import numpy as np

from diffabs.kernel.graph import Node, is_real
from diffabs.kernel.primitives import Unsupported

C_TYPES = {"int64": "int64_t", "uint64": "uint64_t", "int32": "int32_t", "uint32": "uint32_t", "bool": "bool"}
C_INFIX = {
    **{"add": "+", "sub": "-", "mul": "*", "div": "/", "quotient": "/", "and": "&", "or": "|", "xor": "^"},
    **{"lt": "<", "le": "<=", "eq": "==", "ne": "!=", "shift_left": "<<", "shift_right_logical": ">>"},
}
CLAMP_COMPARISONS = {"lower": "<", "higher": ">"}
EXTREMES = {"min": "<", "max": ">"}
C_FUNCTIONS = {
    **{name: name for name in ("exp", "log", "log1p", "expm1", "sin", "cos", "tan", "tanh", "atan", "asin", "acos")},
    **{name: name for name in ("sinh", "cosh", "atan2", "pow", "sqrt", "rint", "floor", "ceil")},
    **{"abs": "fabs", "rem": "fmod"},
}
C_KEYWORDS_TEXT = (
    "auto break case char const continue default do double else enum extern float for goto if inline int long "
    "register restrict return short signed sizeof static struct switch typedef union unsigned void volatile while "
    "bool true false"
)
C_KEYWORDS = set(C_KEYWORDS_TEXT.split())
TAKEN = {*C_FUNCTIONS.values(), "s", "p", "in", "i", "m", "t", "h"}  # which a variable must not hide


class Words:
    """C for numbers of a type, `real` (`single`: in single precision), where `place(where, path)` says where an input
    of the graph stands."""

    def __init__(self, real: str, place: Callable[[str, str], str], single: bool = False):
        """Nothing is written yet."""
        self.real, self.place, self.single = real, place, single
        self._names: dict[int, str] = {}
        self._taken = {*TAKEN, real}

    def operations(self, nodes: Sequence[Node], indent: str) -> Iterator[str]:
        """The lines that work these out, arguments first."""
        for node in nodes:
            if node.op in ("const", "input"):
                continue
            if node.op == "table":
                rows = ", ".join(self.name(x) for x in node.args[1:])
                yield f"{indent}const {self.type(node)} {self.name(node)}_table[] = {{{rows}}};"
            yield f"{indent}const {self.type(node)} {self.name(node)} = {self._expression(node)};"

    def type(self, node: Node) -> str:
        """Of a number."""
        return self.real if is_real(node.dtype) else C_TYPES[node.dtype.name]

    def name(self, node: Node) -> str:
        """What stands for a number: a literal, a variable, a place."""
        if node.op == "const":
            return self._literal(node)
        if node.op == "input":
            return self.place(*node.attr)
        if node.id not in self._names:
            self._names[node.id] = fresh_name(identifier(node.label) or node.op, self._taken)
        return self._names[node.id]

    def _literal(self, node: Node) -> str:
        x = node.attr
        if node.dtype.kind == "b":
            return "true" if x else "false"
        return self.literal(x) if is_real(node.dtype) else f"(({C_TYPES[node.dtype.name]}){int(x)})"

    def literal(self, x: Any) -> str:
        """A real number, of NumPy, as it is written."""
        if np.isnan(x):
            return "NAN"
        if np.isinf(x):
            return "(-INFINITY)" if x < 0 else "INFINITY"
        short = 1e-4 <= abs(x) < 1e7 or x == 0
        text = np.format_float_positional(x, trim="0") if short else np.format_float_scientific(x, trim="0")
        text += "f" if self.single else ""
        return f"({text})" if np.signbit(x) else text

    def _expression(self, node: Node) -> str:
        args = [self.name(x) for x in node.args]
        suffix = "f" if self.single else ""
        if node.op == "ne" and node.args[0] is node.args[1]:
            return f"isnan({args[0]}) != 0"
        if node.op in C_INFIX:
            return f"{args[0]} {C_INFIX[node.op]} {args[1]}"
        if node.op in CLAMP_COMPARISONS:
            return f"{args[0]} {CLAMP_COMPARISONS[node.op]} {args[1]} ? {args[0]} : {args[1]}"
        if node.op in EXTREMES:  # NaN where either is
            a, b = args
            return f"{a} != {a} || {a} {EXTREMES[node.op]} {b} ? {a} : {b}"
        if node.op in C_FUNCTIONS and is_real(node.dtype):
            return f"{C_FUNCTIONS[node.op]}{suffix}({', '.join(args)})"
        if node.op == "is_finite":
            return f"isfinite({args[0]}) != 0"
        if node.op == "neg":
            return f"-{args[0]}"
        if node.op == "not":
            return f"!{args[0]}" if node.dtype.kind == "b" else f"~{args[0]}"
        if node.op == "rem":
            return f"{args[0]} % {args[1]}"
        if node.op in ("select", "gate"):
            which, no, yes = args
            return f"{which} ? {yes} : {no}"
        if node.op == "any":
            return args[0]
        if node.op == "convert":
            return f"({self.type(node)}){args[0]}"
        if node.op == "table":
            return f"{self.name(node)}_table[{args[0]}]"
        raise Unsupported(node.op, "there is none")


def is_name(name: str) -> bool:
    """Return whether C has such a name for a function."""
    return bool(re.fullmatch(r"[A-Za-z]\w*", name, re.ASCII)) and name not in C_KEYWORDS


def identifier(path: str) -> str:
    """Return a path as a name of C; empty where nothing of it can be in one."""
    name = re.sub(r"\W+", "_", path, flags=re.ASCII).strip("_")
    name = f"x{name}" if name[:1].isdigit() else name
    return f"{name}_" if name in C_KEYWORDS else name


def identifiers(paths: Iterable[str]) -> dict[str, str]:
    """Return paths as names of C, each another."""
    taken: set[str] = set()
    return {path: fresh_name(identifier(path) or "x", taken) for path in paths}


def fresh_name(name: str, taken: set[str]) -> str:
    """Return a name that is not taken, with a number where it must be; it is taken then."""
    number, new = 2, name
    while new in taken:
        number, new = number + 1, f"{name}_{number}"
    taken.add(new)
    return new


def comment_text(text: str) -> str:
    """Return a text as it may stand in a comment of any language: on one line, of an alphabet in which no comment ends,
    begins or goes on."""
    return re.sub(r"[^A-Za-z0-9 .,:;=+_/()\[\]<>'^%&|-]", "_", " ".join(text.split()))
