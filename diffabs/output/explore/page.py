"""The page of one tab: sliders on the left, curves in the middle, the linear loop and metrics on the right."""

import asyncio
import contextlib
import math
import pathlib
import time
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import numpy as np
from nicegui import ui  # pyright: ignore[reportMissingImports]  # the extra `explore`

from diffabs.host.values import ScenarioError
from diffabs.output.explore import charts, curves, path_chart, stability
from diffabs.output.explore.canvas import Canvas, encode_change
from diffabs.output.explore.controls import Controls
from diffabs.output.explore.header import add_header
from diffabs.output.explore.knobs import Knob
from diffabs.output.explore.look import SCRIPT, STYLE
from diffabs.output.explore.panels import Curves, Fan
from diffabs.output.explore.results import ResultsPanel
from diffabs.output.explore.saver import Saver
from diffabs.output.explore.session import NOT_PROVED, Basis, ProofVerdict, Session, Tools, check_edit, objections
from diffabs.output.explore.tuner import Reactions, Tuner
from diffabs.output.explore.work import NewestJobThread
from diffabs.scenario.scenario import Scenario

QUICK_JOB_S = 0.05  # s; quicker computations are repeated during a drag
REST = 0.15  # s without a change before all results are computed
LONGEST_REST = 1.0  # s; a slow step waits for a rest of its own time, at most this, so that it hinders no drag
PROVING = 0.35  # s without a change before a proof is attempted
PREPARING = (
    "compiling and running this loop … A brake takes a few seconds, a car with four wheels up to a minute; after that, "
    "a dragged number compiles nothing."
)
STEP_WORDS = {
    "poles": "poles and margins",
    "loop curves": "curves over frequency",
    "fan": f"the fan of {curves.MEMBERS} runs",
    "box": "poles and margins over the box",
    "proof": "the certificate",
}


