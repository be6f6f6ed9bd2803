"""What `d.solve` costs beside a plain solve by diffrax of the same accuracy, where nothing switches and with events.

    lorenz     the Lorenz system, t from 0 to 4: no comparison, no event
    orbit      an orbit of eccentricity 0.6, t from 0 to 20: no comparison, no event
    ball       a bouncing ball with drag, 4 bounces: diffrax restarts after each one, in a scan over its event

Both sides take Tsitouras' method in float64, each at the loosest tolerance of its ladder whose error against a
reference is at most the one asked for. Compiled calls are timed in turn; a ratio is the median of those within
a round. Prints a table, writes JSON with machine and versions.

    python benchmarks/bench_fields.py [--accuracy 1e-6] [--rounds 15] [--lanes 1 256]
"""

import argparse
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


CASES = {
    "lorenz": (lorenz, (1.0, 1.0, 25.0), 4.0, 28.0),
    "orbit": (orbit, (jnp.array([0.4, 0.0]), jnp.array([0.0, 2.0])), 20.0, 1.0),
    "ball": (ball, (1.0, 0.0), 2.2, 9.81),
}


def by_diffabs(case, tolerance):
    """Return the function from args to the final state."""
    field, y0, end, _ = CASES[case]
    bounce = d.Event(lambda t, y, args: y[0], lambda t, y, args: (y[0], -KEEP * y[1]))
    events = [bounce] if case == "ball" else []
    return lambda args: d.solve(field, y0, 0.0, end, args, solver=d.Adaptive(tolerance), events=events).y


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

    if case != "ball":
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

    return bounces


def measure(case, lanes, accuracy, rounds):
    """Return one row: for both sides tolerance, error and time, and the ratio of the times."""
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
    for name, build in (("diffabs", by_diffabs), ("diffrax", by_diffrax)):
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
    row["ratio"] = record.ratio(times["diffabs"], times["diffrax"])
    for name, side in sides.items():
        row[name] = {"tolerance": side["tolerance"], "error": side["error"], "ms": 1e3 * float(np.median(times[name]))}
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
    jax.config.update("jax_enable_x64", True)
    rows = [measure(case, lanes, asked.accuracy, asked.rounds) for case in asked.cases for lanes in asked.lanes]
    table = Table("case", "lanes", "diffabs ms", "rtol", "error", "diffrax ms", "rtol", "error", "ratio")
    for row in rows:
        numbers = [f"{row[n][k]:.2g}" for n in ("diffabs", "diffrax") for k in ("ms", "tolerance", "error")]
        table.add_row(row["case"], str(row["lanes"]), *numbers, f"{row['ratio']:.2f}")
    console = Console()
    console.print(table)
    packages = ("jaxlib", "numpy", "diffrax", "equinox")
    console.print(f"written to {record.written('fields', {'rows': rows}, asked.out, packages)}")


if __name__ == "__main__":
    main()
