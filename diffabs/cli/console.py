"""Shared code of all commands: errors in one line, progress during work, Ctrl-C, and exit statuses."""

import contextlib
import importlib.util
import io
import multiprocessing
import os
import shlex
import sys
import textwrap
import threading
import warnings
from collections.abc import Callable, Iterator, Sequence
from typing import Annotated, NoReturn, TypeVar

import typer
from rich.console import Console

from diffabs.cli import progress
from diffabs.core import channels
from diffabs.engine.drive.engine import EngineError
from diffabs.host import files, interrupt
from diffabs.host.values import ScenarioError
from diffabs.scenario import outside
from diffabs.scenario.scenario import Scenario, field_paths, load, names

T = TypeVar("T")

FAILED, BAD_INPUT, INTERRUPTED = 1, 2, interrupt.INTERRUPTED
SILENCE_S, SECOND_INTERRUPT_S = progress.SILENCE_S, progress.REPEAT_S
AWAKE = 0.1  # s between two checks for Ctrl-C
LOUD = ("error:", "warning:", "verdict:", "interrupted")  # lines that --quiet does not silence
CONTINUED = " \\"  # end of a shell's line that continues on the next
WORKER = "diffabs worker"
EXTRAS: dict[str, tuple[str, ...]] = {
    "sweep": ("filelock", "pyarrow", "scipy", "zarr"),
    "cluster": ("distributed",),
    "tune": ("optax", "scipy"),
    "proof": ("flint",),
    "report": ("jinja2",),
    "explore": ("nicegui",),
}


# Arguments and options that commands share.
def scenarios_like(incomplete: str) -> list[str]:
    """Return completions of a scenario's name; without one the shell completes files."""
    return [name for name in names() if name.startswith(incomplete)]


def fields_like(context: typer.Context, incomplete: str) -> list[str]:
    """Return completions of --set: the fields of the scenario on the line, as `show` writes them."""
    words = [context.params.get("scenario"), *context.args]  # an unfinished option leaves words unparsed here
    try:
        return [f"{path}=" for path in field_paths(load(next(filter(None, words)))) if path.startswith(incomplete)]
    except (StopIteration, OSError, ValueError):
        return []


ScenarioName = Annotated[
    str, typer.Argument(help="TOML file, or name of a packaged scenario.", autocompletion=scenarios_like)
]
Changes = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="SECTION.FIELD=VALUE",
        help="Override a field; may be repeated.",
        autocompletion=fields_like,
    ),
]
Json = Annotated[bool, typer.Option("--json", help="Print the result to stdout as one JSON document.")]


_quiet = False


def quieten(quiet: bool) -> None:
    """Set whether lines other than errors, warnings and interruptions are suppressed."""
    global _quiet
    _quiet = quiet


def escape_unencodable_output() -> None:
    """Make stdout write escapes in place of characters that its encoding lacks, as stderr does."""
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")


def say(line: str) -> None:
    """Write a line for a person to stderr; on a terminal it is folded between words."""
    if _quiet and not line.startswith(LOUD):
        return
    width = _terminal_width()
    if width is not None and len(line) > width:
        line = "\n".join(textwrap.wrap(line, width, break_long_words=False, break_on_hyphens=False))
    _write(line)


def say_command(line: str, words: Sequence[str]) -> None:
    """Write a line that ends in a command; a narrow terminal gets the command on lines of its own, to copy."""
    width, command = _terminal_width(), [shlex.quote(word) for word in words]
    if width is None or len(" ".join([line, *command])) <= width:
        say(" ".join([line, *command]))
        return
    say(line)
    rows = [command[0]]
    for word in command[1:]:
        if len(rows[-1]) + len(word) + len(" ") + len(CONTINUED) <= width:
            rows[-1] += f" {word}"
        else:
            rows.append(f"    {word}")
    _write(f"{CONTINUED}\n".join(rows))


def _write(text: str) -> None:
    """Write to the current stderr.

    While a display of progress is drawn, it replaces `sys.stderr` and moves out of the way. `typer.echo` would write
    past it.
    """
    print(text, file=sys.stderr, flush=True)


