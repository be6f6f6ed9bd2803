"""C by hand, lanes.c: built into a temporary folder where it is needed, with what `gcc` does best."""

import ctypes
import functools
import pathlib
import shutil
import subprocess
import tempfile
import types

import numpy as np

from peers import problem
from peers.ladder import LADDERS

FLAGS = ("-O3", "-march=native", "-mprefer-vector-width=512", "-ffast-math", "-fopenmp", "-fPIC", "-c")
LINK = (
    "-shared",
    "-fopenmp",
)  # without -ffast-math: linked with it, loading sets the processor to flush small numbers to 0
CONSTANTS = ("R1", "R2", "J1", "G", "A", "P", "W1", "W2", "W3", "W4", "K1", "K2", "SLIP", "U", "STOP")
METHODS = {"fixed": 0, "adaptive": 1}
FIRST, LONGEST, LEAST = 1e-4, 7e-3, 2e-5  # steps [s]: the first, the longest at 5/3.6 m/s times 2.5, the shortest
LIMIT = 10**8


class NoCompiler(RuntimeError):
    """There is no gcc, or it failed."""


@functools.cache
def built(real: str):
    """Return `run` of lanes.c for `real`, float or double. Raises NoCompiler."""
    if shutil.which("gcc") is None:
        raise NoCompiler("there is no gcc")
    with tempfile.TemporaryDirectory(prefix="diffabs-peers-") as folder:
        path = pathlib.Path(folder) / f"lanes_{real}.so"
        part = str(path.with_suffix(".o"))
        constants = [f"-D{name}={getattr(problem, name)!r}" for name in CONSTANTS]
        source = str(pathlib.Path(__file__).with_name("lanes.c"))
        for command in (
            ["gcc", *FLAGS, f"-DREAL={real}", *constants, "-o", part, source],
            ["gcc", *LINK, "-o", str(path), part, "-lm"],
        ):
            done = subprocess.run(command, capture_output=True, text=True, check=False)
            if done.returncode:
                raise NoCompiler(done.stderr)
        function = ctypes.CDLL(str(path)).run  # stays open when the file is gone
    array = np.ctypeslib.ndpointer(np.float32 if real == "float" else np.float64, flags="C")
    function.argtypes = [ctypes.c_int] * 2 + [array] * 3 + [ctypes.c_double] * 4 + [ctypes.c_long, array]
    function.restype = ctypes.c_long
    return function


def solved(method, masses, speeds, setting, dtype="float64", least=LEAST, longest=LONGEST):
    """Return (the four numbers (4, lanes), the steps tried of all blocks of 64 lanes).

    method: "adaptive" to a tolerance, or "fixed" with a step [s]: the setting
    dtype: "float32" or "float64"
    least, longest: steps [s] of "adaptive" """
    run = built("float" if dtype == "float32" else "double")
    columns = [np.ascontiguousarray(x, dtype) for x in (masses, problem.holding(masses), speeds)]
    out = np.empty((4, len(masses)), dtype)
    first = FIRST if method == "adaptive" else setting
    tried = run(METHODS[method], len(masses), *columns, first, setting, longest, least, LIMIT, out)
    return out, tried


def prepared_with(method, masses, speeds, setting, dtype, threads):
    """What `prepared` of a peer returns. Threads are set by OMP_NUM_THREADS."""
    del threads
    built("float" if dtype == "float32" else "double")
    return lambda: solved(method, masses, speeds, setting, dtype)[0]


PEERS = {
    f"c_{method}": types.SimpleNamespace(
        TITLE=f"C, {method} RK4 (gcc -O3, OpenMP)",
        PACKAGES=(),
        MANY=None,
        LADDER=LADDERS[method],
        prepared=functools.partial(prepared_with, method),
    )
    for method in METHODS
}
