"""A program as C++: a block of a few vectors of lanes, from their start to their end.

Each line stands there once for every vector of the block, one after the other: while one waits for a result there is
something to do for the next. A lane that has ended makes room for the next one, every so many steps."""

import re
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from diffabs.kernel.cpp_words import CPP_FUNCTIONS, CPP_INFIX, PREFIX, is_boolean, literal, scalar_type, vector_type
from diffabs.kernel.graph import Node, UpdateLevel
from diffabs.kernel.program import Branch, InputPlace, ScalarProgram, ScheduleBlock, live_nodes, schedule_nodes

ONE_VECTOR = range(1)
MIN_BRANCH_OPERATIONS = 24  # operations in a branch: fewer are worked out anyway


class LaunchShape(NamedTuple):
    """How a program is run: vectors in a block; steps between two calls of `renew`; of these, rounds between two looks
    for lanes that have ended."""

    vectors: int
    steps: int
    rounds: int


def emit_cpp(program: ScalarProgram, shape: LaunchShape) -> str:
    """Return the C++ of a program with the functions `renew`, `step` (carry to carry) and `running` (to one truth)."""
    return "\n".join(Text(program, shape).parts()) + "\n"


def operands_by_name(node: Node) -> tuple[Node, ...]:
    """Return what an operation reads by name; the entries of a table lie in a column."""
    return node.args[:1] if node.op == "table" else node.args


