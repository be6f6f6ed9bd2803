"""A compiler from JAX functions of one lane (one simulation run) to native code that runs many lanes at once."""
