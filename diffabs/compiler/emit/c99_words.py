"""C99 for operations on single numbers, shared by the exports of controllers and plants.

An operation without a translation raises Unsupported with its name.
"""

import re
from collections.abc import Callable, Iterable, Iterator, Sequence

import numpy as np

from diffabs.compiler.ir import Node, is_real
from diffabs.compiler.lower.rules import Unsupported
from diffabs.compiler.operations import OPERATIONS

C_TYPES = {"int64": "int64_t", "uint64": "uint64_t", "int32": "int32_t", "uint32": "uint32_t", "bool": "bool"}
FUNCTION = re.compile(r"(\w+)\{f\}")  # a function of the C library, in a template
C_KEYWORDS_TEXT = (
    "auto break case char const continue default do double else enum extern float for goto if inline int long "
    "register restrict return short signed sizeof static struct switch typedef union unsigned void volatile while "
    "bool true false "
    "asm typeof linux unix "  # of compilers without -std=c99
    "alignas alignof constexpr nullptr static_assert thread_local typeof_unqual"  # of C23
)
C_KEYWORDS = set(C_KEYWORDS_TEXT.split())
# Macros of the headers that the texts include, which replace also a struct's field: NAN, EOF, INT64_MAX.
C_MACRO = re.compile(r"[A-Z][A-Z0-9_]{2,}|L_tmpnam|math_errhandling|std(in|out|err)")
C_FUNCTIONS = {name for row in OPERATIONS.values() for name in FUNCTION.findall(row.c99 or "")}
RESERVED_NAMES: set[str] = {*C_FUNCTIONS, "s", "p", "in", "i", "m", "t", "h"}  # names that a variable must not hide


class Words:
    """A writer of C99 for the nodes of a graph.

    Attributes:
        real: C type of the real numbers.
        place: Function (where, path), the two parts of an input's `attr`, -> C expression of the input.
        single: Whether real numbers have single precision.
    """

    def __init__(self, real: str, place: Callable[[str, str], str], single: bool = False):
        """Create a writer without variables; `place` maps (where, path) to the C expression of an input."""
        self.real = real
        self.place = place
        self.single = single
        self._names: dict[int, str] = {}
        self._used_names = {*RESERVED_NAMES, real}

    def operations(self, nodes: Sequence[Node], indent: str) -> Iterator[str]:
        """Yield a C declaration for each node, operands first; constants and inputs need none."""
        for node in nodes:
            if node.op in ("const", "input"):
                continue
            if node.op == "table":
                rows = ", ".join(self.name(x) for x in node.args[1:])
                yield f"{indent}const {self.type(node)} {self.name(node)}_table[] = {{{rows}}};"
            yield f"{indent}const {self.type(node)} {self.name(node)} = {self._expression(node)};"

    def type(self, node: Node) -> str:
        """Return the C type of a number."""
        return self.real if is_real(node.dtype) else C_TYPES[node.dtype.name]

    def name(self, node: Node) -> str:
        """Return the C expression of a node: a literal, a variable, or the place of an input.

        A variable has the label of its node, or the name of its operation, with a number if that name is in use.
        """
        if node.op == "const":
            return self._literal(node)
        if node.op == "input":
            return self.place(*node.attr)
        if node.id not in self._names:
            self._names[node.id] = fresh_name(identifier(node.label) or node.op, self._used_names)
        return self._names[node.id]

    def _literal(self, node: Node) -> str:
        x = node.attr
        if node.dtype.kind == "b":
            return "true" if x else "false"
        return self.literal(x) if is_real(node.dtype) else f"(({C_TYPES[node.dtype.name]}){int(x)})"

    def literal(self, x: float) -> str:
        """Return the C literal of the real number `x` (a NumPy scalar): the shortest decimal that reads back as `x`."""
        if np.isnan(x):
            return "NAN"
        if np.isinf(x):
            return "(-INFINITY)" if x < 0 else "INFINITY"
        short = 1e-4 <= abs(x) < 1e7 or x == 0
        text = np.format_float_positional(x, trim="0") if short else np.format_float_scientific(x, trim="0")
        text += "f" if self.single else ""
        # Parentheses, so that a - (-1.0) does not become a--1.0. signbit, so that -0.0 keeps its sign.
        return f"({text})" if np.signbit(x) else text

    def _expression(self, node: Node) -> str:
        args, real = [self.name(x) for x in node.args], is_real(node.dtype)
        template = OPERATIONS[node.op].c99 if node.op in OPERATIONS else None
        match node.op:
            # isnan returns an int: any nonzero value means NaN.
            case "ne" if node.args[0] is node.args[1]:
                return f"isnan({args[0]}) != 0"
            case "not" if node.dtype.kind == "b":
                return f"!{args[0]}"
            case "rem" if not real:
                return f"{args[0]} % {args[1]}"
            case "select" | "gate":
                return f"{args[0]} ? {args[2]} : {args[1]}"
            case "any":
                return args[0]
            case "convert":
                return f"({self.type(node)}){args[0]}"
            case "table":
                return f"{self.name(node)}_table[{args[0]}]"
        if template is None or ("{f}" in template and not real):
            raise Unsupported(node.op, "there is none")
        return template.format(*args, f="f" if self.single else "")


def is_name(name: str) -> bool:
    """Return whether a text can name an exported C function: an ASCII letter, then letters, digits, _; no keyword."""
    return bool(re.fullmatch(r"[A-Za-z]\w*", name, re.ASCII)) and name not in C_KEYWORDS


def identifier(path: str) -> str:
    """Return a path as an identifier of C; empty if the path has no ASCII letter or digit."""
    name = re.sub(r"\W+", "_", path, flags=re.ASCII).strip("_")
    name = f"x{name}" if name[:1].isdigit() else name
    return f"{name}_" if name in C_KEYWORDS or C_MACRO.fullmatch(name) else name


def identifiers(paths: Iterable[str]) -> dict[str, str]:
    """Return a dictionary from each path to an identifier of C; all identifiers differ."""
    used_names: set[str] = set()
    return {path: fresh_name(identifier(path) or "x", used_names) for path in paths}


def fresh_name(name: str, used_names: set[str]) -> str:
    """Return `name`, or `name` with a number such as name_2 if it is in use, and add the result to `used_names`.

    The name of its table, `name_table`, is reserved as well.
    """
    number, new = 2, name
    while used_names & {new, f"{new}_table"}:
        number, new = number + 1, f"{name}_{number}"
    used_names |= {new, f"{new}_table"}
    return new


def comment_text(text: str) -> str:
    """Return a text that is safe in a comment of any language: one line, with `_` for each unsafe character."""
    # The alphabet lacks * and the backslash: no block comment can begin or end, and no line can continue.
    return re.sub(r"[^A-Za-z0-9 .,:;=+_/()\[\]<>'^%&|-]", "_", " ".join(text.split()))
