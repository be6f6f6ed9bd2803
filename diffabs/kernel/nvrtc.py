"""CUDA C++ to machine code of a named architecture, by NVIDIA's runtime compiler, which comes with JAX for GPUs.

It needs neither a GPU nor a driver. Kept in the user's cache folder as libraries of the processor are (`compilers`)."""

import ctypes
import functools
import hashlib
import importlib.util
import pathlib
import re
from typing import Any

from diffabs.core import files
from diffabs.kernel import binaries
from diffabs.kernel.compilers import NATIVE_FOLDER, NoCompiler

HEADERS = ("lane.h", "threads.h")
# Nothing that changes what is finite: the smallest numbers stay, division and roots are IEEE's. The last two only tell.
NVRTC_FLAGS = (
    *("-std=c++17", "-default-device", "-fmad=true", "-ftz=false", "-prec-div=true", "-prec-sqrt=true"),
    *("-Xptxas=-v", "-diag-suppress=177"),
)


def build_cubin(text: str, architecture: str) -> pathlib.Path:
    """Return the file of the machine code of a text, compiled if it is not there yet; beside it (`.log`) what the
    assembler said of registers. Raises NoCompiler.

    architecture: as in sm_90"""
    headers = [(NATIVE_FOLDER / name).read_bytes() for name in HEADERS]
    said = [text.encode(), *headers, repr((NVRTC_FLAGS, nvrtc_version(), architecture)).encode()]
    digest = hashlib.sha256(b"".join(hashlib.sha256(part).digest() for part in said)).hexdigest()
    try:
        if path := binaries.find_library(digest, ".cubin"):
            return path
        code, log = _compile_cubin(text, architecture, headers)
        path = binaries.write_library(digest, ".cubin", code)
        files.write_file(path.with_suffix(".log"), log.encode())
        return path
    except OSError as error:
        raise NoCompiler(f"no kernel in {binaries.cache_folder()}: {error.strerror or error}") from None


def parse_register_usage(log: str) -> dict[str, dict[str, int]]:
    """Return, of each kernel that the assembler tells of, how many registers a thread has, and bytes that it spills."""
    found = {}
    for part in re.split(r"Compiling entry function", log)[1:]:
        name = re.search(r"'(\w+)'", part)
        used, spilled = re.search(r"Used (\d+) registers", part), re.findall(r"(\d+) bytes spill", part)
        if name and used:
            found[name[1]] = {"registers": int(used[1]), "spilled": sum(map(int, spilled))}
    return found


@functools.cache
def nvrtc_version() -> tuple[int, int]:
    """Return the compiler's version. Raises NoCompiler."""
    major, minor = ctypes.c_int(), ctypes.c_int()
    _load_nvrtc().nvrtcVersion(ctypes.byref(major), ctypes.byref(minor))
    return major.value, minor.value


@functools.cache
def _load_nvrtc() -> Any:
    """Of the packages nvidia-cuda-nvrtc (CUDA 13) and nvidia-cuda-nvrtc-cu12, or of the system."""
    found = importlib.util.find_spec("nvidia")
    folders = [*(found.submodule_search_locations or ())] if found else []
    paths = [
        str(p) for folder in folders for p in sorted(pathlib.Path(folder).glob("*/lib/libnvrtc.so.*"), reverse=True)
    ]
    for path in (*paths, "libnvrtc.so.13", "libnvrtc.so.12"):
        try:
            return ctypes.CDLL(path)
        except OSError:
            continue
    raise NoCompiler("no CUDA compiler; the package nvidia-cuda-nvrtc, which jax[cuda13] brings, has one")


def _compile_cubin(text: str, architecture: str, headers: list[bytes]) -> tuple[bytes, str]:
    nvrtc, program = _load_nvrtc(), ctypes.c_void_p()
    names = (ctypes.c_char_p * len(HEADERS))(*(name.encode() for name in HEADERS))
    contents = (ctypes.c_char_p * len(headers))(*headers)
    nvrtc.nvrtcCreateProgram(ctypes.byref(program), text.encode(), b"kernel.cu", len(HEADERS), contents, names)
    try:
        options = [option.encode() for option in (f"-arch={architecture}", *NVRTC_FLAGS)]
        failed = nvrtc.nvrtcCompileProgram(program, len(options), (ctypes.c_char_p * len(options))(*options))
        log = _part(nvrtc, "ProgramLog", program).rstrip(b"\0").decode(errors="replace")
        if failed:
            lines = [line for line in log.splitlines() if "error" in line] or [f"NVRTC says {failed}"]
            raise NoCompiler(f"NVRTC, {architecture}: {lines[0][:300]}")
        return _part(nvrtc, "CUBIN", program), log
    finally:
        nvrtc.nvrtcDestroyProgram(ctypes.byref(program))


def _part(nvrtc: Any, name: str, program: ctypes.c_void_p) -> bytes:
    size = ctypes.c_size_t()
    getattr(nvrtc, f"nvrtcGet{name}Size")(program, ctypes.byref(size))
    out = ctypes.create_string_buffer(size.value)
    getattr(nvrtc, f"nvrtcGet{name}")(program, out)
    return out.raw
