"""The command `rare`: the probability of a failure that is too rare for a sweep.

It needs the extra `sweep`, which is imported only when the command runs.
"""

import dataclasses
from typing import TYPE_CHECKING, Annotated

import typer

from diffabs.cli import console, progress, show, show_samples
from diffabs.cli import engine as engines
from diffabs.host.values import ScenarioError
from diffabs.scenario import section_sweep
from diffabs.scenario.model import result_document

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
        from diffabs.uncertainty.reliability.failure import choose_metric_engine, describe_failures

        setup = console.load_scenario(scenario, console.add_option_overrides(changes, "sweep", seed=seed))
        show_samples.say_unused_seed(setup)
        metric, bound = section_sweep.read_failure(failure, setup)
        if samples < 20 or samples % 10:
            console.fail(f"--samples {samples} is not a multiple of 10 in [20, inf)")
        study = section_sweep.build_study(setup)
        study = dataclasses.replace(study, engine=engine)
        try:
            study = engines.choose_engine(lambda: choose_metric_engine(study, metric))
        except ValueError as error:
            raise ScenarioError(str(error)) from None
        event = _estimate(study, metric, bound, samples, gradients)
        values = describe_failures(event, study, metric, bound)
        result = result_document("rare", setup, values, "numpy", "scipy")
        show.show_result(as_json, show_samples.show_rare_event, result, setup)


def _estimate(study: "Study", metric: str, bound: float, samples: int, gradients: bool) -> "RareEvent":
    """Return the probability. Raises ScenarioError for a wrong task, typer.Exit if too many runs diverge."""
    from diffabs.uncertainty.reliability.failure import failure_probability
    from diffabs.uncertainty.reliability.importance_sampling import DivergenceError
    from diffabs.uncertainty.reliability.subset_simulation import describe_levels

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
        console.say(f"interrupted: {metric} {describe_levels(levels)}")
        raise typer.Exit(console.INTERRUPTED) from None
    except DivergenceError as error:
        console.fail(str(error), console.FAILED)
    except ValueError as error:
        raise ScenarioError(str(error)) from None
