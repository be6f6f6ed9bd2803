"""What every command does: report errors in one line, wait with a sign of life, leave."""

import contextlib
import importlib.util
import multiprocessing
import os
import shlex
import sys
import textwrap
import threading
import time
import tomllib
import warnings
from collections.abc import Callable, Iterator, Sequence
from typing import Annotated, Any, NoReturn, TypeVar

import typer
from rich.console import Console

from diffabs.cli import progress
from diffabs.core import files, interrupt, provenance, stopwatch
from diffabs.core.values import ScenarioError
from diffabs.scenario import outside
from diffabs.scenario.model import describe_model
from diffabs.scenario.scenario import Scenario, dump, load, names

T = TypeVar("T")

FAILED, BAD_INPUT, INTERRUPTED, TERMINATED = 1, 2, interrupt.INTERRUPTED, interrupt.TERMINATED
SILENCE_S, SECOND_INTERRUPT_S = progress.SILENCE_S, progress.REPEAT_S
AWAKE = 0.1  # s between looks for Ctrl-C
LOUD = ("error:", "warning:", "interrupted")  # lines that --quiet does not silence
CONTINUED = " \\"  # a line of a shell that goes on in the next
WORKER = "diffabs worker"
EXTRAS = {
    "sweep": ("filelock", "pyarrow", "scipy", "zarr"),
    "cluster": ("distributed",),
    "tune": ("optax", "scipy"),
    "report": ("jinja2",),
    "explore": ("nicegui",),
}


# What commands take.
def scenarios_like(incomplete: str) -> list[str]:
    """Completions; where there is none the shell offers files."""
    return [name for name in names() if name.startswith(incomplete)]


def fields_like(context: typer.Context, incomplete: str) -> list[str]:
    """Completions of --set: the fields of the scenario on the line, as `show` writes them."""
    words = [context.params.get("scenario"), *context.args]  # an option without its value leaves words unread
    try:
        tables = tomllib.loads(dump(load(next(filter(None, words)))))
    except (StopIteration, OSError, ValueError):
        return []
    return [f"{path}=" for path in _field_paths(tables) if path.startswith(incomplete)]


def _field_paths(tables: dict[str, Any], above: str = "") -> Iterator[str]:
    for name, value in tables.items():
        if isinstance(value, dict):
            yield from _field_paths(value, f"{above}{name}.")
        else:
            yield f"{above}{name}"


