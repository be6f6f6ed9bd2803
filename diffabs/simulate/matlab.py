"""Export of a run as a MAT file for MATLAB and Octave. SciPy writes it and is imported only on request."""

import pathlib
from collections.abc import Mapping
from typing import Any

from diffabs.core.loop import run_signals
from diffabs.core.protocols import Plant
from diffabs.core.types import Params, PyTree
from diffabs.simulate.types import Run


def write_mat(path: pathlib.Path, run: Run, plant: Plant, **more: Any) -> None:
    """Write the trajectory of one run, up to its end, to a MAT file.

    The file has a column vector for each of `t`, the plant's outputs, `target`, `command` and `control`. The struct
    `units` has their units, and the struct `metrics` the run's metrics.

    Args:
        path: File to write; an existing file is replaced.
        run: One run, no batch, with a trajectory. An AssertionError refuses a run without.
        plant: Plant that defines the signals and their units.
        more: Further variables by name. A mapping becomes a struct, with underscores for dots in its names.
    """
    from scipy.io import savemat

    assert run.trajectory is not None
    kept = run_signals(run.trajectory.sample, plant)
    rows = int(run.trajectory.running.sum()) + 1  # after the end the last sample is repeated
    content: dict[str, PyTree] = {name: values[:rows] for name, (_, values) in kept.items()}
    content["units"] = {name: unit for name, (unit, _) in kept.items()}
    content["metrics"] = {name: float(value) for name, value in run.metrics.items()}
    content |= {name: _struct(value) if isinstance(value, Mapping) else value for name, value in more.items()}
    with path.open("wb") as file:
        savemat(file, content, do_compression=True, long_field_names=True, oned_as="column")


def _struct(values: Params) -> dict[str, PyTree]:
    return {name.replace(".", "_"): value for name, value in values.items()}
