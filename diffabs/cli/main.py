"""The command `diffabs`: the program, and its command `simulate`.

Exit status: 0 done; 1 the answer is no (not proved, not stable), or not possible (diverged, no gain); 2 bad input; 130
interrupted. Results go to stdout, as tables or with --json as one JSON document. Everything else goes to stderr.
"""

import gc

COLLECTS = gc.isenabled()
gc.disable()  # during imports: collections would scan all of JAX's objects, a sixth of a short command's time

import contextlib
import dataclasses
import math
import pathlib
from collections.abc import Iterator
from typing import Annotated, NoReturn

import jax
import typer

from diffabs import __version__
from diffabs.cli import (
    catalogue,
    compare,
    compile,
    console,
    design,
    explore,
    export,
    identify,
    margins,
    prove,
    rare,
    report,
    reproduce,
    show,
    sweep,
    targets,
    tune,
    usage,
)
from diffabs.core import jax_flags
from diffabs.core.pytree import parameters
from diffabs.core.types import JsonObject, Key
from diffabs.engine.faults import describe_faults
from diffabs.engine.matlab import write_mat
from diffabs.engine.run import measure, rollout
from diffabs.engine.sliding import describe_slide
from diffabs.engine.types import Adaptive, Run, describe_solver
from diffabs.host import compilation_cache, interrupt, provenance
from diffabs.host.values import ScenarioError
from diffabs.loop.checking import check_run_accuracy, describe_check, describe_loose_metrics
from diffabs.parts.objectives import at_limits
from diffabs.scenario import model
from diffabs.scenario.scenario import Scenario

if COLLECTS:
    gc.enable()

app = typer.Typer(
    no_args_is_help=True,
    cls=usage.Group,
    context_settings={"help_option_names": ["-h", "--help"]},
    rich_markup_mode=None,  # plain help, for scripts and people
    pretty_exceptions_enable=False,
    help="Simulate, differentiate, tune and certify controllers for braking wheels and balancing two-wheelers.",
)

AT_LIMIT = "at a limit\n"  # key among a run's objectives; the names in a scenario have no line break
WARNED_LIMIT_SHARE = 0.5  # share of time at a limit, above which a run gets a warning
# A command's own arithmetic, whatever the environment says for other programs: without compilation it would take hours.
JAX_FLAGS = {**jax_flags.DEFAULTS, "disable_jit": False, "enable_checks": False}
MAX_CSV_ROWS = 20_000  # of a trajectory


def main() -> NoReturn:
    """Run the command line, and exit. This is the executable `diffabs`."""
    interrupt.begin_hearing()
    try:
        app()
        ending = SystemExit(0)
    except SystemExit as error:
        ending = error
    interrupt.stop_hearing()
    console.leave(ending.code)


def _version(requested: bool) -> None:
    if requested:
        typer.echo(f"diffabs {__version__}")
        raise typer.Exit


@app.callback()
def setup(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Show the version and exit.")
    ] = False,
) -> None:
    """Simulate, differentiate, tune and certify controllers for braking wheels and balancing two-wheelers."""
    del version
    compilation_cache.use_compilation_cache()
    jax.config.update("jax_enable_x64", True)
    for flag, value in JAX_FLAGS.items():
        jax.config.update(f"jax_{flag}", value)


