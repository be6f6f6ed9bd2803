"""The option `--engine`, which selects the program that makes the runs of a command."""

from collections.abc import Callable
from typing import Annotated, TypeVar

import typer

from diffabs.cli import console
from diffabs.engine.drive.engine import REQUESTABLE_ENGINES, resolve_request
from diffabs.host.values import ScenarioError, unknown_name_error

Engine = Annotated[
    str,
    typer.Option(
        help="Engine of the runs: kernel (by a C++ compiler, or CUDA), xla, or auto: a kernel where possible."
    ),
]

COMPILING_KERNEL = "compiling a kernel"
T = TypeVar("T")


def check_engine_name(engine: str) -> None:
    """Check the name of an engine."""
    try:
        resolve_request(engine)
    except ValueError as error:
        if engine in REQUESTABLE_ENGINES:  # the environment variable has another name
            raise ScenarioError(str(error)) from None
        raise unknown_name_error(f"--engine {engine} is unknown", engine, REQUESTABLE_ENGINES) from None


def choose_engine(choose: Callable[[], tuple[T, str]]) -> T:
    """Return a choice of the engine, of which a line on stderr says why it is XLA."""
    choice, why = console.run_with_progress(choose, COMPILING_KERNEL)
    if why:
        console.say(f"note: runs are made by XLA: {why}")
    return choice
