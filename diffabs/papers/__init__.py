"""The papers, reproduced: every figure as PNG, every number with its published value and the difference.

`compact` makes of a summary what a person is shown of it.

A reproduction is a function (folder, progress) -> summary. It writes its figures and `summary.json` into the folder,
which exists, and calls progress(sentence) before whatever takes long. It needs float64 and matplotlib, which is why the
modules are imported only when they are asked for.
"""

import importlib
import pathlib
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from diffabs.papers.digest import Digest

Progress = Callable[[str], None]
Reproduction = Callable[[pathlib.Path, Progress], dict[str, Any]]


def _paper(module: str) -> Reproduction:
    def reproduce(folder: pathlib.Path, progress: Progress) -> dict[str, Any]:
        """Write figures and `summary.json` into the folder; returns the summary."""
        return importlib.import_module(f"diffabs.papers.{module}").reproduce(folder, progress)

    return reproduce


MODULES = {"slip-lmi": "slip_lmi", "slip-estimator": "slip_estimator", "arm-balance": "arm_balance"}
PAPERS: dict[str, Reproduction] = {name: _paper(module) for name, module in MODULES.items()}


def compact(summary: Mapping[str, Any]) -> "Digest":
    """The compact result of a summary that a reproduction wrote."""
    return importlib.import_module(f"diffabs.papers.{MODULES[summary['paper']]}").compact(summary)
