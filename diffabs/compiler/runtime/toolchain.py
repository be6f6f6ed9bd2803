"""Compilation of C++ to a shared library by a compiler of this machine, with the cache of `library_cache`.

The digest of text, headers (ours and XLA's `c_api.h`), compiler, flags and processor identifies a library.
"""

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
from typing import NamedTuple

import jax.ffi

from diffabs.compiler.runtime.library_cache import cache_folder, find_library, make_cache_folder, write_library
from diffabs.host import files, stopwatch

NATIVE_FOLDER = pathlib.Path(__file__).parents[1] / "native"
COMPILER = "DIFFABS_KERNEL_COMPILER"  # environment variable: compiler command; empty means no compiler
CANDIDATES = (["c++"], ["clang++"], ["g++"])
# Flags must preserve NaN and infinity, so -ffast-math is reduced to no-math-errno and no-trapping-math. Linking with
# -ffast-math is wrong too: it makes the whole process flush subnormal numbers to zero.
CPP_FLAGS = (
    *("-std=c++17", "-O2", "-march=native", "-ffp-contract=fast", "-fno-math-errno", "-fno-trapping-math", "-fwrapv"),
    *("-fno-exceptions", "-fno-rtti", "-fPIC", "-shared", "-pthread", "-w"),
)
COMPILE_TIMEOUT_S = 300  # for a kernel; the largest take about 20 s
PROBE_TIMEOUT_S = 30  # for the version output, or for a library of one line


class NoCompiler(Exception):
    """An error: this machine cannot compile a kernel, or cannot load the result. The message gives the reason."""


class Compiler(NamedTuple):
    """A compiler command that works, and the first line of its version output."""

    command: tuple[str, ...]
    version: str


@functools.cache
def _probe_compiler(command: tuple[str, ...]) -> Compiler | str:
    """Return the compiler of a command, or a text that says why it does not work.

    A compiler works if it makes a library that this process can load. After a success, an empty file in the cache
    folder lets later processes skip the trial.
    """
    try:
        version = _run_command([*command, "--version"], PROBE_TIMEOUT_S)
        compiler = Compiler(command, version.stdout.partition("\n")[0].strip())
        note = cache_folder() / f".{_digest('works', compiler)[:32]}"
        if not note.is_file():
            _check_loads(command)
            with contextlib.suppress(OSError):
                (make_cache_folder() / note.name).touch()
    except (OSError, NoCompiler) as error:
        return f"{' '.join(command)}: {error}"
    return compiler


def _check_loads(command: tuple[str, ...]) -> None:
    """Compile a library of one function and load it; raise NoCompiler or OSError if that fails."""
    with files.temporary_folder("diffabs-") as folder:
        source, library = folder / "one.cpp", folder / "one.so"
        # functions.h needs vector extensions and headers, so this line fails where a kernel would fail.
        source.write_text('#include "functions.h"\nextern "C" double one(double x) { return k_exp(all(x))[0]; }\n')
        _compile(command, source, library, PROBE_TIMEOUT_S)
        ctypes.CDLL(str(library))


def find_compiler() -> Compiler:
    """Return the first C++ compiler that makes a library which loads: c++, clang++, g++, then that of the package
    ziglang.

    $DIFFABS_KERNEL_COMPILER replaces this list by one command; if it is set but empty, no compiler is used.
    """
    configured = os.environ.get(COMPILER)
    if configured is not None and not configured.strip():
        raise NoCompiler(f"{COMPILER} is empty")
    commands = (
        [shlex.split(configured)] if configured else [command for command in CANDIDATES if shutil.which(command[0])]
    )
    if not configured and importlib.util.find_spec("ziglang"):
        commands.append([sys.executable, "-m", "ziglang", "cc", "-x", "c++"])
    reasons = []
    for command in commands:
        tried = _probe_compiler(tuple(command))
        if isinstance(tried, Compiler):
            return tried
        reasons.append(tried)
    raise NoCompiler("; ".join(reasons) or 'no C++ compiler; pip install ".[kernel]" in a clone brings one')


