"""Usage of the command line: an example in every help, --quiet and --parts for every command, one line for a wrong
usage.
"""

import functools
import importlib.metadata
import inspect
import re
import sys
from collections.abc import Callable
from typing import Annotated, Any

import typer
import typer.core

from diffabs.cli import console, targets
from diffabs.cli import engine as engines
from diffabs.core.types import PyTree, Scalar
from diffabs.host import provenance
from diffabs.scenario.registry import register_parts

# The base class of all usage errors. It is taken from the Click that this Typer uses, which may be Typer's own copy.
UsageError: Any = typer.BadParameter.__base__
COMMAND_GROUP = "diffabs.commands"  # entry points of other packages; each names a function of the form of a command
Quiet = Annotated[bool, typer.Option("-q", "--quiet", help="Print only results, warnings and errors.")]
Parts = Annotated[
    list[str] | None, typer.Option(metavar="MODULE", help="Also use the parts in this Python module; may be repeated.")
]


class Group(typer.core.TyperGroup):
    """The program, with the commands of other packages. It reports a wrong argument in one line, like any other error.

    The entry points are read only for a help page of all commands, or for a name that is none of its own.
    """

    def list_commands(self, ctx: Any) -> list[str]:
        """Return the names of the commands; those of other packages come last."""
        names = super().list_commands(ctx)
        return [*names, *sorted(_outside_commands().keys() - {*names})]

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        """Return a command by its name, or None."""
        command = super().get_command(ctx, cmd_name)
        if command is None and (point := _outside_commands().get(cmd_name)):
            return _load_outside_command(point)
        return command

    def main(self, *args: PyTree, standalone_mode: bool = True, **more: Any) -> Scalar:
        """Run a command; exit with its status if `standalone_mode`, else return the status.

        `args` and `more` are those of Click.
        """
        words = more.get("args", args[0] if args else None)
        provenance.begin_command(sys.argv[1:] if words is None else words)
        console.escape_unencodable_output()
        try:
            with console.end_on_errors():
                status = super().main(*args, standalone_mode=False, **more)
        except typer.Exit as end:
            status = end.exit_code
        except UsageError as error:
            if type(error).__name__ == "NoArgsIsHelpError":
                error.show()
            else:
                text = " ".join(error.format_message().split()).removesuffix(".")
                value = _refused_value(error).replace("\\", r"\\")
                text = re.sub(r"^Invalid value for '(.*?)': (Value error, )?", rf"\1{value}: ", text)
                where = error.ctx.command_path if error.ctx else "diffabs"
                console.say(f"error: {text[:1].lower()}{text[1:]} ({where} --help)")
            status = error.exit_code
        if standalone_mode:
            sys.exit(status)
        return status


def _refused_value(error: Any) -> str:
    """Return " = VALUE" for a value that Typer's validation refused without naming it, or ""."""
    errors = getattr(error.__cause__, "errors", None)  # of a pydantic.ValidationError
    value = errors()[0]["input"] if errors else ""
    return f" = {value}" if errors and str(value) not in str(error) else ""


@functools.cache
def _outside_commands() -> dict[str, importlib.metadata.EntryPoint]:
    return {point.name: point for point in importlib.metadata.entry_points(group=COMMAND_GROUP)}


def _load_outside_command(point: importlib.metadata.EntryPoint) -> Any:
    """Return the command of another package; one that cannot be loaded says so when it is called."""
    try:
        function = point.load()
    except Exception as error:
        line = f"{point.name} cannot be loaded: {' '.join(f'{point.value}: {error}'.split())}"

        def function() -> None:
            console.fail(line)

        function.__doc__ = f"{line}."
    app = typer.Typer(add_completion=False, rich_markup_mode=None, pretty_exceptions_enable=False)
    add_command(app, function, getattr(function, "example", f"{point.name} --help"), point.name)
    return typer.main.get_command(app)


def add_command(app: typer.Typer, function: Callable[..., PyTree], example: str, name: str | None = None) -> None:
    """Add a function as a command, with its example, --quiet and --parts.

    Args:
        function: Function of the command. An unknown engine is refused before it is called.
        example: Words after `diffabs`.
    """

    @functools.wraps(function)
    def command(*args: PyTree, quiet: bool, parts: list[str] | None, **options: PyTree) -> Any:
        console.quieten(quiet)
        with console.end_on_errors():
            register_parts(parts or ())
            targets.check_distinct(options)
            engines.check_engine_name(options.get("engine", "auto"))
        return function(*args, **options)

    signature = inspect.signature(function)
    more = [
        inspect.Parameter(option, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=annotation)
        for option, default, annotation in (("parts", None, Parts), ("quiet", False, Quiet))
    ]
    command.__signature__ = signature.replace(parameters=[*signature.parameters.values(), *more])  # pyright: ignore
    command.__annotations__ = {**function.__annotations__, "parts": Parts, "quiet": Quiet}
    app.command(name, epilog=f"Example:\n\n\b\n  diffabs {example}")(command)
