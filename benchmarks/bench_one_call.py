"""The README's call and the page own-optax at 4,096 runs: values, forward and reverse derivatives, with no option.

    readme   jit(vmap(measure)) over grips of the road, and the derivative of the mean by two shared numbers
    optax    value_and_grad of the page's loss, the mean IAE of 4,096 roads by three shared numbers

Each by `auto` (no option), by `xla` (DIFFABS_ENGINE=xla, which was the only choice before), and values by `run_batch`
with `engine="kernel"`. The braking loop of `peers` by diffabs with no option, by diffrax and by a scan by hand: the
mean distance and its derivatives by two shared numbers. Their settings leave an error below 1e-4 in every run; the
greatest one is printed. Sides are timed in turn, in processor seconds, and the table has medians over the rounds.
Prints tables, writes JSON with machine and versions.

    python benchmarks/bench_one_call.py [--runs 4096] [--rounds 5] [--dtype float64]
"""

import argparse
import os
import pathlib
import time

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import record
from peers import diffrax_event, jax_scan, problem
from rich.console import Console
from rich.table import Table

import diffabs as d
from diffabs import controllers, objectives, plants, references, stops
from diffabs.scenario import load
from diffabs.scenario.defaults import braking

# Of a function of shared numbers.
READINGS = {"value": lambda f: f, "forward": jax.jacfwd, "reverse": jax.value_and_grad}
SETTINGS = {"diffabs": 1e-5, "diffrax": 1e-6, "scan": 2e-4}  # tolerances, and a step [s]: errors below 1e-4


def readme_case(runs):
    """Return the mean distance of the README's runs as a function of two shared factors, and the runs themselves."""
    rig = load("slip-lmi", ["solver.step=1e-3"])
    grips = jnp.linspace(0.3, 0.6, runs)

    def brake(grip, mass=5.3):
        loop = d.replace(rig.loop, {"plant.road.w4": grip, "plant.mass": mass})
        return d.measure(loop, rig.solver, rig.objectives).metrics

    def mean(factors):
        return jnp.mean(jax.vmap(lambda x: brake(x * factors[0], 5.3 * factors[1])["stop_distance"])(grips))

    def by_kernel():
        batch = d.Batch({"plant.road.w4": grips})
        return d.run_batch(rig.loop, batch, rig.solver, rig.objectives, engine="kernel").metrics

    return mean, jnp.ones(2), lambda: jax.vmap(brake)(grips), by_kernel


def optax_case(runs):
    """Return the loss of docs/journeys/own-optax.md over many roads, and its start."""
    rig = d.Loop(
        plant=plants.MirroredRig(),
        initial=d.BrakeStart(speed=20 / 3.6),
        stop=stops.SpeedReached(speed=15 / 3.6),
        reference=references.FilteredSlip(slip=0.2, time_constant=0.03),
        controller=controllers.StateFeedback(gain=(-11753.0, -48.0)),
        feedforward=controllers.HoldingInput(),
    )
    grips, solver, measured = jnp.linspace(0.3, 0.6, runs), d.FixedStep(1e-3, 0.5), {"iae": objectives.IAE()}

    def loss(z):
        loop = d.replace(rig, {"controller.gain": -jnp.exp(z[:2]), "reference.time_constant": jnp.exp(z[2])})
        batch = d.Batch({"plant.road.w4": grips})
        return d.run_batch(loop, batch, solver, measured).metrics["iae"].mean()

    def by_kernel():
        return d.run_batch(rig, d.Batch({"plant.road.w4": grips}), solver, measured, engine="kernel").metrics

    return loss, jnp.log(jnp.array([11753.0, 48.0, 0.03])), None, by_kernel


def brake_case(side, runs, setting, reading="value"):
    """Return the distances of the peers' problem, (runs,), as a function of two shared factors, by one side.

    diffrax needs to know the `reading`: its loop has one mode of derivatives at a time.
    """
    masses, speeds = (jnp.asarray(x, jnp.result_type(float)) for x in problem.lanes(runs))
    if side == "scan":
        return lambda factors: jax_scan.scanned(masses * factors[0], speeds * factors[1], setting)[1]
    if side == "diffrax":
        adjoint = diffrax.ForwardMode() if reading == "forward" else diffrax.RecursiveCheckpointAdjoint()
        one = jax.vmap(lambda m, v: diffrax_event.one(m, v, setting, adjoint=adjoint)[1])
        return lambda factors: one(masses * factors[0], speeds * factors[1])
    rig = braking(
        plant=plants.MirroredRig(),
        controller=controllers.StateFeedback(gain=(problem.K1, problem.K2), low=0.0, high=problem.U),
        feedforward=controllers.HoldingInput(),
        stop=stops.SpeedReached(speed=problem.STOP),
    )
    solver, measured = d.Adaptive(setting, problem.DURATION), {"distance": objectives.StopDistance()}

    def distance(mass, speed):
        loop = d.replace(rig, {"plant.mass": mass, "initial.speed": speed})
        return d.measure(loop, solver, measured).metrics["distance"]

    return lambda factors: jax.vmap(lambda m, v: distance(m * factors[0], v * factors[1]))(masses, speeds)


