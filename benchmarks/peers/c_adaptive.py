"""lanes.c, adaptive, with OpenMP over blocks of lanes."""

from peers import c

TITLE, PACKAGES, MANY = "C, adaptive RK4 (gcc -O3, OpenMP)", (), None
LADDER = (1e-5, 5e-6, 3e-6, 1e-6, 3e-7, 1e-7)


def prepared(masses, speeds, tolerance, dtype, threads):
    """Threads are set by OMP_NUM_THREADS."""
    del threads
    c.built("float" if dtype == "float32" else "double")
    return lambda: c.solved("adaptive", masses, speeds, tolerance, dtype)[0]
