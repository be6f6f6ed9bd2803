"""How far a run's metrics are from those of shorter steps: an estimate of their errors that asks for no reference.

    d1 = m(h/2) - m(h),  d2 = m(h/4) - m(h/2),  q = |d2/d1| = 2^-p for a method of order p
    |m(h) - m(0)|, about                    |d1| + |d2| (1 + q + q^2 + ...)

L. F. Richardson, Phil. Trans. R. Soc. A 210 (1911). With p = 4 the error is 16/15 of d1, that of the half step 1/15.
Where q stays above `MAX_DIFFERENCE_RATIO` the differences do not shrink, and no limit can be estimated: the metric has
no order.

A run with shorter steps is the same run only if everything with a clock of its own keeps it. Noise is drawn, and a
sampled controller computes, by the period; a delay's ring is made longer (`refined`). Noise that comes out otherwise is
found by drawing it at both steps; a block that works once in every step (`every_step`) is another block with another
step. Then there is nothing to compare, and every number is NaN."""

from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from diffabs.core.blocks import offers
from diffabs.core.loop import BLOCKS, Loop
from diffabs.core.protocols import Clock, Memory, Objective
from diffabs.core.pytree import refine_parts
from diffabs.simulate.run import measure
from diffabs.simulate.solution import Run, Solver, refine_solver

MAX_DIFFERENCE_RATIO = 0.75  # q of an order of 0.4
ROUNDING_EPS = 1e3  # times the precision of a number: differences that are none
MAX_COMPARED_INSTANTS = 256  # instants at which noise is compared


class ErrorEstimate(NamedTuple):
    """Of a metric, in its unit: its value, what a half step changes, and what half of that changes again; the order at
    which they shrink, NaN where there is nothing left to shrink; whether they do; the error of the value."""

    value: Any
    difference: Any
    finer: Any
    order: Any
    converges: Any
    error: Any

    @property
    def relative(self) -> Any:
        """The error as a fraction of the value; 0 where there is no error, infinite where there is no value."""
        return relative_difference(self.error, self.value)


class Accuracy(NamedTuple):
    """Estimates by metric; whether the runs can be compared at all (`reasons` says why not), and whether they ended
    alike: all stopped or none, none diverged."""

    estimates: dict[str, ErrorEstimate]
    comparable: Any
    alike: Any


def estimate_accuracy(loop: Loop, solver: Solver, objectives: Mapping[str, Objective], *, key: Any = None) -> Accuracy:
    """Estimate the errors of what `measure` returns for the same arguments, at the price of seven such runs.

    Pure; batch it with `jax.vmap`. Every period must be on the grid of `solver.step`. Raises what `measure` raises.
    """
    runs = [measure_finer(loop, solver, objectives, times, key=key) for times in (1, 2, 4)]
    fine = is_comparable(loop, solver, key)
    coarse, half, quarter = (run.metrics for run in runs)
    estimates = {name: _estimate(coarse[name], half[name], quarter[name], fine) for name in objectives}
    return Accuracy(estimates, fine, runs_end_alike(*runs))


def measure_finer(
    loop: Loop, solver: Solver, objectives: Mapping[str, Objective], times: int, *, key: Any = None
) -> Run:
    """What `measure` returns with steps that are `times` shorter, over the same whole steps."""
    return measure(refine_parts(loop, times), refine_solver(solver, times), objectives, key=key)


def runs_end_alike(*runs: Run) -> Any:
    """Whether all of these runs stopped, or none, and none diverged."""
    stopped = jnp.stack([run.stopped for run in runs])
    return ~jnp.stack([run.diverged for run in runs]).any(0) & (stopped.all(0) | ~stopped.any(0))


def relative_difference(difference: Any, value: Any) -> Any:
    """|difference/value|; 0 where the difference is, infinite where only the value is."""
    size, of = jnp.abs(difference), jnp.abs(value)
    return jnp.where(size == 0, 0.0, size / jnp.where(of > 0, of, 1.0) + jnp.where(of > 0, 0.0, jnp.inf))


def is_comparable(loop: Loop, solver: Solver, key: Any = None) -> Any:
    """Whether a shorter step leaves the loop what it is: its noise, and what it computes."""
    steady = not any(True for _ in per_step_blocks(loop))
    return steady & (has_same_noise(loop, solver, 2, key) & has_same_noise(loop, solver, 4, key))


