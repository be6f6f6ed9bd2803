"""The search for the worst case of a given controller in a box of plant, road and initial parameters.

    maximise metric(p),  p in [low, high]

One batch screens up to 64 corners of the box and random points. Gradient ascent starts from the worst of them. A run
with derivatives may end its steps on kinks, so its metrics may differ. Another batch therefore runs the ends of the
ascents again, without derivatives, and the result has only metrics of such plain runs.

In a box of more than six numbers, the corners have every combination of the ends of the first six. Every further number
is at its low end in half of these corners, in random order, and at its high end in the others.

The method is local. A run that exceeds a bound is a counterexample, but the worst case found depends on the starts. The
worst case is often a corner; a run of all corners then finds it without a gradient. `WorstCase.report` states how the
search found the worst case, and whether a certificate covers the box.
"""

import dataclasses
import itertools
import math
from collections.abc import Mapping

import jax
import jax.numpy as jnp
import numpy as np
from scipy.stats import qmc

from diffabs.core.bijectors import FreeSpace, Range, parameter_space
from diffabs.core.jax_flags import default_flags
from diffabs.core.kinds import format_value
from diffabs.core.protocols import Objective
from diffabs.core.pytree import ParameterSpec, parameters, replace
from diffabs.core.reason import Reason
from diffabs.core.types import PyTree, Vector
from diffabs.core.units import units_of
from diffabs.core.validity import check_part
from diffabs.engine.drive.engine import describe_engine
from diffabs.engine.solvers import Solver
from diffabs.loop.admissible import first_refusal
from diffabs.loop.batch import Batch
from diffabs.loop.closed_loop import Loop
from diffabs.loop.ensemble import run_batch
from diffabs.loop.result import Run
from diffabs.parts.objectives import default_objectives
from diffabs.tune.descent import Descent, DescentState, lbfgs
from diffabs.tune.method import DerivativeMode, Stopping
from diffabs.tune.problem import Multipliers, Problem, choose_gradient_mode
from diffabs.tune.risk import Mean

FULL_CORNERS = 6  # numbers of the box of which every combination of ends is run: up to 64 corners
CORNER_TOLERANCE = 1e-6  # relative; an ascent that approaches a corner never quite reaches it
EDGE_SHARE = 0.01  # of a range: least distance of a start from the ends; an ascent may end nearer


@dataclasses.dataclass(frozen=True, eq=False)
class WorstCase:
    """The greatest value of a metric that a search has found.

    All metrics are those of plain runs, without derivatives. A point with a NaN metric counts as -inf here, and appears
    in `diverged` instead.

    Attributes:
        metric: Name of the metric.
        values: Parameters of the worst case by path.
        value: Metric of the worst case.
        corners: Number of corners that were run.
        corner: Greatest metric among these corners.
        screened: Greatest metric among all screened points, corners included.
        metrics: All measured metrics of the worst case.
        loop: Loop with the parameters of the worst case.
        rollouts: Cost of the search; a gradient counts as `price` rollouts.
        bound: Bound on the metric, or None.
        diverged: Parameters of the first point, screened or at the end of an ascent, at which the run diverges or the
            metric is NaN; or None.
        reasons: Reason for the end of each ascent.
        engine: Engine of the ascents, with compiler and flags if it is a kernel.
    """

    metric: str
    values: dict[str, PyTree]
    value: float
    corners: int
    corner: float
    screened: float
    metrics: dict[str, float]
    loop: Loop
    rollouts: float
    bound: float | None
    diverged: dict[str, PyTree] | None
    reasons: list[Reason]
    engine: dict[str, str] = dataclasses.field(default_factory=dict)

    @property
    def met(self) -> bool | None:
        """Whether the metric stays within the bound and no run diverged; None without a bound."""
        return None if self.bound is None else self.diverged is None and self.value <= self.bound

    def report(self, proved: bool | None = None) -> str:
        """Return a counterexample, or the effort of the search that found none, in one or two sentences.

        `proved` states whether a certificate covers the box; None means that no certificate was computed.
        """
        at = ", ".join(f"{path} = {np.asarray(v).tolist()}" for path, v in self.values.items())
        if self.diverged is not None:
            at = ", ".join(f"{path} = {np.asarray(v).tolist()}" for path, v in self.diverged.items())
            return f"COUNTEREXAMPLE: the run diverges at {at}."
        case = f"{self.metric} = {self.value:.6g} at {at}"
        if self.met is False:
            beyond = f"beyond {self.bound:g} by {self.value - (self.bound or 0.0):.3g}"
            return f"COUNTEREXAMPLE: {case}, {beyond}. {self._finder()}"
        proof = {
            True: "The linear loop is proved stable over the box by a certificate.",
            False: "No certificate covers the box.",
            None: "Nothing was asked of a certificate.",
        }[proved]
        within = f", within {self.bound:g}" if self.bound is not None else ""
        return (
            f"No counterexample in {self.rollouts:.0f} rollouts: the worst is {case}{within}. {self._finder()} {proof}"
        )

    def _finder(self) -> str:
        """Return a sentence on how the search found the worst case: corner, screened point or gradients."""
        number = 2 ** sum(np.size(value) for value in self.values.values())
        all_run = self.corners == number
        worst = f"worst corner {self.corner:.6g}" + ("" if all_run else f", {self.corners} of {number} run")
        if math.isclose(self.value, self.corner, rel_tol=CORNER_TOLERANCE):
            if all_run:
                return f"That is a corner of the box: running its {number} corners finds it."
            return f"That is a corner of the box: it is one of the {self.corners} corners (of {number}) that were run."
        if self.value <= self.screened:
            return f"That is one of the points that were run first ({worst})."
        first = f"{self.screened:.6g}, the worst of the points that were run first"
        return f"Gradients found it from {first} ({worst})."


