"""What `d.solve` costs beside a plain solve by diffrax of the same accuracy, where nothing switches and with events.

    lorenz     the Lorenz system, t from 0 to 4: no comparison, no event
    orbit      an orbit of eccentricity 0.6, t from 0 to 20: no comparison, no event
    network    20 states, two layers of tanh with random weights, t from 0 to 5: no comparison, no event
    ball       a bouncing ball with drag, 4 bounces: diffrax restarts after each one, in a scan over its event
    ball-grad  the same with the derivative of the final height by gravity, forwards on both sides

All sides take Tsitouras' method in float64, each at the loosest tolerance of its ladder whose error against a
reference is at most the one asked for. A batch is also solved by a kernel. Compiled calls are timed in turn; a ratio
is the median of those within a round. Prints a table, writes JSON with machine and versions.

    python benchmarks/bench_fields.py [--accuracy 1e-6] [--rounds 15] [--lanes 1 256]
"""

import argparse
import functools
import json
import pathlib

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import optimistix
import record
from rich.console import Console
from rich.table import Table

import diffabs as d

jax.config.update("jax_enable_x64", True)

LADDER = [10.0**-k for k in np.arange(4.0, 12.1, 0.5)]
BOUNCES, DRAG, KEEP = 4, 0.05, 0.8


def lorenz(t, y, args):
    """Return the rates of the Lorenz system."""
    x, v, z = y
    return 10.0 * (v - x), x * (args - z) - v, x * v - 8 / 3 * z


def orbit(t, y, args):
    """Return the rates of an orbit."""
    x, v = y
    return v, -args * x / jnp.sum(x * x) ** 1.5


def ball(t, y, args):
    """Return the rates of a falling ball with drag."""
    v = y[1]
    return v, -args - DRAG * v * jnp.abs(v)


SIZE = 20
_numbers = np.random.default_rng(0)
WEIGHTS = [jnp.asarray(_numbers.standard_normal((SIZE, SIZE)) / np.sqrt(SIZE)) for _ in range(2)]


def network(t, y, args):
    """Return the rates of a network with two layers."""
    return args * WEIGHTS[1] @ jnp.tanh(WEIGHTS[0] @ y + jnp.sin(t)) - y


CASES = {
    "lorenz": (lorenz, (1.0, 1.0, 25.0), 4.0, 28.0),
    "orbit": (orbit, (jnp.array([0.4, 0.0]), jnp.array([0.0, 2.0])), 20.0, 1.0),
    "network": (network, jnp.linspace(-1.0, 1.0, SIZE), 5.0, 3.0),
    "ball": (ball, (1.0, 0.0), 2.2, 9.81),
    "ball-grad": (ball, (1.0, 0.0), 2.2, 9.81),
}


def by_diffabs(case, tolerance, engine="xla"):
    """Return the function from args to the final state."""
    field, y0, end, _ = CASES[case]
    bounce = d.Event(lambda t, y, args: y[0], lambda t, y, args: (y[0], -KEEP * y[1]))
    events = [bounce] if field is ball else []

    def final(args):
        return d.solve(field, y0, 0.0, end, args, solver=d.Adaptive(tolerance), events=events, engine=engine).y

    return _with_slope(final) if case == "ball-grad" else final


def _with_slope(final):
    """Return the function from args to the final height and its derivative."""
    return lambda args: jax.jvp(lambda args: final(args)[0], (args,), (jnp.ones_like(args),))


