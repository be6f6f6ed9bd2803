"""diffabs with steps as long as their error allows, by a kernel."""

from peers import ours
from peers.ladder import TOLERANCES

TITLE, PACKAGES, MANY = "diffabs, Adaptive, kernel", ours.PACKAGES, ours.MANY
LADDER = TOLERANCES


def prepared(masses, speeds, tolerance, dtype, threads):
    """Lanes are dealt to host devices."""
    del threads
    return ours.prepared_with("adaptive", masses, speeds, tolerance, dtype, "kernel")
