"""Proved bounds of nonlinear closed loops with limits, over a whole box of parameters."""

from diffabs.reach.certificate import certificate_document as certificate_document
from diffabs.reach.cover import BoxProof as BoxProof
from diffabs.reach.cover import RunClaim as RunClaim
from diffabs.reach.cover import prove_box as prove_box
from diffabs.reach.equations import NoRule as NoRule
