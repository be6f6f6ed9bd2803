"""Lanes on an NVIDIA GPU: machine code by `nvrtc`, started by the driver's own interface on XLA's stream.

Only this module knows `jax.experimental.buffer_callback`, by which a start is an operation of XLA's, and the driver."""

import ctypes
import functools
import pathlib
import threading
from typing import Any, NamedTuple, Protocol

import jax
import numpy as np
from jax.experimental.buffer_callback import buffer_callback

from diffabs.kernel import cuda, nvrtc
from diffabs.kernel.compilers import NoCompiler
from diffabs.kernel.cpp import LaunchShape
from diffabs.kernel.graph import UpdateLevel
from diffabs.kernel.program import ScalarProgram

ORDINAL, MULTIPROCESSORS = 9, 16  # attributes of a pointer and of a device, by the driver's numbers
_lock = threading.Lock()


class GpuDevice(Protocol):
    """What compiles and starts kernels."""

    def compiled(self, text: str) -> pathlib.Path:
        """Return the file of the machine code of a text. Raises NoCompiler."""
        ...

    def address(self, buffer: Any) -> int:
        """Return where an array of XLA's lies."""
        ...

    def start(self, code: pathlib.Path, arrays: Any, room: int, count: int, context: Any) -> None:
        """Start `begin_all`, then `run_all`, for so many lanes; `arrays` are those of `threads.h`, the context is XLA's
        and has the stream."""
        ...


def find_gpu() -> GpuDevice | None:
    """Return the GPU that JAX runs on, or None if that is a processor. Raises NoCompiler for a GPU of another make."""
    home = jax.config.jax_default_device or jax.devices()[0]  # pyright: ignore[reportAttributeAccessIssue]
    platform = home if isinstance(home, str) else home.platform
    return None if platform == "cpu" else _find_cuda_device(platform)


def call_kernel(program: ScalarProgram, shape: LaunchShape, given: list[Any], results: list[Any]) -> list[Any]:
    """Return what becomes of the carries: arrays as the `results` say.

    given: arrays that all lanes share, of the lanes, and of the carry, the last two with a leading axis of lanes

    Raises NoCompiler."""
    on = find_gpu()
    assert on is not None
    source = cuda.emit_cuda(program, shape)
    code = on.compiled(source.text)
    sizes = [len(program.sizes[level]) for level in (UpdateLevel.UNIFORM, UpdateLevel.LANE, UpdateLevel.STEP)]
    count = given[-1].shape[0]

    def start(context: Any, outs: Any, *ins: Any) -> None:
        *found, room = [on.address(buffer) for buffer in outs]
        if count:
            on.start(code, _pack_addresses([*map(on.address, ins), *found], [*sizes, sizes[-1]]), room, count, context)

    whole = [*results, jax.ShapeDtypeStruct((source.room,), np.uint8)]
    return buffer_callback(start, whole)(*given)[:-1]


def describe_gpu_compiler() -> dict[str, str]:
    """Return what decides the bits besides the text. Raises NoCompiler."""
    on = find_gpu()
    assert isinstance(on, CudaDevice)
    major, minor = nvrtc.nvrtc_version()
    return {"compiler": f"NVRTC {major}.{minor}", "flags": " ".join(nvrtc.NVRTC_FLAGS), "processor": on.architecture}


def _pack_addresses(addresses: list[int], sizes: list[int]) -> Any:
    """`Arrays` of `threads.h`: in each group a place more than there are arrays."""
    rest, found = iter(addresses), []
    for size in sizes:
        found += [*(next(rest) for _ in range(size)), 0]
    return (ctypes.c_void_p * len(found))(*found)


# CUDA -----------------------------------------------------------------------------------------------------------------


@functools.cache
def _find_cuda_device(platform: str) -> "CudaDevice":
    capability = getattr(jax.devices(platform)[0], "compute_capability", "")
    if not capability.replace(".", "").isdigit():
        raise NoCompiler(f"kernels are for processors and NVIDIA's GPUs, not for {platform} {capability}".strip())
    return CudaDevice(f"sm_{capability.replace('.', '')}")


class _LoadedCode(NamedTuple):
    """Machine code on a device: its context, the two kernels, and how many blocks of the second it holds at once."""

    context: Any
    begin: Any
    run: Any
    blocks: int


class CudaDevice:
    """NVIDIA's GPUs of this process, of one architecture (sm_90)."""

    def __init__(self, architecture: str):
        """The driver is loaded when something is started."""
        self.architecture = architecture
        self._loaded: dict[tuple[pathlib.Path, int], _LoadedCode] = {}

    def compiled(self, text: str) -> pathlib.Path:
        """As `GpuDevice` says."""
        return nvrtc.build_cubin(text, self.architecture)

    def address(self, buffer: Any) -> int:
        """As `GpuDevice` says."""
        return buffer.__cuda_array_interface__["data"][0]

    def start(self, code: pathlib.Path, arrays: Any, room: int, count: int, context: Any) -> None:
        """As `GpuDevice` says; on the device that has the room."""
        ordinal = ctypes.c_int()
        _call_driver("cuPointerGetAttribute", ctypes.byref(ordinal), ORDINAL, ctypes.c_uint64(room))
        one = self._loaded_on(code, ordinal.value)
        _call_driver("cuCtxPushCurrent_v2", one.context)
        try:
            blocks = min(one.blocks, -(-count // cuda.THREADS_PER_BLOCK))
            shared, counter = ctypes.c_uint64(room + cuda.COUNTER), ctypes.c_uint64(room)
            threads, lanes = ctypes.c_int64(blocks * cuda.THREADS_PER_BLOCK), ctypes.c_int64(count)
            _launch(one.begin, 1, 1, context.stream, arrays, shared, counter, threads)
            _launch(one.run, blocks, cuda.THREADS_PER_BLOCK, context.stream, arrays, shared, counter, lanes)
        finally:
            _call_driver("cuCtxPopCurrent_v2", ctypes.byref(ctypes.c_void_p()))

    def _loaded_on(self, code: pathlib.Path, ordinal: int) -> _LoadedCode:
        with _lock:
            if (code, ordinal) not in self._loaded:
                self._loaded[code, ordinal] = _load(code, ordinal)
            return self._loaded[code, ordinal]


def _load(code: pathlib.Path, ordinal: int) -> _LoadedCode:
    """Into the context that XLA, too, uses: a device's first."""
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


def _launch(kernel: Any, blocks: int, threads: int, stream: int, *args: Any) -> None:
    given = (ctypes.c_void_p * len(args))(*(ctypes.addressof(x) for x in args))
    nothing = ctypes.c_void_p()
    _call_driver("cuLaunchKernel", kernel, blocks, 1, 1, threads, 1, 1, 0, ctypes.c_void_p(stream), given, nothing)


def _call_driver(name: str, *args: Any) -> None:
    """Call the driver. Raises RuntimeError for what it objects to."""
    if failed := getattr(_load_driver(), name)(*args):
        said = ctypes.c_char_p()
        _load_driver().cuGetErrorName(failed, ctypes.byref(said))
        raise RuntimeError(f"{name}: {(said.value or b'error').decode()} ({failed})")


@functools.cache
def _load_driver() -> Any:
    driver = ctypes.CDLL("libcuda.so.1")
    driver.cuInit(0)
    return driver
