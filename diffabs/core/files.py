"""Files that are read and written: only regular ones, whole or not at all, and nothing left behind."""

import contextlib
import errno
import os
import pathlib
import shutil
import stat
import sys
from collections.abc import Iterator
from typing import BinaryIO

WAITING = getattr(os, "O_NONBLOCK", 0)  # opening a pipe that nobody writes to would wait for ever

_unfinished: set[pathlib.Path] = set()


@contextlib.contextmanager
def opened(path: str | os.PathLike[str]) -> Iterator[BinaryIO]:
    """A regular file, to be read. Raises OSError for one that cannot be, and for a folder, a pipe or a device."""
    handle = os.open(path, os.O_RDONLY | WAITING | getattr(os, "O_BINARY", 0))
    try:
        if stat.S_ISDIR(os.fstat(handle).st_mode):
            raise OSError(errno.EISDIR, os.strerror(errno.EISDIR), os.fspath(path))
        if not stat.S_ISREG(os.fstat(handle).st_mode):
            raise OSError(errno.EINVAL, "not a regular file", os.fspath(path))
        with open(handle, "rb", closefd=False) as file:
            yield file
    finally:
        os.close(handle)


def content(path: str | os.PathLike[str], most: int = sys.maxsize) -> bytes:
    """The first `most` bytes of a regular file. Raises OSError, as `opened`."""
    with opened(path) as file:
        return file.read(-1 if most == sys.maxsize else most)


@contextlib.contextmanager
def unfinished(path: pathlib.Path) -> Iterator[pathlib.Path]:
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


def clear() -> None:
    """Remove what is unfinished: for a process that leaves without waiting for its threads."""
    for path in list(_unfinished):
        _remove(path)


def _remove(path: pathlib.Path) -> None:
    with contextlib.suppress(OSError):
        path.unlink() if path.is_symlink() or not path.is_dir() else shutil.rmtree(path, ignore_errors=True)
