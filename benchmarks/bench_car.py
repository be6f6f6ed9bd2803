"""How fast the car with four wheels runs in a kernel, beside C++ by hand with the same method and the same steps.

The right wheels brake on wet asphalt, the left ones on dry. Each wheel has a PID on its slip, without anti-windup, and
a filtered target; a driver holds the line of the start. Masses and speeds are drawn. A run lasts for 1.5 s (`NoStop`)
and ends above 10 m/s; so no last, shorter step has to agree. The slip's least denominator is 10 m/s, which no such run
meets: at rest 1 ms would not be stable. Outputs are distance, lateral position, yaw and speed at the end. A difference
or an error is the greatest one of an output, relative to its greatest value over the lanes; an error is the difference
from the C++ in double precision with an eighth of the step.

    fixed       equal steps of the classical Runge-Kutta method; ends must agree to 1e-9 in double precision, to 3e-5 in
                single (rounding in 1,500 steps), or the benchmark fails. `run_batch` also checks the step for each
                run; inside `jax.jit`, the second row, it does not
    adaptive    Tsitouras' method on both sides, each with the loosest tolerance up to 1e-3 whose error is at most
                1e-5. The kernel locates the limits of torques and locked wheels; the C++ has a PI control and rejects
                steps across them. In both, every lane has its own steps

peers/car.cpp is compiled by the compiler of the kernel, with its flags and again with those of peers/c.py. Times are
processor times of all threads, taken in turn, without compilation; a ratio is the median of those within a round.

    python benchmarks/bench_car.py [--lanes 4096] [--rounds 7] [--step 1e-3] [--threads 1] [--float32] [--steps fixed]

Beside them stand figures that H. M. Unjhawala and others print (doi:10.21105/joss.06548): other models, on an Intel
i7-13700K, by a semi-implicit method with steps of 1 ms, one car at a time, accelerating. They are no measure of ours.
"""

import argparse
import ctypes
import functools
import os
import pathlib
import statistics
import time
from typing import Any

import jax
import numpy as np
import record
from peers import c, tableau
from rich.console import Console
from rich.table import Table

import diffabs as d
from diffabs import controllers, references, roads, stops
from diffabs.compiler.runtime import toolchain
from diffabs.core.protocols import Ending, Memory
from diffabs.core.pytree import pytree, static
from diffabs.core.types import Scalar
from diffabs.parts.objectives.tracking import FinalValue
from diffabs.parts.plants import GRAVITY
from diffabs.parts.plants.car import BRAKES, Car

DURATION, FINER, GOAL = 1.5, 8, 1e-5
AGREEMENT = {"float64": 1e-9, "float32": 3e-5}  # of ends by equal steps
LADDER = tuple(10.0**-k for k in np.arange(3.0, 8.1, 0.25))  # tolerances
SPEEDS, MASSES = (28.0, 32.0), (1000.0, 1400.0)  # m/s, kg
PID = controllers.PID(kp=1e4, ki=1.5e5, low=0.0, high=2000.0)
TARGET = references.FilteredSlip(slip=0.1)
WET: Any = roads.RoadTyre(road=roads.WET_ASPHALT)
CAR: Any = Car(drag=0.4, rolling=0.012, crawl_speed=10.0, front_right_tyre=WET, rear_right_tyre=WET)
DRIVER = controllers.HoldCourse(controller=controllers.PerChannel(PID, BRAKES))
PARTS = {
    "reference": references.PerTarget(reference=dict.fromkeys(BRAKES.values(), TARGET)),
    "controller": DRIVER,
    "stop": stops.NoStop(),
}
LOOP = d.Loop(plant=CAR, **{**CAR.usual_parts(), **PARTS})
REALS = {"float64": "double", "float32": "float"}
SOURCE = pathlib.Path(__file__).with_name("peers") / "car.cpp"
PRINTED = {"11 degrees of freedom, two wheels": 1.5, "18 degrees of freedom, four wheels": 2.6}  # ms for 10 s


@pytree
class FinalOutput(FinalValue):
    """An output at the end of the run."""

    output: str = static(default="speed")
    unit = "signal"

    def value(self, memory: Memory, ending: Ending) -> Scalar:
        """Return the last output."""
        del memory
        return getattr(ending.sample.output, self.output)


