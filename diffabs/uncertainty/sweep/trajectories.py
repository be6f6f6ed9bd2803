"""Trajectories of chosen samples, run again and kept in a zarr group with dimensions `sample` and `instant`.

`xarray.open_zarr(folder / "trajectories.zarr", consolidated=False)` opens it.
"""

import pathlib
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
import zarr

from diffabs.host import files
from diffabs.loop.convert import signal_columns
from diffabs.loop.result import Trajectory
from diffabs.loop.run import run_unchecked
from diffabs.uncertainty.sweep.study import Study, precision

TRAJECTORIES_NAME = "trajectories.zarr"
MAX_TRAJECTORY_INSTANTS = 2000  # recorded instants of a trajectory


def write_trajectories(study: Study, folder: str | pathlib.Path, samples: Sequence[int]) -> pathlib.Path:
    """Run these samples again, write their trajectories in place of an earlier group, and return the group's path."""
    if not samples:
        raise ValueError("samples = []: give the number of at least one sample")
    path = pathlib.Path(folder) / TRAJECTORIES_NAME
    signals = [signal_columns(rerun_sample(study, i).sample, study.loop.plant) for i in samples]
    with files.new_folder(path) as folder:
        group = zarr.open_group(folder, mode="w")
        numbers = {"sample": ("", np.asarray(samples, np.int64))}
        for name, (unit, _) in signals[0].items():
            numbers["time" if name == "t" else name] = unit, np.stack([lane[name][1] for lane in signals])
        for name, (unit, values) in numbers.items():
            dimensions = ("sample", "instant")[: values.ndim]
            array = group.create_array(name, shape=values.shape, dtype=values.dtype, dimension_names=dimensions)
            array[...] = np.asarray(values)
            array.attrs["units"] = unit
    return path


def rerun_sample(study: Study, i: int) -> Trajectory:
    """Return the trajectory of one sample, on the host. After the end of the run the last instant repeats."""
    loop, key = study.lane(i)
    every = max(study.solver.every, -(-study.solver.steps // MAX_TRAJECTORY_INSTANTS))
    with precision(study.dtype):
        loop = jax.tree.map(lambda x: jnp.asarray(x, study.dtype), loop)
        run = jax.device_get(run_unchecked(loop, study.solver, {}, key, every))
    assert run.trajectory is not None
    return run.trajectory