def build_library(text: str, flags: tuple[str, ...] = ()) -> pathlib.Path:
    """Compile a C++ text, unless the cache holds its library, and return the library's file.

    `flags` replaces `CPP_FLAGS` unless empty. An unusable cache folder (not writable, or writable for other users)
    raises NoCompiler.
    """
    compiler = find_compiler()
    own_flags = (flags,) if flags else ()
    digest = _digest(text, compiler, *own_flags)
    try:
        if path := find_library(digest, ".so"):
            return path
        # Compile inside the cache folder, which only this user can write to.
        with files.temporary_folder(f".{digest[:16]}-", make_cache_folder()) as folder:
            source, result = folder / "kernel.cpp", folder / "kernel.so"
            source.write_text(text)
            with stopwatch.count_as_compiling():
                _compile(compiler.command, source, result, COMPILE_TIMEOUT_S, *own_flags)
            return write_library(digest, ".so", result.read_bytes())
    except OSError as error:
        raise NoCompiler(f"no kernel in {cache_folder()}: {error.strerror or error}") from None


def describe_compiler() -> dict[str, str]:
    """Return "compiler", "flags", "processor": with a program's text they fix a kernel's numbers to the last bit."""
    return {"compiler": find_compiler().version, "flags": " ".join(CPP_FLAGS), "processor": _processor()}


def _compile(
    command: tuple[str, ...], source: pathlib.Path, result: pathlib.Path, longest: float, flags: tuple[str, ...] = ()
) -> None:
    """Compile a C++ file to the library `result` in at most `longest` seconds; raise NoCompiler if that fails."""
    include = [f"-I{NATIVE_FOLDER}", f"-I{jax.ffi.include_dir()}"]
    process = _run_command([*command, *(flags or CPP_FLAGS), *include, "-o", str(result), str(source), "-lm"], longest)
    if process.returncode or not result.is_file():
        lines = [line for line in process.stderr.splitlines() if line.strip()] or [f"exit status {process.returncode}"]
        errors = [line for line in lines if "error" in line]
        raise NoCompiler(f"{' '.join(command)}: {(errors or lines)[0][:300]}")


def _run_command(words: list[str], longest: float) -> subprocess.CompletedProcess[str]:
    """Run a command for at most `longest` seconds; raise NoCompiler on timeout, OSError if there is no such command."""
    options = {"stdin": subprocess.DEVNULL, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    with subprocess.Popen(words, **options, start_new_session=True) as process:
        try:
            out, errors = process.communicate(timeout=longest)
        except BaseException as error:
            # A compiler starts child processes that hold the pipes. Kill the whole session, or `with` waits for them.
            with contextlib.suppress(OSError):
                os.killpg(process.pid, signal.SIGKILL) if hasattr(os, "killpg") else process.kill()
            if isinstance(error, subprocess.TimeoutExpired):
                raise NoCompiler(f"{words[0]} did not end within {longest:g} s and was stopped") from None
            raise
        return subprocess.CompletedProcess(words, process.returncode, out, errors)


def _digest(text: str, compiler: Compiler, flags: tuple[str, ...] = ()) -> str:
    """Return the digest of every input of the compilation of `text` (64 hexadecimal digits)."""
    # The FFI header belongs to the digest: a new jaxlib may change the layout of the call frame.
    interface = pathlib.Path(jax.ffi.include_dir()) / "xla" / "ffi" / "api" / "c_api.h"
    headers = [path.read_bytes() for path in (*sorted(NATIVE_FOLDER.glob("*.h")), interface)]
    sources = [text.encode(), *headers, repr((compiler, CPP_FLAGS, _processor())).encode()]
    sources += [repr(flags).encode()] if flags else []
    return hashlib.sha256(b"".join(hashlib.sha256(part).digest() for part in sources)).hexdigest()


@functools.cache
def _processor() -> str:
    """Return a name for the processor with a digest of its features, because -march=native depends on them."""
    lines = pathlib.Path("/proc/cpuinfo").read_text().splitlines() if os.path.exists("/proc/cpuinfo") else []
    features_text = [
        line.partition(":")[2].strip() for line in lines if line.startswith(("model name", "flags", "Features"))
    ]
    features = hashlib.sha256("\n".join(sorted(set(features_text))).encode()).hexdigest()[:12] if features_text else ""
    return f"{platform.machine()} {platform.processor() or next(iter(features_text), '')} {features}".strip()
