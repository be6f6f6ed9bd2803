"""Bounds on the margins of the linear loop, as constraints of a tuning, at every point of a box."""

import dataclasses
from collections.abc import Iterable, Mapping

import jax
import jax.numpy as jnp
import numpy as np

from diffabs.core.channels import control_names
from diffabs.core.compiling import SAME_RESULT_OPTIONS
from diffabs.core.types import Array, Params, Scalar
from diffabs.linear.opened_loop import OpenLoop, open_traced, tracked_columns
from diffabs.linear.responses.grid import FrequencyGrid, place_frequencies
from diffabs.linear.responses.loop_margins import (
    Change,
    Margin,
    delay_margin_on,
    find_sensitivity_peaks,
    phase_margin_on,
)
from diffabs.linear.responses.opening import join_halves, sampled_delay_margin_on
from diffabs.linear.responses.response import (
    TracedSystem,
    as_arrays,
    closed_poles_without_delay,
    largest_singular_values,
    respond,
    respond_sensitivity,
)
from diffabs.loop.batch import Batch
from diffabs.loop.closed_loop import Loop
from diffabs.tune.constraints import MIN_POLE_MAGNITUDE

MAX_BOUNDED_PEAKS = 3  # highest peaks of a response, each with an excess of its own: their order may change in a search
LEAST_EXCESS = -1.0  # of a bound that is far from reached, or of a margin without a limit
AT_MOST = ("sensitivity", "complementary", "control_noise", "shape")
AT_LEAST = ("delay_margin", "phase_margin", "pole_decay", "pole_damping")
OF_ONE_CONTROL = AT_LEAST[:2]
BOUNDED_POLES = 4  # those that are nearest to a bound, each with an excess


