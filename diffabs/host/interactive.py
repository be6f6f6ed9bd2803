"""The progress of a long computation in a notebook or an interactive session: one line that changes in place."""

import sys
import time
from collections.abc import Callable
from typing import Any, ParamSpec, Self

P = ParamSpec("P")
PERIOD_S = 0.3  # shortest time between two changes of the line


class ProgressLine:
    """One line, in a notebook below the cell, else on stderr. Nobody watches a script: there it writes nothing."""

    def __init__(self) -> None:
        """Find out where the line is shown."""
        shell = getattr(sys.modules.get("IPython"), "get_ipython", lambda: None)()
        self.display: Any = None
        if shell is not None and hasattr(shell, "kernel"):
            from IPython.display import display  # pyright: ignore[reportMissingImports]  # a notebook has it

            self.display = display
        self.shown: bool = self.display is not None or hasattr(sys, "ps1")
        self.handle: Any = None
        self.text, self.at = "", -PERIOD_S

    def write(self, text: str) -> None:
        """Show this text, unless the last change was just now."""
        self.text: str = text
        if self.shown and time.monotonic() - self.at >= PERIOD_S:
            self._show()

    def __enter__(self) -> Self:
        """Begin without a text."""
        return self

    def __exit__(self, *error: object) -> None:
        """Show the last text."""
        if self.shown and self.text:
            self._show()
            if self.display is None:
                sys.stderr.write("\n")

    def _show(self) -> None:
        self.at: float = time.monotonic()
        if self.display is None:
            sys.stderr.write(f"\r\x1b[K{self.text}")
            sys.stderr.flush()
        elif self.handle is None:
            self.handle = self.display(Line(self.text), display_id=True)
        else:
            self.handle.update(Line(self.text))


class Line:
    """A text that a notebook shows without quotes."""

    def __init__(self, text: str) -> None:
        """Keep the `text`."""
        self.text = text

    def __repr__(self) -> str:
        """Return the text."""
        return self.text


def report_to(
    line: ProgressLine, progress: Callable[P, None] | None, words: Callable[P, str]
) -> Callable[P, None] | None:
    """Return the user's `progress`, else a function that shows its arguments on a line, else None.

    Args:
        words: Function that returns the text for the same arguments.
    """

    def write(*args: P.args, **kwargs: P.kwargs) -> None:
        line.write(words(*args, **kwargs))

    return progress or (write if line.shown else None)
