"""Leader table of other people's anti-lock simulations: each printed number, ours, and the verdict.

`literature.toml` holds the printed numbers with tolerances and causes. Ours come from runs of packaged scenarios. The
bound is the stop with the friction at its peak from start to end. A scenario `examples/NAME.toml` is not packaged: its
plant is a user's own, in `examples/NAME.py`.

    reproduced     ours is within the tolerance of the printed number, or below a printed upper bound
    refuted        it is not; the cause says why
    undecidable    a number, a parameter or a part is missing
"""

import functools
import json
import math
import pathlib
import shlex
import tomllib
from collections.abc import Callable, Iterator, Sequence
from typing import Any, cast

import jax
import numpy as np

from diffabs.core.pytree import parameters
from diffabs.core.types import JsonObject, Table
from diffabs.core.units import resolve_unit, units_of
from diffabs.host import files, provenance
from diffabs.loop.closed_loop import Loop
from diffabs.loop.result import Run
from diffabs.loop.run import run_unchecked
from diffabs.output import plot
from diffabs.output.plot.style import Sheet
from diffabs.papers import record
from diffabs.papers.digest import Digest
from diffabs.parts.plants import GRAVITY, RoadVehicle
from diffabs.parts.stops import Standstill
from diffabs.scenario import outside
from diffabs.scenario.scenario import Scenario, load

TITLE = "Printed numbers of published anti-lock simulations, computed again"
SHOWN = "literature-mathworks"  # scenario that stands for all in the report
SLIP_GRID = 20001  # points on [0, 1]; the knots of all tables are among them
DIGITS = 5  # significant digits of our numbers in the benchmark table, unless a row sets `digits`
NOTES = [
    "Facts and figures of the sources only; the programs were written anew, and no text of theirs is used.",
    "Ours is the converged value of the model. `scheme` is what the source's own integration gives, by an independent "
    "program.",
    "A bound is the stop with the friction at its peak from start to end, air drag and rolling resistance included.",
]


def read_sources() -> dict[str, JsonObject]:
    """Return the sources by name, as `literature.toml` has them."""
    path = pathlib.Path(__file__).parent / "literature.toml"
    return tomllib.loads(files.read_content(path).decode())


def read_rows() -> list[JsonObject]:
    """Return the rows of all sources, each with the defaults of its source."""
    return [
        {key: value for key, value in source.items() if key != "rows"} | row | {"source": name}
        for name, source in read_sources().items()
        for row in source["rows"]
    ]


def load_row_scenario(name: str, overrides: Sequence[str] = ()) -> Scenario:
    """Return the scenario of a row: a packaged one, or a file of the project's examples with parts of its own."""
    if not name.startswith("examples/"):
        return load(name, overrides, integrated=False)
    here = pathlib.Path(__file__).parent  # an installed package has copies of the examples here
    path = (here if (here / name).exists() else here.parents[1]) / name
    with outside.lend_modules(path.parent, [path.stem]):
        return load(path, overrides, integrated=False)


# Measures of a run: functions (run, row) -> number in SI units.


def _until_end(run: Run) -> tuple[Any, ...]:
    """Return time, slip, vehicle speed, wheel speed, distance and control of a run up to its end."""
    assert run.trajectory is not None
    sample, running = run.trajectory.sample, np.asarray(run.trajectory.running)
    before_end = np.concatenate([[True], running[:-1]])
    y = sample.output
    return tuple(
        np.asarray(x)[before_end] for x in (sample.t, y.slip, y.speed, y.wheel_speed, y.distance, sample.control)
    )


def _stop_time(run: Run, row: Table) -> float:
    del row
    return float(run.metrics["stop_time"])


def _stop_distance(run: Run, row: Table) -> float:
    del row
    return float(run.metrics["stop_distance"])


def _lock_time(run: Run, row: Table) -> float:
    del row
    t, _, _, wheel, _, _ = _until_end(run)
    locked = wheel <= 0
    return float(t[np.argmax(locked)]) if locked.any() else math.inf


def _fitted_distance(run: Run, row: Table) -> float:
    """Return v0^2/(2 a), with a of the straight line through the speeds between 0.3 and 0.9 of the first, v0."""
    del row
    t, _, speed, _, _, _ = _until_end(run)
    fitted = (speed > 0.3 * speed[0]) & (speed < 0.9 * speed[0])
    return float(speed[0] ** 2 / (-2 * np.polyfit(t[fitted], speed[fitted], 1)[0]))


