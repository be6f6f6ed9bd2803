"""Running the command line in this process, for the tests of every command."""

import contextlib
import os
import pathlib

import pytest
from typer.testing import CliRunner

from diffabs.cli import main


def run(*args: object, status: int = 0):
    result = CliRunner().invoke(main.app, [str(a) for a in args])
    if result.exception and not isinstance(result.exception, SystemExit):
        raise result.exception
    assert result.exit_code == status, result.output
    return result


def assert_one_error_line(result):
    assert result.stdout == ""
    assert result.stderr.startswith("error: ")
    assert result.stderr.count("\n") == 1


def left_in(folder: pathlib.Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


def umask() -> int:
    """What new files may not have; it can only be read by setting it."""
    mask = os.umask(0)
    os.umask(mask)
    return mask


@contextlib.contextmanager
def file_size_limit(size: int):
    """The system refuses to make a file longer than `size` [bytes], as a full disk does."""
    resource = pytest.importorskip("resource", reason="the limit is of POSIX")
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
