"""A device as one file of C99: a struct of memory, a function for the start, one for a sample; no allocation.

The text is made from the jaxprs of what the loop itself does, by the rules of package `kernel`, so no part needs a rule
for C. A primitive that has none is an objection that names it."""

import keyword
import re
from collections.abc import Iterator, Sequence
from typing import Any

import jax
import numpy as np

from diffabs.export.device import Device, NotExported
from diffabs.kernel.graph import Array, Graph, Level, Node, real
from diffabs.kernel.primitives import Unsupported, known, translate
from diffabs.kernel.program import RULES, live

assert RULES  # registered where they are imported

TYPES = {"int64": "int64_t", "uint64": "uint64_t", "int32": "int32_t", "uint32": "uint32_t", "bool": "bool"}
INFIX = {
    **{"add": "+", "sub": "-", "mul": "*", "div": "/", "quotient": "/", "and": "&", "or": "|", "xor": "^"},
    **{"lt": "<", "le": "<=", "eq": "==", "ne": "!=", "shift_left": "<<", "shift_right_logical": ">>"},
}
CHOSEN = {"lower": "<", "higher": ">"}
EXTREMES = {"min": "<", "max": ">"}
FUNCTIONS = {
    **{name: name for name in ("exp", "log", "log1p", "expm1", "sin", "cos", "tan", "tanh", "atan", "asin", "acos")},
    **{name: name for name in ("sinh", "cosh", "atan2", "pow", "sqrt", "rint", "floor", "ceil")},
    **{"abs": "fabs", "rem": "fmod"},
}
RESERVED = {
    *(
        "auto",
        "break",
        "case",
        "char",
        "const",
        "continue",
        "default",
        "do",
        "double",
        "else",
        "enum",
        "extern",
        "float",
    ),
    *("for", "goto", "if", "inline", "int", "long", "register", "restrict", "return", "short", "signed", "sizeof"),
    *(
        "static",
        "struct",
        "switch",
        "typedef",
        "union",
        "unsigned",
        "void",
        "volatile",
        "while",
        "bool",
        "true",
        "false",
    ),
}


def c_source(found: Device, name: str, notes: Sequence[str] = ()) -> str:
    """Return a device as C99: `NAME_state`, `NAME_input`, `NAME_start`, `NAME_step`, and a main for tests under
    `#ifdef NAME_MAIN` that reads a line of inputs for each sample and writes the command.

    name: an identifier; notes: lines of the comment at its head
    Raises:
        NotExported: an operation that has no translation.
    """
    if not re.fullmatch(r"[A-Za-z]\w*", name) or keyword.iskeyword(name) or name in RESERVED:
        raise NotExported(f"{name!r} is no name that C has for a function: letters, digits and _")
    with jax.enable_x64(True):
        try:
            return "\n".join(_Text(found, name, notes).parts()) + "\n"
        except Unsupported as error:
            raise NotExported(f"{error.primitive} has no translation to C: {error.reason}") from None