def simulate(
    scenario: Annotated[
        str | None,
        typer.Argument(
            autocompletion=console.scenarios_like,
            help="TOML file, or name of a packaged scenario.",
            show_default=False,
        ),
    ] = None,
    changes: console.Changes = None,
    as_json: console.Json = False,
    csv: Annotated[pathlib.Path | None, typer.Option(help="Write the trajectory to this file.")] = None,
    mat: Annotated[pathlib.Path | None, typer.Option(help="Write trajectory, units and metrics for MATLAB.")] = None,
    plot: Annotated[pathlib.Path | None, typer.Option(help="Draw the run to this file (.png, .pdf, .svg).")] = None,
    seed: Annotated[
        int | None, typer.Option(help="Seed of the noise of sensors; the same as --set solver.seed=N.")
    ] = None,
    from_sweep: Annotated[
        pathlib.Path | None, typer.Option(metavar="DIR", help="Folder of a sweep; run one of its samples again.")
    ] = None,
    sample: Annotated[int | None, typer.Option(help="Number of the sample, with --from-sweep.")] = None,
    check: Annotated[
        bool, typer.Option("--check", help="Also run half and quarter steps, and show the accuracy of each metric.")
    ] = False,
) -> None:
    """Run a scenario once and show its metrics."""
    with console.end_on_errors():
        if (scenario is None) == (from_sweep is None):
            console.fail("either SCENARIO or --from-sweep DIR --sample N is needed")
        if (from_sweep is None) != (sample is None):
            console.fail("--from-sweep DIR and --sample N need each other")
        if from_sweep and (changes or seed is not None):
            console.fail("--from-sweep runs a sample unchanged: --set and --seed do not apply")
        targets.check_picture(plot)
        targets.check_mat(mat)
        keeps_trajectory = bool(csv or mat or plot)
        with contextlib.ExitStack() as files:
            csv_file = files.enter_context(targets.new_target_file(csv, "--csv"))
            mat_file = files.enter_context(targets.new_target_file(mat, "--mat"))
            picture = files.enter_context(targets.new_target_file(plot, "--plot"))
            if from_sweep and sample is not None:
                setup, key = console.run_with_progress(lambda: sweep.sample(from_sweep, sample), "reading the sweep")
            else:
                overrides = console.add_option_overrides(changes, "solver", seed=seed)
                setup = console.load_scenario(scenario or "", overrides)
                key = setup.key()
            run, limited = console.run_with_progress(
                lambda: _run(setup, key, keep=keeps_trajectory), f"simulating {setup.name}"
            )
            accuracy = (
                console.run_with_progress(lambda: _check_accuracy(setup, key), "shortening the step") if check else None
            )
            lines = describe_check(accuracy) if accuracy else _find_loose_metrics(setup, run, key, keeps_trajectory)
            result = _result(setup, run, limited)
            if from_sweep:  # the sweep's seed and the number of the sample decide the noise
                result["solver"]["seed"] = None
                result["sample"] = {"sweep": str(from_sweep), "seed": setup.sweep.seed, "number": sample}
            if accuracy:
                result["accuracy"] = accuracy
            with console.show_before_errors(lambda: _show(result, setup, as_json)):
                if csv_file:
                    show.write_csv(run, setup.loop.plant, csv_file)
                if mat_file:
                    values = {path: value for path, _, value in parameters(setup.loop)}
                    write_mat(mat_file, run, setup.loop.plant, parameters=values, scenario=setup.name)
                if picture:
                    console.run_with_progress(lambda: _draw(setup, run, picture), "drawing")
        result["files"] |= {name: str(path) for name, path in (("csv", csv), ("mat", mat), ("plot", plot)) if path}
        _show(result, setup, as_json)
        for line in lines:
            console.say(f"warning: {line}")
        slides = describe_slide(setup.loop, setup.solver, {**setup.objectives, AT_LIMIT: at_limits(setup.loop)}, run)
        _judge(setup, result, slides)


def _show(result: JsonObject, scenario: Scenario, as_json: bool) -> None:
    show.as_json(result) if as_json else show.show_run(result, scenario)
    if "accuracy" in result and not as_json:
        show.show_accuracy(result["accuracy"])


def _judge(scenario: Scenario, result: JsonObject, slides: str) -> None:
    """Write the warnings, also that the run `slides`. Raises typer.Exit for a diverged run, which has no metrics."""
    if result["diverged"]:
        why = f"{result['fault']}; there are no metrics"
        console.fail(f"{scenario.name}: {slides}" if slides else f"{scenario.name} diverged: {why}", 1)
    if slides:
        console.say(f"warning: {slides}")
    for warning in result["warnings"]:
        console.say(f"warning: {warning}")


def _warnings(scenario: Scenario, run: Run, limited: float) -> Iterator[str]:
    """Yield warnings: an unexpected end of the run, a metric never reached, a control mostly at a limit."""
    stop, stopped = scenario.loop.stop, bool(run.stopped)
    if bool(run.diverged):
        return
    if stopped != stop.success:
        otherwise = getattr(stop, "otherwise", "")
        late = f"NOT STOPPED within solver.duration = {scenario.solver.duration:g} s{otherwise and f'; {otherwise}'}"
        yield (otherwise or "STOPPED EARLY: the run reached its stop") if stopped else late
    for name in scenario.objectives:
        if math.isinf(run.metrics[name]):
            yield f"{name} is infinite: the run ends before the event that it measures"
        elif math.isnan(run.metrics[name]):
            yield f"{name} is not a number: the run lacks what it measures, as an overshoot needs a step"
    if limited > WARNED_LIMIT_SHARE:
        limits, unit = at_limits(scenario.loop), scenario.loop.plant.control_unit
        ends = f"{float(limits.low):g} to {float(limits.high):g} {unit}"
        yield f"the control is at a limit ({ends}) for {100 * limited:.0f} % of the run: gains hardly matter there"


