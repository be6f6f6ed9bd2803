"""The page of the explorer without a browser: events of its elements, and threads whose jobs a test runs itself."""

import ast
import asyncio
import contextlib
import math
import pathlib
import threading

import numpy as np
import pytest
from mutants import killed_by
from seams import replace_seam
from test_explore import SHORT

from diffabs.output.explore import curves, stability, tuning
from diffabs.output.explore.panels import Curve, Curves, Fan, Panel, Path
from diffabs.output.explore.session import AS_GIVEN, CERTIFIED, ProofVerdict, Session, Tools
from diffabs.tune.result import DescentPoint, TuningProgress

nicegui = pytest.importorskip("nicegui")
from nicegui.page import page as route  # noqa: E402  # pyright: ignore[reportMissingImports]
from nicegui.testing import UserInteraction  # noqa: E402  # pyright: ignore[reportMissingImports]

import diffabs.output.explore.page  # noqa: E402

pytestmark = pytest.mark.usefixtures("any_step_is_stable")
EXPLORE = pathlib.Path(diffabs.output.explore.page.__file__).parent
NAME = 'my metric :title="alert(1)"'
LIMIT_S = 60.0
CURVES = stability.LoopCurves(
    np.array([1.0, 10.0]), np.array([-1j, -0.1j]), np.array([0.5, 1.5]), np.full(2, math.inf), math.inf
)
LOOP = stability.Stability(
    None, 0.0, np.array([-1.0]), dict.fromkeys(stability.MARGIN_KEYS, 2.0), True, CURVES, stability.NO_BOX
)


class Jobs:
    """In place of a thread: keeps the newest job until the test runs it."""

    job = None

    def ask(self, job):
        self.job = job

    def end(self):
        self.job = None

    def run(self):
        job, self.job = self.job, None
        assert job
        job()


class OpenPage:
    """A page and its user."""

    def __init__(self, text, folder):
        """Open the page of a scenario in the running event loop; nothing is computed yet."""
        nicegui.core.loop = asyncio.get_running_loop()
        (folder / "mine.toml").write_text(text)
        self.client = nicegui.Client(route("/"), request=None)
        self.proved = []
        tools = Tools(lambda now: self.proved.append(now) or ProofVerdict(CERTIFIED, ""), lambda now: None)
        with self.client:
            self.page = diffabs.output.explore.page.Page(
                Session(str(folder / "mine.toml")), tools, folder, "page's test"
            )
            self.page.end()
            self.page.drawer, self.page.thinker, self.page.tuner.worker = Jobs(), Jobs(), Jobs()
            self.page.build()
        self.session = self.page.session

    def elements(self, name, kind="data-id"):
        return [one for one in self.client.elements.values() if one.props.get(kind) == name]

    def find(self, name, kind="data-id"):
        (one,) = self.elements(name, kind)
        return one

    def click(self, name):
        UserInteraction(self, {self.find(name)}, None).click()

    def enter(self, name, text, kind="data-field"):
        field = self.find(name, kind)
        field.set_value(text)
        UserInteraction(self, {field}, None).trigger("change")

    async def draw(self):
        """Compute the newest curve, and show it."""
        self.page.drawer.run()
        await asyncio.sleep(0)


@pytest.fixture
def visit(tmp_path):
    """Run a user, a coroutine function of an open page; `text` is the scenario."""

    def run(user, text=SHORT):
        async def body():
            opened = OpenPage(text, tmp_path)
            try:
                await user(opened)
            finally:
                opened.page.end()

        asyncio.run(body())

    return run


@killed_by("output.explore.results", '.props["data-metric"] = name', '.props(f"data-metric={name}")')
def test_a_metric_of_any_name_is_no_script(visit):
    async def user(opened):
        assert opened.find(NAME, "data-metric") is opened.page.results.cells[NAME]
        assert [one.props for one in opened.client.elements.values() if ":title" in one.props] == []

    visit(user, SHORT + f"[objective]\n'{NAME}' = 'effort'\n")