@default_flags()
def worst_case(
    loop: Loop,
    *,
    over: Mapping[str, Range],
    metric: str,
    solver: Solver,
    measured: Mapping[str, Objective] | None = None,
    bound: float | None = None,
    screen: int = 64,
    starts: int = 6,
    iterations: int = 10,
    seed: int = 0,
    seed_of_noise: int | None = None,
    price: float | None = None,
    engine: str = "auto",
) -> WorstCase:
    """Search a box for the greatest value of a metric: run a screening of points, then gradient ascent from the worst.

    Args:
        loop: A Loop. The box replaces its values of these parameters.
        over: The box {path: (low, high)}, with finite ends.
        metric: Name of the metric to maximise.
        solver: Solver of every run.
        measured: Objectives by metric; None takes the default objectives of the plant.
        bound: Bound on the metric; the result then states whether the metric exceeds it.
        screen: Number of points of a scrambled Sobol sequence that are run first, in addition to up to 64 corners.
        starts: Number of ascents, one from each of the worst screened points, in one batch; 0 only runs the screening.
        iterations: Greatest number of steps of each ascent.
        seed: Seed of the Sobol sequence, and of the corners of a box of more than six numbers.
        seed_of_noise: Seed of noisy sensors, the same in every run; or None.
        price: Cost of a gradient in rollouts. None is 6 in reverse mode and 1 + 1.5 p in forward mode, for p numbers in
            the box.
        engine: Engine of the runs and their derivatives, as in `build_problem`.

    Raises:
        ValueError: A path or range does not fit, the metric is unknown, a number is out of its range, a screened point
            cannot be run, or a requested kernel is impossible.

    See also:
        `tune.tune`: Better parameters for such cases.
        `prove_box`: A bound that no run of the box exceeds.
        `reliability.failure_probability`: How often a bound is exceeded.

    Notes:
        The search maximises m(p) for p in the box: corners and points of a Sobol sequence first, then ascents along
        dm/dp from the worst of them, in unbounded coordinates. It is local, so a bound that it does not exceed is not
        proved. A run that exceeds it is a counterexample. Source of the points: I. M. Sobol, USSR Comput. Math. Math.
        Phys. 7 (1967), scrambled as J. Matousek, J. Complexity 14 (1998).

    Examples:
        A locked wheel stops later from a higher speed, (14 - 5)/(mu g) = 1.21 s:

        >>> import diffabs as d
        >>> from diffabs import controllers, objectives, stops, tune
        >>> parts = {"initial": d.BrakeStart(speed=10.0, slip=1.0), "stop": stops.SpeedReached(speed=5.0)}
        >>> loop = d.braking(controller=controllers.ConstantTorque(torque=500.0), **parts)
        >>> worst = tune.worst_case(
        ...     loop,
        ...     over={"initial.speed": (8.0, 14.0)},
        ...     metric="stop_time",
        ...     measured={"stop_time": objectives.StopTime()},
        ...     bound=1.0,
        ...     solver=d.FixedStep(5e-3, 6.0),
        ...     screen=8,
        ...     starts=1,
        ... )
        >>> print(f"{worst.value:.2f} s from {worst.values['initial.speed']:.1f} m/s", worst.met)
        1.21 s from 14.0 m/s False
    """
    check_part(loop)
    measured = default_objectives(loop.plant) if measured is None else measured
    if metric not in measured:
        raise ValueError(f"{metric} is not measured; there is {', '.join(measured)}")
    _check_numbers(loop, measured[metric], bound, {"screen": screen, "starts": starts, "iterations": iterations})
    middle = replace(loop, _find_middle(loop, over))
    free, key = parameter_space(middle, over), None if seed_of_noise is None else (seed_of_noise,)
    ranges = np.array(free.ranges)
    corners = _draw_corners(ranges, seed)
    points = np.concatenate([corners, _draw_points(ranges, screen, seed)])
    if line := first_refusal(loop, _values_by_path(free, points), solver):
        raise ValueError(f"the box has points that cannot be run; {line}")

    def run_points(points: np.ndarray) -> Run:
        batch = Batch(_values_by_path(free, points), None if key is None else np.repeat(key, len(points)))
        return jax.device_get(run_batch(loop, batch, solver, measured, accepted=True, engine=engine))

    runs, screened = run_points(points), len(points)
    # NaN sorts last: a diverged point is a counterexample of its own, and a start only if there are too few others.
    worst = np.argsort(-runs.metrics[metric])[:starts]
    # The weight -1 turns the minimisation of Problem into a maximisation.
    problem = Problem(
        middle, free, solver, measured, {metric: -1.0}, Batch({}, key), Mean(), (), choose_gradient_mode(free), engine
    )
    screened_values = runs.metrics[metric][worst]
    screened_values = screened_values[np.isfinite(screened_values)]
    # The scale of the loss. It sets when an ascent ends, and the length of its first step.
    scale = max(abs(float(screened_values[0])), 1e-12) if len(screened_values) else 1.0
    lanes = _ascend(problem, points[worst], scale, iterations) if starts else []
    if price is None:
        price = 1 + 1.5 * free.size if problem.mode is DerivativeMode.FORWARD else 6.0
    ends = _find_ends(free, lanes)
    if len(ends):
        points = np.concatenate([points, ends])
        runs = jax.tree.map(lambda *columns: np.concatenate(columns), runs, run_points(ends))
    values = np.where(np.isnan(runs.metrics[metric]), -np.inf, runs.metrics[metric])
    i = int(np.argmax(values))
    place = _values_by_path(free, points[i])
    bad = np.flatnonzero(runs.diverged | np.isnan(runs.metrics[metric]))
    return WorstCase(
        metric=metric,
        values=place,
        value=float(values[i]),
        corners=len(corners),
        corner=float(np.max(values[: len(corners)])),
        screened=float(np.max(values[:screened])),
        metrics={name: float(x[i]) for name, x in runs.metrics.items()},
        loop=replace(loop, place),
        rollouts=len(points) + price * sum(lane.evaluations for lane in lanes),
        bound=bound,
        diverged=_values_by_path(free, points[bad[0]]) if len(bad) else None,
        reasons=[lane.reason or Reason.LIMIT for lane in lanes],
        engine=describe_engine(problem.find_engine()[0]),
    )


