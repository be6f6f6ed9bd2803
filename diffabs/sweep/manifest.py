"""The manifest of a sweep: what was swept, with which versions, from which scenario; and a digest of all of that.

    format      of the folder
    study       what decides the results (`Study.table`)
    versions    of the packages that can change a bit of them
    commit      of diffabs, where it is known
    source      name and text of the scenario
    digest      SHA-256 of the rest: a file that was changed afterwards is not read

Format, study and versions own the chunks: their digest is in each (`seal`)."""

import json
import pathlib
from collections.abc import Iterator, Mapping
from typing import Any

from diffabs.core import files, provenance
from diffabs.sweep import variables
from diffabs.sweep.seal import Seal, SweepError, digest
from diffabs.sweep.study import DTYPES, FLAGS, RANGES, Study
from diffabs.sweep.tables import FINITE, POSITIVE, number, text, whole, wrong

FORMAT = 3
MANIFEST = "manifest.json"
LARGEST = 2**30  # bytes
DECISIVE = ("jax", "jaxlib", "numpy", "scipy", "pyarrow")  # packages that can change a bit of the result
OWNING = ("format", "study", "versions")
EARLIER = (1, 2)
OLD = "written by an earlier diffabs: read its chunks with pandas, or sweep again"


def described(study: Study) -> dict[str, Any]:
    """What owns the chunks of a study, computed here and now."""
    return {"format": FORMAT, "study": study.table(), "versions": provenance.versions(*DECISIVE)}


class Seals:
    """What each chunk of the sweep with this manifest says of itself."""

    def __init__(self, manifest: Mapping[str, Any]):
        """Works out once what is the same for all."""
        self.study = manifest["study"]
        self.owner = digest({name: manifest[name] for name in OWNING})
        self.count = -(-self.study["samples"] // self.study["chunk"])
        varied = variables.read(self.study["space"], "study.space").paths
        self.columns = frozenset({"sample", *FLAGS, *self.study["objectives"], *varied})

    def of(self, chunk: int) -> Seal:
        """Of this chunk."""
        start = chunk * self.study["chunk"]
        rows = start, min(start + self.study["chunk"], self.study["samples"])
        return Seal(self.owner, chunk, self.study["seed"], rows, self.columns)


def sealed(manifest: Mapping[str, Any]) -> bytes:
    """The file."""
    return json.dumps({**manifest, "digest": digest(manifest)}, indent=1).encode()


def read_manifest(folder: pathlib.Path) -> dict[str, Any]:
    """The manifest, without its digest. Raises SweepError, one line, if there is none, or it is not as it was written,
    or something in it cannot be."""
    try:
        raw = files.content(pathlib.Path(folder) / MANIFEST, LARGEST)
    except (OSError, ValueError) as error:
        why = getattr(error, "strerror", None) or error
        raise SweepError(f"{folder} is no sweep: {MANIFEST}: {why}") from None
    try:
        return _checked(json.loads(raw))
    except (ValueError, RecursionError) as error:
        why = "nested too deeply" if isinstance(error, RecursionError) else " ".join(str(error).split())
        raise SweepError(f"{folder} is no sweep that can be read: {MANIFEST}: {why}") from None


def _checked(given: Any) -> dict[str, Any]:
    if not isinstance(given, dict):
        raise wrong("it", given, "a table")
    if given.get("format") in EARLIER:
        raise ValueError(OLD)
    if given.get("format") != FORMAT:
        raise wrong("format", given.get("format"), str(FORMAT))
    manifest = {name: value for name, value in given.items() if name != "digest"}
    if given.get("digest") != digest(manifest):
        raise ValueError("it was changed after it was written: its digest is another one")
    for line in (*_wrong_study(_table(manifest, "study")), *_wrong_others(manifest)):
        raise ValueError(line)
    return manifest


def _wrong_study(study: Mapping[str, Any]) -> Iterator[str]:
    """One line for what a reader could not use. Raises ValueError for what is of another type."""
    for name, least, most in RANGES:
        if not least <= whole(study.get(name), f"study.{name}") <= most:
            yield f"study.{name} = {study[name]} is outside [{least}, {most}]"
    if study.get("dtype") not in list(DTYPES):
        raise wrong("study.dtype", study.get("dtype"), " or ".join(DTYPES))
    for name in ("loop", "parts", "objectives", "failures"):
        _table(study, name, "study.")
    solver = _table(study, "solver", "study.")
    for name in ("step", "duration"):
        if not POSITIVE.holds(number(solver.get(name), f"study.solver.{name}")):
            yield f"study.solver.{name} = {solver[name]} is outside {POSITIVE.interval()} s"
    for name, bound in study["failures"].items():
        if name not in study["objectives"]:
            yield f"study.failures.{text(name, 'a failure')} is not measured"
        if not FINITE.holds(number(bound, f"study.failures.{name}")):
            yield f"study.failures.{name} = {bound} is outside {FINITE.interval()}"
    varied = variables.read(study.get("space"), "study.space")
    varied.check(study["samples"])
    for name in {"sample", *FLAGS, *varied.paths} & study["objectives"].keys():
        yield f"study.objectives.{name}: another column of the table has this name"


def _wrong_others(manifest: Mapping[str, Any]) -> Iterator[str]:
    for name, version in _table(manifest, "versions").items():
        text(version, f"versions.{name}")
    source = _table(manifest, "source")
    for name in ("scenario", "name"):
        try:
            text(source.get(name, ""), f"source.{name}").encode()
        except UnicodeEncodeError:
            yield f"source.{name} is not text"


def _table(given: Mapping[str, Any], name: str, where: str = "") -> Mapping[str, Any]:
    if not isinstance(given.get(name), dict):
        raise wrong(f"{where}{name}", given.get(name), "a table")
    return given[name]
