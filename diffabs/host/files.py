"""Reading of regular files, and writing of files that appear whole or not at all."""

import contextlib
import ctypes
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

AT_FDCWD, RENAME_EXCHANGE = -100, 2  # of Linux, <fcntl.h> and <linux/fs.h>
NONBLOCKING_FLAG = getattr(os, "O_NONBLOCK", 0)  # without it, opening a pipe without a writer blocks for ever
# Errors of a full, failing or read-only disk. A write to an open file raises them without the file's name.
DISK_ERRORS: set[int] = {errno.ENOSPC, errno.EFBIG, errno.EIO, errno.EROFS, getattr(errno, "EDQUOT", errno.ENOSPC)}

_unfinished: set[pathlib.Path] = set()


@contextlib.contextmanager
def open_regular(path: str | os.PathLike[str]) -> Iterator[BinaryIO]:
    """Yield a regular file, open for reading. Raises OSError for a folder, a pipe or a device."""
    with open(path, "rb", opener=lambda path, flags: os.open(path, flags | NONBLOCKING_FLAG)) as file:
        handle = file.fileno()
        if not stat.S_ISREG(os.fstat(handle).st_mode):
            raise OSError(errno.EINVAL, "not a regular file", os.fspath(path))
        yield file


def read_content(path: str | os.PathLike[str], size: int = sys.maxsize) -> bytes:
    """Return the content of a regular file, or only its first bytes."""
    with open_regular(path) as file:
        return file.read(-1 if size == sys.maxsize else size)


