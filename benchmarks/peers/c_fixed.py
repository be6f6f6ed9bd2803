"""lanes.c with equal steps."""

from peers import c

TITLE, PACKAGES, MANY = "C, fixed RK4 (gcc -O3, OpenMP)", (), None
LADDER = (2e-3, 1e-3, 5e-4, 3e-4, 2e-4, 1e-4)


def prepared(masses, speeds, step, dtype, threads):
    """Threads are set by OMP_NUM_THREADS."""
    del threads
    c.built("float" if dtype == "float32" else "double")
    return lambda: c.solved("fixed", masses, speeds, step, dtype)[0]
