"""What a user waits for at a first call, in a fresh process: trace, lowering, compilation, first run, program size.

Cases: packaged loops, with one metric; fields (two smooth ones, a heater with a switch, a bouncing ball); and by
diffrax a smooth field and a braking loop with an event, for comparison. Ways to call:

    value      one run, jit                forward    its derivative, jit(jacfwd)
    vmap       64 runs, jit(vmap)          reverse    its derivative, jit(grad)

Each row is a process of its own, without JAX's cache. `xla` is DIFFABS_ENGINE=xla. `auto` is the default with an empty
folder of kernels: its numbers include the C++ compiler. `again` is the default in a second process, which finds the
library. Times are processor seconds of the process and of the compilers that it starts, the median over rounds; a busy
machine changes elapsed times more. Prints a table, writes JSON with machine and versions.

    python benchmarks/bench_start.py [--rounds 3] [--cases NAME ...] [--ways NAME ...] [--engines xla auto again]
"""

import argparse
import json
import os
import pathlib
import resource
import statistics
import subprocess
import sys
import tempfile

import record
from rich.console import Console
from rich.table import Table

LOOPS = ("slip-lmi", "slip-cured", "slip-real", "slip-estimator", "lab-rig", "arm-hanging")
FIELDS = ("decay", "lorenz", "heater", "ball")
PEERS = ("diffrax-lorenz", "diffrax-brake")
WAYS = ("value", "vmap", "forward", "reverse")
ENGINES = ("xla", "auto", "again")
PHASES = ("trace", "lower", "compile", "run")
RUNS = 64
RTOL = 1e-6


