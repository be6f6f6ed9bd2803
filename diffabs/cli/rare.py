"""The command `rare`: the probability of a failure that is too rare for a sweep.

It needs the extra `sweep`, which is imported only when the command runs.
"""

import dataclasses
import math
from typing import TYPE_CHECKING, Annotated

import typer

from diffabs.cli import console, progress, show, show_samples
from diffabs.cli import engine as engines
from diffabs.core.pytree import ParameterSpec
from diffabs.host.values import ScenarioError, read_number, unknown_name_error
from diffabs.scenario import section_sweep
from diffabs.scenario.registry import unit_of
from diffabs.scenario.scenario import Scenario
from diffabs.scenario.toml import parse_value

if TYPE_CHECKING:
    from diffabs.uncertainty.reliability.subset_simulation import RareEvent, SubsetProgress
    from diffabs.uncertainty.sweep import Study


def rare(
    scenario: console.ScenarioName,
    failure: Annotated[
        str, typer.Argument(metavar="METRIC[=BOUND]", help="Metric and bound; default: the bound in [sweep.failures].")
    ],
    changes: console.Changes = None,
    samples: Annotated[int, typer.Option(help="Runs of each level, a multiple of 10.")] = 2800,
    seed: Annotated[int | None, typer.Option(help="Seed of the samples; the same as --set sweep.seed=N.")] = None,
    gradients: Annotated[
        bool, typer.Option("--gradients", help="Also sample around points of failure that gradients find.")
    ] = False,
    engine: engines.Engine = "auto",
    as_json: console.Json = False,
) -> None:
    """Compute the probability that a metric exceeds a bound.

    Parameters vary as [sweep.over] says. Probabilities below 1e-7 are feasible."""
    with console.end_on_errors():
        console.need_extra("sweep")
        from diffabs.uncertainty.reliability.failure import describe_failures, find_metric_objection

        setup = console.load_scenario(scenario, console.add_option_overrides(changes, "sweep", seed=seed))
        show_samples.say_unused_seed(setup)
        metric, bound = _read_failure(failure, setup)
        if samples < 20 or samples % 10:
            console.fail(f"--samples {samples} is not a multiple of 10 in [20, inf)")
        study = section_sweep.build_study(setup)
        try:
            usable = engines.choose_engine(engine, lambda: find_metric_objection(study, metric))
            study = dataclasses.replace(study, engine=usable)
        except ValueError as error:
            raise ScenarioError(str(error)) from None
        event = _estimate(study, metric, bound, samples, gradients)
        values = describe_failures(event, study, metric, bound)
        result = console.document("rare", setup, values, "numpy", "scipy")
        show.as_json(result) if as_json else show_samples.show_rare_event(result, setup)


def _read_failure(text: str, scenario: Scenario) -> tuple[str, float]:
    """Return a metric and its bound in SI. Raises ScenarioError."""
    metric, equals, bound = text.partition("=")
    if metric not in scenario.objectives:
        raise unknown_name_error(f"{metric} is not a metric of this scenario", metric, scenario.objectives)
    if equals:
        spec = ParameterSpec(unit_of(scenario.objectives[metric], scenario.loop.plant))
        value = read_number(parse_value(bound.strip()), spec, metric)
        if not math.isfinite(value):
            raise ScenarioError(f"{metric} = {value:g} is outside {spec.interval()}")
        return metric, value
    if metric not in scenario.sweep.failures:
        raise ScenarioError(f"{metric} has no bound in [sweep.failures]: say {metric}=BOUND")
    return metric, scenario.sweep.failures[metric]


def _estimate(study: "Study", metric: str, bound: float, samples: int, gradients: bool) -> "RareEvent":
    """Return the probability. Raises ScenarioError for a wrong task, typer.Exit if too many runs diverge."""
    from diffabs.uncertainty.reliability.failure import failure_probability
    from diffabs.uncertainty.reliability.importance_sampling import DivergenceError

    levels: list[SubsetProgress] = []

    def far() -> str:
        if not levels:
            return f"level 1, {progress.COMPILING}"
        return f"level {len(levels) + 1}, {levels[-1].evaluations:,} runs, {metric} up to {levels[-1].threshold:.4g}"

    try:
        return console.run_with_progress(
            lambda: failure_probability(
                study, metric, bound, gradients=gradients, samples=samples, seed=study.seed, progress=levels.append
            ),
            "looking for failures",
            far,
        )
    except KeyboardInterrupt:
        if not levels:
            raise
        probability, last = math.prod(level.share for level in levels), levels[-1]
        reached = f"{metric} {'>' if last.strict else '>='} {last.threshold:.4g}"
        estimate = f"{reached} has a probability of about {probability:.2g}"
        console.say(f"interrupted: {estimate}, by {last.evaluations:,} runs")
        raise typer.Exit(console.INTERRUPTED) from None
    except DivergenceError as error:
        console.fail(str(error), console.FAILED)
    except ValueError as error:
        raise ScenarioError(str(error)) from None
