"""A program as C++ text: each thread runs a block of a few SIMD vectors of lanes.

An operation becomes one line for each vector of the block, one after the other. The processor overlaps these
independent lines, which hides the latency of each result. Between rounds, the next lane takes the place of a lane that
has ended.
"""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from diffabs.compiler.emit.cpp_words import literal, scalar_type, vector_type
from diffabs.compiler.ir import Node, UpdateLevel, live_nodes
from diffabs.compiler.operations import OPERATIONS
from diffabs.compiler.program import InputPlace, ScalarProgram
from diffabs.compiler.schedule import Branch, ScheduleBlock, schedule_nodes

ONE_VECTOR = range(1)
MIN_BRANCH_OPERATIONS = 24  # of both branches; a jump in a smaller conditional costs more than it saves


class LaunchShape(NamedTuple):
    """The loop structure of a launch.

    Attributes:
        vectors: SIMD vectors in a block.
        steps: Calls of `step` after each call of `renew`.
        rounds: Rounds between two calls of `running`. A round is one call of `renew` and `steps` calls of `step`.
    """

    vectors: int
    steps: int
    rounds: int


def emit_cpp(program: ScalarProgram, shape: LaunchShape) -> str:
    """Return the C++ text of a program, complete with the loops over lanes and the entry point for XLA."""
    return "\n".join(Text(program, shape).parts()) + "\n"


def operands_by_name(node: Node) -> tuple[Node, ...]:
    """Return the operands that an expression refers to by variable name; a table's entries lie in a column instead."""
    return node.args[:1] if node.op == "table" else node.args


class RareNumbers(NamedTuple):
    """Numbers of the carry that a function reads or changes only in the true branch of one conditional with a jump.

    A vector that does not compute this branch neither loads nor stores them.

    Attributes:
        stored: Inputs that only the branch changes, by the id of the gate that returns the new number.
        loaded: Inputs that only the branch reads, by the id of the conditional's first gate.
    """

    stored: dict[int, Node]
    loaded: dict[int, list[Node]]


def find_rare_numbers(block: ScheduleBlock, nodes: Sequence[Node], changed: Sequence[tuple[Node, Node]]) -> RareNumbers:
    """Return the numbers that only the true branch of one outermost conditional with a jump reads or changes.

    Args:
        changed: Numbers of the carry that the function changes, each with its result.
    """
    rare = RareNumbers({}, {})
    readers: dict[int, set[int]] = {node.id: set() for node in nodes}
    for node in nodes:
        for x in node.args:
            readers[x.id].add(node.id)
    results = [result.id for _, result in changed]
    for branch in (item for item in block if isinstance(item, Branch) and branch_jumps(item)):
        gates = {gate.id for gate in branch.gates}
        stored = {
            gate.id: number
            for number, gate in changed
            if gate.id in gates and gate.args[1] is number and not readers[gate.id] and results.count(gate.id) == 1
        }
        inside = {*stored, *(node.id for node in branch.yes.nodes())}
        read = {x.id: x for node in nodes if node.id in inside for x in node.args if x.op == "input"}
        rare.loaded[branch.gates[0].id] = [
            x
            for x in read.values()
            if x.level == UpdateLevel.STEP
            and readers[x.id] <= inside
            and x is not branch.condition
            and x.id not in results
        ]
        rare.stored.update(stored)
    return rare


def branch_jumps(branch: Branch) -> bool:
    """Return whether a conditional becomes a jump: both branches together have at least MIN_BRANCH_OPERATIONS."""
    # `size` includes the gates, which execute with or without a jump.
    return branch.size >= MIN_BRANCH_OPERATIONS + len(branch.gates)


