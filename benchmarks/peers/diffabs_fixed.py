"""diffabs with equal steps."""

from peers import ours
from peers.ladder import STEPS

TITLE, PACKAGES, MANY = "diffabs, FixedStep", ours.PACKAGES, ours.MANY
LADDER = STEPS


def prepared(masses, speeds, step, dtype, threads):
    """Lanes are dealt to host devices."""
    del threads
    return ours.prepared_with("fixed", masses, speeds, step, dtype)
