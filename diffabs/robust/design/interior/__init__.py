"""Interior-point methods in pure JAX, for derivatives through a design."""
