"""A controller as one file of C99: structs of memory and parameters, a start function and a step function."""

import re
from collections.abc import Iterator, Sequence

import jax
import numpy as np

from diffabs.compiler.emit.c99_words import Words, comment_text, identifiers, is_name
from diffabs.compiler.ir import Node, live_nodes
from diffabs.compiler.lower.rules import Unsupported
from diffabs.output.export.device import ComputerProgram, NotExported
from diffabs.output.export.lowered import INPUTS, MEMORY, NUMBERS, Lowered


def make_identifier(text: str) -> str:
    """Return a text, such as a file's name, as an identifier that code can have: ASCII letters, digits and lines.

    Args:
        text: Any text. One that does not begin with a letter gets the prefix `controller_`.
    """
    name = re.sub(r"[\W_]+", "_", text, flags=re.ASCII).strip("_")
    return name if name[:1].isalpha() else f"controller_{name}".rstrip("_")


def c_source(device: ComputerProgram, name: str, notes: Sequence[str] = ()) -> str:
    """Return the text of a C99 file that runs a controller.

    The file has the number type `NAME_real`, the structs `NAME_state`, `NAME_input` and `NAME_parameters` with
    `NAME_defaults`, and the functions `NAME_start` and `NAME_step`. `NAME_step` returns the command, or with several
    controls the struct `NAME_command`. The structs hold only the inputs, parameters and memory that a command depends
    on. Under `#ifdef NAME_MAIN`, with the name in capitals, it has a main function for tests. That function reads a
    line of inputs for each sample from standard input and writes a line with the commands.

    Args:
        device: The computer's part of a loop.
        name: Prefix of the names in C, an identifier.
        notes: Lines for the comment at the head of the file.

    Raises:
        NotExported: The name is no identifier, or an operation has no translation.
    """
    if not is_name(name):
        raise NotExported(f"{name!r} is no name that C has for a function: letters, digits and _")
    # Integers of 64 bits are in the traced program, even if the reals are of single precision.
    with jax.enable_x64(True):
        try:
            return "\n".join(_Text(device, name, notes).parts()) + "\n"
        except Unsupported as error:
            raise NotExported(f"{error.primitive} has no translation to C: {error.reason}") from None