def test_texts_of_a_scenario_are_no_attributes():
    """The framework runs attributes with a leading colon as scripts, so it parses only texts of the package."""
    calls = [
        node
        for path in EXPLORE.glob("*.py")
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.func.attr == "props"
    ]
    texts = [text for call in calls for text in (*call.args, *(word.value for word in call.keywords))]
    assert len(texts) > 40
    assert [ast.unparse(text) for text in texts if not isinstance(text, ast.Constant)] == []


@killed_by("output.explore.page", "self.thinker.ask(partial(self._think, now, version))", "pass")
@pytest.mark.slow
def test_results_follow_a_refused_number(visit, monkeypatch):
    async def user(opened):
        page = opened.page
        await opened.draw()
        replace_seam(monkeypatch, "stable_step", lambda loop: 1e-4 if loop.plant.mass > 6 else 1.0)
        opened.enter("plant.mass", "7")

        def refuse(show, *given):
            with opened.client:
                show(*given)

        with monkeypatch.context() as patch:  # the worst order: the server's thread refuses before the worker goes on
            patch.setattr(page, "later", refuse)
            page.drawer.run()
        assert page.controls.message.text.startswith("plant.mass = 7 kg: solver.step")
        assert opened.session.value("plant.mass") == 5.3
        await opened.draw()
        assert page.controls.message.visible
        for step in ("_poles", "_fan"):
            monkeypatch.setattr(page, step, lambda *given, **more: True)
        thinking = threading.Thread(target=page.thinker.run, daemon=True)
        thinking.start()
        await asyncio.to_thread(thinking.join, LIMIT_S)
        await asyncio.sleep(0)
        assert [now.loop.plant.mass for now in opened.proved] == [5.3]
        assert not page.results.proving.visible

    visit(user)


@killed_by(
    "output.explore.page",
    "            return False\n        self.redraw()\n",
    "            return False\n        self.begin()\n",
)
def test_a_wider_fan_leaves_chart_and_tuning(visit, monkeypatch):
    async def user(opened):
        page = opened.page
        await opened.draw()
        chart = page.chart
        opened.click("tune")
        opened.click("start")
        opened.enter("fan-mass", "30", "data-id")
        assert opened.session.spread.mass == 0.3
        assert page.drawer.job
        assert page.chart is chart
        assert page.tuner.card.visible
        assert page.tuner.worker.job
        assert not page.tuner.stopping
        opened.enter("fan-mass", "91", "data-id")
        assert page.controls.message.text == "fan.mass = 91 is outside [0, 90] %"
        assert opened.find("fan-mass").props["error"]
        await opened.draw()
        assert page.controls.message.visible  # the curve of the number before does not hide it
        opened.enter("fan-mass", "0", "data-id")
        await opened.draw()
        assert not page.controls.message.visible
        assert "error" not in opened.find("fan-mass").props

    visit(user)


@killed_by("output.explore.page", "version < max(self.oldest_valid, self.drawn)", "version < self.oldest_valid")
def test_a_final_curve_never_hides_a_newer_draft(visit, monkeypatch):
    async def user(opened):
        page, late = opened.page, []
        monkeypatch.setattr(curves, "draft_solver", curves.drawing_solver)  # a run that is short has a draft, too
        await opened.draw()
        first = page.shown
        assert first.draft

        def edit(show, *given):
            late.append((show, given))
            opened.enter("plant.mass", "6")

        with monkeypatch.context() as patch:
            patch.setattr(page, "later", edit)
            page.thinker.run()  # the number changes while the final curve is on its way
        await opened.draw()
        newer = page.shown
        assert newer is not first
        ((show, given),) = late
        with opened.client:
            show(*given)
        assert page.shown is newer
        opened.session.put("plant.mass", "6.2")
        opened.session.withdraw()
        assert opened.session.value("plant.mass") == 6

    visit(user)


