"""diffabs with steps as long as their error allows, by a kernel."""

from peers import ours

TITLE, PACKAGES, MANY = "diffabs, Adaptive, kernel", ours.PACKAGES, ours.MANY
LADDER = (1e-4, 3e-5, 2e-5, 1e-5, 5e-6, 3e-6, 1e-6, 3e-7)


def prepared(masses, speeds, tolerance, dtype, threads):
    """Lanes are dealt to host devices."""
    del threads
    return ours.prepared_with("adaptive", masses, speeds, tolerance, dtype, "kernel")
