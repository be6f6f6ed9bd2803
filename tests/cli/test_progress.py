"""How far work is: the same words for every command, with compiling apart from running."""

import re
import threading
import time

import jax
import jax.numpy as jnp
import pytest
from mutants import killed_by
from seams import replace_seam

from diffabs.cli import console, progress
from diffabs.cli.progress import WorkProgress, WorkTiming
from diffabs.host import provenance, stopwatch


@pytest.fixture
def clock(monkeypatch):
    """A time that tests set, and a stopwatch with nothing on it."""
    now = [100.0]
    watch = stopwatch.Stopwatch()
    replace_seam(monkeypatch, "compiling", watch)
    monkeypatch.setattr(progress.time, "monotonic", lambda: now[0])
    return now, watch


@killed_by("host.stopwatch", "while self._spans and", "while False and")
def test_spans_that_overlap_count_once():
    watch = stopwatch.Stopwatch()
    for start, end in ((1.0, 2.0), (4.0, 5.0), (4.5, 6.0), (3.5, 7.0), (9.0, 10.0)):
        watch.add(start, end)
    assert watch.seconds() == pytest.approx(1.0 + 3.5 + 1.0)
    assert watch.seconds(since=5.0) == pytest.approx(2.0 + 1.0)
    assert watch.seconds(since=20.0) == 0.0


@killed_by("host.stopwatch", "if event.startswith(COMPILE_EVENT):", "if False:")
def test_what_jax_compiles_is_counted():
    stopwatch.count_compilations()
    stopwatch.count_compilations()  # once is enough
    begun = time.monotonic()

    def long(x):
        for k in range(30):
            x = jnp.sin(x) @ x + k
        return x

    jax.jit(long)(jnp.ones((4, 4))).block_until_ready()
    took = stopwatch.compile_time_since(begun)
    assert 0.0 < took <= time.monotonic() - begun
    before, begun_again = stopwatch.compile_time_since(begun), time.monotonic()
    with stopwatch.count_as_compiling():
        time.sleep(0.05)
    most = time.monotonic() - begun_again  # more than asked for where the machine is busy
    assert 0.049 <= stopwatch.compile_time_since(begun) - before <= most


@killed_by("cli.progress", "spent = now - start - stopwatch.compile_time_since(start)", "spent = now - start")
def test_what_is_left_does_not_count_compiling(clock):
    """30 s, of which 20 were compiling, for a tenth of the work: the rest takes 90 s, not 270."""
    now, watch = clock
    pace = WorkTiming()
    assert pace.describe(WorkProgress("compiling", 0, 100)) == ""
    now[0] = 130.0
    watch.add(105.0, 125.0)
    assert pace.describe(WorkProgress("ten", 10, 100)) == "; 30 s, 20 s of it compiling, 1 min 30 s left"
    assert pace.describe(WorkProgress("", 10, 100, at_most=True)).endswith(", at most 1 min 30 s left")
    assert pace.describe(WorkProgress("")) == " 30 s, 20 s of it compiling"


@killed_by("cli.progress", "self.first = self.first or (now, far.amount)", "self.first = self.first or (now, 0.0)")
def test_what_was_there_before_is_no_pace(clock):
    """A sweep that goes on: 50 of 100 were there; 10 more took 10 s."""
    now, _ = clock
    pace = WorkTiming()
    pace.describe(WorkProgress("", 50, 100))
    now[0] = 101.5
    assert pace.describe(WorkProgress("fifty", 50, 100)) == "; 2 s"
    now[0] = 110.0
    assert pace.describe(WorkProgress("sixty", 60, 100)) == "; 10 s, 40 s left"


@pytest.mark.parametrize(
    ("seconds", "words"), [(0.4, "0 s"), (59.6, "1 min 0 s"), (3700.0, "1 h 1 min"), (61.0, "1 min 1 s")]
)
def test_a_time_in_words(seconds, words):
    assert progress.format_duration(seconds) == words


@pytest.mark.slow
@killed_by("cli.progress", "if last_words != (last_words := words):", "if True:")
def test_every_wait_says_how_long_it_takes(monkeypatch, capsys):
    """Where nothing can be drawn over, in lines; those that only differ in time are not told again."""
    replace_seam(monkeypatch, "patience", 1.0)
    replace_seam(monkeypatch, "second_interrupt_s", 0.1)
    begun, later = time.monotonic(), threading.Event()
    asked = []

    def detail():
        asked.append(time.monotonic() - begun > 1.8)
        later.set() if sum(asked) == 2 else None  # the first has been told by then
        return "somewhere"

    console.run_with_progress(lambda: later.wait(60.0), "working", detail)
    said = capsys.readouterr().err
    assert re.fullmatch(r"working ... somewhere; \d+ s(, \d+ s of it compiling)?\n", said), said


@killed_by("host.provenance", '"of it compiling": round(compiling, 1)', '"of it compiling": 0.0')
def test_documents_say_how_long_they_took():
    provenance.begin_command(["list", "roads"])
    with stopwatch.count_as_compiling():
        time.sleep(0.2)
    made = provenance.describe_command()
    assert made["command"] == "diffabs list roads"
    assert 0.1 <= made["of it compiling"] <= made["seconds"] <= 300.0


@killed_by("cli.progress", "    if len(words) > room:\n", "    if False:\n")
@pytest.mark.parametrize(
    ("width", "line"),
    [
        (60, "reproducing x ... nine runs on snow; 9 s left"),
        (45, "reproducing x ... nine runs on snow; 9 s left"),
        (44, "nine runs on snow; 9 s left"),
        (27, "nine runs on snow; 9 s left"),
        (26, "nine runs on sn…; 9 s left"),
        (20, "nine runs…; 9 s left"),
        (5, "…; 9 s left"),
    ],
)
def test_a_status_has_one_line(width, line):
    found = progress.fit_line("reproducing x ... nine runs on snow", "nine runs on snow", "; 9 s left", width)
    assert found == line
    assert len(found) <= max(width, len("…; 9 s left"))
