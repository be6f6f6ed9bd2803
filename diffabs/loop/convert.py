"""Conversion of a run to a summary, a pandas.DataFrame, an xarray.Dataset or a figure."""

import csv
import pathlib
from typing import TYPE_CHECKING, Any

import jax
import numpy as np
from jax.core import Tracer

from diffabs.core.channels import has_channels
from diffabs.core.optional import import_optional
from diffabs.core.protocols import Plant, Sample
from diffabs.core.summary import Summary, round_for_table
from diffabs.core.types import Params, PyTree
from diffabs.core.units import control_units
from diffabs.loop.closed_loop import LOOP_SIGNALS
from diffabs.loop.faults import describe_faults

if TYPE_CHECKING:
    import pandas
    import xarray

    from diffabs.loop.result import Run


NUMBER_TYPES = (jax.Array, np.ndarray, np.generic, float, int, bool)
DEFAULT_CONTROL_UNIT = "control"  # unit of the control if no plant is given


def _is_concrete(run: object) -> bool:
    """Return True if a run holds numbers, False inside a function that JAX traces."""
    leaves = jax.tree.leaves(run)
    return all(isinstance(x, NUMBER_TYPES) and not isinstance(x, Tracer) for x in leaves)


def summarise_run(run: PyTree) -> Summary:
    """Return a summary of a run: how it ended, and its metrics.

    A batch gets mean, least and greatest value of each metric, over the runs that have not diverged. A traced run gets
    only the number of its metrics.
    """
    shape, has_trajectory = np.shape(run.stopped), run.trajectory is not None
    if not _is_concrete(run):
        return Summary(f"Run being traced, of {len(run.metrics)} metrics")
    if shape:
        return _summarise_runs(run, int(np.prod(shape)))
    length = f"; a trajectory of {len(run.trajectory.running)} instants" if has_trajectory else ""
    end = f"at t = {round_for_table(run.ending.sample.t)} s"
    how = f"reached its stop {end}" if run.stopped else f"ended {end}"
    if run.diverged:
        how = f"diverged: {describe_faults(run)}"
    if run.slid:
        begins = f"slides along a switching surface from t = {round_for_table(run.slide.t)} s"
        how = begins if run.diverged else f"{how} and {begins}, so that it has no derivatives"
    rows = tuple((name, value) for name, value in run.metrics.items())
    return Summary(f"Run that {how}{length}", ("metric", "value"), rows)


def _summarise_runs(run: "Run", count: int) -> Summary:
    lost, stopped = np.asarray(run.diverged).reshape(-1), int(np.sum(run.stopped))
    rows = []
    for name, values in run.metrics.items():
        good = np.asarray(values).reshape(-1)[~lost]
        rows.append((name, *((good.mean(), good.min(), good.max()) if len(good) else ("", "", ""))))
    title = f"{count} runs: {stopped} reached their stop, {int(lost.sum())} diverged"
    if why := describe_faults(run):
        title += f" ({why})"
    if slid := int(np.sum(run.slid)):
        title += f", {slid} slide along a switching surface and have no derivatives"
    return Summary(title, ("metric", "mean", "least", "greatest"), tuple(rows), "of those that did not diverge")


def signal_columns(sample: Sample, plant: Plant | None = None) -> dict[str, tuple[str, PyTree]]:
    """Return a pair (unit, values) for each signal of samples, by name: the columns of every table and file of a run.

    The names are `t`, the plant's outputs, `target`, `setpoint`, `feedforward`, `command` and `control`
    (`Loop.problems` keeps them apart). The plant defines the unit of the last three. Without a plant the unit is
    "control". In a loop with several inputs each channel has a name: `target_level_1`, `control_pump_1`.
    """
    units = type(sample.output).units
    outputs = {name: (units[name], values) for name, values in sample.output._asdict().items()}
    controls = control_units(plant) if plant is not None else {}
    others = {}
    for name in LOOP_SIGNALS:
        signal = getattr(sample, name)
        names = units if name in ("target", "setpoint") else controls
        if has_channels(signal):
            channels = signal._asdict().items()
            others |= {f"{name}_{key}": (names.get(key, DEFAULT_CONTROL_UNIT), values) for key, values in channels}
        else:
            others[name] = next(iter(names.values()), DEFAULT_CONTROL_UNIT), signal
    return {"t": ("s", sample.t), **outputs, **others}