def _time_between(run: Run, row: Table) -> float:
    t, _, speed, _, _, _ = _until_end(run)
    first, last = np.interp(-np.array(row["speeds"]), -speed, t)
    return float(last - first)


def _braking_rate(run: Run, row: Table) -> float:
    return row["rate_times_time"] / _time_between(run, row)


def _mean_slip(run: Run, row: Table) -> float:
    t, slip, _, _, _, _ = _until_end(run)
    first, last = row["window"]
    return float(np.mean(slip[(t >= first) & (t <= last)]))


def _is_cycling(run: Run, row: Table) -> float:
    """Return 1 if the torque rises through the middle of its range at least three times, else 0."""
    del row
    torque = _until_end(run)[-1]
    middle = 0.5 * (np.max(torque) + np.min(torque[np.argmax(torque) :]))
    high = torque > middle
    return float(np.sum(high[1:] & ~high[:-1]) >= 3)


def _signal_at(index: int) -> Callable[[Run, Table], float]:
    def read(run: Run, row: Table) -> float:
        signals = _until_end(run)
        return float(np.interp(row["at"], signals[0], signals[index]))

    return read


def _output_at(run: Run, row: Table) -> float:
    """Return the signal `signal` of the output at the instant `at`."""
    assert run.trajectory is not None
    sample = run.trajectory.sample
    return float(np.interp(row["at"], np.asarray(sample.t), np.asarray(getattr(sample.output, row["signal"]))))


MEASURES: dict[str, Callable[[Run, Table], float]] = {
    "stop_time": _stop_time,
    "stop_distance": _stop_distance,
    "lock_time": _lock_time,
    "fitted_distance": _fitted_distance,
    "time_between": _time_between,
    "braking_rate": _braking_rate,
    "mean_slip": _mean_slip,
    "is_cycling": _is_cycling,
    "slip_at": _signal_at(1),
    "speed_at": _signal_at(2),
    "distance_at": _signal_at(4),
    "control_at": _signal_at(5),
    "output_at": _output_at,
}

# Bounds


def bound_of_stop(kind: str, a: float, c: float, first: float, last: float) -> float:
    """Return the least time [s] or distance [m] between two speeds at v' = -(a + c v^2), or the rate a/g [1].

    Args:
        kind: "time", "distance" or "efficiency".
        a: Greatest deceleration at standstill [m/s^2].
        c: Air drag per mass [1/m].
        first: Speed at the start [m/s].
        last: Speed at the end [m/s].
    """
    if kind == "efficiency":
        return a / GRAVITY
    if kind == "distance":
        return math.log((a + c * first**2) / (a + c * last**2)) / (2 * c) if c else (first**2 - last**2) / (2 * a)
    root = math.sqrt(c / a)
    return (math.atan(root * first) - math.atan(root * last)) / math.sqrt(a * c) if c else (first - last) / a


def bound_of_loop(loop: Loop, row: Table) -> float:
    """Return the bound of a row for the road and the plant of its loop, in SI units.

    The friction is the greater of its peaks at the first and at the last speed. This is a bound only if the peak is
    monotone in the speed, as it is for the packaged roads.
    """
    plant, stop = cast(Any, loop.plant), cast(Any, loop.stop)
    if row["bound"] == "time_between":
        kind, first, last = "time", *row["speeds"]
    else:
        # A fitted distance is that to standstill, wherever the run ends.
        to_rest = isinstance(stop, Standstill) or row.get("measure") == "fitted_distance"
        kind, first, last = row["bound"], float(loop.initial.speed), 0.0 if to_rest else float(stop.speed)
    slip, speeds = np.linspace(0, 1, SLIP_GRID), np.array([[first], [last]])
    mu = float(np.max(jax.vmap(lambda s: plant.road.friction(s, speeds, 0.0))(slip)))
    a, c = mu * GRAVITY, 0.0
    if isinstance(plant, RoadVehicle):
        a = mu * float(plant.wheel_load / plant.mass) + float(plant.rolling) * GRAVITY
        c = float(plant.drag / plant.mass)
    return bound_of_stop(kind, a, c, first, last)


