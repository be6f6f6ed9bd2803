"""Estimates of the discretisation errors of a run's metrics by Richardson extrapolation, without a reference solution.

    d1 = m(h/2) - m(h),  d2 = m(h/4) - m(h/2),  q = |d2/d1| = 2^-p for a method of order p
    |m(h) - m(0)|, about                    |d1| + |d2| (1 + q + q^2 + ...)

With p = 4 the error of the step h is 16/15 of d1. The error of the half step is 1/15 of d1. If q exceeds
`MAX_DIFFERENCE_RATIO`, the differences do not shrink: the metric has no order and no limit can be estimated.

Runs with different steps are comparable only if everything with its own clock keeps that clock. Noise is drawn and a
sampled controller computes once per period. The ring buffer of a delay becomes longer (`refined`). `_has_same_noise`
compares the noise drawn at both steps. A block that works once in every step (`every_step`) is a different block under
another step. If runs are not comparable, both differences, the order and the error are NaN.

Source: L. F. Richardson, Phil. Trans. R. Soc. A 210 (1911).
"""

from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from diffabs.core.blocks import innermost_blocks, offers
from diffabs.core.protocols import Clock, Memory, Objective
from diffabs.core.pytree import refine_parts
from diffabs.core.types import Array, Bool, Int, Key, Part, PyTree, Scalar, Vector
from diffabs.engine.solvers import Solver, refine_solver
from diffabs.loop.closed_loop import BLOCKS, Loop
from diffabs.loop.result import Run
from diffabs.loop.run import measure

MAX_DIFFERENCE_RATIO = 0.75  # greatest |d2/d1| of a convergent metric: an order of 0.4
ROUNDING_EPS = 1e3  # multiples of machine epsilon: smaller differences count as rounding errors
MAX_COMPARED_INSTANTS = 256  # greatest number of instants at which noise is compared


class ErrorEstimate(NamedTuple):
    """Error estimate of one metric, in the metric's unit (`order` and `converges` have none).

    If the runs are not comparable, every number but `value` is NaN, and the flags are False.

    Attributes:
        value: Value m(h) with the step h of the solver.
        difference: Change d1 = m(h/2) - m(h) by the half step.
        finer: Change d2 = m(h/4) - m(h/2) by the quarter step.
        order: Observed order p = -log2(|d2/d1|). NaN if both differences are rounding errors, or if d2 = 0.
        converges: True if |d2/d1| is at most `MAX_DIFFERENCE_RATIO`, or if both differences are rounding errors.
        error: Estimate |d1| + |d2|/(1 - q) of the error of `value`, with q = |d2/d1|. A larger q than
            `MAX_DIFFERENCE_RATIO` is replaced by this limit: the error is then not reliable.
        turned: True if the metric is finite with one of the three steps and not with another.
    """

    value: Scalar
    difference: Scalar
    finer: Any
    order: Scalar
    converges: Bool
    error: Scalar
    turned: Bool


class Accuracy(NamedTuple):
    """Error estimates of all metrics of a run.

    Attributes:
        estimates: Error estimate of each metric, by name.
        comparable: True if the runs can be compared. `incomparability_reasons` returns the reasons otherwise.
        alike: True if no run diverged and either all or none reached their stop.
    """

    estimates: dict[str, ErrorEstimate]
    comparable: Bool
    alike: Bool


def estimate_accuracy(
    loop: Loop, solver: Solver, objectives: Mapping[str, Objective], *, key: Key | None = None
) -> Accuracy:
    """Return error estimates for the metrics that `measure` returns for the same arguments.

    The function runs the loop with the steps h, h/2 and h/4, so it costs as much as seven runs of `measure`. It is
    pure: batch it with `jax.vmap`. Runs that are not comparable raise no error: their estimates are NaN. Every period
    of a block must be a multiple of `solver.step`.
    """
    runs = [measure_finer(loop, solver, objectives, times, key=key) for times in (1, 2, 4)]
    comparable = is_comparable(loop, solver, key)
    coarse, half, quarter = (run.metrics for run in runs)
    estimates = {name: _estimate(coarse[name], half[name], quarter[name], comparable) for name in objectives}
    return Accuracy(estimates, comparable, runs_end_alike(*runs))


def measure_finer(
    loop: Loop, solver: Solver, objectives: Mapping[str, Objective], times: int, *, key: Key | None = None
) -> Run:
    """Return the result of `measure` with a step of `solver.step`/`times`.

    The run lasts as long as with the original step. Delays keep their length in seconds. An `Adaptive` solver also gets
    a smaller `rtol` (`refine_solver`).
    """
    return measure(refine_parts(loop, times), refine_solver(solver, times), objectives, key=key)


def runs_end_alike(*runs: Run) -> Array:
    """Return True if no run diverged and either all or none of the runs reached their stop."""
    stopped = jnp.stack([run.stopped for run in runs])
    return ~jnp.stack([run.diverged for run in runs]).any(0) & (stopped.all(0) | ~stopped.any(0))


def relative_difference(difference: Scalar, value: Scalar) -> Scalar:
    """Return |difference/value|: 0 for a zero difference, infinite for a nonzero difference from a zero value."""
    size, of = jnp.abs(difference), jnp.abs(value)
    return jnp.where(size == 0, 0.0, size / jnp.where(of > 0, of, 1.0) + jnp.where(of > 0, 0.0, jnp.inf))


