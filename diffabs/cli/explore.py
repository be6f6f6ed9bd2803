"""The command `explore`: a scenario in the browser."""

import errno
import os
import pathlib
import socket
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Annotated

import typer

from diffabs.cli import console
from diffabs.host import interrupt
from diffabs.host.values import ScenarioError
from diffabs.scenario.proving import certify_result
from diffabs.scenario.scenario import Scenario
from diffabs.scenario.tuning import build_work

if TYPE_CHECKING:
    from diffabs.output.explore.session import ProofVerdict, Session
    from diffabs.output.explore.tuning import TuningTask

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
        judge = load_judge(proof) if proof else None
        from diffabs.output.explore import server
        from diffabs.output.explore.session import Tools

        listener = _open_socket(port)
        options = {
            "ready": lambda url: console.say(f"{url} (on this machine only; Ctrl-C ends it)"),
            "browser": browser,
        }
        if not interrupt.take_interrupt():  # Ctrl-C may have come during the import of the framework
            with console.warnings_in_lines():
                tools = Tools(prove_scenario, pose_tuning, judge)
                server.serve(scenario, tools, pathlib.Path.cwd(), listener, thread=console.WORKER, **options)
            interrupt.take_interrupt()
        raise KeyboardInterrupt  # only Ctrl-C ends the server


def _open_socket(port: int | None) -> socket.socket:
    """Return a socket at the given port, else at the usual port or any free one. Raises typer.Exit.

    The socket listens before the server starts, so that a port in use is reported at once.
    """
    from diffabs.output.explore.guard import LOOPBACK_ADDRESS

    try:
        return socket.create_server((LOOPBACK_ADDRESS, PORT if port is None else port))
    except OSError as error:
        if port is None:
            return socket.create_server((LOOPBACK_ADDRESS, 0))
        in_use = error.errno == errno.EADDRINUSE
        console.fail(f"--port {port}: {'another program uses this port' if in_use else os.strerror(error.errno or 0)}")


def load_judge(path: pathlib.Path) -> "Callable[[Session], ProofVerdict]":
    """Return the function that judges a session by a proof's file."""
    from diffabs.output.explore.proved import judge_values, load_proved_box
    from diffabs.scenario.proofs import read_proof_document

    try:
        document = read_proof_document(path)
        if document is None:
            why = "is no certificate of prove" if path.exists() else "there is no such file"
            console.fail(f"--proof {path}: {why}")
        return partial(judge_values, load_proved_box(path, document))
    except ValueError as error:
        console.fail(f"--proof {path}: {' '.join(str(error).split())}")


def prove_scenario(scenario: Scenario) -> "ProofVerdict":
    """Return the verdict on a scenario's gain over the ranges of its [design].

    The word is "certified", "refuted" or "undecided" for quadratic stability. Without any certificate it is "unknown",
    and the sentence gives the reason.
    """
    from diffabs.output.explore.session import CERTIFIED, NOT_PROVED, REFUTED, UNDECIDED, ProofVerdict

    outcome = certify_result(scenario)
    sentence = outcome.sentence.partition(": ")[2]
    if not outcome.certified:
        return ProofVerdict(NOT_PROVED, sentence)
    words = {True: CERTIFIED, False: REFUTED, None: UNDECIDED}
    return ProofVerdict(words[outcome.document["quadratically_stable"]], sentence)


def pose_tuning(scenario: Scenario) -> "TuningTask":
    """Return runs and constraints of a scenario's [tune]."""
    from diffabs.output.explore.tuning import TuningTask

    try:
        work = build_work(scenario)
    except ModuleNotFoundError as error:
        raise ScenarioError(str(error)) from None
    return TuningTask(work.batch, list(work.constraints.values()))
