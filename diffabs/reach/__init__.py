"""Proved bounds of nonlinear closed loops with limits, over a whole box of parameters."""

from diffabs.reach.cover import BoxProof, Claim, prove_box
from diffabs.reach.equations import NoRule

__all__ = ["BoxProof", "Claim", "NoRule", "prove_box"]
