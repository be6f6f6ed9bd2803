"""lanes.c, adaptive, with OpenMP over blocks of lanes."""

from peers import c
from peers.ladder import TOLERANCES

TITLE, PACKAGES, MANY = "C, adaptive RK4 (gcc -O3, OpenMP)", (), None
LADDER = TOLERANCES


def prepared(masses, speeds, tolerance, dtype, threads):
    """Threads are set by OMP_NUM_THREADS."""
    del threads
    c.built("float" if dtype == "float32" else "double")
    return lambda: c.solved("adaptive", masses, speeds, tolerance, dtype)[0]
