"""The documents that commands write, recognised by what is in them."""

import errno
import json
import os
import pathlib
import sys
from collections.abc import Iterator
from typing import Any, NamedTuple

from diffabs.core import files
from diffabs.papers import PAPERS

MAX_DOCUMENT_BYTES = 2**27  # bytes of a document
SUMMARY, MANIFEST = "summary.json", "manifest.json"
KEYS_BY_KIND = {  # the keys that only this kind has
    "reproduce": ("paper", "rows", "figures"),
    "sweep": ("digest", "sensitivity", "failures"),
    "rare": ("levels", "probability", "bound"),
    "tune": ("free", "history", "constraints"),
    "identify": ("values", "residuals", "chi2"),
    "design": ("gain", "states", "over", "poles"),
    "certificate": ("format", "system", "claims"),
}
READABLE_DOCUMENTS = "reproduce, sweep, rare, tune, identify, design and certify write"


class ReportError(ValueError):
    """What no report can be made of, and why, in one line."""


class Document(NamedTuple):
    """A document: of which kind, its content, and the file that it was read from."""

    kind: str
    content: dict[str, Any]
    path: pathlib.Path

    @property
    def folder(self) -> pathlib.Path:
        """Where its figures are."""
        return self.path.parent


def find_documents(source: pathlib.Path) -> list[Document]:
    """Return the documents of a file, or of a folder: those in it, and the results in folders of their own below it.

    Raises:
        ReportError: there is none.
        OSError: a file cannot be read.
    """
    if not source.exists():
        raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), str(source))
    if not source.is_dir():
        return list(_documents_of_file(source, named=True))
    below = sorted(source.glob(f"*/{SUMMARY}"), key=_sort_key)
    found = {one.path: one for path in [*sorted(source.glob("*.json")), *below] for one in _documents_of_file(path)}
    if found:
        return list(found.values())
    if (source / MANIFEST).is_file():
        raise ReportError(f"{source}: the sweep has no {SUMMARY} yet; diffabs sweep ... --resume goes on with it")
    raise ReportError(f"{source}: holds nothing that {READABLE_DOCUMENTS}")


def _sort_key(path: pathlib.Path) -> tuple[int, str]:
    """The papers come first, in the order in which they are reproduced."""
    name = path.parent.name
    return [*PAPERS, name].index(name), name


def _documents_of_file(path: pathlib.Path, named: bool = False) -> Iterator[Document]:
    """The documents of a file; where a person has named it there must be one."""
    try:
        content = json.loads(files.read_content(path, MAX_DOCUMENT_BYTES), parse_int=_read_integer)
    except OverflowError as error:
        raise ReportError(f"{path}: {error}") from None
    except (ValueError, RecursionError):
        if named:
            raise ReportError(f"{path}: is no JSON document that {READABLE_DOCUMENTS}") from None
        return
    found = list(_inside(content, path))
    if named and not found:
        raise ReportError(f"{path}: is no document that {READABLE_DOCUMENTS}")
    yield from found


def _read_integer(text: str) -> int:
    """Return a whole number of JSON. Raises OverflowError for one that no float can be."""
    value = int(text)
    if abs(value) > sys.float_info.max:
        raise OverflowError(f"a whole number of {len(text.lstrip('-'))} digits is too large")
    return value


def _inside(content: Any, path: pathlib.Path) -> Iterator[Document]:
    """A document, or those of all papers in what `reproduce --json` prints."""
    if not isinstance(content, dict):
        return
    if isinstance(content.get("papers"), dict) and isinstance(content.get("out"), str):
        for name, paper in content["papers"].items():
            yield from _inside(paper, pathlib.Path(content["out"]) / name / SUMMARY)
        return
    for kind, keys in KEYS_BY_KIND.items():
        if all(key in content for key in keys):
            yield Document(kind, content, _home(kind, content, path))
            return


def _home(kind: str, content: dict[str, Any], path: pathlib.Path) -> pathlib.Path:
    """Where a document belongs: what `sweep --json` prints, beside the sweep's manifest."""
    if kind == "sweep" and not (path.parent / MANIFEST).exists() and isinstance(content.get("out"), str):
        return pathlib.Path(content["out"]) / SUMMARY
    return path