OUTPUTS = ("distance", "lateral_position", "yaw", "speed")
FINAL = {name: FinalOutput(output=name) for name in OUTPUTS}


def constants():
    """Return the definitions that car.cpp needs, from the parts of the loop."""
    numbers = {
        "TO_FRONT": CAR.to_front, "TO_REAR": CAR.to_rear, "FRONT_TRACK": CAR.front_track, "REAR_TRACK": CAR.rear_track,
        "HEIGHT": CAR.height, "ROLL": CAR.roll_share, "RADIUS": CAR.radius, "YAW_INERTIA": CAR.yaw_inertia,
        "FRONT_INERTIA": CAR.front_wheel_inertia, "REAR_INERTIA": CAR.rear_wheel_inertia, "DRAG": CAR.drag,
        "ROLLING": CAR.rolling, "LAG": CAR.steer_lag, "CRAWL": CAR.crawl_speed, "GRAVITY": GRAVITY,
        "C4": roads.DRY_ASPHALT.c4, "KP": PID.kp, "KI": PID.ki, "TORQUE": PID.high, "SLIP": TARGET.slip,
        "FILTER": TARGET.time_constant, "GAIN": DRIVER.gain, "PREVIEW": DRIVER.preview, "FULL": DRIVER.full_angle,
    }  # fmt: skip
    sides = {"LEFT": roads.DRY_ASPHALT, "RIGHT": roads.WET_ASPHALT}
    curves = {side: f"{float(road.c1)!r}, {float(road.c2)!r}, {float(road.c3)!r}" for side, road in sides.items()}
    return {**{name: repr(float(number)) for name, number in numbers.items()}, **curves}


def drawn(lanes):
    """Return a mass [kg] and a speed [m/s] for each lane."""
    generator = np.random.default_rng(0)
    return tuple(generator.uniform(*span, lanes).astype(np.float32).astype(float) for span in (MASSES, SPEEDS))


def by_kernel(masses, speeds, dtype, kind, setting, *, traced=False):
    """Return the call that returns the four outputs at the end, shape (4, lanes). A traced call checks no step."""
    solver = d.FixedStep(setting, DURATION, kinks=False) if kind == "fixed" else d.Adaptive(setting, DURATION)

    def metrics(masses, speeds):
        batch = d.Batch({"plant.mass": masses, "initial.speed": speeds})
        return d.run_batch(LOOP, batch, solver, FINAL, engine="kernel").metrics

    compiled = jax.jit(metrics) if traced else metrics
    masses, speeds = masses.astype(dtype), speeds.astype(dtype)

    def call():
        with jax.enable_x64(dtype == "float64"):
            ends = compiled(masses, speeds)
            return np.stack([np.asarray(ends[name]) for name in OUTPUTS])

    return call


def by_hand(masses, speeds, dtype, kind, setting, threads, flags=()):
    """Return the call of peers/car.cpp that returns distance, lateral position, yaw and speed, shape (4, lanes)."""
    numbers = constants() | {name: repr(x) for name, x in tableau.definitions().items()}
    lines = [f"#define {name} {text}" for name, text in {"REAL": REALS[dtype], **numbers}.items()]
    text = "\n".join([*lines, SOURCE.read_text(encoding="utf-8")])
    flags = (*(flags or toolchain.CPP_FLAGS), *(("-fsingle-precision-constant",) if dtype == "float32" else ()))
    function = ctypes.CDLL(str(toolchain.build_library(text, flags))).run
    array = np.ctypeslib.ndpointer(np.dtype(dtype), flags="C")
    function.argtypes = [ctypes.c_long, array, array, ctypes.c_int, *[ctypes.c_double] * 2, ctypes.c_int, array]
    function.restype = ctypes.c_long
    masses, speeds = masses.astype(dtype), speeds.astype(dtype)
    end = np.empty((len(OUTPUTS), len(masses)), dtype)

    def call():
        function(len(masses), masses, speeds, kind == "adaptive", DURATION, setting, threads, end)
        return end

    return call


def difference(end, other):
    """Return the greatest difference of an output, relative to its greatest value over the lanes."""
    return float((np.abs(end - other).max(axis=1) / np.abs(other).max(axis=1)).max())


def processor_time(call):
    """Return the processor seconds of all threads that a call takes."""
    begun = time.process_time()
    call()
    return time.process_time() - begun


