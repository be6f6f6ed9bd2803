"""The papers, reproduced: every figure as PNG, every number with its published value and the difference.

A reproduction is a function (folder, progress) -> summary. It writes its figures and `summary.json` into the folder,
which exists, and calls progress(sentence) before whatever takes long. It needs float64 and matplotlib, which is why the
modules are imported only when they are asked for.
"""

import importlib
import pathlib
from collections.abc import Callable
from typing import Any

Progress = Callable[[str], None]
Reproduction = Callable[[pathlib.Path, Progress], dict[str, Any]]


def _paper(module: str) -> Reproduction:
    def reproduce(folder: pathlib.Path, progress: Progress) -> dict[str, Any]:
        """Write figures and `summary.json` into the folder; returns the summary."""
        return importlib.import_module(f"diffabs.papers.{module}").reproduce(folder, progress)

    return reproduce


PAPERS: dict[str, Reproduction] = {
    "slip-lmi": _paper("slip_lmi"),
    "slip-estimator": _paper("slip_estimator"),
    "arm-balance": _paper("arm_balance"),
}
