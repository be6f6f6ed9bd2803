"""The command `explore`: a scenario in the browser."""

import errno
import os
import pathlib
from collections.abc import Callable
from typing import TYPE_CHECKING, Annotated

import typer

from diffabs.cli import console
from diffabs.host import interrupt

if TYPE_CHECKING:
    from diffabs.output.explore.session import ProofVerdict, Session

PORT = 8342
DEFAULT_SCENARIO = "slip-cured"  # shown without an argument


def explore(
    scenario: console.ScenarioName = DEFAULT_SCENARIO,
    port: Annotated[
        int | None,
        typer.Option(
            min=0,
            max=65535,
            help=f"Port of the page; 0 for any free port. Default: {PORT}, or any free port if it cannot be used.",
        ),
    ] = None,
    proof: Annotated[
        pathlib.Path | None,
        typer.Option(metavar="FILE", help="Certificate of prove; the page says whether its box has the values shown."),
    ] = None,
    browser: Annotated[bool, typer.Option("--browser/--no-browser", help="Open the page in the browser.")] = True,
) -> None:
    """Drag parameters in the browser.

    Curves, a fan of runs, poles and a certificate follow at once. The page can also tune and save."""
    with console.end_on_errors():
        console.need_extra("explore")
        console.load_scenario(scenario, None)  # reports a wrong scenario here, before a page opens
        judge = _load_judge(proof) if proof else None
        from diffabs.output.explore import server
        from diffabs.output.explore.session import Tools

        try:
            listener = server.open_listener(port, PORT)
        except OSError as error:
            used = error.errno == errno.EADDRINUSE
            reason = "another program uses this port" if used else os.strerror(error.errno or 0)
            console.fail(f"--port {port}: {reason}")
        options = {
            "ready": lambda url: console.say(f"{url} (on this machine only; Ctrl-C ends it)"),
            "browser": browser,
        }
        if not interrupt.take_interrupt():  # Ctrl-C may have come during the import of the framework
            with console.warnings_in_lines():
                tools = Tools(judge=judge)
                server.serve(scenario, tools, pathlib.Path.cwd(), listener, thread=console.WORKER, **options)
            interrupt.take_interrupt()
        raise KeyboardInterrupt  # only Ctrl-C ends the server


def _load_judge(path: pathlib.Path) -> Callable[["Session"], "ProofVerdict"]:
    """Return the function that judges a session by a proof's file."""
    from diffabs.output.explore.proved import load_judge

    try:
        return load_judge(path)
    except ValueError as error:
        console.fail(f"--proof {path}: {' '.join(str(error).split())}")