def _bound(row: Table, overrides: list[str]) -> float | None:
    if "bound" not in row:
        return None
    if "friction_peak" in row:
        return bound_of_stop(row["bound"], row["friction_peak"] * GRAVITY, 0.0, row["speed"], 0.0)
    return bound_of_loop(load_row_scenario(row["scenario"], overrides).loop, row)


# Rows

_run_row = jax.jit(run_unchecked, static_argnums=(1, 4))


@functools.cache
def simulate_row(scenario: str, overrides: tuple[str, ...]) -> Run:
    """Return the run of a scenario with overrides. Several rows read the same run."""
    case = load_row_scenario(scenario, overrides)
    return _run_row(case.loop, case.solver, dict(case.objectives), None, case.solver.every)


def our_value(row: Table) -> float | None:
    """Return our number of a row, in its unit; None if nothing can be computed."""
    measure = row.get("measure")
    if measure == "saving":
        before, after = row["values"]
        return 100 * (1 - after / before)
    if not measure or "printed" not in row:
        return None
    values = []
    for overrides in (row.get("set", []), *([row["against"]] if "against" in row else [])):
        run = simulate_row(row["scenario"], tuple(overrides))
        if bool(run.diverged):
            raise RuntimeError(f"the run of {row['source']}, {row['quantity']}, has diverged")
        values.append(MEASURES[measure](run, row))
    combine = {"difference": lambda a, b: a - b, "ratio": lambda a, b: a / b}.get(row.get("operation", ""))
    return row.get("factor", 1.0) * (combine(*values) if combine else values[0])


def judge_row(row: Table) -> JsonObject:
    """Return a row of the table, with our number, bound and verdict."""
    overrides, printed, ours = row.get("set", []), row.get("printed"), our_value(row)
    tolerance = row.get("tolerance", row.get("relative", 0.0) * (printed or 0.0))
    verdict = "undecidable"
    if ours is not None and printed is not None:
        values = [ours, *(our_value({**row, "set": [*overrides, *near]}) for near in row.get("nearby", []))]
        excess = (value - printed if row.get("at_most", False) else abs(value - printed) for value in values)
        verdicts = {"reproduced" if by <= tolerance else "refuted" for by in excess}
        verdict = verdicts.pop() if len(verdicts) == 1 else verdict
    scenario = row.get("scenario")
    texts = [text for override in overrides for text in ("--set", override)]
    if scenario is not None and scenario.startswith("examples/"):
        texts += ["--parts", scenario.removesuffix(".toml").replace("/", ".")]  # from the folder of the project
    has_run = scenario is not None and ours is not None and row.get("measure") != "saving"
    return {
        "source": row["source"],
        "quantity": row["quantity"],
        "unit": row["unit"],
        "printed": printed,
        "at_most": row.get("at_most", False),
        "ours": ours,
        "tolerance": None if verdict == "undecidable" else tolerance,
        "verdict": verdict,
        "cause": row.get("cause", ""),
        "bound": _bound(row, overrides),
        "scheme": row.get("scheme"),
        "scenario": scenario if has_run else None,
        "command": shlex.join(["diffabs", "simulate", str(scenario), *texts]) if has_run else None,
        "place": row["place"],
        "digits": row.get("digits", DIGITS),
    }


def reproduce(folder: pathlib.Path, progress: Callable[[str], None]) -> JsonObject:
    """Write the figure, `table.json` and `summary.json` into the folder, and return the summary."""
    rows = []
    for group in _by_source(read_rows()):
        progress(f"literature: {group[0]['title']}")
        rows += [judge_row(row) for row in group]
    progress("literature: figure and table")
    files.write_file(folder / "table.json", write_json(rows).encode())
    solver = load(SHOWN, integrated=False).solver
    summary = {
        "paper": "literature",
        "scenario": SHOWN,
        "title": TITLE,
        "rows": rows,
        "sources": {name: {key: source[key] for key in ("title", "place")} for name, source in read_sources().items()},
        "figures": record.save_figures({"printed_against_ours": draw_rows(rows)}, folder),
        "notes": NOTES,
        "solver": {"method": "RK4, fixed step of each scenario", f"step of {SHOWN}": solver.step},
        "made": provenance.describe_making(("reproduce", "literature")),
        "versions": record.origin_of_numbers(),
    }
    return record.write_summary(folder, summary, compact)


