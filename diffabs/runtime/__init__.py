"""What a process needs: files, interrupts, provenance, and summaries of results. It knows no physics."""
