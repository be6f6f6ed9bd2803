"""Trajectories of chosen samples, run again and kept in a zarr group: dimensions `sample` and `instant`.

`xarray.open_zarr(folder / "trajectories.zarr", consolidated=False)` opens it."""

import dataclasses
import pathlib
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
import zarr

from diffabs.core import files
from diffabs.core.loop import run_signals
from diffabs.simulate.run import rollout
from diffabs.simulate.solution import Trajectory
from diffabs.sweep.study import Study, precision

TRAJECTORIES_NAME = "trajectories.zarr"
MAX_INSTANTS = 2000  # of a trajectory


def write_trajectories(study: Study, folder: str | pathlib.Path, samples: Sequence[int]) -> pathlib.Path:
    """Run these samples again and write their trajectories, whole or not at all, in place of earlier ones.

    Raises ValueError for a sample that is not in the sweep."""
    path = pathlib.Path(folder) / TRAJECTORIES_NAME
    seen = [run_signals(rerun_sample(study, i).sample, study.loop.plant) for i in samples]
    with files.new_folder(path) as folder:
        group = zarr.open_group(folder, mode="w")
        numbers = {"sample": ("", np.asarray(samples, np.int64))}
        for name, (unit, _) in seen[0].items():
            numbers["time" if name == "t" else name] = unit, np.stack([one[name][1] for one in seen])
        for name, (unit, values) in numbers.items():
            dimensions = ("sample", "instant")[: values.ndim]
            array = group.create_array(name, shape=values.shape, dtype=values.dtype, dimension_names=dimensions)
            array[...] = np.asarray(values)
            array.attrs["units"] = unit
    return path


def rerun_sample(study: Study, i: int) -> Trajectory:
    """One sample's run, on the host. After its end the last instant is repeated."""
    loop, key = study.lane(i)
    every = max(study.solver.every, -(-study.solver.steps // MAX_INSTANTS))
    with precision(study.dtype):
        loop = jax.tree.map(lambda x: jnp.asarray(x, study.dtype), loop)
        run = jax.device_get(rollout(loop, dataclasses.replace(study.solver, every=every), key=key))
    assert run.trajectory is not None
    return run.trajectory