@killed_by("output.explore.page", "            self.oldest_valid = self.version\n", "            pass\n")
def test_a_late_curve_does_not_return_after_a_reset(visit):
    async def user(opened):
        await opened.draw()
        opened.enter("plant.mass", "6")
        opened.page.drawer.run()  # its curve is on its way
        opened.click("reset")
        await asyncio.sleep(0)
        opened.session.put("plant.mass", "6.2")
        opened.session.withdraw()
        assert opened.session.value("plant.mass") == 5.3

    visit(user)


@killed_by(
    "output.explore.page",
    "        if version < self.oldest_valid:\n            return\n        if self.chart is not None:\n",
    "        if self.chart is not None:\n",
)
def test_a_late_fan_does_not_return_after_a_reset(visit, monkeypatch):
    async def user(opened):
        page, late = opened.page, []
        monkeypatch.setattr(curves, "run_fan", lambda *given: None)
        monkeypatch.setattr(page, "_poles", lambda *given, **more: True)
        await opened.draw()

        def reset(show, *given):
            if show == page._show_fan:
                late.append(given)
                opened.click("reset")

        with monkeypatch.context() as patch:
            patch.setattr(page, "later", reset)
            page.thinker.run()
        (given,) = late
        with opened.client:
            page._show_fan(*given)
        assert page.controls.fan_note.text == ""

    visit(user)


async def settled(opened, condition):
    """Wait for loads in other threads."""
    with contextlib.suppress(TimeoutError):
        async with asyncio.timeout(LIMIT_S):
            while not condition():
                await asyncio.sleep(0.01)
    assert condition()


@killed_by("output.explore.page", "        async with self.switching:\n", "        if True:\n")
def test_two_quick_choices_both_hold(visit, monkeypatch):
    async def user(opened):
        load, gate = opened.session.load_part, threading.Event()
        monkeypatch.setattr(opened.session, "load_part", lambda *given: (load(*given), gate.wait(LIMIT_S))[0])
        opened.page.controls.rebuild()  # with the slow load
        with opened.client:
            opened.find("road").set_value("snow")
            opened.find("controller").set_value("relay")
        await asyncio.sleep(0.2)
        opened.enter("plant.mass", "5.5")  # an edit in between
        gate.set()
        await settled(opened, lambda: opened.session.parts == {"road": "snow", "controller": "relay"})
        assert opened.session.value("plant.mass") == 5.5
        assert opened.find("plant.mass", "data-field").value == "5.5"

    visit(user)


def broken(*given, **more):
    """In place of a function with a defect, for example in a user's part."""
    raise TypeError("broken part")


@killed_by(
    "output.explore.page",
    "            return\n        self.show_refusal(error)\n        if job",
    "            pass\n        self.show_refusal(error)\n        if job",
)
@pytest.mark.parametrize("action", ["edit", "scenario"])
def test_an_error_of_an_old_run_is_not_shown(visit, monkeypatch, action):
    async def user(opened):
        page = opened.page
        opened.enter("plant.mass", "6")
        with monkeypatch.context() as patch:
            patch.setattr(curves, "run_curves", broken)
            page.drawer.run()
        with opened.client:
            page.begin() if action == "scenario" else opened.enter("plant.mass", "6.2")
        await asyncio.sleep(0)
        assert not page.controls.message.visible
        assert page.results.measuring.visible
        with monkeypatch.context() as patch:
            patch.setattr(curves, "run_curves", broken)
            page.drawer.run()
        await asyncio.sleep(0)
        assert page.controls.message.text == "TypeError: broken part"
        assert not page.results.measuring.visible

    visit(user)


