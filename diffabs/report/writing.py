"""Sections as one HTML file: no script, nothing that is fetched from elsewhere."""

import importlib.resources
import pathlib
from collections.abc import Callable, Sequence

from diffabs import __version__
from diffabs.report import experiments, findings, proofs, studies
from diffabs.report.documents import Document, ReportError
from diffabs.report.page import Section, numbers

MARK = b'<meta name="generator" content="diffabs report'  # what a report begins with
BEGINNING = 1024  # bytes in which it is
SECTIONS: dict[str, Callable[[Document], Section]] = {
    "reproduce": experiments.paper,
    "sweep": studies.sweep,
    "rare": studies.rare,
    "tune": findings.tune,
    "identify": findings.identify,
    "design": proofs.design,
    "certificate": proofs.certificate,
}


def report(found: Sequence[Document], title: str = "") -> str:
    """Return a report of these documents as HTML, a section each.

    title: of the whole; by default that of the only section
    Raises:
        ReportError: a document lacks what its kind has.
    """
    import jinja2

    sections = [_section(one) for one in found]
    text = (importlib.resources.files("diffabs.report") / "report.html.j2").read_text(encoding="utf-8")
    environment = jinja2.Environment(
        autoescape=True, trim_blocks=True, lstrip_blocks=True, undefined=jinja2.StrictUndefined
    )
    environment.filters["numbers"] = numbers
    whole = title or (sections[0].title if len(sections) == 1 else f"{len(sections)} results")
    return environment.from_string(text).render(title=whole, sections=sections, version=__version__)


def _section(document: Document) -> Section:
    try:
        return SECTIONS[document.kind](document)
    except (KeyError, IndexError, TypeError, AttributeError, ValueError, OSError) as error:
        said = " ".join(f"{type(error).__name__} {error}".split())
        raise ReportError(f"{document.path}: is no whole document of {document.kind}: {said}") from None


def ours(path: pathlib.Path) -> bool:
    """Return whether a file is a report of this package, which another may replace."""
    with path.open("rb") as file:
        return MARK in file.read(BEGINNING)
