"""Proved bounds of nonlinear closed loops with limits, over a whole box of parameters."""

from diffabs.robust.reach.certificate import certificate_document as certificate_document
from diffabs.robust.reach.cover import BoxProof as BoxProof
from diffabs.robust.reach.cover import RunClaim as RunClaim
from diffabs.robust.reach.cover import cover_box as cover_box
from diffabs.robust.reach.equations import NoRule as NoRule
