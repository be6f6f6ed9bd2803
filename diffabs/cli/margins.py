"""The command `margins`: stability margins of the linearised loop."""

import math
import pathlib
from collections.abc import Sequence
from functools import partial
from typing import TYPE_CHECKING, Annotated

import typer
from rich.table import Table

from diffabs.cli import console, show, tables, targets
from diffabs.core.pytree import ParameterSpec, replace
from diffabs.core.types import JsonObject
from diffabs.host import documents, provenance
from diffabs.host.separated import read_decimal
from diffabs.host.values import ScenarioError, format_given, read_number_in_range
from diffabs.linear.stability_margins import MARGIN_UNITS
from diffabs.scenario.parameter_paths import parameters_of, read_entries
from diffabs.scenario.registry import KMH
from diffabs.scenario.scenario import Scenario

if TYPE_CHECKING:
    from diffabs.linear.robustness import Band, System

MARGIN_NAMES = {
    **{"gain_up": "gain may rise to, times", "gain_down": "gain may fall to, times", "phase": "phase margin [deg]"},
    **{"delay": "delay margin [ms]", "modulus": "modulus margin, 1/Ms", "sensitivity": "greatest |S|, Ms"},
    **{"complementary": "greatest |T|, Mt", "crossover": "crossover [rad/s]"},
}
SHOWN_IN = {"phase": math.degrees(1), "delay": 1e3}
MOST_SAMPLES = 10_000
SHORT_PATHS = {"speed": "initial.speed", "speed_kmh": "initial.speed_kmh"}


def margins(
    scenario: console.ScenarioName,
    at: Annotated[
        list[str] | None,
        typer.Option(
            "--at", metavar="PATH=VALUE", help="Fix a parameter: speed=10, plant.mass=6, target=0.15; may be repeated."
        ),
    ] = None,
    samples: Annotated[
        int,
        typer.Option(
            min=0, max=MOST_SAMPLES, help="Number of systems inside the ranges of [design.over], added to the corners."
        ),
    ] = 32,
    changes: console.Changes = None,
    plot: Annotated[
        pathlib.Path | None, typer.Option(help="Draw Bode, Nyquist and sensitivities to this file (.png, .pdf, .svg).")
    ] = None,
    as_json: console.Json = False,
) -> None:
    """Compute stability margins of the linearised loop.

    It shows gain, phase, delay and modulus margin of the scenario, and the worst over [design.over]."""
    with console.end_on_errors():
        targets.check_picture(plot)
        with targets.new_target_file(plot, "--plot") as picture:
            setup = console.load_scenario(scenario, changes, integrated=False)
            values, target = _read_places(setup, at or ())
            nominal, over = _find_margins(setup, values, target, samples)
            result = _document(setup, nominal, over, values, target)
            show_result = partial(show.as_json, result) if as_json else partial(_show, result, setup, nominal, over)
            if picture:
                with console.show_before_errors(show_result):
                    console.run_with_progress(lambda: _draw(setup, nominal, over, picture), "drawing")
        result["files"] |= {"plot": str(plot)} if plot else {}
        show_result()
        _judge(setup, nominal, over)


def _read_places(scenario: Scenario, options: Sequence[str]) -> tuple[dict[str, float], float | None]:
    """Return values by path of the loop, in SI, and the target. Raises ScenarioError."""
    table: JsonObject = {}
    for item in options:
        path, _, text = item.partition("=")
        try:
            value = read_decimal(text)
        except ValueError:
            raise ScenarioError(f"--at {format_given(item)}: a number is needed, as in --at speed=10") from None
        path = SHORT_PATHS.get(path.strip(), path.strip())
        if path in table:
            raise ScenarioError(f"--at {path} is given twice")
        table[path] = value
    allowed = {**parameters_of(scenario.loop), "target": (ParameterSpec("1"), ())}
    entries = [entry.single("be fixed") for entry in read_entries(table, "--at", allowed, "no parameter of this loop")]
    values = {entry.path: read_number_in_range(entry.value, entry.spec, entry.where) / entry.scale for entry in entries}
    return values, values.pop("target", None)