@killed_by(
    "output.explore.page", "Exception as error:  # a check that fails", "ScenarioError as error:  # a check that fails"
)
def test_an_error_in_the_check_withdraws_the_number(visit, monkeypatch):
    async def user(opened):
        await opened.draw()
        opened.enter("plant.mass", "6")
        with monkeypatch.context() as patch:
            patch.setattr(diffabs.output.explore.page, "check_edit", broken)
            await opened.draw()
        assert opened.session.value("plant.mass") == 5.3
        assert opened.page.controls.message.text == "TypeError: broken part"
        opened.page.thinker.job = None
        await opened.draw()
        assert opened.page.thinker.job

    visit(user)


@killed_by(
    "output.explore.page",
    'with self._report_error("run", version):\n                self._send',
    "if True:\n                self._send",
    case="run",
)
@killed_by("output.explore.page", "with self._report_error(name, version):", "if True:", case="fan")
@killed_by("output.explore.page", 'if job == "fan":', "if False:", case="fan")
@killed_by("output.explore.page", 'self.chart.change(charts.clear_curves("fan"))', "pass", case="fan")
@pytest.mark.parametrize("failing", ["run", "fan"])
def test_an_error_stops_no_other_result(visit, monkeypatch, failing):
    async def user(opened):
        page, asked, changes = opened.page, [], []
        monkeypatch.setattr(curves, "draft_solver", curves.drawing_solver)
        await opened.draw()
        monkeypatch.setattr(page.chart, "change", changes.append)
        monkeypatch.setattr(curves, "run_fan", broken if failing == "fan" else lambda *given: None)
        monkeypatch.setattr(page, "_poles", lambda *given, box=False: asked.append(box))
        if failing == "run":
            monkeypatch.setattr(curves, "run_curves", broken)
        page.thinker.run()
        await asyncio.sleep(0)
        assert asked == [False, True]
        assert len(opened.proved) == 1
        assert page.controls.message.text == "TypeError: broken part"
        assert not page.results.proving.visible
        assert not page.results.measuring.visible
        if failing == "fan":
            assert page.controls.fan_note.text == "no fan"
            assert changes == [{"dataset": [{"id": "fan", "source": {"t": []}}]}]

    visit(user)


@killed_by("output.explore.page", "_verdict(self.tools.judge, self.session)", "self.tools.judge(self.session)")
def test_an_error_in_a_proof_file_is_on_its_card(visit):
    async def user(opened):
        opened.page.tools = opened.page.tools._replace(judge=broken)
        opened.page.drawer.job = None
        opened.page.redraw()
        assert opened.page.drawer.job
        assert opened.page.results.box_why.text == "TypeError: broken part"

    visit(user)


@killed_by("output.explore.controls", "for note in self.session.original.notes:", "for note in ():")
def test_entries_that_a_part_removes_are_named(visit):
    async def user(opened):
        with opened.client:
            opened.session.switch(opened.session.load_part("controller", "pid"))
            opened.page.controls.rebuild()
        texts = [getattr(one, "text", "") for one in opened.client.elements.values()]
        assert "controller=pid removes tune.free.controller.gain of the replaced part" in texts

    visit(user)


@killed_by("output.explore.controls", '(fan.refused, "refused")', '(0, "refused")')
def test_refused_members_of_a_fan_are_counted(visit):
    async def user(opened):
        opened.page.controls.fan(Fan(None, (), 200, 3, 2, "mass ± 90 %"))
        assert opened.page.controls.fan_note.text == "200 members, mass ± 90 %; 3 refused; 2 diverged"

    visit(user)


@killed_by(
    "output.explore.page", "Exception as error:  # also an error in", "ScenarioError as error:  # also an error in"
)
@killed_by("output.explore.page", '"" if basis else self.controls.fan_note.text', '""')
def test_a_part_with_a_defect_changes_nothing(visit, monkeypatch):
    async def user(opened):
        page, asked = opened.page, threading.Event()
        page.controls.fan_note.set_text("200 members")
        monkeypatch.setattr(opened.session, "load_part", lambda *given: (asked.set(), broken()))
        page.controls.rebuild(page.controls.fan_note.text)
        with opened.client:
            opened.find("controller").set_value("relay")
        await settled(opened, lambda: asked.is_set() and not page.switching.locked())
        assert page.controls.message.text == "TypeError: broken part"
        assert opened.session.parts["controller"] == opened.find("controller").value == AS_GIVEN
        assert page.controls.fan_note.text == "200 members"

    visit(user)


