"""The command `tune`: tuning of the free parameters of [tune] by gradients, and a proof about the result.

It needs the extra `tune`, and for a proof the extra `design`. Modules that need them are imported only when the command
runs.
"""

import functools
import pathlib
from typing import TYPE_CHECKING, Annotated

import typer

from diffabs.cli import certificates, console, progress, show, targets
from diffabs.cli import engine as engines
from diffabs.core.types import JsonObject
from diffabs.scenario import tuning
from diffabs.scenario.model import result_document
from diffabs.scenario.proving import Proved, certify_result, without_certificate
from diffabs.scenario.scenario import Scenario, dump
from diffabs.scenario.tuning import Work

if TYPE_CHECKING:
    from diffabs.tune import Tuned, TuningProgress


def tune(
    scenario: console.ScenarioName,
    changes: console.Changes = None,
    starts: Annotated[int | None, typer.Option(help="Number of descents; the same as --set tune.starts=N.")] = None,
    engine: engines.Engine = "auto",
    as_json: console.Json = False,
    out: Annotated[
        pathlib.Path | None, typer.Option(metavar="FILE.toml", help="Write the tuned scenario to this file.")
    ] = None,
    plot: Annotated[
        pathlib.Path | None, typer.Option(metavar="FILE.png", help="Draw the history of the tuning, and its worst run.")
    ] = None,
) -> None:
    """Tune the free parameters of [tune] by gradients.

    The objective is taken over all runs of [tune] at once."""
    with console.end_on_errors(), certificates.report_design_errors():
        console.need_extra("tune")
        targets.check_picture(plot)
        targets.check_scenario_file(out)
        with targets.new_target_file(plot, "--plot") as picture:
            with targets.new_target_file(out, "--out") as out_file:
                setup = console.load_scenario(scenario, console.add_option_overrides(changes, "tune", starts=starts))
                work = console.run_with_progress(lambda: tuning.build_work(setup), "computing the runs")
                tuned, result, sentence = _tune_and_document(work, engine)
                show_result = functools.partial(_show, result, sentence, setup, as_json)
                if not result["met"]:  # inside `with`: the exception discards the files
                    show_result()
                    _leave_if_interrupted(result)
                    unmet = tuning.describe_unmet(result["constraints"])
                    console.fail(f"{setup.name}: not met: {unmet}; {result['reason']}", console.FAILED)
                if out_file:
                    with console.show_before_errors(show_result):
                        out_file.write_text(dump(setup.with_loop(tuned.loop, "tuned")), encoding="utf-8")
            # The scenario is in place: a picture that cannot be drawn does not cost it.
            result["files"] |= {"out": str(out)} if out else {}
            if picture:
                with console.show_before_errors(show_result):
                    result |= _draw_unless_interrupted(work, tuned, picture, result["interrupted"])
                result["files"] |= {"plot": str(plot)} if picture.exists() else {}
        show_result()
        _leave_if_interrupted(result)


def _leave_if_interrupted(result: JsonObject) -> None:
    """Raise typer.Exit after Ctrl-C: the result shown is the best so far."""
    if result["interrupted"]:
        unmet = tuning.describe_unmet(result["constraints"])
        line = "interrupted: this is the best so far, not a minimum"
        console.say(f"{line}; not met: {unmet}, so that no file is written" if unmet else line)
        raise typer.Exit(console.INTERRUPTED)


def _show(result: JsonObject, sentence: str, scenario: Scenario, as_json: bool) -> None:
    show.as_json(result) if as_json else show.show_tuning(result, scenario)
    console.say(sentence)


def _tune_and_document(work: Work, engine: str) -> tuple["Tuned", JsonObject, str]:
    """Return the tuning, its JSON document and a sentence on the certificate.

    After Ctrl-C the document lacks the parts that are not computed yet.
    """
    tuned, interrupted = _tune_with_progress(work, engine)
    after = work.scenario.with_loop(tuned.loop, "tuned")
    try:
        proved = console.run_with_progress(lambda: certify_result(after), "certifying the result")
        result = console.run_with_progress(lambda: _document(work, tuned, proved), "comparing before and after")
    except KeyboardInterrupt:
        interrupted, proved = True, without_certificate("interrupted")
        result = tuning.with_unproved(work, _document(work._replace(task=None), tuned, proved))
    return tuned, {**result, "interrupted": interrupted}, proved.sentence


def _document(work: Work, tuned: "Tuned", proved: Proved) -> JsonObject:
    packages = ("optax", "scipy", *(("cvxpy", "clarabel") if proved.certified else ()))
    return result_document("tune", work.scenario, tuning.describe_tuning(work, tuned, proved), *packages)


def _draw_unless_interrupted(work: Work, tuned: "Tuned", picture: pathlib.Path, interrupted: bool) -> JsonObject:
    """Draw the tuning, and return the document's entry "interrupted", which Ctrl-C changes to true."""
    try:
        console.run_with_progress(lambda: _draw(work, tuned, picture), "drawing")
    except KeyboardInterrupt:
        picture.unlink()
        interrupted = True
    return {"interrupted": interrupted}


def _tune_with_progress(work: Work, engine: str) -> tuple["Tuned", bool]:
    """Return the tuning, and True if Ctrl-C ended it. Raises typer.Exit if no start can be used."""
    from diffabs import tune

    history = list["TuningProgress"]()
    ending = console.InterruptibleEnd("the evaluation in hand", nothing=lambda: not history)
    # With constraints the number of rounds is unknown.
    max_iterations = None if work.constraints else work.scenario.tune.iterations
    problem, method = tuning.build_tuning(work, engine), tuning.build_method(work)
    engines.choose_engine(problem.find_engine)

    def run_tuning() -> "Tuned":
        return tune.tune(problem, method=method, progress=history.append, stopping=ending)

    try:
        return console.run_with_progress(
            run_tuning, f"tuning {work.scenario.name}", lambda: _format_progress(history, max_iterations), ending
        ), ending.is_requested
    except tune.StartError as error:
        console.fail(f"{work.scenario.name}: no start can be used: {error}", console.FAILED)


def _format_progress(history: "list[TuningProgress]", max_iterations: int | None = None) -> progress.WorkProgress:
    """Return the progress on one line; `max_iterations` is the greatest number of iterations, None if unknown."""
    if not history:
        return progress.WorkProgress(progress.COMPILING)
    last, total = history[-1], len(history)
    words = (
        f"loss {last.point.loss:.6g}, gradient {last.point.gradient:.2g}, violation {last.point.violation:.2g},"
        f" {total} evaluations, {last.starts} under way"
    )
    return progress.WorkProgress(words, max(step.point.iteration for step in history), max_iterations, at_most=True)


def _draw(work: Work, tuned: "Tuned", path: pathlib.Path) -> None:
    from diffabs.output.plot.tuning import draw_worst_run

    draw_worst_run(work, tuned).savefig(path)
