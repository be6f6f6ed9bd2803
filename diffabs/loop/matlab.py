"""Export of a run as a MAT file for MATLAB and Octave. SciPy writes it and is imported only on request."""

import pathlib
import re
from collections.abc import Mapping

from diffabs.core.protocols import Plant
from diffabs.core.types import PyTree
from diffabs.loop.convert import trajectory_columns
from diffabs.loop.result import Run

KEYWORDS_TEXT = (
    "break case catch classdef continue else elseif end for function global if otherwise parfor persistent return spmd "
    "switch try while"
)
KEYWORDS = set(KEYWORDS_TEXT.split())
MAX_NAME = 60  # MATLAB reads 63 characters; a number against equal names takes the others


def write_mat(path: pathlib.Path, run: Run, plant: Plant, **more: object) -> None:
    """Write the trajectory of one run, up to its end, to a MAT file, with `more` variables by name.

    The file has a column vector for each of the `signal_columns`. The struct `units` has their units, and the struct
    `metrics` the run's metrics. A mapping becomes a struct, too. A name that is not valid in MATLAB is changed:
    stop-time becomes `stop_time`.
    """
    from scipy.io import savemat

    columns = trajectory_columns(run, plant)
    content: dict[str, PyTree] = {name: values for name, (_, values) in columns.items()}
    content["units"] = {name: unit for name, (unit, _) in columns.items()}
    content["metrics"] = {name: float(value) for name, value in run.metrics.items()}
    with path.open("wb") as file:
        savemat(file, _with_valid_names(content | more), do_compression=True, long_field_names=True, oned_as="column")


def _with_valid_names(values: Mapping[str, PyTree]) -> dict[str, PyTree]:
    """Return a mapping, and the mappings in it, with names that are valid in MATLAB and differ."""
    renamed: dict[str, PyTree] = {}
    for name, value in values.items():
        valid = re.sub(r"\W+", "_", name, flags=re.ASCII)
        valid = (valid if valid[:1].isalpha() else f"x{valid}")[:MAX_NAME]
        new, number = f"{valid}_" if valid in KEYWORDS else valid, 2
        while new in renamed:
            new, number = f"{valid}_{number}", number + 1
        renamed[new] = _with_valid_names(value) if isinstance(value, Mapping) else value
    return renamed
