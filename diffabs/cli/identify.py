"""The command `identify`: parameters of a scenario from a measured run.

It needs the extra `tune`. Modules that need it are imported only when the command runs.
"""

import dataclasses
import functools
import math
import pathlib
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Annotated

import numpy as np
import typer

from diffabs.cli import certificates, console, progress, show, targets
from diffabs.config.values import ScenarioError, format_given, read_number_in_range, unknown_name_error
from diffabs.core.pytree import ParameterSpec, get, parameters
from diffabs.core.types import JsonObject, PyTree
from diffabs.runtime import provenance
from diffabs.scenario import section_tune, toml
from diffabs.scenario.measurements import Readings, read_measurements
from diffabs.scenario.parameter_paths import flatten_table
from diffabs.scenario.scenario import Scenario, dump
from diffabs.simulate.types import Solver

if TYPE_CHECKING:
    from diffabs.identify.fit import Identified

HIGH_CORRELATION = 0.95
ROUNDS = 3  # fits; each estimates unknown noise from the residuals of the previous fit
MIN_RELATIVE_NOISE = 1e-6  # of a column's spread: a lower bound of estimated noise
MAX_DATA_ROWS = 20_000  # of a simulated trajectory
DEPENDENT = {"slip", "speed", "wheel_speed"}
REDUNDANT = (
    "slip, speed and wheel_speed depend on each other; together they make the standard deviations too small; choose"
    " columns with --column"
)
FILE_ROUNDING = 1e-11  # relative, of an instant in a file of `simulate --csv`
SPARE = 2  # extra steps, so that the run covers the last instant of the data


def identify(
    scenario: console.ScenarioName,
    data: Annotated[
        pathlib.Path,
        typer.Option(metavar="FILE.csv", help="Measured run, as simulate --csv writes it, or a logger."),
    ],
    free: Annotated[
        list[str],
        typer.Option(metavar="PATH[=LOW:HIGH]", help="Parameter to identify, and its range; may be repeated."),
    ],
    sigma: Annotated[
        list[str] | None,
        typer.Option(
            metavar="COLUMN=NUMBER",
            help="Standard deviation of a column's noise; default: estimated from the residuals.",
        ),
    ] = None,
    column: Annotated[
        list[str] | None, typer.Option(metavar="COLUMN", help="Compare only this column; may be repeated.")
    ] = None,
    rename: Annotated[
        list[str] | None,
        typer.Option(
            metavar="COLUMN=NAME", help="Signal, or t, that a column of the file holds, in SI; may be repeated."
        ),
    ] = None,
    separator: Annotated[
        str | None, typer.Option(metavar="CHARACTER", help="Between the cells, or `tab`; default: guessed.")
    ] = None,
    changes: console.Changes = None,
    as_json: console.Json = False,
    out: Annotated[
        pathlib.Path | None, typer.Option(metavar="FILE.toml", help="Write the scenario with the identified values.")
    ] = None,
) -> None:
    """Find parameters of a scenario from a measured run.

    Each value has a standard deviation. Parameters that the run does not determine are named."""
    with console.end_on_errors(), certificates.report_design_errors():
        console.need_extra("tune")
        targets.check_scenario_file(out)
        with targets.new_target_file(out, "--out") as file:
            chosen = console.load_scenario(scenario, changes)
            units = chosen.loop.plant.shows.units
            file_form = _read_renames(rename or ()), _read_separator(separator)
            readings = _compared_columns(data, column, units, *file_form)
            noise = _read_noise(sigma or (), readings, units)
            ranges = _read_ranges(free, chosen)
            found, noise, interrupted = _fit_with_progress(chosen, readings, ranges, noise)
            result = {**_result(chosen, readings, ranges, found, noise), "interrupted": interrupted}
            show_result = functools.partial(show.as_json if as_json else show.show_identification, result)
            if interrupted:
                show_result()
                console.say("interrupted: these are the values so far, not the best ones; no file is written")
                raise typer.Exit(console.INTERRUPTED)
            if result["undetermined"]:  # inside `with`: the exception discards the file
                show_result()
                missing = "; ".join(row["direction"] for row in result["undetermined"])
                console.fail(f"{chosen.name}: not identifiable from these data: {missing}", console.FAILED)
            if file:
                with console.show_before_errors(show_result):
                    file.write_text(dump(chosen.with_loop(found.part, "identified")), encoding="utf-8")
        result["files"] |= {"out": str(out)} if out else {}
        show_result()


def _read_renames(given: Sequence[str]) -> dict[str, str]:
    """Return signals by the name of their column in the file."""
    found = {}
    for text in given:
        column, equals, name = (word.strip() for word in text.rpartition("="))
        if not (equals and column and name):
            raise ScenarioError(f"--rename {format_given(text)} is not of the form column=name")
        if column in found:
            raise ScenarioError(f"--rename {format_given(column)} is given twice")
        found[column] = name
    return found


