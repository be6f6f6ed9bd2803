"""The folder of a sweep: a manifest, and one Parquet file for each chunk.

    manifest.json                             study and versions of the sweep
    chunks/part-00000012-<digest>.parquet     a chunk; its name holds the first 16 digits of its SHA-256

A file is written beside its place, flushed to the disk, and renamed. So each file is whole, and its name determines its
contents. There is no index to keep, and nothing to repair after a kill. One process at a time has the lock.
"""

import contextlib
import json
import pathlib
from collections.abc import Iterator

import filelock

from diffabs.core.types import JsonObject, Table
from diffabs.host import files
from diffabs.uncertainty.sweep import seal
from diffabs.uncertainty.sweep.manifest import MANIFEST_NAME as MANIFEST_NAME
from diffabs.uncertainty.sweep.manifest import Seals, encode_manifest
from diffabs.uncertainty.sweep.manifest import read_manifest as read_manifest
from diffabs.uncertainty.sweep.seal import DamagedError
from diffabs.uncertainty.sweep.seal import SweepError as SweepError

CHUNKS_FOLDER, LOCK_FILE = "chunks", ".lock"
MAX_VALUE_CHARACTERS = 60
LEFTOVERS = (".manifest.*.tmp", "manifest.json.tmp", "chunks/.part-*.tmp", "chunks/part-*.tmp")  # of a killed process
IGNORED_PREFIXES = (".", "_")  # readers of Parquet data sets ignore names with these beginnings


class Store:
    """A folder, opened for one sweep."""

    def __init__(self, folder: pathlib.Path):
        """Set the `folder`, without reading or writing."""
        self.folder: pathlib.Path = pathlib.Path(folder)
        self.chunks: pathlib.Path = pathlib.Path(folder) / CHUNKS_FOLDER

    @contextlib.contextmanager
    def lock(self) -> Iterator[None]:
        """Hold the lock of the folder, which is created if it does not exist.

        An error in the `with` block, such as a scheduler that does not answer, leaves nothing new in the folder unless
        a chunk is finished. Ctrl-C leaves the manifest.
        """
        try:
            created = [path for path in (self.folder, *self.folder.parents) if not path.exists()]
            before = set() if created else {path.name for path in self.folder.iterdir()}
            self.folder.mkdir(parents=True, exist_ok=True)
            lock = filelock.FileLock(self.folder / LOCK_FILE, timeout=0)
            lock.acquire()
        except filelock.Timeout:
            raise SweepError(f"{self.folder} is in use by another process") from None
        except OSError as error:
            raise SweepError(f"{self.folder} cannot be written: {error.strerror}") from None
        try:
            yield
        except Exception:
            if not self._has_chunks():
                self._remove_new(before, created)  # while the lock is held
            raise
        finally:
            lock.release()

    def _remove_new(self, before: set[str], created: list[pathlib.Path]) -> None:
        """Remove all that is not in `before`, and the `created` folders, the innermost first."""
        with contextlib.suppress(OSError):  # a folder that is not empty stays
            if CHUNKS_FOLDER not in before and self.chunks.exists():
                self.chunks.rmdir()
            for name in {MANIFEST_NAME, LOCK_FILE} - before:
                (self.folder / name).unlink(missing_ok=True)
            for folder in created:
                folder.rmdir()

    def check_free(self) -> None:
        """Check that a new sweep can begin in the folder, without writing."""
        if has_manifest := (self.folder / MANIFEST_NAME).exists():
            read_manifest(self.folder)
        if self._has_chunks():
            why = "already holds a sweep; --resume continues it"
            why = why if has_manifest else f"has chunks but no {MANIFEST_NAME}; it cannot be continued"
            raise SweepError(f"{self.folder} {why}")
        ours = {CHUNKS_FOLDER, MANIFEST_NAME, *LEFTOVERS}
        names = (path.name for path in self.folder.iterdir()) if self.folder.is_dir() else ()
        foreign_files = sorted(name for name in names if name not in ours and not name.startswith("."))
        if foreign_files:
            raise SweepError(
                f"{self.folder} is no sweep, but holds {foreign_files[0]}; choose a folder that is new or empty"
            )

    def begin(self, manifest: Table, *, resume: bool) -> None:
        """Write the `manifest`, or compare it with the existing one if `resume` is set.

        Unless `resume` is set, a sweep without a finished chunk (because its process was killed, for example) starts
        again from the beginning.
        """
        for pattern in LEFTOVERS:
            for leftover in self.folder.glob(pattern):
                leftover.unlink(missing_ok=True)
        if not (resume and (self.folder / MANIFEST_NAME).exists()):
            self.check_free()
            self.chunks.mkdir(exist_ok=True)
            files.write_durably(self.folder / MANIFEST_NAME, encode_manifest(manifest))
            return
        existing = read_manifest(self.folder)
        differences = list(describe_differences(_decisive_entries(existing), _decisive_entries(manifest)))
        if differences:
            more = f", and {len(differences) - 3} more" if len(differences) > 3 else ""
            raise SweepError(f"{self.folder} holds another sweep: {'; '.join(differences[:3])}{more}")
        self.chunks.mkdir(exist_ok=True)

    def _has_chunks(self) -> bool:
        return any(self.chunks.glob("*"))

    def scan(self, seals: Seals) -> tuple[dict[int, pathlib.Path], list[int]]:
        """Return the paths of the intact chunks by number, and the numbers of the damaged ones.

        A chunk is intact if `verify_chunk` accepts it with its seal of `seals`. A damaged file is removed. A file with
        another name stays.
        """
        whole, damaged = {}, []
        for chunk, paths in list_chunks(self.folder, seals.count)[0].items():
            for path in paths:
                try:
                    seal.verify_chunk(read_chunk(path), path, seals.of(chunk))
                    whole[chunk] = path
                except DamagedError:
                    damaged.append(chunk)
                    path.unlink()
        return whole, [chunk for chunk in dict.fromkeys(damaged) if chunk not in whole]

    def write(self, chunk: int, data: bytes) -> pathlib.Path:
        """Write the `data` of a `chunk`, completely or not at all, and return its path."""
        return files.write_durably(self.chunks / seal.chunk_file_name(chunk, data), data)


