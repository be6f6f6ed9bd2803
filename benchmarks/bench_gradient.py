"""What the gradient of a batch objective costs, in rollouts: forward mode in p parameters, reverse mode, and memory.

The objective is the mean over lanes (masses) of stopping distance [m] + IAE [s]. Loops:

    lmi     rig of [lmi], 50 to 5 km/h, its published gain, torque 0 to 9.03 N m
    est     quarter car of [est], 100 km/h to rest, PID, fixed slip
    latch   the same with the slip estimator

Every time is divided by that of the objective alone, `jit` of the mean of `measure`, taken in the same round: rounds
are interleaved, ratios and times are medians over them. `--quick` leaves the memory out. Prints tables, writes JSON
with machine, versions and commit.

With `--rtol R` the runs take adaptive steps, the value its own, fewer than the gradient does. With `--engine kernel`
values and forward derivatives are a kernel's, and XLA's stand beside them, alternately; there is no reverse mode.

    python benchmarks/bench_gradient.py [--lanes 256] [--rounds 9] [--loops lmi est latch] [--quick] [--rtol 1e-5]
                                        [--engine kernel] [--kinks no]
"""

import argparse
import dataclasses
import pathlib
import statistics
import time

import jax
import jax.numpy as jnp
import record
from rich.console import Console
from rich.table import Table

import diffabs as d
from diffabs import controllers, objectives, plants, references, roads, stops
from diffabs.core.pytree import get
from diffabs.scenario.defaults import braking

MEASURED = {"stop_distance": objectives.StopDistance(), "iae": objectives.IAE()}
COUNTS = (1, 2, 4, 6, 8)
MEMORY_STEPS = (1000, 2000, 4000, 8000, 16000)
FORWARD_BOUND, REVERSE_BOUND, MEMORY_BOUND = 1.5, 6.0, 2.0  # 1 + 1.5 p; 6; 2

LMI = braking(
    plant=plants.MirroredRig(),
    initial=d.BrakeStart(speed=50 / 3.6),
    stop=stops.SpeedReached(speed=5 / 3.6),
    controller=controllers.StateFeedback(low=0.0, high=9.03),
    feedforward=controllers.HoldingInput(),
)
EST = braking(
    plant=plants.QuarterCar(road=roads.MagicFormula(), inertia=1.0539),
    controller=controllers.PID(ki=5000.0, kd=5.67, low=0.0, high=90.0),
    reference=references.FixedSlip(),
)
EST_PARAMETERS = ("controller.kp", "controller.ki", "controller.kd", "controller.cutoff", "reference.slip")
EST_PARAMETERS += ("controller.high", "plant.inertia", "plant.road.D")
# loop, masses [kg], duration [s], parameters: those of the controller first, since tuning moves them.
CASES = {
    "lmi": (
        LMI,
        (5.3, 6.2),
        1.7,
        ("controller.gain", "reference.slip", "controller.high", "plant.road.w4", "plant.road.w1")
        + ("plant.wheel_inertia", "initial.speed"),
    ),
    "est": (EST, (14.0, 16.0), 3.4, EST_PARAMETERS),
    "latch": (dataclasses.replace(EST, reference=references.PeakLatch()), (14.0, 16.0), 3.4, EST_PARAMETERS),
}


def objective(name, options, duration=None, engine="xla"):
    """(logarithmic changes of p <= 8 parameters -> mean objective)."""
    loop, masses, horizon, paths = CASES[name]
    masses, duration = jnp.linspace(masses[0], masses[1], options.lanes), duration or horizon
    kinks = {"located": None, "no": False}[options.kinks]
    solver = d.Adaptive(options.rtol, duration) if options.rtol else d.FixedStep(options.step, duration, kinks=kinks)

    def mean(logs):
        factors, values = jnp.concatenate([jnp.exp(logs), jnp.ones(len(paths) + 1 - len(logs))]), {}
        for path in paths:
            value = jnp.asarray(get(loop, path))
            values[path] = value * (factors[: value.size] if value.ndim else factors[0])
            factors = factors[value.size :]
        changed = d.replace(loop, values)
        if engine == "kernel":
            lanes = d.Batch({"plant.mass": masses})
            metrics = d.run_batch(changed, lanes, solver, MEASURED, accepted=True, engine=engine).metrics
            return jnp.mean(metrics["stop_distance"] + metrics["iae"])

        def one(mass):
            metrics = d.measure(d.replace(changed, {"plant.mass": mass}), solver, MEASURED).metrics
            return metrics["stop_distance"] + metrics["iae"]

        return jnp.mean(jax.vmap(one)(masses))

    return mean


def compiled(function, count):
    """(callable without arguments, seconds of tracing and compilation, bytes of temporary memory)."""
    logs = jnp.zeros(count)
    begun = time.perf_counter()
    program = jax.jit(function).lower(logs).compile()
    seconds = time.perf_counter() - begun
    analysis = program.memory_analysis()
    return lambda: jax.block_until_ready(program(logs)), seconds, getattr(analysis, "temp_size_in_bytes", 0)


