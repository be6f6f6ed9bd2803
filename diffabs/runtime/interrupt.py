"""Ctrl-C at any moment: no traceback, exit status 130.

An exception raised by a signal handler appears at an arbitrary place. An import reports it, a destructor prints and
drops it, and compiled code does not see it. So a signal handler here only counts. While the command is being imported
there is no work to save, and the process ends at once. Later, code that waits for work polls the count
(`console.waited`). The third press without a poll ends the process in any state.

The module imports only the standard library, because it precedes all other imports.
"""

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
# `python -m diffabs` is called -m until the package is imported, and diffabs/__main__.py from then on.
COMMAND_NAMES = ("diffabs", "-m")
CHILD_FLAG = "--multiprocessing-fork"  # an argument of each process that `multiprocessing` starts anew

_pending = 0
_terminated = False


def end_early_on_interrupt() -> None:
    """Let Ctrl-C end the process at once until `begin_hearing`; does nothing unless the process is the command
    `diffabs`.

    A child process of the command ignores Ctrl-C: the command itself ends it.
    """
    program = pathlib.Path(sys.argv[0] if sys.argv else "")
    if program.name.removesuffix(".exe") in COMMAND_NAMES or program.parts[-2:] == ("diffabs", "__main__.py"):
        _answer(signal.SIG_IGN if CHILD_FLAG in sys.orig_argv else _leave)


def begin_hearing() -> None:
    """Count Ctrl-C and SIGTERM from now on, for `take_interrupt`.

    A signal that the process ignores, or that another program handles, keeps its handler. The function sets handlers
    only in the main thread.
    """
    global _pending
    _pending = 0
    _answer(_press)
    if threading.current_thread() is threading.main_thread() and signal.getsignal(signal.SIGTERM) == signal.SIG_DFL:
        signal.signal(signal.SIGTERM, _terminate)


def stop_hearing() -> None:
    """Ignore Ctrl-C from now on, while the process ends."""
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGINT, signal.SIG_IGN)


def was_terminated() -> bool:
    """Return whether SIGTERM has arrived since the start of the process."""
    return _terminated


def take_interrupt() -> bool:
    """Return whether Ctrl-C or SIGTERM has arrived, and reset: the same signal makes only one call return True."""
    global _pending
    if not _pending:
        return False
    _pending = 0
    return True


def _answer(handler: Any) -> None:
    """Set the handler of Ctrl-C unless another program has set one, as a shell does for background processes."""
    if threading.current_thread() is not threading.main_thread():
        return
    if signal.getsignal(signal.SIGINT) in (signal.default_int_handler, _leave, _press):
        signal.signal(signal.SIGINT, handler)


def _press(*_: object) -> None:
    global _pending
    _pending += 1
    if _pending >= MAX_UNHEARD_PRESSES:
        _leave()


def _terminate(*_: object) -> None:
    global _terminated
    _terminated = True
    _press()


def _leave(*_: object) -> None:
    """End the process at once, with a restored cursor and the line `interrupted`."""
    with contextlib.suppress(OSError):
        os.write(2, (SHOW_CURSOR + b"\n" if _pending and os.isatty(2) else b"") + b"interrupted\n")
    os._exit(TERMINATED if _terminated else INTERRUPTED)
