"""Services of a process: files, interrupts, provenance, and summaries of results. It knows no physics."""
