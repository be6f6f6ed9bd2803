"""Short form of a reproduction for the terminal: a table, counts of numbers that agree, and verdicts on claims.

Everything is computed from the summary, so each sentence matches its number.

    a published number is reproduced if ours rounds to its printed digits
    an independent number is reproduced if ours differs by at most 0.1 %, or rounds to the decimals given
    a claim is refuted if the number that would support it contradicts it
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from decimal import Decimal
from typing import Any, NamedTuple

from diffabs.core.types import Table

RELATIVE_TOLERANCE = 1e-3  # of independent numbers
Row = Mapping[str, Any]


class Refuted(NamedTuple):
    """A claim of a paper, and the evidence against it.

    Attributes:
        claim: The claim.
        because: Reason for the refutation, a format string of the numbers of `evidence`.
        evidence: (name, quantity) of the rows with these numbers.
        false: Function of these numbers that returns whether they contradict the claim.
    """

    claim: str
    because: str
    evidence: Sequence[tuple[str, str]]
    false: Callable[..., bool]


class Digest(NamedTuple):
    """Short form of a reproduction.

    Attributes:
        title: Title.
        headings: Headings of the table.
        lines: Lines of the table.
        agreement: Sentences on the numbers that agree.
        verdicts: Pairs of a word ("refuted" or "holds") and a sentence, one pair for each claim.
        figures: Number of figures.
    """

    title: str
    headings: Sequence[str]
    lines: Sequence[Sequence[str]]
    agreement: Sequence[str]
    verdicts: Sequence[tuple[str, str]]
    figures: int


def digest(
    summary: Table,
    headings: Sequence[str],
    lines: Sequence[Sequence[str]],
    claims: Iterable[Refuted],
    printed: tuple[str, Sequence[Row]],
    independent: Sequence[Row],
) -> Digest:
    """Return the digest of a paper from its table and the parts that all papers share.

    Args:
        printed: Place of the published numbers in the paper, and their rows.
    """
    return Digest(
        title=summary["title"].split(" (")[0],
        headings=headings,
        lines=lines,
        agreement=[text for text in (count_published(*printed), count_computed(independent)) if text],
        verdicts=[judgement for claim in claims if (judgement := verdict(summary["rows"], claim))],
        figures=len(summary["figures"]),
    )


def our_number(rows: Iterable[Row], name: str, quantity: str) -> float | None:
    """Return our number in a row of the record; None if there is no such row."""
    return next((row["ours"] for row in rows if (row["name"], row["quantity"]) == (name, quantity)), None)


def is_reproduced(row: Row) -> bool:
    """Return whether our number rounds to the printed digits; `matches`, if the row has it, decides."""
    return row["matches"] if "matches" in row else rounds_to(row["ours"], row["published"])


def rounds_to(number: float | str, printed: float) -> bool:
    """Return whether a number rounds to another number at the other's decimals; a word such as "never" does not."""
    return not isinstance(number, str) and round(number, decimals(printed)) == printed


def decimals(printed: float) -> int:
    """Return the number of decimals of a number as written."""
    exponent = Decimal(repr(printed)).normalize().as_tuple().exponent
    return max(0, -int(exponent))


def is_close(row: Row) -> bool:
    """Return whether our number agrees with the independent number.

    Rounding counts only if the independent number has decimals; without decimals, 0.4 would agree with 0.
    """
    reference, gap = row["reference"], row["difference"]
    if gap is None:  # beside a word, such as "never"
        return row["ours"] == reference
    return abs(gap) <= RELATIVE_TOLERANCE * abs(reference) or (
        decimals(reference) > 0 and rounds_to(row["ours"], reference)
    )


def count_published(where: str, rows: Sequence[Row]) -> str:
    """Return a sentence on the share of published numbers that are reproduced, the exceptions, and the rule."""
    if not rows:
        return f"The paper prints no number to compare with: {where}."
    return _share(rows, is_reproduced, f"published numbers reproduced ({where}: to the printed digit)")


def count_computed(rows: Sequence[Row]) -> str:
    """Return a sentence on the share of independent numbers that are reproduced, and the exceptions."""
    return _share(rows, is_close, "independent numbers reproduced (to 0.1 % or the decimals given)")


def _share(rows: Sequence[Row], agrees: Callable[[Row], bool], words: str) -> str:
    missed = [row for row in rows if not agrees(row)]
    ours = [row["ours"] if isinstance(row["ours"], str) else f"{row['ours']:.5g}" for row in missed]
    exceptions = "; ".join(f"{row['name']}, {row['quantity']}: {x}" for row, x in zip(missed, ours, strict=True))
    return f"{len(rows) - len(missed)} of {len(rows)} {words}{f', not {exceptions}' if missed else ''}." if rows else ""


def verdict(rows: Sequence[Row], claim: Refuted) -> tuple[str, str] | None:
    """Return "refuted" or "holds", and a sentence of the claim with its numbers; None if the record lacks a number."""
    values = [our_number(rows, *place) for place in claim.evidence]
    if None in values:
        return None
    word = "refuted" if claim.false(*values) else "holds"
    return word, f"{claim.claim}: {claim.because.format(*values)}"
