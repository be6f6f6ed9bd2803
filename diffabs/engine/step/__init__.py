"""One step of a run: its computation, and the choice of the step."""
