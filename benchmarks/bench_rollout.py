"""Closed loops per second: diffabs, diffrax and SciPy on the same loop, in one run, at equal accuracy.

The loop: the rig of [lmi] from 50 to 5 km/h under its published gain, torque >= 0, masses 5.3 to 6.2 kg. Each program
gets the largest step or tolerance of its ladder whose worst error over ALL lanes (stopping time, distance, IAE) is
below `--accuracy` against a converged reference. Medians; compile time apart. Prints a table, writes JSON with machine
and versions to out/benchmarks/rollout.json.

    python benchmarks/bench_rollout.py [--lanes 512] [--accuracy 1e-4]
"""

import argparse
import importlib.metadata
import json
import os
import pathlib
import platform
import statistics
import time

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import optimistix
from rich.console import Console
from rich.table import Table
from scipy.integrate import solve_ivp

import diffabs as d
from diffabs import controllers, objectives, plants, stops
from diffabs.scenario.defaults import braking

REPEATS = 5
ABSOLUTE = 1e-2  # absolute over relative tolerance of the peers: the IAE is small, 0.009 s
STOP = 5 / 3.6
LOOP = braking(
    plant=plants.MirroredRig(),
    initial=d.BrakeStart(speed=50 / 3.6),
    stop=stops.SpeedReached(speed=STOP),
    controller=controllers.StateFeedback(torque_min=0.0),
    feedforward=controllers.HoldingInput(),
)
MEASURED = {"stop_time": objectives.StopTime(), "stop_distance": objectives.StopDistance(), "iae": objectives.IAE()}


def with_diffabs(step):
    """masses -> (lanes, 3) by the fixed-step scan."""

    def one(mass):
        run = d.measure(d.replace(LOOP, {"plant.mass": mass}), d.FixedStep(step, 1.7), MEASURED)
        return jnp.stack([run.metrics[name] for name in MEASURED])

    return jax.vmap(one)


def right_hand_side(t, z, mass):
    """The same closed loop as one flat vector (body, wheel, distance, x1, IAE), as a user of a peer would write it."""
    p, gain = LOOP.plant, LOOP.controller.gain
    body, wheel, _, x1, _ = z
    v, w = p.body_radius * body, p.wheel_radius * wheel
    slip = (v - w) / jnp.maximum(v, w)
    mu, held = p.road.friction(slip), p.road.friction(0.2)
    hold = held * 9.81 * (mass * p.wheel_radius + 2 * 0.8 * p.wheel_inertia / p.wheel_radius)
    torque = jnp.maximum(hold + gain[0] * x1 + gain[1] * (slip - 0.2), 0.0)
    rates = (
        -2 * mu * 9.81 / p.body_radius,
        (mu * mass * 9.81 * p.wheel_radius - torque) / p.wheel_inertia,
        v,
        slip - 0.2,
        jnp.abs(slip - 0.2),
    )
    return jnp.stack(rates)


START = jnp.array([50 / 3.6 / LOOP.plant.body_radius, 50 / 3.6 / LOOP.plant.wheel_radius, 0.0, 0.0, 0.0])


def with_diffrax(tolerance):
    """masses -> (lanes, 3) by Tsit5 with a PI step-size controller, ended by an event."""
    stop = diffrax.Event(
        lambda t, y, args, **kwargs: LOOP.plant.body_radius * y[0] - STOP, optimistix.Newton(rtol=1e-10, atol=1e-12)
    )

    def one(mass):
        solution = diffrax.diffeqsolve(
            diffrax.ODETerm(right_hand_side),
            diffrax.Tsit5(),
            t0=0.0,
            t1=2.0,
            dt0=1e-4,
            y0=START,
            args=mass,
            stepsize_controller=diffrax.PIDController(
                rtol=tolerance, atol=ABSOLUTE * tolerance, pcoeff=0.3, icoeff=0.4
            ),
            event=stop,
            max_steps=100_000,
        )
        return jnp.array([solution.ts[-1], solution.ys[-1, 2], solution.ys[-1, 4]])

    return jax.vmap(one)


def with_scipy(tolerance):
    """masses -> (lanes, 3) by a Python loop over solve_ivp (DOP853), its right-hand side compiled by JAX."""
    compiled = jax.jit(right_hand_side)

    def stop(t, z, mass):
        return LOOP.plant.body_radius * z[0] - STOP

    stop.terminal = True

    def many(masses):
        rows = []
        for mass in np.asarray(masses):
            run = solve_ivp(
                lambda t, z, m: np.asarray(compiled(t, z, m)),
                (0, 2),
                np.asarray(START),
                "DOP853",
                events=stop,
                args=(mass,),
                rtol=tolerance,
                atol=ABSOLUTE * tolerance,
            )
            rows.append([run.t[-1], run.y[2, -1], run.y[4, -1]])
        return np.array(rows)

    return many


