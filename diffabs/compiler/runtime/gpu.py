"""Launches on an NVIDIA GPU: machine code of `nvrtc`, started through the CUDA driver on XLA's stream.

Only this module uses the driver and `jax.experimental.buffer_callback`, which makes a launch an operation of XLA.
"""

import ctypes
import functools
import pathlib
import threading
from typing import Any, NamedTuple

import jax
import numpy as np
from jax.experimental.buffer_callback import buffer_callback

from diffabs.compiler.emit import cuda
from diffabs.compiler.emit.cpp import LaunchShape
from diffabs.compiler.ir import UpdateLevel
from diffabs.compiler.program import ScalarProgram
from diffabs.compiler.runtime import nvrtc
from diffabs.compiler.runtime.toolchain import NoCompiler
from diffabs.core.types import PyTree
from diffabs.host.process import default_devices

# CUDA's enumerators CU_POINTER_ATTRIBUTE_DEVICE_ORDINAL and CU_DEVICE_ATTRIBUTE_MULTIPROCESSOR_COUNT.
ORDINAL, MULTIPROCESSORS = 9, 16
_lock = threading.Lock()


def find_gpu() -> "CudaDevice | None":
    """Return the GPU that JAX runs on by default, or None if JAX runs on a CPU by default."""
    home = default_devices()[0]
    if home.platform == "cpu":
        return None
    capability = getattr(home, "compute_capability", "")
    if not capability.replace(".", "").isdigit():
        raise NoCompiler(f"kernels are for processors and NVIDIA's GPUs, not for {home.platform} {capability}".strip())
    return _cuda_device(f"sm_{capability.replace('.', '')}")


def call_kernel(
    program: ScalarProgram, shape: LaunchShape, arguments: list[PyTree], results: list[PyTree]
) -> list[PyTree]:
    """Compile a program and return the carry's arrays after all lanes have ended, as an operation of XLA on the GPU.

    `arguments` are uniform arrays, arrays of the lanes and arrays of the carry; the last two have an axis of lanes.
    """
    on = find_gpu()
    assert on is not None
    source = cuda.emit_cuda(program, shape)
    code = on.compile(source.text)
    sizes = [len(program.sizes[level]) for level in (UpdateLevel.UNIFORM, UpdateLevel.LANE, UpdateLevel.STEP)]
    count = arguments[-1].shape[0]

    def start(context: PyTree, outs: Any, *ins: Any) -> None:
        *addresses, room = [on.address(buffer) for buffer in outs]
        if count:
            on.start(
                code, _pack_addresses([*map(on.address, ins), *addresses], [*sizes, sizes[-1]]), room, count, context
            )

    # XLA allocates the kernels' own memory as one more result, which is dropped.
    whole = [*results, jax.ShapeDtypeStruct((source.room,), np.uint8)]
    return buffer_callback(start, whole)(*arguments)[:-1]


def _pack_addresses(addresses: list[int], sizes: list[int]) -> ctypes.Array[ctypes.c_void_p]:
    """Return the struct `Arrays` of `threads.h`: groups of `sizes` addresses, each with one null pointer at its end."""
    remaining, pointers = iter(addresses), []
    for size in sizes:
        # C++ has no arrays of length 0, so every group has one more entry.
        pointers += [*(next(remaining) for _ in range(size)), 0]
    return (ctypes.c_void_p * len(pointers))(*pointers)


# CUDA -----------------------------------------------------------------------------------------------------------------


@functools.cache
def _cuda_device(architecture: str) -> "CudaDevice":
    return CudaDevice(architecture)


class _LoadedCode(NamedTuple):
    """Machine code in a device's memory.

    Attributes:
        context: The driver's context.
        begin: Kernel `begin_all`.
        run: Kernel `run_all`.
        blocks: Blocks of `run_all` that the device holds at a time.
    """

    context: PyTree
    begin: Any
    run: PyTree
    blocks: int


