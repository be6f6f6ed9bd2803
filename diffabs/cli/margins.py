"""The command `margins`: stability margins of the linearised loop."""

import pathlib
from collections.abc import Sequence
from functools import partial
from typing import Annotated

import typer

from diffabs.cli import certificates, console, show, show_margins, targets
from diffabs.cli.options import read_sides
from diffabs.core.pytree import ParameterSpec, replace
from diffabs.core.types import JsonObject
from diffabs.host import documents, provenance
from diffabs.host.separated import read_decimal
from diffabs.host.values import ScenarioError, format_given
from diffabs.scenario.parameter_paths import parameters_of, read_fixed_values
from diffabs.scenario.robustness import ScenarioChannelMargins, ScenarioMargins, examine_margins
from diffabs.scenario.scenario import Scenario

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
        typer.Option(min=0, max=MOST_SAMPLES, help="Number of systems inside the ranges, added to the corners."),
    ] = 32,
    changes: console.Changes = None,
    plot: Annotated[
        pathlib.Path | None, typer.Option(help="Draw Bode, Nyquist and sensitivities to this file (.png, .pdf, .svg).")
    ] = None,
    proof: Annotated[
        pathlib.Path | None,
        typer.Option(
            metavar="FILE.json",
            help="Show beside the worst what this file of certify --sensitivity proves, checked again.",
        ),
    ] = None,
    bounds: Annotated[
        bool,
        typer.Option(
            "--bounds",
            help="Bound the greatest |S| and |T| over the ranges from above, too; the extra design is needed.",
        ),
    ] = False,
    over: Annotated[
        list[str] | None,
        typer.Option("--over", metavar="PATH=LOW:HIGH", help="Range of a parameter; default: [design.over]."),
    ] = None,
    as_json: console.Json = False,
) -> None:
    """Compute stability margins of the linearised loop.

    It shows gain, phase, delay and modulus margin of the scenario, and the worst over --over or [design.over]. A plant
    with several controls has them for each channel, with the others closed, and the least singular value of I + L. With
    --bounds: the greatest |S| and |T| found in these ranges, and bounds for constant and for varying parameters."""
    with console.end_on_errors():
        targets.check_picture(plot)
        with targets.new_target_file(plot, "--plot") as picture:
            setup = console.load_scenario(scenario, changes, integrated=False)
            values, target = _read_places(setup, at or ())
            ranges = {side.path: side.ends for side in read_sides(over, setup)} if over else None
            box = _bounded_box(setup, ranges, values, target) if bounds else {}
            uses = {
                "--plot": picture,
                "--proof": proof,
                "over [design.over]": setup.design.over,
                "--over without --bounds": over and not bounds,
            }
            for option in (option for option, use in uses.items() if use):
                console.refuse_several_controls(setup, f"margins {option}")
            try:
                margin_results = console.run_with_progress(
                    lambda: examine_margins(setup, values, target, samples, ranges), f"linearising {setup.name}"
                )
            except ScenarioError:
                raise
            except ValueError as error:
                console.fail(f"{setup.name}: {error}", console.FAILED)
            result = {"scenario": setup.name, **margin_results.record(), "versions": provenance.versions(), "files": {}}
            result = documents.stamp("margins", result)
            proved = _read_proof(proof, margin_results, setup, values) if proof else {}
            result["proved"] = proved
            result["bounds"] = _bound_peaks(setup, values, box) if bounds else {}
            has_channels = isinstance(margin_results, ScenarioChannelMargins)
            view = show_margins.show_channel_margins if has_channels else show_margins.show_margins
            show_result = partial(show.show_result, as_json, view, result, setup, margin_results)
            if picture and isinstance(margin_results, ScenarioMargins):
                with console.show_before_errors(show_result):
                    console.run_with_progress(lambda: _draw(setup, margin_results, picture), "drawing")
        result["files"] |= {"plot": str(plot)} if plot else {}
        show_result()
        _judge(setup, margin_results)


def _bounded_box(
    setup: Scenario, ranges: dict[str, tuple[float, float]] | None, values: dict[str, float], target: float | None
) -> dict[str, tuple[float, float]]:
    """Return the ranges of --bounds by path, in SI, without those of fixed values."""
    if target is not None:
        console.fail("--at target does not go with --bounds: set the reference of the loop")
    ranges = setup.design.ranges(setup.loop) if ranges is None else ranges
    box = {path: ends for path, ends in ranges.items() if path not in values}
    if not box:
        fixed = f"; --at fixes {', '.join(ranges)}" if ranges else ""
        console.fail(f"--bounds needs ranges: --over PATH=LOW:HIGH, or [design.over]{fixed}")
    return box


def _bound_peaks(setup: Scenario, values: dict[str, float], box: dict[str, tuple[float, float]]) -> JsonObject:
    """Return the bounds of the peaks of S and T by name, as JSON values."""
    from diffabs.robust.frequency import peaks as bounded

    with certificates.report_design_errors():
        peaks = console.run_with_progress(
            lambda: bounded.bound_peaks(replace(setup.loop, values), box), f"bounding the peaks of {setup.name}"
        )
    ranges = {path: list(ends) for path, ends in box.items()}
    return {"over": ranges, **{name: peak.record() for name, peak in peaks.items()}}


def _read_proof(
    file: pathlib.Path, results: ScenarioMargins | ScenarioChannelMargins, setup: Scenario, values: dict[str, float]
) -> dict[str, float]:
    """Return the margins that a file proves for the examined loops, by name; they are checked again."""
    from diffabs.scenario.frequency_proofs import read_proved_margins

    if isinstance(results, ScenarioChannelMargins):
        raise ScenarioError("--proof is about a loop with one control")
    loop = replace(setup.loop, values)
    try:
        return console.run_with_lines(
            lambda tell: read_proved_margins(file, results, loop, tell).bounds(), f"verifying {file}"
        )
    except ModuleNotFoundError:
        console.need_extra("proof")
        raise
    except ValueError as error:
        console.fail(f"{file}: {' '.join(str(error).split())}")


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
    values = read_fixed_values(table, "--at", allowed)
    return values, values.pop("target", None)


def _draw(scenario: Scenario, margins: ScenarioMargins, picture: pathlib.Path) -> None:
    from diffabs.output.plot import frequency

    loops = [system.loop for system in margins.band.systems]
    title = f"{scenario.title or scenario.name}: the open loop"
    frequency.loop_shape(margins.nominal.loop, margins.nominal.margins, loops, title=title).savefig(picture)


def _judge(scenario: Scenario, margins: ScenarioMargins | ScenarioChannelMargins) -> None:
    """Raise typer.Exit for a loop that is unstable, here or within the ranges."""
    nominal = margins if isinstance(margins, ScenarioChannelMargins) else margins.nominal
    if not nominal.margins.stable:
        console.conclude(f"{scenario.name}: the closed loop is not stable: no margins")
    if isinstance(margins, ScenarioMargins) and (unstable := margins.band.unstable):
        first = show_margins.format_place(unstable[0].values, scenario)
        count = f"{len(unstable)} of {len(margins.band.systems)} systems"
        console.conclude(f"{scenario.name}: not stable in {count} of the ranges, as at {first}")
