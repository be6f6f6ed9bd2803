"""Result documents: kind, version, numbers that JSON lacks, and texts that are refused."""

import json
import math
import pathlib

import pytest
from mutants import killed_by

from diffabs.core.types import JsonObject
from diffabs.host.documents import (
    DocumentError,
    format_document,
    kind_of,
    parse_document,
    read_document,
    replace_infinite,
    stamp,
)
from diffabs.output.report import find_documents


@killed_by("host.documents", "if not 1 <= version <= VERSION:", "if version > VERSION:")
@killed_by("host.documents", "if not 1 <= version <= VERSION:", "if version < 1:")
def test_a_document_has_a_kind_and_a_version(tmp_path: pathlib.Path) -> None:
    document = stamp("tune", {"free": {}})
    assert document == {"format": "diffabs tune 1", "free": {}}
    (tmp_path / "x.json").write_text(format_document(document))
    assert kind_of(read_document(tmp_path / "x.json")) == "tune"
    for version, age in ((2, "a newer"), (10**11, "a newer"), (10**3999, "a newer"), (0, "an older")):
        with pytest.raises(DocumentError, match=f"^format = .* was written by {age} diffabs; version 1 is needed$"):
            parse_document(f'{{"format": "diffabs tune {version}"}}')


@pytest.mark.parametrize("content", [{}, [], 3, {"format": 3}, {"format": "diffabs certificate"}, {"format": "tune 1"}])
def test_a_text_of_others_has_no_kind(content: object) -> None:
    assert kind_of(content) == ""


@killed_by("output.report.documents", 'content.get("format", CERTIFICATE_FORMAT) == CERTIFICATE_FORMAT or ', "")
@pytest.mark.parametrize("form", [{}, {"format": "diffabs tune 1"}])
def test_documents_of_earlier_releases_have_no_version(form: JsonObject, tmp_path: pathlib.Path) -> None:
    (tmp_path / "x.json").write_text(json.dumps({**form, "free": {}, "history": [], "constraints": []}))
    (document,) = find_documents(tmp_path)
    assert document.kind == "tune"


@killed_by("host.documents", "not math.isfinite(value) else value", "math.isnan(value) else value")
def test_numbers_that_json_lacks_become_null() -> None:
    assert (
        format_document({"a": (math.inf, 1.5, math.nan), 2: -math.inf}, None) == '{"a": [null, 1.5, null], "2": null}'
    )
    assert replace_infinite([1, "x", True]) == [1, "x", True]


@killed_by("host.documents", '"object_pairs_hook": _read_unique_names', "")
@killed_by("host.documents", '"parse_constant": _refuse_constant, ', "")
@pytest.mark.parametrize(
    ("text", "words"),
    [('{"a": 1, "a": 2}', "a name comes twice among a, a"), ('{"a": NaN}', "NaN is not a finite number")],
)
def test_an_exact_document_says_one_thing(text: str, words: str) -> None:
    parse_document(text)
    with pytest.raises(ValueError, match=words):
        parse_document(text, exact=True)


@killed_by("host.documents", "    except RecursionError:", "    except KeyError:")
@killed_by("host.documents", "abs(value) > sys.float_info.max", "False")
@pytest.mark.parametrize(("text", "words"), [("[" * 100_000, "nested too deeply"), ("9" * 400, "of 400 digits")])
def test_a_text_that_no_reader_can_hold_is_refused(text: str, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        parse_document(text)