def list_chunks(folder: pathlib.Path, count: int) -> tuple[dict[int, list[pathlib.Path]], list[pathlib.Path]]:
    """Return the files of the chunks by number, and other files that a reader would take for parts of the data set."""
    named, strays = {}, []
    for path in sorted((folder / CHUNKS_FOLDER).glob("*")):
        number = seal.CHUNK_NAME_PATTERN.fullmatch(path.name)
        if number and int(number[1]) < count:
            named.setdefault(int(number[1]), []).append(path)
        elif not path.name.startswith(IGNORED_PREFIXES):
            strays.append(path)
    return named, strays


def check_owner(folder: pathlib.Path, manifest: Table, sample: int) -> None:
    """Check that a chunk belongs to the manifest: the chunk with this sample, or the first one if that is missing."""
    seals = Seals(manifest)
    named = list_chunks(folder, seals.count)[0]
    if not named:
        raise SweepError(f"{folder} has no finished chunk yet; --resume continues it")
    own_chunk = sample // manifest["study"]["chunk"]
    chunk = own_chunk if own_chunk in named else min(named)
    for path in named[chunk]:
        seal.verify_chunk(read_chunk(path), path, seals.of(chunk))


def read_chunk(path: pathlib.Path) -> bytes:
    """Return the bytes of a chunk's file."""
    try:
        return files.read_content(path)
    except OSError as error:
        raise SweepError(f"{path} cannot be read: {error.strerror}; move it away") from None


def describe_differences(existing: object, expected: object, path: str = "") -> Iterator[str]:
    """Yield one line for each difference between two documents, also of the order of equal entries.

    The order of the variables decides their samples.
    """
    if isinstance(existing, dict) and isinstance(expected, dict):
        keys = [*existing, *(key for key in expected if key not in existing)]
        inner = {key: f"{path}.{key}" if path else str(key) for key in keys}
        lines = [
            line for key in keys for line in describe_differences(existing.get(key), expected.get(key), inner[key])
        ]
        if not lines and list(existing) != list(expected):
            lines = [f"{path} has the entries {', '.join(existing)} there, {', '.join(expected)} here"]
        yield from lines
    elif json.dumps(existing) != json.dumps(expected):  # as digests do: NaN is NaN, and 1 is not 1.0
        yield f"{path} is {_abbreviate(existing)} there, {_abbreviate(expected)} here"


def _decisive_entries(manifest: Table) -> JsonObject:
    """Return the entries that decide the results: all except the notes on commit, source and units.

    A manifest without an engine is that of a sweep by XLA.
    """
    study = {"engine": {"name": "xla"}, **manifest.get("study", {})}
    return {
        key: value for key, value in {**manifest, "study": study}.items() if key not in ("commit", "source", "units")
    }


def _abbreviate(value: object) -> str:
    text = json.dumps(value)
    return text if len(text) <= MAX_VALUE_CHARACTERS else f"{text[: MAX_VALUE_CHARACTERS - 3]}..."
