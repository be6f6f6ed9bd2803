"""How fast the car with four wheels runs in a kernel, beside C++ by hand with the same method and the same steps.

The right wheels brake on wet asphalt, the left ones on dry. Each wheel has a PID on its slip, without anti-windup, and
a filtered target; a driver holds the line of the start. Masses and speeds are drawn. A run lasts for 1.5 s (`NoStop`)
and ends above 10 m/s; so no last, shorter step has to agree. The slip's least denominator is 10 m/s, which no such run
meets: at rest 1 ms would not be stable. Steps are equal ones of the classical Runge-Kutta method. Distance, lateral
position, yaw and speed at the end must agree to 1e-9 of their greatest values, or the benchmark fails. "Error of the
step" is the difference from an eighth of the step, in the same measure.

peers/car.cpp is compiled by the compiler of the kernel, with its flags and again with those of peers/c.py. Times are
processor times of all threads, taken in turn, without compilation; a ratio is the median of those within a round.

    python benchmarks/bench_car.py [--lanes 4096] [--rounds 7] [--step 1e-3] [--threads 1]

Beside them stand figures that H. M. Unjhawala and others print (doi:10.21105/joss.06548): other models, on an Intel
i7-13700K, by a semi-implicit method with steps of 1 ms, one car at a time, accelerating. They are no measure of ours.
"""

import argparse
import ctypes
import os
import pathlib
import statistics
import time
from typing import Any

import jax
import numpy as np
import record
from peers import c
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

DURATION, AGREEMENT, CHECKED, FINER = 1.5, 1e-9, 64, 8
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
    return generator.uniform(*MASSES, lanes), generator.uniform(*SPEEDS, lanes)


def by_kernel(masses, speeds, step):
    """Return the call that returns the four outputs at the end, shape (4, lanes)."""
    batch = d.Batch({"plant.mass": masses, "initial.speed": speeds})
    solver = d.FixedStep(step, DURATION, kinks=False)

    def call():
        metrics = d.run_batch(LOOP, batch, solver, FINAL, engine="kernel").metrics
        return np.stack([np.asarray(metrics[name]) for name in OUTPUTS])

    return call


def by_hand(masses, speeds, step, threads, flags=()):
    """Return the call of peers/car.cpp that returns distance, lateral position, yaw and speed, shape (4, lanes)."""
    lines = [f"#define {name} {text}" for name, text in constants().items()]
    text = "\n".join([*lines, SOURCE.read_text(encoding="utf-8")])
    function = ctypes.CDLL(str(toolchain.build_library(text, flags))).run
    array = np.ctypeslib.ndpointer(np.float64, flags="C")
    function.argtypes = [ctypes.c_long, array, array, ctypes.c_long, ctypes.c_double, ctypes.c_int, array]
    function.restype = None
    end = np.empty((len(OUTPUTS), len(masses)))

    def call():
        function(len(masses), masses, speeds, round(DURATION / step), step, threads, end)
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


def measured(lanes, step, rounds, threads):
    """Return the error of the step, and a row for each program."""
    masses, speeds = drawn(lanes)
    best = tuple(flag for flag in c.FLAGS if flag not in ("-c", "-fopenmp"))
    calls = {
        "kernel": by_kernel(masses, speeds, step),
        "C++, flags of the kernel": by_hand(masses, speeds, step, threads),
        "C++, -O3 -ffast-math": by_hand(masses, speeds, step, threads, (*best, "-shared", "-std=c++17", "-pthread")),
    }
    ends = {name: call().copy() for name, call in calls.items()}
    few = masses[:CHECKED], speeds[:CHECKED]
    finer = by_hand(*few, step / FINER, 1)()
    times = record.in_turn({name: lambda call=call: processor_time(call) for name, call in calls.items()}, rounds)
    rows = {}
    for name, end in ends.items():
        apart = difference(end, ends["kernel"])
        if not apart <= AGREEMENT:
            raise SystemExit(f"{name}: the ends differ by {apart:.1e} from the kernel's, more than {AGREEMENT:g}")
        seconds = statistics.median(times[name]) / lanes
        rows[name] = {
            "difference": apart,
            "runs_per_s_and_core": 1 / seconds,
            "ns_per_step": 1e9 * seconds * step / DURATION,
            "ms_per_10_s": 1e3 * seconds * 10.0 / DURATION,
            "speed_over_kernel": record.ratio(times["kernel"], times[name]),
        }
    return {"error_of_step": difference(ends["kernel"][:, : len(few[0])], finer), "rows": rows}


def main():
    """Measure, print, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--lanes", type=int, default=4096)
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--step", type=float, default=1e-3, help="s")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--out", type=pathlib.Path)
    options = parser.parse_args()
    if hasattr(os, "sched_setaffinity"):  # a kernel has a thread for each processor that the process may use
        os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[: options.threads])
    jax.config.update("jax_enable_x64", True)
    sizes = {key: getattr(options, key) for key in ("lanes", "step", "rounds", "threads")}
    made = {**measured(**sizes), **sizes, "printed_ms_per_10_s": PRINTED, "kernel": toolchain.describe_compiler()}
    table = Table("car", "runs/s and core", "ns/step", "ms for 10 s", "speed over kernel's", "difference")
    for name, row in made["rows"].items():
        numbers = (f"{row['ns_per_step']:,.0f}", f"{row['ms_per_10_s']:.2f}", f"{row['speed_over_kernel']:.2f}")
        table.add_row(name, f"{row['runs_per_s_and_core']:,.0f}", *numbers, f"{row['difference']:.0e}")
    Console().print(table, f"error of the step: {made['error_of_step']:.1e}; printed elsewhere, in ms: {PRINTED}")
    Console().print(f"written to {record.written('car', made, options.out)}", soft_wrap=True)


if __name__ == "__main__":
    main()
