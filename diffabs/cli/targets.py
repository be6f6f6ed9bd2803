"""Files that commands write: under names that fit, whole or not at all."""

import contextlib
import importlib.util
import pathlib
from collections.abc import Iterator

from diffabs.cli.console import fail, need_matplotlib
from diffabs.core import files

PICTURES = (".png", ".pdf", ".svg")


def check_picture(plot: pathlib.Path | None) -> None:
    """Raises typer.Exit for a name that no figure can have, or without matplotlib."""
    if plot:
        if plot.suffix.lower() not in PICTURES:
            fail(f"--plot {plot}: the name must end in {', '.join(PICTURES)}")
        need_matplotlib()


def check_mat(mat: pathlib.Path | None) -> None:
    """Raises typer.Exit for a name that MATLAB would not load, or without SciPy."""
    if mat and mat.suffix != ".mat":
        fail(f"--mat {mat}: the name must end in .mat")
    if mat and importlib.util.find_spec("scipy") is None:
        fail('MAT files need scipy: pip install ".[tune]" in a clone')


def check_scenario_file(out: pathlib.Path | None) -> None:
    """Raises typer.Exit for a name under which no scenario would be found."""
    if out and out.suffix != ".toml":
        fail(f"--out {out}: the name must end in .toml")


def resolve_path(path: pathlib.Path, option: str) -> pathlib.Path:
    """A path without links. Raises typer.Exit for links that only lead to each other."""
    try:
        with contextlib.suppress(FileNotFoundError):
            path.stat()  # some versions of Python resolve a loop
        return path.resolve()
    except OSError as error:
        fail(f"{option} {path}: cannot be written, {error.strerror}")
    except ValueError:
        fail(f"{option} {path}: is no name of a file")


@contextlib.contextmanager
def new_target_file(target: pathlib.Path | None, option: str) -> Iterator[pathlib.Path | None]:
    """A temporary file beside `target` that takes its place at the end, or vanishes if anything goes wrong; None where
    no file is wanted. Whoever removes it leaves `target` as it was.

    Raises typer.Exit where no file can be written.
    """
    if target is None:
        yield None
        return
    target = resolve_path(target, option)
    if target.exists() and not target.is_file():
        fail(f"{option} {target}: is not a regular file")
    with _open_target(files.new_file(target), option, target) as temporary:
        yield temporary


@contextlib.contextmanager
def new_target_folder(target: pathlib.Path) -> Iterator[pathlib.Path]:
    """A temporary folder beside `target` that takes its place at the end, or vanishes if anything goes wrong.

    An older result (it has a summary.json) is replaced; any other content is left alone. Raises typer.Exit where the
    folder cannot be made.
    """
    target = resolve_path(target, "--out")
    if target.exists() and not (target.is_dir() and (not any(target.iterdir()) or (target / "summary.json").exists())):
        fail(f"--out {target}: exists and is no earlier result; move it away")
    with _open_target(files.new_folder(target), "--out", target) as new:
        yield new


@contextlib.contextmanager
def _open_target(
    making: contextlib.AbstractContextManager[pathlib.Path], option: str, target: pathlib.Path
) -> Iterator[pathlib.Path]:
    """What is being made. Raises typer.Exit where it cannot be begun."""
    with contextlib.ExitStack() as stack:
        try:
            made = stack.enter_context(making)
        except OSError as error:
            fail(f"{option} {target}: cannot be written, {error.strerror}")
        yield made
