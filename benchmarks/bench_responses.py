"""Ten thousand PI loops: peak of the sensitivity and its derivative by both gains, against a loop over SLICOT.

One run, the same problems: random plants of order 3 under a PI controller that leaves each loop stable. SLICOT
(`ab13dd` of `slycot`) computes peaks of a part of them, and its time is scaled. It has no derivatives: central
differences by two gains take four more calls. Prints a table, writes JSON with machine and versions.

    python benchmarks/bench_responses.py [--lanes 10000] [--part 500]
"""

import argparse
import pathlib
import statistics

import jax
import jax.numpy as jnp
import numpy as np
import record
import slycot
from rich.console import Console
from rich.table import Table

from diffabs.linear import Transfer
from diffabs.linear.responses import sensitivity_peak

REPEATS, CHUNK, WIDTH = 5, 500, 1e-4


def matrices(plant, gains, numbers=np):
    """A, B, C of L = (kp + ki/s) C0 (s - A0)^-1 B0; the integral is the last state."""
    a, b, c = plant
    integral = numbers.concatenate([c, numbers.zeros((1, 1))], axis=1)
    top = numbers.concatenate([a, numbers.zeros((3, 1))], axis=1)
    output = numbers.concatenate([gains[0] * c, gains[1] * numbers.ones((1, 1))], axis=1)
    return numbers.concatenate([top, integral]), numbers.concatenate([b, numbers.zeros((1, 1))]), output


def stable_loops(count):
    """Plants and gains of stable loops."""
    draw, plants, gains = np.random.default_rng(0), [], []
    while len(plants) < count:
        a = np.diag(-np.exp(draw.normal(0, 1, 3))) + np.triu(draw.normal(0, 1, (3, 3)), 1)
        plant, gain = (a, draw.normal(size=(3, 1)), draw.normal(size=(1, 3))), draw.uniform(0.2, 1.5, 2)
        big, b, c = matrices(plant, gain)
        if np.linalg.eigvals(big - b @ c).real.max() < -0.02:
            plants.append(plant)
            gains.append(gain)
    return tuple(np.stack(part) for part in zip(*plants, strict=True)), np.stack(gains)


def peak(plant, gains):
    """Return the peak of the sensitivity."""
    a, b, c = matrices(plant, gains, jnp)
    return sensitivity_peak(Transfer(a, b, c, jnp.zeros((1, 1)))).value


def slicot_peak(plant, gains):
    """Return the same by SLICOT."""
    a, b, c = matrices(plant, gains)
    return slycot.ab13dd("C", "I", "N", "D", 4, 1, 1, a - b @ c, np.eye(4), b, -c, np.eye(1))[0]


def main():
    """Compute, compare, print, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--lanes", type=int, default=10_000)
    parser.add_argument("--part", type=int, default=500)
    parser.add_argument("--out", type=pathlib.Path)
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    plants, gains = stable_loops(options.lanes)
    both = jax.value_and_grad(peak, argnums=1)
    many = jax.jit(lambda plants, gains: jax.lax.map(lambda lane: both(*lane), (plants, gains), batch_size=CHUNK))
    values = jax.jit(lambda plants, gains: jax.lax.map(lambda lane: peak(*lane), (plants, gains), batch_size=CHUNK))
    compiled = record.timed(lambda: jax.block_until_ready(many(plants, gains)))
    jax.block_until_ready(values(plants, gains))

    def loop_over_slicot(calls):
        return record.timed(lambda: [slicot_peak([p[i] for p in plants], gains[i]) for _ in range(calls) for i in part])

    part, scale = range(options.part), options.lanes / options.part
    takers = {
        "derivative": lambda: record.timed(lambda: jax.block_until_ready(many(plants, gains))),
        "value": lambda: record.timed(lambda: jax.block_until_ready(values(plants, gains))),
        "slicot": lambda: scale * loop_over_slicot(1),
    }
    taken = record.in_turn(takers, REPEATS)
    peaks, slopes = (np.asarray(x) for x in many(plants, gains))
    reference = np.array([slicot_peak([p[i] for p in plants], gains[i]) for i in part])
    steps = WIDTH * np.eye(2)
    differences = np.array(
        [
            [
                (slicot_peak([p[i] for p in plants], gains[i] + h) - slicot_peak([p[i] for p in plants], gains[i] - h))
                for h in steps
            ]
            for i in part
        ]
    ) / (2 * WIDTH)
    n = options.part
    error = float(np.max(np.abs(peaks[:n] / reference - 1)))
    slope_error = float(np.max(np.abs(slopes[:n] - differences) / np.maximum(1.0, np.abs(differences))))
    value_ratio = record.ratio(taken["slicot"], taken["value"])
    slope_ratio = 5 * record.ratio(taken["slicot"], taken["derivative"])
    table = Table("what", "seconds", "SLICOT in a loop", "times")
    median = {name: statistics.median(seconds) for name, seconds in taken.items()}
    table.add_row("peaks", f"{median['value']:.3f}", f"{median['slicot']:.2f}", f"{value_ratio:.1f}")
    table.add_row("and derivatives", f"{median['derivative']:.3f}", f"{5 * median['slicot']:.2f}", f"{slope_ratio:.1f}")
    console = Console()
    console.print(table)
    console.print(f"{options.lanes} loops; compiled in {compiled:.1f} s; {int(np.isnan(peaks).sum())} not decided")
    console.print(f"greatest difference of a peak {error:.1e}, of a slope {slope_error:.1e} (differences by SLICOT)")
    result = {"lanes": options.lanes, "seconds": median, "ratios": {"value": value_ratio, "derivative": slope_ratio}}
    print(record.written("responses", {**result, "errors": {"peak": error, "slope": slope_error}}, options.out))


if __name__ == "__main__":
    main()
