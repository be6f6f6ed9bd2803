"""Progress of a command: redrawn on a terminal, a line now and then elsewhere, with the same words.

    MESSAGE ... PROGRESS; 1 min 34 s, 12 s of it compiling, at most 40 s left

The estimate of the time left excludes compiling, which does not recur.
"""

import contextlib
import math
import time
from collections.abc import Callable, Iterator
from typing import NamedTuple

from rich.console import Console, ConsoleOptions, RenderResult
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.spinner import Spinner

from diffabs.host import stopwatch

SILENCE_S = 2.0  # s without a sign of life
REPEAT_S = 5.0  # s between lines of progress
FRAMES = 12.5  # per second
MIN_SHOWN_S = 1.0  # s at the start without times
MIN_COMPILING_S = 0.5  # s of compiling; a shorter time is not shown
SPINNER = 2  # columns of the spinner and the blank after it
COMPILING = "compiling"  # words before the first progress


class WorkProgress(NamedTuple):
    """Progress of work.

    Attributes:
        words: Progress in words.
        amount: Finished amount.
        total: Whole amount; None if unknown.
        at_most: True if `total` is only an upper bound.
    """

    words: str
    amount: float = 0.0
    total: float | None = None
    at_most: bool = False


Detail = Callable[[], WorkProgress | str]


def format_duration(seconds: float) -> str:
    """Return a length of time in words."""
    minutes, remainder = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours} h {minutes} min" if hours else f"{minutes} min {remainder} s" if minutes else f"{remainder} s"


class WorkTiming:
    """Clock of some work, which measures the time since its start and estimates the time left."""

    def __init__(self) -> None:
        """Start the clock."""
        self.begun: float = time.monotonic()
        self.first: tuple[float, float] | None = None  # time and amount of the first known progress

    def describe(self, far: WorkProgress) -> str:
        """Return time so far and time left in words, to follow the words of `far`, the progress; empty in the first
        second.
        """
        now = time.monotonic()
        remaining = self.remaining_time(far, now)
        if now - self.begun < MIN_SHOWN_S:
            return ""
        parts = [format_duration(now - self.begun)]
        if (compiling := stopwatch.compile_time_since(self.begun)) >= MIN_COMPILING_S:
            parts[0] += f", {format_duration(compiling)} of it compiling"
        if remaining is not None:
            parts.append(f"{'at most ' if far.at_most else ''}{format_duration(remaining)} left")
        return f"{'; ' if far.words else ' '}{', '.join(parts)}"

    def remaining_time(self, far: WorkProgress, now: float) -> float | None:
        """Return the time left [s] at the instant `now` of `time.monotonic`; None if it is unknown.

        `far` is the progress. The pace counts from the first call whose progress has a total, without compile time.
        """
        if far.total is None:
            return None
        self.first = self.first or (now, far.amount)
        start, before = self.first
        spent = now - start - stopwatch.compile_time_since(start)
        return None if far.amount <= before or spent <= 0 else spent * (far.total - far.amount) / (far.amount - before)


def can_redraw(console: Console) -> bool:
    """Return True if lines can be redrawn: on a terminal that can move its cursor (not TERM=dumb)."""
    return console.is_terminal and not console.is_dumb_terminal


class _Picture:
    """A spinner with words, and a bar below it if the total is known."""

    def __init__(self, message: str, detail: Detail | None):
        self.message, self.detail, self.spinner, self.pace = message, detail, Spinner("dots"), WorkTiming()

    def far(self) -> tuple[WorkProgress, str]:
        """Return the progress, and one line with message and progress but without times."""
        far = self.detail() if self.detail else ""
        far = WorkProgress(far) if isinstance(far, str) else far
        return far, f"{self.message} ... {far.words}".strip()

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        """Yield spinner and bar. The spinner stays one object: a new one would always draw its first frame."""
        far, words = self.far()
        self.spinner.update(text=fit_line(words, far.words, self.pace.describe(far), options.max_width - SPINNER))
        yield self.spinner
        if far.total and not far.at_most:
            yield ProgressBar(total=far.total, completed=far.amount, width=min(60, options.max_width))


def fit_line(words: str, short_words: str, times: str, width: int) -> str:
    """Return progress and times on one line of a terminal.

    If the line is too long, it loses the message first. The progress is then cut at its end, the times never.
    """
    room = width - len(times)
    if len(words) > room:
        words = short_words or words
    return (words if len(words) <= room else f"{words[: max(room - 1, 0)].rstrip()}…") + times


@contextlib.contextmanager
def show_progress(
    message: str, detail: Detail | None, tell: Callable[[str], None], timing: tuple[float, float]
) -> Iterator[Callable[[], None]]:
    """Show the progress of work within a `with` block, as a spinner or as lines.

    It yields a function that the block must call often: without a spinner, each call may write a line that is due.

    Args:
        detail: Function that returns the progress. Without it, at most one line is written.
        tell: Function that writes a line, if stderr cannot be redrawn.
        timing: Time [s] of the first line, and time [s] between further lines.
    """
    console, picture = Console(stderr=True), _Picture(message, detail)
    if can_redraw(console):
        # stdout is not redirected: Live would print results on stderr.
        with Live(picture, console=console, transient=True, refresh_per_second=FRAMES, redirect_stdout=False):
            yield lambda: None
        return
    due, last_words = time.monotonic() + timing[0], ""

    def line() -> None:
        nonlocal due, last_words
        if time.monotonic() > due:
            far, words = picture.far()
            if last_words != (last_words := words):
                tell(last_words + picture.pace.describe(far))
            due = time.monotonic() + timing[1] if detail else math.inf

    yield line