class _Text:
    def __init__(self, found: Device, name: str, notes: Sequence[str]):
        self.device, self.name, self.notes = found, name, notes
        self.real = f"{name}_real"
        graph = Graph()
        self.inputs = _named(found.input, graph, "in", self._flat_input)
        self.state = _named(found.state, graph, "s", _flat_state)
        given = _filled(found.input, self.inputs)
        self.started = _outputs(graph, found.start, found.input, given)
        held, both = _filled(found.state, self.state), (found.state, found.input)
        *after, self.command = _outputs(graph, lambda both: found.step(*both), both, [*held, *given])
        self.place = graph.input(np.int64, Level.UNIFORM, ("", "i"))
        moved: list[Node] = []
        if found.moves:
            place, count = np.full((), self.place, object), jax.ShapeDtypeStruct((), np.int64)
            moved = _outputs(graph, lambda both: found.move(*both), (found.state, count), [*held, place])
        self.moving = dict(zip([*self.state][len(after) :], moved, strict=bool(moved)))
        self.after = dict(zip(self.state, after, strict=False)) | self.moving
        self._keep()

    @staticmethod
    def _flat_input(path: str) -> str:
        return path.removeprefix("measured.")

    def _keep(self) -> None:
        """What of memory and inputs the command depends on, from one sample to the next."""
        kept: set[str] = set()
        roots = [self.command]
        while True:
            needed = {node.id for node in live(roots)}
            more = {name for name, node in self.state.items() if node.id in needed} - kept
            if not more:
                break
            kept |= more
            roots = [self.command, *(self.after[name] for name in kept if name in self.after)]
        self.kept = [name for name in self.state if name in kept]
        self.begun = dict(zip(self.state, self.started, strict=True))
        starts = [self.begun[name] for name in self.kept]
        seen = {node.id for node in live([*roots, *starts])}
        self.read = [name for name, node in self.inputs.items() if node.id in seen]

    def parts(self) -> Iterator[str]:
        """The lines of the text."""
        yield from self._head()
        yield f"typedef {'float' if self.device.dtype == np.float32 else 'double'} {self.real};\n"
        yield "/* What is measured at a sample. */\ntypedef struct {"
        for name in self.read:
            yield f"  {self.real} {_identifier(name)}; /* [{self.device.units.get(name, '1')}] */"
        yield ("" if self.read else "  char none;\n") + f"}} {self.name}_input;\n"
        yield "/* What is remembered from one sample to the next. */\ntypedef struct {"
        for name in self.kept:
            yield f"  {self._type(self.state[name])} {_identifier(name)};"
        yield ("" if self.kept else "  char none;\n") + f"}} {self.name}_state;\n"
        yield f"void {self.name}_start({self.name}_state *s, const {self.name}_input *in);"
        yield f"{self.real} {self.name}_step({self.name}_state *s, const {self.name}_input *in);\n"
        yield "/* Before the first sample, with what is measured then. */"
        yield f"void {self.name}_start({self.name}_state *s, const {self.name}_input *in)\n{{"
        yield from self._body({name: self.begun[name] for name in self.kept}, ())
        yield "}\n"
        yield f"/* At each sample: the command [{self.device.control_unit}]. */"
        yield f"{self.real} {self.name}_step({self.name}_state *s, const {self.name}_input *in)\n{{"
        stored = {name: self.after[name] for name in self.kept if name in self.after and name not in self.moving}
        yield from self._body(stored, [self.command])
        yield f"  return {self._now(self.command, {self.state[name].id: name for name in self.kept})};\n}}\n"
        yield from self._main()

    def _head(self) -> Iterator[str]:
        delay = f", output it {self.device.delay:g} s after that" if self.device.delay else ""
        yield f"/* {self.name}: the controller, to be called every {self.device.period:g} s{delay}."
        for note in self.notes:
            yield f"   {note.replace('*/', '* /')}"
        yield (
            f"   Call {self.name}_start once with the first measurements, then {self.name}_step at every sample,\n"
            "   the first among them. Nothing is allocated and nothing is global; two states are two controllers. */"
        )
        yield "#include <math.h>\n#include <stdbool.h>\n#include <stdint.h>\n"

    def _body(self, stored: dict[str, Node], more: Sequence[Node]) -> Iterator[str]:
        """The operations that these need, and the memory's new values."""
        nodes = live([*stored.values(), *more])
        moving = {name: node for name, node in self.moving.items() if name in self.kept} if more else {}
        used = {node.id for node in nodes} | {node.id for node in live(list(moving.values()))}
        for struct, wanted, names in (("s", self.kept, self.state), ("in", self.read, self.inputs)):
            if not any(names[name].id in used for name in wanted) and not (struct == "s" and stored):
                yield f"  (void){struct};"
        yield from self._operations(nodes, "  ")
        # What is stored, or returned, may be what was read before.
        read = {self.state[name].id: name for name in self.kept}
        late = {node.id: node for node in [*stored.values(), *more] if node.id in read}
        for node in late.values():
            yield f"  const {self._type(node)} old_{_identifier(read[node.id])} = s->{_identifier(read[node.id])};"
        if moving:
            yield from self._moves(moving)
        for name, node in stored.items():
            if node is not self.state[name]:
                yield f"  s->{_identifier(name)} = {self._now(node, read)};"

    def _moves(self, moving: dict[str, Node]) -> Iterator[str]:
        """What moves by itself until the next sample, by as many steps as the simulation takes."""
        yield f"  for (int i = 0; i < {self.device.moves}; i++) {{"
        yield from self._operations(live(list(moving.values())), "    ")
        for name, node in moving.items():
            if node is not self.state[name]:
                yield f"    s->{_identifier(name)} = {self._name(node)};"
        yield "  }"

    def _operations(self, nodes: Sequence[Node], indent: str) -> Iterator[str]:
        for node in nodes:
            if node.op in ("const", "input"):
                continue
            if node.op == "table":
                rows = ", ".join(self._name(x) for x in node.args[1:])
                yield f"{indent}const {self._type(node)} t{node.id}[] = {{{rows}}};"
            yield f"{indent}const {self._type(node)} v{node.id} = {self._expression(node)};"

    def _now(self, node: Node, read: dict[int, str]) -> str:
        return f"old_{_identifier(read[node.id])}" if node.id in read else self._name(node)

    def _type(self, node: Node) -> str:
        return self.real if real(node.dtype) else TYPES[node.dtype.name]

    def _name(self, node: Node) -> str:
        if node.op == "const":
            return self._literal(node)
        if node.op != "input":
            return f"v{node.id}"
        struct, name = node.attr
        return f"{struct}->{_identifier(name)}" if struct else name

    def _literal(self, node: Node) -> str:
        x = node.attr
        if node.dtype.kind == "b":
            return "true" if x else "false"
        if not real(node.dtype):
            return f"(({TYPES[node.dtype.name]}){int(x)})"
        if np.isnan(x):
            return "NAN"
        if np.isinf(x):
            return "(-INFINITY)" if x < 0 else "INFINITY"
        short = 1e-4 <= abs(x) < 1e7 or x == 0
        text = np.format_float_positional(x, trim="0") if short else np.format_float_scientific(x, trim="0")
        text += "f" if self.device.dtype == np.float32 else ""
        return f"({text})" if np.signbit(x) else text

    def _expression(self, node: Node) -> str:
        args = [self._name(x) for x in node.args]
        suffix = "f" if self.device.dtype == np.float32 else ""
        if node.op in INFIX:
            return f"{args[0]} {INFIX[node.op]} {args[1]}"
        if node.op in CHOSEN:
            return f"{args[0]} {CHOSEN[node.op]} {args[1]} ? {args[0]} : {args[1]}"
        if node.op in EXTREMES:  # NaN where either is
            a, b = args
            return f"{a} != {a} || {a} {EXTREMES[node.op]} {b} ? {a} : {b}"
        if node.op in FUNCTIONS and real(node.dtype):
            return f"{FUNCTIONS[node.op]}{suffix}({', '.join(args)})"
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
            return f"({self._type(node)}){args[0]}"
        if node.op == "table":
            return f"t{node.id}[{args[0]}]"
        raise Unsupported(node.op, "there is none")

    def _main(self) -> Iterator[str]:
        scan = "%f" if self.device.dtype == np.float32 else "%lf"
        count = len(self.read)
        yield f"#ifdef {self.name.upper()}_MAIN"
        yield "/* For tests: a line of inputs, in the order of the struct, for each sample; writes the commands. */"
        yield "#include <stdio.h>\n\nint main(void)\n{"
        yield f"  {self.name}_state s;\n  {self.name}_input in;\n  bool first = true;"
        if count:
            targets = ", ".join(f"&in.{_identifier(name)}" for name in self.read)
            yield f'  while (scanf("{" ".join([scan] * count)}", {targets}) == {count}) {{'
        else:
            yield "  in.none = 0;\n  while (getchar() == '\\n') {"
        yield f"    if (first)\n      {self.name}_start(&s, &in);"
        yield "    first = false;"
        yield f'    printf("%.17g\\n", (double){self.name}_step(&s, &in));\n  }}'
        yield "  return 0;\n}\n#endif"


