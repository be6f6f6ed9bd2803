"""Ctrl-C, SIGTERM and SIGHUP at any moment: no traceback, exit status 130, 143, 129.

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
import stat
import sys
import threading
from typing import Any

INTERRUPTED = 128 + signal.SIGINT  # exit status after Ctrl-C; after another signal 128 and its number, as in a shell
END_SIGNALS = tuple(getattr(signal, name) for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name))  # besides Ctrl-C
MAX_UNHEARD_PRESSES = 3
SHOW_CURSOR = b"\x1b[?25h"
# `python -m diffabs` is called -m until the package is imported, and diffabs/__main__.py from then on.
COMMAND_NAMES = ("diffabs", "-m")
CHILD_FLAG = "--multiprocessing-fork"  # an argument of each process that `multiprocessing` starts anew

_pending = 0
_status = INTERRUPTED


def end_early_on_interrupt() -> None:
    """Let Ctrl-C, SIGTERM and SIGHUP end the process at once until `begin_hearing`.

    Does nothing unless the process is the command `diffabs`. A child process of the command ignores what a terminal
    sends to all processes, Ctrl-C and SIGHUP: the command itself ends its children.
    """
    program = pathlib.Path(sys.argv[0] if sys.argv else "")
    if program.name.removesuffix(".exe") in COMMAND_NAMES or program.parts[-2:] == ("diffabs", "__main__.py"):
        is_child = CHILD_FLAG in sys.orig_argv
        _answer(signal.SIG_IGN if is_child else _leave)
        for number in END_SIGNALS:
            if not is_child:
                _answer_end(number, _leave)
            elif number != signal.SIGTERM:
                _answer_end(number, signal.SIG_IGN)


def begin_hearing() -> None:
    """Count Ctrl-C, SIGTERM and SIGHUP from now on, for `take_interrupt`.

    A signal that the process ignores, or that another program handles, keeps its handler. The function sets handlers
    only in the main thread.
    """
    global _pending
    _pending = 0
    _answer(_press)
    for number in END_SIGNALS:
        _answer_end(number, _end)


def stop_hearing() -> None:
    """Ignore Ctrl-C from now on, while the process ends."""
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGINT, signal.SIG_IGN)


def exit_status() -> int:
    """Return the exit status of an interrupted process: that of SIGTERM or SIGHUP if one has arrived."""
    return _status


def take_interrupt() -> bool:
    """Return whether a signal that interrupts has arrived, and reset: the same signal makes one call return True."""
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


def _answer_end(number: signal.Signals, handler: Any) -> None:
    """Set the handler of a signal of `END_SIGNALS`, unless it is ignored, as under `nohup`, or of another program."""
    if threading.current_thread() is threading.main_thread() and signal.getsignal(number) in (signal.SIG_DFL, _leave):
        signal.signal(number, handler)


def _press(*_: object) -> None:
    global _pending
    _pending += 1
    if _pending >= MAX_UNHEARD_PRESSES:
        _leave()


def _end(number: int, *_: object) -> None:
    _note_end(number)
    _press()


def _note_end(number: int) -> None:
    """Store the exit status of SIGTERM or SIGHUP; after SIGHUP the terminal is gone, and its text goes nowhere."""
    global _status
    if number == signal.SIGINT:
        return
    _status = 128 + number
    if number != signal.SIGTERM:
        nowhere = os.open(os.devnull, os.O_RDWR)
        for stream in (0, 1, 2):
            with contextlib.suppress(OSError):
                if stat.S_ISCHR(os.fstat(stream).st_mode):
                    os.dup2(nowhere, stream)


def _leave(number: int = signal.SIGINT, *_: object) -> None:
    """End the process at once, with a restored cursor and the line `interrupted`."""
    _note_end(number)
    with contextlib.suppress(OSError):
        os.write(2, (SHOW_CURSOR + b"\n" if _pending and os.isatty(2) else b"") + b"interrupted\n")
    os._exit(_status)
