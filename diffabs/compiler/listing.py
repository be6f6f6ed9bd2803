"""A program as text, one line for each operation: the input and the result of a pass.

    v7 = mul c0.0, u1.0     f64, step
    c0.0 <- v7

u1.0 is entry 0 of the uniform array 1. l0.2 is entry 2 of the lane's array 0, and c0.0 entry 0 of the carry's array 0.
The last word says how often the operation is computed: once a launch (uniform), once a lane, or in each step. Numbers
that a function writes into the carry have an arrow. `select` and `gate` have the operands condition, value if false,
value if true.
"""

from collections.abc import Iterator

from diffabs.compiler.ir import Node, UpdateLevel, live_nodes
from diffabs.compiler.program import RUNNING_FUNCTION, ScalarProgram
from diffabs.compiler.schedule import Branch, ScheduleBlock, schedule_nodes

ArrayPaths = dict[UpdateLevel, list[str]]  # names of the arrays of each level
INPUT_LETTERS = {UpdateLevel.UNIFORM: "u", UpdateLevel.LANE: "l", UpdateLevel.STEP: "c"}
LEVEL_NAMES = {UpdateLevel.UNIFORM: "uniform", UpdateLevel.LANE: "lane", UpdateLevel.STEP: "step"}


def list_program(program: ScalarProgram, paths: ArrayPaths) -> str:
    """Return the text of a program: its inputs, then its functions with the operations that they need, operands first.

    An operation that several functions need stands in the first of them.
    """
    names = _name_nodes(program)
    lines, listed = _inputs(program, paths, names), set[int]()
    for function, results in program.results.items():
        lines.append(f"{function}:")
        nodes = [node for node in live_nodes(results) if node.id not in listed]
        lines += [_operation(node, names) for node in nodes if node.op not in ("const", "input")]
        lines += [f"  {arrow}" for arrow in _arrows(program, function, names)]
        listed |= {node.id for node in nodes}
    return "\n".join(lines) + "\n"


def list_schedule(program: ScalarProgram, paths: ArrayPaths) -> str:
    """Return the text of the operations of level step in their order, inside the conditionals that need them.

    Operations of the other levels have no line, but keep their names.
    """
    names = _name_nodes(program)
    lines = _inputs(program, paths, names)
    for function, results in program.results.items():
        lines.append(f"{function}:")
        lines += _block(schedule_nodes(results, UpdateLevel.STEP), names, "  ")
        lines += [f"  {arrow}" for arrow in _arrows(program, function, names)]
    return "\n".join(lines) + "\n"


def count_by_level(program: ScalarProgram) -> dict[str, int]:
    """Return the number of operations by how often they are computed: "uniform", "lane", "step"."""
    nodes = live_nodes([node for results in program.results.values() for node in results])
    return {
        name: sum(node.level == level and node.op not in ("const", "input") for node in nodes)
        for level, name in LEVEL_NAMES.items()
    }


def _name_nodes(program: ScalarProgram) -> dict[int, str]:
    """Return the texts for all nodes by id: c0.0 for an input, v7 for an operation, the value of a constant."""
    names = {node.id: f"{INPUT_LETTERS[p.level]}{p.array}.{p.entry}" for p, node in program.inputs.items()}
    count = 0
    for node in live_nodes([node for results in program.results.values() for node in results]):
        if node.op == "const":
            names[node.id] = str(bool(node.attr)) if node.dtype == bool else repr(node.attr.item())
        elif node.id not in names:
            names[node.id] = f"v{count}"
            count += 1
    return names


def _inputs(program: ScalarProgram, paths: ArrayPaths, names: dict[int, str]) -> list[str]:
    """Return the lines of the inputs that the program reads or returns, with the paths of their arrays."""
    used = {node.id for node in live_nodes([node for results in program.results.values() for node in results])}
    lines = ["inputs:"]
    for place, node in program.inputs.items():
        if node.id in used:
            lines.append(f"  {names[node.id]:<8} {_kind(node)}  {paths[place.level][place.array]}".rstrip())
    return lines


def _kind(node: Node) -> str:
    """Return the type of a number, such as f64."""
    return "bool" if node.dtype == bool else f"{node.dtype.kind}{8 * node.dtype.itemsize}"


def _operation(node: Node, names: dict[int, str]) -> str:
    operands = ", ".join(names[x.id] for x in node.args)
    return f"  {f'{names[node.id]} = {node.op} {operands}':<40} {_kind(node)}, {LEVEL_NAMES[node.level]}"


def _arrows(program: ScalarProgram, function: str, names: dict[int, str]) -> Iterator[str]:
    """Yield the lines for the results of a function: numbers of the carry that it changes, or if the lane goes on."""
    results = program.results[function]
    if function == RUNNING_FUNCTION:
        yield f"-> {names[results[0].id]}"
        return
    for number, result in zip(program.carry_inputs(), results, strict=True):
        if result is not number:
            yield f"{names[number.id]} <- {names[result.id]}"


def _block(block: ScheduleBlock, names: dict[int, str], indent: str) -> list[str]:
    """Return the lines of a block, with its conditionals as if and else."""
    lines: list[str] = []
    for item in block:
        if not isinstance(item, Branch):
            lines.append(indent[2:] + _operation(item, names))
            continue
        lines.append(f"{indent}if {names[item.condition.id]}:")
        lines += _block(item.yes, names, indent + "  ")
        if item.no.items:
            lines.append(f"{indent}else:")
            lines += _block(item.no, names, indent + "  ")
        lines += [indent[2:] + _operation(gate, names) for gate in item.gates]
    return lines
