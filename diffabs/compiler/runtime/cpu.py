"""Programs on the processor: C++ text, compiled to a library and registered with XLA."""

import ctypes
import pathlib
import threading

import jax

from diffabs.compiler.autodiff.transpose import Sweeps
from diffabs.compiler.emit import cpp
from diffabs.compiler.emit.sweeps import emit_sweeps
from diffabs.compiler.listing import count_by_level
from diffabs.compiler.program import ScalarProgram
from diffabs.compiler.runtime import toolchain
from diffabs.core.types import PyTree
from diffabs.host.process import core_count

MAX_STEP_LINES = 10_000  # operations times vectors; a larger program gets fewer vectors, or compiling takes too long
LIBRARY_NAME_PREFIX = "diffabs_kernel_"
_lock = threading.Lock()
_loaded: dict[str, PyTree] = {}


def build_target(program: ScalarProgram | Sweeps, shape: cpp.LaunchShape) -> str:
    """Return the name of a program's FFI target of XLA; compile and register the program if necessary.

    A large program, or one with derivatives, gets fewer vectors than `shape` says.
    """
    if isinstance(program, Sweeps):
        return register_library(toolchain.build_library(emit_sweeps(program, shape._replace(vectors=1))))
    # Tangents are independent of each other too and hide latency, so they replace vectors of the block.
    vectors = shape.vectors // max(1, program.tangents)
    operations = count_by_level(program)["step"]
    shape = shape._replace(vectors=max(1, min(vectors, MAX_STEP_LINES // max(1, operations))))
    return register_library(toolchain.build_library(cpp.emit_cpp(program, shape)))


def register_library(path: pathlib.Path) -> str:
    """Return the name of a library's FFI target of XLA; load and register it if this process has not."""
    name = f"{LIBRARY_NAME_PREFIX}{path.stem[:32]}"
    with _lock:
        if name not in _loaded:
            try:
                handler = ctypes.CDLL(str(path)).diffabs_kernel
            except (OSError, AttributeError) as error:  # such as in a folder without execution rights
                raise toolchain.NoCompiler(f"{path.parent}: {error}") from None
            # The table keeps the handler alive: XLA holds only its address.
            jax.ffi.register_ffi_target(name, jax.ffi.pycapsule(handler), platform="cpu")
            _loaded[name] = handler, path
    return name


def thread_count() -> int:
    """Return the number of threads of a launch: one for each core, for any number of JAX's CPU devices."""
    # Launches on several devices at once share the cores: a thread takes its next lane when it has time.
    return core_count()
