"""Proved bounds of nonlinear closed loops with limits, over a whole box of parameters."""
