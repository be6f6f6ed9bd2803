"""Runs of a scenario for the page: one, or the members of a fan; large loops in a kernel.

XLA takes 0.6 ms for each step of a car, a kernel a thirtieth of that.
"""

import operator
from typing import Any

import jax
import numpy as np

from diffabs.compiler.runtime.toolchain import NoCompiler, find_compiler
from diffabs.core.pytree import get, parameters
from diffabs.engine.drive.engine import EngineError, default_engine
from diffabs.engine.solvers import Solver
from diffabs.host.process import default_platform
from diffabs.loop.batch import Batch
from diffabs.loop.ensemble import run_batch
from diffabs.loop.result import Run
from diffabs.loop.run import rollout
from diffabs.output.explore.friction import FACTOR_PATH
from diffabs.output.explore.knobs import mass_path
from diffabs.scenario.scenario import Scenario

MANY_STATES = 12  # numbers that a loop integrates; a run of a larger one by XLA is too slow for a drag
_in_kernel: dict[Any, bool] = {}  # whether a kernel makes the runs, by the structure of the loop


def takes_kernel(scenario: Scenario) -> bool:
    """Return whether a kernel makes the runs: the loop is large, and neither its parts nor the machine forbid it."""
    if default_engine() == "xla" or default_platform() != "cpu":
        return False
    structure = jax.tree.structure(scenario.loop)
    if structure not in _in_kernel:
        states = jax.tree.leaves(jax.eval_shape(scenario.loop.start).flow())
        _in_kernel[structure] = sum(x.size for x in states) > MANY_STATES and _has_compiler()
    return _in_kernel[structure]


def run_alone(scenario: Scenario, solver: Solver) -> Run:
    """Return the run of a scenario by a solver, with its metrics and trajectory, as NumPy arrays."""
    if takes_kernel(scenario):
        try:
            run = _run_in_kernel(scenario, {}, solver, np.ones(1, bool))
        except EngineError:  # an operation without a translation
            _in_kernel[jax.tree.structure(scenario.loop)] = False
        else:
            return jax.tree.map(operator.itemgetter(0), run)
    return jax.device_get(rollout(scenario.loop, solver, scenario.objectives, key=scenario.key()))


def run_members(scenario: Scenario, values: dict[str, np.ndarray], solver: Solver, accepted: np.ndarray) -> Run:
    """Return the `accepted` runs with different `values` by path, shape (runs,), with trajectories as NumPy arrays."""
    if takes_kernel(scenario):
        return _run_in_kernel(scenario, values, solver, accepted)
    batch = Batch(values, keys=np.arange(len(accepted)) + scenario.seed)
    return jax.device_get(run_batch(scenario.loop, batch, solver, {}, trajectories=True, accepted=accepted))


def spread_paths(scenario: Scenario) -> list[str]:
    """Return the paths in which the members of a fan may differ: a mass and the friction factor, if there are any."""
    paths = {path for path, _, _ in parameters(scenario.loop)}
    return [path for path in (mass_path(scenario), FACTOR_PATH) if path in paths]


def _run_in_kernel(scenario: Scenario, values: dict[str, np.ndarray], solver: Solver, accepted: np.ndarray) -> Run:
    # One run and a fan have the same columns and objectives, so that they share a compiled program.
    count = len(accepted)
    shared = {path: np.full(count, float(get(scenario.loop, path))) for path in spread_paths(scenario)}
    batch = Batch(shared | values, keys=np.arange(count) + scenario.seed)
    run = run_batch(
        *(scenario.loop, batch, solver, scenario.objectives),
        trajectories=True,
        accepted=accepted,
        engine="kernel",
    )
    return jax.device_get(run)


def _has_compiler() -> bool:
    try:
        find_compiler()
    except NoCompiler:
        return False
    return True
