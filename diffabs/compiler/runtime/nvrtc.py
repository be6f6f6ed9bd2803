"""Compilation of CUDA C++ to machine code of a given architecture by NVRTC, NVIDIA's runtime compiler.

NVRTC comes with JAX for GPUs. It needs neither a GPU nor a driver. The cache of `library_cache` keeps the machine code;
the digest of text, headers, flags, NVRTC's version and architecture identifies it.
"""

import ctypes
import functools
import hashlib
import importlib.util
import pathlib
import re

from diffabs.compiler.runtime import library_cache
from diffabs.compiler.runtime.toolchain import NATIVE_FOLDER, NoCompiler
from diffabs.host import files

HEADERS = ("lane.h", "threads.h")
# Flags must preserve subnormal numbers and IEEE division and roots. The last two only control messages.
NVRTC_FLAGS = (
    *("-std=c++17", "-default-device", "-fmad=true", "-ftz=false", "-prec-div=true", "-prec-sqrt=true"),
    *("-Xptxas=-v", "-diag-suppress=177"),
)


def build_cubin(text: str, architecture: str) -> pathlib.Path:
    """Return the file with the machine code (cubin) of a CUDA C++ text; compile it unless the cache holds it.

    A file `.log` beside it holds the assembler's messages on register usage.
    """
    headers = [(NATIVE_FOLDER / name).read_bytes() for name in HEADERS]
    sources = [text.encode(), *headers, repr((NVRTC_FLAGS, nvrtc_version(), architecture)).encode()]
    digest = hashlib.sha256(b"".join(hashlib.sha256(part).digest() for part in sources)).hexdigest()
    try:
        if path := library_cache.find_library(digest, ".cubin"):
            return path
        code, log = _compile_cubin(text, architecture, headers)
        path = library_cache.write_library(digest, ".cubin", code)
        files.write_file(path.with_suffix(".log"), log.encode())
        return path
    except OSError as error:
        raise NoCompiler(f"no kernel in {library_cache.cache_folder()}: {error.strerror or error}") from None


def parse_register_usage(log: str) -> dict[str, dict[str, int]]:
    """Return, by kernel name, a thread's "registers" and its "spilled" bytes, of stores and loads together."""
    usage = {}
    for part in re.split(r"Compiling entry function", log)[1:]:
        name = re.search(r"'(\w+)'", part)
        used, spilled = re.search(r"Used (\d+) registers", part), re.findall(r"(\d+) bytes spill", part)
        if name and used:
            usage[name[1]] = {"registers": int(used[1]), "spilled": sum(map(int, spilled))}
    return usage


@functools.cache
def nvrtc_version() -> tuple[int, int]:
    """Return NVRTC's major and minor version."""
    major, minor = ctypes.c_int(), ctypes.c_int()
    _load_nvrtc().nvrtcVersion(ctypes.byref(major), ctypes.byref(minor))
    return major.value, minor.value


@functools.cache
def _load_nvrtc() -> ctypes.CDLL:
    """Return NVRTC of the package nvidia-cuda-nvrtc (CUDA 13) or nvidia-cuda-nvrtc-cu12, or of the system."""
    nvidia = importlib.util.find_spec("nvidia")
    folders = [*(nvidia.submodule_search_locations or ())] if nvidia else []
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
    """Return the machine code of a CUDA C++ text and NVRTC's messages; raise NoCompiler if it does not compile."""
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


def _part(nvrtc: object, name: str, program: ctypes.c_void_p) -> bytes:
    """Return an output of an NVRTC program: "ProgramLog" or "CUBIN" (`name`)."""
    size = ctypes.c_size_t()
    getattr(nvrtc, f"nvrtcGet{name}Size")(program, ctypes.byref(size))
    out = ctypes.create_string_buffer(size.value)
    getattr(nvrtc, f"nvrtcGet{name}")(program, out)
    return out.raw