def _run(scenario: Scenario, key: Key, keep: bool) -> tuple[Run, float]:
    """Return the run, on the host, and the share of its time with the control at a limit."""
    measured = {**scenario.objectives, AT_LIMIT: at_limits(scenario.loop)}
    if keep:
        # A file needs few rows: thin the trajectory on the device, before it takes memory.
        steps = scenario.solver.steps
        every = min(max(scenario.solver.every, math.ceil(steps / MAX_CSV_ROWS)), steps)
        run = rollout(scenario.loop, dataclasses.replace(scenario.solver, every=every), measured, key=key)
    else:
        run = measure(scenario.loop, scenario.solver, measured, key=key)
    run = jax.device_get(run)
    return run._replace(metrics={name: run.metrics[name] for name in scenario.objectives}), float(run.metrics[AT_LIMIT])


def _find_loose_metrics(scenario: Scenario, run: Run, key: Key, keep: bool) -> list[str]:
    """Return warnings of metrics that depend on `rtol`; `_run` makes a second run with the same compiled program."""
    solver = scenario.solver
    if not isinstance(solver, Adaptive) or run.diverged:
        return []
    return describe_loose_metrics(
        run.metrics, solver, lambda other: _run(dataclasses.replace(scenario, solver=other), key, keep)[0]
    )


def _check_accuracy(scenario: Scenario, key: Key) -> JsonObject:
    try:
        return check_run_accuracy(scenario.loop, scenario.solver, scenario.objectives, key)
    except ValueError as error:
        raise ScenarioError(str(error)) from None


def _draw(scenario: Scenario, run: Run, picture: pathlib.Path) -> None:
    from diffabs.output.plot import draw_run

    unit = scenario.loop.plant.control_unit
    draw_run(run, title=scenario.title or scenario.name, unit=unit).savefig(picture)


def _result(scenario: Scenario, run: Run, limited: float) -> JsonObject:
    return {
        "scenario": scenario.name,
        "metrics": {name: float(run.metrics[name]) for name in scenario.objectives},
        "stopped": bool(run.stopped),
        "diverged": bool(run.diverged),
        "fault": describe_faults(run),
        "at_limit": limited,
        "warnings": list(_warnings(scenario, run, limited)),
        "title": scenario.title,
        "parts": model.describe_parts(scenario),
        "parameters": model.describe_numbers(scenario),
        "solver": {**describe_solver(scenario.solver), "seed": scenario.seed},
        "versions": provenance.versions(),
        "files": {},
    }


usage.add_command(app, simulate, "simulate slip-lmi --set plant.mass=6.2 --plot run.png")
usage.add_command(app, design.design, "design slip-lmi --set design.decay=80 --out gain.json")
usage.add_command(app, design.certify, "certify slip-lmi --gain=-11753,-76.7")
usage.add_command(app, design.verify_certificate, "verify gain.json", "verify")
usage.add_command(app, prove.prove, "prove slip-cured --over plant.mass=5.3:6.2 --claim overshoot=0.02")
usage.add_command(app, explore.explore, "explore slip-cured --port 8342")
usage.add_command(app, margins.margins, "margins slip-cured --at speed=5 --plot loop.png")
usage.add_command(app, export.export, "export slip-cured --to c -o controller.c")
usage.add_command(app, compile.compile_scenario, "compile slip-lmi --show eliminate --by plant.mass", "compile")
usage.add_command(app, tune.tune, "tune slip-cured --set reference.time_constant=0.03 --out tuned.toml")
usage.add_command(app, identify.identify, "identify slip-lmi --data run.csv --free plant.mass=4:8")
usage.add_command(app, sweep.sweep, "sweep slip-lmi --samples 10000 --set solver.step=1e-3 --figures")
usage.add_command(app, rare.rare, "rare slip-lmi stop_time=2.2 --set solver.step=1e-3")
usage.add_command(app, compare.compare, "compare out/sweep-slip-lmi out/sweep-mine --metric iae")
usage.add_command(app, catalogue.list_parts, "list roads", "list")
usage.add_command(app, catalogue.show_scenario, "show slip-lmi --set plant.mass=6.2 --out mine.toml", "show")
usage.add_command(app, reproduce.reproduce, "reproduce slip-estimator")
usage.add_command(app, report.report, "report out -o result.html")