def makers(masses, speeds, dtype, kind, threads):
    """Return by name what makes the call of a program for a setting: a step [s] or a tolerance."""
    best = tuple(flag for flag in c.FLAGS if flag not in ("-c", "-fopenmp"))
    common = masses, speeds, dtype, kind
    return {
        "kernel": functools.partial(by_kernel, *common),
        **({"kernel in jit": functools.partial(by_kernel, *common, traced=True)} if kind == "fixed" else {}),
        "C++, flags of the kernel": functools.partial(by_hand, *common, threads=threads),
        "C++, -O3 -ffast-math": functools.partial(
            by_hand, *common, threads=threads, flags=(*best, "-shared", "-std=c++17", "-pthread")
        ),
    }


def accurate(make, settings, truth):
    """Return the first setting whose ends have an error of at most `GOAL`, its call and its ends."""
    for setting in settings:
        call = make(setting=setting)
        end = call().copy()
        if len(settings) == 1 or difference(end, truth) <= GOAL:
            return setting, call, end
    raise SystemExit(f"no tolerance gives an error of {GOAL:g}")


def measured(lanes, step, rounds, threads, dtype, kind):
    """Return a row for each program."""
    masses, speeds = drawn(lanes)
    truth = makers(masses, speeds, "float64", "fixed", threads)["C++, -O3 -ffast-math"](setting=step / FINER)()
    settings = (step,) if kind == "fixed" else LADDER
    chosen = {
        name: accurate(make, settings, truth) for name, make in makers(masses, speeds, dtype, kind, threads).items()
    }
    takers = {name: functools.partial(processor_time, call) for name, (_, call, _) in chosen.items()}
    times = record.in_turn(takers, rounds)
    rows = {}
    for name, (setting, _, end) in chosen.items():
        apart = difference(end, chosen["kernel"][2])
        if kind == "fixed" and not apart <= AGREEMENT[dtype]:
            raise SystemExit(
                f"{name}: the ends differ by {apart:.1e} from the kernel's, more than {AGREEMENT[dtype]:g}"
            )
        seconds = statistics.median(times[name]) / lanes
        rows[name] = {
            "setting": setting,
            "error": difference(end, truth),
            "difference": apart,
            "runs_per_s_and_core": 1 / seconds,
            "ms_per_10_s": 1e3 * seconds * 10.0 / DURATION,
            "speed_over_kernel": record.ratio(times["kernel"], times[name]),
        }
    return rows


def main():
    """Measure, print, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--lanes", type=int, default=4096)
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--step", type=float, default=1e-3, help="s")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--float32", action="store_true", help="single precision on both sides")
    parser.add_argument("--steps", nargs="+", choices=("fixed", "adaptive"), default=("fixed", "adaptive"))
    parser.add_argument("--out", type=pathlib.Path)
    options = parser.parse_args()
    if hasattr(os, "sched_setaffinity"):  # a kernel has a thread for each processor that the process may use
        os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[: options.threads])
    jax.config.update("jax_enable_x64", True)
    dtype = "float32" if options.float32 else "float64"
    sizes = {key: getattr(options, key) for key in ("lanes", "step", "rounds", "threads")}
    rows = {kind: measured(**sizes, dtype=dtype, kind=kind) for kind in options.steps}
    made = {"rows": rows, "dtype": dtype, **sizes, "printed_ms_per_10_s": PRINTED}
    table = Table(f"car, {dtype}", "", "setting", "error", "difference", "runs/s and core", "ms for 10 s", "speed")
    for kind, programs in rows.items():
        for name, row in programs.items():
            numbers = (f"{row['setting']:.1e}", f"{row['error']:.1e}", f"{row['difference']:.0e}")
            speeds = (
                f"{row['runs_per_s_and_core']:,.0f}",
                f"{row['ms_per_10_s']:.2f}",
                f"{row['speed_over_kernel']:.2f}",
            )
            table.add_row(kind, name, *numbers, *speeds)
    Console(width=120).print(table, f"speed: over the kernel's; printed elsewhere, in ms: {PRINTED}")
    path = record.written(f"car-{dtype}", {**made, "kernel": toolchain.describe_compiler()}, options.out)
    Console().print(f"written to {path}", soft_wrap=True)


if __name__ == "__main__":
    main()
