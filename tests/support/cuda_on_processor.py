"""The text of a GPU's kernel, run thread by thread on the processor: a `Device` for tests without a GPU."""

import ctypes
import pathlib

import numpy as np

from diffabs.compiler.emit import cuda
from diffabs.compiler.runtime import toolchain

HERE = pathlib.Path(__file__).parent
THREADS = 5  # so that some lanes are taken by threads that have ended others


class Processor:
    """Stands in for a GPU."""

    def __init__(self):
        self.rooms = {}  # needed and given, by address

    def describe(self):
        return {"compiler": "a stand-in", "flags": "", "processor": "one"}

    def compile(self, text):
        before, after = ((HERE / name).read_text() for name in ("stand_ins.h", "one_by_one.h"))
        return toolchain.build_library(before + text + after)

    def address(self, buffer):
        array = np.asarray(buffer)
        self.rooms[array.ctypes.data] = array.nbytes
        return array.ctypes.data

    def start(self, code, arrays, room, count, context):
        library = ctypes.CDLL(str(code))
        library.needed.restype = ctypes.c_int64
        assert library.needed(ctypes.c_int64(cuda.COUNTER)) <= self.rooms[room]
        numbers = (ctypes.c_int64(x) for x in (count, 1, THREADS, cuda.COUNTER))
        library.start(arrays, ctypes.c_void_p(room), *numbers)
