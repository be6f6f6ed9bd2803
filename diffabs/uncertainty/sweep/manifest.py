"""The manifest of a sweep: its study, versions and scenario, with a digest of all of these.

    format      of the folder
    study       everything that decides the results (`Study.table`)
    versions    of the packages that can change a bit of the results
    commit      of diffabs, where it is known
    source      name and text of the scenario
    units       of the parameters that vary and of the metrics, where they are known
    digest      SHA-256 of the rest; a manifest with another digest is refused

Format, study and versions own the chunks: each chunk contains their digest (`seal`).
"""

import dataclasses
import json
import pathlib
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

from diffabs.core.pytree import ParameterSpec
from diffabs.core.types import JsonObject, PyTree, Table
from diffabs.host import documents, files, provenance
from diffabs.host.values import (
    FINITE_SPEC,
    ScenarioError,
    choice_reader,
    format_given,
    range_reader,
    read_as_given,
    read_one,
    read_switch,
    read_table,
    read_text,
    table_field,
    table_reader,
    unknown_name_error,
    whole_reader,
    wrong_kind_error,
)
from diffabs.uncertainty.sweep import variables
from diffabs.uncertainty.sweep.seal import Seal, SweepError, json_digest
from diffabs.uncertainty.sweep.study import DTYPES, FLAG_COLUMNS, RANGES, Study
from diffabs.uncertainty.sweep.variables import Space

MANIFEST_FORMAT = 3
MANIFEST_NAME = "manifest.json"
MAX_MANIFEST_BYTES = 2**30  # bytes
DECISIVE_PACKAGES = (
    "jaxlib",
    "numpy",
    "scipy",
    "pyarrow",
)  # packages, in addition to JAX, that can change a bit of the results
POSITIVE_SECONDS = ParameterSpec("s", low=0.0, open_low=True)
OWNER_KEYS = ("format", "study", "versions")
OLD_MANIFEST_ADVICE = "read its chunks with pandas, or sweep again"


def describe_owner(study: Study) -> JsonObject:
    """Return what a sweep of this process is, {"format", "study", "versions"}; its digest, the owner, is in every
    chunk.
    """
    return {
        "format": MANIFEST_FORMAT,
        "study": study.table(),
        "versions": provenance.describe_platform(*DECISIVE_PACKAGES),
    }


