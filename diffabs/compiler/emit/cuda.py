"""A program as CUDA C++, one lane at a time for each thread.

The program's lines are the same as in the processor's text (`cpp`). Before them, `lane.h` defines their names for
single numbers; after them, `threads.h` contains the kernels to launch.
"""

from typing import NamedTuple

from diffabs.compiler.emit.cpp import LaunchShape, Text
from diffabs.compiler.program import ScalarProgram

# Two blocks in double precision, or three in single, fill the 65,536 registers of a multiprocessor (`threads.h`).
THREADS_PER_BLOCK = 128
COUNTER = 64  # bytes reserved for the number of the next lane


class CudaSource(NamedTuple):
    """CUDA C++ with the kernels `begin_all` and `run_all`.

    Attributes:
        text: CUDA C++.
        room: Bytes of device memory that the kernels need in addition to the arrays.
    """

    text: str
    room: int


def emit_cuda(program: ScalarProgram, shape: LaunchShape) -> CudaSource:
    """Return the CUDA C++ of a program, with the kernels to launch, and their need of memory.

    It contains the functions `renew` and `step` (carry to carry) and `running` (carry to boolean). A thread has one
    lane at a time, so `shape.vectors` has no effect.
    """
    writer = _Text(program, shape._replace(vectors=1))
    columns = sum(len(node.args) for _, node in writer.columns.values())
    # The device struct `Shared` holds at most 8 bytes for each entry, and one pad.
    return CudaSource("\n".join(writer.parts()) + "\n", COUNTER + 8 * (len(writer.shared) + columns + 1))


class _Text(Text):
    """A writer of a program as CUDA C++."""

    HEAD = '#include "lane.h"'
    DRIVER = f'enum {{ THREADS = {THREADS_PER_BLOCK} }};\n#include "threads.h"'