def cheapest(make, ladder, masses, reference, accuracy):
    """The first setting of a ladder, coarse to fine, that is accurate on every lane: (setting, error, function)."""
    for setting in ladder:
        function = make(setting)
        error = float(np.max(np.abs(np.asarray(jax.jit(function)(masses)) / reference - 1)))
        if error <= accuracy:
            return setting, error, function
    raise RuntimeError(f"no setting of {ladder} reaches {accuracy}")


def timed(function, masses):
    """(compile time, median run time) in seconds."""
    jax.clear_caches()
    start = time.perf_counter()
    compiled = jax.jit(function).lower(masses).compile()
    compile_time = time.perf_counter() - start
    return compile_time, _median(lambda: jax.block_until_ready(compiled(masses)))


def _median(call, repeats=REPEATS):
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        call()
        times.append(time.perf_counter() - start)
    return statistics.median(times)


def main():
    """Measure, print, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--lanes", type=int, default=512)
    parser.add_argument("--accuracy", type=float, default=1e-4)
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    masses = jnp.linspace(5.3, 6.2, options.lanes)
    reference = np.asarray(jax.jit(with_diffabs(2e-5))(masses))
    rows = []
    for name, make, ladder in (
        ("diffabs, fixed RK4", with_diffabs, (2e-3, 1e-3, 7e-4, 5e-4, 3e-4, 2e-4, 1e-4, 5e-5)),
        ("diffrax, Tsit5", with_diffrax, (1e-4, 1e-5, 1e-6, 3e-7, 1e-7, 3e-8, 1e-8, 3e-9, 1e-9)),
    ):
        setting, error, function = cheapest(make, ladder, masses, reference, options.accuracy)
        compile_time, run_time = timed(function, masses)
        rows.append(_row(name, setting, error, compile_time, run_time, options.lanes))
    few = masses[:: max(1, options.lanes // 8)]
    for tolerance in (1e-5, 1e-6, 1e-7, 1e-8, 1e-9, 1e-10):
        function = with_scipy(tolerance)
        error = float(np.max(np.abs(function(few) / reference[:: max(1, options.lanes // 8)] - 1)))
        if error <= options.accuracy:
            run_time = _median(lambda function=function: function(few), 3)
            rows.append(_row("SciPy, DOP853 in a loop", tolerance, error, 0.0, run_time, len(few)))
            break
    gradient = jax.grad(lambda masses: jnp.mean(with_diffabs(rows[0]["setting"])(masses)[:, 2]))
    compile_time, run_time = timed(gradient, masses)
    rows.append(_row("diffabs, gradient (reverse)", rows[0]["setting"], 0.0, compile_time, run_time, options.lanes))
    _report(rows, options)


def _row(name, setting, error, compile_time, run_time, lanes):
    return {
        "program": name,
        "setting": setting,
        "worst_error": error,
        "compile_s": compile_time,
        "run_s": run_time,
        "runs_per_s": lanes / run_time,
    }


def _report(rows, options):
    table = Table(title=f"{options.lanes} closed loops, worst error over all lanes <= {options.accuracy:g}")
    for heading in ("program", "step or tolerance", "worst error", "compile [s]", "run [s]", "runs/s", "ratio"):
        table.add_column(heading)
    for row in rows:
        ratio = row["runs_per_s"] / rows[0]["runs_per_s"]
        table.add_row(
            row["program"],
            f"{row['setting']:g}",
            f"{row['worst_error']:.1e}",
            f"{row['compile_s']:.1f}",
            f"{row['run_s']:.2f}",
            f"{row['runs_per_s']:.0f}",
            f"{ratio:.3f}",
        )
    Console().print(table)
    packages = ("diffabs", "jax", "jaxlib", "diffrax", "scipy", "numpy")
    record = {
        "rows": rows,
        "lanes": options.lanes,
        "accuracy": options.accuracy,
        "device": str(jax.devices()[0]),
        "machine": {"processor": platform.machine(), "system": platform.system(), "cores": os.cpu_count()},
        "versions": {name: importlib.metadata.version(name) for name in packages},
        "python": platform.python_version(),
    }
    path = pathlib.Path("out/benchmarks/rollout.json")
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(record, indent=2))
    Console().print(f"written to {path}")


if __name__ == "__main__":
    main()
