"""C++ to a shared library, by a compiler of this machine, kept in the user's cache folder.

A library's name is the digest of everything that it is made of: text, headers, compiler, flags, processor. It is
written whole and then named, so that two processes, or one that was killed, leave nothing that is half a library."""

import contextlib
import ctypes
import functools
import hashlib
import importlib.util
import os
import pathlib
import platform
import shutil
import subprocess
import sys
import tempfile
from typing import NamedTuple

import jax.ffi

from diffabs.core import files, stopwatch

NATIVE = pathlib.Path(__file__).parent / "native"
CACHE = "DIFFABS_KERNEL_CACHE"  # the folder of the libraries, if set
COMPILER = "DIFFABS_KERNEL_COMPILER"  # the command, if set; an empty one is none
CANDIDATES = (["c++"], ["clang++"], ["g++"])
# No flag may change what is finite, nor what a comparison with NaN says: nothing of -ffast-math but what concerns the
# errno of C's functions, and traps, which nobody looks at. Not at linking, either: that would set how the whole process
# treats the smallest numbers.
FLAGS = (
    *("-std=c++17", "-O2", "-march=native", "-ffp-contract=fast", "-fno-math-errno", "-fno-trapping-math", "-fwrapv"),
    *("-fno-exceptions", "-fno-rtti", "-fPIC", "-shared", "-pthread", "-w"),
)
LONGEST = 600  # s
ROOM = 1 << 28  # bytes of libraries, some 800; beyond, the half that was not used for longest goes


class NoCompiler(Exception):
    """Nothing here makes a library of C++; why."""


class Compiler(NamedTuple):
    """A command that works, and what it says it is."""

    command: tuple[str, ...]
    version: str


@functools.cache
def _tried(command: tuple[str, ...]) -> Compiler | str:
    """The compiler of a command, or why it is none: it has to make a library that this process can load. That it did so
    once is noted beside the libraries."""
    try:
        version = subprocess.run([*command, "--version"], capture_output=True, text=True, timeout=LONGEST)
        made = Compiler(command, version.stdout.partition("\n")[0].strip())
        note = cache_folder() / f".{_digest('works', made)[:32]}"
        if not note.is_file():
            _try(command)
            with contextlib.suppress(OSError):
                note.parent.mkdir(parents=True, exist_ok=True)
                note.touch()
    except (OSError, subprocess.TimeoutExpired, NoCompiler) as error:
        return f"{' '.join(command)}: {error}"
    return made


def _try(command: tuple[str, ...]) -> None:
    with tempfile.TemporaryDirectory(prefix="diffabs-") as folder:
        source, library = pathlib.Path(folder) / "one.cpp", pathlib.Path(folder) / "one.so"
        source.write_text('#include "functions.h"\nextern "C" double one(double x) { return k_exp(all(x))[0]; }\n')
        _run(command, source, library)
        ctypes.CDLL(str(library))


def compiler() -> Compiler:
    """Return the first compiler that works: c++, clang++, g++, then that of the package ziglang. Raises NoCompiler."""
    said = os.environ.get(COMPILER)
    if said is not None and not said.strip():
        raise NoCompiler(f"{COMPILER} is empty")
    commands = [said.split()] if said else [command for command in CANDIDATES if shutil.which(command[0])]
    if not said and importlib.util.find_spec("ziglang"):
        commands.append([sys.executable, "-m", "ziglang", "cc", "-x", "c++"])
    tried = [_tried(tuple(command)) for command in commands]
    works = [one for one in tried if isinstance(one, Compiler)]
    if not works:
        raise NoCompiler("; ".join(map(str, tried)) or 'no C++ compiler; pip install "diffabs[kernel]" brings one')
    return works[0]


def library(text: str) -> pathlib.Path:
    """Return the file of the library of a text, which is compiled if it is not there yet. Raises NoCompiler, also for a
    folder that cannot be written."""
    made = compiler()
    digest = _digest(text, made)
    folder = cache_folder()
    path = folder / f"{digest}.so"
    if path.is_file():
        with contextlib.suppress(OSError):  # of somebody else
            os.utime(path)
        return path
    try:
        folder.mkdir(parents=True, exist_ok=True)
        files.make_room(folder, "*.so", ROOM)
        with tempfile.TemporaryDirectory(prefix=f".{digest[:16]}-", dir=folder) as own:
            source, result = pathlib.Path(own) / "kernel.cpp", pathlib.Path(own) / "kernel.so"
            source.write_text(text)
            with stopwatch.compiling():
                _run(made.command, source, result)
            os.replace(result, path)
    except (OSError, subprocess.TimeoutExpired) as error:
        raise NoCompiler(f"no kernel in {folder}: {getattr(error, 'strerror', None) or error}") from None
    return path


def cache_folder() -> pathlib.Path:
    """Return the folder in which libraries are kept: $DIFFABS_KERNEL_CACHE, or the user's for caches."""
    if said := os.environ.get(CACHE):
        return pathlib.Path(said)
    if sys.platform == "darwin":
        return pathlib.Path.home() / "Library" / "Caches" / "diffabs" / "kernel"
    return pathlib.Path(os.environ.get("XDG_CACHE_HOME") or pathlib.Path.home() / ".cache") / "diffabs" / "kernel"


def described() -> dict[str, str]:
    """Return what decides the bits besides the text: compiler, flags, processor. Raises NoCompiler."""
    return {"compiler": compiler().version, "flags": " ".join(FLAGS), "processor": _processor()}


def _run(command: tuple[str, ...], source: pathlib.Path, result: pathlib.Path) -> None:
    include = [f"-I{NATIVE}", f"-I{jax.ffi.include_dir()}"]
    done = subprocess.run(
        [*command, *FLAGS, *include, "-o", str(result), str(source), "-lm"],
        capture_output=True,
        text=True,
        timeout=LONGEST,
        stdin=subprocess.DEVNULL,
    )
    if done.returncode or not result.is_file():
        lines = [line for line in done.stderr.splitlines() if line.strip()] or [f"exit status {done.returncode}"]
        errors = [line for line in lines if "error" in line]
        raise NoCompiler(f"{' '.join(command)}: {(errors or lines)[0][:300]}")


def _digest(text: str, made: Compiler) -> str:
    interface = pathlib.Path(jax.ffi.include_dir()) / "xla" / "ffi" / "api" / "c_api.h"
    headers = [path.read_bytes() for path in (*sorted(NATIVE.glob("*.h")), interface)]
    said = [text.encode(), *headers, repr((made, FLAGS, _processor())).encode()]
    return hashlib.sha256(b"".join(hashlib.sha256(part).digest() for part in said)).hexdigest()


@functools.cache
def _processor() -> str:
    """The processor's kind: what -march=native makes of it differs."""
    lines = pathlib.Path("/proc/cpuinfo").read_text().splitlines() if os.path.exists("/proc/cpuinfo") else []
    wanted = [line.partition(":")[2].strip() for line in lines if line.startswith(("model name", "flags", "Features"))]
    features = hashlib.sha256("\n".join(sorted(set(wanted))).encode()).hexdigest()[:12] if wanted else ""
    return f"{platform.machine()} {platform.processor() or next(iter(wanted), '')} {features}".strip()