def make_room(folder: pathlib.Path, pattern: str, room: int) -> None:
    """Remove half of the matching files, the oldest ones, if all together have more than `room` bytes.

    Half refers to the number of files, so the rest may still exceed `room`.
    """
    entries = []
    for path in folder.glob(pattern):
        with contextlib.suppress(FileNotFoundError):  # another process was quicker
            entries.append((path.stat().st_mtime, path.stat().st_size, path))
    if sum(size for _, size, _ in entries) > room:
        for _, _, path in sorted(entries)[: (len(entries) + 1) // 2]:
            with contextlib.suppress(OSError):
                path.unlink()


@contextlib.contextmanager
def temporary_path(path: pathlib.Path) -> Iterator[pathlib.Path]:
    """Yield the path of a file or folder, and remove it at the end unless it was renamed to its final place.

    `remove_unfinished` removes it, too, if the process leaves while a thread still writes.
    """
    _unfinished.add(path)
    try:
        yield path
    except BaseException:  # the path stays in `_unfinished`: a running thread may create the file again
        _remove(path)
        raise
    _remove(path)
    _unfinished.discard(path)


def describe_error(error: OSError) -> str:
    """Return an error of the system in one line: the file or folder, if it has one, and the reason."""
    reason = error.strerror or str(error)
    return " ".join((reason if error.filename is None else f"{os.fsdecode(error.filename)}: {reason}").split())


@contextlib.contextmanager
def name_in_disk_errors(target: str | os.PathLike[str], temporary: pathlib.Path | None = None) -> Iterator[None]:
    """Name `target` in an error of the disk in the `with` block that names no file, or one in `temporary`."""
    try:
        yield
    except OSError as error:
        named = error.filename
        inside = named and temporary and pathlib.Path(os.fsdecode(named)).is_relative_to(temporary)
        if error.errno in DISK_ERRORS and (named is None or inside):
            error.filename, error.filename2 = os.fspath(target), None
        raise


@contextlib.contextmanager
def temporary_folder(prefix: str, parent: pathlib.Path | None = None) -> Iterator[pathlib.Path]:
    """Yield an empty folder that vanishes at the end. Errors of the disk name it. Its parent is by default `TMPDIR`."""
    with tempfile.TemporaryDirectory(prefix=prefix, dir=parent) as name, name_in_disk_errors(name):
        yield pathlib.Path(name)


@contextlib.contextmanager
def new_file(target: pathlib.Path, suffix: str | None = None) -> Iterator[pathlib.Path]:
    """Yield an empty file beside `target` that replaces `target` at the end, or vanishes after an error.

    Readers see the old file or the whole new one. If the caller removes the file, `target` stays unchanged. The file
    behind a symbolic link is replaced, and the link stays. A killed process may leave a hidden file `.STEM.*`.
    """
    target = pathlib.Path(os.path.realpath(target))
    if target.exists() and not target.is_file():
        raise OSError(errno.EINVAL, "not a regular file", str(target))
    temporary = target.with_name(f".{target.stem}.{secrets.token_hex(4)}{suffix or target.suffix}")
    with name_in_disk_errors(target, temporary), temporary_path(temporary):
        temporary.touch(exist_ok=False)
        yield temporary
        if temporary.exists():
            temporary.replace(target)


def write_file(target: pathlib.Path, data: bytes) -> None:
    """Write a file, whole or not at all."""
    with new_file(target) as temporary:
        temporary.write_bytes(data)


def write_synced(target: pathlib.Path, data: bytes) -> pathlib.Path:
    """Write a file that is whole whenever it exists, also after a power cut, and return its path.

    Several processes may write it at once; the content of the last one stays. Unlike `write_durably`, the function does
    not sync the folder, so a power cut may undo the write.
    """
    with new_file(target, ".tmp") as temporary, temporary.open("wb") as file:  # data sets read hidden .parquet files
        file.write(data)
        file.flush()
        os.fsync(file.fileno())
    return target


def others_may_write(folder: pathlib.Path) -> bool:
    """Return whether users other than this one and root may write to a folder; always False on Windows.

    The answer is True for a folder that the group or everybody may write to, or that another user owns.
    """
    if not hasattr(os, "getuid"):
        return False  # Windows: a user's folders are the user's
    status = folder.stat()
    return bool(status.st_mode & (stat.S_IWGRP | stat.S_IWOTH)) or status.st_uid not in (os.getuid(), 0)


def write_durably(target: pathlib.Path, data: bytes) -> pathlib.Path:
    """Write a file that is whole whenever it exists, also after a power cut, and return its path.

    Unlike `write_synced`, the function also syncs the folder, so that the new file survives a power cut.
    """
    write_synced(target, data)
    if hasattr(os, "O_DIRECTORY"):
        folder = os.open(os.path.dirname(os.path.realpath(target)), os.O_RDONLY | os.O_DIRECTORY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)
    return target


@contextlib.contextmanager
def new_folder(target: pathlib.Path) -> Iterator[pathlib.Path]:
    """Yield an empty folder beside `target` that replaces `target` at the end, or vanishes after an error.

    Linux exchanges the old and the new folder in one step. Other systems, and some network file systems, take two
    steps. A process killed between them leaves no `target`, and the old content in `.NAME.*/old` beside it. The folder
    behind a symbolic link is replaced, and the link stays. A killed process may leave a hidden folder `.NAME.*` in any
    case; remove it when no process writes. Missing parents of `target` are made at the end, and not after an error.
    """
    target = pathlib.Path(os.path.realpath(target))
    if target.exists() and not target.is_dir():
        raise OSError(errno.ENOTDIR, os.strerror(errno.ENOTDIR), str(target))
    place = next(parent for parent in target.parents if parent.exists())
    room = pathlib.Path(tempfile.mkdtemp(prefix=f".{target.name}.", dir=place))
    with name_in_disk_errors(target, room), temporary_path(room):
        new, old = room / "new", room / "old"
        new.mkdir()
        yield new
        target.parent.mkdir(parents=True, exist_ok=True)
        if target.exists():
            if _exchange(new, target):
                return
            target.rename(old)
        try:
            new.rename(target)
        except OSError:
            if old.exists():
                old.rename(target)
            raise


def _exchange(first: pathlib.Path, second: pathlib.Path) -> bool:
    """Exchange two files or folders in one step, and return True; return False where the system has no such step."""
    if sys.platform != "linux":
        return False
    with contextlib.suppress(AttributeError, OSError):  # a C library without renameat2
        places = (AT_FDCWD, os.fsencode(first), AT_FDCWD, os.fsencode(second))
        return ctypes.CDLL(None).renameat2(*places, RENAME_EXCHANGE) == 0
    return False


def remove_unfinished() -> None:
    """Remove all unfinished files and folders, for a process that leaves without waiting for its threads."""
    for path in list(_unfinished):
        _remove(path)


def _remove(path: pathlib.Path) -> None:
    with contextlib.suppress(OSError):
        path.unlink() if path.is_symlink() or not path.is_dir() else shutil.rmtree(path, ignore_errors=True)