@killed_by(
    "output.explore.page",
    "Exception as error:  # for example, the file",
    "ScenarioError as error:  # for example, the file",
)
def test_a_new_tab_shows_every_error(monkeypatch, tmp_path):
    async def connected(self):
        pass

    async def body():
        nicegui.core.loop = asyncio.get_running_loop()
        monkeypatch.setattr(diffabs.output.explore.page, "Session", broken)
        monkeypatch.setattr(nicegui.Client, "connected", connected)
        client = nicegui.Client(route("/"), request=None)
        with client, contextlib.suppress(TypeError):
            await diffabs.output.explore.page.show("mine.toml", Tools(broken, broken), tmp_path, "page's test")
        texts = [getattr(one, "text", "") for one in client.elements.values()]
        assert "TypeError: broken part" in texts

    asyncio.run(body())


@killed_by("output.explore.tuner", "if not self.dialog.value:", "if False:")
@killed_by("output.explore.tuner", "        self.dialog.close()\n        self.card", "        self.card")
def test_a_tuning_starts_once_and_from_an_open_dialog(visit):
    async def user(opened):
        tuner = opened.page.tuner
        opened.click("tune")
        start = opened.find("start")
        opened.click("start")
        first = tuner.worker.job
        assert first
        UserInteraction(opened, {start}, None).click()
        assert tuner.worker.job is first
        tuner.running, tuner.worker.job = False, None
        opened.click("tune")
        with opened.client:
            opened.page.begin()  # a road that was loaded meanwhile
        opened.click("start")
        assert not tuner.worker.job

    visit(user)


@killed_by(
    "output.explore.tuner", "Exception as error:  # also an unexpected", "ScenarioError as error:  # also an unexpected"
)
def test_a_tuning_that_cannot_start_says_why(visit, monkeypatch):
    async def user(opened):
        opened.click("tune")
        monkeypatch.setattr(diffabs.output.explore.tuner.tuning, "scenario_with_goal", broken)
        with contextlib.suppress(TypeError):
            opened.click("start")
        assert opened.page.controls.message.text == "TypeError: broken part"

    visit(user)


@killed_by("output.explore.tuner", '"NOT tuned" if tuned.unstable else "tuned"', '"tuned"')
@killed_by("output.explore.tuner", "(tuned.unstable, *tuned.at_bounds)", "(tuned.unstable,)")
def test_a_result_with_an_unstable_box_is_not_called_tuned(visit):
    async def user(opened):
        tuner, now = opened.page.tuner, opened.session.scenario()
        found = tuning.TuningFound(now, True, "it ended", ("gain 2 is at its lower bound, -300 N m",), "")
        drawn = Curves(np.array([0.0]), (), dict.fromkeys(now.objectives, 1.0), "", draft=False)
        for unstable, head in (("", "tuned"), ("1 of 8 points of [design.over] are not stable", "NOT tuned")):
            with opened.client:
                tuner._table(now, found._replace(unstable=unstable), drawn, drawn)
            assert opened.find("tuned").text == head
            notes = [one.text for one in opened.elements("tuning-note")]
            assert notes == [*filter(None, [unstable]), "gain 2 is at its lower bound, -300 N m"]

    visit(user)


