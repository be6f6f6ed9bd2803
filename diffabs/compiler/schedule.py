"""The nesting of operations in conditionals: each in the innermost branch that contains all its readers."""

from collections.abc import Iterator, Sequence

from diffabs.compiler.ir import Node, UpdateLevel, live_nodes


class Branch:
    """A conditional in a schedule.

    Attributes:
        gates: Nodes "gate" of the conditional's results; they lie outside of both branches.
        yes: Operations that only the true branch needs.
        no: Operations that only the false branch needs.
        condition: Boolean node.
    """

    def __init__(self, gates: list[Node], yes: "ScheduleBlock", no: "ScheduleBlock"):
        """Create the conditional of `gates`, which share one number, with the blocks `yes` and `no`."""
        self.gates = gates
        self.yes = yes
        self.no = no
        self.condition: Node = gates[0].args[0]

    @property
    def size(self) -> int:
        """Number of operations in both branches, gates included."""
        return self.yes.size + self.no.size + len(self.gates)


class ScheduleBlock:
    """A branch of a conditional, or all operations: nodes and inner conditionals in order.

    An inner conditional stands in the place of its first gate.
    """

    def __init__(self, outer: "ScheduleBlock | None" = None):
        """Create an empty block inside `outer`, or an outermost block."""
        self.outer = outer
        self.depth: int = outer.depth + 1 if outer else 0
        self.items: dict[int, Node | Branch] = {}

    @property
    def size(self) -> int:
        """Number of operations in the block and its branches."""
        return sum(item.size if isinstance(item, Branch) else 1 for item in self.items.values())

    def nodes(self) -> Iterator[Node]:
        """Yield the operations of the block and of its branches, gates included, in any order."""
        for item in self.items.values():
            if isinstance(item, Branch):
                yield from item.gates
                yield from (*item.yes.nodes(), *item.no.nodes())
            else:
                yield item

    def __iter__(self) -> Iterator[Node | Branch]:
        """Yield operations and branches, operands first."""
        return (self.items[i] for i in sorted(self.items))


def schedule_nodes(roots: Sequence[Node], level: UpdateLevel) -> ScheduleBlock:
    """Return the operations of one level that the roots need, nested in the branches of conditionals."""
    nodes = [node for node in live_nodes(roots) if node.level == level and node.op not in ("input", "const")]
    gates: dict[int, list[Node]] = {}
    for node in nodes:
        if node.op == "gate":
            gates.setdefault(node.attr.number, []).append(node)
    outermost, used = ScheduleBlock(), dict[int, ScheduleBlock]()

    def use(node: Node, block: ScheduleBlock) -> None:
        """Record that an operation in `block` reads `node`."""
        used[node.id] = _common(used[node.id], block) if node.id in used else block

    for root in roots:
        use(root, outermost)
    # Readers first: when a node is placed, the blocks of all its readers are known.
    for node in reversed(nodes):
        if node.op != "gate":
            used[node.id].items[node.id] = node
            for arg in node.args:
                use(arg, used[node.id])
        elif (group := gates[node.attr.number])[-1] is node:
            block = used[node.id]
            # The gates of a conditional are created in a row, so here the readers of all of them are placed.
            for gate in group[:-1]:
                block = _common(block, used[gate.id])
            branch = Branch(group, ScheduleBlock(block), ScheduleBlock(block))
            block.items[group[0].id] = branch
            use(branch.condition, block)
            for gate in group:
                use(gate.args[1], branch.no)
                use(gate.args[2], branch.yes)
    return outermost


def _common(a: ScheduleBlock, b: ScheduleBlock) -> ScheduleBlock:
    """Return the innermost block that contains both blocks."""
    while a is not b:
        a, b = (a.outer, b) if a.depth >= b.depth else (a, b.outer)  # pyright: ignore[reportAssignmentType]
    return a
