"""A cache of compiled libraries and GPU code in the user's cache folder, with a check for damage.

A file name holds two digests: one of every input of the compilation, and one of the file's content. A library is
compiled again if no file has its first digest. Either it was never made, or an input changed, or it was removed to make
room. A file whose content does not match the second digest (empty, truncated or changed) is removed, and compiled again
too.
"""

import contextlib
import errno
import hashlib
import logging
import os
import pathlib
import sys

from diffabs.host import files

CACHE = "DIFFABS_KERNEL_CACHE"  # environment variable: folder of the compiled libraries
MAX_CACHE_BYTES = 1 << 28  # about 800 libraries; a larger cache loses its less recently used half
CONTENT = 32  # hexadecimal digits of the content digest in a file name
log: logging.Logger = logging.getLogger("diffabs")


def cache_folder() -> pathlib.Path:
    """Return the folder of compiled libraries: $DIFFABS_KERNEL_CACHE, or diffabs/kernel in the user's cache folder."""
    if folder := os.environ.get(CACHE):
        return pathlib.Path(folder)
    try:
        caches = pathlib.Path.home() / ("Library/Caches" if sys.platform == "darwin" else ".cache")
    except RuntimeError:
        raise OSError(errno.ENOENT, f"the user has no home folder; name a folder in {CACHE}") from None
    if sys.platform != "darwin" and (folder := os.environ.get("XDG_CACHE_HOME")):
        caches = pathlib.Path(folder)
    return caches / "diffabs" / "kernel"


def make_cache_folder() -> pathlib.Path:
    """Create the cache folder if it is missing, and return it; raise OSError if other users may write code there."""
    folder = cache_folder()
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    if files.others_may_write(folder):
        raise OSError(errno.EPERM, f"other users may write to it: `chmod go-w` it, or name another folder in {CACHE}")
    return folder


def find_library(made_of: str, suffix: str) -> pathlib.Path | None:
    """Return the file of a library by the digest of its compilation's inputs, or None if the cache does not hold it.

    The content of the file is checked. A damaged file is removed, with one line in the log.
    """
    for path in sorted(make_cache_folder().glob(f"{made_of}-*{suffix}")):
        try:
            content = files.read_content(path)
        except FileNotFoundError:  # another process removed the file
            continue
        if _file_name(made_of, content, suffix) == path.name:
            # The time stamp orders the files for eviction by last use. A read-only folder cannot store it.
            with contextlib.suppress(OSError):
                os.utime(path)
            return path
        log.warning("%s is damaged; it is compiled again", path)
        path.unlink(missing_ok=True)
    return None


def write_library(made_of: str, suffix: str, content: bytes) -> pathlib.Path:
    """Write a library to the cache and return its file.

    The write is atomic: a file with a library's name is always complete. If the files with this suffix have more than
    MAX_CACHE_BYTES, the less recently used half of them is removed first.
    """
    folder = make_cache_folder()
    files.make_room(folder, f"*{suffix}", MAX_CACHE_BYTES)
    return files.write_synced(folder / _file_name(made_of, content, suffix), content)


def _file_name(made_of: str, content: bytes, suffix: str) -> str:
    """Return the name of a library's file: both digests and the suffix."""
    return f"{made_of}-{hashlib.sha256(content).hexdigest()[:CONTENT]}{suffix}"