@killed_by("output.explore.tuner", "if task.samples and task.over else grid", "if False else grid")
@killed_by("output.explore.tuner", "if not math.isfinite(loss):", "if False:")
@killed_by("output.explore.tuner", "min(1.0, iteration / limit)", "min(1.0, len(self.losses) / limit)")
@killed_by("output.explore.tuner", "if progress.round else", "if False else")
def test_the_card_counts_runs_rounds_and_iterations(visit):
    async def user(opened):
        tuner = opened.page.tuner
        opened.click("tune")
        (line,) = (
            words for one in opened.client.elements.values() if (words := getattr(one, "text", ""))[:5] == "over "
        )
        assert line == "over 16 samples of plant.mass; such that iae ≤ 1; at most 4 iterations in each round"
        opened.click("start")
        for turn, iteration, loss in ((0, 0, math.inf), (0, 0, 3.5), (0, 0, 2.5), (0, 1, 2.25), (1, 2, 1.5)):
            point = DescentPoint(iteration, loss, loss, 0.0, 0.0, 1)
            with opened.client:
                tuner._show_progress(TuningProgress(turn, 1, point))
            assert tuner.far.text.endswith(f"iteration {iteration} of at most 4, loss {loss}")
        assert tuner.losses == [3.5, 2.5, 2.25, 1.5]
        assert tuner.far.text == "round 2, iteration 2 of at most 4, loss 1.5"
        assert tuner.bar.value == 0.5

    goal = "iterations = 4\nsamples = 16\n[tune.over]\n'plant.mass' = [5.3, 6.2]\n[tune.limits]\niae = 1.0\n"
    visit(user, SHORT.replace("iterations = 3\n", goal))


@killed_by(
    "output.explore.tuner",
    "            return\n        self.card.set_visibility(False)\n        self.page.show_refusal(error)\n",
    "            pass\n        self.card.set_visibility(False)\n        self.page.show_refusal(error)\n",
    case="True",
)
@killed_by(
    "output.explore.tuner",
    "except Exception as error:  # the message",
    "except OSError as error:  # the message",
    case="False",
)
@pytest.mark.parametrize("left", [False, True])
def test_a_failed_tuning_is_told_to_its_own_scenario(visit, left):
    async def user(opened):
        opened.page.tuner.pose = broken
        opened.click("tune")
        opened.click("start")
        if left:
            with opened.client:
                opened.page.begin()
        with contextlib.suppress(TypeError):
            opened.page.tuner.worker.run()
        await asyncio.sleep(0)
        assert not opened.page.tuner.running
        assert opened.page.controls.message.text == ("" if left else "TypeError: broken part")

    visit(user)


@killed_by(
    "output.explore.page",
    "        if version >= self.oldest_valid:\n            self.learned",
    "        if True:\n            self.learned",
)
def test_no_box_of_the_scenario_before(visit, monkeypatch):
    async def user(opened):
        page, shown = opened.page, []

        def linearise(now, known):
            with opened.client:
                page.begin()  # while the thinker is at the old scenario
            return stability.NO_BOX

        monkeypatch.setattr(curves, "run_fan", lambda *given: None)
        monkeypatch.setattr(stability, "linear_stability", lambda now, around: shown.append(around) or LOOP)
        await opened.draw()
        with monkeypatch.context() as patch:
            patch.setattr(stability, "linearise_box", linearise)
            page.thinker.run()
        await asyncio.sleep(0)
        shown.clear()
        monkeypatch.setattr(stability, "linearise_box", broken)
        await opened.draw()
        page.thinker.run()
        assert shown == [None]

    visit(user)


