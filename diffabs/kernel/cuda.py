"""A program as CUDA C++: a lane for each thread. The lines are those of the processor's text (`cpp`); before them the
same names are given to single numbers (`lane.h`), after them stands the launch (`threads.h`)."""

from typing import NamedTuple

from diffabs.kernel.cpp import LaunchShape, Text
from diffabs.kernel.program import ScalarProgram

THREADS_PER_BLOCK = (
    128  # of a block; four of these fill a multiprocessor's registers, at the most that a thread can have
)
COUNTER = 64  # bytes that the number of the next lane has to itself


class CudaSource(NamedTuple):
    """CUDA C++ with the kernels `begin_all` and `run_all`; how many bytes these need beside the arrays."""

    text: str
    room: int


def emit_cuda(program: ScalarProgram, shape: LaunchShape) -> CudaSource:
    """Return the CUDA C++ of a program with the functions `renew`, `step` (carry to carry) and `running` (to a truth).
    A thread has one lane, whatever the shape's vectors."""
    made = _Text(program, shape._replace(vectors=1))
    columns = sum(len(node.args) for _, node in made.columns.values())
    return CudaSource("\n".join(made.parts()) + "\n", COUNTER + 8 * (len(made.shared) + columns + 1))


class _Text(Text):
    HEAD = '#include "lane.h"'
    DRIVER = f'enum {{ THREADS = {THREADS_PER_BLOCK} }};\n#include "threads.h"'