ScenarioName = Annotated[
    str, typer.Argument(help="A TOML file, or the name of a packaged scenario.", autocompletion=scenarios_like)
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
Json = Annotated[bool, typer.Option("--json", help="One JSON document on stdout, nothing else there.")]


_quiet = False
_given: tuple[str, ...] = ()  # the words after `diffabs`
_begun = time.monotonic()


def quieten(wanted: bool) -> None:
    """Say no more than errors, warnings, and what was interrupted; or everything."""
    global _quiet
    _quiet = wanted


def note_command(words: Sequence[str]) -> None:
    """Note the words of the command that begins."""
    global _given, _begun
    _given, _begun = tuple(words), time.monotonic()
    stopwatch.count_compilations()


def describe_run() -> dict[str, str | float]:
    """Return when, where and by which command a document is made, and how long that took so far [s]."""
    seconds, compiling = time.monotonic() - _begun, stopwatch.compile_time_since(_begun)
    return {**provenance.describe_making(_given), "seconds": round(seconds, 1), "of it compiling": round(compiling, 1)}


def describe_source(chosen: Scenario) -> dict[str, Any]:
    """Return how every document on a scenario begins: what was asked about, and how the document is made."""
    return {"scenario": chosen.name, "model": describe_model(chosen), "made": describe_run()}


def say(line: str) -> None:
    """A line for a person, on stderr; on a terminal folded between words."""
    if not _quiet or line.startswith(LOUD):
        _write("\n".join(_fold_line(line)))


def say_command(line: str, words: Sequence[str]) -> None:
    """A line that ends in a command; on a terminal too narrow for both the command has its own lines, to copy."""
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
    """Not with `typer.echo`, which writes past what has taken the place of stderr: the display of how far work is,
    which moves out of the way."""
    print(text, file=sys.stderr, flush=True)


def _fold_line(line: str) -> list[str]:
    width = _terminal_width()
    if width is None or len(line) <= width:
        return [line]
    return textwrap.wrap(line, width, break_long_words=False, break_on_hyphens=False)


def _terminal_width() -> int | None:
    """Columns of the terminal that stderr is; None where it is none."""
    console = Console(stderr=True)
    return console.width if console.is_terminal else None


def fail(line: str, status: int = BAD_INPUT) -> NoReturn:
    """Leave with one line. Raises typer.Exit."""
    say(f"error: {line}")
    raise typer.Exit(status)


def is_animated() -> bool:
    """Whether stderr shows a spinner."""
    return progress.can_redraw(Console(stderr=True))


@contextlib.contextmanager
def end_on_errors() -> Iterator[None]:
    """Bad input, a full disk, Ctrl-C, and parts from outside that raise or exit end a command with one line and their
    exit status."""
    try:
        yield
    except ScenarioError as error:
        fail(str(error))
    except BrokenPipeError:
        raise
    except OSError as error:
        fail(" ".join(str(error).split()), FAILED)
    except MemoryError:
        fail("out of memory", FAILED)
    except KeyboardInterrupt:
        say("interrupted")
        raise typer.Exit(INTERRUPTED) from None
    except (Exception, SystemExit) as error:
        if not (line := outside.describe_outside_error(error)):
            raise
        fail(line)


class InterruptibleEnd:
    """What Ctrl-C asks of work that can end early and has then something to show: to finish `what` it has in hand. The
    work asks this object whether it shall. The second time Ctrl-C interrupts, and the first, too, while `nothing()` is
    reached yet."""

    def __init__(self, what: str, nothing: Callable[[], bool] = lambda: False):
        """Nobody has asked yet."""
        self.what, self.nothing, self.asked = what, nothing, False

    def __call__(self) -> bool:
        """Whether Ctrl-C was pressed."""
        return self.asked

    def ask(self) -> None:
        """Ctrl-C was pressed. Raises KeyboardInterrupt if the work is not to be waited for."""
        if self.asked or self.nothing():
            raise KeyboardInterrupt
        self.asked = True
        say(f"interrupted: finishing {self.what} (Ctrl-C again: at once)")


def run_with_progress(
    work: Callable[[], T], message: str, detail: progress.Detail | None = None, ending: InterruptibleEnd | None = None
) -> T:
    """The result of `work`, with a spinner on a terminal, or a line if it takes long elsewhere. `detail` says how far
    the work is: beside the spinner, or in a line every few seconds.

    The work has a thread of its own, because Ctrl-C cannot interrupt compiled code in the main one. Raises what it
    raises, and KeyboardInterrupt at once, or with an `ending` when there is nothing to wait for.
    """
    result: list[T] = []
    errors: list[BaseException] = []

    def run() -> None:
        try:
            # a part from outside may print: stdout is for the result
            with contextlib.redirect_stdout(sys.stderr), warnings_in_lines():
                result.append(work())
        except BaseException as error:
            errors.append(error)

    thread = threading.Thread(target=run, name=WORKER, daemon=True)
    told = (
        contextlib.nullcontext(lambda: None)
        if _quiet
        else progress.show_progress(message, detail, say, (SILENCE_S, SECOND_INTERRUPT_S))
    )
    with told as tell:
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


@contextlib.contextmanager
def warnings_in_lines() -> Iterator[None]:
    """Say what the library warns of in a line, without the file that warns."""
    with warnings.catch_warnings():
        warnings.showwarning = lambda message, *_: say(f"warning: {' '.join(str(message).split())}")
        yield


def _wait_for_interrupt(thread: threading.Thread) -> bool:
    """Wait a moment for a thread. Whether Ctrl-C was pressed; an exception where this is not the command's process."""
    try:
        thread.join(AWAKE)
    except KeyboardInterrupt:
        return True
    return interrupt.take_interrupt()


def load_scenario(scenario: str, changes: Sequence[str] | None, *, integrated: bool = True) -> Scenario:
    """A scenario; says what is allowed in it but hardly meant. Raises ScenarioError."""
    chosen = run_with_progress(lambda: load(scenario, changes or (), integrated=integrated), "checking the scenario")
    for line in chosen.cautions():
        say(f"warning: {line}")
    return chosen


def leave(status: Any) -> NoReturn:
    """Exit at once where interrupted work still runs: the interpreter would wait for it; what that work has begun to
    write and its processes go with it. Raises SystemExit else."""
    status = TERMINATED if status == INTERRUPTED and interrupt.was_terminated() else status
    if any(thread.name == WORKER for thread in threading.enumerate()):
        for child in multiprocessing.active_children():
            child.kill()
        files.remove_unfinished()
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(status if isinstance(status, int) else FAILED)
    raise SystemExit(status)


def add_option_overrides(changes: Sequence[str] | None, section: str, **fields: Any) -> list[str]:
    """Return overrides, with those that options of their own say of fields of a section."""
    return [*(changes or ()), *(f"{section}.{name}={value}" for name, value in fields.items() if value is not None)]


def need_extra(extra: str) -> None:
    """Raises typer.Exit if a module of an optional extra is not installed."""
    missing = [name for name in EXTRAS[extra] if importlib.util.find_spec(name) is None]
    if missing:
        fail(f'{" and ".join(missing)} needed: pip install ".[{extra}]" in a clone')


def need_matplotlib() -> None:
    """Raises typer.Exit where no figure can be drawn."""
    os.environ.setdefault("MPLBACKEND", "agg")
    if importlib.util.find_spec("matplotlib") is None:
        fail('figures need matplotlib: pip install ".[plot]" in a clone')
