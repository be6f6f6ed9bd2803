"""Reproductions: every figure as PNG, every number with its published or measured value and the difference.

`PAPERS` are the three papers. `lab-rig` compares with the measured rig, `literature` with other people's programs.

`compact` returns the short form of a summary that the command line prints.

A reproduction is a function (folder, progress) -> summary; `lab-rig` also takes `data`. It writes its figures and
`summary.json` into the existing folder. It calls progress(sentence) before each long computation. It needs float64 and
matplotlib, so its module is imported only on use.
"""

import importlib
import pathlib
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from diffabs.core.types import JsonObject, Table

if TYPE_CHECKING:
    from diffabs.papers.digest import Digest

Progress = Callable[[str], None]
Reproduction = Callable[..., dict[str, Any]]


def _reproduction(module: str) -> Reproduction:
    def reproduce(folder: pathlib.Path, progress: Progress, **options: Any) -> JsonObject:
        """Write figures and `summary.json` into the folder, and return the summary."""
        return importlib.import_module(f"diffabs.papers.{module}").reproduce(folder, progress, **options)

    return reproduce


PAPERS = ("slip-lmi", "slip-estimator", "arm-balance")
MODULES = {name: name.replace("-", "_") for name in (*PAPERS, "lab-rig", "literature")}
REPRODUCTIONS: dict[str, Reproduction] = {name: _reproduction(module) for name, module in MODULES.items()}


def compact(summary: Table) -> "Digest":
    """Return the digest of a summary that a reproduction wrote.

    Args:
        summary: Contents of `summary.json`.
    """
    return importlib.import_module(f"diffabs.papers.{MODULES[summary['paper']]}").compact(summary)
