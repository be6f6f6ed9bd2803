"""Public yardsticks outside brakes: the Lorenz ensemble, a bouncing ball with its gradient, Robertson's reactions.

    lorenz       the ensemble of the SciML benchmarks: sigma 10, beta 8/3, rho from 0 to 21 over the lanes, from
                 (1, 0, 0) over the time 1, by 1,000 equal RK4 steps and by adaptive steps to an error of 1e-8
    ball         4 bounces with drag: the height at the end and its derivative by gravity; diffrax restarts after each
    robertson    stiff reactions, rates 0.04, 1e4, 3e7, by explicit steps (d.solve) and by implicit ones (Kvaerno5)

The ensemble is `d.solve` under vmap, by a kernel. Beside it stand peers/lorenz.cpp, compiled by the compiler of the
kernel with its flags and again with those of peers/c.py, on as many threads; and diffrax under vmap and jit, over
blocks of lanes. The error is the greatest over the lanes that SciPy's DOP853 computes to 1e-13, relative to the
greatest state. Adaptive methods get the loosest tolerance of their ladder that is accurate. Times are taken in turn; a
ratio is the median of those within a round. On a machine that does something else only ratios mean anything.

    python benchmarks/bench_yardsticks.py [--cases lorenz ball robertson] [--lanes 768000] [--rounds 5]
"""

import argparse
import ctypes
import functools
import os
import pathlib
import statistics
from typing import Any

import bench_fields
import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import record
from peers import c, tableau
from rich.console import Console
from rich.table import Table
from scipy.integrate import solve_ivp

import diffabs as d
from diffabs.compiler.runtime import toolchain
from diffabs.engine.field import SolutionStatus

STEPS, ACCURACY, CHECKED, BLOCK = 1000, 1e-8, 256, 512
LADDER = [10.0**-k for k in np.arange(6.0, 12.1, 0.5)]
RATES = (0.04, 1e4, 3e7)  # of Robertson's reactions
SOURCE = pathlib.Path(__file__).with_name("peers") / "lorenz.cpp"


def rhos(lanes):
    """Return the parameter of each lane."""
    return np.linspace(0.0, 21.0, lanes)


def checked(lanes):
    """Return the numbers of the lanes that have a reference, and their final states (3, lanes)."""
    which = np.unique(np.linspace(0, lanes - 1, min(CHECKED, lanes)).astype(int))
    rho = rhos(lanes)[which]

    def rates(t, state):
        x, y, z = state.reshape(3, -1)
        return np.concatenate([10.0 * (y - x), x * (rho - z) - y, x * y - 8 / 3 * z])

    start = np.concatenate([np.ones(len(rho)), np.zeros(2 * len(rho))])
    found = solve_ivp(rates, (0.0, 1.0), start, method="DOP853", rtol=1e-13, atol=1e-14)
    return which, found.y[:, -1].reshape(3, -1)


def worst(found, which, truth):
    """Return the greatest error over the lanes `which`, relative to the greatest state."""
    states = np.stack([np.asarray(x) for x in found])
    return float(np.abs(states[:, which] - truth).max() / np.abs(truth).max())


def by_diffabs(kind, rho, engine="kernel"):
    """Return the function from a tolerance to the call that returns the final states (3, lanes)."""

    def prepared(tolerance):
        solver = d.FixedStep(1 / STEPS, 1.0) if kind == "fixed" else d.Adaptive(tolerance)

        def final(rho):
            return d.solve(bench_fields.lorenz, (1.0, 0.0, 0.0), 0.0, 1.0, rho, solver=solver, engine=engine).y

        call = jax.jit(jax.vmap(final))
        return lambda: jax.block_until_ready(call(rho))

    return prepared


def compiled(real, flags):
    """Return `run` of peers/lorenz.cpp."""
    lines = [f"#define REAL {real}", *(f"#define {name} REAL({x!r})" for name, x in tableau.definitions().items())]
    text = "\n".join([*lines, SOURCE.read_text(encoding="utf-8")])
    function = ctypes.CDLL(str(toolchain.build_library(text, flags))).run
    array = np.ctypeslib.ndpointer(np.float32 if real == "float" else np.float64, flags="C")
    function.argtypes = [ctypes.c_long, array, ctypes.c_long, ctypes.c_double, ctypes.c_int, array]
    function.restype = ctypes.c_long
    return function


def by_c(kind, rho, threads, flags=()):
    """Return the function from a tolerance to the call that returns the final states (3, lanes)."""
    run = compiled("float" if rho.dtype == np.float32 else "double", flags)
    out, steps = np.empty((3, len(rho)), rho.dtype), STEPS if kind == "fixed" else 0

    def prepared(tolerance):
        return lambda: (run(len(rho), rho, steps, tolerance or 0.0, threads, out), out)[1]

    return prepared


