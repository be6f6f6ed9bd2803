"""The model of parts and loops, and the contracts between them. The package depends on no particular part."""
