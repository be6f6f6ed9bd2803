"""A controller as a function block in Structured Text (IEC 61131-3) for a PLC, with the same operations as in C.

Every operation is an assignment to a typed variable. This leaves no order of evaluation and no type mixing to a
compiler. The language has no literals for infinity and NaN: infinite limits become the largest finite number, and a NaN
raises NotExported. Comparisons with NaN are false, as in C, if the PLC follows IEEE 754.
"""

import re
from collections.abc import Iterator, Sequence

import jax
import numpy as np

from diffabs.compiler.emit.c99_words import comment_text
from diffabs.compiler.ir import Node, is_real, live_nodes
from diffabs.compiler.lower.rules import Unsupported
from diffabs.compiler.operations import OPERATIONS
from diffabs.output.export.device import ComputerProgram, NotExported
from diffabs.output.export.lowered import INPUTS, MEMORY, NUMBERS, Lowered

INTEGERS = {"int64": "LINT", "uint64": "ULINT", "int32": "DINT", "uint32": "UDINT"}
LOGICAL = {"and", "or", "xor", "not"}  # in this language for truths only
LINE = 110  # width of a list of variables
ST_KEYWORDS_TEXT = (
    "abs acos action and any array asin at atan atan2 begin bool by byte case configuration constant cos date "
    "dint do dt dword else elsif end exit exp expt extends false final for from function function_block global if "
    "in int interface interval jmp ld len limit lint ln log lreal lt ltime lword max method min mod move mux "
    "namespace not of on or out overlap override pointer priority private program protected public read read_only "
    "read_write real ref ref_to repeat reset resource retain return rol ror shl shr sel sin single sint sqrt st "
    "step string struct super tan task then this time to transition true trunc type udint uint ulint until using "
    "usint var while with word wstring write xor le ge gt eq ne add sub mul div r s n p l d sd ds sl "
    "abstract and_then andn any_bit any_date any_derived any_elementary any_int any_magnitude any_num any_real "
    "any_string cal calc calcn char class concat continue ctd ctu ctud date_and_time delete en eno extends f_edge "
    "f_trig find final implements insert internal jmpc jmpcn ldate ldate_and_time ldn ldt left ltime_of_day ltod "
    "non_retain null or_else orn r_edge r_trig replace retc retcn right round rs sr stn time_of_day tod tof ton tp "
    "var_access var_config var_external var_global var_in_out var_input var_output var_temp wchar xorn"
)
ST_KEYWORDS = set(ST_KEYWORDS_TEXT.split())
OWN = {"command", "held", "reset", "started", "i"}  # names that the block itself uses


def structured_text(device: ComputerProgram, name: str, notes: Sequence[str] = ()) -> str:
    """Return the text of a FUNCTION_BLOCK that runs a controller.

    Its inputs are `reset` and the measurements that the controller reads. Its outputs are `command`, or one such as
    `command_pump_1` for each control, and `held`, which is true if the sample could not be used. The parameters are
    variables of the block. Call the block once a period. It starts at its first call, and again whenever `reset` is
    true.

    Args:
        device: The computer's part of a loop.
        name: Name of the block, an identifier.
        notes: Lines for the comment at the head of the text.

    Raises:
        NotExported: The name is no identifier, an operation has no translation, or a constant is NaN.
    """
    if not re.fullmatch(r"[A-Za-z](_?[A-Za-z0-9])*", name) or _is_reserved(name) or name.lower() in OWN:
        raise NotExported(f"{name!r} is no name that Structured Text has for a block: letters, digits and single _")
    with jax.enable_x64(True):
        try:
            return "\n".join(_Block(device, name, notes).parts()) + "\n"
        except Unsupported as error:
            why = f"{error.primitive} has no translation to Structured Text: {error.reason}"
            raise NotExported(why) from None