def is_comparable(loop: Loop, solver: Solver, key: Key | None = None, divisors: tuple[int, ...] = (2, 4)) -> Bool:
    """Return True if a shorter step changes neither the noise of the loop nor the instants at which a block computes.

    The step is divided by each of `divisors`. Without a key (None) the noise is not compared.
    """
    return (not any(True for _ in per_step_blocks(loop))) & _has_same_noise(loop, solver, divisors, key)


def incomparability_reasons(loop: Loop, solver: Solver, key: Key | None = None) -> list[str]:
    """Return one line for each reason why runs with other steps are not comparable; an empty list if they are."""
    lines = [
        f"{name} computes once in every step: with another step it is another {name}" for name in per_step_blocks(loop)
    ]
    if not _has_same_noise(loop, solver, (2, 4), key):
        lines.append("a shorter step draws other noise: give the sensor a period that is a multiple of solver.step")
    return lines


def per_step_blocks(loop: Loop) -> Iterator[str]:
    """Yield the names of the blocks (such as "controller") that compute at every step instead of on a clock."""
    for name in BLOCKS:
        if any(getattr(block, "every_step", False) for block in innermost_blocks(getattr(loop, name))):
            yield name


def needs_key(loop: Loop) -> bool:
    """Return True if the loop has noise: its sensor raises an error without a key."""
    try:
        # Tracing for shapes alone reaches the sensor's check for a key and computes nothing.
        jax.eval_shape(lambda x: _draws(x, 1e-3, 1, None), loop)
    except ValueError:
        return True
    return False


def _has_same_noise(loop: Loop, solver: Solver, divisors: tuple[int, ...], key: object) -> Bool:
    """Return True if the sensor shows the same values at the common instants with the steps of all `divisors`.

    The plant's signal is held constant, so only noise can differ. At most `MAX_COMPARED_INSTANTS` instants are
    compared.
    """
    if key is None:
        return jnp.asarray(True)
    count = min(solver.steps, MAX_COMPARED_INSTANTS)
    steps = jnp.asarray([solver.step, *(solver.step / times for times in divisors)])
    # All steps share one scan: a program for each would take as long to compile as a run.
    outputs = jax.vmap(lambda h: _draws(loop, h, count * max(divisors), key))(steps)

    def agree(x: Vector) -> Bool:
        coarse = x[0, :count]
        finer = jnp.stack([x[i, : count * times : times] for i, times in enumerate(divisors, 1)])
        return jnp.all((coarse == finer) | (jnp.abs(coarse - finer) <= 1e-6 * jnp.abs(coarse)))  # infinities are equal

    return jnp.all(jnp.stack([agree(x) for x in jax.tree.leaves(outputs)]))


def _draws(loop: Loop, h: Scalar, count: int, key: PyTree) -> Scalar:
    """Return the sensor's outputs at the times 0, h, 2 h, ..., a pytree with leaves (count, ...).

    The plant stays in its start state.
    """
    signal = loop.plant.output(loop.plant.start(loop.initial))
    signal = jax.tree.map(lambda x: jnp.asarray(x, jnp.result_type(float)), signal)
    sensor: Part = loop.sensor
    start = sensor.start(signal)

    def step(memory: Memory, k: Int) -> tuple[Memory, PyTree]:
        ticked = sensor.tick(Clock(k * h, h, k, key), memory, signal) if offers(sensor, "tick") else memory
        held = jax.tree.map(lambda x, old: jnp.asarray(x, jnp.result_type(old)), ticked.held, start.held)
        return Memory(start.flow, held), sensor.output(k * h, Memory(start.flow, held), signal)

    return jax.lax.scan(step, start, jnp.arange(count))[1]


def _estimate(coarse: Scalar, half: Scalar, quarter: Scalar, comparable: Bool) -> ErrorEstimate:
    """Return the error estimate of a metric from its values m(h), m(h/2) and m(h/4).

    `comparable` is True if the runs with these steps are comparable.
    """
    d1, d2 = half - coarse, quarter - half
    # The inner `where` replaces a zero divisor: the quotient of the branch not taken stays finite.
    q = jnp.where(d1 == 0, jnp.where(d2 == 0, 0.0, jnp.inf), jnp.abs(d2) / jnp.where(d1 == 0, 1.0, jnp.abs(d1)))
    floor = ROUNDING_EPS * jnp.finfo(jnp.result_type(coarse)).eps * jnp.abs(quarter)
    rounded = (jnp.abs(d1) <= floor) & (jnp.abs(d2) <= floor)
    order = jnp.where(rounded | (q == 0), jnp.nan, -jnp.log2(jnp.where(q > 0, q, 1.0)))
    # The geometric series |d2| (1 + q + q^2 + ...) is capped at q = MAX_DIFFERENCE_RATIO: then its sum is 4 |d2|.
    error = jnp.abs(d1) + jnp.abs(d2) / (1 - jnp.minimum(q, MAX_DIFFERENCE_RATIO))
    valid = comparable & jnp.isfinite(d1) & jnp.isfinite(d2)
    d1, d2, order, error = (jnp.where(valid, x, jnp.nan) for x in (d1, d2, order, error))
    finite = jnp.isfinite(jnp.stack([coarse, half, quarter]))
    turned = comparable & jnp.any(finite) & ~jnp.all(finite)
    return ErrorEstimate(coarse, d1, d2, order, valid & (rounded | (q <= MAX_DIFFERENCE_RATIO)), error, turned)
