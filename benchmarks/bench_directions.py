"""From how many inputs of a run XLA's reverse mode costs less than a kernel's Jacobian (`deferred.MAX_DIRECTIONS`).

A braking quarter car on a road of n tabulated friction values: value_and_grad of the mean stopping distance of some
runs by all n values. The kernel computes n forward directions, eight in a launch; XLA computes one vector-Jacobian
product. Both in one process, in turn, in processor seconds; medians over rounds. Prints a table, writes JSON with
machine and versions. With `--rtol` the steps are adaptive, and a kernel's backward sweep is measured, too.

    python benchmarks/bench_directions.py [--inputs 8 32 64 128] [--runs 256] [--rounds 5] [--rtol 1e-5]
"""

import argparse
import pathlib
import time

import jax
import jax.numpy as jnp
import numpy as np
import record
from bench_one_call import processor_time
from rich.console import Console
from rich.table import Table

import diffabs as d
from diffabs import objectives, plants, roads, stops
from diffabs.engine.drive import deferred
from diffabs.scenario.defaults import braking

NEVER = 1 << 30
MEASURED = {"distance": objectives.StopDistance()}


def mean_distance(inputs, runs, rtol=None):
    """Return the mean distance as a function of the friction values, and these values."""
    solver = d.Adaptive(rtol, 1.0) if rtol else d.FixedStep(1e-3, 1.0)
    slips = np.linspace(0.0, 1.0, inputs)
    friction = jnp.asarray(np.sin(2.0 * np.arctan(10.0 * slips)) * 0.4 + 0.5 * slips / (0.1 + slips))
    car = braking(
        plant=plants.QuarterCar(road=roads.Tabulated(slip=slips, mu=friction)),
        initial=d.BrakeStart(speed=10.0),
        stop=stops.SpeedReached(speed=5.0),
    )
    masses = jnp.linspace(14.0, 16.0, runs)

    def mean(friction):
        def distance(mass):
            loop = d.replace(car, {"plant.mass": mass, "plant.road.mu": friction})
            return d.measure(loop, solver, MEASURED).metrics["distance"]

        return jnp.mean(jax.vmap(distance)(masses))

    return mean, friction


def compile_gradient(mean, friction, limit, sweeps):
    """Return the compiled value and gradient, and its first seconds.

    A kernel makes it by sweeps from `sweeps` inputs on, and else by its Jacobian up to `limit` inputs.
    """
    deferred.MAX_DIRECTIONS, deferred.MIN_SWEEP_INPUTS, begun = limit, sweeps, time.process_time()
    call = jax.jit(lambda x: jax.value_and_grad(mean)(x)).lower(friction).compile()
    jax.block_until_ready(call(friction))
    return (lambda: jax.block_until_ready(call(friction))), time.process_time() - begun


def main() -> None:
    """Measure, print a table, and write JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--inputs", type=int, nargs="+", default=[8, 32, 64, 128])
    parser.add_argument("--runs", type=int, default=256)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--rtol", type=float, help="of adaptive steps; without it they are fixed")
    parser.add_argument("--out", type=pathlib.Path)
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    rows, table = {}, Table("inputs", "kernel, first [s]", "XLA, first [s]", "kernel [s]", "XLA [s]", "kernel/XLA")
    for inputs in options.inputs:
        mean, friction = mean_distance(inputs, options.runs, options.rtol)
        calls, first = {}, {}
        ways = {"kernel": (inputs, NEVER), "xla": (0, NEVER)} | ({"sweep": (0, 0)} if options.rtol else {})
        for engine, limits in ways.items():
            calls[engine], first[engine] = compile_gradient(mean, friction, *limits)
        gradients = [np.asarray(call()[1]) for call in calls.values()]
        for gradient in gradients[1:]:
            np.testing.assert_allclose(gradient, gradients[0], rtol=1e-7, atol=1e-12)
        taken = record.in_turn(
            {key: lambda call=call: processor_time(call) for key, call in calls.items()}, options.rounds
        )
        later = {engine: float(np.median(seconds)) for engine, seconds in taken.items()}
        rows[inputs] = {"first": first, "later": later}
        numbers = (first["kernel"], first["xla"], later["kernel"], later["xla"], later["kernel"] / later["xla"])
        table.add_row(str(inputs), *(f"{number:.3g}" for number in numbers))
        print(inputs, rows[inputs], flush=True)
    Console(width=110).print(table)
    print(record.written("directions", {**vars(options), "out": None, "rows": rows}, options.out, ("jaxlib", "numpy")))


if __name__ == "__main__":
    main()
