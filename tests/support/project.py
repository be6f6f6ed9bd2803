"""Where the project is, and what its tests keep between runs."""

import pathlib

ROOT = pathlib.Path(__file__).resolve().parents[2]
CACHE = str(ROOT / ".jax_cache")
