"""Contents of a report's section: plain data for the template."""

import base64
import dataclasses
import math
import pathlib
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

from diffabs.core.summary import round_for_table
from diffabs.core.types import Params, PyTree, Scalar, Table
from diffabs.host import files
from diffabs.host.values import make_printable
from diffabs.output.report.documents import is_within

IMAGES = {".png": "image/png", ".svg": "image/svg+xml"}
LARGEST_IMAGE = 2**25  # bytes
MAX_SHOWN_ENTRIES = 8  # of a list in a cell
VERDICT_NAMES: dict[bool | None, str] = {True: "proved", False: "disproved", None: "undecided"}


class ShownNumber(NamedTuple):
    """A number as a reader sees it, and with all its digits."""

    shown: str
    exact: str


class ReportTable(NamedTuple):
    """A table; cells are texts, numbers, lists of numbers, truth values, or None for an empty cell."""

    title: str
    headings: Sequence[str]
    rows: Sequence[Sequence[PyTree]]
    note: str = ""


class Figure(NamedTuple):
    """A picture with its caption.

    Attributes:
        caption: Caption.
        address: Image as a data URL; empty for a drawn one.
        drawn: SVG that this package drew; empty for an embedded image.
    """

    caption: str
    address: str = ""
    drawn: str = ""


class ReportVerdict(NamedTuple):
    """A verdict in one word, and its sentence."""

    word: str
    sentence: str


@dataclasses.dataclass
class Section:
    """A result with its question and its origin.

    Attributes:
        title: Heading.
        question: Question that the result answers.
        answer: Sentences of the answer.
        verdicts: Verdicts on requirements or claims.
        model: Tables of the parts and parameters.
        model_note: Sentence on the model.
        figures: Pictures.
        figures_note: Sentence in place of missing pictures.
        tables: Tables of the result.
        certificate: Verdicts of a proof.
        certificate_tables: Numbers of a proof.
        notes: Further sentences.
        provenance: Names and values: date, commit, machine, versions, seeds.
        command: Command that made the document, as the document says.
        again: Commands about the result, which this package writes.
    """

    title: str
    question: str
    answer: list[str] = dataclasses.field(default_factory=list)
    verdicts: list[ReportVerdict] = dataclasses.field(default_factory=list)
    model: list[ReportTable] = dataclasses.field(default_factory=list)
    model_note: str = ""
    figures: list[Figure] = dataclasses.field(default_factory=list)
    figures_note: str = ""
    tables: list[ReportTable] = dataclasses.field(default_factory=list)
    certificate: list[ReportVerdict] = dataclasses.field(default_factory=list)
    certificate_tables: list[ReportTable] = dataclasses.field(default_factory=list)
    notes: list[str] = dataclasses.field(default_factory=list)
    provenance: list[tuple[str, PyTree]] = dataclasses.field(default_factory=list)
    command: str = ""
    again: list[str] = dataclasses.field(default_factory=list)


def shown_numbers(value: Scalar) -> list[ShownNumber | str]:
    """Return the texts and numbers that a cell shows.

    A longer list than `MAX_SHOWN_ENTRIES` shows its first entries and its length. Nested lists are flattened.
    """
    if value is None:
        return [""]
    if isinstance(value, bool):
        return ["yes" if value else "no"]
    if isinstance(value, int):
        return [ShownNumber(f"{value:,}" if abs(value) >= 10_000 else str(value), str(value))]
    if isinstance(value, float):
        return [ShownNumber(round_for_table(value) if math.isfinite(value) else str(value), repr(value))]
    if isinstance(value, list | tuple):
        shown = [part for entry in value[:MAX_SHOWN_ENTRIES] for part in shown_numbers(entry)]
        return [*shown, *([f"... ({len(value)})"] if len(value) > MAX_SHOWN_ENTRIES else [])]
    return [str(value)]


def embed_image(path: pathlib.Path, folder: pathlib.Path, caption: str = "") -> Figure | None:
    """Return a picture with its bytes as a data URL; None for an unreadable file, other types, and outside of `folder`.

    The file ends in .png or .svg and has at most `LARGEST_IMAGE` bytes.
    """
    kind = IMAGES.get(path.suffix.lower()) if is_within(path, folder) else None
    try:
        data = files.read_content(path, LARGEST_IMAGE + 1) if kind else b""
    except (OSError, ValueError):
        return None
    if not data or len(data) > LARGEST_IMAGE:
        return None
    text = base64.b64encode(data).decode()
    return Figure(caption or path.stem.replace("_", " "), f"data:{kind};base64,{text}")


def embed_named(folder: pathlib.Path, named: str | None, caption: str) -> Figure | None:
    """Return the picture that a document names if it is in the document's folder, else None.

    Args:
        named: Path of the picture in the document, of which only the name need be right; None without one.
    """
    if not named:
        return None
    places = (folder / pathlib.PurePath(named).name, folder / named)
    return next((figure for path in places if (figure := embed_image(path, folder, caption))), None)


def describe_missing(figures: Sequence[Figure], named: str | None) -> str:
    """Return the sentence in place of a picture that a document names and that is not among the figures."""
    if not named or any(figure.address for figure in figures):
        return ""
    return f"Not shown: {make_printable(named)} is not in the folder of the document."


def model_tables(model: Table | None) -> list[ReportTable]:
    """Return tables of parts, parameters and solver."""
    if not model:
        return []
    more = {path: format_pairs({**about, "type": None}) for path, about in model["parts"].items()}
    also = any(more.values())
    parts = [[path, about["type"], *([more[path]] if also else [])] for path, about in model["parts"].items()]
    rows = [[path, row["value"], table_unit(row["unit"])] for path, row in model["parameters"].items()]
    solver = [[name, value] for name, value in (model.get("solver") or {}).items()]
    return [
        ReportTable("Parts", ("part", "type", *(["also"] if also else [])), parts),
        ReportTable("Parameters", ("parameter", "value", "unit"), rows, "in SI"),
        *([ReportTable("Integration", ("setting", "value"), solver)] if solver else []),
    ]


def table_unit(text: str | None) -> str:
    """Return a unit for a table: "1" for a number without unit, empty for None."""
    return "" if text is None else "1" if text == "" else text


def describe_origin(content: Table, **more: Any) -> list[tuple[str, PyTree]]:
    """Return the origin of a document as rows of name and value: date, commit, machine, versions and `more`."""
    origin = {name: value for name, value in (content.get("made") or {}).items() if name != "command"}
    versions = {f"version of {name}": value for name, value in (content.get("versions") or {}).items()}
    # Papers and manifests keep part of the origin among the versions.
    for name in ("commit", "machine", "backend"):
        if value := versions.pop(f"version of {name}", None):
            origin.setdefault(name, value)
    rows = {
        "date": "not known: the document does not say",
        **origin,
        **{name: value for name, value in more.items() if value is not None},
        **versions,
    }
    return [
        (name.replace("_", " "), format_pairs(value) if isinstance(value, dict) else value)
        for name, value in rows.items()
    ]


def format_pairs(values: Params) -> str:
    """Return names with their values on one line; values that are None are left out."""
    return ", ".join(f"{name} {value}" for name, value in values.items() if value is not None)


def format_known(value: float | None, digits: int = 6) -> str:
    """Return a number with so many digits, "not known" for None, which stands for NaN and infinity in JSON."""
    return "not known" if value is None else f"{value:.{digits}g}"


def join_words(words: Iterable[PyTree]) -> str:
    """Return words joined by commas and "and"; "nothing" without words."""
    words = list(map(str, words))
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} and {words[-1]}" if words else "nothing"
