"""The summary of a result in a few lines: text for a terminal, HTML for a notebook."""

import dataclasses
import html
import math
from collections.abc import Sequence

import numpy as np

from diffabs.core.types import PyTree, Scalar

ZERO_TOLERANCE = 1e-14  # smaller numbers, in SI units, are rounding errors


def round_for_table(value: Scalar, digits: int = 6) -> str:
    """Return a number as text for a table; numbers below 1e-14 are rounding errors and give 0."""
    value = float(value)
    return "0" if abs(value) < ZERO_TOLERANCE else f"{value:.{digits}g}"


def format_metric(value: Scalar) -> str:
    """Return a metric as text for a table; `never` for infinity, `none` for a run without such a metric (NaN)."""
    return "never" if value == math.inf else "none" if math.isnan(value) else round_for_table(value)


def format_cell(value: Scalar) -> str:
    """Return a value as text for a table; of a list, the first four entries."""
    if isinstance(value, str | bool | np.bool_) or value is None:
        return "" if value is None else str(value)
    if np.ndim(value):
        rows = np.asarray(value).reshape(-1)
        return f"[{', '.join(map(round_for_table, rows[:4]))}{', ...' if len(rows) > 4 else ''}]"
    return str(value) if isinstance(value, int) else round_for_table(value)


@dataclasses.dataclass(frozen=True)
class Summary:
    """A title, a table (columns, and rows of values), and a line below it. As text it fits most terminals."""

    title: str
    columns: tuple[str, ...] = ()
    rows: tuple[tuple[PyTree, ...], ...] = ()
    note: str = ""

    def __str__(self) -> str:
        """Return the summary as text."""
        lines = [list(self.columns), *([format_cell(value) for value in row] for row in self.rows)] if self.rows else []
        widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
        table = [
            "  ".join(word.ljust(width) for word, width in zip(line, widths, strict=True)).rstrip() for line in lines
        ]
        if table:
            table.insert(1, "-" * (sum(widths) + 2 * (len(widths) - 1)))
        return "\n".join([self.title, *table, *([self.note] if self.note else [])])

    __repr__ = __str__

    def _repr_html_(self) -> str:
        """Return the summary as HTML for a notebook."""
        head = "".join(f"<th>{html.escape(name)}</th>" for name in self.columns)
        body = "".join(_row(row) for row in self.rows)
        note = f"<p>{html.escape(self.note)}</p>" if self.note else ""
        table = f"<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>" if self.rows else ""
        return f"<p><strong>{html.escape(self.title)}</strong></p>{table}{note}"


def _row(values: Sequence[PyTree]) -> str:
    return f"<tr>{''.join(f'<td>{html.escape(format_cell(value))}</td>' for value in values)}</tr>"