def _named(shape: Any, graph: Graph, struct: str, flat: Any) -> dict[str, Node]:
    """A number for each entry of a pytree of shapes, by its path."""
    found: dict[str, Node] = {}
    for path, leaf in jax.tree_util.tree_leaves_with_path(shape):
        words = [str(getattr(key, "name", getattr(key, "key", getattr(key, "idx", key)))) for key in path]
        for at in np.ndindex(leaf.shape):
            name = flat(".".join([*words, *map(str, at)]))
            found[name] = graph.input(leaf.dtype, Level.UNIFORM, (struct, name))
    return found


def _flat_state(path: str) -> str:
    """A path in the memory without what says nothing to a reader of C."""
    return re.sub(r"\.(flow|held)(?=\.|$)", "", path)


def _filled(shape: Any, nodes: dict[str, Node]) -> list[Array]:
    """The numbers as arrays of the shapes of a pytree's leaves."""
    left, arrays = iter(nodes.values()), []
    for leaf in jax.tree.leaves(shape):
        out = np.empty(leaf.shape, object)
        for at in np.ndindex(leaf.shape):
            out[at] = next(left)
        arrays.append(out)
    return arrays


def _outputs(graph: Graph, function: Any, shape: Any, inputs: list[Array]) -> list[Node]:
    """What a function returns, number by number; what it closes over is known."""
    closed = jax.make_jaxpr(function)(shape)
    constants = [known(graph, np.asarray(x)) for x in closed.consts]
    return [node for array in translate(graph, closed.jaxpr, constants, inputs) for node in array.flat]


def _identifier(path: str) -> str:
    name = re.sub(r"\W", "_", path)
    return f"{name}_" if name in RESERVED else name