@killed_by("output.explore.page", "        if self.frequencies is None:\n", "        if True:\n")
@killed_by("output.explore.page", "_sentence(error), True, None", "_sentence(error), True, self.frequencies")
def test_a_drag_redraws_the_curves_without_the_margins(visit, monkeypatch):
    async def user(opened):
        page, drawn = opened.page, []
        monkeypatch.setattr(curves, "run_fan", lambda *given: None)
        monkeypatch.setattr(stability, "linearise_box", lambda now, known: stability.NO_BOX._replace(systems=3))
        monkeypatch.setattr(stability, "box_of", lambda now: ())
        monkeypatch.setattr(stability, "linear_stability", lambda now, box: LOOP._replace(box=box or stability.NO_BOX))
        monkeypatch.setattr(stability, "loop_curves", lambda now, w: drawn.append(w) or CURVES._replace(w=w))
        await opened.draw()
        page.thinker.run()
        await asyncio.sleep(0)
        page.learned["poles"] = math.inf
        monkeypatch.setattr(page, "_wait_for_rest", lambda *given: False)
        drawn.clear()
        opened.enter("plant.mass", "5.5")
        await opened.draw()
        page.thinker.run()
        await asyncio.sleep(0)
        assert [list(w) for w in drawn] == [[1.0, 10.0]]
        shown = "band: least to greatest |S| at 3 points of [design.over]"
        assert page.results.frequency.about.text == shown

        monkeypatch.setattr(stability, "linear_stability", broken)
        page._poles(page.session.scenario(), page.version)
        assert not page._loop_curves(page.session.scenario(), page.version)
        await asyncio.sleep(0)
        assert not page.results.frequency.element.visible

    visit(user)


@killed_by("output.explore.page", "        self.path_place.clear()\n", "")
@killed_by(
    "output.explore.page", "self.path_map.change(path_chart.change_path_before(run.path if run else None))", "pass"
)
@killed_by("output.explore.page", 'self._say("", version)', "pass")
@killed_by("output.explore.page", "                self._say(name, version)\n", "")
def test_a_run_with_a_path_is_seen_from_above(visit, monkeypatch):
    async def user(opened):
        page, sent, said = opened.page, [], []
        run = Curves(np.arange(2.0), (Panel("1", (Curve("slip", np.zeros(2)),)),), {}, "", draft=False)
        line = np.array([0.0, 5.0])
        path = Path(line, line, line, line, np.empty((0, 0, 2)), ((-1.0, 6.0), (-1.0, 1.0)), ())
        monkeypatch.setattr(curves, "run_curves", lambda *given: run._replace(path=path))
        monkeypatch.setattr(curves, "run_fan", lambda *given: said.append(page.waiting_line.text))
        monkeypatch.setattr(stability, "linear_stability", broken)
        monkeypatch.setattr(page, "later", lambda show, *given: show(*given))
        page.results.cells = dict.fromkeys(page.session.original.objectives)
        assert "compiling" in opened.find("preparing").text
        with opened.client:
            page.drawer.run()
            assert opened.elements("preparing") == []
            assert opened.find("path").options["dataset"][0]["source"]["x"] == [0.0, 5.0]
            monkeypatch.setattr(page.path_map, "change", sent.append)
            page.pin(page.shown)
            page.pin(None)
            assert [change["dataset"][0]["source"]["x"] for change in sent] == [[0.0, 5.0], []]
            page.thinker.run()
            assert said == ["computing the fan of 200 runs (compiles at first) …"]
            assert page.waiting_line.text == ""
            page.begin()
        assert opened.elements("path") == []

    visit(user)


@killed_by("output.explore.frequency_card", "moved=box is not None", "moved=True")
@killed_by("output.explore.frequency_card", "        self.place.clear()\n", "")
@killed_by("output.explore.frequency_card", "        if self.curves:\n", "        if False:\n")
def test_only_the_chosen_chart_over_frequency_is_drawn(visit, monkeypatch):
    async def user(opened):
        card, changes = opened.page.results.frequency, []
        unstable = CURVES._replace(gain=np.full(2, math.nan), peak=2.0)
        box = stability.NO_BOX._replace(systems=2, unstable=1)
        with opened.client:
            card.show(unstable, box)
            assert card.about.text == "no curve: the loop is not stable; no band: a loop of [design.over] is not stable"
            for view, words in (("Nyquist", "the closed loop is NOT stable; light: 2"), ("Bode", "grey: 0 dB")):
                card.switch.set_value(view)
                assert words in card.about.text
                canvas = opened.find("frequency")
                assert canvas is card.canvas.element
                assert canvas.options["dataset"][0]["source"]["w"] == [1.0, 10.0]
            monkeypatch.setattr(card.canvas, "change", changes.append)
            card.show(CURVES)
            card.show(CURVES, box)
        assert [[part["id"] for part in change["dataset"]] for change in changes] == [["here"], ["here", "box"]]

    visit(user)


