"""How far a command is: drawn on a terminal, a line now and then elsewhere, the same words in both.

    MESSAGE ... WHAT IS REACHED; 1 min 34 s, 12 s of it compiling, at most 40 s left

What is left is worked out without the time that went into compiling: that is not needed again."""

import contextlib
import math
import time
from collections.abc import Callable, Iterator
from typing import NamedTuple

from rich.console import Console, ConsoleOptions, RenderResult
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.spinner import Spinner

from diffabs.core import stopwatch

SILENCE_S = 2.0  # s without a sign of life
REPEAT_S = 5.0  # s between lines about how far work is
FRAMES = 12.5  # per second
MIN_SHOWN_S = 1.0  # s in which nothing is said of time
MIN_COMPILING_S = 0.5  # s of compiling, from which it is
SPINNER = 2  # columns, with the blank behind it
COMPILING = "compiling"  # while nothing is reached


class WorkProgress(NamedTuple):
    """How far work is, in words; and where it is known, `done` of `total`, or of as much as it can be (`at_most`)."""

    words: str
    done: float = 0.0
    total: float | None = None
    at_most: bool = False


Detail = Callable[[], WorkProgress | str]


def format_duration(seconds: float) -> str:
    """A length of time, in words."""
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours} h {minutes} min" if hours else f"{minutes} min {rest} s" if minutes else f"{rest} s"


class WorkTiming:
    """How long work has taken, and will: since when, and since when something of it was done."""

    def __init__(self) -> None:
        """It begins now."""
        self.begun = time.monotonic()
        self.first: tuple[float, float] | None = None  # when anything was known, and how much was done then

    def describe(self, far: WorkProgress) -> str:
        """In words, to be put behind those of `far`; nothing at first."""
        now = time.monotonic()
        rest = self.remaining_time(far, now)
        if now - self.begun < MIN_SHOWN_S:
            return ""
        parts = [format_duration(now - self.begun)]
        if (compiling := stopwatch.compile_time_since(self.begun)) >= MIN_COMPILING_S:
            parts[0] += f", {format_duration(compiling)} of it compiling"
        if rest is not None:
            parts.append(f"{'at most ' if far.at_most else ''}{format_duration(rest)} left")
        return f"{'; ' if far.words else ' '}{', '.join(parts)}"

    def remaining_time(self, far: WorkProgress, now: float) -> float | None:
        """How long [s] the rest takes at the pace so far, compiling left out; None where that is not known yet."""
        if far.total is None:
            return None
        self.first = self.first or (now, far.done)
        start, before = self.first
        spent = now - start - stopwatch.compile_time_since(start)
        return None if far.done <= before or spent <= 0 else spent * (far.total - far.done) / (far.done - before)


def can_redraw(console: Console) -> bool:
    """Whether lines can be drawn over: not into a file, nor on a terminal without movements (TERM=dumb)."""
    return console.is_terminal and not console.is_dumb_terminal


class _Picture:
    """A spinner with the words, and a bar below where the total is known."""

    def __init__(self, message: str, detail: Detail | None):
        self.message, self.detail, self.spinner, self.pace = message, detail, Spinner("dots"), WorkTiming()

    def far(self) -> tuple[WorkProgress, str]:
        """How far it is; and that with the message, without times."""
        far = self.detail() if self.detail else ""
        far = WorkProgress(far) if isinstance(far, str) else far
        return far, f"{self.message} ... {far.words}".strip()

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        """The spinner must be one object, or it would not turn."""
        far, words = self.far()
        self.spinner.update(text=fit_line(words, far.words, self.pace.describe(far), options.max_width - SPINNER))
        yield self.spinner
        if far.total and not far.at_most:
            yield ProgressBar(total=far.total, completed=far.done, width=min(60, options.max_width))


def fit_line(words: str, rest: str, times: str, width: int) -> str:
    """Return words and times in one line of a terminal: where they are too long, only the rest of the words, that is
    without the message, and of those as much as there is room for."""
    room = width - len(times)
    if len(words) > room:
        words = rest or words
    return (words if len(words) <= room else f"{words[: max(room - 1, 0)].rstrip()}…") + times


@contextlib.contextmanager
def show_progress(
    message: str, detail: Detail | None, tell: Callable[[str], None], timing: tuple[float, float]
) -> Iterator[Callable[[], None]]:
    """How far some work is, until the end; the function that is given is to be called often. `tell` writes a line,
    `timing` [s] is when the first one comes where nothing can be drawn, and how often others follow."""
    console, picture = Console(stderr=True), _Picture(message, detail)
    if can_redraw(console):
        # Only standard error: what is drawn must not get in between results that go elsewhere.
        with Live(picture, console=console, transient=True, refresh_per_second=FRAMES, redirect_stdout=False):
            yield lambda: None
        return
    due, told = time.monotonic() + timing[0], ""

    def line() -> None:
        nonlocal due, told
        if time.monotonic() > due:
            far, words = picture.far()
            if told != (told := words):
                tell(told + picture.pace.describe(far))
            due = time.monotonic() + timing[1] if detail else math.inf

    yield line
