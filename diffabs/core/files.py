"""Files that are read and written: only regular ones, whole or not at all, and nothing left behind."""

import contextlib
import errno
import os
import pathlib
import secrets
import shutil
import stat
import sys
import tempfile
from collections.abc import Iterator
from typing import BinaryIO

NONBLOCKING_FLAG = getattr(os, "O_NONBLOCK", 0)  # opening a pipe that nobody writes to would wait for ever

_unfinished: set[pathlib.Path] = set()


@contextlib.contextmanager
def open_regular(path: str | os.PathLike[str]) -> Iterator[BinaryIO]:
    """A regular file, to be read. Raises OSError for one that cannot be, and for a folder, a pipe or a device."""
    handle = os.open(path, os.O_RDONLY | NONBLOCKING_FLAG | getattr(os, "O_BINARY", 0))
    try:
        if stat.S_ISDIR(os.fstat(handle).st_mode):
            raise OSError(errno.EISDIR, os.strerror(errno.EISDIR), os.fspath(path))
        if not stat.S_ISREG(os.fstat(handle).st_mode):
            raise OSError(errno.EINVAL, "not a regular file", os.fspath(path))
        with open(handle, "rb", closefd=False) as file:
            yield file
    finally:
        os.close(handle)


def read_content(path: str | os.PathLike[str], most: int = sys.maxsize) -> bytes:
    """The first `most` bytes of a regular file. Raises OSError, as `opened`."""
    with open_regular(path) as file:
        return file.read(-1 if most == sys.maxsize else most)


def make_room(folder: pathlib.Path, pattern: str, room: int) -> None:
    """Remove the older half of those files of a folder that match, where they have more than `room` bytes. Raises
    OSError for a folder that cannot be read."""
    found = []
    for path in folder.glob(pattern):
        with contextlib.suppress(FileNotFoundError):  # another process was quicker
            found.append((path.stat().st_mtime, path.stat().st_size, path))
    if sum(size for _, size, _ in found) > room:
        for _, _, path in sorted(found)[: (len(found) + 1) // 2]:
            with contextlib.suppress(OSError):
                path.unlink()


@contextlib.contextmanager
def temporary_path(path: pathlib.Path) -> Iterator[pathlib.Path]:
    """A file or folder that is gone afterwards, unless it was renamed to its place; also where `clear` has to end what
    a thread still does."""
    _unfinished.add(path)
    try:
        yield path
    except BaseException:  # it stays known: a thread that goes on may write it once more
        _remove(path)
        raise
    _remove(path)
    _unfinished.discard(path)


@contextlib.contextmanager
def new_file(target: pathlib.Path, temporary: pathlib.Path | None = None) -> Iterator[pathlib.Path]:
    """An empty file beside `target` that takes its place at the end, or vanishes if anything goes wrong: readers see
    the old file or the whole new one. Whoever removes it leaves `target` as it was. `temporary`: its path, where only
    one process writes; else one that nobody else has. Raises OSError where no file can be made."""
    temporary = temporary or target.with_name(f".{target.stem}.{secrets.token_hex(4)}{target.suffix}")
    temporary.touch(exist_ok=False)
    with temporary_path(temporary):
        yield temporary
        if temporary.exists():
            temporary.replace(target)


def write_file(target: pathlib.Path, data: bytes) -> None:
    """Write a file, whole or not at all. Raises OSError."""
    with new_file(target) as temporary:
        temporary.write_bytes(data)


def write_synced(target: pathlib.Path, data: bytes) -> pathlib.Path:
    """Write a file that is whole at every instant at which it is there, also after a power cut. Several processes may
    write it at once: the last one's stays. Returns the path. Raises OSError."""
    with new_file(target) as temporary, temporary.open("wb") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())
    return target


def others_may_write(folder: pathlib.Path) -> bool:
    """Return whether users other than this one and root may write to a folder. Raises OSError."""
    if not hasattr(os, "getuid"):
        return False  # Windows: a user's folders are the user's
    there = folder.stat()
    return bool(there.st_mode & (stat.S_IWGRP | stat.S_IWOTH)) or there.st_uid not in (os.getuid(), 0)


def write_durably(target: pathlib.Path, data: bytes) -> pathlib.Path:
    """Write a file that is whole at every instant at which it is there, also after a power cut; only one process may.
    What a kill leaves behind ends in `.tmp`. Returns the path. Raises OSError."""
    temporary = target.with_name(f"{target.name}.tmp")
    temporary.unlink(missing_ok=True)
    with new_file(target, temporary), temporary.open("wb") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())
    if hasattr(os, "O_DIRECTORY"):
        folder = os.open(target.parent, os.O_RDONLY | os.O_DIRECTORY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)
    return target


@contextlib.contextmanager
def new_folder(target: pathlib.Path) -> Iterator[pathlib.Path]:
    """An empty folder beside `target` that takes its place at the end, or vanishes if anything goes wrong. Raises
    OSError where the folder cannot be made or replaced; the old one is then back."""
    target.parent.mkdir(parents=True, exist_ok=True)
    with temporary_path(pathlib.Path(tempfile.mkdtemp(prefix=f".{target.name}.", dir=target.parent))) as room:
        new, old = room / "new", room / "old"
        new.mkdir()
        yield new
        if target.exists():
            target.rename(old)
        try:
            new.rename(target)
        except OSError:
            if old.exists():
                old.rename(target)
            raise


def remove_unfinished() -> None:
    """Remove what is unfinished: for a process that leaves without waiting for its threads."""
    for path in list(_unfinished):
        _remove(path)


def _remove(path: pathlib.Path) -> None:
    with contextlib.suppress(OSError):
        path.unlink() if path.is_symlink() or not path.is_dir() else shutil.rmtree(path, ignore_errors=True)
