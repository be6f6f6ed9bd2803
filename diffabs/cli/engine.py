"""What makes the runs of a command: the option, and what becomes of "auto"."""

from collections.abc import Callable
from typing import Annotated

import typer

from diffabs.cli import console
from diffabs.core.values import unknown
from diffabs.simulate.engine import REQUESTABLE_ENGINES

Engine = Annotated[str, typer.Option(help="xla, kernel (a program of this machine, by its C++ compiler), or auto.")]


def check(engine: str) -> None:
    """Raises ScenarioError for a name of none."""
    if engine not in REQUESTABLE_ENGINES:
        raise unknown(f"--engine {engine} is unknown", engine, REQUESTABLE_ENGINES)


def decided(engine: str, objection: Callable[[], str | None]) -> str:
    """Return "xla" or "kernel": of "auto" the second where nothing stands against it; else a line says what does."""
    if engine != "auto":
        return engine
    line = console.waited(objection, "compiling a kernel")
    if line:
        console.say(f"note: runs are made by XLA: {line}")
    return "xla" if line else "kernel"