class Text:
    """The parts of a text, of which another back end has another first and last one, over the same names."""

    HEAD, DRIVER = '#include "functions.h"', '#include "drive.h"'

    def __init__(self, program: ScalarProgram, shape: LaunchShape):
        """What of a program is worked out where."""
        self.program, self.shape = program, shape
        self.roots = [node for nodes in program.results.values() for node in nodes]
        nodes = live_nodes(self.roots)
        self.alive = {node.id for node in nodes}
        self.columns: dict[tuple[int, ...], tuple[str, Node]] = {}
        for node in nodes:
            if node.op == "table":
                key = tuple(x.id for x in node.args[1:])
                self.columns.setdefault(key, (f"t{len(self.columns)}", node))
        lanes = self._read([node for node in nodes if node.level == UpdateLevel.STEP], self.roots, UpdateLevel.LANE)
        self.lanes = [node for node in nodes if node.id in lanes]
        below = [node for node in nodes if node.level >= UpdateLevel.LANE]
        shared = self._read(below, self.roots, UpdateLevel.UNIFORM)
        self.shared = [node for node in nodes if node.id in shared and node.op != "const"]

    @staticmethod
    def _read(readers: list[Node], roots: list[Node], level: UpdateLevel) -> set[int]:
        """The numbers of a level's nodes that are read from elsewhere."""
        read = {
            arg.id for node in readers if node.level > level for arg in operands_by_name(node) if arg.level == level
        }
        return read | {root.id for root in roots if root.level == level}

    def parts(self) -> Iterator[str]:
        """The parts of the text, in their order."""
        single = "#define SINGLE\n" if self.program.dtype == np.float32 else ""
        yield f"{single}{self.HEAD}\nenum {{ VECTORS = {self.shape.vectors}, SLOTS = VECTORS*LANES }};"
        sizes = self.program.sizes
        counts = zip(("UNIFORM", "OF_LANES", "CARRIED"), (len(sizes[level]) for level in sizes), strict=True)
        yield "enum { " + ", ".join(f"{name} = {count}" for name, count in counts) + " };"
        kinds = {place.array: scalar_type(node.dtype) for place, node in self._given(UpdateLevel.STEP)}
        widths = [f"{size}*sizeof({kinds.get(i, 'u8')})" for i, size in enumerate(sizes[UpdateLevel.STEP])]
        yield f"static const i64 WIDTHS[] = {{{', '.join(map(str, widths))}}};"
        yield from self._structures()
        yield from self._prepare()
        yield from self._begin()
        for name in ("renew", "step"):
            yield from self._function(name)
        yield from self._running()
        yield from self._moves()
        yield f"enum {{ STEPS = {self.shape.steps}, ROUNDS = {self.shape.rounds} }};"
        yield self.DRIVER

    def _given(self, level: UpdateLevel) -> list[tuple[InputPlace, Node]]:
        return [
            (p, n)
            for p, n in self.program.inputs.items()
            if p.level == level and (level == UpdateLevel.STEP or n.id in self.alive)
        ]

    def _structures(self) -> Iterator[str]:
        """What all lanes share, and a block of lanes: carry, inputs of the lanes, and what follows from these."""
        shared = [f"{scalar_type(node.dtype)} v{node.id};" for node in self.shared]
        tables = [f"{scalar_type(n.args[1].dtype)} {name}[{len(n.args) - 1}];" for name, n in self.columns.values()]
        yield "struct Shared { " + " ".join([*shared, *tables]) + " int none; };"
        carried = [f"{vector_type(n.dtype)} c{n.id}[VECTORS];" for _, n in self._given(UpdateLevel.STEP)]
        lanes = {n.id: n for n in [*(n for _, n in self._given(UpdateLevel.LANE)), *self.lanes]}
        own = [f"{vector_type(n.dtype)} l{n.id}[VECTORS];" for n in lanes.values() if n.op != "const"]
        yield "struct Block { " + " ".join([*carried, *own]) + " int none; };"

    def _prepare(self) -> Iterator[str]:
        """static void prepare(Shared&, arrays): what is the same for all lanes."""
        yield "PART void prepare(Shared& s, const Array* uniform) { (void)s; (void)uniform;"
        for place, node in self._given(UpdateLevel.UNIFORM):
            value = f"((const {scalar_type(node.dtype)}*)uniform[{place.array}].data)[{place.entry}]"
            yield "  " + _declare_uniform(node, value)
        columns = [x for _, node in self.columns.values() for x in node.args[1:]]
        wanted = [node for node in [*self.shared, *columns] if node.level == UpdateLevel.UNIFORM]
        yield from self._lines(schedule_nodes(wanted, UpdateLevel.UNIFORM), ONE_VECTOR, "  ")
        for node in self.shared:
            yield f"  s.v{node.id} = first(v{node.id});"
        for name, node in self.columns.values():
            for i, x in enumerate(node.args[1:]):
                yield f"  s.{name}[{i}] = first({self._name(x, 0)});"
        yield "}"

    def _begin(self) -> Iterator[str]:
        """static void begin(Block&, const Shared&, int q): what follows from the inputs of the lanes of vector q."""
        yield "PART void begin(Block& b, const Shared& s, int q) { (void)b; (void)s; (void)q;"
        yield from self._uniform([node for node in live_nodes(self.lanes) if node.level == UpdateLevel.LANE])
        for _, node in self._given(UpdateLevel.LANE):
            yield f"  const {vector_type(node.dtype)} v{node.id}_0 = b.l{node.id}[q];"
        yield from self._lines(schedule_nodes(self.lanes, UpdateLevel.LANE), ONE_VECTOR, "  ")
        for node in self.lanes:
            if node.op not in ("input", "const"):
                yield f"  b.l{node.id}[q] = v{node.id}_0;"
        yield "}"

    def _function(self, name: str) -> Iterator[str]:
        """static void NAME(Block&, const Shared&): a function of the carry, of all vectors."""
        carried, results = self.program.carried(), self.program.results[name]
        changed = [(c, r) for c, r in zip(carried, results, strict=True) if c is not r]
        yield f"BODY void {name}(Block& b, const Shared& s) {{ (void)b; (void)s;"
        yield from self._body([r for _, r in changed])
        for q in range(self.shape.vectors):
            for c, r in changed:
                yield f"  b.c{c.id}[{q}] = {self._name(r, q)};"
        yield "}"

    def _running(self) -> Iterator[str]:
        """static void running(const Block&, const Shared&, mask*): whether each lane goes on."""
        (root,) = self.program.results["running"]
        yield "PART void running(const Block& b, const Shared& s, mask* on) { (void)b; (void)s;"
        yield from self._body([root])
        for q in range(self.shape.vectors):
            yield f"  on[{q}] = {self._name(root, q)};"
        yield "}"

    def _body(self, roots: list[Node]) -> Iterator[str]:
        nodes = live_nodes(roots)
        own = {node.id for node in nodes}
        steps = [node for node in nodes if node.level == UpdateLevel.STEP]
        yield from self._uniform([*steps, *roots])
        read = [*roots, *(x for node in steps for x in operands_by_name(node))]
        lanes = {x.id: x for x in read if x.level == UpdateLevel.LANE}
        for q in range(self.shape.vectors):
            for node in self.program.carried():
                if node.id in own:
                    yield f"  const {vector_type(node.dtype)} v{node.id}_{q} = b.c{node.id}[{q}];"
            for node in lanes.values():
                yield f"  const {vector_type(node.dtype)} v{node.id}_{q} = b.l{node.id}[{q}];"
        yield from self._lines(schedule_nodes(roots, UpdateLevel.STEP), range(self.shape.vectors), "  ")

    def _uniform(self, readers: list[Node]) -> Iterator[str]:
        """What all lanes share of what these read."""
        shared = {node.id for node in self.shared}
        read = {x.id: x for node in readers for x in (node, *operands_by_name(node)) if x.id in shared}
        for node in read.values():
            yield "  " + _declare_uniform(node, f"s.v{node.id}")

    def _moves(self) -> Iterator[str]:
        """Functions that put a lane into a place of the block, and take its carry out."""
        yield "PART void put(Block& b, int p, i64 j, const Array* lanes, const Array* carry) {"
        yield "  const int i = p/LANES, q = p%LANES; (void)lanes;"
        for places, name, array in ((UpdateLevel.LANE, "l", "lanes"), (UpdateLevel.STEP, "c", "carry")):
            for place, node in self._given(places):
                size = self.program.sizes[places][place.array]
                value = f"((const {scalar_type(node.dtype)}*){array}[{place.array}].data)[j*{size} + {place.entry}]"
                target = f"b.{name}{node.id}[i]"
                yield f"  set({target}, q, {value});" if is_boolean(node.dtype) else f"  place({target}, q, {value});"
        yield "}\nPART void take(const Block& b, int p, i64 j, const Array* carry) {"
        yield "  const int i = p/LANES, q = p%LANES;"
        for place, node in self._given(UpdateLevel.STEP):
            size, value = self.program.sizes[UpdateLevel.STEP][place.array], f"b.c{node.id}[i]"
            value = f"get({value}, q)" if is_boolean(node.dtype) else f"at({value}, q)"
            yield f"  (({scalar_type(node.dtype)}*)carry[{place.array}].data)[j*{size} + {place.entry}] = {value};"
        yield "}"

    # operations -------------------------------------------------------------------------------------------------------

    def _lines(self, block: ScheduleBlock, vectors: range, indent: str) -> Iterator[str]:
        """The lines of a block, for these vectors."""
        for item in block:
            if isinstance(item, Branch):
                yield from self._branch(item, vectors, indent)
            else:
                for q in vectors:
                    declared = f"{indent}const {vector_type(item.dtype)} {self._name(item, q)}"
                    yield f"{declared} = {self._expression(item, q)};"

    def _branch(self, branch: Branch, vectors: range, indent: str) -> Iterator[str]:
        """A branch that is worth a jump, for each vector in which any lane goes there; in the lanes that do not, its
        results do not count."""
        yield from self._lines(branch.no, vectors, indent)
        if branch.size < MIN_BRANCH_OPERATIONS + len(branch.gates):
            yield from self._lines(branch.yes, vectors, indent)
            yield from self._gates(branch, vectors, indent + "const ")
            return
        for gate in branch.gates:
            names = ", ".join(f"{self._name(gate, q)} = {self._name(gate.args[1], q)}" for q in vectors)
            yield f"{indent}{vector_type(gate.dtype)} {names};"
        for q in vectors:
            yield f"{indent}if (any({self._name(branch.which, q)})) {{"
            yield from self._lines(branch.yes, range(q, q + 1), indent + "  ")
            yield from self._gates(branch, range(q, q + 1), indent + "  ", declared=True)
            yield indent + "}"

    def _gates(self, branch: Branch, vectors: range, indent: str, declared: bool = False) -> Iterator[str]:
        for gate in branch.gates:
            for q in vectors:
                which, no, yes = (self._name(x, q) for x in gate.args)
                left = self._name(gate, q) if declared else f"{vector_type(gate.dtype)} {self._name(gate, q)}"
                yield f"{indent}{left} = sel({which}, {yes}, {no});"

    def _name(self, node: Node, q: int) -> str:
        if node.op == "const":
            return literal(node)
        return f"v{node.id}" if node.level == UpdateLevel.UNIFORM else f"v{node.id}_{q}"

    def _expression(self, node: Node, q: int) -> str:
        args = [self._name(x, q) for x in node.args]
        if node.op in CPP_INFIX:
            return f"{args[0]} {CPP_INFIX[node.op]} {args[1]}"
        if node.op in PREFIX:
            return PREFIX[node.op] + args[0]
        if node.op in CPP_FUNCTIONS:
            return f"{CPP_FUNCTIONS[node.op]}({', '.join(args)})"
        if node.op == "select":
            return f"sel({args[0]}, {args[2]}, {args[1]})"
        if node.op == "convert":
            return f"to({args[0]}, {vector_type(node.dtype)}{{}})"
        if node.op == "bits":
            return f"bits_as({args[0]}, {vector_type(node.dtype)}{{}})"
        if node.op == "any":
            return args[0]
        assert node.op == "table", node.op
        return f"entry(s.{self.columns[tuple(x.id for x in node.args[1:])][0]}, {args[0]})"


def _declare_uniform(node: Node, value: str) -> str:
    """A number of all lanes, in every lane."""
    return f"const {vector_type(node.dtype)} v{node.id} = all({'(bool)' if is_boolean(node.dtype) else ''}{value});"


def count_operations(source: str) -> int:
    """Return how many operations a text has for each vector of lanes."""
    return len(re.findall(r"^ +(?:const )?\w+ v\d+_0 = ", source, re.MULTILINE))