def _terminal_width() -> int | None:
    """Return the columns of the terminal behind stderr; None for a file or a pipe."""
    console = Console(stderr=True)
    return console.width if console.is_terminal else None


def fail(line: str, status: int = BAD_INPUT) -> NoReturn:
    """End the command with one line on stderr."""
    say(f"error: {line}")
    raise typer.Exit(status)


def conclude(line: str) -> NoReturn:
    """End a command that answers a question with the answer "no", or "undecided", on stderr.

    The command did its work, so the line does not begin with `error:`. The exit status lets a script stop, as `diff`
    does for files that differ.
    """
    say(f"verdict: {line}")
    raise typer.Exit(FAILED)


def is_animated() -> bool:
    """Return True if stderr shows a spinner."""
    return progress.can_redraw(Console(stderr=True))


def refuse_several_controls(scenario: Scenario, who: str) -> None:
    """Raise ScenarioError if the plant has several controls and `who`, a command, can use only one."""
    try:
        channels.need_single_control(scenario.loop.plant, who)
    except ValueError as error:
        raise ScenarioError(str(error)) from None


@contextlib.contextmanager
def end_on_errors() -> Iterator[None]:
    """End a command with one line and an exit status for expected errors in the `with` block.

    Expected are bad input, an engine that cannot make the runs, and Ctrl-C. So are errors of the system, such as a full
    disk or lack of memory. Parts from outside that raise or exit are expected, too.
    """
    try:
        yield
    except (ScenarioError, EngineError) as error:
        fail(str(error))
    except BrokenPipeError:
        raise
    except OSError as error:
        at_output = (error.filename is None or error.errno in files.DISK_ERRORS) and _is_output_refused()
        fail(f"standard output: {error.strerror or error}" if at_output else files.describe_error(error), FAILED)
    except MemoryError:
        fail("out of memory", FAILED)
    except KeyboardInterrupt:
        say("interrupted")
        raise typer.Exit(INTERRUPTED) from None
    except (Exception, SystemExit) as error:
        if not (line := outside.describe_outside_error(error)):
            raise
        fail(line)


@contextlib.contextmanager
def show_before_errors(show: Callable[[], object]) -> Iterator[None]:
    """Show results before an error of the `with` block, such as of a full disk, ends the command."""
    try:
        yield
    except BaseException:
        show()
        raise


def _is_output_refused() -> bool:
    """Return True if standard output cannot be written, as on a full disk."""
    try:
        sys.stdout.write("")
        sys.stdout.flush()
    except OSError:
        return True
    return False


class InterruptibleEnd:
    """The reaction to Ctrl-C of work that can end early with a partial result.

    The first Ctrl-C sets `is_requested`. The work calls this object between its steps, and ends after the current
    step if the answer is True. The second Ctrl-C interrupts at once. The first one also does while there is no
    partial result.
    """

    def __init__(self, step: str, nothing: Callable[[], bool] = lambda: False):
        """Store the `step` to finish, for messages, and `nothing`, which is true while there is no result."""
        self.step = step
        self.nothing = nothing
        self.is_requested: bool = False

    def __call__(self) -> bool:
        """Return True once Ctrl-C has requested the end."""
        return self.is_requested

    def ask(self) -> None:
        """Handle Ctrl-C: request the end of the work, and say so on stderr.

        Raises:
            KeyboardInterrupt: It is the second Ctrl-C, or there is no partial result yet.
        """
        if self.is_requested or self.nothing():
            raise KeyboardInterrupt
        self.is_requested = True
        say(f"interrupted: finishing {self.step} (Ctrl-C again: at once)")