def timed(name, options):
    """Rows of one loop: {"value", "forward 1", ..., "reverse"} to medians of seconds and of ratios."""
    mean = objective(name, options, engine=options.engine)
    programs = {"value": compiled(mean, 8)}
    programs |= {"reverse": compiled(jax.grad(mean), 8)} if options.engine == "xla" else {}
    programs |= {f"forward {p}": compiled(jax.jacfwd(mean), p) for p in COUNTS}
    if options.engine == "kernel":
        known = objective(name, options)
        programs |= {"value by XLA": compiled(known, 8), "forward 2 by XLA": compiled(jax.jacfwd(known), 2)}
    times = {key: [] for key in programs}
    for r in range(options.rounds + 1):  # the first warms up
        for key, (call, _, _) in programs.items():
            begun = time.perf_counter()
            call()
            if r:
                times[key].append(time.perf_counter() - begun)
    return {
        key: {
            "run_s": statistics.median(times[key]),
            "ratio": statistics.median(a / b for a, b in zip(times[key], times["value"], strict=True)),
            "compile_s": seconds,
            "temporary_bytes": memory,
        }
        for key, (_, seconds, memory) in programs.items()
    }


def crossover(rows):
    """The number of parameters from which reverse mode is the cheaper, on the line through the forward ratios."""
    ratios = [rows[f"forward {p}"]["ratio"] for p in COUNTS]
    slope, start = statistics.linear_regression(COUNTS, ratios)
    return (rows["reverse"]["ratio"] - start) / slope


def memory(name, options):
    """{number of steps: bytes of temporary memory of the reverse gradient}."""
    sizes = {}
    for steps in MEMORY_STEPS:
        mean = objective(name, options, steps * options.step)
        sizes[steps] = compiled(jax.grad(mean), 8)[2]
    return sizes


def main():
    """Measure, print, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--lanes", type=int, default=256)
    parser.add_argument("--step", type=float, default=1e-3, help="of integration [s]")
    parser.add_argument("--rounds", type=int, default=9)
    parser.add_argument("--loops", nargs="+", choices=list(CASES), default=list(CASES))
    parser.add_argument("--rtol", type=float, help="of adaptive steps; without it they are fixed")
    parser.add_argument("--engine", choices=("xla", "kernel"), default="xla")
    parser.add_argument("--kinks", choices=("located", "no"), default="located", help="of fixed steps, in derivatives")
    parser.add_argument("--quick", action="store_true", help="leave the memory out")
    parser.add_argument("--out", type=pathlib.Path)
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    found = {}
    for name in options.loops:
        rows = timed(name, options)
        sizes = {} if options.quick or options.rtol or options.engine == "kernel" else memory(name, options)
        found[name] = {"rows": rows, "crossover": crossover(rows) if "reverse" in rows else None, "memory": sizes}
        show(name, found[name], options)
    write(found, options)


def show(name, found, options):
    """One table of times, one line of memory."""
    table = Table(title=f"{name}: {options.lanes} lanes, medians of {options.rounds} rounds")
    for heading in ("", "run [ms]", "ratio", "bound", "compile [s]", "temporary [MB]"):
        table.add_column(heading)
    for key, row in found["rows"].items():
        kind, _, count = key.removesuffix(" by XLA").partition(" ")
        bound = {"value": 1.0, "reverse": REVERSE_BOUND}.get(kind, 1 + FORWARD_BOUND * int(count or 0))
        table.add_row(
            key,
            f"{1e3 * row['run_s']:.1f}",
            f"{row['ratio']:.2f}",
            f"{bound:.1f}",
            f"{row['compile_s']:.1f}",
            f"{row['temporary_bytes'] / 1e6:.2f}",
        )
    console = Console()
    console.print(table)
    if found["crossover"] is not None:
        console.print(f"reverse mode is the cheaper from p = {found['crossover']:.1f}")
    if found["memory"]:
        sizes = ", ".join(f"{steps}: {size / 1e6:.2f} MB" for steps, size in found["memory"].items())
        spread = max(found["memory"].values()) / min(found["memory"].values())
        console.print(f"temporary memory of reverse mode by steps: {sizes}; factor {spread:.2f} <= {MEMORY_BOUND:g}")


def write(found, options):
    """JSON with machine, versions and commit."""
    kept = {"loops": found, "lanes": options.lanes, "step_s": options.step, "rtol": options.rtol}
    kept |= {"rounds": options.rounds, "device": str(jax.devices()[0])}
    kept |= {"engine": options.engine, "kinks": options.kinks}
    name = "gradient" + ("-adaptive" if options.rtol else "") + ("-kernel" if options.engine == "kernel" else "")
    path = record.written(name, kept, options.out)
    Console().print(f"written to {path}")


if __name__ == "__main__":
    main()