def _read_separator(given: str | None) -> str | None:
    """Return the character between the cells, or None to guess it."""
    if given is None:
        return None
    separator = {"tab": "\t", "\\t": "\t"}.get(given, given)
    if len(separator) != 1 or separator.isalnum() or separator in "\"'+-.\r\n_":
        raise ScenarioError(f"--separator {format_given(given)} is no separator: `tab`, or a character such as ;")
    return separator


def _compared_columns(
    data: pathlib.Path,
    names: Sequence[str] | None,
    units: Mapping[str, str],
    renamed: Mapping[str, str] | None = None,
    separator: str | None = None,
) -> Readings:
    """Return the columns of a file that are compared. Who names some columns may have others in the file."""
    strict = not (names or renamed)
    readings = read_measurements(data, units, renamed=renamed, separator=separator, strict=strict)
    if readings.unread:
        console.say(f"note: not compared: {', '.join(readings.unread)}")
    if readings.infinite and not names:
        console.say(f"note: {', '.join(readings.infinite)} is infinite in every row of the data, and is not compared")
    for name in names or ():
        if name in readings.infinite:
            raise ScenarioError(f"--column {name} is infinite in every row of the data")
        if name not in readings.columns:
            raise unknown_name_error(f"--column {format_given(name)} is not in the data", name, readings.columns)
    columns = {name: readings.columns[name] for name in names or readings.columns}
    if set(columns) >= DEPENDENT:
        console.say(f"note: {REDUNDANT}")
    return Readings(readings.t, columns)


def _read_noise(given: Sequence[str], readings: Readings, units: Mapping[str, str]) -> dict[str, float]:
    """Return standard deviations by column, in SI."""
    found: dict[str, float] = {}
    for text in given:
        name, equals, number = text.partition("=")
        name = name.strip()
        if not equals:
            raise ScenarioError(f"--sigma {format_given(text)} is not of the form column=number")
        if name not in readings.columns:
            raise unknown_name_error(
                f"--sigma {format_given(name)} is not a column of the data", name, readings.columns
            )
        if name in found:
            raise ScenarioError(f"--sigma {name} is given twice")
        spec = ParameterSpec(units[name], low=0.0, open_low=True)
        found[name] = read_number_in_range(toml.parse_value(number.strip()), spec, f"--sigma {name}")
    return found


def _read_ranges(given: Sequence[str], chosen: Scenario) -> dict[str, section_tune.Ends | None]:
    """Return ranges by path; None for the declared range."""
    table = {}
    for text in given:
        path, equals, ends = text.partition("=")
        low, colon, high = ends.partition(":")
        if not path.strip() or (equals and not colon):
            raise ScenarioError(f"--free {format_given(text)} is not of the form path or path=low:high")
        (path,) = flatten_table({path.strip(): 0.0}, "--free")
        if path in table:
            raise ScenarioError(f"--free {path} is given twice")
        table[path] = (
            [toml.parse_value(low.strip()), toml.parse_value(high.strip())] if equals else section_tune.DECLARED_RANGE
        )
    found = section_tune.free_ranges(table, chosen.loop, "--free")
    section_tune.check_starts(chosen.loop, found, "--free")
    return found


def _fit_with_progress(
    chosen: Scenario, readings: Readings, ranges: Mapping[str, section_tune.Ends | None], given: Mapping[str, float]
) -> tuple["Identified", dict[str, float], bool]:
    """Return the fit, its standard deviations by column, and True if Ctrl-C ended it."""
    far: list[str] = []

    def report_progress(evaluations: int, cost: float) -> None:
        far.append(f"{evaluations} evaluation{'s' if evaluations != 1 else ''}, cost {cost:.6g}")

    ending = console.InterruptibleEnd("the evaluation in hand", nothing=lambda: not far)
    found, noise = console.run_with_progress(
        lambda: _fit(chosen, readings, ranges, given, report_progress, ending),
        f"identifying {chosen.name}",
        lambda: far[-1] if far else progress.COMPILING,
        ending,
    )
    return found, noise, ending.asked


