"""Proofs and disproofs in exact arithmetic, and their files."""
