"""Sections as one HTML file, which fetches nothing and contains no script."""

import contextlib
import importlib.resources
import pathlib
from collections.abc import Callable, Iterator, Sequence

from diffabs import __version__
from diffabs.host import files
from diffabs.host.documents import DocumentError
from diffabs.host.values import ScenarioError, make_printable
from diffabs.output.report import assessments, experiments, findings, proofs, studies
from diffabs.output.report.documents import Document, ReportError, check_tables, find_documents
from diffabs.output.report.page import Section, shown_numbers

MARK = b'<meta name="generator" content="diffabs report'  # near the start of every report
MARK_WITHIN_BYTES = 1024  # length of the start of a file with the mark
SECTION_BY_KIND: dict[str, Callable[[Document], Section]] = {
    "reproduce": experiments.paper_section,
    "sweep": studies.sweep_section,
    "rare": studies.rare_section,
    "tune": findings.tuning_section,
    "identify": findings.identification_section,
    "prove": proofs.box_section,
    "design": proofs.design_section,
    "assess": assessments.assessment_section,
    "certificate": proofs.certificate_section,
}
COMPARISON_BY_KIND: dict[str, Callable[[Sequence[Document]], Section]] = {"assess": assessments.comparison_section}


def build_report(documents: Sequence[Document], title: str = "") -> str:
    """Return a report of documents as HTML, with one section each. Several of a kind are compared before, if possible.

    Args:
        documents: Documents of the commands.
        title: Title of the report; by default the title of the only section, or the number of results.

    Raises:
        ReportError: A document, or a file that belongs to it, cannot be read.
    """
    import jinja2

    # Each first: its error names the document that cannot be read.
    sections = [_section(document) for document in documents]
    sections = [*_compare(documents), *sections]
    text = (importlib.resources.files("diffabs.output.report") / "report.html.j2").read_text(encoding="utf-8")
    environment = jinja2.Environment(
        autoescape=True, trim_blocks=True, lstrip_blocks=True, undefined=jinja2.StrictUndefined
    )
    environment.filters |= {"numbers": shown_numbers, "printable": make_printable}
    whole = title or (sections[0].title if len(sections) == 1 else f"{len(documents)} results")
    try:
        return environment.from_string(text).render(title=whole, sections=sections, version=__version__)
    except RecursionError:  # lists in lists
        raise ReportError(
            f"{', '.join(str(document.path) for document in documents)}: values are nested too deeply"
        ) from None


def write_report(sources: Sequence[pathlib.Path], target: pathlib.Path, title: str = "") -> None:
    """Write the report of all documents in folders or files as one HTML file, whole or not at all.

    Args:
        sources: Folders or files, as for `find_documents`.
        target: File to write.
        title: Title of the report, as for `build_report`.

    Raises:
        ReportError: A source has no document, or one cannot be read.
        OSError: The file cannot be written.
    """
    text = build_report([document for source in sources for document in find_documents(source)], title)
    # Half of a surrogate pair (in JSON, in a file name) has no UTF-8; readers of HTML show its reference as U+FFFD.
    files.write_file(target, text.encode(errors="xmlcharrefreplace"))


def _compare(documents: Sequence[Document]) -> Iterator[Section]:
    """Yield a section for each kind of which there are several documents that can be compared."""
    for kind, compare in COMPARISON_BY_KIND.items():
        alike = [document for document in documents if document.kind == kind]
        if len(alike) > 1:
            with _naming_unreadable(*alike):
                yield compare(alike)


def _section(document: Document) -> Section:
    with _naming_unreadable(document):
        check_tables(document)
        return SECTION_BY_KIND[document.kind](document)


@contextlib.contextmanager
def _naming_unreadable(*documents: Document) -> Iterator[None]:
    """Raise ReportError with the files of documents of one kind for an error in the `with` block."""
    try:
        yield
        return
    except (DocumentError, ScenarioError) as error:
        message = str(error)
    except (TypeError, AttributeError):
        message = "a value in it is of the wrong type"
    except (KeyError, IndexError, ValueError, OSError) as error:
        message = " ".join(f"{type(error).__name__} {error}".split())
    paths = ", ".join(str(document.path) for document in documents)
    raise ReportError(f"{paths}: cannot be read as a document of {documents[0].kind}: {message}")


def is_report(path: pathlib.Path) -> bool:
    """Return True for a file that is a report of diffabs, which another report may replace.

    Args:
        path: File to read.

    Raises:
        OSError: The file cannot be read.
    """
    with path.open("rb") as file:
        return MARK in file.read(MARK_WITHIN_BYTES)