class Text:
    """A writer of a program as C++, part by part.

    A subclass for another back end replaces HEAD and DRIVER. HEAD defines the types and functions that the parts use.
    DRIVER comes after the parts and calls them.
    """

    HEAD, DRIVER = '#include "functions.h"', '#include "drive.h"'

    def __init__(self, program: ScalarProgram, shape: LaunchShape):
        """Find the values that are computed before the steps: `shared` once a launch, `lanes` once a lane.

        `columns` has the name and a node of each table. The other operations are computed in every step.
        """
        self.program = program
        self.shape = shape
        self.rare: RareNumbers = RareNumbers({}, {})
        self.roots: list[Node] = [node for nodes in program.results.values() for node in nodes]
        nodes = live_nodes(self.roots)
        self.alive: set[int] = {node.id for node in nodes}
        # Tables with the same entries share one column.
        self.columns: dict[tuple[int, ...], tuple[str, Node]] = {}
        for node in nodes:
            if node.op == "table":
                key = tuple(x.id for x in node.args[1:])
                self.columns.setdefault(key, (f"t{len(self.columns)}", node))
        lanes = self._ids_read([node for node in nodes if node.level == UpdateLevel.STEP], self.roots, UpdateLevel.LANE)
        self.lanes: list[Node] = [node for node in nodes if node.id in lanes]
        below = [node for node in nodes if node.level >= UpdateLevel.LANE]
        shared = self._ids_read(below, self.roots, UpdateLevel.UNIFORM)
        self.shared: list[Node] = [node for node in nodes if node.id in shared and node.op != "const"]

    @staticmethod
    def _ids_read(readers: list[Node], roots: list[Node], level: UpdateLevel) -> set[int]:
        """Return the ids of the nodes of `level` that results are, or that `readers` of a faster level read."""
        read = {
            arg.id for node in readers if node.level > level for arg in operands_by_name(node) if arg.level == level
        }
        return read | {root.id for root in roots if root.level == level}

    def parts(self) -> Iterator[str]:
        """Yield the parts of the text in their order."""
        single = "#define SINGLE\n" if self.program.dtype == np.float32 else ""
        yield f"{single}{self.HEAD}\nenum {{ VECTORS = {self.shape.vectors}, SLOTS = VECTORS*LANES }};"
        sizes = self.program.sizes
        counts = zip(("UNIFORM", "OF_LANES", "CARRIED"), (len(sizes[level]) for level in sizes), strict=True)
        yield "enum { " + ", ".join(f"{name} = {count}" for name, count in counts) + " };"
        yield "enum { FIRST = UNIFORM + OF_LANES, RESULTS = CARRIED };"
        yield self.widths(0)
        yield from self.functions(("renew", "step"))
        yield from self.running_function()
        yield f"enum {{ STEPS = {self.shape.steps}, ROUNDS = {self.shape.rounds} }};"
        yield self.DRIVER

    def widths(self, first: int) -> str:
        """Return the table of the bytes of one lane in each array of the carry, from array `first` on."""
        kinds = {place.array: scalar_type(node.dtype) for place, node in self._given_inputs(UpdateLevel.STEP)}
        widths = [
            f"{size}*sizeof({kinds.get(i, 'u8')})"
            for i, size in enumerate(self.program.sizes[UpdateLevel.STEP])
            if i >= first
        ]
        # An array without entries has no node to take the type from. Its width is 0 in any type.
        return f"static const i64 WIDTHS[] = {{{', '.join(map(str, widths))}}};"

    def functions(self, names: Sequence[str]) -> Iterator[str]:
        """Yield the structs and functions of a program; `names` are those that update the carry."""
        yield from self._structures()
        yield from self._prepare()
        yield from self._begin()
        for name in names:
            yield from self._function(name)
        yield from self._put_and_take()

    def _given_inputs(self, level: UpdateLevel) -> list[tuple[InputPlace, Node]]:
        """Return the inputs of a level that the results depend on; for STEP all inputs of the carry."""
        return [
            (p, n)
            for p, n in self.program.inputs.items()
            if p.level == level and (level == UpdateLevel.STEP or n.id in self.alive)
        ]

    def _array_inputs(self, level: UpdateLevel) -> list[tuple[InputPlace, Node]]:
        """Return the inputs of a level that `put` reads and, for STEP, `take` returns."""
        return self._given_inputs(level)

    def _structures(self) -> Iterator[str]:
        """Yield the structs `Shared`, with values of all lanes, and `Block`, with the carry and values of each lane."""
        shared = [f"{scalar_type(node.dtype)} v{node.id};" for node in self.shared]
        tables = [f"{scalar_type(n.args[1].dtype)} {name}[{len(n.args) - 1}];" for name, n in self.columns.values()]
        yield "struct Shared { " + " ".join([*shared, *tables]) + " int none; };"
        carried = [f"{vector_type(n.dtype)} c{n.id}[VECTORS];" for _, n in self._given_inputs(UpdateLevel.STEP)]
        lanes = {n.id: n for n in [*(n for _, n in self._given_inputs(UpdateLevel.LANE)), *self.lanes]}
        lane_values = [f"{vector_type(n.dtype)} l{n.id}[VECTORS];" for n in lanes.values() if n.op != "const"]
        yield "struct Block { " + " ".join([*carried, *lane_values]) + " int none; };"

    def _prepare(self) -> Iterator[str]:
        """Yield static void prepare(Shared&, arrays), which computes the values that all lanes share."""
        yield "PART void prepare(Shared& s, const Array* uniform) { (void)s; (void)uniform;"
        for place, node in self._given_inputs(UpdateLevel.UNIFORM):
            value = f"((const {scalar_type(node.dtype)}*)uniform[{place.array}].data)[{place.entry}]"
            yield "  " + _declare_uniform(node, value)
        columns = [x for _, node in self.columns.values() for x in node.args[1:]]
        uniforms = [node for node in [*self.shared, *columns] if node.level == UpdateLevel.UNIFORM]
        yield from self._lines(schedule_nodes(uniforms, UpdateLevel.UNIFORM), ONE_VECTOR, "  ")
        for node in self.shared:
            yield f"  s.v{node.id} = first(v{node.id});"
        for _, node in self.columns.values():
            yield from self._fill_column(node, "  ")
        yield "}"

    def _begin(self) -> Iterator[str]:
        """Yield static void begin(Block&, const Shared&, int q), which computes vector q's values of level LANE."""
        yield "PART void begin(Block& b, const Shared& s, int q) { (void)b; (void)s; (void)q;"
        yield from self._load_uniforms([node for node in live_nodes(self.lanes) if node.level == UpdateLevel.LANE])
        for _, node in self._given_inputs(UpdateLevel.LANE):
            yield f"  const {vector_type(node.dtype)} v{node.id}_0 = b.l{node.id}[q];"
        yield from self._lines(schedule_nodes(self.lanes, UpdateLevel.LANE), ONE_VECTOR, "  ")
        for node in self.lanes:
            if node.op not in ("input", "const"):
                yield f"  b.l{node.id}[q] = v{node.id}_0;"
        yield "}"

    def _function(self, name: str) -> Iterator[str]:
        """Yield static void NAME(Block&, const Shared&), which updates the carry of all vectors."""
        carried, results = self.program.carry_inputs(), self.program.results[name]
        # Compute all results of all vectors before the first store: each may read the old carry.
        changed = [(c, r) for c, r in zip(carried, results, strict=True) if c is not r]
        yield f"BODY void {name}(Block& b, const Shared& s) {{ (void)b; (void)s;"
        yield from self._body([r for _, r in changed], changed)
        for q in range(self.shape.vectors):
            for c, r in changed:
                if r.id not in self.rare.stored:
                    yield f"  b.c{c.id}[{q}] = {self._name(r, q)};"
        yield "}"

    def running_function(self) -> Iterator[str]:
        """Yield static void running(const Block&, const Shared&, mask*), which tells for each lane if it continues."""
        (root,) = self.program.results["running"]
        yield "PART void running(const Block& b, const Shared& s, mask* on) { (void)b; (void)s;"
        yield from self._body([root])
        for q in range(self.shape.vectors):
            yield f"  on[{q}] = {self._name(root, q)};"
        yield "}"

    def _body(self, roots: list[Node], changed: Sequence[tuple[Node, Node]] = ()) -> Iterator[str]:
        """Yield the loads and operations that compute `roots` for all vectors; set `self.rare`."""
        nodes, block = live_nodes(roots), schedule_nodes(roots, UpdateLevel.STEP)
        self.rare = find_rare_numbers(block, nodes, changed)
        loaded_later = {node.id for numbers in self.rare.loaded.values() for node in numbers}
        needed = {node.id for node in nodes}
        steps = [node for node in nodes if node.level == UpdateLevel.STEP]
        yield from self._load_uniforms([*steps, *roots])
        read = [*roots, *(x for node in steps for x in operands_by_name(node))]
        lanes = {x.id: x for x in read if x.level == UpdateLevel.LANE}
        for q in range(self.shape.vectors):
            for node in self.program.carry_inputs():
                if node.id in needed - loaded_later:
                    yield self._load(node, q, "  ")
            for node in lanes.values():
                yield f"  const {vector_type(node.dtype)} v{node.id}_{q} = b.l{node.id}[{q}];"
        yield from self._lines(block, range(self.shape.vectors), "  ")

    def _load(self, node: Node, q: int, indent: str) -> str:
        """Return the line that loads a number of the carry for vector q."""
        return f"{indent}const {vector_type(node.dtype)} {self._name(node, q)} = b.c{node.id}[{q}];"

    def _load_uniforms(self, readers: list[Node]) -> Iterator[str]:
        """Yield declarations of the shared values that these nodes read."""
        shared = {node.id for node in self.shared}
        read = {x.id: x for node in readers for x in (node, *operands_by_name(node)) if x.id in shared}
        for node in read.values():
            yield "  " + _declare_uniform(node, f"s.v{node.id}")

    def _put_and_take(self) -> Iterator[str]:
        """Yield the functions `put`, from the arrays to a place of the block, and `take`, back to the arrays."""
        yield "PART void put(Block& b, int p, i64 j, const Array* lanes, const Array* carry) {"
        yield "  const int i = p/LANES, q = p%LANES; (void)lanes;"
        for places, name, array in ((UpdateLevel.LANE, "l", "lanes"), (UpdateLevel.STEP, "c", "carry")):
            for place, node in self._array_inputs(places):
                size = self.program.sizes[places][place.array]
                value = f"((const {scalar_type(node.dtype)}*){array}[{place.array}].data)[j*{size} + {place.entry}]"
                target = f"b.{name}{node.id}[i]"
                yield f"  set({target}, q, {value});" if node.dtype == bool else f"  place({target}, q, {value});"
        yield "}\nPART void take(const Block& b, int p, i64 j, const Array* carry) {"
        yield "  const int i = p/LANES, q = p%LANES;"
        for place, node in self._array_inputs(UpdateLevel.STEP):
            size, value = self.program.sizes[UpdateLevel.STEP][place.array], f"b.c{node.id}[i]"
            value = f"get({value}, q)" if node.dtype == bool else f"at({value}, q)"
            yield f"  (({scalar_type(node.dtype)}*)carry[{place.array}].data)[j*{size} + {place.entry}] = {value};"
        yield "}"

    # operations -------------------------------------------------------------------------------------------------------

    def _lines(self, block: ScheduleBlock, vectors: range, indent: str) -> Iterator[str]:
        """Yield the lines of the operations of a schedule block, for each of `vectors`."""
        for item in block:
            if isinstance(item, Branch):
                yield from self._branch(item, vectors, indent)
            else:
                if item.op == "table" and item.level == UpdateLevel.UNIFORM:  # read where its entries are computed
                    yield from self._fill_column(item, indent)
                for q in vectors:
                    declared = f"{indent}const {vector_type(item.dtype)} {self._name(item, q)}"
                    yield f"{declared} = {self._expression(item, q)};"

    def _fill_column(self, table: Node, indent: str) -> Iterator[str]:
        """Yield the lines that write the entries of a table, which are uniform, into its column."""
        name, _ = self.columns[tuple(x.id for x in table.args[1:])]
        for i, x in enumerate(table.args[1:]):
            yield f"{indent}s.{name}[{i}] = first({self._name(x, 0)});"

    def _branch(self, branch: Branch, vectors: range, indent: str) -> Iterator[str]:
        """Yield a conditional: the false branch, then the true branch, within a jump if `branch_jumps`.

        A vector computes the true branch if the condition is true in any of its lanes. The gates then select for each
        lane. All vectors compute the false branch.
        """
        yield from self._lines(branch.no, vectors, indent)
        if not branch_jumps(branch):
            yield from self._lines(branch.yes, vectors, indent)
            yield from self._gates(branch, vectors, indent + "const ")
            return
        for gate in (gate for gate in branch.gates if gate.id not in self.rare.stored):
            # Initialize the results with the branch not taken, so that a vector that skips the jump has valid values.
            names = ", ".join(f"{self._name(gate, q)} = {self._name(gate.args[1], q)}" for q in vectors)
            yield f"{indent}{vector_type(gate.dtype)} {names};"
        for q in vectors:
            yield f"{indent}if (any({self._name(branch.condition, q)})) {{"
            for node in self.rare.loaded.get(branch.gates[0].id, ()):
                yield self._load(node, q, indent + "  ")
            yield from self._lines(branch.yes, range(q, q + 1), indent + "  ")
            yield from self._gates(branch, range(q, q + 1), indent + "  ", declared=True)
            yield indent + "}"

    def _gates(self, branch: Branch, vectors: range, indent: str, declared: bool = False) -> Iterator[str]:
        """Yield the selections of a conditional's results; `declared` says that their variables exist."""
        for gate in branch.gates:
            for q in vectors:
                condition, no, yes = (self._name(x, q) for x in gate.args)
                if gate.id in self.rare.stored:
                    target = f"b.c{self.rare.stored[gate.id].id}[{q}]"
                else:
                    target = self._name(gate, q) if declared else f"{vector_type(gate.dtype)} {self._name(gate, q)}"
                yield f"{indent}{target} = sel({condition}, {yes}, {no});"

    def _name(self, node: Node, q: int) -> str:
        """Return the C++ variable of a node for vector q, or the literal of a constant."""
        if node.op == "const":
            return literal(node)
        return f"v{node.id}" if node.level == UpdateLevel.UNIFORM else f"v{node.id}_{q}"

    def _expression(self, node: Node, q: int) -> str:
        """Return the C++ expression of an operation for vector q."""
        args = [self._name(x, q) for x in node.args]
        if node.op in OPERATIONS:
            return OPERATIONS[node.op].cpp.format(*args)
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
    """Return the declaration of a vector with the number `value` in every lane."""
    return f"const {vector_type(node.dtype)} v{node.id} = all({'(bool)' if node.dtype == bool else ''}{value});"
