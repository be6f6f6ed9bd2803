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
    from diffabs.explore.session import ProofVerdict, Tools
    from diffabs.explore.tuning import TuningTask

PORT = 8342
DEFAULT_SCENARIO = "slip-cured"  # what is shown where nothing is asked for


def explore(
    scenario: console.ScenarioName = DEFAULT_SCENARIO,
    port: Annotated[
        int | None, typer.Option(min=0, max=65535, help=f"Of the page; 0 for any. Default: {PORT}, else any.")
    ] = None,
    browser: Annotated[bool, typer.Option("--browser/--no-browser", help="Open the page in the browser.")] = True,
) -> None:
    """Drag parameters in the browser.

    Curves, a fan of runs, poles and a certificate follow. The page tunes, and saves."""
    with console.end_on_errors():
        console.need_extra("explore")
        console.load_scenario(scenario, None)  # what is wrong is said here, not in a page
        from diffabs.explore import server

        there = _open_socket(port)
        told = {"ready": lambda url: console.say(f"{url} (on this machine only; Ctrl-C ends it)"), "browser": browser}
        if not interrupt.take_interrupt():  # while the framework was imported
            with console.warnings_in_lines():
                server.serve(scenario, _page_tools(), pathlib.Path.cwd(), there, thread=console.WORKER, **told)
            interrupt.take_interrupt()
        raise KeyboardInterrupt  # nothing else ends it


def _open_socket(port: int | None) -> socket.socket:
    """A socket at the port that is asked for; at the usual one or any other if none is. Raises typer.Exit."""
    from diffabs.explore.server import listen_on_loopback

    try:
        return listen_on_loopback(PORT if port is None else port)
    except OSError as error:
        if port is None and error.errno == errno.EADDRINUSE:
            return listen_on_loopback(0)
        why = "another program listens there" if error.errno == errno.EADDRINUSE else error.strerror
        console.fail(f"--port {port}: {why}")


def _page_tools() -> "Tools":
    """What the page needs of other commands."""
    from diffabs.explore.session import Tools

    return Tools(prove_scenario, pose_tuning)


def prove_scenario(chosen: Scenario) -> "ProofVerdict":
    """Return what can be proved of a scenario over the ranges of its [design]."""
    from diffabs.explore.session import CERTIFIED, NOT_PROVED, REFUTED, UNDECIDED, ProofVerdict

    found = tune.certify_result(chosen)
    sentence = found.sentence.partition(": ")[2]
    if not found.certified:
        return ProofVerdict(NOT_PROVED, sentence)
    words = {True: CERTIFIED, False: REFUTED, None: UNDECIDED}
    return ProofVerdict(words[found.document["quadratically_stable"]], sentence)


def pose_tuning(chosen: Scenario) -> "TuningTask":
    """Return lanes and constraints of a scenario's [tune]. Raises ScenarioError."""
    from diffabs.explore.tuning import TuningTask

    try:
        work = tune.build_work(chosen)
    except ModuleNotFoundError as error:
        raise ScenarioError(str(error)) from None
    return TuningTask(work.batch, list(work.constraints.values()))
