"""The option `--engine`, which selects the program that makes the runs of a command."""

from collections.abc import Callable
from typing import Annotated

import typer

from diffabs.cli import console
from diffabs.core.values import unknown_name_error
from diffabs.simulate.drive.engine import REQUESTABLE_ENGINES

Engine = Annotated[
    str, typer.Option(help="Engine of the runs: xla, kernel (compiled by this machine's C++ compiler) or auto.")
]


def check_engine_name(engine: str) -> None:
    """Check the name of an engine.

    Args:
        engine: Value of the option.

    Raises:
        ScenarioError: The name is unknown.
    """
    if engine not in REQUESTABLE_ENGINES:
        raise unknown_name_error(f"--engine {engine} is unknown", engine, REQUESTABLE_ENGINES)


def choose_engine(engine: str, objection: Callable[[], str | None]) -> str:
    """Return "xla" or "kernel", the engine that makes the runs.

    "auto" becomes "kernel" unless there is an objection. A line on stderr then gives the reason for XLA.

    Args:
        engine: Value of the option: "auto", or an engine, which is returned as it is.
        objection: Function that compiles a kernel, and returns None or the reason why it cannot be used.
    """
    if engine != "auto":
        return engine
    line = console.run_with_progress(objection, "compiling a kernel")
    if line:
        console.say(f"note: runs are made by XLA: {line}")
    return "xla" if line else "kernel"
