"""What makes the runs of a command: the option, and what becomes of "auto"."""

from collections.abc import Callable
from typing import Annotated

import typer

from diffabs.cli import console
from diffabs.core.values import unknown_name_error
from diffabs.simulate.engine import REQUESTABLE_ENGINES

Engine = Annotated[str, typer.Option(help="xla, kernel (a program of this machine, by its C++ compiler), or auto.")]


def check_engine_name(engine: str) -> None:
    """Raises ScenarioError for a name of none."""
    if engine not in REQUESTABLE_ENGINES:
        raise unknown_name_error(f"--engine {engine} is unknown", engine, REQUESTABLE_ENGINES)


def choose_engine(engine: str, objection: Callable[[], str | None]) -> str:
    """Return "xla" or "kernel": of "auto" the second where nothing stands against it; else a line says what does."""
    if engine != "auto":
        return engine
    line = console.run_with_progress(objection, "compiling a kernel")
    if line:
        console.say(f"note: runs are made by XLA: {line}")
    return "xla" if line else "kernel"