class ClassicalRK4(diffrax.AbstractERK):
    """The classical Runge-Kutta method, which diffrax does not bring."""

    tableau = diffrax.ButcherTableau(
        c=np.array([0.5, 0.5, 1.0]),
        b_sol=np.array([1 / 6, 1 / 3, 1 / 3, 1 / 6]),
        b_error=np.zeros(4),
        a_lower=(np.array([0.5]), np.array([0.0, 0.5]), np.array([0.0, 0.0, 1.0])),
    )
    interpolation_cls = diffrax.ThirdOrderHermitePolynomialInterpolation.from_k

    def order(self, terms):
        """Return the order of the method."""
        return 4


def by_diffrax(kind, rho, block):
    """Return the function from a tolerance to the call that returns the final states (3, lanes)."""

    def prepared(tolerance):
        fixed = kind == "fixed"
        control = diffrax.ConstantStepSize() if fixed else diffrax.PIDController(rtol=tolerance, atol=tolerance)

        def one(rho):
            return diffrax.diffeqsolve(
                diffrax.ODETerm(bench_fields.lorenz),
                ClassicalRK4() if fixed else diffrax.Tsit5(),
                t0=0.0,
                t1=1.0,
                dt0=1 / STEPS,
                y0=(jnp.ones_like(rho), jnp.zeros_like(rho), jnp.zeros_like(rho)),
                args=rho,
                stepsize_controller=control,
                saveat=diffrax.SaveAt(t1=True),
                max_steps=None,
                adjoint=diffrax.ForwardMode(),
            ).ys

        whole = -(-len(rho) // block) * block
        blocks = jnp.asarray(np.pad(rho, (0, whole - len(rho)), mode="edge")).reshape(-1, block)
        call = jax.jit(lambda blocks: jax.lax.map(jax.vmap(one), blocks))
        return lambda: [np.reshape(x, -1)[: len(rho)] for x in jax.block_until_ready(call(blocks))]

    return prepared


def lorenz(options):
    """Return a row for each method and contender: tolerance, error, runs per second and the kernel's part of them."""
    which, truth = checked(options.lanes)
    rho, rows = rhos(options.lanes).astype(options.dtype), []
    accuracy = ACCURACY if options.dtype == "float64" else 1e-5
    best = tuple(flag for flag in c.FLAGS if flag not in ("-c", "-fopenmp"))
    for kind in ("fixed", "adaptive"):
        makers = {
            "kernel": by_diffabs(kind, rho),
            "C++, flags of the kernel": by_c(kind, rho, options.threads),
            "C++, -O3 -ffast-math": by_c(kind, rho, options.threads, (*best, "-shared", "-std=c++17", "-pthread")),
            "diffrax, vmap": by_diffrax(kind, rho, min(options.block, options.lanes)),
        }
        calls, found = {}, {}
        for name, prepared in makers.items():
            for tolerance in [None] if kind == "fixed" else LADDER:
                calls[name] = prepared(tolerance)
                off = worst(calls[name](), which, truth)
                found[name] = {"tolerance": tolerance, "error": off}
                if off <= accuracy:
                    break
        takers = {name: functools.partial(record.timed, call) for name, call in calls.items()}
        times = record.in_turn(takers, options.rounds)
        for name, one in found.items():
            speed = options.lanes / statistics.median(times[name])
            row = {"method": kind, "name": name, **one, "runs_per_s": speed}
            rows.append(row | {"of_kernel": record.ratio(times["kernel"], times[name])})
    table = Table("lorenz", "", "tolerance", "error", "runs/s", "times kernel")
    for row in rows:
        numbers = ("" if row["tolerance"] is None else f"{row['tolerance']:.0e}", f"{row['error']:.1e}")
        table.add_row(row["method"], row["name"], *numbers, f"{row['runs_per_s']:,.0f}", f"{row['of_kernel']:.3g}")
    Console().print(table)
    return rows


def ball(options):
    """Return the row of the ball: derivative of the final height by gravity, its error, and the times."""
    gravity, calls, sides = jnp.asarray(9.81), {}, {}

    def slope(build, tolerance):
        height = lambda args: build("ball", tolerance)(args)[0]  # noqa: E731
        return jax.jit(lambda args: jax.jvp(height, (args,), (jnp.ones_like(args),)))

    def by_differences(width):
        ends = [bench_fields.by_diffabs("ball", 1e-12)(gravity + sign * width)[0] for sign in (1, -1)]
        return float((ends[0] - ends[1]) / (2 * width))

    truth = (4 * by_differences(5e-4) - by_differences(1e-3)) / 3
    for name, build in (("diffabs", bench_fields.by_diffabs), ("diffrax", bench_fields.by_diffrax)):
        for tolerance in bench_fields.LADDER:
            calls[name] = slope(build, tolerance)
            sides[name] = {"tolerance": tolerance, "error": abs(float(calls[name](gravity)[1]) / truth - 1)}
            if sides[name]["error"] <= 1e-6:
                break
    takers = {
        name: lambda call=call: record.timed(lambda: jax.block_until_ready(call(gravity)))
        for name, call in calls.items()
    }
    times = record.in_turn(takers, 3 * options.rounds)
    row: dict[str, Any] = {"derivative": truth, "ratio": record.ratio(times["diffabs"], times["diffrax"])}
    table = Table("ball: d height / d gravity", "rtol", "error", "ms")
    for name, side in sides.items():
        row[name] = side | {"ms": 1e3 * statistics.median(times[name])}
        table.add_row(name, f"{side['tolerance']:.0e}", f"{side['error']:.0e}", f"{row[name]['ms']:.2f}")
    Console().print(table, f"diffabs over diffrax: {row['ratio']:.2f}")
    return row


def reactions(t, y, args):
    """Return the rates of Robertson's reactions."""
    slow, mixed, fast = args[0] * y[0], args[1] * y[1] * y[2], args[2] * y[1] ** 2
    return jnp.stack([mixed - slow, slow - mixed - fast, fast])


def robertson(options):
    """Return a row for each end: how `d.solve` ended, its error and time, and those of an implicit method."""
    y0, rates, rows = jnp.array([1.0, 0.0, 0.0]), jnp.array(RATES), []
    for end in options.ends:
        exact = solve_ivp(
            lambda t, y: np.array(reactions(t, y, RATES)), (0.0, end), y0, method="Radau", rtol=1e-10, atol=1e-14
        ).y[:, -1]

        def explicit(args, end=end):
            found = d.solve(reactions, y0, 0.0, end, args, solver=d.Adaptive(1e-6))
            return found.y, found.status

        def implicit(args, end=end):
            found = diffrax.diffeqsolve(
                diffrax.ODETerm(reactions),
                diffrax.Kvaerno5(),
                t0=0.0,
                t1=end,
                dt0=1e-4,
                y0=y0,
                args=args,
                stepsize_controller=diffrax.PIDController(rtol=1e-7, atol=1e-11),
                max_steps=None,
                adjoint=diffrax.ForwardMode(),
            )
            return found.ys[-1], found.stats["num_steps"]

        calls, row = {"d.solve": jax.jit(explicit), "Kvaerno5": jax.jit(implicit)}, {"end": end}
        for name, call in calls.items():
            y, told = jax.block_until_ready(call(rates))
            row[name] = {"error": float(np.abs(np.asarray(y) / exact - 1).max())}
            row[name] |= {"status": SolutionStatus(int(told)).name} if name == "d.solve" else {"steps": int(told)}
        takers = {
            name: lambda call=call: record.timed(lambda: jax.block_until_ready(call(rates)))
            for name, call in calls.items()
        }
        times = record.in_turn(takers, options.rounds)
        for name, taken in times.items():
            row[name]["ms"] = 1e3 * statistics.median(taken)
        rows.append(row | {"ratio": record.ratio(times["d.solve"], times["Kvaerno5"])})
    table = Table("robertson to", "d.solve", "error", "ms", "Kvaerno5 error", "ms", "ratio")
    for row in rows:
        ours, theirs = row["d.solve"], row["Kvaerno5"]
        numbers = (f"{ours['error']:.0e}", f"{ours['ms']:.1f}", f"{theirs['error']:.0e}", f"{theirs['ms']:.1f}")
        table.add_row(f"{row['end']:g}", ours["status"], *numbers, f"{row['ratio']:.3g}")
    Console().print(table)
    return rows


CASES = {"lorenz": lorenz, "ball": ball, "robertson": robertson}


def main():
    """Measure the cases that the command line names."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", nargs="+", choices=CASES, default=list(CASES))
    parser.add_argument("--lanes", type=int, default=768_000)
    parser.add_argument("--dtype", choices=("float32", "float64"), default="float64")
    parser.add_argument("--block", type=int, default=BLOCK, help="lanes of diffrax that step together")
    parser.add_argument("--ends", type=float, nargs="+", default=[40.0, 1e3], help="of Robertson's reactions")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--out", type=pathlib.Path)
    options = parser.parse_args()
    # A kernel uses all processors that the process may use: the peers get as many.
    options.threads = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    jax.config.update("jax_enable_x64", options.dtype == "float64")
    found = {name: CASES[name](options) for name in options.cases}
    kept = {key: getattr(options, key) for key in ("lanes", "dtype", "block", "threads", "rounds")}
    packages = ("jaxlib", "numpy", "scipy", "diffrax", "equinox")
    made = {**found, **kept, "kernel": toolchain.describe_compiler()}
    path = record.written(f"yardsticks-{options.dtype}", made, options.out, packages)
    Console().print(f"written to {path}", soft_wrap=True)


if __name__ == "__main__":
    main()
