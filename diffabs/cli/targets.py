"""Output files of the commands: checks of their names, and files written whole or not at all."""

import contextlib
import importlib.util
import itertools
import os
import pathlib
from collections.abc import Iterator, Mapping
from typing import Any

from diffabs.cli.console import fail, need_matplotlib
from diffabs.host import files
from diffabs.scenario import outside
from diffabs.scenario.scenario import names

PICTURES = (".png", ".pdf", ".svg")
OUTPUTS = ("csv", "mat", "out", "plot")  # arguments of commands that name what is written
# Arguments of commands that name what is read, and what messages call it.
INPUTS = {"scenario": "the scenario", "data": "the file of --data", "source": "the result"}


def check_distinct(arguments: Mapping[str, Any]) -> None:
    """Check that a command writes no file twice, and no file that it reads."""
    outputs = {f"--{name}": arguments[name] for name in OUTPUTS if arguments.get(name)}
    places = {option: resolve_path(path, option) for option, path in outputs.items()}
    for first, second in itertools.combinations(places, 2):
        if places[first] == places[second]:
            fail(f"{first} and {second} are the same file, {outputs[first]}")
    for option, (description, source) in itertools.product(places, _find_inputs(arguments)):
        if os.path.isfile(source) and places[option].exists() and os.path.samefile(source, places[option]):
            fail(f"{option} {outputs[option]} is {description} itself")


def _find_inputs(arguments: Mapping[str, Any]) -> Iterator[tuple[str, str | pathlib.Path]]:
    """Yield description and path of each file that a command reads: its inputs, and the modules of `--parts`."""
    for name, description in INPUTS.items():
        is_packaged = name == "scenario" and arguments.get(name) in names()
        if arguments.get(name) and not is_packaged:
            yield description, arguments[name]
    for module in outside.registered_modules():
        yield f"the module {module.__name__}", getattr(module, "__file__", None) or ""


def check_picture(plot: pathlib.Path | None) -> None:
    """Check the file of a figure."""
    if plot:
        if plot.suffix.lower() not in PICTURES:
            fail(f"--plot {plot}: the name must end in {', '.join(PICTURES)}")
        need_matplotlib()


def check_mat(mat: pathlib.Path | None) -> None:
    """Check that MATLAB loads a file of this name, and that SciPy is there; None for no export."""
    if mat and mat.suffix != ".mat":
        fail(f"--mat {mat}: the name must end in .mat")
    if mat and importlib.util.find_spec("scipy") is None:
        fail('MAT files need scipy: pip install ".[tune]" in a clone')


def check_scenario_file(out: pathlib.Path | None) -> None:
    """Check the file of a scenario: `load` finds only files that end in .toml."""
    if out and out.suffix != ".toml":
        fail(f"--out {out}: the name must end in .toml")


def resolve_path(path: pathlib.Path, option: str) -> pathlib.Path:
    """Return a path without symbolic links."""
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

    An empty folder or an older result (a folder with summary.json that is not a sweep's) is replaced. Any other content
    is left alone.
    """
    target = resolve_path(target, "--out")
    entries = set(os.listdir(target)) if target.is_dir() else set()
    is_result = "summary.json" in entries and not entries & {"manifest.json", "chunks"}  # a sweep has a summary, too
    if target.exists() and not (target.is_dir() and (is_result or not entries)):
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
            temporary = stack.enter_context(making)
        except OSError as error:
            fail(f"{option} {target}: cannot be written, {error.strerror}")
        yield temporary
