"""Margins of a scenario's loop, here and over the ranges of [design.over]."""

from collections.abc import Mapping
from typing import NamedTuple

from diffabs.core.channels import control_names, need_single_control
from diffabs.core.pytree import replace
from diffabs.core.types import JsonObject
from diffabs.host.values import ScenarioError
from diffabs.linear.multivariable_margins import MULTIVARIABLE_UNITS, MultivariableMargins, multivariable_margins
from diffabs.linear.opened_loop import OpenLoop, open_loop
from diffabs.linear.robustness import Band, System, band
from diffabs.linear.stability_margins import MARGIN_UNITS
from diffabs.scenario.scenario import Scenario


class ScenarioMargins(NamedTuple):
    """The margins of a scenario.

    Attributes:
        values: Fixed values by path of the loop, in SI.
        target: Setpoint; None for the loop's own.
        over: Ranges (low, high) of the parameters that have no fixed value, by path, in SI.
        nominal: The loop at the fixed values.
        band: The loops over the ranges; without systems if there are no ranges.
    """

    values: Mapping[str, float]
    target: float | None
    over: Mapping[str, tuple[float, float]]
    nominal: System
    band: Band

    def record(self) -> JsonObject:
        """Return the margins as JSON values, in SI."""
        opened = self.nominal.loop
        return {
            "at": {**self.values} | ({} if self.target is None else {"target": self.target}),
            "period": opened.period,
            "delay_in_the_loop": opened.delay,
            "order": len(opened.transfer().A),
            "margins": self.nominal.margins.record(),
            "units": MARGIN_UNITS,
            "over": {path: list(ends) for path, ends in self.over.items()},
            **self.band.record(),
        }


class ScenarioChannelMargins(NamedTuple):
    """The margins of a scenario whose plant has several controls.

    Attributes:
        values: Fixed values by path of the loop, in SI.
        loop: The open loop at these values.
        margins: Margins of each channel and of all.
    """

    values: Mapping[str, float]
    loop: OpenLoop
    margins: MultivariableMargins

    def record(self) -> JsonObject:
        """Return the margins as JSON values, in SI."""
        return {
            "at": dict(self.values),
            "period": self.loop.period,
            "delay_in_the_loop": self.loop.delay,
            "order": len(self.loop.transfer().A),
            **self.margins.record(),
            "units": MARGIN_UNITS | MULTIVARIABLE_UNITS,
        }


def examine_margins(
    scenario: Scenario,
    values: Mapping[str, float] | None = None,
    target: float | None = None,
    samples: int = 32,
    over: Mapping[str, tuple[float, float]] | None = None,
) -> ScenarioMargins | ScenarioChannelMargins:
    """Return the margins of a scenario's loop, at its values and over the ranges of [design.over].

    A plant with several controls has margins at its values only.

    Args:
        values: Values by path of the loop, in SI, which replace the loop's own and their ranges.
        target: Setpoint, as in `linear.open_loop`.
        samples: Number of systems inside the ranges, added to the corners.
        over: Ranges (low, high) by path of the loop, in SI; None for those of [design.over].

    Raises:
        ScenarioError: A loop with several controls has a `target`, which is one of several.
        ValueError: The loop has no linear model at a point, or several controls and [design.over].
    """
    values = dict(values or {})
    loop = replace(scenario.loop, values)
    if control_names(loop.plant):
        if target is not None:
            names = ", ".join(getattr(scenario.loop.plant.shows, "tracked", ()))
            raise ScenarioError(f"--at target = {target:g}: there are several targets, {names}; set their references")
        if scenario.design.over:
            need_single_control(loop.plant, "margins over [design.over]")
        opened = open_loop(loop, target)
        return ScenarioChannelMargins(values, opened, multivariable_margins(opened))
    ranges = scenario.design.ranges(scenario.loop) if over is None else over
    over = {path: ends for path, ends in ranges.items() if path not in values}
    (nominal,) = band(loop, {}, 0, target).systems
    return ScenarioMargins(values, target, over, nominal, band(loop, over, samples, target) if over else Band((), 0))
