"""How long after a slider moves the curves of that value are on the screen: the explorer, dragged in headless Chromium.

    python benchmarks/bench_explore.py [SCENARIO ...] [--seconds 10]

A pointer moves a slider 25 times a second. The time of each move runs, in the browser and by its clock, from the
slider's event to the frame after which a curve of that value, or of a later one, was painted: server, simulation,
network and drawing included. On a busy machine these times grow with its load; the server's processor time for each
redraw, of all its threads, does not. Needs the extra `explore`, Playwright and Chromium, on Linux."""

import argparse
import os
import pathlib
import re
import shutil
import statistics
import subprocess
import sys
import tempfile

from record import written

FLAGS = ["--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-background-networking"]
FLAGS += ["--disable-component-update", "--disable-sync"]
BETWEEN = 40  # ms between moves
PATIENCE = 300_000  # ms, for compiling


def main() -> None:
    """Measure each scenario, print median and 95th percentile, and write a record."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("scenarios", nargs="*", default=["slip-cured", "slip-lmi", "arm-hanging", "car-jump"])
    parser.add_argument("--seconds", type=float, default=10.0, help="how long each is dragged")
    parser.add_argument("--chromium", default=shutil.which("chromium") or shutil.which("chromium-browser"))
    parser.add_argument("--out", type=pathlib.Path)
    asked = parser.parse_args()
    found = {name: measured(name, asked.seconds, asked.chromium) for name in asked.scenarios}
    for name, one in found.items():
        said = f"median {one['median']:.0f} ms, 95 % within {one['p95']:.0f} ms, {one['redraws']} redraws of"
        print(f"{name}: {said} {one['moves']} moves, {one['server']:.0f} ms of the server's processor time each")
    print(written("explore", {"unit": "ms", "scenarios": found}, asked.out, ("jaxlib", "nicegui", "playwright")))


def measured(scenario: str, seconds: float, chromium: str) -> dict[str, float]:
    """Return the times of a drag [ms]: median, 95th percentile, the server's for each redraw; redraws and moves."""
    command = [sys.executable, "-m", "diffabs", "explore", scenario, "--port", "0", "--no-browser"]
    with tempfile.TemporaryDirectory() as folder:
        server = subprocess.Popen(command, cwd=folder, stderr=subprocess.PIPE, text=True)
        try:
            assert server.stderr
            lines = iter(server.stderr.readline, "")
            address = next((at for line in lines if (at := re.match(r"http://127\.0\.0\.1:\d+/\S*", line))), None)
            assert address, "the explorer ended without an address"
            times, moves, used = dragged(address[0], seconds, chromium, server.pid)
        finally:
            server.terminate()
            server.wait()
    times.sort()
    p95 = times[min(len(times) - 1, int(0.95 * len(times)))]
    counts = {"redraws": len(times), "moves": moves}
    return {"median": statistics.median(times), "p95": p95, "server": 1e3 * used / len(times), **counts}


def dragged(address: str, seconds: float, chromium: str, server: int) -> tuple[list[float], int, float]:
    """Drag the first slider to and fro; the time of each redraw [ms], the moves, the processor time of `server` [s]."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium, args=FLAGS, headless=True)
        page = browser.new_page(viewport={"width": 1280, "height": 800})
        page.set_default_timeout(PATIENCE)
        page.goto(address)
        page.wait_for_selector("[data-id=curves] canvas")
        page.wait_for_selector("[data-id=proving]", state="hidden")
        box = page.locator("[data-slider]").first.bounding_box()
        assert box
        y, left, width = box["y"] + box["height"] / 2, box["x"] + 0.3 * box["width"], 0.4 * box["width"]
        page.mouse.move(left, y)
        page.mouse.down()
        count = int(1e3 * seconds / BETWEEN)
        page.wait_for_timeout(1500)  # what is compiled at the first change
        page.evaluate("explorer.times = []")
        first, before = page.evaluate("explorer.edit"), processor_time(server)
        for i in range(count):
            part = i / 100 % 2
            page.mouse.move(left + width * (part if part < 1 else 2 - part), y)
            page.wait_for_timeout(BETWEEN)
        page.mouse.up()
        page.wait_for_function("explorer.last === explorer.edit")
        times, used = page.evaluate("explorer.times"), processor_time(server) - before
        moves = page.evaluate("explorer.edit") - first
        browser.close()
    return times, moves, used


def processor_time(process: int) -> float:
    """Return the processor time of a process and its threads so far [s]."""
    user, system = pathlib.Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[11:13]
    return (int(user) + int(system)) / os.sysconf("SC_CLK_TCK")


if __name__ == "__main__":
    main()
