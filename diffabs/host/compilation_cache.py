"""The cache of compiled programs in the user's cache folder, which JAX keeps between commands.

Compiling takes most of the time of a command. JAX names a program by a hash of its contents. A user's own settings of
JAX's cache take precedence; DIFFABS_NO_CACHE=1 turns this cache off.
"""

import logging
import os
import pathlib
import sys
import warnings

import jax

from diffabs.host import files, provenance

OFF_VARIABLE = "DIFFABS_NO_CACHE"  # if set, no program is kept
WORTH = 0.05  # s of compiling; faster programs are not kept
ROOM = 256 * 2**20  # bytes on disk; above, the oldest half is removed
USER_VARIABLES = (
    "JAX_COMPILATION_CACHE_DIR",
    "JAX_ENABLE_COMPILATION_CACHE",
)  # of JAX; they take precedence


def use_compilation_cache() -> pathlib.Path | None:
    """Make JAX keep compiled programs in the user's cache folder, and return this folder.

    None means that this function changed nothing. The cache is turned off, the user has set JAX's own cache, or the
    folder cannot be used. Commands then still work. Only a folder that other users may write to gives a warning.
    """
    jax_folder = jax.config.values.get("jax_compilation_cache_dir")
    if os.environ.get(OFF_VARIABLE) or any(name in os.environ for name in USER_VARIABLES) or jax_folder:
        return None
    try:
        folder = _user_folder() / "diffabs" / f"jax-{provenance.processor()}"
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        if files.others_may_write(folder):  # a program read from there is executed: another user could plant one
            logging.getLogger("diffabs").warning(
                "%s: compiled programs are not kept there, because other users may write to it", folder
            )
            return None
        if not os.access(folder, os.R_OK | os.W_OK | os.X_OK):
            return None
        files.make_room(folder, "*", ROOM)
    except (OSError, RuntimeError):  # RuntimeError: no home
        return None
    warnings.filterwarnings("ignore", "Error (reading|writing) persistent compilation cache", UserWarning)
    jax.config.update("jax_compilation_cache_dir", str(folder))
    if "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS" not in os.environ:
        jax.config.update("jax_persistent_cache_min_compile_time_secs", WORTH)
    return folder


def _user_folder() -> pathlib.Path:
    """Return the system's folder for caches. Raises RuntimeError for a user without home."""
    if sys.platform == "darwin":
        return pathlib.Path.home() / "Library" / "Caches"
    cache_home = pathlib.Path(os.environ.get("LOCALAPPDATA" if sys.platform == "win32" else "XDG_CACHE_HOME", ""))
    if cache_home.is_absolute():
        return cache_home
    return pathlib.Path.home() / ("AppData/Local" if sys.platform == "win32" else ".cache")