@killed_by("output.explore.page", "self.version + 1, {}", "self.version + 1, self.learned")
def test_a_quick_fan_is_slow_in_another_scenario(visit, monkeypatch):
    async def user(opened):
        page, done = opened.page, []
        for name in ("poles", "loop_curves", "fan"):
            monkeypatch.setattr(page, f"_{name}", lambda *given, **more: done.append(1) or True)
        await opened.draw()
        page.thinker.run()
        await asyncio.sleep(0)
        monkeypatch.setattr(page, "_wait_for_rest", lambda *given: False)  # a drag
        for begin, quick in ((page.redraw, 3), (page.begin, 0)):
            done.clear()
            with opened.client:
                begin()
            await opened.draw()
            page.thinker.run()
            assert len(done) == quick

    visit(user)


@killed_by("output.explore.page", "min(max(REST, seconds), LONGEST_REST) if", "REST if")
def test_a_slow_step_waits_for_a_longer_rest(visit):
    """So that a fan of a second does not stop a drag that pauses for a moment."""

    async def user(opened):
        page = opened.page
        page.learned |= {"fan": 0.4, "poles": math.inf, "loop curves": 7.0}
        assert [page._rest_before(name) for name in ("fan", "poles", "loop curves", "box")] == [0.4, 0.15, 1.0, 0.15]

    visit(user)


@killed_by("output.explore.tuner", "        self.dialog.clear()\n", "", case="tune-ask-tuning")
@killed_by("output.explore.saver", "        self.dialog.clear()\n", "", case="save-saving")
@pytest.mark.parametrize(("button", "dialog"), [("tune", "ask-tuning"), ("save", "saving")])
def test_a_page_keeps_one_dialog(visit, button, dialog):
    async def user(opened):
        counts = []
        for _ in range(3):
            opened.click(button)
            counts.append(len(opened.client.elements))
        assert len(opened.elements(dialog)) == 1
        assert counts == [counts[0]] * 3

    visit(user)


@killed_by("output.explore.controls", "knob.place_of(value)) > 0.5", "knob.place_of(value)) > 1e-6")
def test_a_dragged_slider_is_not_pushed_back(visit):
    async def user(opened):
        slider = opened.find("plant.mass", "data-slider")
        slider.set_value(333)
        with opened.client:
            opened.page.controls._take_slider("plant.mass", 333, 1)
        assert opened.session.value("plant.mass") != 5.3
        assert slider.value == 333
        opened.enter("plant.mass", "5.3")
        assert slider.value == pytest.approx(opened.session.knobs["plant.mass"].place_of(5.3))

    visit(user)


@killed_by("output.explore.controls", "        if not line:\n", "        if False:\n")
def test_the_next_edit_clears_refused_fields(visit):
    async def user(opened):
        refused = {"plant.mass": ("data-field", "-1", "5.3"), "fan-mass": ("data-id", "91", "10")}
        await opened.draw()
        for name, (kind, text, _) in refused.items():
            opened.enter(name, text, kind)
            assert opened.find(name, kind).props["error"]
            assert opened.find(name, kind).value == text
        opened.enter("initial.speed", "25")
        await opened.draw()
        for name, (kind, _, valid) in refused.items():
            assert "error" not in opened.find(name, kind).props
            assert opened.find(name, kind).value == valid

    visit(user)
