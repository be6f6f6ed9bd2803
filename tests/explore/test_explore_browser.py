"""The explorer in headless Chromium: drag, see the curve change, tune, save, run; and its server from outside.

Needs the extra `explore`; the tests with a browser also Playwright and Chromium ($CHROMIUM, or the
system's)."""

import contextlib
import importlib.util
import json
import os
import pathlib
import re
import shutil
import signal
import socket
import subprocess
import sys
import time

import pytest
from test_explore import SHORT

from diffabs.scenario import load, names

CHROMIUM = os.environ.get("CHROMIUM") or shutil.which("chromium") or shutil.which("chromium-browser")
FLAGS = ["--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-background-networking"]
FLAGS += ["--disable-component-update", "--disable-sync"]
PATIENCE = 120_000  # ms: programs are compiled on the way, on a machine that has other work

there = {name: importlib.util.find_spec(name) is not None for name in ("nicegui", "playwright")}
needs_extra = pytest.mark.skipif(not there["nicegui"], reason="needs the extra `explore`")
needs_browser = pytest.mark.skipif(
    not (there["nicegui"] and there["playwright"] and CHROMIUM),
    reason="needs the extra `explore`, Playwright and Chromium",
)
pytestmark = pytest.mark.slow


class Explorer:
    """The command, in a folder of its own."""

    def __init__(self, folder: pathlib.Path, scenario: str = "mine.toml"):
        """Start it, and wait until it says where it is."""
        self.folder = folder
        (folder / "mine.toml").write_text(SHORT)
        words = [sys.executable, "-m", "diffabs", "explore", scenario, "--port", "0", "--no-browser"]
        self.process = subprocess.Popen(words, cwd=folder, stderr=subprocess.PIPE, text=True, start_new_session=True)
        assert self.process.stderr
        lines = iter(self.process.stderr.readline, "")  # a busy machine says first what it waits for
        found = next(
            (at for line in lines if (at := re.match(r"(http://127\.0\.0\.1:(\d+)/\?token=(\S+)) ", line))), None
        )
        assert found, "it ended without an address"
        self.url, self.port = found[1], int(found[2])
        self.cookie = f"Cookie: diffabs-explore-{self.port}={found[3]}"

    def interrupted(self) -> tuple[int, str]:
        """Press Ctrl-C; exit status, and what it said."""
        self.process.send_signal(signal.SIGINT)
        _, rest = self.process.communicate(timeout=60)
        return self.process.returncode, rest

    def end(self) -> None:
        """Whatever it does."""
        if self.process.poll() is None:
            self.process.kill()
        self.process.communicate()


@pytest.fixture(scope="module")
def explorer(tmp_path_factory):
    one = Explorer(tmp_path_factory.mktemp("explored"))
    yield one
    one.end()


@pytest.fixture(scope="module")
def browser():
    from playwright.sync_api import sync_playwright  # pyright: ignore[reportMissingImports]

    with sync_playwright() as playwright:
        one = playwright.chromium.launch(executable_path=CHROMIUM, args=FLAGS, headless=True)
        yield one
        one.close()


@pytest.fixture
def tabs(explorer, browser):
    """Open a tab of the explorer; none may fetch anything from elsewhere, nor report an error."""
    opened, elsewhere, errors = [], [], []

    def tab():
        context = browser.new_context(viewport={"width": 1280, "height": 800})
        opened.append(context)
        page = context.new_page()
        page.set_default_timeout(PATIENCE)
        page.on("request", lambda one: elsewhere.append(one.url) if _outside(one.url, explorer.port) else None)
        page.on("pageerror", lambda error: errors.append(str(error)))
        page.goto(explorer.url)
        page.wait_for_selector("[data-id=curves] canvas")
        page.wait_for_function("!!document.querySelector('[data-metric=iae]').textContent")
        return page

    yield tab
    for context in opened:
        context.close()
    assert elsewhere == []
    assert errors == []


def _outside(url: str, port: int) -> bool:
    return not url.startswith((f"http://127.0.0.1:{port}/", f"ws://127.0.0.1:{port}/", "data:", "blob:"))


CURVE = """() => { const box = document.querySelector('[data-id=curves] .nicegui-echart');
  const source = getElement(+box.id.slice(1)).chart.getOption().dataset[0].source; return source['0.0']; }"""
BEFORE = CURVE.replace("dataset[0]", "dataset[1]")
SPEED = CURVE.replace("'0.0'", "'1.0'")
FAN = CURVE.replace("dataset[0]", "dataset[2]").replace("'0.0'", "'0.0.0'")


