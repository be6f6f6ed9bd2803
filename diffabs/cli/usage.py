"""How the command line is used: an example in every help, --quiet everywhere, and one line for a wrong usage."""

import functools
import inspect
import re
import sys
from collections.abc import Callable
from typing import Annotated, Any

import typer
import typer.core

from diffabs.cli import console

# Of the click that this typer brings or needs: the ancestor of all complaints about arguments.
UsageError: Any = typer.BadParameter.__base__
Quiet = Annotated[bool, typer.Option("-q", "--quiet", help="Say nothing but results, warnings and errors.")]


class Group(typer.core.TyperGroup):
    """The program, whose complaint about an argument is one line like any other error."""

    def main(self, *args: Any, standalone_mode: bool = True, **more: Any) -> Any:
        """Run a command, and exit if `standalone_mode`."""
        try:
            status = super().main(*args, standalone_mode=False, **more)
        except UsageError as error:
            status = _told(error)
        if standalone_mode:
            sys.exit(status)
        return status


def _told(error: Any) -> int:
    if type(error).__name__ == "NoArgsIsHelpError":
        error.show()
    else:
        text = " ".join(error.format_message().split()).removesuffix(".")
        text = re.sub(r"^Invalid value for '(.*?)': ", r"\1: ", text)
        where = error.ctx.command_path if error.ctx else "diffabs"
        console.say(f"error: {text[:1].lower()}{text[1:]} ({where} --help)")
    return error.exit_code


def add(app: typer.Typer, function: Callable[..., Any], example: str, name: str | None = None) -> None:
    """Make a function a command: with its example (what follows `diffabs`), and with --quiet."""

    @functools.wraps(function)
    def command(*args: Any, quiet: bool, **given: Any) -> Any:
        console.quieten(quiet)
        return function(*args, **given)

    signature = inspect.signature(function)
    more = inspect.Parameter("quiet", inspect.Parameter.KEYWORD_ONLY, default=False, annotation=Quiet)
    command.__signature__ = signature.replace(parameters=[*signature.parameters.values(), more])  # pyright: ignore
    command.__annotations__ = {**function.__annotations__, "quiet": Quiet}
    app.command(name, epilog=f"Example:\n\n\b\n  diffabs {example}")(command)