def compile_call(function, x, engine):
    """Return the compiled call for an engine, and its processor seconds from the trace to the first result."""
    os.environ["DIFFABS_ENGINE"] = engine
    begun = time.process_time()
    call = jax.jit(lambda x: function(x)).lower(x).compile()
    jax.block_until_ready(call(x))
    return (lambda: jax.block_until_ready(call(x))), time.process_time() - begun


def processor_time(call):
    """Return the processor seconds of a call."""
    begun = time.process_time()
    call()
    return time.process_time() - begun


def main() -> None:
    """Measure, print tables, and write JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=4096)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--dtype", default="float64", choices=["float32", "float64"])
    parser.add_argument("--engines", nargs="+", default=["auto", "xla"])
    parser.add_argument("--sides", nargs="*", default=list(SETTINGS), choices=list(SETTINGS))
    parser.add_argument("--out", type=pathlib.Path)
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", options.dtype == "float64")
    calls, starts, values, errors = {}, {}, {}, {}
    for name, case in (("readme", readme_case), ("optax", optax_case)):
        mean, x, runs, by_kernel = case(options.runs)
        for engine in options.engines:
            for reading, differentiate in READINGS.items():
                key = f"{name}, {reading}, {engine}"
                calls[key], starts[key] = compile_call(differentiate(mean), x, engine)
                values[key] = np.ravel(jax.tree.leaves(calls[key]())[-1]).astype(float).tolist()
            if runs:
                calls[f"{name}, all metrics, {engine}"], _ = compile_call(lambda _, runs=runs: runs(), x, engine)
        os.environ["DIFFABS_ENGINE"] = "auto"
        calls[f"{name}, run_batch, kernel"] = lambda by_kernel=by_kernel: jax.block_until_ready(by_kernel())
        calls[f"{name}, run_batch, kernel"]()
    if options.sides:
        exact = np.asarray(jax.jit(brake_case("diffabs", options.runs, 1e-9))(jnp.ones(2)))
    for side in options.sides:
        distances, x = brake_case(side, options.runs, SETTINGS[side]), jnp.ones(2)
        errors[side] = float(np.max(np.abs(np.asarray(jax.jit(distances)(x)) / exact - 1)))
        for reading, differentiate in READINGS.items():
            if (side, reading) == ("scan", "reverse"):
                continue  # it keeps all steps of all runs: more than 20 GB
            distances = brake_case(side, options.runs, SETTINGS[side], reading)
            key = f"brake, {reading}, {side}"
            mean = differentiate(lambda x, distances=distances: jnp.mean(distances(x)))
            calls[key], starts[key] = compile_call(mean, x, "auto")
            values[key] = np.ravel(jax.tree.leaves(calls[key]())[-1]).astype(float).tolist()
    taken = record.in_turn({key: lambda call=call: processor_time(call) for key, call in calls.items()}, options.rounds)
    table = Table("call", "first [s]", "later [s]", "last numbers")
    rows = {}
    for key, seconds in taken.items():
        rows[key] = {"first": starts.get(key), "later": float(np.median(seconds)), "result": values.get(key)}
        shown = ", ".join(f"{v:.10g}" for v in values.get(key, []))
        table.add_row(key, f"{starts[key]:.1f}" if key in starts else "", f"{rows[key]['later']:.3f}", shown)
    Console(width=110).print(table)
    print("greatest relative error of a distance:", {side: f"{error:.1e}" for side, error in errors.items()})
    packages = ("jaxlib", "numpy", "diffrax")
    print(
        record.written(
            "one-call", {**vars(options), "out": None, "errors": errors, "rows": rows}, options.out, packages
        )
    )


if __name__ == "__main__":
    main()