def drag(page, key: str, places: int, steps: int = 8) -> None:
    """Drag a slider by so many pixels."""
    box = page.locator(f'[data-slider="{key}"]').bounding_box()
    thumb = page.locator(f'[data-slider="{key}"] .q-slider__thumb').bounding_box()
    x, y = thumb["x"] + thumb["width"] / 2, box["y"] + box["height"] / 2
    page.mouse.move(x, y)
    page.mouse.down()
    for i in range(1, steps + 1):
        page.mouse.move(x + places * i / steps, y)
        page.wait_for_timeout(30)
    page.mouse.up()


def rested(page) -> None:
    """Wait until all is up to date."""
    page.wait_for_function("explorer.last === explorer.edit")
    page.wait_for_selector("[data-id=proving]", state="hidden")


@needs_browser
def test_dragging_a_slider_moves_the_curve_and_its_number(tabs):
    page = tabs()
    rested(page)
    field = page.locator('[data-field="plant.mass"]')
    curve, mass, measured = page.evaluate(CURVE), field.input_value(), page.inner_text("[data-metric=iae]")
    pixels = page.locator("[data-id=curves] canvas").screenshot()
    drag(page, "plant.mass", 40)
    rested(page)
    assert float(field.input_value()) > float(mass)
    assert page.evaluate(CURVE) != curve
    assert page.locator("[data-id=curves] canvas").screenshot() != pixels
    assert page.inner_text("[data-metric=iae]") != measured
    assert len(page.evaluate(FAN)) > 10
    assert page.evaluate("explorer.times.length") >= 1
    assert page.inner_text("[data-id=word]") in ("certified", "no common Lyapunov matrix", "undecided")
    assert re.search(r"\d°", page.inner_text("[data-margin=phase]"))


@needs_browser
def test_the_curves_over_frequency_follow_a_drag_in_each_chart(tabs):
    page = tabs()
    rested(page)
    source = """() => { const box = document.querySelector('[data-id=frequency]');
      return getElement(+box.id.slice(1)).chart.getOption().dataset[0].source; }"""
    for view, curve in (("Nyquist", "re"), ("Bode", "phase"), ("|S|", "s")):
        page.click(f"[data-id=views] >> text='{view}'")
        page.wait_for_function(f"curve => ({source})()[curve]?.length > 100", arg=curve)
        before = page.evaluate(source)[curve]
        drag(page, "controller.gain.1", 20)
        rested(page)
        page.wait_for_function(
            f"([curve, before]) => JSON.stringify(({source})()[curve]) !== before", arg=[curve, json.dumps(before)]
        )
        assert len(page.evaluate(source)[curve]) == len(before)


@needs_browser
@pytest.mark.parametrize("name", names())
def test_every_packaged_scenario_can_be_dragged_at_once(name, tmp_path, browser):
    """Also while everything is still being compiled; in the end nothing computes any more, and nothing failed."""
    one = Explorer(tmp_path, name)
    context = browser.new_context(viewport={"width": 1280, "height": 800})
    try:
        page = context.new_page()
        page.set_default_timeout(2 * PATIENCE)
        page.goto(one.url)
        page.wait_for_selector("[data-slider]")
        first = page.locator("[data-slider]").first.get_attribute("data-slider")
        for places in (30, -20, 12, -15):
            drag(page, first, places, 15)
            page.wait_for_timeout(300)
        page.wait_for_function("explorer.last === explorer.edit")
        page.wait_for_function("[...document.querySelectorAll('.busy')].every(e => !e.checkVisibility())")
        assert not page.locator("[data-id=refused]").is_visible(), page.inner_text("[data-id=refused]")
        assert "Error" not in page.inner_text(".right")
        assert "index" not in page.inner_text(".right")
        assert one.interrupted()[0] == 130
    finally:
        context.close()
        one.end()


@needs_browser
def test_nonsense_in_a_field_is_refused_with_the_field_named(tabs):
    page = tabs()
    field = page.locator('[data-field="plant.mass"]')
    curve = page.evaluate(CURVE)
    for text, said in (
        ("heavy", 'plant.mass = "heavy" is text; a number in (0, inf) kg is needed'),
        ("-1", "plant.mass = -1 is outside (0, inf) kg"),
        ("1e400", "plant.mass = inf is outside (0, inf) kg"),
    ):
        field.fill(text)
        field.press("Enter")
        page.wait_for_function("text => document.querySelector('[data-id=refused]').textContent === text", arg=said)
        assert page.is_visible("[data-id=refused]")
    assert page.evaluate(CURVE) == curve
    field.fill("6")
    field.press("Enter")
    page.wait_for_selector("[data-id=refused]", state="hidden")
    page.wait_for_function(f"curve => JSON.stringify(({CURVE})()) !== JSON.stringify(curve)", arg=curve)
    spread = page.locator("[data-id=fan-mass]")
    spread.fill("200")
    spread.press("Enter")
    page.wait_for_selector("text=fan.mass = 200 is outside [0, 90] %")


