"""The view of stability margins."""

import decimal
import math

from rich.table import Table

from diffabs.cli import console, show, tables
from diffabs.cli.show_proofs import describe_box
from diffabs.core.types import JsonObject
from diffabs.linear.stability_margins import Margins
from diffabs.scenario.parameter_paths import parameters_of
from diffabs.scenario.registry import KMH
from diffabs.scenario.robustness import ScenarioChannelMargins, ScenarioMargins
from diffabs.scenario.scenario import Scenario

MARGIN_NAMES = {
    **{"gain_up": "gain may rise to, times", "gain_down": "gain may fall to, times", "phase": "phase margin [deg]"},
    **{"delay": "delay margin [ms]", "modulus": "modulus margin, 1/Ms", "sensitivity": "greatest |S|, Ms"},
    **{"complementary": "greatest |T|, Mt", "crossover": "crossover [rad/s]"},
}
SHORT_NAMES = {
    **{"gain_up": "gain up", "gain_down": "gain down", "phase": "phase [deg]", "delay": "delay [ms]"},
    **{"modulus": "1/Ms", "complementary": "Mt", "crossover": "crossover [rad/s]"},
}
SHOWN_PEAKS, BOUND_NAMES = ("sensitivity", "complementary"), ("constant", "varying")
SHOWN_IN = {"phase": math.degrees(1), "delay": 1e3}


def show_margins(result: JsonObject, scenario: Scenario, margins: ScenarioMargins) -> None:
    """Show a table of the margins, with the worst value and its place, and with what a file proves."""
    worst, proved = margins.band.worst(), result["proved"]
    columns = [*([f"worst of {len(margins.band.systems)}", "where"] if worst else []), *(["proved"] if proved else [])]
    table = Table("margin", "here", *columns)
    for name, words in MARGIN_NAMES.items():
        row = [_format_margin(name, margins.nominal.margins)]
        if system := worst.get(name):
            row += [_format_margin(name, system.margins), format_place(system.values, scenario)]
        if proved:
            row += [""] * (len(columns) - len(row)) + ([format_bound(name, proved[name])] if name in proved else [])
        table.add_row(words, *row)
    tables.show_titled_table(_title(result, scenario), table)
    show_bounds(result, scenario)
    _show_notes(result, scenario)


def show_channel_margins(result: JsonObject, scenario: Scenario, margins: ScenarioChannelMargins) -> None:
    """Show a table with a row for each channel, and one for all channels together at inputs and outputs."""
    all_margins = margins.margins
    table = Table("channel", *SHORT_NAMES.values())
    for channel, single in all_margins.channels.items():
        table.add_row(channel, *(_format_margin(name, single) for name in SHORT_NAMES))
    tables.show_titled_table(f"{_title(result, scenario)}; a channel with the others closed", table)
    table = Table("all channels", "least s(I + L)", "at [rad/s]", "Mt", "disk margin", "gains up", "phases [deg]")
    for place, at in (("at the controls", all_margins.input), ("at the outputs", all_margins.output)):
        if at:
            values = (at.smallest, at.sensitivity_at, at.complementary, at.disk, at.gain[1], math.degrees(at.phase))
            table.add_row(place, *map(_format_number, values))
    tables.show_titled_table("All channels together", table)
    console.say("s(I + L): singular value of the return difference, 1/Ms; disk margin: each channel changes by itself")
    show_bounds(result, scenario)
    _show_notes(result, scenario)


def show_bounds(result: JsonObject, scenario: Scenario) -> None:
    """Show a table of the greatest |S| and |T| found in a box and of their bounds, if there are any."""
    bounds, proved = result["bounds"], result["proved"]
    if not bounds:
        return
    columns = ["proved"] if proved else []
    table = Table("peak", "found", "where", "constant parameters", "varying parameters", *columns)
    for name, symbol in (("sensitivity", "|S|"), ("complementary", "|T|")):
        peak = bounds[name]
        shown = [_format_upper(peak["constant"]), _format_upper(peak["varying"])]
        shown += [format_bound(name, proved[name]) if name in proved else ""] if proved else []
        reached = "unstable" if peak["reached"] == "inf" else f"{peak['reached']:.5g}"
        table.add_row(symbol, reached, format_place(peak["values"], scenario), *shown)
    box = describe_box(bounds["over"], scenario)
    tables.show_titled_table(f"Greatest |S| and |T| at all frequencies, {box}", table)
    first = bounds["sensitivity"]
    console.say(
        "constant parameters: the bound of mu; varying parameters: a common Lyapunov matrix, at any rate of change"
    )
    if first["no_common"]:
        console.say("varying parameters: proved that no common Lyapunov matrix exists")
    if first["vertices"]:
        count = f"{first['vertices']} vertices that cover {first['coverage']['checked']} checked systems"
        times = {name: sum(bounds[peak]["seconds"].get(name, 0.0) for peak in SHOWN_PEAKS) for name in BOUND_NAMES}
        spent = ", ".join(f"{name} {seconds:.2g} s" for name, seconds in times.items())
        console.say(f"both bounds are about the hull of {count}; {spent}")


def _format_upper(bound: float | str | None) -> str:
    if bound is None:
        return "undecided"
    return "no bound" if bound == "inf" else format_bound("sensitivity", float(bound))


def _title(result: JsonObject, scenario: Scenario) -> str:
    when = f"sampled every {1e3 * result['period']:g} ms" if result["period"] else "in continuous time"
    delay = f", {1e3 * result['delay_in_the_loop']:g} ms of delay" if result["delay_in_the_loop"] else ""
    return f"{scenario.title or scenario.name}: the linearised loop, {when}{delay}"


def _show_notes(result: JsonObject, scenario: Scenario) -> None:
    if frozen := getattr(scenario.loop.plant, "frozen", ()):
        console.say(f"note: {' and '.join(frozen)} are held constant; limits are not included")
    show.show_files(result)


def _format_margin(name: str, margins: Margins) -> str:
    value = margins.numbers()[name]
    if math.isnan(value):
        return "undecided" if name == "delay" and margins.stable else "none"
    return "no limit" if value == math.inf else f"{value * SHOWN_IN.get(name, 1.0):.4g}"


def format_bound(name: str, bound: float) -> str:
    """Return a proved bound; rounding does not claim more than is proved."""
    digits = bound * SHOWN_IN.get(name, 1.0)
    rounding = decimal.ROUND_CEILING if name == "sensitivity" else decimal.ROUND_FLOOR
    exact = decimal.Context(prec=5, rounding=rounding).create_decimal(repr(digits))
    return f"{'at most' if name == 'sensitivity' else 'at least'} {exact.normalize():f}"


def _format_number(value: float) -> str:
    return "none" if math.isnan(value) else "infinity" if value == math.inf else f"{value:.4g}"


def format_place(values: dict[str, float], scenario: Scenario) -> str:
    """Return the parameters of a system in words."""
    units = {path: spec.unit for path, (spec, _) in parameters_of(scenario.loop).items()}
    words = []
    for path, value in values.items():
        scale, unit = (KMH, "km/h") if units[path] == "m/s" else (1.0, units[path])
        words.append(f"{path.rpartition('.')[2]} {scale * value:.4g} {unit}".strip())
    return ", ".join(words)
