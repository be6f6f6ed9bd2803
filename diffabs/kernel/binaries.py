"""Compiled libraries in the user's cache folder, whose damage is found before they are loaded.

The name of a file has two digests: one of everything that the library is made of, one of the file's content. A file
whose content is not what its name says (empty, cut off, changed, or another library) is removed and compiled again."""

import contextlib
import errno
import hashlib
import logging
import os
import pathlib
import sys

from diffabs.core import files

CACHE = "DIFFABS_KERNEL_CACHE"  # the folder of the libraries, if set
MAX_CACHE_BYTES = 1 << 28  # bytes of libraries, some 800; beyond, the half that was not used for longest goes
CONTENT = 32  # hexadecimal digits of the content's digest in a name
log = logging.getLogger("diffabs")


def cache_folder() -> pathlib.Path:
    """Return the folder in which libraries are kept: $DIFFABS_KERNEL_CACHE, or the user's for caches. Raises OSError
    for a user without a home folder."""
    if said := os.environ.get(CACHE):
        return pathlib.Path(said)
    try:
        caches = pathlib.Path.home() / ("Library/Caches" if sys.platform == "darwin" else ".cache")
    except RuntimeError:
        raise OSError(errno.ENOENT, f"the user has no home folder; name a folder in {CACHE}") from None
    if sys.platform != "darwin" and (said := os.environ.get("XDG_CACHE_HOME")):
        caches = pathlib.Path(said)
    return caches / "diffabs" / "kernel"


def make_cache_folder() -> pathlib.Path:
    """Return the cache folder, made if it is not there. Raises OSError if it cannot be made, or if other users may
    write to it: they could put their code there."""
    folder = cache_folder()
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    if files.others_may_write(folder):
        raise OSError(errno.EPERM, f"other users may write to it: `chmod go-w` it, or name another folder in {CACHE}")
    return folder


def find_library(made_of: str, suffix: str) -> pathlib.Path | None:
    """Return the file of a library, or None where there is none. A damaged file is removed, with one line in the log.
    Raises OSError for a file that cannot be read, and as `make_cache_folder`.

    Args:
        made_of: digest of everything that decides the library
        suffix: end of the file's name
    """
    for path in sorted(make_cache_folder().glob(f"{made_of}-*{suffix}")):
        try:
            content = files.read_content(path)
        except FileNotFoundError:  # another process has removed it
            continue
        if _file_name(made_of, content, suffix) == path.name:
            with contextlib.suppress(OSError):  # a folder that is only read
                os.utime(path)  # the file was used
            return path
        log.warning("%s is damaged; it is compiled again", path)
        path.unlink(missing_ok=True)
    return None


def write_library(made_of: str, suffix: str, content: bytes) -> pathlib.Path:
    """Write a library and return its file, which is whole at every instant at which it is there. Raises OSError."""
    folder = make_cache_folder()
    files.make_room(folder, f"*{suffix}", MAX_CACHE_BYTES)
    return files.write_synced(folder / _file_name(made_of, content, suffix), content)


def _file_name(made_of: str, content: bytes, suffix: str) -> str:
    return f"{made_of}-{hashlib.sha256(content).hexdigest()[:CONTENT]}{suffix}"
