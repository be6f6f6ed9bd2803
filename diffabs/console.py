"""What every command does: report errors in one line, wait with a sign of life, replace files whole."""

import contextlib
import importlib.util
import math
import os
import pathlib
import shutil
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Annotated, Any, NoReturn, TypeVar

import typer
from rich.console import Console

from diffabs.catalogue import ScenarioError
from diffabs.scenario import Scenario, load

T = TypeVar("T")

FAILED, BAD_INPUT, INTERRUPTED = 1, 2, 130
PATIENCE = 2.0  # s without a sign of life
AGAIN = 5.0  # s between lines about how far work is
WORKER = "diffabs worker"
PICTURES = (".png", ".pdf", ".svg")

# What commands take.
ScenarioName = Annotated[str, typer.Argument(help="A TOML file, or the name of a packaged scenario.")]
Changes = Annotated[
    list[str] | None, typer.Option("--set", metavar="SECTION.FIELD=VALUE", help="Override a field; may be repeated.")
]
Json = Annotated[bool, typer.Option("--json", help="One JSON document on stdout, nothing else there.")]


def say(line: str) -> None:
    """A line for a person: on stderr, never wrapped."""
    typer.echo(line, err=True)


def fail(line: str, status: int = BAD_INPUT) -> NoReturn:
    """Leave with one line. Raises typer.Exit."""
    say(f"error: {line}")
    raise typer.Exit(status)


def animated() -> bool:
    """Whether stderr shows a spinner: a terminal that can write over a line."""
    console = Console(stderr=True)
    return console.is_terminal and not console.is_dumb_terminal


@contextlib.contextmanager
def guarded() -> Iterator[None]:
    """Bad input, a full disk, and Ctrl-C end a command with one line and their exit status."""
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


def waited(work: Callable[[], T], message: str, detail: Callable[[], str] | None = None) -> T:
    """The result of `work`, with a spinner on a terminal, or a line if it takes long elsewhere. `detail` says how far
    the work is: beside the spinner, or in a line every few seconds.

    The work has a thread of its own, because Ctrl-C cannot interrupt compiled code in the main one. Raises what it
    raises.
    """
    result: list[T] = []
    errors: list[BaseException] = []

    def run() -> None:
        try:
            result.append(work())
        except BaseException as error:
            errors.append(error)

    thread = threading.Thread(target=run, name=WORKER, daemon=True)
    console = Console(stderr=True)

    def line() -> str:
        return f"{message} ... {detail() if detail else ''}".strip()

    tell, due, told = say, time.monotonic() + PATIENCE, ""
    with console.status(line()) if console.is_terminal else contextlib.nullcontext() as status:
        if status:
            tell, due = status.update, 0.0
        thread.start()
        while thread.is_alive():
            thread.join(0.1)
            if time.monotonic() > due:
                if told != (told := line()):
                    tell(told)
                due = (0.0 if status else time.monotonic() + AGAIN) if detail else math.inf
    if errors:
        raise errors[0]
    return result[0]


def loaded(scenario: str, changes: Sequence[str] | None, *, integrated: bool = True) -> Scenario:
    """A scenario; says what is allowed in it but hardly meant. Raises ScenarioError."""
    chosen = waited(lambda: load(scenario, changes or (), integrated=integrated), "checking the scenario")
    for line in chosen.cautions():
        say(f"warning: {line}")
    return chosen


def leave(status: Any) -> NoReturn:
    """Exit at once where interrupted work still runs: the interpreter would wait for it. Raises SystemExit else."""
    if any(thread.name == WORKER for thread in threading.enumerate()):
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(status if isinstance(status, int) else FAILED)
    raise SystemExit(status)


def need_extra(extra: str, *modules: str) -> None:
    """Raises typer.Exit if a module of an optional extra is not installed."""
    missing = [name for name in modules if importlib.util.find_spec(name) is None]
    if missing:
        fail(f'{" and ".join(missing)} needed: pip install "diffabs[{extra}]"')


def need_matplotlib() -> None:
    """Raises typer.Exit where no figure can be drawn."""
    os.environ.setdefault("MPLBACKEND", "agg")
    if importlib.util.find_spec("matplotlib") is None:
        fail('figures need matplotlib: pip install "diffabs[plot]"')


def check_picture(plot: pathlib.Path | None) -> None:
    """Raises typer.Exit for a name that no figure can have, or without matplotlib."""
    if plot:
        if plot.suffix.lower() not in PICTURES:
            fail(f"--plot {plot}: the name must end in {', '.join(PICTURES)}")
        need_matplotlib()


def check_scenario_file(out: pathlib.Path | None) -> None:
    """Raises typer.Exit for a name under which no scenario would be found."""
    if out and out.suffix != ".toml":
        fail(f"--out {out}: the name must end in .toml")


@contextlib.contextmanager
def new_file(target: pathlib.Path, option: str) -> Iterator[pathlib.Path]:
    """A temporary file beside `target` that takes its place at the end, or vanishes if anything goes wrong.

    Raises typer.Exit where no file can be written.
    """
    target = target.resolve()
    if target.exists() and not target.is_file():
        fail(f"{option} {target}: is not a regular file")
    try:
        handle, name = tempfile.mkstemp(prefix=f".{target.stem}.", suffix=target.suffix, dir=target.parent)
    except OSError as error:
        fail(f"{option} {target}: cannot be written, {error.strerror}")
    os.close(handle)
    temporary = pathlib.Path(name)
    try:
        yield temporary
        temporary.chmod(0o666 & ~_umask())
        temporary.replace(target)
    finally:
        temporary.unlink(missing_ok=True)


@contextlib.contextmanager
def new_folder(target: pathlib.Path) -> Iterator[pathlib.Path]:
    """A temporary folder beside `target` that takes its place at the end, or vanishes if anything goes wrong.

    An older result (it has a summary.json) is replaced; any other content is left alone. Raises typer.Exit where the
    folder cannot be made or replaced.
    """
    target = target.resolve()
    if target.exists() and not (target.is_dir() and (not any(target.iterdir()) or (target / "summary.json").exists())):
        fail(f"--out {target}: exists and is no earlier result; move it away")
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        room = pathlib.Path(tempfile.mkdtemp(prefix=f".{target.name}.", dir=target.parent))
    except OSError as error:
        fail(f"--out {target}: cannot be written, {error.strerror}")
    new, old = room / "new", room / "old"
    try:
        new.mkdir()
        yield new
        if target.exists():
            target.rename(old)
        try:
            new.rename(target)
        except OSError:
            if old.exists():
                old.rename(target)
            raise
    finally:
        shutil.rmtree(room, ignore_errors=True)


def _umask() -> int:
    """What new files may not have; it can only be read by setting it."""
    mask = os.umask(0)
    os.umask(mask)
    return mask
