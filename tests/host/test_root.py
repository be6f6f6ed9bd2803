"""Names of the package's root: what they are, what they load, and what a wrong use of them says."""

import subprocess
import sys

import pytest
from marks import cases
from mutants import killed_by

import diffabs as d
from diffabs import controllers, plants, tune
from diffabs.parts.objectives import IAE, Overshoot
from diffabs.scenario.registry import register_parts
from diffabs.scenario.scenario import load
from diffabs.uncertainty.sweep.distributions import Uniform
from diffabs.uncertainty.sweep.study import Study
from diffabs.uncertainty.sweep.variables import Space

SOLVER = d.FixedStep(1e-3, 0.01)
HEAVY = ("optax", "cvxpy", "matplotlib", "pyarrow", "scipy.optimize", "jaxtyping")


def python(program):
    return subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True).stdout.strip()


def test_the_root_loads_no_extra():
    """In a process of its own: the import, and a look at every name, load no library that only some commands need."""
    program = (
        f"import sys, diffabs as d; [getattr(d, n) for n in dir(d)]; print([m for m in {HEAVY} if m in sys.modules])"
    )
    assert python(program) == "[]"


@pytest.mark.parametrize(
    "first", cases(["import diffabs.tune, diffabs.uncertainty.sweep", "d.tune, d.sweep"], "d.tune, d.sweep")
)
@pytest.mark.slow
def test_packages_are_the_same_whatever_comes_first(first):
    program = f"""
import sys, diffabs as d
{first}
from diffabs.tune import tune
import diffabs.tune as package, diffabs.uncertainty.sweep as other
from diffabs.uncertainty.sweep import Study
print(d.tune is package, d.sweep is other, d.tune.tune is tune, d.sweep.Study is Study, callable(d.tune))
"""
    assert python(program) == "True True True True True"


def test_functions_of_the_root():
    assert d.load is load
    assert d.register_parts is register_parts
    assert d.linear.linearize.__module__ == "diffabs.linear.linearization"
    assert {"load", "tune", "sweep", "linear", "register_parts"} <= set(dir(d))


def message(function, *args, error=ValueError, **options):
    with pytest.raises(error) as caught:
        function(*args, **options)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_calls_with_a_loop_in_the_place_of_a_task():
    assert message(d.tune, d.braking()).startswith("problem = Loop is no Problem; build_problem(loop, free=")
    assert message(tune.tune, 3).startswith("problem = 3 is no Problem; ")
    assert message(d.sweep, d.braking(), "x").startswith("study = Loop is no Study; Study(loop=")
    with pytest.raises(AttributeError, match=r"a run is d\.rollout\(loop, solver\)"):
        _ = d.simulate


@killed_by("core.pytree", "if isinstance(part, type):", "if False:")
@pytest.mark.parametrize(
    ("parts", "line"),
    [
        ({"controller": controllers.PID}, "controller = PID is a class; PID(...) is needed"),
        ({"plant": plants.QuarterCar}, "plant = QuarterCar is a class; QuarterCar(...) is needed"),
        (
            {"controller": controllers.PID(antiwindup=controllers.Clamping)},
            "controller.antiwindup = Clamping is a class; Clamping(...) is needed",
        ),
    ],
    ids=["controller", "plant", "antiwindup"],
)
def test_a_class_in_the_place_of_a_part(parts, line):
    loop = d.braking(**parts)
    assert message(d.rollout, loop, SOLVER) == line
    assert message(d.check, loop, SOLVER) == line
    assert message(d.run_batch, loop, d.Batch({"plant.mass": [5.0, 6.0]}), SOLVER) == line
    assert message(d.linear.open_loop, loop) == line
    given = {"free": ["controller.kp"], "objective": {"iae": 1.0}, "solver": SOLVER}
    assert message(tune.build_problem, loop, **given) == line
    space = Space({"plant.mass": Uniform(5.0, 6.0)})
    assert message(Study(loop=loop, space=space, samples=4, solver=SOLVER, objectives={"iae": IAE()}).check) == line


@killed_by("loop.result", 'if name in self.metrics else f"; {metrics}"', 'if False else f"; {metrics}"')
def test_a_metric_that_is_asked_of_the_run():
    run = d.measure(d.braking(), SOLVER, {"iae": IAE(), "overshoot": Overshoot()})
    assert message(lambda: run.iae, error=AttributeError) == 'a Run has no field iae; run.metrics["iae"] is a metric'
    line = message(lambda: run.stop_distance, error=AttributeError)
    assert line == "a Run has no field stop_distance; its metrics are iae, overshoot"
    assert not hasattr(run, "_ipython_display_")