@needs_browser
def test_two_tabs_do_not_disturb_each_other(tabs):
    one, other = tabs(), tabs()
    rested(other)
    was = other.evaluate(CURVE)
    field = one.locator('[data-field="initial.speed"]')
    field.fill("20")
    field.press("Enter")
    one.wait_for_function(f"curve => JSON.stringify(({CURVE})()) !== JSON.stringify(curve)", arg=was)
    rested(one)
    assert other.evaluate(CURVE) == was
    assert other.locator('[data-field="initial.speed"]').input_value() == "30"
    other.locator('[data-field="plant.mass"]').fill("6")
    other.locator('[data-field="plant.mass"]').press("Enter")
    other.wait_for_function(f"curve => JSON.stringify(({CURVE})()) !== JSON.stringify(curve)", arg=was)
    assert one.locator('[data-field="plant.mass"]').input_value() != "6"
    assert other.evaluate(SPEED)[0] == pytest.approx(30)  # drawn from its own numbers
    assert one.evaluate(SPEED)[0] == pytest.approx(20)


@needs_browser
def test_tuned_saved_and_run_by_the_command_line(tabs, explorer):
    page = tabs()
    drag(page, "controller.gain.1", -30)
    rested(page)
    start = page.locator('[data-field="controller.gain.1"]').input_value()
    page.click("[data-id=tune]")
    page.click("[data-id=start]")
    page.wait_for_selector("[data-id=tuned]")
    cells = page.locator("[data-id=before-after] > *").all_inner_texts()
    rows = {cells[i]: cells[i + 1 : i + 3] for i in range(0, len(cells), 3)}
    assert rows["gain 2"][0] == start
    assert float(rows["iae"][1]) < float(rows["iae"][0])
    assert len(page.evaluate(BEFORE)) > 10
    rested(page)
    assert page.locator('[data-field="controller.gain.1"]').input_value() == rows["gain 2"][1]
    assert page.inner_text("[data-metric=iae]") == rows["iae"][1]

    page.click("[data-id=save]")
    assert page.locator("[data-id=file]").input_value() == "mine-explored.toml"
    page.locator("[data-id=file]").fill("mine.toml")
    page.click("[data-id=write]")
    page.wait_for_selector('text=file = "mine.toml" exists')
    assert (explorer.folder / "mine.toml").read_text() == SHORT
    page.locator("[data-id=file]").fill("tuned.toml")
    page.click("[data-id=write]")
    page.wait_for_selector("text=diffabs simulate tuned.toml")
    assert {one.name for one in explorer.folder.iterdir()} == {"mine.toml", "tuned.toml"}
    words = [sys.executable, "-m", "diffabs", "simulate", "tuned.toml", "--json"]
    done = subprocess.run(words, cwd=explorer.folder, capture_output=True, text=True, check=True)
    metrics = json.loads(done.stdout)["metrics"]
    for name in ("iae", "stop_time", "stop_distance", "overshoot"):
        assert page.inner_text(f"[data-metric={name}]") == f"{metrics[name]:.5g}"
    assert load(explorer.folder / "tuned.toml").tune.free == load(explorer.folder / "mine.toml").tune.free
    page.click("[data-id=go-back]")
    page.wait_for_function(
        "start => document.querySelector('[data-field=\"controller.gain.1\"]').value === start", arg=start
    )


@needs_browser
def test_the_time_axis_fits_the_transient_then_the_run(tabs):
    page = tabs()
    rested(page)
    shown = """() => { const box = document.querySelector('[data-id=curves] .nicegui-echart');
      return getElement(+box.id.slice(1)).chart.getModel().getComponent('xAxis', 0).axis.scale.getExtent()[1]; }"""
    whole = page.evaluate(shown)
    page.click("[data-id=fit]")
    page.wait_for_function(f"whole => ({shown})() < 0.95 * whole", arg=whole)
    page.click("[data-id=whole]")
    page.wait_for_function(f"whole => ({shown})() === whole", arg=whole)
    assert page.inner_text("[data-id=poles-of]") == "of the linear model: torque limits are not in this"
    assert page.inner_text("[data-id=proved-of]") == page.inner_text("[data-id=poles-of]")


@needs_browser
def test_a_change_of_a_deleted_chart_is_given_up(tabs):
    tries = """() => new Promise(done => { const get = window.getElement; let n = 0;
      window.getElement = id => { n += id === -1; return get(id); };
      explorer.change(-1, {}, 0, 3);
      setTimeout(() => { window.getElement = get; done(n); }, 500); })"""
    assert tabs().evaluate(tries) == 4