def _find_margins(
    scenario: Scenario, values: dict[str, float], target: float | None, samples: int
) -> tuple["System", "Band"]:
    """Return the loop at these values, and over the other ranges. Raises typer.Exit for a loop without linear model."""
    from diffabs.linear.robustness import Band, band

    loop, over = replace(scenario.loop, values), _ranges(scenario, values)
    try:
        here = console.run_with_progress(lambda: band(loop, {}, 0, target), f"linearising {scenario.name}")
        work = partial(band, loop, over, samples, target)
        return here.systems[0], console.run_with_progress(work, "over the ranges") if over else Band((), 0)
    except ValueError as error:
        console.fail(f"{scenario.name}: {error}", console.FAILED)


def _ranges(scenario: Scenario, values: dict[str, float]) -> dict[str, tuple[float, float]]:
    """Return the ranges of [design.over] whose parameters have no fixed value."""
    return {path: ends for path, ends in scenario.design.ranges(scenario.loop).items() if path not in values}


def _draw(scenario: Scenario, nominal: "System", over: "Band", picture: pathlib.Path) -> None:
    from diffabs.output.plot import frequency

    loops = [system.loop for system in over.systems]
    title = f"{scenario.title or scenario.name}: the open loop"
    frequency.loop_shape(nominal.loop, nominal.margins, loops, title=title).savefig(picture)


def _document(
    scenario: Scenario, nominal: "System", over: "Band", values: dict[str, float], target: float | None
) -> JsonObject:
    """Return the JSON document, in SI."""
    content = {
        "scenario": scenario.name,
        "at": values | ({} if target is None else {"target": target}),
        "period": nominal.loop.period,
        "delay_in_the_loop": nominal.loop.delay,
        "order": len(nominal.loop.transfer().A),
        "margins": nominal.margins.record(),
        "units": MARGIN_UNITS,
        "over": {path: list(ends) for path, ends in _ranges(scenario, values).items()},
        **over.record(),
        "versions": provenance.versions(),
        "files": {},
    }
    return documents.stamp("margins", content)


def _show(result: JsonObject, scenario: Scenario, nominal: "System", over: "Band") -> None:
    """Show a table of the margins, with the worst value and its place."""
    worst = over.worst()
    table = Table("margin", "here", *([f"worst of {len(over.systems)}", "where"] if worst else []))
    for name, words in MARGIN_NAMES.items():
        row = [_format_margin(name, nominal)]
        if system := worst.get(name):
            row += [_format_margin(name, system), _format_place(system.values, scenario)]
        table.add_row(words, *row)
    when = f"sampled every {1e3 * result['period']:g} ms" if result["period"] else "in continuous time"
    delay = f", {1e3 * result['delay_in_the_loop']:g} ms of delay" if result["delay_in_the_loop"] else ""
    tables.show_titled_table(f"{scenario.title or scenario.name}: the linearised loop, {when}{delay}", table)
    if frozen := getattr(scenario.loop.plant, "frozen", ()):
        console.say(f"note: {' and '.join(frozen)} are held constant; limits are not included")
    show.show_files(result)


def _format_margin(name: str, system: "System") -> str:
    value = system.margins.numbers()[name]
    if math.isnan(value):
        return "undecided" if name == "delay" and system.margins.stable else "none"
    return "no limit" if value == math.inf else f"{value * SHOWN_IN.get(name, 1.0):.4g}"


def _format_place(values: dict[str, float], scenario: Scenario) -> str:
    units = {path: spec.unit for path, (spec, _) in parameters_of(scenario.loop).items()}
    words = []
    for path, value in values.items():
        scale, unit = (KMH, "km/h") if units[path] == "m/s" else (1.0, units[path])
        words.append(f"{path.rpartition('.')[2]} {scale * value:.4g} {unit}".strip())
    return ", ".join(words)


def _judge(scenario: Scenario, nominal: "System", over: "Band") -> None:
    """Raise typer.Exit for a loop that is unstable, here or within the ranges."""
    if not nominal.margins.stable:
        console.conclude(f"{scenario.name}: the closed loop is not stable: no margins")
    if over.unstable:
        first = _format_place(over.unstable[0].values, scenario)
        count = f"{len(over.unstable)} of {len(over.systems)} systems"
        console.conclude(f"{scenario.name}: not stable in {count} of the ranges, as at {first}")
