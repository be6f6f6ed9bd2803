"""diffabs with equal steps, by a kernel."""

from peers import ours

TITLE, PACKAGES, MANY = "diffabs, FixedStep, kernel", ours.PACKAGES, ours.MANY
LADDER = (2e-3, 1e-3, 5e-4, 3e-4, 2e-4, 1e-4)


def prepared(masses, speeds, step, dtype, threads):
    """Lanes are dealt to host devices."""
    del threads
    return ours.prepared_with("fixed", masses, speeds, step, dtype, "kernel")
