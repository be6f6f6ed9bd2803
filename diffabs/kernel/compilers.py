"""C++ to a shared library, by a compiler of this machine, kept in the user's cache folder (`binaries`).

A library is found by the digest of everything that it is made of: text, headers, compiler, flags, processor."""

import contextlib
import ctypes
import functools
import hashlib
import importlib.util
import os
import pathlib
import platform
import shlex
import shutil
import signal
import subprocess
import sys
import tempfile
from typing import NamedTuple

import jax.ffi

from diffabs.core import stopwatch
from diffabs.kernel.binaries import cache_folder, find_library, make_cache_folder, write_library

NATIVE_FOLDER = pathlib.Path(__file__).parent / "native"
COMPILER = "DIFFABS_KERNEL_COMPILER"  # the compiler's command; set but empty, no compiler is used
CANDIDATES = (["c++"], ["clang++"], ["g++"])
# No flag may change NaN or infinity: of -ffast-math only no-math-errno and no-trapping-math. It must not be given at
# linking either, where it changes how the whole process treats subnormal numbers.
CPP_FLAGS = (
    *("-std=c++17", "-O2", "-march=native", "-ffp-contract=fast", "-fno-math-errno", "-fno-trapping-math", "-fwrapv"),
    *("-fno-exceptions", "-fno-rtti", "-fPIC", "-shared", "-pthread", "-w"),
)
COMPILE_TIMEOUT_S = 300  # that a compiler may take for a kernel; the largest take some 20 s
PROBE_TIMEOUT_S = 30  # and to say its version, or to make a library of one line


class NoCompiler(Exception):
    """No C++ compiler here makes a library. The message says why."""


class Compiler(NamedTuple):
    """A command that works, and what it says it is."""

    command: tuple[str, ...]
    version: str


@functools.cache
def _probe_compiler(command: tuple[str, ...]) -> Compiler | str:
    """The compiler of a command, or why it is none: it has to make a library that this process can load. That it did so
    once is noted beside the libraries."""
    try:
        version = _run_command([*command, "--version"], PROBE_TIMEOUT_S)
        made = Compiler(command, version.stdout.partition("\n")[0].strip())
        note = cache_folder() / f".{_digest('works', made)[:32]}"
        if not note.is_file():
            _check_loads(command)
            with contextlib.suppress(OSError):
                (make_cache_folder() / note.name).touch()
    except (OSError, NoCompiler) as error:
        return f"{' '.join(command)}: {error}"
    return made


def _check_loads(command: tuple[str, ...]) -> None:
    """Make a library of one line and load it. Raises NoCompiler or OSError."""
    with tempfile.TemporaryDirectory(prefix="diffabs-") as folder:
        source, library = pathlib.Path(folder) / "one.cpp", pathlib.Path(folder) / "one.so"
        source.write_text('#include "functions.h"\nextern "C" double one(double x) { return k_exp(all(x))[0]; }\n')
        _compile(command, source, library, PROBE_TIMEOUT_S)
        ctypes.CDLL(str(library))


def find_compiler() -> Compiler:
    """Return the first compiler that works: c++, clang++, g++, then that of the package ziglang. Raises NoCompiler."""
    said = os.environ.get(COMPILER)
    if said is not None and not said.strip():
        raise NoCompiler(f"{COMPILER} is empty")
    commands = [shlex.split(said)] if said else [command for command in CANDIDATES if shutil.which(command[0])]
    if not said and importlib.util.find_spec("ziglang"):
        commands.append([sys.executable, "-m", "ziglang", "cc", "-x", "c++"])
    reasons = []
    for command in commands:
        tried = _probe_compiler(tuple(command))
        if isinstance(tried, Compiler):
            return tried
        reasons.append(tried)
    raise NoCompiler("; ".join(reasons) or 'no C++ compiler; pip install ".[kernel]" in a clone brings one')


def build_library(text: str) -> pathlib.Path:
    """Return the file of the library of a text, which is compiled if it is not there yet. Raises NoCompiler, also for a
    folder that cannot be written or that others may write to."""
    made = find_compiler()
    digest = _digest(text, made)
    try:
        if path := find_library(digest, ".so"):
            return path
        with tempfile.TemporaryDirectory(prefix=f".{digest[:16]}-", dir=make_cache_folder()) as own:
            source, result = pathlib.Path(own) / "kernel.cpp", pathlib.Path(own) / "kernel.so"
            source.write_text(text)
            with stopwatch.count_as_compiling():
                _compile(made.command, source, result, COMPILE_TIMEOUT_S)
            return write_library(digest, ".so", result.read_bytes())
    except OSError as error:
        raise NoCompiler(f"no kernel in {cache_folder()}: {error.strerror or error}") from None


def describe_compiler() -> dict[str, str]:
    """Return what decides the bits besides the text: compiler, flags, processor. Raises NoCompiler."""
    return {"compiler": find_compiler().version, "flags": " ".join(CPP_FLAGS), "processor": _processor()}


def _compile(command: tuple[str, ...], source: pathlib.Path, result: pathlib.Path, longest: float) -> None:
    include = [f"-I{NATIVE_FOLDER}", f"-I{jax.ffi.include_dir()}"]
    done = _run_command([*command, *CPP_FLAGS, *include, "-o", str(result), str(source), "-lm"], longest)
    if done.returncode or not result.is_file():
        lines = [line for line in done.stderr.splitlines() if line.strip()] or [f"exit status {done.returncode}"]
        errors = [line for line in lines if "error" in line]
        raise NoCompiler(f"{' '.join(command)}: {(errors or lines)[0][:300]}")


def _run_command(words: list[str], longest: float) -> subprocess.CompletedProcess[str]:
    """Run a command for at most so many seconds. Raises NoCompiler for one that takes longer, OSError where the
    command does not exist."""
    told = {"stdin": subprocess.DEVNULL, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    with subprocess.Popen(words, **told, start_new_session=True) as process:
        try:
            out, errors = process.communicate(timeout=longest)
        except BaseException as error:
            # A compiler starts others, which hold the pipes: all of its session are ended, or `with` waits for them.
            with contextlib.suppress(OSError):
                os.killpg(process.pid, signal.SIGKILL) if hasattr(os, "killpg") else process.kill()
            if isinstance(error, subprocess.TimeoutExpired):
                raise NoCompiler(f"{words[0]} did not end within {longest:g} s and was stopped") from None
            raise
        return subprocess.CompletedProcess(words, process.returncode, out, errors)


def _digest(text: str, made: Compiler) -> str:
    interface = pathlib.Path(jax.ffi.include_dir()) / "xla" / "ffi" / "api" / "c_api.h"
    headers = [path.read_bytes() for path in (*sorted(NATIVE_FOLDER.glob("*.h")), interface)]
    said = [text.encode(), *headers, repr((made, CPP_FLAGS, _processor())).encode()]
    return hashlib.sha256(b"".join(hashlib.sha256(part).digest() for part in said)).hexdigest()


@functools.cache
def _processor() -> str:
    """The processor's kind: what -march=native makes of it differs."""
    lines = pathlib.Path("/proc/cpuinfo").read_text().splitlines() if os.path.exists("/proc/cpuinfo") else []
    wanted = [line.partition(":")[2].strip() for line in lines if line.startswith(("model name", "flags", "Features"))]
    features = hashlib.sha256("\n".join(sorted(set(wanted))).encode()).hexdigest()[:12] if wanted else ""
    return f"{platform.machine()} {platform.processor() or next(iter(wanted), '')} {features}".strip()