def incomparability_reasons(loop: Loop, solver: Solver, key: Any = None) -> list[str]:
    """Why runs with other steps cannot be compared, a line each; none if they can. Not for traced loops."""
    lines = [
        f"{name} computes once in every step: with another step it is another {name}" for name in per_step_blocks(loop)
    ]
    if not (has_same_noise(loop, solver, 2, key) and has_same_noise(loop, solver, 4, key)):
        lines.append("a shorter step draws other noise: give the sensor a period that is a multiple of solver.step")
    return lines


def per_step_blocks(loop: Loop) -> Iterator[str]:
    """The blocks of a loop that work once in every integration step, by name."""
    for name in BLOCKS:
        block = getattr(loop, name)
        inner = getattr(block, "blocks", (block,))
        if any(getattr(one, "every_step", False) for one in inner):
            yield name


def needs_key(loop: Loop) -> bool:
    """Whether the loop has noise: its sensor refuses to draw without a key."""
    try:
        jax.eval_shape(lambda one: _draws(one, 1e-3, 1, 1, None), loop)
    except ValueError:
        return True
    return False


def has_same_noise(loop: Loop, solver: Solver, times: int, key: Any) -> Any:
    """Whether the sensor shows the same at the common instants with steps that are `times` shorter, of a signal that
    does not move. Noise is all that can differ then."""
    if key is None:
        return jnp.asarray(True)
    count = min(solver.steps, MAX_COMPARED_INSTANTS)
    a = _draws(loop, solver.step, 1, count, key)
    b = _draws(loop, solver.step / times, times, count, key)
    pairs = zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)
    same = [jnp.all((x == y) | (jnp.abs(x - y) <= 1e-6 * jnp.abs(x))) for x, y in pairs]  # equal: infinite ones, too
    return jnp.all(jnp.stack(same))


def _draws(loop: Loop, h: float, times: int, count: int, key: Any) -> Any:
    """What the sensor shows after each `times` steps (count, ...) of a run that stands still at its start."""
    signal = loop.plant.output(loop.plant.start(loop.initial))
    signal = jax.tree.map(lambda x: jnp.asarray(x, jnp.result_type(float)), signal)
    sensor: Any = loop.sensor
    start = sensor.start(signal)

    def step(memory: Memory, k: Any) -> tuple[Memory, Any]:
        ticked = sensor.tick(Clock(k * h, h, k, key), memory, signal) if offers(sensor, "tick") else memory
        held = jax.tree.map(lambda x, old: jnp.asarray(x, jnp.result_type(old)), ticked.held, start.held)
        return Memory(start.flow, held), sensor.output(k * h, Memory(start.flow, held), signal)

    seen = jax.lax.scan(step, start, jnp.arange(count * times))[1]
    return jax.tree.map(lambda x: x[::times], seen)


def _estimate(coarse: Any, half: Any, quarter: Any, fine: Any) -> ErrorEstimate:
    d1, d2 = half - coarse, quarter - half
    q = jnp.where(d1 == 0, jnp.where(d2 == 0, 0.0, jnp.inf), jnp.abs(d2) / jnp.where(d1 == 0, 1.0, jnp.abs(d1)))
    floor = ROUNDING_EPS * jnp.finfo(jnp.result_type(coarse)).eps * jnp.abs(quarter)
    rounded = (jnp.abs(d1) <= floor) & (jnp.abs(d2) <= floor)
    order = jnp.where(rounded | (q == 0), jnp.nan, -jnp.log2(jnp.where(q > 0, q, 1.0)))
    # Without an order: four times the last difference.
    error = jnp.abs(d1) + jnp.abs(d2) / (1 - jnp.minimum(q, MAX_DIFFERENCE_RATIO))
    known = fine & jnp.isfinite(d1) & jnp.isfinite(d2)
    d1, d2, order, error = (jnp.where(known, x, jnp.nan) for x in (d1, d2, order, error))
    return ErrorEstimate(coarse, d1, d2, order, known & (rounded | (q <= MAX_DIFFERENCE_RATIO)), error)