class _Block:
    """A writer of the function block."""

    def __init__(self, device: ComputerProgram, name: str, notes: Sequence[str]):
        self.device, self.name, self.notes = device, name, notes
        self.program = program = Lowered(device)
        self.real = "REAL" if device.dtype == np.float32 else "LREAL"
        self.used_names = used_names = OWN - {*device.commands} | {name.lower()}
        self.names = {(MEMORY, path): _fresh(path, used_names) for path in device.commands}
        self.names |= {(INPUTS, path): _fresh(path, used_names) for path in program.read}
        self.names |= {(NUMBERS, path): _fresh(path, used_names) for path in program.used}
        memory = [path for path in program.memory if path not in device.commands]
        self.names |= {(MEMORY, path): _fresh(f"m_{path}", used_names) for path in memory}
        self.temporary: dict[str, str] = {}  # types by name
        self.called: dict[int, str] = {}  # variables by the id of the node

    def parts(self) -> Iterator[str]:
        """Yield the lines of the text."""
        program, units = self.program, self.device.units
        body = list(self._body())  # first, because it creates the temporaries that the head declares
        yield from self._head()
        yield f"FUNCTION_BLOCK {self.name}"
        yield "VAR_INPUT"
        for path in program.read:
            yield f"  {self.names[INPUTS, path]} : {self.real}; (* [{comment_text(units.get(path, '1'))}] *)"
        yield "  reset : BOOL; (* begin anew, with what is measured now *)\nEND_VAR"
        yield "VAR_OUTPUT"
        for path, unit in self.device.commands.items():
            yield f"  {self.names[MEMORY, path]} : {self.real}; (* [{comment_text(unit)}] *)"
        yield "  held : BOOL; (* whether the last sample could not be used *)\nEND_VAR"
        if program.used:
            yield from ["VAR (* parameters *)", *self._parameters(), "END_VAR"]
        yield "VAR"
        for path in program.memory:
            if path not in self.device.commands:
                yield f"  {self.names[MEMORY, path]} : {self._type(program.state[path])};"
        yield "  started : BOOL := FALSE;\nEND_VAR"
        if self.temporary:
            yield from ["VAR_TEMP", *self._declare(), "END_VAR"]
        yield ""
        yield from body
        yield "END_FUNCTION_BLOCK"

    def _parameters(self) -> Iterator[str]:
        specs = {name: spec for number in self.device.numbers for name, spec in number.name_entries()}
        for path in self.program.used:
            value = self._real(self.program.values[path]).strip("()")
            yield f"  {self.names[NUMBERS, path]} : {self.real} := {value}; (* {comment_text(specs[path])} *)"

    def _head(self) -> Iterator[str]:
        delay = f", its command to be output {self.device.delay:g} s after that" if self.device.delay else ""
        lines = [
            f"{self.name}: the controller, to be called every {self.device.period:g} s{delay}.",
            *self.notes,
            *map(str, self.device.numbers),
            "A sample with a NaN, or that leads to one, is not used: the controller's memory and the command stay,",
            "and held is TRUE. Time and a moving target go on.",
            "Nothing is global: two instances are two controllers.",
        ]
        text = "\n   ".join(map(comment_text, lines))
        yield f"(* {text} *)"

    def _declare(self) -> Iterator[str]:
        """Yield declarations of the temporaries, several of a type in a line."""
        for kind in dict.fromkeys(self.temporary.values()):
            line = ""
            for name in (name for name, of in self.temporary.items() if of == kind):
                if len(line) + len(name) > LINE:
                    yield f"  {line} : {kind};"
                    line = ""
                line += f"{', ' if line else ''}{name}"
            yield f"  {line} : {kind};"

    def _body(self) -> Iterator[str]:
        program = self.program
        yield "IF reset OR NOT started THEN"
        yield from self._assign(program.begun, (), "  ")
        yield "  started := TRUE;\nEND_IF;"
        yield from self._assign(program.stored, [program.held], "")

    def _assign(self, stored: dict[str, Node], more: Sequence[Node], indent: str) -> Iterator[str]:
        """Yield the operations that these nodes need, then assignments to the commands and the memory."""
        yield from self._operations(live_nodes([*stored.values(), *more]), indent)
        for node in more:
            yield f"{indent}held := {self._value(node)};"
        if more and self.program.moving:
            yield from self._moves(indent)
        for name, node in stored.items():
            if node is not self.program.state[name]:
                yield f"{indent}{self.names[MEMORY, name]} := {self._value(node)};"

    def _moves(self, indent: str) -> Iterator[str]:
        """Yield the loop that advances the reference to the next sample in the simulation's Runge-Kutta steps."""
        moving = self.program.moving
        self.temporary["i"] = "INT"
        yield f"{indent}FOR i := 0 TO {self.device.moves - 1} DO"
        yield from self._operations(live_nodes(list(moving.values())), indent + "  ")
        for name, node in moving.items():
            if node is not self.program.state[name]:
                yield f"{indent}  {self.names[MEMORY, name]} := {self._value(node)};"
        yield f"{indent}END_FOR;"

    def _operations(self, nodes: Sequence[Node], indent: str) -> Iterator[str]:
        for node in nodes:
            if node.op in ("const", "input"):
                continue
            if node.op == "table":
                table = f"{self._variable(node)}_table"
                self.temporary[table] = f"ARRAY[0..{len(node.args) - 2}] OF {self._type(node)}"
                for k, entry in enumerate(node.args[1:]):
                    yield f"{indent}{table}[{k}] := {self._value(entry)};"
            expression = self._expression(node)
            name = self._variable(node)
            self.temporary[name] = self._type(node)
            yield f"{indent}{name} := {expression};"

    def _variable(self, node: Node) -> str:
        """Return the variable of a number."""
        if node.id not in self.called:
            self.called[node.id] = _fresh(node.label or node.op, self.used_names)
        return self.called[node.id]

    def _type(self, node: Node) -> str:
        if is_real(node.dtype):
            return self.real
        return "BOOL" if node.dtype.kind == "b" else INTEGERS[node.dtype.name]

    def _value(self, node: Node) -> str:
        if node.op == "const":
            return self._literal(node.attr, node)
        if node.op != "input":
            return self._variable(node)
        where, path = node.attr
        return self.names[where, path] if where else "INT_TO_LINT(i)"

    def _literal(self, x: float, node: Node) -> str:
        if node.dtype.kind == "b":
            return "TRUE" if x else "FALSE"
        if not is_real(node.dtype):
            return f"{self._type(node)}#{int(x)}"
        return self._real(x)

    def _real(self, x: float) -> str:
        """Return the literal of a real number; infinity becomes the largest finite number, NaN raises Unsupported."""
        if np.isnan(x):
            raise Unsupported("nan", "there is no such number in it")
        limit = np.finfo(self.device.dtype).max
        x = self.device.dtype.type(min(max(x, -limit), limit))
        short = 1e-4 <= abs(x) < 1e7 or x == 0
        text = np.format_float_positional(x, trim="0") if short else _scientific(x)
        return f"({text})" if np.signbit(x) else text

    def _expression(self, node: Node) -> str:
        args, op = [self._value(x) for x in node.args], node.op
        boolean, real = node.args[0].dtype.kind == "b", is_real(node.dtype)
        match op:
            case "select" | "gate":
                # SEL(G, IN0, IN1) has the operands in the order of `select`: truth, no, yes.
                return f"SEL({', '.join(args)})"
            case "any":
                return args[0]
            case "rem" if not real:
                return f"{args[0]} MOD {args[1]}"
            case "table":
                return f"{self._variable(node)}_table[{args[0]}]"
            case "convert":
                return self._convert(node, args[0])
        template = OPERATIONS[op].st if op in OPERATIONS else None
        if template is None or (op in LOGICAL and not boolean) or (op in ("lt", "le") and boolean):
            raise Unsupported(op, "there is none")
        return template.format(*args, real=self.real, largest=_scientific(np.finfo(self.device.dtype).max))

    def _convert(self, node: Node, arg: str) -> str:
        """Return a number converted to another type; to an integer by truncation, as in C."""
        before, after = self._type(node.args[0]), self._type(node)
        if before == after:
            return arg
        if after == "BOOL":
            return f"{arg} <> {'0.0' if before == self.real else f'{before}#0'}"
        if before == "BOOL":
            false, true = ("0.0", "1.0") if after == self.real else (f"{after}#0", f"{after}#1")
            return f"SEL({arg}, {false}, {true})"
        if before == self.real:
            return f"{before}_TRUNC_{after}({arg})"
        return f"{before}_TO_{after}({arg})"


def _is_reserved(name: str) -> bool:
    """Return whether the language has another meaning for a name: a keyword, the end of one such as END_IF, or
    a standard function or block."""
    return name.lower() in ST_KEYWORDS or name.lower().startswith("end_")


def _scientific(x: float) -> str:
    return np.format_float_scientific(x, trim="0", exp_digits=1).replace("e", "E")


def _fresh(path: str, used_names: set[str]) -> str:
    """Return a new identifier for a path, and add it to `used_names`; case is ignored, `_table` is reserved."""
    name = re.sub(r"[\W_]+", "_", path, flags=re.ASCII).strip("_")
    name = f"x_{name}".strip("_") if _is_reserved(name) or not name[:1].isalpha() else name
    number, fresh = 2, name
    while used_names & (both := {fresh.lower(), f"{fresh}_table".lower()}):
        number, fresh = number + 1, f"{name}_{number}"
    used_names |= both
    return fresh