class Seals:
    """The seals of all chunks of the sweep with one manifest.

    Attributes:
        study: Table of the study.
        owner: Digest of the owner.
        count: Number of chunks.
        columns: Names of the columns of a chunk.
    """

    def __init__(self, manifest: Table):
        """Compute from the `manifest` the entries that all seals share."""
        self.study: Table = manifest["study"]
        self.owner: str = json_digest({name: manifest[name] for name in OWNER_KEYS})
        self.count: int = -(-self.study["samples"] // self.study["chunk"])
        varied = variables.read_space(self.study["space"], "study.space").paths
        self.columns: frozenset[str] = frozenset({"sample", *FLAG_COLUMNS, *self.study["objectives"], *varied})

    def of(self, chunk: int) -> Seal:
        """Return the seal of this chunk."""
        start = chunk * self.study["chunk"]
        rows = start, min(start + self.study["chunk"], self.study["samples"])
        return Seal(self.owner, chunk, self.study["seed"], rows, self.columns)


def encode_manifest(manifest: Table) -> bytes:
    """Return the bytes of the manifest's file, with its digest."""
    return json.dumps({**manifest, "digest": json_digest(manifest)}, indent=1).encode()


def read_manifest(folder: pathlib.Path) -> JsonObject:
    """Return the manifest of a folder, without its digest."""
    try:
        raw = files.read_content(pathlib.Path(folder) / MANIFEST_NAME, MAX_MANIFEST_BYTES)
    except (OSError, ValueError) as error:
        why = getattr(error, "strerror", None) or error
        raise SweepError(f"{folder} is no sweep: {MANIFEST_NAME}: {why}") from None
    try:
        return _check_manifest(documents.parse_document(raw))
    except ValueError as error:
        why = " ".join(str(error).split())
        raise SweepError(f"{folder} is no sweep that can be read: {MANIFEST_NAME}: {why}") from None


def _check_manifest(document: object) -> JsonObject:
    if not isinstance(document, dict):
        raise wrong_kind_error("it", document, "a table")
    _check_format(document.get("format"))
    manifest = {name: value for name, value in document.items() if name != "digest"}
    if document.get("digest") != json_digest(manifest):
        raise ValueError("it was changed after it was written: its digest is another one")
    study = read_table(_Manifest, manifest, "", "a manifest").study
    for name in study.failures:
        if name not in study.objectives:
            raise unknown_name_error(f"study.failures.{format_given(name)} is not measured", name, study.objectives)
    study.space.check(study.samples)
    for name in {"sample", *FLAG_COLUMNS, *study.space.paths} & study.objectives.keys():
        raise ScenarioError(f"study.objectives.{name}: another column of the table has this name")
    return manifest


def _check_format(stated: object) -> None:
    if isinstance(stated, bool) or not isinstance(stated, int | float):
        raise wrong_kind_error("format", stated, str(MANIFEST_FORMAT))
    if stated != MANIFEST_FORMAT:
        error = documents.other_release_error(stated, stated, MANIFEST_FORMAT)
        raise error if stated > MANIFEST_FORMAT else ValueError(f"{error}: {OLD_MANIFEST_ADVICE}")


def _read_utf8(text: PyTree, path: str) -> str:
    try:
        read_text(text, path).encode()
    except UnicodeEncodeError:
        raise wrong_kind_error(path, text, "text without surrogates") from None
    return text


read_notes: Callable[[PyTree, str], Any] = table_reader(_read_utf8)


@dataclasses.dataclass(frozen=True, kw_only=True)
class _Solver:
    step: float = table_field(range_reader(POSITIVE_SECONDS))
    duration: float = table_field(range_reader(POSITIVE_SECONDS))
    follow_slides: bool = table_field(read_switch, False)


@dataclasses.dataclass(frozen=True, kw_only=True)
class _Fixed(_Solver):
    kinks: bool | None = table_field(read_switch, None)


@dataclasses.dataclass(frozen=True, kw_only=True)
class _Adaptive(_Solver):
    rtol: float = table_field(range_reader(FINITE_SPEC))


def _read_solver(entry: object, path: str) -> _Solver:
    table = {"type": "fixed", **entry} if isinstance(entry, Mapping) else entry
    return read_one({"fixed": _Fixed, "adaptive": _Adaptive}, table, path)


@dataclasses.dataclass(frozen=True)
class _Study:
    """The fields of a study (`Study.table`) without which its results cannot be read.

    `loop`, `parts` and `objectives` only inform a person who reads the file.
    """

    samples: int = table_field(whole_reader(*RANGES["samples"]))
    seed: int = table_field(whole_reader(*RANGES["seed"]))
    chunk: int = table_field(whole_reader(*RANGES["chunk"]))
    dtype: str = table_field(choice_reader(*DTYPES))
    failures: Mapping[str, float] = table_field(table_reader(range_reader(FINITE_SPEC)))
    success: bool = table_field(read_switch)
    solver: _Solver = table_field(_read_solver)
    space: Space = table_field(variables.read_space)
    loop: Table = table_field(table_reader(read_as_given))
    parts: Table = table_field(table_reader(table_reader(read_as_given)))
    objectives: Table = table_field(table_reader(read_as_given))
    engine: Mapping[str, str] = table_field(table_reader(read_text), dict)  # empty for XLA


@dataclasses.dataclass(frozen=True)
class _Manifest:
    format: int = table_field(read_as_given)
    study: _Study = table_field(partial(read_table, _Study))
    versions: Mapping[str, str] = table_field(table_reader(read_text))
    source: Mapping[str, str] = table_field(read_notes)
    commit: str = table_field(read_text, "")
    units: Mapping[str, str] = table_field(table_reader(read_text), dict)