@needs_browser
def test_another_scenario_and_another_road(tabs):
    page = tabs()
    page.click("[data-id=scenario]")
    page.click(".q-menu >> text=arm-hanging")
    page.wait_for_selector('[data-slider="plant.rider_mass"]')
    page.wait_for_function("document.querySelector('[data-metric=peak_lean]')?.textContent")
    rested(page)
    assert page.inner_text("[data-id=word]") == "no common Lyapunov matrix"
    assert not page.is_visible("[data-id=road]")


def asked(port: int, *lines: str) -> bytes:
    """What the server answers to a request in these lines."""
    with socket.create_connection(("127.0.0.1", port), timeout=30) as one:
        one.sendall("\r\n".join([*lines, "Connection: close", "", ""]).encode())
        found = b""
        with contextlib.suppress(ConnectionError):
            while part := one.recv(65536):
                found += part
    return found


@needs_extra
def test_another_page_is_not_answered(explorer):
    own = f"127.0.0.1:{explorer.port}"
    assert asked(explorer.port, "GET / HTTP/1.1", f"Host: {own}", explorer.cookie).startswith(b"HTTP/1.1 200 ")
    assert asked(explorer.port, "GET / HTTP/1.1", "Host: evil.example", explorer.cookie).startswith(b"HTTP/1.1 403 ")
    foreign = ["GET /_nicegui_ws/socket.io/?EIO=4&transport=polling HTTP/1.1", f"Host: {own}", explorer.cookie]
    assert asked(explorer.port, *foreign, "Origin: http://evil.example").startswith(b"HTTP/1.1 403 ")
    upgrade = ["Upgrade: websocket", "Sec-WebSocket-Version: 13", "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ=="]
    path = "GET /_nicegui_ws/socket.io/?EIO=4&transport=websocket HTTP/1.1"
    answer = asked(explorer.port, path, f"Host: {own}", "Origin: http://evil.example", explorer.cookie, *upgrade)
    assert answer.startswith(b"HTTP/1.1 403 ")


@needs_extra
def test_who_does_not_know_the_token_is_not_answered(explorer):
    from diffabs.output.explore.guard import STRANGER

    own = f"Host: 127.0.0.1:{explorer.port}"
    for path in ("/", "/?token=guessed", "/_nicegui/"):
        answer = asked(explorer.port, f"GET {path} HTTP/1.1", own)
        assert answer.startswith(b"HTTP/1.1 403 ")
        assert answer.partition(b"\r\n\r\n")[2].decode() == f"{STRANGER}\n"
    upgrade = ["Upgrade: websocket", "Sec-WebSocket-Version: 13", "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ=="]
    path = "GET /_nicegui_ws/socket.io/?EIO=4&transport=websocket HTTP/1.1"
    assert asked(explorer.port, path, own, *upgrade).startswith(b"HTTP/1.1 403 ")


@needs_extra
def test_it_listens_on_loopback_only(explorer):
    hexadecimal = f":{explorer.port:04X}"
    rows = [
        row.split() for name in ("tcp", "tcp6") for row in pathlib.Path(f"/proc/net/{name}").read_text().splitlines()
    ]
    there = [row[1] for row in rows if row[1].endswith(hexadecimal) and row[3] == "0A"]
    assert there == [f"0100007F{hexadecimal}"]


@needs_extra
def test_ctrl_c_ends_it_without_a_word_too_many(tmp_path):
    one = Explorer(tmp_path)
    try:
        asked(one.port, "GET / HTTP/1.1", f"Host: 127.0.0.1:{one.port}")
        began = time.monotonic()
        status, rest = one.interrupted()
        assert (status, rest) == (130, "interrupted\n")
        assert time.monotonic() - began < 20
        assert {path.name for path in tmp_path.iterdir()} == {"mine.toml"}
    finally:
        one.end()


@needs_browser
def test_ctrl_c_ends_it_during_a_tuning(tmp_path, browser):
    one, context = Explorer(tmp_path), browser.new_context()
    try:
        page = context.new_page()
        page.set_default_timeout(PATIENCE)
        page.goto(one.url)
        page.wait_for_selector("[data-id=curves] canvas")
        page.click("[data-id=tune]")
        page.click("[data-id=start]")
        page.wait_for_selector("[data-id=far]")
        began = time.monotonic()
        assert one.interrupted() == (130, "interrupted\n")
        assert time.monotonic() - began < 20
    finally:
        context.close()
        one.end()


@needs_extra
def test_a_port_that_is_taken_is_said(tmp_path, explorer):
    words = [sys.executable, "-m", "diffabs", "explore", "slip-cured", "-q", "--no-browser"]
    words += ["--port", str(explorer.port)]
    done = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True, timeout=120)
    assert (done.returncode, done.stderr) == (2, f"error: --port {explorer.port}: another program uses this port\n")
