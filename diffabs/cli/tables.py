"""Tables on stdout that fit a terminal: cells are folded between words, and a table too wide becomes several."""

import copy

from rich.console import Console
from rich.table import Column, Table

PIPE_WIDTH = 140  # columns of a table on a pipe or in a file
FRAME, PER_COLUMN = 1, 3  # width of the frame; further width of frame and padding for each column


def show_titled_table(title: str, table: Table) -> None:
    """Print a table to stdout, below its title; one that is too wide is split into several."""
    for column in table.columns:
        column.overflow = "fold"  # fold long cells: rich would cut them off
    console = open_console()
    console.print(*([title] if title else []), *fit_table(table, console.width), sep="\n")


def open_console() -> Console:
    """Return rich's console on stdout. It reads no markup, and a pipe has `PIPE_WIDTH` columns."""
    console = Console(markup=False, emoji=False, highlight=False)  # rich would read the unit `[N m]` as a style
    if not console.is_terminal:
        console.width = PIPE_WIDTH
    return console


def fit_table(table: Table, width: int) -> list[Table]:
    """Return a table as one or more tables, each at most `width` wide if its longest words allow it.

    The first column names the row, so it is repeated in each table.
    """
    groups: list[list[Column]] = []
    first, *columns = table.columns
    for column in columns:
        if groups and _least([*groups[-1], column]) <= width:
            groups[-1].append(column)
        else:
            groups.append([first, column])
    return [_lay_out(table, group, width) for group in groups or [[first]]]


def _lay_out(table: Table, columns: list[Column], width: int) -> Table:
    """Return a table of these columns, each as wide as its longest word; wider columns share the remaining width."""
    new = copy.copy(table)
    new.columns = [copy.copy(column) for column in columns]
    spare = width - _least(columns)
    needs = {i: _line(column) - _word(column) for i, column in enumerate(columns)}
    # Smallest need first, so that the width it leaves unused goes to the wider columns.
    for place, i in enumerate(sorted(needs, key=lambda i: needs[i])):
        more = max(0, min(needs[i], spare // (len(columns) - place)))
        spare -= more
        if spare >= 0:
            new.columns[i].width = _word(columns[i]) + more
    return new


def _least(columns: list[Column]) -> int:
    return FRAME + sum(PER_COLUMN + _word(column) for column in columns)


def _texts(column: Column) -> list[str]:
    return [str(column.header), *map(str, column.cells)]


def _word(column: Column) -> int:
    """Return the length of the longest word."""
    return max((len(word) for text in _texts(column) for word in text.split()), default=1)


def _line(column: Column) -> int:
    """Return the length of the longest text."""
    return max(map(len, _texts(column)), default=1)