def _check_numbers(loop: Loop, objective: Objective, bound: float | None, counts: Mapping[str, int]) -> None:
    """Raise a ValueError if the bound is not finite, or if a count is negative or no whole number."""
    allowed = ParameterSpec(objective.unit or "1").around(units_of(loop.plant))
    if bound is not None and not allowed.holds(bound):
        raise ValueError(f"bound = {bound:g} is outside {allowed.interval()}")
    for name, count in counts.items():
        if not isinstance(count, int | np.integer) or count < 0:
            raise ValueError(f"{name} = {count!r} is no whole number in [0, inf)")


def _find_middle(loop: Loop, over: Mapping[str, Range]) -> dict[str, np.ndarray]:
    """Return the middle of the box by path, without paths that are no parameter: `parameter_space` refuses them."""
    middle = {}
    for path, spec, value in parameters(loop):
        if path not in over:
            continue
        try:
            ends = np.array([np.broadcast_to(end, np.shape(value)) for end in over[path]], float)
        except (TypeError, ValueError):
            ends = np.array([])
        if len(ends) != 2 or not np.isfinite(ends).all():
            shape = f" of shape {np.shape(value)}" if np.ndim(value) else ""
            needed = f"a pair (low, high) of finite numbers{shape} in {spec.around(units_of(loop.plant)).interval()}"
            raise ValueError(f"over: {path} = {format_value(over[path])} is not {needed}")
        middle[path] = ends.mean(axis=0)
    return middle


