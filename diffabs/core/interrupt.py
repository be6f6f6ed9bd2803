"""Ctrl-C, at any moment: no traceback, exit status 130.

An exception that a signal raises wherever the program happens to be comes out as it pleases: an import reports it, a
destructor prints and forgets it, compiled code does not see it. So a signal only counts here. While the command is
being imported there is nothing to keep, and the process ends at once; later it is asked for where work is waited for
(`console.waited`). Whoever presses for the third time unheard ends the process, whatever it does.

Standard library only, because it comes before all other imports."""

import contextlib
import os
import pathlib
import signal
import sys
import threading
from typing import Any

INTERRUPTED, TERMINATED = 130, 143  # exit status after Ctrl-C, after SIGTERM
MAX_UNHEARD_PRESSES = 3
SHOW_CURSOR = b"\x1b[?25h"
COMMAND_NAMES = ("diffabs", "-m")  # `python -m diffabs` is called -m until the package is imported

_pending = 0
_terminated = False


def end_early_on_interrupt() -> None:
    """If this process is the command `diffabs`, Ctrl-C ends it at once, until `begin()`; a library leaves it alone."""
    if _is_command():
        _answer(_leave)


def begin_hearing() -> None:
    """From now on Ctrl-C and SIGTERM are heard where `pressed()` is asked, if the process does not ignore them."""
    global _pending
    _pending = 0
    _answer(_press)
    if threading.current_thread() is threading.main_thread() and signal.getsignal(signal.SIGTERM) == signal.SIG_DFL:
        signal.signal(signal.SIGTERM, _terminate)


def stop_hearing() -> None:
    """From now on the process ends, and cannot be interrupted in that."""
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGINT, signal.SIG_IGN)


def was_terminated() -> bool:
    """Whether SIGTERM was among the signals."""
    return _terminated


def take_interrupt() -> bool:
    """Whether Ctrl-C was pressed since this was last answered with yes."""
    global _pending
    if not _pending:
        return False
    _pending = 0
    return True


def _is_command() -> bool:
    multiprocessing = sys.modules.get("multiprocessing.process")
    child = multiprocessing is not None and multiprocessing.parent_process() is not None
    return not child and pathlib.Path(sys.argv[0] if sys.argv else "").name.removesuffix(".exe") in COMMAND_NAMES


def _answer(handler: Any) -> None:
    """Nothing is changed where somebody else has said what Ctrl-C does, as a shell does for what runs behind it."""
    if threading.current_thread() is not threading.main_thread():
        return
    if signal.getsignal(signal.SIGINT) in (signal.default_int_handler, _leave, _press):
        signal.signal(signal.SIGINT, handler)


def _press(*_: Any) -> None:
    global _pending
    _pending += 1
    if _pending >= MAX_UNHEARD_PRESSES:
        _leave()


def _terminate(*_: Any) -> None:
    global _terminated
    _terminated = True
    _press()


def _leave(*_: Any) -> None:
    with contextlib.suppress(OSError):
        os.write(2, (SHOW_CURSOR + b"\n" if _pending and os.isatty(2) else b"") + b"interrupted\n")
    os._exit(TERMINATED if _terminated else INTERRUPTED)
