"""Print the table of published anti-lock simulations, or compare it with numbers of yours.

    python read_table.py [NUMBERS.json]

NUMBERS.json maps "source: quantity" to your number in the unit of the table. It needs Python only.
"""

import json
import pathlib
import sys

TABLE = pathlib.Path(__file__).parent / "table.json"


def compare(numbers):
    """Return lines (source, quantity, unit, printed, ours, yours, whether yours is within the tolerance of ours)."""
    lines = []
    for row in json.loads(TABLE.read_text(encoding="utf-8"))["rows"]:
        yours = numbers.get(f"{row['source']}: {row['quantity']}")
        comparable = yours is not None and row["ours"] is not None and row["tolerance"] is not None
        agrees = abs(yours - row["ours"]) <= max(row["tolerance"], 1e-3 * abs(row["ours"])) if comparable else None
        lines.append((row["source"], row["quantity"], row["unit"], row["printed"], row["ours"], yours, agrees))
    return lines


if __name__ == "__main__":
    for line in compare(json.loads(pathlib.Path(sys.argv[1]).read_text()) if sys.argv[1:] else {}):
        print(*("" if value is None else value for value in line), sep="\t")
