"""A launch in reverse mode as C++ text: a block of lanes runs to its end, and its log is read backwards.

The text has the functions of both programs, each in a namespace. A row of the log has what the transposed replay of one
step reads: numbers of the carry before the step and after it, and which lanes have a replay.
"""

from collections.abc import Iterator

import numpy as np

from diffabs.compiler.autodiff.transpose import Sweeps, read_carry
from diffabs.compiler.emit.cpp import LaunchShape, Text
from diffabs.compiler.emit.cpp_words import vector_type
from diffabs.compiler.ir import Node, UpdateLevel
from diffabs.compiler.program import InputPlace, ScalarProgram

MAX_LOG_BYTES = 1 << 30  # of a thread; the runs of a block whose log is longer have the derivative NaN


def emit_sweeps(sweeps: Sweeps, shape: LaunchShape) -> str:
    """Return the C++ text of a launch in reverse mode, complete with the loops over lanes and the entry for XLA."""
    return "\n".join(_parts(sweeps, shape)) + "\n"


def _parts(sweeps: Sweeps, shape: LaunchShape) -> Iterator[str]:
    """Yield the parts of the text in their order."""
    ahead, values = Text(sweeps.ahead, shape), len(sweeps.ahead.sizes[UpdateLevel.STEP])
    back = _BackText(sweeps.back, shape, values)
    single = "#define SINGLE\n" if sweeps.ahead.dtype == np.float32 else ""
    yield f"{single}{ahead.HEAD}\nenum {{ VECTORS = {shape.vectors}, SLOTS = VECTORS*LANES }};"
    sizes = sweeps.back.sizes
    yield f"enum {{ UNIFORM = {len(sizes[UpdateLevel.UNIFORM])}, OF_LANES = {len(sizes[UpdateLevel.LANE])} }};"
    moved = len(sizes[UpdateLevel.STEP]) - values
    yield f"enum {{ CARRIED = {values}, RESULTS = {moved}, FIRST = UNIFORM + OF_LANES + CARRIED }};"
    yield back.widths(values)
    yield "namespace ahead {"
    yield from ahead.functions(("renew", "step"))
    yield from ahead.running_function()
    yield "}\nnamespace back {"
    yield from back.functions(("step",))
    yield "}"
    yield from _log(sweeps, read_carry(sweeps.back, values))
    yield f"enum {{ STEPS = {shape.steps}, ROUNDS = {shape.rounds} }};\nenum : i64 {{ LOG_BYTES = {MAX_LOG_BYTES} }};"
    yield '#include "sweeps.h"'


class _BackText(Text):
    """A writer of a transposed replay: cotangents and sums come from arrays and return to them, the rest is logged."""

    def __init__(self, program: ScalarProgram, shape: LaunchShape, values: int):
        self.values = values
        super().__init__(program, shape)
        self.read: set[int] = {node.id for _, node in read_carry(program, values)}

    def _given_inputs(self, level: UpdateLevel) -> list[tuple[InputPlace, Node]]:
        inputs = super()._given_inputs(level)
        return [(p, n) for p, n in inputs if level != UpdateLevel.STEP or p.array >= self.values or n.id in self.read]

    def _array_inputs(self, level: UpdateLevel) -> list[tuple[InputPlace, Node]]:
        return [(p, n) for p, n in self._given_inputs(level) if level != UpdateLevel.STEP or p.array >= self.values]


def _log(sweeps: Sweeps, read: list[tuple[InputPlace, Node]]) -> Iterator[str]:
    """Yield the struct `Row` and the functions that write a row, before and after a step, and that read it."""
    inputs = {(p.array, p.entry): n for p, n in sweeps.ahead.inputs.items() if p.level == UpdateLevel.STEP}
    numbers = [(p, n) for p, n in read if p.array != sweeps.flag]
    fields = [f"{vector_type(n.dtype)} f{n.id}[VECTORS];" for _, n in numbers]
    yield f"struct Row {{ mask on[VECTORS]; {' '.join(fields)} }};"
    notes = [(p, f"row.f{n.id}[q] = a.c{inputs[p.array, p.entry].id}[q];") for p, n in numbers]
    before = [text for p, text in notes if p.array in sweeps.changed]
    after = [text for p, text in notes if p.array not in sweeps.changed]
    after.append(f"row.on[q] = a.c{inputs[sweeps.flag, 0].id}[q];")
    recalled = [f"b.c{n.id}[q] = row.{'on' if p.array == sweeps.flag else f'f{n.id}'}[q];" for p, n in read]
    yield from _for_vectors("note_start(const ahead::Block& a, Row& row)", before)
    yield from _for_vectors("note_end(const ahead::Block& a, Row& row)", after)
    yield from _for_vectors("recall(back::Block& b, const Row& row)", recalled)


def _for_vectors(head: str, lines: list[str]) -> Iterator[str]:
    """Yield a function whose lines are executed for each vector q."""
    yield f"PART void {head} {{\n  for (int q = 0; q < VECTORS; q++) {{"
    yield from (f"    {line}" for line in lines)
    yield "  }\n}"
