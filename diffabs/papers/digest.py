"""What a person is shown of a reproduction: a table that fits a terminal, how many numbers agree, what is refuted.

All of it is read off the summary, so that no sentence outlives the number it rests on:

    a published number is reproduced if ours rounds to its printed digits
    an independent one if ours differs by no more than 0.1 %, or rounds to the decimals given
    a claim is refuted if the number that would bear it out does not
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from decimal import Decimal
from typing import Any, NamedTuple

RELATIVE_TOLERANCE = 1e-3  # relative
Row = Mapping[str, Any]


class Refuted(NamedTuple):
    """A claim of a paper, and why it is false: `because` with the numbers of `evidence`, (name, quantity) of rows, for
    which `false` says whether they contradict the claim."""

    claim: str
    because: str
    evidence: Sequence[tuple[str, str]]
    false: Callable[..., bool]


class Digest(NamedTuple):
    """A title, a table of headings and lines, sentences on agreement, claims with verdicts, and how many figures."""

    title: str
    headings: Sequence[str]
    lines: Sequence[Sequence[str]]
    agreement: Sequence[str]
    verdicts: Sequence[tuple[str, str]]
    figures: int


def digest(
    summary: Mapping[str, Any],
    headings: Sequence[str],
    lines: Sequence[Sequence[str]],
    claims: Iterable[Refuted],
    printed: tuple[str, Sequence[Row]],
    independent: Sequence[Row],
) -> Digest:
    """What all papers have in common. `printed`: where the published numbers stand, and their rows."""
    return Digest(
        title=summary["title"].split(" (")[0],
        headings=headings,
        lines=lines,
        agreement=[text for text in (count_published(*printed), count_computed(independent)) if text],
        verdicts=[found for claim in claims if (found := verdict(summary["rows"], claim))],
        figures=len(summary["figures"]),
    )


def our_number(rows: Iterable[Row], name: str, quantity: str) -> float | None:
    """Our number in a row of the record; None where there is no such row."""
    return next((row["ours"] for row in rows if (row["name"], row["quantity"]) == (name, quantity)), None)


def is_reproduced(row: Row) -> bool:
    """Whether ours rounds to the printed digits: those that the row was judged by, or those of the number itself."""
    return row["matches"] if "matches" in row else rounds_to(row["ours"], row["published"])


def rounds_to(number: float, given: float) -> bool:
    """Whether a number rounds to one that is given with so many decimals."""
    return round(number, decimals(given)) == given


def decimals(given: float) -> int:
    """How many a number has as it is written."""
    exponent = Decimal(repr(given)).normalize().as_tuple().exponent
    return max(0, -int(exponent))


def is_close(row: Row) -> bool:
    """Whether ours agrees with an independent number. Without decimals, rounding would let 0.4 be 0."""
    known, gap = row["reference"], abs(row["difference"])
    return gap <= RELATIVE_TOLERANCE * abs(known) or (decimals(known) > 0 and rounds_to(row["ours"], known))


def count_published(where: str, rows: Sequence[Row]) -> str:
    """How many of these published numbers are reproduced, which are not, and by what rule."""
    if not rows:
        return f"The paper prints no number to compare with: {where}."
    return _share(rows, is_reproduced, f"published numbers reproduced ({where}: to the printed digit)")


def count_computed(rows: Sequence[Row]) -> str:
    """How many of these independent numbers are reproduced, and which are not."""
    return _share(rows, is_close, "independent numbers reproduced (to 0.1 % or the decimals given)")


def _share(rows: Sequence[Row], agrees: Callable[[Row], bool], words: str) -> str:
    missed = [row for row in rows if not agrees(row)]
    which = "; ".join(f"{row['name']}, {row['quantity']}: {row['ours']:.5g}" for row in missed)
    return f"{len(rows) - len(missed)} of {len(rows)} {words}{f', not {which}' if missed else ''}." if rows else ""


def verdict(rows: Sequence[Row], claim: Refuted) -> tuple[str, str] | None:
    """ "refuted" or "holds", and the claim with the numbers why; None where the record does not have them."""
    values = [our_number(rows, *place) for place in claim.evidence]
    if None in values:
        return None
    word = "refuted" if claim.false(*values) else "holds"
    return word, f"{claim.claim}: {claim.because.format(*values)}"