def used() -> float:
    """Return the processor seconds of this process and of its children that have ended."""
    both = (resource.getrusage(whose) for whose in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return sum(usage.ru_utime + usage.ru_stime for usage in both)


def loop_case(name):
    """Return the first metric of a scenario as a function of its plant's first tunable number, and that number."""
    import diffabs as d
    from diffabs.core.pytree import get, parameters
    from diffabs.scenario import load

    chosen = load(name)
    tunable = [path for path, spec, value in parameters(chosen.loop) if spec.tunable and getattr(value, "ndim", 0) == 0]
    path = next((path for path in tunable if path.startswith("plant.")), tunable[0])
    metric, objective = next(iter(chosen.objectives.items()))

    def metric_of(x):
        return d.measure(d.replace(chosen.loop, {path: x}), chosen.solver, {metric: objective}).metrics[metric]

    return metric_of, float(get(chosen.loop, path))


def field_case(name):
    """Return the end of a field as a function of a parameter, and that parameter."""
    import jax.numpy as jnp

    import diffabs as d

    def lorenz(t, y, rho):
        a, b, c = y
        return 10.0 * (b - a), a * (rho - c) - b, a * b - 8 / 3 * c

    def fall(t, y, gravity):
        return y[1], -gravity

    bounce = d.Event(lambda t, y, args: y[0], lambda t, y, args: (y[0], -0.8 * y[1]))
    fields = {
        "decay": (lambda t, y, rate: -rate * y, 1.0, 2.0, (), 0.5),
        "lorenz": (lorenz, (1.0, 0.0, 0.0), 2.0, (), 28.0),
        "heater": (lambda t, y, target: jnp.where(y < target, 8.0, 4.0) - y, 0.0, 2.0, (), 3.0),
        "ball": (fall, (1.0, 0.0), 1.5, (bounce,), 9.81),
    }
    field, start, end, events, value = fields[name]

    def final(x):
        y = d.solve(field, start, 0.0, end, x, solver=d.Adaptive(RTOL), events=events).y
        return y[0] if isinstance(y, tuple) else y

    return final, value


def peer_case(name):
    """Return a result of diffrax as a function of a parameter, and that parameter."""
    import diffrax

    if name == "diffrax-brake":
        from peers.diffrax_event import one

        return lambda mass: one(mass, mass * 0.0 + 10.0, RTOL)[3], 5.7

    def lorenz(t, y, rho):
        a, b, c = y
        return 10.0 * (b - a), a * (rho - c) - b, a * b - 8 / 3 * c

    def final(rho):
        controller = diffrax.PIDController(rtol=RTOL, atol=RTOL)
        term, start = diffrax.ODETerm(lorenz), (1.0, 0.0, 0.0)
        return diffrax.diffeqsolve(
            term, diffrax.Tsit5(), 0.0, 2.0, 1e-2, start, rho, stepsize_controller=controller
        ).ys[0][-1]

    return final, 28.0


def measure_start(name: str, way: str) -> dict[str, float]:
    """Return the processor seconds of the phases of a first call in this process, and the lines of its program."""
    import jax
    import jax.numpy as jnp

    jax.config.update("jax_enable_x64", True)
    function, value = (loop_case if name in LOOPS else field_case if name in FIELDS else peer_case)(name)
    ways = {
        "value": function,
        "vmap": jax.vmap(function),
        "forward": jax.jacfwd(function),
        "reverse": jax.grad(function),
    }
    x = jnp.asarray(value) * (jnp.linspace(0.95, 1.05, RUNS) if way == "vmap" else 1.0)
    seconds, begun = {}, used()

    def phase(label: str) -> None:
        nonlocal begun
        seconds[label], begun = used() - begun, used()

    traced = jax.jit(ways[way]).trace(x)
    phase("trace")
    lowered = traced.lower()
    phase("lower")
    lines = lowered.as_text().count("\n")
    begun = used()
    compiled = lowered.compile()
    phase("compile")
    jax.block_until_ready(compiled(x))
    phase("run")
    return {**seconds, "all": sum(seconds.values()), "lines": lines}


def start_process(name: str, way: str, engine: str, folder: str) -> dict[str, float] | None:
    """Return what a process of its own measures, or None if it fails."""
    environment = {**os.environ, "DIFFABS_KERNEL_CACHE": folder, "JAX_ENABLE_COMPILATION_CACHE": "false"}
    environment["DIFFABS_ENGINE"] = "xla" if engine == "xla" else "auto"
    words = [sys.executable, __file__, "--one", name, way]
    done = subprocess.run(words, env=environment, capture_output=True, text=True, check=False)
    if done.returncode:
        print(done.stderr.strip().splitlines()[-1], file=sys.stderr)
        return None
    return json.loads(done.stdout.splitlines()[-1])


def measure_case(name: str, way: str, engines: tuple[str, ...], rounds: int) -> dict[str, dict[str, float]]:
    """Return the medians of each engine; a peer has one engine, "xla"."""
    rows: dict[str, list[dict[str, float]]] = {}
    for _ in range(rounds):
        with tempfile.TemporaryDirectory(prefix="diffabs-start-") as folder:
            for engine in ("xla",) if name in PEERS else engines:
                if measured := start_process(name, way, engine, folder):
                    rows.setdefault(engine, []).append(measured)
    return {
        engine: {key: statistics.median(row[key] for row in measured) for key in measured[0]}
        for engine, measured in rows.items()
    }


def main() -> None:
    """Measure the cases and ways, print a table, and write JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--cases", nargs="+", default=[*LOOPS, *FIELDS, *PEERS], choices=[*LOOPS, *FIELDS, *PEERS])
    parser.add_argument("--ways", nargs="+", default=WAYS, choices=WAYS)
    parser.add_argument("--engines", nargs="+", default=ENGINES, choices=ENGINES)
    parser.add_argument("--out", type=pathlib.Path)
    parser.add_argument("--one", nargs=2, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.one:
        print(json.dumps(measure_start(*options.one)))
        return
    table = Table("case", "way", "engine", *PHASES, "all", "lines of StableHLO")
    rows = {}
    for name in options.cases:
        for way in options.ways:
            rows[f"{name} {way}"] = measure_case(name, way, tuple(options.engines), options.rounds)
            for engine, row in rows[f"{name} {way}"].items():
                numbers = [f"{row[phase]:.2f}" for phase in (*PHASES, "all")]
                table.add_row(name, way, engine, *numbers, f"{row['lines']:.0f}")
    Console(width=100).print(table)
    packages = ("jaxlib", "numpy", "diffrax")
    print(record.written("start", {"rounds": options.rounds, "rows": rows}, options.out, packages))


if __name__ == "__main__":
    main()
