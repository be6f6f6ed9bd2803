"""Result documents: JSON with a kind and a version, written and read in one place.

    {"format": "diffabs tune 1", "scenario": "slip-cured", ...}

Commands write them, and reports, `verify` and the explorer read them. Documents of earlier releases have no `format`;
their readers know them by their keys.
"""

import json
import math
import os
import re
import sys
from typing import Any, NoReturn

from diffabs.core.types import JsonObject
from diffabs.host import files
from diffabs.host.values import format_given

VERSION = 1  # of the documents that this release writes; it reads this version, earlier ones, and documents without any
MAX_DOCUMENT_BYTES = 2**27  # bytes of a document that is read
FORMAT_PATTERN = re.compile(r"diffabs ([a-z -]+) ([0-9]{1,4000})")  # Python reads no integer of more than 4300 digits


class DocumentError(ValueError):
    """A document that is JSON, but that this release cannot read. The message is one line."""


def stamp(kind: str, content: JsonObject) -> JsonObject:
    """Return a document of a kind, such as `tune`, with the version of this release as its first entry.

    Args:
        kind: Small letters, blanks and hyphens.
        content: Values of the document.
    """
    return {"format": f"diffabs {kind} {VERSION}", **content}


def kind_of(content: object) -> str:
    """Return the kind of a document; empty without a format of this package.

    Raises:
        DocumentError: The document is of a version that this release does not read.
    """
    stated = content.get("format") if isinstance(content, dict) else None
    match = FORMAT_PATTERN.fullmatch(stated) if isinstance(stated, str) else None
    if match is None:
        return ""
    version = int(match[2])
    if not 1 <= version <= VERSION:
        raise other_release_error(stated, version, VERSION)
    return match[1]


def other_release_error(stated: object, version: float, needed: int) -> DocumentError:
    """Return the error for a file whose `format` states a version that this release does not read.

    Args:
        stated: Value of `format`.
        version: Version in it.
        needed: Version that this release reads.
    """
    age = "a newer" if version > needed else "an older"
    return DocumentError(f"format = {format_given(stated)} was written by {age} diffabs; version {needed} is needed")


def format_document(content: object, indent: int | None = 2) -> str:
    """Return the JSON text of a document; a number without a form in JSON becomes null.

    Args:
        content: Values of the document.
        indent: Blanks before each level; None for one line.
    """
    try:
        return json.dumps(content, indent=indent, allow_nan=False)
    except ValueError:  # rare, so that a long document of finite numbers is not copied
        return json.dumps(replace_infinite(content), indent=indent, allow_nan=False)


def replace_infinite(value: object) -> object:
    """Return values with null in place of NaN and infinity, which JSON lacks."""
    if isinstance(value, dict):
        return {str(key): replace_infinite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [replace_infinite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def read_document(path: str | os.PathLike[str], max_bytes: int = MAX_DOCUMENT_BYTES, *, exact: bool = False) -> Any:
    """Return the values of a file.

    Args:
        path: File of at most `max_bytes` bytes.
        exact: Whether every number is a finite double and every name in a table occurs once, as in certificates.

    Raises:
        OSError: The file cannot be read.
        DocumentError: It is of another version, or has an integer beyond the range of a float.
        ValueError: It is too large, no JSON in UTF-8, or nested too deeply.
    """
    return parse_document(files.read_content(path, max_bytes), exact=exact)


def parse_document(raw: bytes | str, *, exact: bool = False) -> Any:
    """Return the values of a text; see `read_document`."""
    try:
        if exact:
            # Integers become floats: a long integer costs no time.
            hooks = {"parse_int": float, "parse_constant": _refuse_constant, "object_pairs_hook": _read_unique_names}
            return json.loads(raw, **hooks)
        content = json.loads(raw, parse_int=_read_integer)
    except RecursionError:
        raise ValueError("nested too deeply") from None
    kind_of(content)
    return content


def _read_integer(text: str) -> int:
    """Return a whole number of JSON. Raises DocumentError for a number beyond the range of a float."""
    value = int(text)
    if abs(value) > sys.float_info.max:
        raise DocumentError(f"a whole number of {len(text.lstrip('-'))} digits is too large")
    return value


def _refuse_constant(word: str) -> NoReturn:
    raise ValueError(f"{word} is not a finite number")


def _read_unique_names(pairs: list[tuple[str, Any]]) -> JsonObject:
    members = dict(pairs)
    if len(members) != len(pairs):
        # json keeps the last of two equal names; another reader may keep the first and see another claim
        raise ValueError(f"a name comes twice among {', '.join(name for name, _ in pairs)[:200]}")
    return members
