"""Robust design and its proofs."""