@dataclasses.dataclass(frozen=True, eq=False)
class FrequencyBounds:
    """Bounds of a loop's margins, at every point of a batch; each is None for no bound.

    The loop is that of `linear.open_loop`: linear, at rest on its setpoint, with exact delays and sampling. A loop with
    several channels has the peaks of the largest singular value, so `sensitivity=2.0` keeps the least singular value of
    the return difference above 0.5.

    Derivatives are right at the peaks (`linear.responses`). An unstable loop has excesses NaN: a search rejects a step
    there, and its start must be stable.

    Attributes:
        sensitivity: Largest |S| over all frequencies.
        complementary: Largest |T|.
        delay_margin: Least added delay that makes the loop unstable [s].
        phase_margin: Least angle to -1 [rad].
        pole_decay: Least decay rate of the closed loop's poles [1/s]; of a loop without pure delay.
        pole_damping: Least damping ratio of the closed loop's poles; of a loop without pure delay.
        control_noise: Largest gain from noise on the tracked signals to the command, in their units.
        shape: Rows (frequency [rad/s], bound of |S|); straight between them on logarithmic axes, constant outside.
        points: The points of the box: values by path of the loop.

    Examples:
        >>> from diffabs import tune
        >>> from diffabs.loop.batch import grid
        >>> from diffabs.scenario import load
        >>> bounds = tune.FrequencyBounds(sensitivity=2.0, points=grid({"plant.mass": [5.3, 6.2]}))
        >>> bounds.worst(load("slip-lmi").loop)["sensitivity"] > 2.0
        True
    """

    sensitivity: float | None = None
    complementary: float | None = None
    delay_margin: float | None = None
    phase_margin: float | None = None
    pole_decay: float | None = None
    pole_damping: float | None = None
    control_noise: float | None = None
    shape: tuple[tuple[float, float], ...] = ()
    points: Batch = dataclasses.field(default_factory=Batch)

    @property
    def bounds(self) -> Mapping[str, float]:
        """The bounds by name; that of the shape is 1, of the largest |S| over its bound."""
        numbers = {name: getattr(self, name) for name in (*AT_MOST[:3], *AT_LEAST)}
        return {name: bound for name, bound in numbers.items() if bound is not None} | (
            {"shape": 1.0} if self.shape else {}
        )

    def excess(self, loop: Loop, metrics: Params) -> Scalar:
        """Return the relative excesses of all bounds, (k,): several for each bound and point. `metrics` is not used."""
        del metrics
        values, bounds = self.evaluate(loop), self.bounds
        excesses = []
        for name, bound in bounds.items():
            beyond = values[name] / bound - 1 if name in AT_MOST else 1 - values[name] / bound
            excesses.append(jnp.maximum(beyond, LEAST_EXCESS).ravel())
        return jnp.concatenate(excesses) if excesses else jnp.zeros(0)

    def worst(self, loop: Loop) -> dict[str, float]:
        """Return the worst value of each bounded margin over all points; NaN if the loop is unstable at one."""
        return worst_of(jax.jit(self.evaluate, compiler_options=SAME_RESULT_OPTIONS)(loop))

    def evaluate(self, loop: Loop) -> dict[str, Array]:
        """Return the values of each bounded margin at each point, (points, k); those that are not the worst included.

        Raises:
            ValueError: A bound of one channel for a plant with several controls, or a part has no linear model.
        """
        check_one_control(self.bounds, loop)
        return self.points.each(loop, lambda loop, key: self._evaluate_point(loop))

    def _evaluate_point(self, loop: Loop) -> dict[str, Array]:
        halves = open_traced(loop)
        opened = join_halves(halves)
        grid = place_frequencies(opened)
        values = {name: self._evaluate_bound(name, loop, halves, opened, grid) for name in self.bounds}
        return {name: jnp.where(grid.decided, value, jnp.nan) for name, value in values.items()}

    def _evaluate_bound(
        self, name: str, loop: Loop, halves: OpenLoop, opened: TracedSystem, grid: FrequencyGrid
    ) -> Array:
        if name in ("pole_decay", "pole_damping"):
            return least_of_poles(opened, name)
        if name == "phase_margin":
            return _both(phase_margin_on(opened, grid))
        if name == "delay_margin" and opened.period is None:
            return _both(delay_margin_on(opened, grid))
        if name == "delay_margin":
            return _both(sampled_delay_margin_on(halves, opened, grid))
        change = self._weighted_sensitivity(name, loop, halves)
        tops = find_sensitivity_peaks(opened, grid, change)[0]
        if name == "shape":  # a peak on a corner of the shape has no slope of zero, so the search misses it
            corners = jnp.array(self.shape)[:, 0]
            tops = jnp.append(tops, largest_singular_values(change(respond_sensitivity(opened, corners), corners)))
        return jax.lax.top_k(tops, MAX_BOUNDED_PEAKS)[0]

    def _weighted_sensitivity(self, name: str, loop: Loop, halves: OpenLoop) -> Change:
        """Return the function of S and of the frequency whose largest singular value is bounded."""

        def complement(s: Array, w: Array) -> Array:
            return jnp.eye(s.shape[-1]) - s

        def respond_to_noise(s: Array, w: Array) -> Array:
            columns, controller = tracked_columns(loop), as_arrays(halves.controller, 0)
            return s @ respond(controller._replace(B=controller.B[:, columns], D=controller.D[:, columns]), w)

        def divide_by_shape(s: Array, w: Array) -> Array:
            frequencies, values = jnp.log(jnp.array(self.shape)).T
            return s / jnp.exp(jnp.interp(jnp.log(w), frequencies, values))[:, None, None]

        changes: dict[str, Change] = {
            "sensitivity": lambda s, w: s,
            "complementary": complement,
            "control_noise": respond_to_noise,
            "shape": divide_by_shape,
        }
        return changes[name]


def check_one_control(bounds: Iterable[str], loop: Loop) -> None:
    """Raise a ValueError if a bound is of one control and the plant has several."""
    if (names := control_names(loop.plant)) and (single := set(bounds) & set(OF_ONE_CONTROL)):
        raise ValueError(f"{', '.join(sorted(single))}: of one control; the plant has {', '.join(names)}")


def least_of_poles(opened: TracedSystem, name: str) -> Array:
    """Return the least decay rates [1/s] or damping ratios of the closed loop's poles; NaN with a pure delay."""
    poles = closed_poles_without_delay(opened)
    if opened.period is not None:
        # ln 0 and its derivative are infinite, so a pole at z = 0 is replaced before the logarithm.
        alive = jnp.abs(poles) > MIN_POLE_MAGNITUDE
        poles = jnp.log(jnp.where(alive, poles, MIN_POLE_MAGNITUDE)) / opened.period
    values = -poles.real if name == "pole_decay" else -poles.real / jnp.abs(poles)
    return jnp.where(opened.delay > 0, jnp.nan, -jax.lax.top_k(-values, min(BOUNDED_POLES, len(poles)))[0])


def worst_of(values: Mapping[str, Array]) -> dict[str, float]:
    """Return the worst of the values of each margin."""
    return {name: float(np.max(v) if name in AT_MOST else np.min(v)) for name, v in values.items()}


def _both(margin: Margin) -> Array:
    """Return a margin and the next one: their order may change in a search."""
    return jnp.stack([margin.value, margin.runner_up])