class _Text:
    """A writer of the file."""

    def __init__(self, device: ComputerProgram, name: str, notes: Sequence[str]):
        self.device, self.name, self.notes = device, name, notes
        self.real = f"{name}_real"
        self.program = program = Lowered(device)
        self.fields = {
            where: identifiers(paths)
            for where, paths in ((INPUTS, program.read), (MEMORY, [*program.memory, "held"]), (NUMBERS, program.used))
        }
        # Members of the struct of commands; a single command has no struct.
        several = identifiers(path.removeprefix("command.") for path in device.commands if path != "command")
        self.members = list(several.values())
        self.returned = f"{name}_command" if several else self.real
        self.words = Words(self.real, self._place, single=device.dtype == np.float32)

    def _place(self, where: str, path: str) -> str:
        """Return the C expression of an input, memory entry or parameter; the loop counter has no struct."""
        return f"{where}->{self.fields[where][path]}" if where else path

    def parts(self) -> Iterator[str]:
        """Yield the blocks of the text."""
        yield from self._head()
        yield f"typedef {'float' if self.device.dtype == np.float32 else 'double'} {self.real};\n"
        yield from self._structs()
        arguments = f"{self.name}_state *s, const {self.name}_parameters *p, const {self.name}_input *in"
        start, step = f"void {self.name}_start({arguments})", f"{self.returned} {self.name}_step({arguments})"
        yield f"{start};\n{step};\n"
        yield from self._defaults()
        yield f"/* Before the first sample, with what is measured then. */\n{start}\n{{"
        yield from self._body(self.program.begun, ())
        yield "  s->held = false;\n}\n"
        units = ", ".join(self.device.commands.values())
        yield f"/* At each sample: the command{'s' * bool(self.members)} [{comment_text(units)}]. */\n{step}\n{{"
        yield from self._body(self.program.stored, [self.program.held])
        held = ", ".join(f"s->{self.fields[MEMORY][path]}" for path in self.device.commands)
        yield f"  return {f'({self.returned}){{{held}}}' if self.members else held};\n}}\n"
        yield from self._main()

    def _head(self) -> Iterator[str]:
        """Yield the comment at the head, the includes and the check of compiler flags."""
        delay = f", output it {float(self.device.delay)!r} s after that" if self.device.delay else ""
        yield f"/* {self.name}: the controller, to be called every {float(self.device.period)!r} s{delay}."
        for line in [*self.notes, *map(str, self.device.numbers)]:
            yield f"   {comment_text(line)}"
        yield (
            f"   Call {self.name}_start once with the first measurements, then {self.name}_step at every sample,\n"
            f"   the first among them, both with parameters: {self.name}_defaults, or a changed copy.\n"
            "   A sample with a NaN, or that leads to one, is not used: the controller's memory and the command stay,\n"
            "   and held is true. Time and a moving target go on. Parameters are not checked: keep each in its range.\n"
            "   Nothing is allocated and nothing changes that is global; two states are two controllers. */"
        )
        yield "#include <math.h>\n#include <stdbool.h>\n#include <stdint.h>\n"
        # With -ffast-math a compiler may assume that no NaN exists and remove the check for lost samples.
        yield "#if defined(__FAST_MATH__) || (defined(__FINITE_MATH_ONLY__) && __FINITE_MATH_ONLY__ > 0)"
        yield "#error compile without -ffast-math and -ffinite-math-only: a NaN must be seen\n#endif\n"

    def _structs(self) -> Iterator[str]:
        """Yield the structs of inputs, parameters and memory."""
        program, real = self.program, self.real
        specs = {name: spec for number in self.device.numbers for name, spec in number.name_entries()}
        inputs, numbers, memory = (self.fields[where] for where in (INPUTS, NUMBERS, MEMORY))
        read = [f"{real} {inputs[x]}; /* [{comment_text(self.device.units.get(x, '1'))}] */" for x in program.read]
        yield from self._struct("What is measured at a sample.", "input", read)
        used = [f"{real} {numbers[x]}; /* {comment_text(specs[x])} */" for x in program.used]
        yield from self._struct("What can be changed, also between two samples.", "parameters", used)
        declarations = [f"{self.words.type(program.state[x])} {memory[x]};" for x in program.memory]
        held = f"bool {memory['held']}; /* whether the last sample could not be used */"
        if self.members:
            units = self.device.commands.values()
            rows = [f"{real} {x}; /* [{comment_text(unit)}] */" for x, unit in zip(self.members, units, strict=True)]
            yield from self._struct("What the controller commands.", "command", rows)
        yield from self._struct("What is remembered from one sample to the next.", "state", [*declarations, held])

    def _struct(self, about: str, name: str, members: Sequence[str]) -> Iterator[str]:
        """Yield a struct with a comment; an empty one gets a placeholder, because C99 has no empty structs."""
        yield f"/* {about} */\ntypedef struct {{"
        yield from (f"  {member}" for member in members or ["char none;"])
        yield f"}} {self.name}_{name};\n"

    def _defaults(self) -> Iterator[str]:
        """Yield the parameter values of the scenario."""
        names, values = self.fields[NUMBERS], self.program.values
        rows = [f".{names[x]} = {self.words.literal(self.device.dtype.type(values[x]))}" for x in self.program.used]
        yield f"const {self.name}_parameters {self.name}_defaults = {{"
        yield from (f"  {row}," for row in rows or [".none = 0"])
        yield "};\n"

    def _body(self, stored: dict[str, Node], more: Sequence[Node]) -> Iterator[str]:
        """Yield the statements that compute `stored` and `more` and store them in the memory."""
        nodes = live_nodes([*stored.values(), *more])
        moving = self.program.moving if more else {}
        used = {node.id for node in nodes} | {node.id for node in live_nodes(list(moving.values()))}
        for struct, names in ((INPUTS, self.program.inputs), (NUMBERS, self.program.numbers)):
            # A cast to void avoids a warning for an unused argument.
            if not any(node.id in used for node in names.values()):
                yield f"  (void){struct};"
        # All operations come before the first store, because they read the memory's old values.
        yield from self.words.operations(nodes, "  ")
        if moving:
            yield from self._moves(moving)
        for name, node in [*stored.items(), *(("held", node) for node in more)]:
            if node is not self.program.state.get(name):
                yield f"  s->{self.fields[MEMORY][name]} = {self.words.name(node)};"

    def _moves(self, moving: dict[str, Node]) -> Iterator[str]:
        """Yield the loop that advances the reference to the next sample in the simulation's Runge-Kutta steps."""
        yield f"  for (int i = 0; i < {self.device.moves}; i++) {{"
        yield from self.words.operations(live_nodes(list(moving.values())), "    ")
        for name, node in moving.items():
            if node is not self.program.state[name]:
                yield f"    s->{self.fields[MEMORY][name]} = {self.words.name(node)};"
        yield "  }"

    def _main(self) -> Iterator[str]:
        """Yield a main function for tests."""
        scan = "%f" if self.device.dtype == np.float32 else "%lf"
        count = len(self.program.read)
        yield f"#ifdef {self.name.upper()}_MAIN"
        yield "/* For tests: a line of inputs, in the order of the struct, for each sample; writes the commands. */"
        yield "#include <stdio.h>\n\nint main(void)\n{"
        yield f"  {self.name}_state s;\n  {self.name}_input in;\n  bool first = true;"
        if count:
            targets = ", ".join(f"&in.{self.fields[INPUTS][name]}" for name in self.program.read)
            yield f'  while (scanf("{" ".join([scan] * count)}", {targets}) == {count}) {{'
        else:
            yield "  in.none = 0;\n  while (getchar() == '\\n') {"
        yield f"    if (first)\n      {self.name}_start(&s, &{self.name}_defaults, &in);"
        yield "    first = false;"
        # Seventeen digits identify a double.
        step, printed = (
            f"{self.name}_step(&s, &{self.name}_defaults, &in)",
            " ".join(["%.17g"] * max(len(self.members), 1)),
        )
        if self.members:
            yield f"    const {self.returned} u = {step};"
        values = ", ".join(f"(double)u.{member}" for member in self.members) or f"(double){step}"
        yield f'    printf("{printed}\\n", {values});\n  }}'
        yield "  return 0;\n}\n#endif"
