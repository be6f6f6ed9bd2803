"""The right column: verdict, map of poles, curves over frequency, margins, and metrics of the run."""

from nicegui import ui  # pyright: ignore[reportMissingImports]  # the extra `explore`

from diffabs.core.types import JsonObject, PyTree
from diffabs.output.explore import charts
from diffabs.output.explore.canvas import Canvas
from diffabs.output.explore.frequency_card import FrequencyCard
from diffabs.output.explore.knobs import unit_words
from diffabs.output.explore.panels import NO_VALUE, format_reading
from diffabs.output.explore.session import CERTIFIED, REFUTED, UNDECIDED, ProofVerdict
from diffabs.output.explore.stability import Stability, format_margin
from diffabs.scenario.registry import unit_of
from diffabs.scenario.scenario import Scenario

HEADS = {CERTIFIED: "certified", REFUTED: "no common Lyapunov matrix", UNDECIDED: "undecided"}
MARGINS = {
    "gain_up": "gain may rise to",
    "gain_down": "gain may fall to",
    "phase": "phase margin",
    "delay": "delay margin",
    "modulus": "modulus margin 1/Ms",
}


class ResultsPanel:
    """The current results of the loop; results that are being computed again are marked."""

    def build(self) -> None:
        """Put the panel into the open column."""
        with ui.element("div").classes("card-title"):
            ui.label("certificate over the ranges of [design]")
            self.proving = ui.label("computing …").classes("busy").props("data-id=proving")
        with ui.element("div").classes("verdict stale").props("data-id=verdict") as self.verdict_box:
            self.word = ui.label("").style("font-weight:600; font-size:13.5px").props("data-id=word")
            self.why = ui.label("").classes("why")
        self.proved_of: ui.label = ui.label("").classes("note").props("data-id=proved-of")
        with ui.element("div").classes("verdict").props("data-id=proved-box") as self.box_verdict:
            self.box_word = ui.label("").style("font-weight:600; font-size:13.5px")
            self.box_why = ui.label("").classes("why")
        self.box_verdict.set_visibility(False)
        with ui.element("div").classes("card-title"):
            ui.label("poles of the linearised loop")
            self.loop = ui.label("").classes("note").props("data-id=stable")
            self.solving = ui.label("computing …").classes("busy")
        self.map: Canvas = Canvas(charts.pole_chart(), "poles", "poles")
        self.none: ui.label = ui.label("").classes("note").props("data-id=about-poles")
        self.poles_of: ui.label = ui.label("").classes("note").props("data-id=poles-of")
        self.frequency: FrequencyCard = FrequencyCard()
        self.frequency.build()
        table = ui.element("div").classes("grid-table").style("grid-template-columns: 1fr auto auto")
        self.margin_cells: dict[str, tuple[PyTree, PyTree]] = {}
        with table.props("data-id=margins"):
            for words in ("margins", "here", "worst"):
                ui.label(words).classes("head" if words == "margins" else "head number")
            for name, words in MARGINS.items():
                ui.label(words)
                here, worst = (ui.label(NO_VALUE).classes("number") for _ in range(2))
                here.props["data-margin"], worst.props["data-margin"] = name, f"{name}-worst"
                self.margin_cells[name] = (here, worst)
        with ui.element("div").classes("card-title"):
            ui.label("measured on the run")
            self.measuring = ui.label("computing …").classes("busy")
        self.numbers: ui.element = ui.element("div").classes("grid-table").style("grid-template-columns: 1fr auto auto")
        self.numbers.props("data-id=metrics")

    def begin(self, scenario: Scenario) -> None:
        """Prepare the panel for another scenario."""
        self.units: dict[str, str] = {
            name: unit_of(objective, scenario.loop.plant) for name, objective in scenario.objectives.items()
        }
        self.verdict_box.classes(replace="verdict stale")
        control = charts.QUANTITIES.get(getattr(scenario.loop.plant, "control_unit", ""), "control")
        for line in (self.proved_of, self.poles_of):
            line.set_text(f"of the linear model: {control} limits are not in this")
        for line in (self.word, self.why, self.none, self.loop):
            line.set_text("")
        self.numbers.clear()
        self.cells: JsonObject = {}
        with self.numbers:
            for name, unit in self.units.items():
                ui.label(name.replace("_", " "))
                self.cells[name] = ui.label("").classes("number")
                self.cells[name].props["data-metric"] = name
                ui.label(unit_words(unit)).classes("note")

    def wait(self) -> None:
        """Mark all results as out of date."""
        for busy in (self.proving, self.solving, self.measuring):
            busy.set_visibility(True)
        self.verdict_box.classes(add="stale")

    def metrics(self, values: dict[str, float], *, fresh: bool) -> None:
        """Show the metrics; `fresh` says that they belong to the current numbers."""
        self.measuring.set_visibility(not fresh)
        for name, value in values.items():
            self.cells[name].set_text(format_reading(value))

    def stability(self, outcome: Stability | str, *, fresh: bool) -> None:
        """Show poles, margins and curves over frequency, or the reason why there are none.

        `outcome` is the stability or the reason as text. `fresh` says that it belongs to the current numbers.
        """
        self.solving.set_visibility(not fresh)
        loop = None if isinstance(outcome, str) else outcome
        self.map.change(charts.change_poles(loop))
        self.map.element.set_visibility(loop is not None)
        self.frequency.element.set_visibility(loop is not None)
        if loop:
            self.frequency.show(loop.curves, loop.box)
        self.none.set_text(outcome if isinstance(outcome, str) else self._of_poles(outcome))
        for name, (here, worst) in self.margin_cells.items():
            lowest = loop.box.worst if loop else {}
            here.set_text(format_margin(name, loop.margins[name], loop.stable) if loop else NO_VALUE)
            worst.set_text(format_margin(name, lowest[name], stable=True) if name in lowest else NO_VALUE)
        self.loop.set_text("" if loop is None else "stable" if loop.stable else "NOT STABLE")

    def verdict(self, verdict: ProofVerdict) -> None:
        """Show the verdict of the proof."""
        self.proving.set_visibility(False)
        self.verdict_box.classes(replace=f"verdict {verdict.word}")
        self.word.set_text(HEADS.get(verdict.word, "no verdict"))
        self.why.set_text(verdict.sentence)

    def proved_box(self, verdict: ProofVerdict) -> None:
        """Show the verdict of a proof's file on the current values."""
        self.box_verdict.set_visibility(True)
        self.box_verdict.classes(replace=f"verdict {verdict.word}")
        self.box_word.set_text("proved for the box" if verdict.word == CERTIFIED else "no proof for these values")
        self.box_why.set_text(verdict.sentence)

    @staticmethod
    def _of_poles(loop: Stability) -> str:
        """Return a line about the map: sampling, delay, and the points behind the worst margins."""
        kind = f"sampled every {1e3 * loop.period:g} ms, shown as ln(z)/T" if loop.period else "continuous time"
        late = f", {1e3 * loop.delay:g} ms of delay" if loop.delay else ""
        around = loop.box
        lost = f", {around.unstable} NOT stable" if around.unstable else ""
        points = f"; grey and worst: {around.systems} points of [design.over]{lost}" if around.systems else ""
        return f"{kind}{late}{points}"
