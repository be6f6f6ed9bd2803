"""diffabs itself: its parts, `run_batch` as a user calls it, and the one place where a solver is chosen."""

import functools
import types

import jax.numpy as jnp

import diffabs
from diffabs import controllers, objectives, plants, stops
from diffabs.scenario.defaults import braking
from peers import on_devices, problem
from peers.ladder import LADDERS

MEASURED = {name: objectives.BRAKING[name] for name in problem.METRICS}
LOOP = braking(
    plant=plants.MirroredRig(),
    initial=diffabs.BrakeStart(speed=50 / 3.6),
    stop=stops.SpeedReached(speed=problem.STOP),
    controller=controllers.StateFeedback(low=0.0, high=problem.U),
    feedforward=controllers.HoldingInput(),
)
KINDS = ("fixed", "adaptive")


def solver(kind, setting, duration):
    """Return the solver of a kind, whose setting is a step [s] or a relative tolerance."""
    if kind == "adaptive":
        return diffabs.Adaptive(rtol=setting, duration=duration)
    return diffabs.FixedStep(setting, duration)


def prepared_with(kind, engine, masses, speeds, setting, dtype, threads=None):
    """What `prepared` of a peer returns, for a solver and an engine of diffabs. Lanes are dealt to host devices."""
    del threads
    chosen = solver(kind, setting, problem.DURATION)

    def solve(m, v):
        batch = diffabs.Batch({"plant.mass": m, "initial.speed": v})
        metrics = diffabs.run_batch(LOOP, batch, chosen, MEASURED, engine=engine).metrics
        return tuple(jnp.asarray(metrics[name]) for name in problem.METRICS)

    return on_devices.spread(solve, masses, speeds, dtype, compiled=False)


PEERS = {
    name: types.SimpleNamespace(
        TITLE=title,
        PACKAGES=("diffabs-control", "jax", "jaxlib"),
        MANY=None,
        LADDER=LADDERS[kind],
        prepared=functools.partial(prepared_with, kind, engine),
    )
    for name, title, kind, engine in (
        ("diffabs_adaptive", "diffabs, Adaptive", "adaptive", "xla"),
        ("diffabs_fixed", "diffabs, FixedStep", "fixed", "xla"),
        ("kernel_adaptive", "diffabs, Adaptive, kernel", "adaptive", "kernel"),
        ("kernel_fixed", "diffabs, FixedStep, kernel", "fixed", "kernel"),
    )
}