def _by_source(rows: list[JsonObject]) -> Iterator[list[JsonObject]]:
    for name in dict.fromkeys(row["source"] for row in rows):
        yield [row for row in rows if row["source"] == name]


# Benchmark table


def write_json(rows: list[JsonObject]) -> str:
    """Return the benchmark table as JSON: the scenarios with parameters and units, the sources, and the rows."""
    names = dict.fromkeys(row["scenario"] for row in rows if row["scenario"])
    content = {
        "scenarios": {name: scenario_parameters(name) for name in names},
        "sources": {row["source"]: row["place"] for row in rows},
        "rows": [_round_row(row) for row in rows],
    }
    return json.dumps(content, indent=1, allow_nan=False) + "\n"


def _round_row(row: JsonObject) -> JsonObject:
    numbers = {key: float(f"{row[key]:.{row['digits']}g}") for key in ("ours", "bound") if row[key] is not None}
    tolerance = {} if row["tolerance"] is None else {"tolerance": float(f"{row['tolerance']:.3g}")}
    return {key: value for key, value in (row | numbers | tolerance).items() if key != "digits"}


def scenario_parameters(name: str) -> JsonObject:
    """Return the parameters of a scenario by path, each with value and unit."""
    scenario = load_row_scenario(name)
    units = units_of(scenario.loop.plant)
    described: JsonObject = {
        path: {"value": np.asarray(value).tolist(), "unit": resolve_unit(spec.unit, units)}
        for path, spec, value in parameters(scenario.loop)
    }
    return {key: row for key, row in described.items() if np.all(np.isfinite(row["value"]))}


# Figure and digest


def draw_rows(rows: list[JsonObject]) -> Sheet:
    """Return the figure of all stops: the printed number and ours, each as a multiple of the bound."""
    stops = [row for row in rows if row["bound"] and row["printed"] and row["unit"] in ("s", "m")]
    places = np.arange(len(stops))[::-1]
    figure, (axis,) = plot.sheet(size=(9.0, 0.26 * len(stops) + 1.2), title="Stops: printed and ours")
    axis.axvline(1.0, color="black", lw=1, label="bound: friction at its peak")
    for key, marker, colour in (("printed", "+", plot.COLOURS[0]), ("ours", "x", plot.COLOURS[1])):
        shown = [(row[key] / row["bound"], at) for row, at in zip(stops, places, strict=True) if row[key] is not None]
        axis.scatter(*np.transpose(shown), s=36, marker=marker, color=colour, label=key)
    axis.set_yticks(places, [f"{row['source']}: {row['quantity']}" for row in stops], fontsize=7)
    plot.label_axes(axis, "time or distance, relative to the bound [1]", "")
    return figure


def compact(summary: Table) -> Digest:
    """Return the digest: every row of the table, the verdicts counted, and the refuted rows with their causes."""
    headings = ("source", "quantity", "unit", "printed", "ours", "bound", "verdict")
    rows = summary["rows"]
    lines = [
        (row["source"], row["quantity"], row["unit"], _format_printed(row), _number(row["ours"]), _number(row["bound"]),
         row["verdict"])
        for row in rows
    ]  # fmt: skip
    counts = {word: sum(row["verdict"] == word for row in rows) for word in ("reproduced", "refuted", "undecidable")}
    agreement = [f"{len(rows)} printed numbers: " + ", ".join(f"{n} {word}" for word, n in counts.items()) + "."]
    causes = {(row["source"], row["cause"]): None for row in rows if row["verdict"] == "refuted"}
    verdicts = [("refuted", f"{source}, {_names(rows, source, cause)}: {cause}") for source, cause in causes]
    return Digest(summary["title"], headings, lines, agreement, verdicts, len(summary["figures"]))


def _names(rows: list[JsonObject], source: str, cause: str) -> str:
    named = [row["quantity"] for row in rows
             if (row["source"], row["cause"], row["verdict"]) == (source, cause, "refuted")]  # fmt: skip
    return named[0] if len(named) == 1 else f"{len(named)} numbers"


def _format_printed(row: Table) -> str:
    return f"{'<= ' if row['at_most'] else ''}{_number(row['printed'])}"


def _number(value: float | None) -> str:
    return "" if value is None else f"{value:.{DIGITS}g}"
