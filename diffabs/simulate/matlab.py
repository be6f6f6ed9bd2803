"""Export of a run as a MAT file for MATLAB and Octave. SciPy writes it and is imported only on request."""

import pathlib
from collections.abc import Mapping
from typing import Any

from diffabs.core.loop import run_signals
from diffabs.core.protocols import Plant
from diffabs.core.types import Params, PyTree
from diffabs.simulate.solution import Run


def write_mat(path: pathlib.Path, run: Run, plant: Plant, **more: Any) -> None:
    """Write the instants up to the end of a run with a trajectory to a MAT file.

    The file has a column vector for each signal, and structs for their `units` and the run's `metrics`.

    Args:
        path: File to write.
        run: One run with a trajectory.
        plant: Plant that defines the signals and their units.
        more: Further variables. A mapping becomes a struct, with underscores for dots in its names.
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
