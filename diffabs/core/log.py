"""A long memory of which little changes at a time.

A step of a run chooses, of everything, between what was and what is to be. Of a table of a thousand rows that costs a
copy of it each time, though one row is new. So a solver may lend the tables to the blocks, who then only say which row
is to be written, and write these itself: at the end of a step, or before the next one reads, in place."""

import dataclasses
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp


@partial(jax.tree_util.register_dataclass, data_fields=["rows", "place", "row"], meta_fields=["lent"])
@dataclasses.dataclass(frozen=True)
class Log:
    """Rows (size, n); the place of the last one that was put, and that row (n,). While they are lent, that row is not
    among them."""

    rows: Any
    place: Any
    row: Any
    lent: bool = False

    @property
    def size(self) -> int:
        """How many rows there are."""
        return len(self.rows)

    def put(self, place: Any, row: Any) -> "Log":
        """The log with a row at a place, a whole number of the row's type."""
        rows = self.rows if self.lent else self.rows.at[place.astype(int)].set(row)
        return dataclasses.replace(self, rows=rows, place=place, row=row)

    def read(self, places: Any) -> Any:
        """The rows at these places (k,)."""
        rows = self.rows[places]
        return jnp.where((places == self.place.astype(int))[:, None], self.row, rows) if self.lent else rows


def log_rows(tree: Any) -> list[Any]:
    """Return the rows of all logs."""
    return [log.rows for log in jax.tree.leaves(tree, is_leaf=_is_log) if _is_log(log)]


def borrow(tree: Any, rows: list[Any] | None) -> Any:
    """Return a tree whose logs have these rows, lent; with None, no rows at all."""
    each = iter(rows or ())
    return _map_logs(lambda log: Log(next(each) if rows else None, log.place, log.row, lent=True), tree)


def commit(tree: Any, rows: list[Any]) -> Any:
    """Return a tree whose logs have these rows, and the row that was put while they were lent."""
    each = iter(rows)
    return _map_logs(lambda log: Log(next(each), log.place, log.row).put(log.place, log.row), tree)


def write_last_rows(tree: Any) -> list[Any]:
    """Return the rows of all logs with the row that was put last. Who writes what the step before has put, and then
    reads, does so in place; who reads first needs a copy, unless the row depends on what was read."""
    return log_rows(commit(tree, log_rows(tree)))


def _is_log(x: Any) -> bool:
    return isinstance(x, Log)


def _map_logs(change: Any, tree: Any) -> Any:
    return jax.tree.map(lambda x: change(x) if _is_log(x) else x, tree, is_leaf=_is_log)