def run_with_progress(
    work: Callable[[], T], message: str, detail: progress.Detail | None = None, ending: InterruptibleEnd | None = None
) -> T:
    """Return the result of `work`, and show its progress: a spinner on a terminal, else lines on stderr.

    The work runs in its own thread, because Ctrl-C cannot interrupt compiled code in the main thread. Its output to
    stdout goes to stderr. `detail` returns the progress. Without an `ending`, Ctrl-C interrupts the work at once.
    """
    result: list[T] = []
    errors: list[BaseException] = []

    def run() -> None:
        try:
            # a part from outside may print, and stdout must hold nothing but the result
            with contextlib.redirect_stdout(sys.stderr), warnings_in_lines():
                result.append(work())
        except BaseException as error:
            errors.append(error)

    # Daemon: after an interrupt the process can exit while compiled code still runs.
    thread = threading.Thread(target=run, name=WORKER, daemon=True)
    display = (
        contextlib.nullcontext(lambda: None)
        if _quiet
        else progress.show_progress(message, detail, say, (SILENCE_S, SECOND_INTERRUPT_S))
    )
    with display as tell:
        thread.start()
        ended = False
        while not ended:
            if _wait_for_interrupt(thread):
                (ending or InterruptibleEnd("", nothing=lambda: True)).ask()
            ended = not thread.is_alive()
            tell()
    if errors:
        raise errors[0]
    return result[0]


def run_with_lines(work: Callable[[Callable[[str], None]], T], message: str) -> T:
    """Return the result of `work`, and show the last line of progress that it gives to its argument."""
    lines = [""]
    return run_with_progress(lambda: work(lines.append), message, lambda: lines[-1])


@contextlib.contextmanager
def warnings_in_lines() -> Iterator[None]:
    """Write each warning of Python code as one line, without file and line number."""
    with warnings.catch_warnings():
        warnings.showwarning = lambda message, *_: say(f"warning: {' '.join(str(message).split())}")
        yield


def _wait_for_interrupt(thread: threading.Thread) -> bool:
    """Wait a moment for a thread; return True after Ctrl-C.

    `interrupt` counts Ctrl-C in the process of the command. Elsewhere Ctrl-C raises KeyboardInterrupt.
    """
    try:
        thread.join(AWAKE)
    except KeyboardInterrupt:
        return True
    return interrupt.take_interrupt()


def load_scenario(scenario: str, changes: Sequence[str] | None, *, integrated: bool = True) -> Scenario:
    """Return a scenario, and write its notes and a warning for each value that is allowed but probably a mistake.

    With `integrated` it also checks that the step is stable for the loop. With parts from outside, it raises
    ScenarioError if the friction of a road has not the sign of the slip.
    """
    setup = run_with_progress(lambda: load(scenario, changes or (), integrated=integrated), "checking the scenario")
    run_with_progress(lambda: outside.check_road(setup.loop), "checking the road")
    for line in setup.notes:
        say(f"note: {line}")
    for line in setup.cautions():
        say(f"warning: {line}")
    return setup


def leave(status: str | int | None) -> NoReturn:
    """End the process with an exit status, without waiting for interrupted work.

    The interpreter would wait for the thread of such work. This function ends the process at once, after it has removed
    the work's unfinished files and processes.

    Raises:
        SystemExit: No work runs, so the interpreter can end as usual.
    """
    status = interrupt.exit_status() if status == INTERRUPTED else status
    if any(thread.name == WORKER for thread in threading.enumerate()):
        for child in multiprocessing.active_children():
            child.kill()
        files.remove_unfinished()
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(status if isinstance(status, int) else FAILED)
    raise SystemExit(status)


def add_option_overrides(changes: Sequence[str] | None, section: str, **fields: object) -> list[str]:
    """Return the overrides of --set, followed by those of separate options such as --seed; None is left out."""
    return [*(changes or ()), *(f"{section}.{name}={value}" for name, value in fields.items() if value is not None)]


def need_extra(extra: str) -> None:
    """End the command if a module of an optional extra, a key of `EXTRAS`, is not installed."""
    missing = [name for name in EXTRAS[extra] if importlib.util.find_spec(name) is None]
    if missing:
        fail(f'{" and ".join(missing)} needed: pip install ".[{extra}]" in a clone')


def need_matplotlib() -> None:
    """End the command if Matplotlib is not installed."""
    os.environ.setdefault("MPLBACKEND", "agg")
    if importlib.util.find_spec("matplotlib") is None:
        fail('figures need matplotlib: pip install ".[plot]" in a clone')
