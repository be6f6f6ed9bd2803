"""A long memory in which each step changes one row.

A step of a run selects between the old and the new value of every memory. For a table of a thousand rows the selection
copies the table in each step, although one row is new. A solver may therefore lend the tables. The blocks then only
name the new row. The solver writes it in place, at the end of a step or before the next read.
"""

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

from diffabs.core.types import Array, PyTree, Scalar


@partial(jax.tree_util.register_dataclass, data_fields=["rows", "place", "row"], meta_fields=["lent"])
@dataclasses.dataclass(frozen=True)
class Log:
    """A table of rows, with the index and the value of the row written last.

    Attributes:
        rows: Rows, shape (size, n).
        place: Index of the row written last.
        row: That row, shape (n,). While the rows are lent, `rows` does not contain it.
        lent: Whether a solver holds the rows.
    """

    rows: PyTree
    place: Array
    row: PyTree
    lent: bool = False

    @property
    def size(self) -> int:
        """Number of rows."""
        return len(self.rows)

    def put(self, place: Array, row: object) -> "Log":
        """Return the log with `row` (n,) as the row at index `place`.

        `place` is a whole number, stored as an array of the row's type.
        """
        rows = self.rows if self.lent else self.rows.at[place.astype(int)].set(row)
        return dataclasses.replace(self, rows=rows, place=place, row=row)

    def read(self, places: Any) -> Scalar:
        """Return the rows at these `places` (k,), shape (k, n)."""
        rows = self.rows[places]
        return jnp.where((places == self.place.astype(int))[:, None], self.row, rows) if self.lent else rows


def log_rows(tree: object) -> list[PyTree]:
    """Return the rows of all logs in a pytree."""
    return [log.rows for log in jax.tree.leaves(tree, is_leaf=_is_log) if _is_log(log)]


def borrow(tree: object, rows: list[PyTree] | None) -> PyTree:
    """Return the tree with its logs lent to a solver, and with these rows (`log_rows`) in the logs, or without rows."""
    each = iter(rows or ())
    return _map_logs(lambda log: Log(next(each) if rows else None, log.place, log.row, lent=True), tree)


def commit(tree: object, rows: list[PyTree]) -> PyTree:
    """Return the tree with its logs no longer lent: each has its rows, and among them the row written last."""
    each = iter(rows)
    return _map_logs(lambda log: Log(next(each), log.place, log.row).put(log.place, log.row), tree)


def write_last_rows(tree: object) -> list[PyTree]:
    """Return the rows of all lent logs after the row written last is put in its place.

    If a step writes the previous step's row and then reads, the write happens in place. If it reads first, the write
    needs a copy, unless the row depends on the value read.
    """
    return log_rows(commit(tree, log_rows(tree)))


def _is_log(x: Scalar) -> bool:
    return isinstance(x, Log)


def _map_logs(change: Callable[[Log], Log], tree: object) -> Any:
    return jax.tree.map(lambda x: change(x) if _is_log(x) else x, tree, is_leaf=_is_log)
