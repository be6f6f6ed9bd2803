"""The JSON documents of the commands, recognised by their keys."""

import errno
import os
import pathlib
from collections.abc import Iterator, Sequence
from typing import NamedTuple

from diffabs.core.types import JsonObject
from diffabs.host.documents import DocumentError, kind_of, read_document
from diffabs.host.values import ScenarioError, format_given, wrong_kind_error

SUMMARY, MANIFEST = "summary.json", "manifest.json"
KEYS_BY_KIND: dict[str, tuple[str, ...]] = {  # the keys that only this kind has
    "reproduce": ("paper", "rows", "figures"),
    "sweep": ("digest", "sensitivity", "failures"),
    "rare": ("levels", "probability", "bound"),
    "tune": ("free", "history", "constraints"),
    "identify": ("values", "residuals", "chi2"),
    "prove": ("verdict", "refuted_by", "share_left"),
    "design": ("gain", "states", "over", "poles"),
    "assess": ("clauses", "stops", "unfinished"),
    "certificate": ("format", "system", "claims"),
}
MODEL = ("model", "model.parts", "model.parameters")
TABLES_BY_KIND: dict[str, tuple[str, ...]] = {  # the members that are tables, where a document has them
    "reproduce": ("digest", "solver"),
    "sweep": ("failures", "metrics", "sensitivity", "worst", "never", "diverged", "refused"),
    "rare": ("failures",),
    "tune": (*MODEL, "model.metrics", "free", "objective", "metrics", "certificate", "engine", "files"),
    "identify": (*MODEL, "values", "residuals", "data"),
    "prove": (*MODEL, "over", "bounds"),
    "design": (*MODEL, "over", "files"),
    "assess": (*MODEL, "program", "files"),
    "certificate": ("system",),
}
CERTIFICATE_FORMAT = "diffabs certificate"  # a file with another `format` is no document of these
READABLE_DOCUMENTS = "reproduce, sweep, rare, tune, identify, prove --json, design, assess and certify write"


class ReportError(ScenarioError):
    """An error: a source has no document, or a document cannot be read. The message is one line."""


class Document(NamedTuple):
    """A JSON document of a command.

    Attributes:
        kind: Key of `KEYS_BY_KIND`.
        content: Values of the document.
        path: File of the document. A document inside of another has the file where its command writes it.
    """

    kind: str
    content: JsonObject
    path: pathlib.Path

    @property
    def folder(self) -> pathlib.Path:
        """Folder of the document's figures."""
        return self.path.parent


def find_documents(source: pathlib.Path) -> list[Document]:
    """Return the documents in a file, or in a folder and its subfolders of results.

    Args:
        source: File, or folder with `*.json` files and `*/summary.json` below it.

    Raises:
        ReportError: There is no document.
        OSError: A file cannot be read.
    """
    if not source.exists():
        raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), str(source))
    if not source.is_dir():
        return list(_documents_of_file(source, named=True))
    here, below = (sorted(source.glob(pattern)) for pattern in ("*.json", f"*/{SUMMARY}"))
    of_files, of_folders = ([x for path in paths for x in _documents_of_file(path)] for paths in (here, below))
    documents = {document.path: document for document in [*of_files, *sorted(of_folders, key=_sort_key)]}
    if documents:
        return list(documents.values())
    if (source / MANIFEST).is_file():
        raise ReportError(f"{source}: the sweep has no {SUMMARY} yet; diffabs sweep ... --resume completes it")
    raise ReportError(f"{source}: has no document that {READABLE_DOCUMENTS}")


def _sort_key(document: Document) -> tuple[bool, str]:
    """Return a key that puts papers first, in the order of their reproduction."""
    is_paper = document.kind == "reproduce"
    return not is_paper, str(document.content.get("made", {}).get("date", "")) if is_paper else ""


def _documents_of_file(path: pathlib.Path, named: bool = False) -> Iterator[Document]:
    """Yield the documents of a file. Raises ReportError for a `named` file without a document."""
    problem = f"is not a document that {READABLE_DOCUMENTS}"
    try:
        content = read_document(path)
    except DocumentError as error:
        raise ReportError(f"{path}: {error}") from None
    except ValueError:
        content = None
        problem = f"is not a JSON document that {READABLE_DOCUMENTS}" if path.stat().st_size else "is empty"
    documents = list(_inside(content, path))
    if path.name == SUMMARY and (path.parent / MANIFEST).is_file():
        _check_summary(path, documents, problem)
    if named and not documents:
        raise ReportError(f"{path}: {problem}")
    yield from documents


def _check_summary(path: pathlib.Path, documents: Sequence[Document], problem: str) -> None:
    """Raise ReportError for the summary of a sweep that is another document, or none."""
    kinds = [document.kind for document in documents]
    if kinds != ["sweep"]:
        problem = f"is of {' and '.join(kinds)}, and a document of sweep is needed" if kinds else problem
        raise ReportError(f"{path}: {problem}; diffabs sweep ... --resume writes it again")


def check_tables(document: Document) -> None:
    """Raise ReportError for a member of a document that is no table, where its kind has one."""
    for path in ("made", "versions", *TABLES_BY_KIND[document.kind]):
        parent, _, name = path.rpartition(".")
        table = document.content.get(parent, {}) if parent else document.content
        if name in table and not isinstance(table[name], dict):
            raise ReportError(str(wrong_kind_error(path, table[name], "a table")))


def _inside(content: object, path: pathlib.Path) -> Iterator[Document]:
    """Yield a document, or the documents of all papers in the output of `reproduce --json`."""
    if not isinstance(content, dict):
        return
    if isinstance(content.get("papers"), dict) and isinstance(content.get("out"), str):
        for name, paper in content["papers"].items():
            folder = _find_folder(pathlib.PurePath(content["out"], name), path)
            for document in _inside(paper, path):
                yield (
                    document._replace(content={**document.content, "figures": []})
                    if folder is None
                    else (document._replace(path=folder / SUMMARY))
                )
        return
    for kind, keys in KEYS_BY_KIND.items():
        is_stated = content.get("format", CERTIFICATE_FORMAT) == CERTIFICATE_FORMAT or kind_of(content) == kind
        if is_stated and all(key in content for key in keys):
            # The output of `sweep --json` counts as the summary in the sweep's folder: figures and manifest are there.
            if kind == "sweep" and not (path.parent / MANIFEST).exists() and isinstance(content.get("out"), str):
                if (folder := _find_folder(pathlib.PurePath(content["out"]), path)) is None:
                    out = format_given(content["out"])
                    raise ReportError(f"{path}: its sweep {out} is not in the folder of the document; report the sweep")
                path = folder / SUMMARY
            yield Document(kind, content, path)
            return


def _find_folder(out: pathlib.PurePath, path: pathlib.Path) -> pathlib.Path | None:
    """Return the folder `out` that the document in the file `path` names, None unless it is in the file's folder.

    A relative name counts from the folder of the file if there is such a folder, else from the working directory.
    """
    places = (path.parent / out, pathlib.Path(out))
    return next((place for place in places if is_within(place, path.parent) and place.is_dir()), None)


def is_within(path: pathlib.Path, folder: pathlib.Path) -> bool:
    """Return whether a path is in a folder or below, also by its symbolic links: a document may be of somebody else."""
    try:
        return path.resolve().is_relative_to(folder.resolve())
    except (OSError, RuntimeError, ValueError):  # a circle of links, a null character
        return False
