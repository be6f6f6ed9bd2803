"""A device as one file of C99: a struct of memory, a function for the start, one for a sample; no allocation."""

import keyword
import re
from collections.abc import Iterator, Sequence

import jax
import numpy as np

from diffabs.export.c_words import RESERVED, Words, identifier
from diffabs.export.device import Device, NotExported
from diffabs.export.lowered import INPUTS, MEMORY, Lowered
from diffabs.kernel.graph import Node
from diffabs.kernel.primitives import Unsupported
from diffabs.kernel.program import live


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
        self.program = Lowered(found)
        self.words = Words(self.real, _place, single=found.dtype == np.float32)

    def parts(self) -> Iterator[str]:
        """The lines of the text."""
        yield from self._head()
        yield f"typedef {'float' if self.device.dtype == np.float32 else 'double'} {self.real};\n"
        yield "/* What is measured at a sample. */\ntypedef struct {"
        for name in self.program.read:
            yield f"  {self.real} {identifier(name)}; /* [{self.device.units.get(name, '1')}] */"
        yield ("" if self.program.read else "  char none;\n") + f"}} {self.name}_input;\n"
        yield "/* What is remembered from one sample to the next. */\ntypedef struct {"
        for name in self.program.kept:
            yield f"  {self.words.type(self.program.state[name])} {identifier(name)};"
        yield ("" if self.program.kept else "  char none;\n") + f"}} {self.name}_state;\n"
        yield f"void {self.name}_start({self.name}_state *s, const {self.name}_input *in);"
        yield f"{self.real} {self.name}_step({self.name}_state *s, const {self.name}_input *in);\n"
        yield "/* Before the first sample, with what is measured then. */"
        yield f"void {self.name}_start({self.name}_state *s, const {self.name}_input *in)\n{{"
        yield from self._body(self.program.begun, ())
        yield "}\n"
        yield f"/* At each sample: the command [{self.device.control_unit}]. */"
        yield f"{self.real} {self.name}_step({self.name}_state *s, const {self.name}_input *in)\n{{"
        yield from self._body(self.program.stored, [self.program.command])
        yield f"  return {self._now(self.program.command)};\n}}\n"
        yield from self._main()

    def _head(self) -> Iterator[str]:
        delay = f", output it {self.device.delay:g} s after that" if self.device.delay else ""
        yield f"/* {self.name}: the controller, to be called every {self.device.period:g} s{delay}."
        for note in self.notes:
            yield f"   {note.replace('*/', '* /')}"
        for number in self.device.numbers:
            yield f"   {number}"
        yield (
            f"   Call {self.name}_start once with the first measurements, then {self.name}_step at every sample,\n"
            "   the first among them. Nothing is allocated and nothing is global; two states are two controllers. */"
        )
        yield "#include <math.h>\n#include <stdbool.h>\n#include <stdint.h>\n"

    def _body(self, stored: dict[str, Node], more: Sequence[Node]) -> Iterator[str]:
        """The operations that these need, and the memory's new values."""
        nodes = live([*stored.values(), *more])
        moving = self.program.moving if more else {}
        used = {node.id for node in nodes} | {node.id for node in live(list(moving.values()))}
        for struct, wanted, names in (
            (MEMORY, self.program.kept, self.program.state),
            (INPUTS, self.program.read, self.program.inputs),
        ):
            if not any(names[name].id in used for name in wanted) and not (struct == MEMORY and stored):
                yield f"  (void){struct};"
        yield from self.words.operations(nodes, "  ")
        # What is stored, or returned, may be what was read before.
        read = self.program.memory
        late = {node.id: node for node in [*stored.values(), *more] if node.id in read}
        for node in late.values():
            yield f"  const {self.words.type(node)} old_{identifier(read[node.id])} = s->{identifier(read[node.id])};"
        if moving:
            yield from self._moves(moving)
        for name, node in stored.items():
            if node is not self.program.state[name]:
                yield f"  s->{identifier(name)} = {self._now(node)};"

    def _moves(self, moving: dict[str, Node]) -> Iterator[str]:
        """What moves by itself until the next sample, by as many steps as the simulation takes."""
        yield f"  for (int i = 0; i < {self.device.moves}; i++) {{"
        yield from self.words.operations(live(list(moving.values())), "    ")
        for name, node in moving.items():
            if node is not self.program.state[name]:
                yield f"    s->{identifier(name)} = {self.words.name(node)};"
        yield "  }"

    def _now(self, node: Node) -> str:
        read = self.program.memory
        return f"old_{identifier(read[node.id])}" if node.id in read else self.words.name(node)

    def _main(self) -> Iterator[str]:
        scan = "%f" if self.device.dtype == np.float32 else "%lf"
        count = len(self.program.read)
        yield f"#ifdef {self.name.upper()}_MAIN"
        yield "/* For tests: a line of inputs, in the order of the struct, for each sample; writes the commands. */"
        yield "#include <stdio.h>\n\nint main(void)\n{"
        yield f"  {self.name}_state s;\n  {self.name}_input in;\n  bool first = true;"
        if count:
            targets = ", ".join(f"&in.{identifier(name)}" for name in self.program.read)
            yield f'  while (scanf("{" ".join([scan] * count)}", {targets}) == {count}) {{'
        else:
            yield "  in.none = 0;\n  while (getchar() == '\\n') {"
        yield f"    if (first)\n      {self.name}_start(&s, &in);"
        yield "    first = false;"
        yield f'    printf("%.17g\\n", (double){self.name}_step(&s, &in));\n  }}'
        yield "  return 0;\n}\n#endif"


def _place(where: str, path: str) -> str:
    return f"{where}->{identifier(path)}" if where else path