class CudaDevice:
    """The NVIDIA GPUs of this process, all of one architecture such as sm_90."""

    def __init__(self, architecture: str):
        """Store the architecture, such as sm_90; the first launch loads the driver."""
        self.architecture = architecture
        self._loaded: dict[tuple[pathlib.Path, int], _LoadedCode] = {}

    def describe(self) -> dict[str, str]:
        """Return "compiler", "flags", "processor": with a program's text they determine its numbers to the last bit."""
        major, minor = nvrtc.nvrtc_version()
        return {
            "compiler": f"NVRTC {major}.{minor}",
            "flags": " ".join(nvrtc.NVRTC_FLAGS),
            "processor": self.architecture,
        }

    def compile(self, text: str) -> pathlib.Path:
        """Return the file with the machine code of a CUDA C++ `text`."""
        return nvrtc.build_cubin(text, self.architecture)

    def address(self, buffer: Any) -> int:
        """Return the device address of a `buffer` of XLA."""
        return buffer.__cuda_array_interface__["data"][0]

    def start(self, code: pathlib.Path, arrays: PyTree, room: int, count: int, context: PyTree) -> None:
        """Start `begin_all` and then `run_all` on the device of the address `room`, of counter and shared values."""
        ordinal = ctypes.c_int()
        # Several devices may run this program: the memory tells which one to use.
        _call_driver("cuPointerGetAttribute", ctypes.byref(ordinal), ORDINAL, ctypes.c_uint64(room))
        at = code, ordinal.value
        with _lock:
            if at not in self._loaded:
                self._loaded[at] = _load(*at)
            loaded = self._loaded[at]
        _call_driver("cuCtxPushCurrent_v2", loaded.context)
        try:
            # At most as many blocks as run at a time: each thread takes further lanes from the counter.
            blocks = min(loaded.blocks, -(-count // cuda.THREADS_PER_BLOCK))
            shared, counter = ctypes.c_uint64(room + cuda.COUNTER), ctypes.c_uint64(room)
            threads, lanes = ctypes.c_int64(blocks * cuda.THREADS_PER_BLOCK), ctypes.c_int64(count)
            _launch(loaded.begin, 1, 1, context.stream, arrays, shared, counter, threads)
            _launch(loaded.run, blocks, cuda.THREADS_PER_BLOCK, context.stream, arrays, shared, counter, lanes)
        finally:
            _call_driver("cuCtxPopCurrent_v2", ctypes.byref(ctypes.c_void_p()))


def _load(code: pathlib.Path, ordinal: int) -> _LoadedCode:
    """Load machine code into the primary context of device `ordinal`, which XLA uses too, and return its kernels."""
    context, module, number = ctypes.c_void_p(), ctypes.c_void_p(), ctypes.c_int()
    begin, run = ctypes.c_void_p(), ctypes.c_void_p()
    _call_driver("cuDevicePrimaryCtxRetain", ctypes.byref(context), ordinal)
    _call_driver("cuCtxPushCurrent_v2", context)
    try:
        _call_driver("cuModuleLoadData", ctypes.byref(module), code.read_bytes())
        for kernel, name in ((begin, b"begin_all"), (run, b"run_all")):
            _call_driver("cuModuleGetFunction", ctypes.byref(kernel), module, name)
        _call_driver("cuDeviceGetAttribute", ctypes.byref(number), MULTIPROCESSORS, ordinal)
        blocks = number.value
        _call_driver(
            "cuOccupancyMaxActiveBlocksPerMultiprocessor",
            ctypes.byref(number),
            run,
            cuda.THREADS_PER_BLOCK,
            ctypes.c_size_t(0),
        )
    finally:
        _call_driver("cuCtxPopCurrent_v2", ctypes.byref(ctypes.c_void_p()))
    return _LoadedCode(context, begin, run, blocks * max(1, number.value))


def _launch(kernel: object, blocks: int, threads: int, stream: int, *args: PyTree) -> None:
    """Start a kernel on a stream with `blocks` blocks of `threads` threads; `args` are values of ctypes."""
    # cuLaunchKernel takes an array with the address of each argument.
    pointers = (ctypes.c_void_p * len(args))(*(ctypes.addressof(x) for x in args))
    nothing = ctypes.c_void_p()
    _call_driver("cuLaunchKernel", kernel, blocks, 1, 1, threads, 1, 1, 0, ctypes.c_void_p(stream), pointers, nothing)


def _call_driver(name: str, *args: object) -> None:
    """Call a function of the driver; raise RuntimeError with the name of the error it returns."""
    if failed := getattr(_load_driver(), name)(*args):
        message = ctypes.c_char_p()
        _load_driver().cuGetErrorName(failed, ctypes.byref(message))
        raise RuntimeError(f"{name}: {(message.value or b'error').decode()} ({failed})")


@functools.cache
def _load_driver() -> ctypes.CDLL:
    driver = ctypes.CDLL("libcuda.so.1")
    driver.cuInit(0)
    return driver
