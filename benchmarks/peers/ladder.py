"""The settings that every peer is given, coarse to fine. A gap would cost a peer up to its factor."""

TOLERANCES = (1e-4, 3e-5, 1e-5, 3e-6, 1e-6, 3e-7, 1e-7, 3e-8, 1e-8, 3e-9, 1e-9)
STEPS = (2e-3, 1e-3, 5e-4, 3e-4, 2e-4, 1e-4)  # s
LADDERS = {"fixed": STEPS, "adaptive": TOLERANCES}
