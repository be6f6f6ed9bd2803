"""lanes.c with equal steps."""

from peers import c
from peers.ladder import STEPS

TITLE, PACKAGES, MANY = "C, fixed RK4 (gcc -O3, OpenMP)", (), None
LADDER = STEPS


def prepared(masses, speeds, step, dtype, threads):
    """Threads are set by OMP_NUM_THREADS."""
    del threads
    c.built("float" if dtype == "float32" else "double")
    return lambda: c.solved("fixed", masses, speeds, step, dtype)[0]
