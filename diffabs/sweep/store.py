"""The folder of a sweep: a manifest, and one Parquet file for each chunk.

    manifest.json                             what was swept, and with which versions
    chunks/part-00000012-<digest>.parquet     a chunk; its name holds the first 16 digits of its SHA-256

A file is written beside its place, flushed to the disk, and renamed, so that what is there is whole, and its name says
what must be in it: no index to keep, nothing to repair after a kill. One process at a time has the lock."""

import contextlib
import hashlib
import io
import json
import os
import pathlib
import re
from collections.abc import Iterator, Mapping
from typing import Any

import filelock
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

FORMAT = 1
NAME = re.compile(r"part-(\d{8})-([0-9a-f]{16})\.parquet")
MANIFEST, CHUNKS, LOCK = "manifest.json", "chunks", ".lock"
MOST_SHOWN = 60


class SweepError(ValueError):
    """A sweep that cannot be started, continued or read; one line."""


def encoded(columns: Mapping[str, np.ndarray]) -> bytes:
    """A chunk as the bytes of its Parquet file: the same columns give the same bytes."""
    table = pa.table({name: _array(column) for name, column in columns.items()})
    buffer = io.BytesIO()
    pq.write_table(table, buffer, compression="zstd")
    return buffer.getvalue()


def _array(column: np.ndarray) -> pa.Array:
    return pa.array(column.astype(str)).dictionary_encode() if column.dtype.kind in "OU" else pa.array(column)


class Store:
    """A folder, opened for one sweep."""

    def __init__(self, folder: pathlib.Path):
        """Nothing is read or written yet."""
        self.folder, self.chunks = pathlib.Path(folder), pathlib.Path(folder) / CHUNKS

    @contextlib.contextmanager
    def locked(self) -> Iterator[None]:
        """Alone in the folder, which is made if it is not there. Raises SweepError if another process has it, or if it
        cannot be written."""
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            lock = filelock.FileLock(self.folder / LOCK, timeout=0)
            lock.acquire()
        except filelock.Timeout:
            raise SweepError(f"{self.folder} is in use by another process") from None
        except OSError as error:
            raise SweepError(f"{self.folder} cannot be written: {error.strerror}") from None
        try:
            yield
        finally:
            lock.release()

    def begin(self, manifest: Mapping[str, Any], *, resume: bool) -> None:
        """Write the manifest, or compare it with the one that is there. Raises SweepError for a folder that holds
        another configuration (naming the first differences), finished chunks although `resume` is not set, or other
        files. A sweep that never finished a chunk (its scheduler did not answer, say) is begun anew."""
        wanted = {"format": FORMAT, **manifest}
        for leftover in (self.folder / f"{MANIFEST}.tmp", *self.chunks.glob("part-*.parquet.tmp")):
            leftover.unlink(missing_ok=True)
        if not (self.folder / MANIFEST).exists():
            self._begin_new(wanted)
            return
        there = read_manifest(self.folder)
        if not resume:
            if self.chunks.is_dir() and any(self.chunks.iterdir()):
                raise SweepError(f"{self.folder} already holds a sweep; --resume continues it")
            self._begin_new(wanted)
            return
        found = list(differences(_decisive(there), _decisive(wanted)))
        if found:
            more = f", and {len(found) - 3} more" if len(found) > 3 else ""
            raise SweepError(f"{self.folder} holds another sweep: {'; '.join(found[:3])}{more}")
        self.chunks.mkdir(exist_ok=True)

    def _begin_new(self, manifest: Mapping[str, Any]) -> None:
        if self.chunks.is_dir() and any(self.chunks.iterdir()):
            raise SweepError(f"{self.folder} has chunks but no {MANIFEST}; it cannot be continued")
        names = (path.name for path in self.folder.iterdir())
        others = sorted(name for name in names if name not in (CHUNKS, MANIFEST) and not name.startswith("."))
        if others:
            raise SweepError(f"{self.folder} is no sweep, but holds {others[0]}; choose a folder that is new or empty")
        self.chunks.mkdir(exist_ok=True)
        write_whole(self.folder / MANIFEST, json.dumps(manifest, indent=1).encode())

    def scan(self) -> tuple[dict[int, pathlib.Path], list[int]]:
        """Chunks that are there and whole, and those that are damaged. A damaged file is removed; one of another name
        is left alone."""
        whole, damaged = {}, []
        named = ((NAME.fullmatch(path.name), path) for path in sorted(self.chunks.glob("*.parquet")))
        for name, path in named:
            if name and hashlib.sha256(path.read_bytes()).hexdigest().startswith(name[2]):
                whole[int(name[1])] = path
            elif name:
                damaged.append(int(name[1]))
                path.unlink()
        return whole, [chunk for chunk in damaged if chunk not in whole]

    def write(self, chunk: int, data: bytes) -> pathlib.Path:
        """A chunk, whole or not at all."""
        digest = hashlib.sha256(data).hexdigest()[:16]
        return write_whole(self.chunks / f"part-{chunk:08d}-{digest}.parquet", data)


def read_manifest(folder: pathlib.Path) -> dict[str, Any]:
    """The manifest. Raises SweepError if there is none, or none that this version reads."""
    path = pathlib.Path(folder) / MANIFEST
    try:
        manifest = json.loads(path.read_bytes())
        if not isinstance(manifest, dict) or manifest.get("format") != FORMAT:
            raise ValueError(f"format {manifest.get('format') if isinstance(manifest, dict) else None} is not {FORMAT}")
        for name in ("study", "source"):
            if not isinstance(manifest.get(name), dict):
                raise ValueError(f"{name} is missing")
    except OSError as error:
        raise SweepError(f"{folder} is no sweep: {MANIFEST}: {error.strerror}") from None
    except ValueError as error:
        raise SweepError(f"{folder} is no sweep that can be read: {MANIFEST}: {error}") from None
    return manifest


def write_whole(path: pathlib.Path, data: bytes) -> pathlib.Path:
    """A file that is whole at every instant at which it is there, also after a power cut."""
    temporary = path.with_name(f"{path.name}.tmp")
    try:
        with temporary.open("wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(path)
    except BaseException:
        with contextlib.suppress(OSError):
            temporary.unlink()
        raise
    if hasattr(os, "O_DIRECTORY"):
        folder = os.open(path.parent, os.O_RDONLY | os.O_DIRECTORY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)
    return path


def differences(there: Any, wanted: Any, path: str = "") -> Iterator[str]:
    """Where two documents differ, a line each."""
    if isinstance(there, dict) and isinstance(wanted, dict):
        for key in [*there, *(key for key in wanted if key not in there)]:
            inner = f"{path}.{key}" if path else str(key)
            yield from differences(there.get(key), wanted.get(key), inner)
    elif there != wanted:
        yield f"{path} is {_short(there)} there, {_short(wanted)} here"


def _decisive(manifest: Mapping[str, Any]) -> dict[str, Any]:
    """What results depend on: everything but the commit, which is a note."""
    return {key: value for key, value in manifest.items() if key not in ("commit", "source")}


def _short(value: Any) -> str:
    text = json.dumps(value)
    return text if len(text) <= MOST_SHOWN else f"{text[: MOST_SHOWN - 3]}..."
