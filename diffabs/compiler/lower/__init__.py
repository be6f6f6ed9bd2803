"""Lowering: from a jaxpr to operations on single numbers, by one rule for each JAX primitive."""

# Each of these modules registers its rules, so that `rules.lower_jaxpr` knows all of them.
from diffabs.compiler.lower import arrays as arrays
from diffabs.compiler.lower import control_flow as control_flow
from diffabs.compiler.lower import elementwise as elementwise
from diffabs.compiler.lower import indexing as indexing
from diffabs.compiler.lower import random as random
