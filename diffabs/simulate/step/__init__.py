"""One step of a run: what it computes, and which step is taken."""