def _draw_corners(ranges: np.ndarray, seed: int) -> np.ndarray:
    """Return up to 64 different corners of the box, shape (corners, p); all if there are no more."""
    first = np.array(list(itertools.product(*ranges[:FULL_CORNERS])))
    both = np.repeat(ranges[FULL_CORNERS:].T, len(first) // 2, axis=0)
    return np.hstack([first, np.random.default_rng(seed).permuted(both, axis=0)])


def _draw_points(ranges: np.ndarray, screen: int, seed: int) -> np.ndarray:
    """Return points of a scrambled Sobol sequence in the box, shape (screen, p)."""
    low, high = ranges.T
    sequence = qmc.Sobol(len(low), rng=np.random.default_rng(seed))
    # Sobol points are balanced only in powers of two: draw the next power and keep the first `screen` points.
    return low + (high - low) * sequence.random_base2(max(screen - 1, 0).bit_length())[:screen]


def _values_by_path(free: FreeSpace, point: Vector) -> dict[str, PyTree]:
    """Return the parameters by path from a vector (p,), or from the rows of a matrix (runs, p)."""
    values, first = {}, 0
    for entry in free.entries:
        n = len(entry.maps)
        values[entry.path] = point[..., first : first + n].reshape((*np.shape(point)[:-1], *entry.shape))
        first += n
    return values


def _find_ends(free: FreeSpace, lanes: list[DescentState]) -> np.ndarray:
    """Return the ends of the ascents whose start could be run, shape (ends, p)."""
    low, high = np.array(free.ranges).T
    ends = [jnp.asarray(lane.z) for lane in lanes if lane.reason is not Reason.START]
    rows = [np.concatenate([np.ravel(x) for x in free.values(z).values()]) for z in ends]
    # Rounding of the map from z may leave the box.
    return np.clip(np.reshape(rows, (-1, free.size)), low, high)


def _ascend(problem: Problem, points: np.ndarray, scale: float, iterations: int) -> list[DescentState]:
    """Return the final states of ascents from these points, with the metric divided by `scale`."""
    low, high = np.array(problem.space.ranges).T
    # The map from z to a range is flat at its ends: an ascent from a corner would have no gradient.
    points = np.clip(points, low + EDGE_SHARE * (high - low), high - EDGE_SHARE * (high - low))
    z = np.stack(
        [problem.space.place(replace(problem.subject, _values_by_path(problem.space, point))) for point in points]
    )
    none = Multipliers(np.zeros((len(z), 0)), np.ones(len(z)))
    loss = problem.loss(scale)
    descent = Descent(
        problem.evaluator(scale),
        lambda z, m: loss(z, m)[0],
        problem.steady(),
        lbfgs(),
        Stopping(iterations=iterations),
        lambda lanes: None,
        steepness=problem.space.steepness,
    )
    return descent.run(z, none)