class Page:
    """The contents of one tab. All methods run in the server's thread, except the section at the end that is marked."""

    def __init__(self, session: Session, tools: Tools, folder: pathlib.Path, thread: str):
        """Prepare the page of a `session`.

        `tools` are the functions that need extras, `folder` is the folder for saved files, and `thread` is the name of
        the worker threads.
        """
        self.session = session
        self.tools = tools
        self.client = ui.context.client
        self.server: asyncio.AbstractEventLoop = asyncio.get_running_loop()
        self.version: int = 0
        self.turned_at: float = 0.0
        self.oldest_valid: int = 0  # earlier results are dropped: they are of another scenario, or of replaced numbers
        self.drawn: int = 0  # version of the shown curve
        self.shown: Curves | None = None
        self.refused_version: int = 0  # version of a refusal, whose message stays
        self.switching: asyncio.Lock = asyncio.Lock()  # scenario and parts change one after the other
        self.learned: dict[str, Any] = {}  # of this scenario: seconds of each step, and the box computed last
        self.box_current: bool = False  # whether the poles shown last had the box of their own loop
        self.frequencies: np.ndarray | None = None  # rad/s, of the loop whose poles were shown last; None without one
        self.drawer, self.thinker = (NewestJobThread(thread) for _ in range(2))
        self.controls: Controls = Controls(session, self._change, self._replaced, self._widen)
        self.results: ResultsPanel = ResultsPanel()
        self.saver: Saver = Saver(session, folder)
        reactions = Reactions(self.later, self.show_refusal, self._show_values, self.pin)
        self.tuner: Tuner = Tuner(session, tools.pose, reactions, thread)
        self.body: Any = None
        self.client.on_delete(self.end)

    def build(self) -> None:
        """Put all elements on the page, and start to compute."""
        with ui.element("div").classes("explorer") as self.body:
            add_header(self)
            with ui.element("main").classes("columns"):
                with ui.element("section").classes("left"):
                    self.controls.build()
                with ui.element("section").classes("middle"):
                    self.title = ui.label().classes("title").props("data-id=title")
                    self.place = ui.element("div").classes("curves").props("data-id=curves")
                    self.path_place = ui.element("div")
                    with ui.element("div").classes("foot"):
                        self.end_line = ui.label().props("data-id=end")
                        self.waiting_line = ui.label().classes("busy").props("data-id=waiting")
                with ui.element("section").classes("right"):
                    self.tuner.build()
                    self.results.build()
            self.saver.build()
        self.begin()

    def begin(self) -> None:
        """Show a scenario from its beginning."""
        self.oldest_valid, self.learned = self.version + 1, {}
        self.shown = None
        self.title.set_text(self.session.original.title or self.session.original.name)
        self.end_line.set_text("")
        self.waiting_line.set_text("")
        self.place.clear()
        self.path_place.clear()
        with self.place:
            ui.label(PREPARING).classes("preparing").props("data-id=preparing")
        self.chart: Canvas | None = None
        self.path_map: Canvas | None = None
        self.results.begin(self.session.original)
        self.tuner.begin()
        self.redraw()

    def redraw(self, edit: int = 0) -> None:
        """Compute everything again from the current values; `edit` is the browser's number of the user's edit."""
        self.version += 1
        self.turned_at = time.monotonic()
        now, edited = self.session.scenario(), self.session.edited
        if edited is None:
            self.oldest_valid = self.version
        self.results.wait()
        if self.tools.judge:
            self.results.proved_box(_verdict(self.tools.judge, self.session))
        self.drawer.ask(partial(self._draw, now, self.version, edit, edited))

    def later(self, show: Callable[..., None], *arguments: object) -> None:
        """Call show(*given) in the server's thread; workers change elements through `later` only."""

        def do() -> None:
            if not self.client.is_deleted:
                with self.client:
                    show(*arguments)

        self.server.call_soon_threadsafe(do)

    def pin(self, run: Curves | None) -> None:
        """Show `run` as the dashed curve to compare with; None removes it."""
        if self.chart is not None:
            change = charts.change_curves(run, "before") if run else charts.clear_curves("before")
            self.chart.change(change)
        if self.path_map is not None:
            self.path_map.change(path_chart.change_path_before(run.path if run else None))

    def show_until_settled(self, *, whole: bool) -> None:
        """Fit the time axis to the transient of the current run, or with `whole` to the whole run."""
        if self.chart is not None and self.shown is not None:
            self.chart.change(charts.change_time_axis(None if whole else curves.transient_end(self.shown)))

    def show_refusal(self, error: Exception | None) -> None:
        """Show the message of an `error`, which stays until the next change; None hides it."""
        if error is not None:
            self.refused_version = self.version
        self.controls.show_refusal("" if error is None else _sentence(error))

    def reset(self) -> None:
        """Set all numbers back to the scenario's values."""
        self.session.reset()
        self.show_refusal(None)
        self._show_values()

    def _show_values(self) -> None:
        """Show the session's values in all controls, and compute everything again."""
        self.controls.show_all()
        self.redraw()

    def end(self) -> None:
        """Stop all threads of a closed tab."""
        self.version += 1
        self.drawer.end()
        self.thinker.end()
        self.tuner.end()

    # Methods that run in the server's thread.
    def _change(self, key: str, value: object, edit: int) -> None:
        """Apply a dragged or typed number."""
        try:
            self.session.put(key, value)
        except ScenarioError as error:
            self.show_refusal(error)
            self.controls.wrong(key)
            return
        self.controls.show(key)
        self.redraw(edit)

    def _widen(self, name: str, value: object) -> bool:
        """Apply another spread of the fan, and return whether it is valid."""
        try:
            self.session.widen(name, value)
        except ScenarioError as error:
            self.show_refusal(error)
            return False
        self.redraw()
        return True

    def _withdraw_edit(self, key: str, error: Exception, version: int) -> None:
        """Refuse a number whose loop must not be run, and return to the last accepted numbers.

        Edits after the last accepted numbers were not checked on their own; they are withdrawn, too.
        """
        if version != self.version:
            return
        for withdrawn in self.session.withdraw():
            if withdrawn != key:
                self.controls.show(withdrawn)
        self.redraw()
        self.show_refusal(error)
        self.controls.wrong(key)

    async def _replaced(self, load: Callable[[], Basis]) -> None:
        """Load another scenario or part, switch to it, and build the controls again.

        Only the loading runs in another thread: the user goes on to edit meanwhile.
        """
        basis, refusal = None, None
        async with self.switching:
            try:
                basis = await asyncio.to_thread(load)
            except Exception as error:  # also an error in a user's part
                refusal = error
            if self.client.is_deleted:
                return
            with self.client:
                if basis:
                    self.session.switch(basis)
                self.controls.rebuild("" if basis else self.controls.fan_note.text)
                if basis:
                    self.begin()
                self.show_refusal(refusal)

    def _show_curves(self, run: Curves, now: Scenario, change: str, path_change: str, version: int, edit: int) -> None:
        if version < max(self.oldest_valid, self.drawn):
            return
        self.drawn: int = version
        self.session.accept(now.loop)
        if self.chart is None:
            self.place.clear()
            with self.place:
                self.chart = Canvas(charts.run_chart(run), "fill")
            if run.path:
                with self.path_place:
                    self.path_map = Canvas(path_chart.path_chart(run.path), "path", "path")
        else:
            self.chart.send(change, edit)
            if self.path_map is not None:
                self.path_map.send(path_change)
        self.shown = run
        if version == self.version != self.refused_version:
            self.show_refusal(None)
        self.end_line.set_text(f"{self.session.original.name} {run.end}")
        if not run.draft:
            self.results.metrics(run.metrics, fresh=version == self.version)

    def _gave_up(self, job: str, error: Exception, version: int) -> None:
        if version != self.version:
            return
        self.show_refusal(error)
        if job == "fan":
            self.controls.fan_note.set_text("no fan")
            if self.chart is not None:
                self.chart.change(charts.clear_curves("fan"))
        if job == "run":
            self.results.measuring.set_visibility(False)
            if self.shown is None:
                self.place.clear()
                self.end_line.set_text("no run")

    def _learn(self, name: str, value: object, version: int) -> None:
        if version >= self.oldest_valid:
            self.learned[name] = value

    def _show_fan(self, fan: Fan | None, change: str, version: int) -> None:
        if version < self.oldest_valid:
            return
        if self.chart is not None:
            self.chart.send(change)
        self.controls.fan(fan)

    def _show_stability(self, loop_stability: stability.Stability | str, version: int, whole: bool) -> None:
        if version >= self.oldest_valid:
            self.results.stability(loop_stability, fresh=whole and version == self.version)

    def _show_loop_curves(self, loop_curves: stability.LoopCurves, version: int) -> None:
        if version >= self.oldest_valid:
            self.results.frequency.show(loop_curves)

    def _show_waiting(self, words: str, version: int) -> None:
        if version == self.version:
            self.waiting_line.set_text(words)

    def _show_verdict(self, verdict: ProofVerdict, version: int) -> None:
        if version == self.version:
            self.results.verdict(verdict)

    # Methods that run in worker threads. They reach the page through `later` only.
    @contextlib.contextmanager
    def _report_error(self, job: str, version: int) -> Iterator[None]:
        """Show an unexpected error of the computation `job`, and go on after it."""
        try:
            yield
        except Exception as error:
            self.later(self._gave_up, job, error, version)

    def _draw(self, now: Scenario, version: int, edit: int, edited: Knob | None) -> None:
        """Compute and send the curve, after a check of the `edited` number, and then have the rest computed."""
        if edited is not None:
            try:
                check_edit(edited, now)
            except Exception as error:  # a check that fails is no permission
                self.later(self._withdraw_edit, edited.key, error, version)
                return
        with self._report_error("run", version):
            self._send(curves.run_curves(now, curves.draft_solver(now)), now, version, edit)
        # The curve comes first. Also after an error: poles and verdict may exist without a run.
        self.thinker.ask(partial(self._think, now, version))

    def _send(self, run: Curves, now: Scenario, version: int, edit: int = 0) -> None:
        path_change = encode_change(path_chart.change_path(run.path) if run.path else {})
        self.later(self._show_curves, run, now, encode_change(charts.change_curves(run)), path_change, version, edit)

    def _think(self, now: Scenario, version: int) -> None:
        """Compute everything except the curve: quick results during a drag, the others after a rest."""
        if version != self.version:
            return
        steps = {"poles": self._poles, "loop curves": self._loop_curves, "fan": self._fan}
        quick = [name for name in steps if self.learned.get(name, math.inf) < QUICK_JOB_S]
        for name in quick:
            self._time_step(name, steps[name], now, version)
        if not self._wait_for_rest(REST, version):
            return
        if curves.draft_solver(now):
            with self._report_error("run", version):
                self._send(curves.run_curves(now), now, version)
        for name in steps:
            if name not in quick and self._wait_for_rest(self._rest_before(name), version):
                self._say(name, version)
                self._time_step(name, steps[name], now, version)
        if version == self.version and not self.box_current:
            self._say("box", version)
            self._poles(now, version, box=True)
        if self._wait_for_rest(PROVING, version):
            self._say("proof", version)
            self.later(self._show_verdict, _verdict(self.tools.prove, now), version)
        self._say("", version)
        objections(now)  # compiles the check now, before the next edit needs it

    def _rest_before(self, name: str) -> float:
        """Return the rest [s] after which a step is computed: its own time, between `REST` and `LONGEST_REST`."""
        seconds = self.learned.get(name, REST)
        return min(max(REST, seconds), LONGEST_REST) if math.isfinite(seconds) else REST

    def _say(self, name: str, version: int) -> None:
        """Show what the page waits for; an empty name says that it waits for nothing."""
        first = "" if name in self.learned else " (compiles at first)"
        words = f"computing {STEP_WORDS[name]}{first} …" if name else ""
        if version == self.version:
            self.later(self._show_waiting, words, version)

    def _time_step(self, name: str, step: Callable[[Scenario, int], bool], now: Scenario, version: int) -> None:
        begun = time.monotonic()
        with self._report_error(name, version):
            useful = step(now, version)
            # Without a result the step counts as slow, so that a drag does not repeat it.
            self.later(self._learn, name, time.monotonic() - begun if useful else math.inf, version)

    def _wait_for_rest(self, seconds: float, version: int) -> bool:
        """Wait until nothing has changed for some seconds, and return whether this version is still the newest."""
        while version == self.version and (remaining := self.turned_at + seconds - time.monotonic()) > 0:
            time.sleep(min(remaining, 0.02))
        return version == self.version

    def _poles(self, now: Scenario, version: int, *, box: bool = False) -> bool:
        """Show poles, margins and curves of this loop, and return whether there are any.

        Those of the box are the cached ones, or with `box` they are computed for this loop.
        """
        shown: Any
        around = self.learned.get("box")
        try:
            if box:
                around = stability.linearise_box(now, around)
                self.later(self._learn, "box", around, version)
            shown = stability.linear_stability(now, around)
            self.box_current = around is not None and around.of == stability.box_of(now)
            self.frequencies = shown.curves.w
        except Exception as error:  # the card shows every error, and the thread goes on
            shown, self.box_current, self.frequencies = _sentence(error), True, None
        self.later(self._show_stability, shown, version, self.box_current)
        return not isinstance(shown, str)

    def _loop_curves(self, now: Scenario, version: int) -> bool:
        """Show L and |S| at the frequencies of the loop whose poles were shown last, and return whether there are any.

        It takes a fraction of the time of the margins, so it follows a drag.
        """
        if self.frequencies is None:
            return False
        try:
            loop_curves = stability.loop_curves(now, self.frequencies)
        except Exception:  # the step of the poles says the same, and why
            return False
        self.later(self._show_loop_curves, loop_curves, version)
        return True

    def _fan(self, now: Scenario, version: int) -> bool:
        fan = curves.run_fan(now, self.session.spread)
        self.later(self._show_fan, fan, encode_change(charts.change_fan(fan)), version)
        return True


def _verdict(judge: Callable[..., ProofVerdict], subject: Scenario | Session) -> ProofVerdict:
    """Return the verdict on a scenario or session; the card shows every error as the reason for no verdict."""
    try:
        return judge(subject)
    except Exception as error:
        return ProofVerdict(NOT_PROVED, _sentence(error))


def _sentence(error: Exception) -> str:
    """Return an error's message in one line, with the type of an unexpected error for a bug report."""
    words = " ".join(str(error).split())
    return words if isinstance(error, (ValueError, ArithmeticError)) and words else f"{type(error).__name__}: {words}"


async def show(source: str, tools: Tools, folder: pathlib.Path, thread: str) -> None:
    """Fill the page of a newly opened tab."""
    ui.add_css(STYLE)
    ui.add_head_html(f"<script>{SCRIPT}</script>")
    ui.colors(primary=charts.BLUE)
    client = ui.context.client
    waiting = ui.label("checking the scenario …").classes("waiting")
    await client.connected()
    try:
        session = await asyncio.to_thread(Session, source)
    except Exception as error:  # for example, the file has changed since the command started
        waiting.set_text(_sentence(error))
        return
    if client.is_deleted:
        return
    with client:
        waiting.delete()
        Page(session, tools, folder, thread).build()
