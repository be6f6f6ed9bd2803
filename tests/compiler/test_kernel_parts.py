"""Every packaged scenario, and every part of tests/support/parts.py in a loop, by a kernel and by XLA."""

import dataclasses

import jax
import numpy as np
import parts
import pytest
from kernels import FOLDER, both, same
from seams import replace_seam

import diffabs as d
from diffabs import scenario
from diffabs.compiler.runtime import library_cache
from diffabs.core.pytree import get
from diffabs.parts.objectives import default_objectives
from diffabs.scenario.defaults import balancing, braking

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("kernel parts")]

VARIED = {"arm-balance": "initial.theta", "arm-hanging": "initial.theta", "quadruple-tank": "initial.level_1"}
LANES, SPREAD = 12, 0.04
OF_BALANCES = (*parts.BALANCES, "leaning", "voltage", "balance feedback", "observer feedback", "upright", "angles")
FAMILIES = ("road", "plant", "initial", "controller", "reference", "actuator", "sensor", "feedforward", "stop")
CASES = [(family, name) for family in FAMILIES for name in parts.PARTS[family]]
LOTTERY = [("actuator", "series", "adaptive")]  # which of its lanes diverge is the last bit's to say, in XLA as well
SOLVERS = {"fixed": d.FixedStep(1e-3, 0.12), "adaptive": d.Adaptive(rtol=1e-6, duration=0.12, step=1e-3)}
# What a lane's step sequence may make of its last bit, with steps that end on kinks: the solver's own reproducibility.
CLOSE = {"fixed": {"rtol": 1e-13, "atol": 1e-14}, "adaptive": {"rtol": 1e-7, "atol": 1e-9}}

# CUDA's elementary functions and fused products differ from XLA's in the last digits.
LOOSER = 10 if jax.default_backend() == "gpu" else 1

# In XLA a last digit of the initial speed changes the final slip error by 8e-12 of slip-real, and of extremum seeking,
# which waits for a peak to have passed, by 8e-8 and the IAE by 9e-9. Relays that chatter at a valve pass a last digit
# on to the slip at the end of a run.
LAST_DIGIT = {
    **{
        (f"literature-{source}", "fixed"): {"rtol": 1e-10, "atol": 2e-11}
        for source in ("mathworks", "staroletov", "vipulsree", "villena")
    },
    ("literature-staroletov", "adaptive"): {"rtol": 1e-5, "atol": 1e-9},
    ("slip-real", "fixed"): {"rtol": 1e-13, "atol": 2e-11},
    ("extremum seeking", "adaptive"): {"rtol": 1e-7, "atol": 2e-7},
}


@pytest.fixture(autouse=True)
def _own_folder(monkeypatch):
    monkeypatch.setenv(library_cache.CACHE, FOLDER)
    replace_seam(monkeypatch, "vectors_per_block", 2)


def close(name, kind):
    """How close two engines are, of a part or a scenario."""
    return {key: LOOSER * bound for key, bound in LAST_DIGIT.get((name, kind), CLOSE[kind]).items()}


def with_part(family, name):
    """A loop with this part, and what is varied in it."""
    part = parts.PARTS[family][name]
    if family == "road":
        return braking(plant=dataclasses.replace(braking().plant, road=part)), "initial.speed"
    balance = name in OF_BALANCES or (family == "stop" and name == "fallen")
    loop = balancing() if balance else braking()
    return dataclasses.replace(loop, **{family: part}), "initial.theta" if balance else "initial.speed"


@pytest.mark.parametrize("kind", SOLVERS)
@pytest.mark.parametrize(("family", "name"), CASES, ids=map("-".join, CASES))
def test_a_part(family, name, kind):
    if (family, name, kind) in LOTTERY:
        pytest.skip("1e-15 of its speed decides which lanes diverge")
    loop, path = with_part(family, name)
    values = {path: np.asarray(get(loop, path), float) * np.linspace(1 - SPREAD, 1 + SPREAD, LANES) + 1e-3}
    same(*both(loop, values, SOLVERS[kind], default_objectives(loop.plant), np.arange(LANES)), **close(name, kind))


@pytest.mark.parametrize("kind", SOLVERS)
@pytest.mark.parametrize("name", scenario.names())
def test_a_scenario(name, kind):
    """To its end."""
    one = scenario.load(name)
    path = VARIED.get(name, "initial.speed")
    values = {path: float(get(one.loop, path)) * np.linspace(1 - SPREAD, 1 + SPREAD, LANES)}
    solver = one.solver
    if kind == "fixed" and isinstance(solver, d.Adaptive):
        pytest.skip("its own solver has adaptive steps")
    if kind == "adaptive":
        solver = d.Adaptive(rtol=1e-6, duration=solver.duration, step=solver.step)
    same(*both(one.loop, values, solver, dict(one.objectives), np.arange(LANES)), **close(name, kind))


def test_objectives():
    """All at once, of a braking wheel and of a balance."""
    for loop, path in ((braking(), "initial.speed"), (balancing(), "initial.theta")):
        values = {path: float(get(loop, path)) * np.linspace(1 - SPREAD, 1 + SPREAD, LANES) + 1e-3}
        mine = {n: part for n, part in parts.PARTS["objective"].items() if n.startswith("balance") == (path[-1] == "a")}
        same(*both(loop, values, SOLVERS["fixed"], mine), **close("all", "fixed"))


def test_in_single_precision():
    one = scenario.load("slip-lmi")
    values = {"plant.mass": np.linspace(5.3, 6.2, LANES)}
    with jax.enable_x64(False):
        found, expected = both(one.loop, values, one.solver, dict(one.objectives))
    assert found.metrics["iae"].dtype == np.float32
    same(found, expected, rtol=2e-4, atol=1e-6)
