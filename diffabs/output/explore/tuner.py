"""The dialog and the card of a tuning: free parameters, progress, and values before and after."""

import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

from nicegui import ui  # pyright: ignore[reportMissingImports]  # the extra `explore`

from diffabs.core.pytree import get
from diffabs.core.types import PyTree
from diffabs.host.values import ScenarioError
from diffabs.output.explore import curves, tuning
from diffabs.output.explore.canvas import Canvas
from diffabs.output.explore.knobs import unit_words
from diffabs.output.explore.panels import Curves, format_reading
from diffabs.output.explore.session import Session
from diffabs.output.explore.work import NewestJobThread
from diffabs.scenario.scenario import Scenario

if TYPE_CHECKING:
    from diffabs.tune.result import TuningProgress

Fields = tuple[Any, Any]  # fields of the lower and the upper bound
LOGARITHMIC_LOSS_RATIO = 20  # ratio of the largest to the smallest loss above which the axis is logarithmic
LOSS = {
    "animation": False,
    "grid": {"left": 52, "right": 8, "top": 8, "bottom": 18},
    "xAxis": {"type": "value", "minInterval": 1, "axisLabel": {"fontSize": 9}},
    "yAxis": {"type": "value", "scale": True, "axisLabel": {"fontSize": 9}, "splitNumber": 2},
    "series": [{"id": "loss", "type": "line", "showSymbol": False, "data": [], "lineStyle": {"width": 1.6}}],
}


class Reactions(NamedTuple):
    """What the page does for its tuner.

    Attributes:
        later: Calls a function with these arguments in the server's thread.
        show_refusal: Shows why something was refused; None removes the message.
        show_values: Shows the session's values in all controls and runs the loop with them.
        pin: Keeps curves beside the later ones; None removes them.
    """

    later: Callable[..., None]
    show_refusal: Callable[[Exception | None], None]
    show_values: Callable[[], None]
    pin: Callable[[Curves | None], None]


