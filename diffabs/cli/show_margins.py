"""The view of stability margins."""

import math

from rich.table import Table

from diffabs.cli import console, show, tables
from diffabs.core.types import JsonObject
from diffabs.linear.robustness import System
from diffabs.scenario.parameter_paths import parameters_of
from diffabs.scenario.registry import KMH
from diffabs.scenario.robustness import ScenarioMargins
from diffabs.scenario.scenario import Scenario

MARGIN_NAMES = {
    **{"gain_up": "gain may rise to, times", "gain_down": "gain may fall to, times", "phase": "phase margin [deg]"},
    **{"delay": "delay margin [ms]", "modulus": "modulus margin, 1/Ms", "sensitivity": "greatest |S|, Ms"},
    **{"complementary": "greatest |T|, Mt", "crossover": "crossover [rad/s]"},
}
SHOWN_IN = {"phase": math.degrees(1), "delay": 1e3}


def show_margins(result: JsonObject, scenario: Scenario, margins: ScenarioMargins) -> None:
    """Show a table of the margins, with the worst value and its place."""
    worst = margins.band.worst()
    table = Table("margin", "here", *([f"worst of {len(margins.band.systems)}", "where"] if worst else []))
    for name, words in MARGIN_NAMES.items():
        row = [_format_margin(name, margins.nominal)]
        if system := worst.get(name):
            row += [_format_margin(name, system), format_place(system.values, scenario)]
        table.add_row(words, *row)
    when = f"sampled every {1e3 * result['period']:g} ms" if result["period"] else "in continuous time"
    delay = f", {1e3 * result['delay_in_the_loop']:g} ms of delay" if result["delay_in_the_loop"] else ""
    tables.show_titled_table(f"{scenario.title or scenario.name}: the linearised loop, {when}{delay}", table)
    if frozen := getattr(scenario.loop.plant, "frozen", ()):
        console.say(f"note: {' and '.join(frozen)} are held constant; limits are not included")
    show.show_files(result)


def _format_margin(name: str, system: System) -> str:
    value = system.margins.numbers()[name]
    if math.isnan(value):
        return "undecided" if name == "delay" and system.margins.stable else "none"
    return "no limit" if value == math.inf else f"{value * SHOWN_IN.get(name, 1.0):.4g}"


def format_place(values: dict[str, float], scenario: Scenario) -> str:
    """Return the parameters of a system in words."""
    units = {path: spec.unit for path, (spec, _) in parameters_of(scenario.loop).items()}
    words = []
    for path, value in values.items():
        scale, unit = (KMH, "km/h") if units[path] == "m/s" else (1.0, units[path])
        words.append(f"{path.rpartition('.')[2]} {scale * value:.4g} {unit}".strip())
    return ", ".join(words)