def _fit(
    chosen: Scenario,
    readings: Readings,
    ranges: Mapping[str, section_tune.Ends | None],
    given: Mapping[str, float],
    told: Callable[[int, float], None],
    stopping: Callable[[], bool],
) -> tuple["Identified", dict[str, float]]:
    """Return the fit, and its standard deviations by column. Raises ValueError.

    An unknown deviation starts as the spread of its column. It then becomes the root mean square of the column's
    residuals, over `ROUNDS` fits in all.
    """
    from diffabs.identify.identification import identify
    from diffabs.identify.traces import Traces

    (solver, t), columns = _match_times(chosen.solver, readings.t), readings.columns

    def fit_traces(
        noise: Mapping[str, float], starts: Sequence[PyTree] = (), absolute: bool = bool(given)
    ) -> tuple["Identified", dict[str, np.ndarray]]:
        traces = Traces(t=t, columns=columns, sigma=noise)
        options = {"solver": solver, "absolute": absolute, "starts": starts}
        found = identify(chosen.loop, traces, dict(ranges), **options, progress=told, stopping=stopping)
        return found, traces.residuals(found)

    spread = {name: float(np.std(values)) or 1.0 for name, values in columns.items()}
    noise = {**spread, **given}
    found, residuals = fit_traces(noise)
    evaluations = found.evaluations
    # Weights by residuals change the fit, and the fit its residuals: iterate a few times from the last values.
    for _ in range(0 if len(given) == len(columns) else ROUNDS - 1):
        if stopping():
            break
        least = {name: MIN_RELATIVE_NOISE * size for name, size in spread.items()}
        left = {name: _root_mean_square(values) for name, values in residuals.items()}
        noise = {name: given.get(name) or max(left[name], least[name]) for name in columns}
        # Residuals below the bound are errors of the solver and of the search, not noise: they do not scale the bound.
        exact = any(left[name] < least[name] for name in columns if name not in given)
        # A value at an end of its range cannot be moved from there: the scenario's own values are the start again.
        found, residuals = fit_traces(noise, [] if found.ends else [found.values], bool(given) or exact)
        evaluations += found.evaluations
    return dataclasses.replace(found, evaluations=evaluations), noise


def _match_times(solver: Solver, t: np.ndarray) -> tuple[Solver, np.ndarray]:
    """Return a solver whose whole steps cover the instants `t`, but not more steps than the given solver's, and `t`.

    The solver keeps at most `MAX_DATA_ROWS` instants. The last instant becomes its end if it exceeds that only by the
    rounding of a file.
    """
    steps = min(math.ceil(float(t[-1]) / solver.step) + SPARE, solver.steps)
    end = steps * solver.step
    solver = dataclasses.replace(solver, duration=end, every=max(1, math.ceil(steps / MAX_DATA_ROWS)))
    # A file has an instant in 12 digits, and the product of the steps may be less than the duration by a rounding.
    return solver, np.where(t <= end * (1 + FILE_ROUNDING), np.minimum(t, end), t)


def _root_mean_square(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def _result(
    chosen: Scenario,
    readings: Readings,
    ranges: Mapping[str, section_tune.Ends | None],
    found: "Identified",
    noise: Mapping[str, float],
) -> JsonObject:
    """Return the JSON document."""
    known = found.uncertainty
    return {
        **console.describe_source(chosen),
        "data": {"samples": len(readings.t), "columns": list(readings.columns), "until": float(readings.t[-1])},
        "values": _scalar_values(chosen, ranges, found),
        "correlations": [
            {"between": [known.names[i], known.names[j]], "correlation": float(known.correlation[i, j])}
            for i in range(len(known.names))
            for j in range(i)
            if abs(known.correlation[i, j]) > HIGH_CORRELATION
        ],
        "notes": found.describe_limits().splitlines(),
        "undetermined": [
            {"direction": one.describe(), "spread": one.spread, "components": one.components}
            for one in known.undetermined_directions()
        ],
        "residuals": _residuals(readings, found, noise, chosen.loop.plant.shows.units),
        "chi2": found.chi2,
        "degrees": known.degrees,
        "scale": known.scale,
        "reason": found.reason.value,
        "evaluations": found.evaluations,
        "parameters": {path: np.asarray(v, float).tolist() for path, _, v in parameters(found.part)},
        "versions": provenance.versions("optax", "scipy"),
        "files": {},
    }


def _scalar_values(
    chosen: Scenario, ranges: Mapping[str, section_tune.Ends | None], found: "Identified"
) -> dict[str, JsonObject]:
    """Return one row for each number: a list `controller.gain` gives `controller.gain.0` and so on."""
    specs = {path: spec for path, spec, _ in parameters(chosen.loop)}
    rows = {}
    for path, ends in ranges.items():
        low, high = ends or (specs[path].low, specs[path].high)
        values = np.asarray(found.values[path], float)
        low, high, before, values = np.broadcast_arrays(low, high, np.asarray(get(chosen.loop, path), float), values)
        for at in np.ndindex(values.shape):
            name = ".".join([path, *map(str, at)])
            numbers = {"before": before[at], "value": values[at], "low": low[at], "high": high[at]}
            known = found.describe_deviation(name)
            deviation = {"deviation": None, "why": known} if isinstance(known, str) else {"deviation": known}
            rows[name] = {k: float(x) for k, x in numbers.items()} | deviation | {"unit": specs[path].unit}
    return rows


def _residuals(
    readings: Readings, found: "Identified", noise: Mapping[str, float], units: Mapping[str, str]
) -> dict[str, JsonObject]:
    """Return statistics of simulated minus measured, by column."""
    each = np.split(np.asarray(found.residuals), len(readings.columns))
    return {
        name: {
            "sigma": noise[name],
            "rms": _root_mean_square(values),
            "mean": float(np.mean(values)),
            "largest": float(np.max(np.abs(values))),
            "unit": units[name],
        }
        for name, values in zip(readings.columns, each, strict=True)
    }