class Tuner:
    """One tuning at a time, in its own thread. Its result replaces all edits made during the tuning."""

    def __init__(self, session: Session, pose: Callable[[Scenario], tuning.TuningTask], page: Reactions, thread: str):
        """Prepare the tuner of a `session`, whose tasks `pose` makes; `thread` is the name of its thread."""
        self.session = session
        self.pose = pose
        self.page = page
        self.worker: NewestJobThread = NewestJobThread(thread)
        self.stopping, self.running = False, False
        self.origin: Scenario | None = None

    def build(self) -> None:
        """Put the hidden card into the open column, and the closed dialog on the page."""
        self.dialog: ui.dialog = ui.dialog()
        self.card: ui.element = ui.element("div").classes("tuning").props("data-id=tuning")
        self.card.set_visibility(False)

    def begin(self) -> None:
        """Stop the tuning, and hide its card and the dialog, for another scenario."""
        self.stopping = True
        self.origin = None
        self.dialog.close()
        self.card.set_visibility(False)

    def end(self) -> None:
        """Stop the tuning and its thread, for a closed tab."""
        self.stopping = True
        self.worker.end()

    def ask(self) -> None:
        """Open the dialog."""
        if self.running:
            ui.notify("a tuning is under way", type="warning")
            return
        now = self.session.scenario()
        paths, metric = tuning.default_tuning(now)
        self.dialog.clear()
        with self.dialog, ui.card().style("min-width: 460px").props("data-id=ask-tuning"):
            ui.label("Tune from here").style("font-weight:600; font-size:15px")
            free = ui.select(tuning.tunable_parameters(now), value=paths, label="free parameters", multiple=True)
            free.classes("w-full").props("dense outlined use-chips data-id=free")
            fields: dict[str, Fields] = {}
            ranges = ui.element("div").classes("grid-table bounds").props("data-id=bounds")
            ranges.style("grid-template-columns: 1fr 92px 92px auto")
            free.on_value_change(lambda: self._bounds(ranges, now, list(free.value or ()), fields))
            self._bounds(ranges, now, paths, fields)
            objective = tuning.describe_own_objective(now)
            goals = {tuning.OWN_OBJECTIVE: f"the scenario's objective: {objective}"} if objective else {}
            goals |= {name: name for name in now.objectives}
            small = ui.select(goals, value=metric, label="make small").props("dense outlined")
            small.classes("w-full").props("data-id=metric")
            ui.label(self._about(now)).classes("note")
            with ui.row().classes("w-full justify-end"):
                ui.button("cancel", on_click=self.dialog.close).props("flat no-caps")

                def start() -> None:
                    if not self.dialog.value:
                        return  # a second click, while the dialog closes
                    self.dialog.close()
                    bounded = {key: (low.value, high.value) for key, (low, high) in fields.items()}
                    self._start(list(free.value or ()), str(small.value), bounded)

                ui.button("start", on_click=start).props("unelevated no-caps data-id=start")
        self.dialog.open()

    def _bounds(self, place: ui.element, now: Scenario, paths: list[str], fields: dict[str, Fields]) -> None:
        """Show fields for the lower and upper bound of each free number."""
        knobs = self.session.knobs
        place.clear()
        fields.clear()
        with place:
            for words in ("stays between", "low", "high", ""):
                ui.label(words).classes("head number" if words in ("low", "high") else "head")
            for path in paths:
                try:
                    ends = tuning.bounds_on_page(now, path, knobs)
                except ScenarioError as error:
                    ui.label(str(error)).style("grid-column: 1 / 5")
                    continue
                for key, pair in ends.items():
                    ui.label(knobs[key].name)
                    low, high = (ui.input(value=knobs[key].text(end)).props("dense outlined") for end in pair)
                    low.props["data-bound"], high.props["data-bound"] = f"{key}-low", f"{key}-high"
                    fields[key] = (low, high)
                    ui.label(unit_words(knobs[key].spec.unit)).classes("note")

    @staticmethod
    def _about(now: Scenario) -> str:
        task = now.tune
        grid = " by ".join(f"{len(values)} of {path}" for path, values in task.over.items()) or "the run shown"
        lanes = f"{task.samples} samples of {' and '.join(task.over)}" if task.samples and task.over else grid
        requirements = [f"{name} ≤ {bound:g}" for name, bound in task.limits.items()]
        requirements += [f"certified decay ≥ {task.decay:g} 1/s"] if task.decay else []
        requirements += [f"damping ≥ {task.damping:g}"] if task.damping else []
        limit = f"at most {task.iterations} iterations"
        return (
            f"over {lanes}; such that {', '.join(requirements)}; {limit} in each round"
            if requirements
            else f"over {lanes}; {limit}"
        )

    def _start(self, paths: list[str], metric: str, bounded: dict[str, tuple[PyTree, PyTree]]) -> None:
        session = self.session
        try:
            scenario = tuning.scenario_with_goal(session.scenario(), paths, metric, session.knobs, bounded)
        except Exception as error:  # also an unexpected one says why nothing starts
            self.page.show_refusal(error)
            return
        self.page.show_refusal(None)
        self.stopping, self.running, self.origin = False, True, session.scenario()
        self.losses: list[float] = []
        self.card.clear()
        with self.card:
            with ui.element("div").classes("card-title"):
                ui.label("tuning")
                self.far = ui.label("compiling …").classes("busy").props("data-id=far")
            self.bar = ui.linear_progress(0, show_value=False).props("rounded size=6px")
            self.loss = Canvas(LOSS, "loss")
            ui.button("stop with the best so far", on_click=self._stop).props("flat dense no-caps size=sm data-id=stop")
        self.card.set_visibility(True)
        self.worker.ask(lambda: self._tune(scenario))

    def _stop(self) -> None:
        self.stopping: bool = True

    # Methods that run in the tuning's thread.
    def _tune(self, scenario: Scenario) -> None:
        later = self.page.later
        try:
            posed = self.pose(scenario)
            before = curves.run_curves(scenario)
            tuned = tuning.tune_scenario(
                scenario,
                posed,
                self.session.knobs,
                lambda progress: later(self._show_progress, progress),
                lambda: self.stopping,
            )
            after = curves.run_curves(tuned.after)
        except Exception as error:  # the message shows every error
            later(self._gave_up, error)
        else:
            later(self._show_result, scenario, tuned, before, after)

    # Methods that run in the server's thread.
    def _show_progress(self, progress: "TuningProgress") -> None:
        iteration, loss = progress.point.iteration, progress.point.loss
        if self.origin is None:
            return
        limit = self.origin.tune.iterations
        words = f"round {progress.round + 1}, " if progress.round else ""
        self.far.set_text(f"{words}iteration {iteration} of at most {limit}, loss {loss:.5g}")
        self.bar.set_value(min(1.0, iteration / limit))
        if not math.isfinite(loss):  # an infinite loss has no place in the chart
            return
        self.losses.append(float(f"{loss:.6g}"))
        wide = min(self.losses) > 0 and max(self.losses) > LOGARITHMIC_LOSS_RATIO * min(self.losses)
        axis = {"type": "log" if wide else "value"}
        self.loss.change({"yAxis": [axis], "series": [{"id": "loss", "data": [*enumerate(self.losses)]}]})

    def _gave_up(self, error: Exception) -> None:
        self.running = False
        if self.origin is None:
            return
        self.card.set_visibility(False)
        self.page.show_refusal(error)

    def _show_result(self, scenario: Scenario, tuned: tuning.TuningFound, before: Curves, after: Curves) -> None:
        self.running: bool = False
        if self.origin is None:
            return
        session = self.session
        self._table(scenario, tuned, before, after)
        session.adopt(tuned.after.loop)
        self.page.pin(before)
        self.page.show_values()

    def _table(self, scenario: Scenario, tuned: tuning.TuningFound, before: Curves, after: Curves) -> None:
        """Show the free parameters and the metrics before and after the tuning."""
        knobs = self.session.knobs
        self.card.clear()
        with self.card:
            with ui.element("div").classes("card-title"):
                ui.label("NOT tuned" if tuned.unstable else "tuned").props("data-id=tuned")
                ui.label(tuned.reason + ("" if tuned.met else "; NOT every constraint is met")).classes("note")
            for sentence in filter(None, (tuned.unstable, *tuned.at_bounds)):
                ui.label(sentence).classes("note").props("data-id=tuning-note")
            place = ui.element("div").classes("grid-table").style("grid-template-columns: 1fr auto auto")
            with place.props("data-id=before-after"):
                for words in ("", "before", "after"):
                    ui.label(words).classes("head number")
                for knob in knobs.values():
                    if knob.path in scenario.tune.free:
                        pair = (knob.pick(get(stage.loop, knob.path)) for stage in (scenario, tuned.after))
                        self._line(knob.label, *map(knob.text, pair))
                for name in scenario.objectives:
                    pair = (run.metrics[name] for run in (before, after))
                    self._line(name.replace("_", " "), *map(format_reading, pair))
            with ui.row().classes("gap-2"):
                ui.button("keep", on_click=self._keep).props("flat dense no-caps size=sm data-id=keep")
                ui.button("go back", on_click=self._go_back).props("flat dense no-caps size=sm data-id=go-back")

    @staticmethod
    def _line(words: str, before: str, after: str) -> None:
        ui.label(words)
        ui.label(before).classes("number")
        ui.label(after).classes("number")

    def _keep(self) -> None:
        self.card.set_visibility(False)

    def _go_back(self) -> None:
        """Return to the numbers before the tuning."""
        if self.origin is not None:
            self.session.adopt(self.origin.loop)
            self.page.show_values()
        self.card.set_visibility(False)
        self.page.pin(None)
