"""Forward-mode derivatives of a program: tangents, their elimination and their replication."""