def by_diffrax(case, tolerance):
    """Return the function from args to the final state."""
    field, y0, end, _ = CASES[case]
    y0 = jax.tree.map(jnp.asarray, y0)
    control = diffrax.PIDController(rtol=tolerance, atol=tolerance)

    def run(args, t, y, event=None):
        return diffrax.diffeqsolve(
            diffrax.ODETerm(field),
            diffrax.Tsit5(),
            t0=t,
            t1=end,
            dt0=None,
            y0=y,
            args=args,
            stepsize_controller=control,
            event=event,
            max_steps=100_000,
            adjoint=diffrax.ForwardMode(),
        )

    if field is not ball:
        return lambda args: jax.tree.map(lambda x: x[-1], run(args, 0.0, y0).ys)
    landing = diffrax.Event(lambda t, y, args, **_: y[0], optimistix.Newton(rtol=1e-12, atol=1e-12), direction=False)

    def bounces(args):
        def one(at, _):
            t, (x, v) = at
            found = run(args, t, (x, v), landing)
            x, v = jax.tree.map(lambda x: x[-1], found.ys)
            hit = found.event_mask
            return (found.ts[-1], (jnp.where(hit, 1e-12, x), jnp.where(hit, -KEEP * v, v))), None

        (t, y), _ = jax.lax.scan(one, (jnp.asarray(0.0), y0), length=BOUNCES)
        return jax.tree.map(lambda x: x[-1], run(args, t, y).ys)

    return _with_slope(bounces) if case == "ball-grad" else bounces


def measure(case, lanes, accuracy, rounds):
    """Return one row: for each side tolerance, error and time, and the ratio of the time to diffrax's."""
    centre = CASES[case][3]
    args = jnp.asarray(centre) * jnp.linspace(1.0, 1.01, lanes) if lanes > 1 else jnp.asarray(centre)
    batched = (lambda f: jax.jit(jax.vmap(f))) if lanes > 1 else jax.jit
    truth = jax.tree.leaves(batched(by_diffabs(case, 1e-12))(args))
    other = jax.tree.leaves(batched(by_diffrax(case, 1e-12))(args))
    scale = max(float(jnp.max(jnp.abs(x))) for x in truth)

    def error(found, true):
        pairs = zip(jax.tree.leaves(found), true, strict=True)
        return max(float(jnp.max(jnp.abs(a - b))) for a, b in pairs) / scale

    agreement, sides = error(other, truth), {}
    makers = {"xla": by_diffabs, "kernel": functools.partial(by_diffabs, engine="kernel"), "diffrax": by_diffrax}
    if lanes == 1:
        del makers["kernel"]
    for name, build in makers.items():
        for tolerance in LADDER:
            call = batched(build(case, tolerance))
            off = error(call(args), truth)
            if off <= accuracy:
                break
        sides[name] = {"tolerance": tolerance, "error": off, "call": call}
    takers = {
        name: lambda call=side["call"]: record.timed(lambda: jax.block_until_ready(call(args)))
        for name, side in sides.items()
    }
    times = record.in_turn(takers, rounds)
    row = {"case": case, "lanes": lanes, "references differ by": agreement}
    for name, side in sides.items():
        row[name] = {"tolerance": side["tolerance"], "error": side["error"], "ms": 1e3 * float(np.median(times[name]))}
        row[name]["ratio"] = record.ratio(times[name], times["diffrax"])
    return row


def main():
    """Measure the cases that the command line names."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--accuracy", type=float, default=1e-6)
    parser.add_argument("--rounds", type=int, default=15)
    parser.add_argument("--lanes", type=int, nargs="+", default=[1, 256])
    parser.add_argument("--cases", nargs="+", default=list(CASES))
    parser.add_argument("--out", type=pathlib.Path)
    asked = parser.parse_args()
    rows = [measure(case, lanes, asked.accuracy, asked.rounds) for case in asked.cases for lanes in asked.lanes]
    table = Table("case", "lanes", "", "ms", "rtol", "error", "times diffrax")
    for row in rows:
        for name in ("xla", "kernel", "diffrax"):
            if name in row:
                numbers = [f"{row[name][key]:.2g}" for key in ("ms", "tolerance", "error", "ratio")]
                table.add_row(row["case"], str(row["lanes"]), name, *numbers)
    console = Console()
    console.print(table)
    packages = ("jaxlib", "numpy", "diffrax", "equinox")
    path = record.written("fields", {"rows": rows}, asked.out, packages)
    told = json.loads(path.read_text(encoding="utf-8"))
    console.print(told["machine"], told["versions"], f"written to {path}")


if __name__ == "__main__":
    main()