def trajectory_columns(run: "Run", plant: Plant | None = None) -> dict[str, tuple[str, np.ndarray]]:
    """Return the `signal_columns` of one run up to its end; values have shape (instants,)."""
    if run.trajectory is None:
        raise ValueError("the run has no trajectory: make it with rollout")
    if np.shape(run.stopped):
        raise ValueError("these are many runs: take one, jax.tree.map(lambda x: x[0], run)")
    rows = int(np.sum(run.trajectory.running)) + 1  # after the end the last sample is repeated
    columns = signal_columns(run.trajectory.sample, plant)
    return {name: (unit, np.asarray(values)[:rows]) for name, (unit, values) in columns.items()}


def write_csv(path: pathlib.Path, run: "Run", plant: Plant) -> None:
    """Write the `trajectory_columns` of one run to a CSV file with twelve digits; its header has names and units."""
    columns = {f"{name} [{unit}]": values for name, (unit, values) in trajectory_columns(run, plant).items()}
    with path.open("w", encoding="utf-8", newline="\n") as file:
        csv.writer(file, lineterminator="\n").writerow(columns)  # a plant from outside may have a comma in a unit
        for row in zip(*(values.tolist() for values in columns.values()), strict=True):
            file.write(",".join(f"{value:.12g}" for value in row) + "\n")


def to_pandas(run: "Run", plant: Plant | None = None) -> "pandas.DataFrame":
    """Return a pandas.DataFrame: the trajectory indexed by `t`, or without a trajectory one row per run.

    A trajectory has units, metrics and end flags in `attrs`. A row per run has the metrics and the end flags as
    columns. The plant defines the unit of the control.
    """
    pandas = import_optional("pandas")

    if run.trajectory is None:
        flags = {name: getattr(run, name) for name in ("stopped", "diverged", "timed_out")}
        rows = {
            name: np.atleast_1d(np.asarray(values)).reshape(-1) for name, values in {**run.metrics, **flags}.items()
        }
        return pandas.DataFrame(rows)
    columns = trajectory_columns(run, plant)
    frame = pandas.DataFrame({name: values for name, (_, values) in columns.items()}).set_index("t")
    frame.attrs |= {"units": {name: unit for name, (unit, _) in columns.items()}, **_attributes(run)}
    return frame


def to_xarray(run: "Run", plant: Plant | None = None) -> "xarray.Dataset":
    """Return the trajectory as an xarray.Dataset over `t` [s], with `units` of variables and the metrics in `attrs`."""
    xarray = import_optional("xarray")

    columns = trajectory_columns(run, plant)
    each = {name: ("t", values, {"units": unit}) for name, (unit, values) in columns.items()}
    return xarray.Dataset(each, coords={"t": each.pop("t")}, attrs=_attributes(run))


def to_figure(run: "Run", plant: Plant | None = None, title: str = "") -> Any:
    """Return a matplotlib figure of the run. The signals of the plant's output select the kind of figure."""
    from diffabs.output.plot import draw_run  # upwards: the one such import, for the method of `Run`

    return draw_run(run, title=title, unit=getattr(plant, "control_unit", ""))


def _attributes(run: "Run") -> Params:
    """Return metrics and end flags of a run as plain numbers."""
    flags = {name: int(getattr(run, name)) for name in ("stopped", "diverged", "timed_out")}
    return {**{name: float(value) for name, value in run.metrics.items()}, **flags}
