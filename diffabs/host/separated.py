"""Text files of columns: the separator of the cells, and numbers with a decimal point or comma.

a,b        0.5,1.5      comma and point
a;b        0,5;1,5      semicolon or tab, and point or comma
"""

import csv
from collections.abc import Sequence

MAX_LOOKED_AT = 100  # lines from which the separator is guessed
SEPARATORS = {",": "comma", ";": "semicolon", "\t": "tab"}


def split_rows(text: str, separator: str | None = None) -> tuple[list[list[str]], str]:
    """Return the cells of each line, names first, and the separator; None guesses one of `SEPARATORS`."""
    lines = text.splitlines()
    separator = separator or guess_separator(lines)
    try:
        return list(csv.reader(lines, delimiter=separator)), separator
    except csv.Error as error:
        raise ValueError(f"is not a CSV file: {error}") from None


def guess_separator(lines: Sequence[str]) -> str:
    """Return the separator that splits the names and the most lines below into equally many cells, more than one.

    The comma is the separator of a file with one column, and of one whose first numbers no separator splits alike.
    """
    first = [line for line in lines[:MAX_LOOKED_AT] if line]

    def count_alike(separator: str) -> int:
        """Return the number of lines like the first one, or 0 if it has one cell or differs from the second."""
        try:
            counts = [len(row) for row in csv.reader(first, delimiter=separator)]
        except csv.Error:
            return 0
        return counts.count(counts[0]) if counts[0] > 1 and counts[0] == counts[:2][-1] else 0

    alike = {separator: count_alike(separator) for separator in SEPARATORS} if first else {}
    max_count = max(alike.values(), default=0)
    fits = [separator for separator, count in alike.items() if count == max_count] if max_count else [","]
    if len(fits) > 1:
        raise ValueError(
            f"separator: {' and '.join(SEPARATORS[separator] for separator in fits)} both fit; name one of them"
        )
    return fits[0]


def read_decimal(cell: str, comma: bool = False) -> float:
    """Return the number in a cell, or in another text of a person.

    Raises:
        ValueError: The cell is no number. So are digits in groups, such as 1.234,5 and 1_000, and of other scripts.
    """
    text = cell.strip()
    if "_" in text or not text.isascii() or ("," in text and ("." in text or not comma)):  # `float` takes 1_000
        raise ValueError(cell)
    return float(text.replace(",", "."))
