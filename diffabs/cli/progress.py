"""How far a command is: drawn on a terminal, a line now and then elsewhere, the same words in both."""

import contextlib
import math
import time
from collections.abc import Callable, Iterator
from typing import NamedTuple

from rich.console import Console, ConsoleOptions, RenderResult
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.spinner import Spinner

PATIENCE = 2.0  # s without a sign of life
AGAIN = 5.0  # s between lines about how far work is
FRAMES = 12.5  # per second
INDENT = 2  # columns of the spinner


class Far(NamedTuple):
    """How far work is, in words; and where it is known, `done` of `total`."""

    words: str
    done: float = 0.0
    total: float | None = None


Detail = Callable[[], Far | str]


def left(seconds: float) -> str:
    """A time to wait for, in words; nothing where it is not known."""
    if not math.isfinite(seconds):
        return ""
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return (
        f", {hours} h {minutes} min left"
        if hours
        else f", {minutes} min {rest} s left"
        if minutes
        else f", {rest} s left"
    )


def drawable(console: Console) -> bool:
    """Whether lines can be drawn over: not into a file, nor on a terminal without movements (TERM=dumb)."""
    return console.is_terminal and not console.is_dumb_terminal


class _Picture:
    """A spinner with the words, and a bar below where the total is known."""

    def __init__(self, message: str, detail: Detail | None):
        self.message, self.detail, self.spinner = message, detail, Spinner("dots")

    def far(self) -> Far:
        """The words with the message."""
        far = self.detail() if self.detail else ""
        far = Far(far) if isinstance(far, str) else far
        return far._replace(words=f"{self.message} ... {far.words}".strip())

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        """The spinner must be one object, or it would not turn."""
        words, done, total = self.far()
        self.spinner.update(text=words)
        yield self.spinner
        if total:
            yield ProgressBar(total=total, completed=done, width=min(60, options.max_width))


@contextlib.contextmanager
def shown(
    message: str, detail: Detail | None, tell: Callable[[str], None], timing: tuple[float, float]
) -> Iterator[Callable[[], None]]:
    """How far some work is, until the end; the function that is given is to be called often. `tell` writes a line,
    `timing` [s] is when the first one comes where nothing can be drawn, and how often others follow."""
    console, picture = Console(stderr=True), _Picture(message, detail)
    if drawable(console):
        # Only standard error: what is drawn must not get in between results that go elsewhere.
        with Live(picture, console=console, transient=True, refresh_per_second=FRAMES, redirect_stdout=False):
            yield lambda: None
        return
    due, told = time.monotonic() + timing[0], ""

    def line() -> None:
        nonlocal due, told
        if time.monotonic() > due:
            if told != (told := picture.far().words):
                tell(told)
            due = time.monotonic() + timing[1] if detail else math.inf

    yield line
