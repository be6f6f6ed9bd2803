"""Output files of the commands: checks of their names, and files written whole or not at all."""

import contextlib
import importlib.util
import pathlib
from collections.abc import Iterator

from diffabs.cli.console import fail, need_matplotlib
from diffabs.runtime import files

PICTURES = (".png", ".pdf", ".svg")


def check_picture(plot: pathlib.Path | None) -> None:
    """Check the file of a figure.

    Args:
        plot: File; None for no figure.

    Raises:
        typer.Exit: The ending is not that of a figure, or Matplotlib is missing.
    """
    if plot:
        if plot.suffix.lower() not in PICTURES:
            fail(f"--plot {plot}: the name must end in {', '.join(PICTURES)}")
        need_matplotlib()


def check_mat(mat: pathlib.Path | None) -> None:
    """Check the file of a MAT export.

    Args:
        mat: File; None for no export.

    Raises:
        typer.Exit: MATLAB would not load a file of this name, or SciPy is missing.
    """
    if mat and mat.suffix != ".mat":
        fail(f"--mat {mat}: the name must end in .mat")
    if mat and importlib.util.find_spec("scipy") is None:
        fail('MAT files need scipy: pip install ".[tune]" in a clone')


def check_scenario_file(out: pathlib.Path | None) -> None:
    """Check the file of a scenario: `load` finds only files that end in .toml.

    Args:
        out: File; None for no file.

    Raises:
        typer.Exit: The name does not end in .toml.
    """
    if out and out.suffix != ".toml":
        fail(f"--out {out}: the name must end in .toml")


def resolve_path(path: pathlib.Path, option: str) -> pathlib.Path:
    """Return a path without symbolic links.

    Args:
        path: Path.
        option: Option of the path, for messages.

    Raises:
        typer.Exit: The links form a loop, or the text is not a path.
    """
    try:
        with contextlib.suppress(FileNotFoundError):
            path.stat()  # raises for a loop of links, which `resolve` accepts in some Python versions
        return path.resolve()
    except OSError as error:
        fail(f"{option} {path}: cannot be written, {error.strerror}")
    except ValueError:
        fail(f"{option} {path}: is not a file name")


@contextlib.contextmanager
def new_target_file(target: pathlib.Path | None, option: str) -> Iterator[pathlib.Path | None]:
    """Yield a temporary file beside `target` that replaces it at the end; None without a target.

    An error discards the temporary file, and `target` stays unchanged. The block may also delete the temporary file,
    with the same effect.

    Args:
        target: File to write.
        option: Option of the file, for messages.

    Raises:
        typer.Exit: The file cannot be written.
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
    """Yield a temporary folder beside `target` that replaces it at the end; an error discards it.

    An empty folder or an older result (a folder with summary.json) is replaced. Any other content is left alone.

    Args:
        target: Folder to write.

    Raises:
        typer.Exit: The folder cannot be made, or has other content.
    """
    target = resolve_path(target, "--out")
    if target.exists() and not (target.is_dir() and (not any(target.iterdir()) or (target / "summary.json").exists())):
        fail(f"--out {target}: exists and is not an earlier result; move it away")
    with _open_target(files.new_folder(target), "--out", target) as new:
        yield new


@contextlib.contextmanager
def _open_target(
    making: contextlib.AbstractContextManager[pathlib.Path], option: str, target: pathlib.Path
) -> Iterator[pathlib.Path]:
    """Yield the temporary file or folder. Raises typer.Exit if it cannot be made."""
    with contextlib.ExitStack() as stack:
        try:
            made = stack.enter_context(making)
        except OSError as error:
            fail(f"{option} {target}: cannot be written, {error.strerror}")
        yield made
