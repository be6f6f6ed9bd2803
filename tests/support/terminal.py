"""Running the command line under a pseudo-terminal, as a person sees it."""

import fcntl
import os
import pty
import re
import signal
import struct
import subprocess
import sys
import termios
import threading
import time

from sweeping import environment

COLUMNS, ROWS = 80, 24
PATIENCE = 300.0  # s for anything that takes seconds on an idle machine
CONTROL_C = b"\x03"
ESCAPES = re.compile(r"\x1b\[[0-?]*[ -/]*[@-~]")
MOVEMENTS = re.compile(r"\x1b\[[0-9;]*[A-HJKf]")  # of the cursor, and erased lines
FRAMES = re.compile("[─━│┃┌┐└┘├┤┬┴┼┏┓┗┛┡┩┢┪┣┫┳┻╇╈╋┠┨╶╺╸]")
PATH = re.compile(r" *\S*/\S*( \\)?")  # alone on its line
SPINNER = re.compile("[⠋⠙⠹⠸⠼⠴⠦⠧⠇⠏]")
# The terminal becomes the controlling one, whose Ctrl-C is a signal, before the command takes the process over; and the
# signal is not ignored, as it would be where the tests run behind a shell.
CONTROLLED = """
import fcntl, os, signal, sys, termios
fcntl.ioctl(0, termios.TIOCSCTTY, 0)
signal.signal(signal.SIGINT, signal.SIG_DFL)
os.execv(sys.executable, sys.argv[1:])
"""


class Terminal:
    """`diffabs ...` in a terminal of 80 columns, in a session of its own."""

    def __init__(self, *words: object, term: str = "xterm-256color", **options):
        self.master, slave = pty.openpty()
        fcntl.ioctl(slave, termios.TIOCSWINSZ, struct.pack("HHHH", ROWS, COLUMNS, 0, 0))
        command = [sys.executable, "-c", CONTROLLED, sys.executable, "-m", "diffabs", *map(str, words)]
        env = {k: v for k, v in environment().items() if k not in ("COLUMNS", "LINES", "NO_COLOR", "FORCE_COLOR")}
        self.process = subprocess.Popen(
            command,
            stdin=slave,
            stdout=slave,
            stderr=slave,
            start_new_session=True,
            env=env | {"TERM": term},
            **options,
        )
        os.close(slave)
        self._seen = bytearray()
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def __enter__(self):
        return self

    def __exit__(self, *_):
        if self.process.poll() is None:
            os.killpg(self.process.pid, signal.SIGKILL)
        self.process.wait()
        self._reader.join(PATIENCE)
        os.close(self.master)

    def _read(self):
        try:
            while some := os.read(self.master, 65536):
                self._seen += some
        except OSError:  # the last process that had the terminal has gone
            pass

    @property
    def raw(self) -> str:
        return self._seen.decode(errors="replace")

    @property
    def text(self) -> str:
        """What was written, without colours and movements of the cursor."""
        return ESCAPES.sub("", self.raw).replace("\r\n", "\n")

    def press(self) -> None:
        """Ctrl-C."""
        os.write(self.master, CONTROL_C)

    def until(self, condition) -> bool:
        """Wait while the command runs. Whether the condition, or a text on the screen, came true."""
        met = condition if callable(condition) else lambda: condition in self.text
        end = time.monotonic() + PATIENCE
        while self.process.poll() is None:
            if met():
                return True
            assert time.monotonic() < end, self.text
            time.sleep(5e-3)
        self._reader.join(PATIENCE)
        return bool(met())

    def status(self) -> int:
        """The exit status, when it has come and all is read."""
        self.process.wait(PATIENCE)
        self._reader.join(PATIENCE)
        return self.process.returncode

    def loads(self, library: str) -> bool:
        """Wait until the process has a shared library with this in its name: it is in the midst of its imports."""
        maps = f"/proc/{self.process.pid}/maps"
        return self.until(lambda: library in _text(maps))


def _text(path: str) -> str:
    try:
        with open(path, encoding="utf-8") as file:
            return file.read()
    except OSError:
        return ""


def words(text: str) -> set[str]:
    """What is between blanks and the frames of tables."""
    return set(FRAMES.sub(" ", text).split())


def assert_fits(terminal: Terminal) -> None:
    """No line is longer than the terminal is wide, which would break it in the middle of a word; but one that holds
    nothing but a path, and a backslash where a command goes on: nobody can fold that, and tests have long ones."""
    for line in re.split(r"[\r\n]", ESCAPES.sub("", MOVEMENTS.sub("\n", terminal.raw))):
        assert len(line.removesuffix("^C")) <= COLUMNS or PATH.fullmatch(line), line  # ^C is the terminal's


def assert_orderly(terminal: Terminal) -> None:
    assert "Traceback" not in terminal.text, terminal.text
    assert "Exception ignored" not in terminal.text, terminal.text
    hidden, shown = (terminal.raw.rfind(f"\x1b[?25{which}") for which in "lh")
    assert shown >= hidden, "the cursor stays hidden"
