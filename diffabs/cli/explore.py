"""The command `explore`: a scenario in the browser."""

import errno
import pathlib
import socket
from typing import TYPE_CHECKING, Annotated

import typer

from diffabs.cli import console, tune
from diffabs.core import interrupt
from diffabs.core.values import ScenarioError
from diffabs.scenario.scenario import Scenario

if TYPE_CHECKING:
    from diffabs.explore.session import Tools, Verdict
    from diffabs.explore.tuning import Posed

PORT = 8342
FIRST = "slip-cured"  # what is shown where nothing is asked for


def explore(
    scenario: console.ScenarioName = FIRST,
    port: Annotated[
        int | None, typer.Option(min=0, max=65535, help=f"Of the page; 0 for any. Default: {PORT}, else any.")
    ] = None,
    browser: Annotated[bool, typer.Option("--browser/--no-browser", help="Open the page in the browser.")] = True,
) -> None:
    """Drag parameters in the browser.

    Curves, a fan of runs, poles and a certificate follow. The page tunes, and saves."""
    with console.guarded():
        console.need_extra("explore")
        console.loaded(scenario, None)  # what is wrong is said here, not in a page
        from diffabs.explore import server

        there = _listening(port)
        told = {"ready": lambda url: console.say(f"{url} (on this machine only; Ctrl-C ends it)"), "browser": browser}
        if not interrupt.pressed():  # while the framework was imported
            with console.warnings_in_lines():
                server.serve(scenario, _tools(), pathlib.Path.cwd(), there, thread=console.WORKER, **told)
            interrupt.pressed()
        raise KeyboardInterrupt  # nothing else ends it


def _listening(port: int | None) -> socket.socket:
    """A socket at the port that is asked for; at the usual one or any other if none is. Raises typer.Exit."""
    from diffabs.explore.server import listening

    try:
        return listening(PORT if port is None else port)
    except OSError as error:
        if port is None and error.errno == errno.EADDRINUSE:
            return listening(0)
        why = "another program listens there" if error.errno == errno.EADDRINUSE else error.strerror
        console.fail(f"--port {port}: {why}")


def _tools() -> "Tools":
    """What the page needs of other commands."""
    from diffabs.explore.session import Tools

    return Tools(prove, pose)


def prove(chosen: Scenario) -> "Verdict":
    """Return what can be proved of a scenario over the ranges of its [design]."""
    from diffabs.explore.session import CERTIFIED, REFUTED, UNDECIDED, UNKNOWN, Verdict

    found = tune.certificate_of(chosen)
    sentence = found.sentence.partition(": ")[2]
    if not found.certified:
        return Verdict(UNKNOWN, sentence)
    words = {True: CERTIFIED, False: REFUTED, None: UNDECIDED}
    return Verdict(words[found.document["quadratically_stable"]], sentence)


def pose(chosen: Scenario) -> "Posed":
    """Return lanes and constraints of a scenario's [tune]. Raises ScenarioError."""
    from diffabs.explore.tuning import Posed

    try:
        work = tune.work_of(chosen)
    except ModuleNotFoundError as error:
        raise ScenarioError(str(error)) from None
    return Posed(work.batch, list(work.constraints.values()))
