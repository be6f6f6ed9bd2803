"""Compiled programs are kept between commands: in the user's cache folder, by JAX, which names them by what they are.

Compiling is most of what a command costs. Who configures JAX's own cache decides; DIFFABS_NO_CACHE=1 turns it off."""

import logging
import os
import pathlib
import sys
import warnings

import jax

from diffabs.core import files, provenance

OFF_VARIABLE = "DIFFABS_NO_CACHE"  # if set, nothing is kept
WORTH = 0.05  # s of compiling, from which a program is kept
ROOM = 256 * 2**20  # bytes on disk; beyond, the oldest half goes
USER_VARIABLES = ("JAX_COMPILATION_CACHE_DIR", "JAX_ENABLE_COMPILATION_CACHE")  # by which a user has decided


def use_compilation_cache() -> pathlib.Path | None:
    """Return the folder that JAX from now on keeps compiled programs in, or None: without one everything works, and
    compiles. Nothing is said of a folder that cannot be written or of a damaged entry."""
    chosen = jax.config.values.get("jax_compilation_cache_dir")
    if os.environ.get(OFF_VARIABLE) or any(name in os.environ for name in USER_VARIABLES) or chosen:
        return None
    try:
        folder = _user_folder() / "diffabs" / f"jax-{provenance.processor()}"
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        if files.others_may_write(folder):  # what is read from there is run
            logging.getLogger("diffabs").warning(
                "%s: nothing is kept there, because other users may write to it", folder
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
    """Return where this system wants caches. Raises RuntimeError where the user has no home."""
    if sys.platform == "darwin":
        return pathlib.Path.home() / "Library" / "Caches"
    given = pathlib.Path(os.environ.get("LOCALAPPDATA" if sys.platform == "win32" else "XDG_CACHE_HOME", ""))
    if given.is_absolute():
        return given
    return pathlib.Path.home() / ("AppData/Local" if sys.platform == "win32" else ".cache")
