"""An explored scenario as a file that the command line runs."""

import os
import pathlib

from diffabs.host import files
from diffabs.host.values import ScenarioError, format_given
from diffabs.scenario.scenario import Scenario, dump, loads

MAX_NAME_LENGTH = 120  # characters, with the suffix


def save_scenario(scenario: Scenario, folder: pathlib.Path, name: str, *, replacing: bool = False) -> pathlib.Path:
    """Write a scenario to a file atomically, and return its path.

    It refuses an existing file unless `replacing`, and a scenario that the command line would refuse.
    """
    path = folder / _check_name(name)
    text = dump(scenario).encode()
    loads(text, path.stem, path.name)  # raises ScenarioError if the command line would refuse the text
    try:
        if replacing and path.is_file():
            files.write_file(path, text)
        else:
            with files.temporary_path(path.with_name(f".{path.stem}.{os.getpid()}.tmp")) as temporary:
                temporary.write_bytes(text)
                os.link(temporary, path)  # a link fails if the path exists; a rename would replace it
    except FileExistsError:
        raise ScenarioError(
            f"file = {format_given(path.name)} exists: choose another name, or allow to replace it"
        ) from None
    except OSError as error:
        raise ScenarioError(f"file = {format_given(path.name)} cannot be written: {error.strerror}") from None
    return path


def free_name(folder: pathlib.Path, stem: str) -> str:
    """Return a file name that does not exist in the folder."""
    names = (f"{stem}{'' if i == 1 else f'-{i}'}.toml" for i in range(1, 10_000))
    return next(name for name in names if not (folder / name).exists())


def _check_name(name: str) -> str:
    name = name.strip()
    plain = name.removesuffix(".toml")
    if not name.endswith(".toml") or not plain or len(name) > MAX_NAME_LENGTH:
        raise ScenarioError(f"file = {format_given(name)} is no name of a scenario: such as mine.toml is needed")
    if name != pathlib.PurePath(name).name or name.startswith(".") or "\\" in name or not name.isprintable():
        raise ScenarioError(
            f"file = {format_given(name)} leads elsewhere: a name without folders, such as mine.toml, is needed"
        )
    return name
