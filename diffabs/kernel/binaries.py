"""Compiled libraries in the user's cache folder: what is loaded is what was compiled.

The name of a file has two digests: one of everything that the library is made of, one of the file's content. A file
whose content is not what its name says (empty, cut off, changed, or another library) is removed and compiled again."""

import errno
import hashlib
import logging
import os
import pathlib
import sys

from diffabs.core import files

CACHE = "DIFFABS_KERNEL_CACHE"  # the folder of the libraries, if set
ROOM = 1 << 28  # bytes of libraries, some 800; beyond, the half that was not used for longest goes
CONTENT = 32  # hexadecimal digits of the content's digest in a name
log = logging.getLogger("diffabs")


def cache_folder() -> pathlib.Path:
    """Return the folder in which libraries are kept: $DIFFABS_KERNEL_CACHE, or the user's for caches."""
    if said := os.environ.get(CACHE):
        return pathlib.Path(said)
    if sys.platform == "darwin":
        return pathlib.Path.home() / "Library" / "Caches" / "diffabs" / "kernel"
    return pathlib.Path(os.environ.get("XDG_CACHE_HOME") or pathlib.Path.home() / ".cache") / "diffabs" / "kernel"


def own_folder() -> pathlib.Path:
    """Return the cache folder, made if it is not there. Raises OSError if it cannot be made, or if other users may
    write to it: they could put their code there."""
    folder = cache_folder()
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    if files.others_may_write(folder):
        raise OSError(errno.EPERM, f"other users may write to it: `chmod go-w` it, or name another folder in {CACHE}")
    return folder


def find(made_of: str, suffix: str) -> pathlib.Path | None:
    """Return the file of a library, or None. A damaged one is removed, with one line in the log. Raises OSError, as
    `own_folder`.

    Args:
        made_of: the digest of everything that decides the library
        suffix: of its file name
    """
    for path in sorted(own_folder().glob(f"{made_of}-*{suffix}")):
        if _named(made_of, files.content(path), suffix) == path.name:
            os.utime(path)  # it was used
            return path
        log.warning("%s is damaged; it is compiled again", path)
        path.unlink(missing_ok=True)
    return None


def write(made_of: str, suffix: str, content: bytes) -> pathlib.Path:
    """Write a library and return its file, which is whole at every instant at which it is there. Raises OSError."""
    folder = own_folder()
    files.make_room(folder, f"*{suffix}", ROOM)
    return files.write_synced(folder / _named(made_of, content, suffix), content)


def _named(made_of: str, content: bytes, suffix: str) -> str:
    return f"{made_of}-{hashlib.sha256(content).hexdigest()[:CONTENT]}{suffix}"
