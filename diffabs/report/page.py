"""What a section of a report consists of: plain data, which a template lays out."""

import base64
import dataclasses
import json
import math
import pathlib
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

from diffabs.core import files, pictures
from diffabs.core.summary import round_for_table

IMAGES = {".png": "image/png", ".svg": "image/svg+xml"}
LARGEST_IMAGE = 2**25  # bytes
LARGEST_AXES = 2**21  # characters of the numbers that a picture shows
ENDS = ("box", "x", "y", "log")  # numbers of axes
MAX_SHOWN_ENTRIES = 8  # entries of a list
UNKNOWN_ORIGIN = "not known: the document does not say"
VERDICT_NAMES = {True: "proved", False: "disproved", None: "undecided"}


class ShownNumber(NamedTuple):
    """A number as a reader sees it, and all its digits."""

    shown: str
    exact: str


class ReportTable(NamedTuple):
    """Cells are texts, numbers, lists of numbers, truth values, or None for nothing."""

    title: str
    headings: Sequence[str]
    rows: Sequence[Sequence[Any]]
    note: str = ""


class Figure(NamedTuple):
    """An image, by the address of its own bytes or as SVG that this package has drawn, and what it is of; `axes` are
    the numbers that it shows, as JSON of `diffabs.plot.shown`, "" where it does not say."""

    caption: str
    address: str = ""
    drawn: str = ""
    axes: str = ""


class ReportVerdict(NamedTuple):
    """A word, and the sentence it is about."""

    word: str
    sentence: str


@dataclasses.dataclass
class Section:
    """A result: what was asked, what came out, the model, figures, tables, what is proved, notes, where it comes from
    and the commands that compute it again."""

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
    provenance: list[tuple[str, Any]] = dataclasses.field(default_factory=list)
    again: list[str] = dataclasses.field(default_factory=list)


def shown_numbers(value: Any) -> list[ShownNumber | str]:
    """Return what a cell shows: a text, or numbers; of a long list, or one of lists, the first entries."""
    if value is None:
        return [""]
    if isinstance(value, bool):
        return ["yes" if value else "no"]
    if isinstance(value, int):
        return [ShownNumber(f"{value:,}" if abs(value) >= 10_000 else str(value), str(value))]
    if isinstance(value, float):
        return [ShownNumber(round_for_table(value) if math.isfinite(value) else str(value), repr(value))]
    if isinstance(value, list | tuple):
        shown = [one for entry in value[:MAX_SHOWN_ENTRIES] for one in shown_numbers(entry)]
        return [*shown, *([f"... ({len(value)})"] if len(value) > MAX_SHOWN_ENTRIES else [])]
    return [str(value)]


def embed_image(path: pathlib.Path, caption: str = "") -> Figure | None:
    """Return a picture with its bytes in it; None for a file that is none, or cannot be read."""
    kind = IMAGES.get(path.suffix.lower())
    try:
        data = files.read_content(path, LARGEST_IMAGE + 1) if kind else b""
    except (OSError, ValueError):
        return None
    if not data or len(data) > LARGEST_IMAGE:
        return None
    data, axes = pictures.without_text(data, pictures.AXES_KEY)
    text = base64.b64encode(data).decode()
    return Figure(caption or path.stem.replace("_", " "), f"data:{kind};base64,{text}", axes=_axes(axes))


def _axes(text: str) -> str:
    """What a picture says of its axes; nothing for what a page could not show."""
    if len(text) > LARGEST_AXES:
        return ""
    try:
        given = json.loads(text or "[]")
        good = [one for one in given if all(map(_is_series, one["series"])) and all(map(_finite, map(one.get, ENDS)))]
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
        return ""
    return json.dumps(good, separators=(",", ":")) if good else ""


def _is_series(one: Any) -> bool:
    return _finite(one["x"]) and _finite(one["y"]) and len(one["x"]) == len(one["y"]) > 0


def _finite(values: Any) -> bool:
    return isinstance(values, list) and all(isinstance(x, int | float) and math.isfinite(x) for x in values)


def model_tables(model: Mapping[str, Any] | None) -> list[ReportTable]:
    """Return the parts and the parameters of `scenario.model`."""
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
    """Return a unit for a table: what has none has the unit 1."""
    return "" if text is None else "1" if text == "" else text


def describe_origin(content: Mapping[str, Any], **more: Any) -> list[tuple[str, Any]]:
    """Return where a document comes from: date, commit, machine, versions, and seeds or other `more`."""
    made = {name: value for name, value in (content.get("made") or {}).items() if name != "command"}
    versions = {f"version of {name}": value for name, value in (content.get("versions") or {}).items()}
    for name in ("commit", "machine", "backend"):  # what older documents have among the versions
        if value := versions.pop(f"version of {name}", None):
            made.setdefault(name, value)
    rows = {
        "date": UNKNOWN_ORIGIN,
        **made,
        **{name: value for name, value in more.items() if value is not None},
        **versions,
    }
    return [
        (name.replace("_", " "), format_pairs(value) if isinstance(value, dict) else value)
        for name, value in rows.items()
    ]


def format_pairs(values: Mapping[str, Any]) -> str:
    """Return names with their values in a line; what is None has none."""
    return ", ".join(f"{name} {value}" for name, value in values.items() if value is not None)


def original_command(content: Mapping[str, Any], otherwise: str = "") -> list[str]:
    """Return the command that a document was made by, or another that does the same; none where none is known."""
    line = (content.get("made") or {}).get("command") or otherwise
    return [str(line)] if line else []


def join_words(words: Iterable[Any]) -> str:
    """Return words in a sentence."""
    words = list(map(str, words))
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} and {words[-1]}" if words else "nothing"
