"""The command `diffabs`: the program with all its commands.

Exit status: 0 done; 1 the answer is no (not proved, not stable), or not possible (diverged, no gain); 2 bad input; 130
interrupted. Results go to stdout, as tables or with --json as one JSON document. Everything else goes to stderr.
"""

import gc

COLLECTS = gc.isenabled()
gc.disable()  # during imports: collections would scan all of JAX's objects, a sixth of a short command's time

from typing import Annotated, NoReturn

import jax
import typer

from diffabs import __version__
from diffabs.cli import (
    assess,
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
    simulate,
    sweep,
    tune,
    usage,
    verify,
)
from diffabs.core import jax_flags
from diffabs.host import compilation_cache, interrupt

if COLLECTS:
    gc.enable()

app: typer.Typer = typer.Typer(
    no_args_is_help=True,
    cls=usage.Group,
    context_settings={"help_option_names": ["-h", "--help"]},
    rich_markup_mode=None,  # plain help, for scripts and people
    pretty_exceptions_enable=False,
)

# A command's own arithmetic, whatever the environment says for other programs: without compilation it would take hours.
JAX_FLAGS: dict[str, bool | str] = {**jax_flags.DEFAULTS, "disable_jit": False, "enable_checks": False}


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


usage.add_command(app, simulate.simulate, "simulate slip-lmi --set plant.mass=6.2 --plot run.png")
usage.add_command(app, design.design, "design slip-lmi --set design.decay=80 --out gain.json")
usage.add_command(app, design.certify, "certify slip-lmi --gain=-11753,-76.7")
usage.add_command(app, verify.verify_certificate, "verify gain.json", "verify")
usage.add_command(app, prove.prove, "prove slip-cured --over plant.mass=5.3:6.2 --claim overshoot=0.02")
usage.add_command(app, explore.explore, "explore slip-cured --port 8342")
usage.add_command(app, margins.margins, "margins slip-cured --at speed=5 --plot loop.png")
usage.add_command(app, export.export, "export slip-cured --to c -o controller.c")
usage.add_command(app, compile.compile_scenario, "compile slip-lmi --show eliminate --by plant.mass", "compile")
usage.add_command(app, tune.tune, "tune slip-cured --set reference.time_constant=0.03 --out tuned.toml")
usage.add_command(app, identify.identify, "identify slip-lmi --data run.csv --free plant.mass=4:8")
usage.add_command(app, sweep.sweep, "sweep slip-lmi --samples 10000 --set solver.step=1e-3 --figures")
usage.add_command(app, rare.rare, "rare slip-lmi stop_time=2.2 --set solver.step=1e-3")
usage.add_command(app, assess.assess_brakes, "assess half-car --load 500", "assess")
usage.add_command(app, compare.compare, "compare out/sweep-slip-lmi out/sweep-mine --metric iae")
usage.add_command(app, catalogue.list_parts, "list roads", "list")
usage.add_command(app, catalogue.show_scenario, "show slip-lmi --set plant.mass=6.2 --out mine.toml", "show")
usage.add_command(app, reproduce.reproduce, "reproduce slip-estimator")
usage.add_command(app, report.report, "report out -o result.html")
