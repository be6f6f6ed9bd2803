"""The card of the loop's curves over frequency, with a switch between |S|, Nyquist and Bode."""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from nicegui import ui  # pyright: ignore[reportMissingImports]  # the extra `explore`

from diffabs.core.types import JsonObject
from diffabs.output.explore import frequency_charts as charts
from diffabs.output.explore.canvas import Canvas, merge_change
from diffabs.output.explore.stability import BoxLoops, LoopCurves

Lines = list[str]


class FrequencyView(NamedTuple):
    """A way to draw the curves.

    Attributes:
        chart: Returns the options of its empty chart.
        change: Returns the change that shows a loop and, if it has moved, its box.
        describe: Returns what the chart shows, and why something is missing.
    """

    chart: Callable[[], JsonObject]
    change: Callable[..., JsonObject]
    describe: Callable[[LoopCurves, BoxLoops], Lines]


def describe_sensitivity(curves: LoopCurves, box: BoxLoops) -> Lines:
    """Return lines about |S|, its band and its goal."""
    lines = [] if _is_stable(curves) else ["no curve: the loop is not stable"]
    if box.unstable:
        lines.append("no band: a loop of [design.over] is not stable")
    elif box.systems:
        lines.append(f"band: least to greatest |S| at {box.systems} points of [design.over]")
    return [*lines, "dashed: goal of [tune.constraints]"] if np.isfinite(curves.goal).any() else lines


def describe_nyquist(curves: LoopCurves, box: BoxLoops) -> Lines:
    """Return lines about L in the complex plane."""
    lines = [*_describe_opened(curves), *([f"light: {box.systems} points of [design.over]"] if box.systems else [])]
    if np.isfinite(curves.peak):
        lines.append(f"dashed: |1 + L| = 1/{curves.peak:g}, the goal `sensitivity` of [tune.constraints]")
    return [*lines, "dotted: negative frequencies"]


def describe_bode(curves: LoopCurves, box: BoxLoops) -> Lines:
    """Return lines about magnitude and phase of L."""
    band = [f"bands: range of L at {box.systems} points of [design.over]"] if box.systems else []
    return [*_describe_opened(curves), *band, "grey: 0 dB and -180°"]


def _describe_opened(curves: LoopCurves) -> Lines:
    return [] if _is_stable(curves) else ["the closed loop is NOT stable"]


def _is_stable(curves: LoopCurves) -> bool:
    return bool(np.isfinite(curves.gain).any())


VIEWS = {
    "|S|": FrequencyView(charts.sensitivity_chart, charts.change_sensitivity, describe_sensitivity),
    "Nyquist": FrequencyView(charts.nyquist_chart, charts.change_nyquist, describe_nyquist),
    "Bode": FrequencyView(charts.bode_chart, charts.change_bode, describe_bode),
}


class FrequencyCard:
    """One chart at a time: only the visible one is sent to the browser."""

    def build(self) -> None:
        """Put the card into the open element."""
        with ui.element("div") as self.element:
            with ui.element("div").classes("card-title"):
                ui.label("loop over frequency")
                ui.element("div").classes("grow")
                self.switch: ui.toggle = ui.toggle([*VIEWS], value="|S|", on_change=self._switch)
                self.switch.props("dense no-caps unelevated data-id=views")
            self.place: ui.element = ui.element("div")
            self.about: ui.label = ui.label("").classes("note").props("data-id=about-frequency")
        self.curves: LoopCurves | None = None
        self._switch()

    def show(self, curves: LoopCurves, box: BoxLoops | None = None) -> None:
        """Show the curves of a loop, and those of another `box`; None keeps the box that was shown last."""
        self.curves = curves
        if box:
            self.box: BoxLoops = box
        self.canvas.change(VIEWS[self.switch.value].change(curves, self.box.curves, moved=box is not None))
        self._describe(curves)

    def _switch(self, *event: Any) -> None:
        """Draw the chosen chart anew."""
        view = VIEWS[self.switch.value]
        options = view.chart()
        if self.curves:
            # The framework sends these options more than once, so a change could come before the last time.
            options = merge_change(options, view.change(self.curves, self.box.curves, moved=True))
            self._describe(self.curves)
        self.place.clear()
        with self.place:
            self.canvas: Canvas = Canvas(options, "frequency", "frequency")

    def _describe(self, curves: LoopCurves) -> None:
        self.about.set_text("; ".join(VIEWS[self.switch.value].describe(curves, self.box)))
