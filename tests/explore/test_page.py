"""The page of the explorer without a browser: events of its elements, and threads whose jobs a test runs itself."""

import ast
import asyncio
import contextlib
import pathlib
import threading

import pytest
from mutants import killed_by
from seams import replace_seam
from test_explore import SHORT

from diffabs.explore import curves
from diffabs.explore.session import CERTIFIED, ProofVerdict, Session, Tools

nicegui = pytest.importorskip("nicegui")
from nicegui.page import page as route  # noqa: E402  # pyright: ignore[reportMissingImports]
from nicegui.testing import UserInteraction  # noqa: E402  # pyright: ignore[reportMissingImports]

import diffabs.explore.page  # noqa: E402

pytestmark = pytest.mark.usefixtures("any_step_is_stable")
EXPLORE = pathlib.Path(diffabs.explore.page.__file__).parent
NAME = 'my metric :title="alert(1)"'
LIMIT_S = 60.0


class Jobs:
    """In place of a thread: keeps the newest job until the test runs it."""

    job = None

    def ask(self, job):
        self.job = job

    def end(self):
        self.job = None

    def run(self):
        job, self.job = self.job, None
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
            self.page = diffabs.explore.page.Page(Session(str(folder / "mine.toml")), tools, folder, "page's test")
            self.page.end()
            self.page.drawer, self.page.thinker, self.page.tuner.worker = Jobs(), Jobs(), Jobs()
            self.page.build()
        self.session = self.page.session

    def find(self, name, kind="data-id"):
        (one,) = (one for one in self.client.elements.values() if one.props.get(kind) == name)
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


@killed_by("explore/results.py", '.props["data-metric"] = name', '.props(f"data-metric={name}")')
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


@killed_by("explore/page.py", "self.thinker.ask(partial(self._think, now, version))", "pass")
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
    "explore/page.py",
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


@killed_by("explore/page.py", "version < max(self.since, self.drawn)", "version < self.since")
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


@killed_by("explore/page.py", "            self.since = self.version\n", "            pass\n")
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
    "explore/page.py",
    "        if version < self.since:\n            return\n        if self.chart is not None:\n",
    "        if self.chart is not None:\n",
)
def test_a_late_fan_does_not_return_after_a_reset(visit, monkeypatch):
    async def user(opened):
        page, late = opened.page, []
        monkeypatch.setattr(curves, "run_fan", lambda *given: None)
        monkeypatch.setattr(page, "_poles", lambda *given, **more: True)
        await opened.draw()
        with monkeypatch.context() as patch:
            patch.setattr(page, "later", lambda show, *given: (late.append((show, given)), opened.click("reset")))
            page.thinker.run()
        ((show, given),) = late
        with opened.client:
            show(*given)
        assert page.controls.made.text == ""

    visit(user)


async def settled(opened, condition):
    """Wait for loads in other threads."""
    with contextlib.suppress(TimeoutError):
        async with asyncio.timeout(LIMIT_S):
            while not condition():
                await asyncio.sleep(0.01)
    assert condition()


@killed_by("explore/page.py", "        async with self.switching:\n", "        if True:\n")
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
