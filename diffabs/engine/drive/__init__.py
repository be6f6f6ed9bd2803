"""Repetition of steps: loops, batches, the kernel and devices."""
