"""Compilers of this machine, their libraries, and the launch of a program under JAX."""
