"""Safeguarded descent from many starts at once, with any optimiser of optax.

The optimiser proposes an update u; the step t u is taken if the loop there is finite and its integration stable, and,
where u is only a direction (L-BFGS), if it satisfies the weak Wolfe conditions

    L(z + t u) <= L(z) + 1e-4 t g'u,   g(z + t u)'u >= 0.9 g'u

t is found by bisection and expansion, as A. S. Lewis and M. L. Overton, Nonsmooth optimization via quasi-Newton
methods, Math. Program. 141 (2013), recommend for functions with kinks. A point that diverges or is not stable is too
far, and its gradient is never used. All starts are evaluated in one compiled call; each decides on its own."""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax

from diffabs.core.reason import Reason
from diffabs.tune.problem import Evaluation, Multipliers

ARMIJO, WOLFE = 1e-4, 0.9
SHORTEST = 1e-10  # of t
EXPANSION = 4.0
TRIALS = 12  # of a line search that has found something better, before it is content with that
JUMPS = 2  # such searches in a row: no point beyond is better, so the loss jumps there and its gradient is no guide
LONGEST = 2.0  # of a component of u, in units of z: about half of a finite range
PATIENCE = 3  # accepted steps in a row that gain nothing


@dataclasses.dataclass(frozen=True)
class Stopping:
    """When a descent ends: the greatest component of the gradient of L (of order one at the start), the relative change
    of L over three steps, or the number of accepted steps."""

    gradient: float = 1e-6
    change: float = 1e-7
    iterations: int = 100


class Point(NamedTuple):
    """A line of a history."""

    iteration: int
    objective: float
    loss: float
    gradient: float  # greatest component
    violation: float  # greatest excess, in units of the constraints' scales
    evaluations: int  # so far, rejected ones included


class Kept(NamedTuple):
    """A step that meets every constraint."""

    z: np.ndarray
    seen: Any
    point: Point


@dataclasses.dataclass
class Lane:
    """One start on its way."""

    z: np.ndarray
    loss: float
    gradient: np.ndarray
    seen: Any
    update: np.ndarray
    t: float = 1.0
    low: float = 0.0  # greatest step known to be too short, and `better`, what is there
    high: float = np.inf  # least step known to be too long
    better: tuple[np.ndarray, Any] | None = None
    trials: int = 0
    idle: int = 0
    jumps: int = 0
    evaluations: int = 1
    iterations: int = 0
    reason: Reason | None = None
    history: list[Point] = dataclasses.field(default_factory=list)
    kept: Kept | None = None  # the best step so far that meets every constraint

    def note(self) -> None:
        """Add the present point to the history, and keep it if it is the best that meets the constraints."""
        worst = float(np.max(self.seen.excess, initial=0.0))
        self.history.append(
            Point(
                self.iterations,
                float(self.seen.objective),
                self.loss,
                float(np.max(np.abs(self.gradient))),
                worst,
                self.evaluations,
            )
        )
        if worst <= 0:
            self.keep(Kept(self.z, self.seen, self.history[-1]))

    def keep(self, other: Kept | None) -> None:
        """The better of two."""
        if other and not (self.kept and self.kept.point.objective <= other.point.objective):
            self.kept = other

    def go_back(self) -> None:
        """To the step that was kept, if the present point does not meet the constraints."""
        last = self.history[-1]
        if self.kept and not last.violation <= 0:
            self.z, self.seen, self.reason = self.kept.z, self.kept.seen, Reason.KEPT
            point = self.kept.point._replace(iteration=last.iteration, evaluations=last.evaluations)
            self.history.append(point)


class Optimiser(NamedTuple):
    """An optimiser of optax; `searches` if its updates are directions for a line search, not steps to be taken."""

    transformation: optax.GradientTransformationExtraArgs
    searches: bool


def lbfgs(memory: int = 10) -> Optimiser:
    """optax's L-BFGS direction; the line search is this module's, which knows what to do where a run diverges."""
    chain = optax.chain(optax.scale_by_lbfgs(memory_size=memory), optax.scale(-1.0))
    return Optimiser(optax.with_extra_args_support(chain), True)


Evaluate = Callable[[Any, Multipliers], Evaluation]


class Descent:
    """Descends from the starts z (starts, p) under fixed multipliers."""

    def __init__(
        self,
        evaluate: Evaluate,
        loss: Callable[[Any, Any], Any],
        steady: Callable[[np.ndarray], np.ndarray],
        optimiser: Optimiser,
        stopping: Stopping,
        told: Callable[[list[Lane]], None],
        interrupted: Callable[[], bool] = lambda: False,
    ):
        """`loss` is that of one start, for optimisers that search on their own; `told` is called with all starts after
        every evaluation, and then `interrupted`, which ends them all."""
        self.evaluate, self.steady, self.stopping, self.told = evaluate, steady, stopping, told
        self.interrupted = interrupted
        self.searches = optimiser.searches
        self._init = jax.jit(jax.vmap(optimiser.transformation.init))

        def update(g: Any, state: Any, z: Any, value: Any, m: Any) -> Any:
            more = {"value": value, "grad": g, "value_fn": lambda z: loss(z, m)}
            return optimiser.transformation.update(g, state, z, **more)

        self._update = jax.jit(jax.vmap(update))

    def run(self, starts: np.ndarray, multipliers: Multipliers) -> list[Lane]:
        """Every start to its end."""
        self.multipliers = multipliers
        first, fine = self._evaluated(starts)
        lanes = [
            Lane(z, float(first.loss[i]), first.gradient[i], at(first.seen, i), np.zeros_like(z))
            for i, z in enumerate(starts)
        ]
        for lane, ok in zip(lanes, fine, strict=True):
            lane.reason = self._finished(lane) if ok else Reason.START
            lane.note()
        self.states = self._init(jnp.asarray(starts))
        self._propose(lanes, [lane.reason is None for lane in lanes])
        self.told(lanes)
        while any(lane.reason is None for lane in lanes) and not self.interrupted():
            self._round(lanes)
            self.told(lanes)
        for lane in lanes:
            lane.reason = lane.reason or Reason.INTERRUPTED
        return lanes

    def _round(self, lanes: list[Lane]) -> None:
        trials = np.stack([lane.z + lane.t * lane.update for lane in lanes])
        found, fine = self._evaluated(trials)
        moved = []
        for i, lane in enumerate(lanes):
            taken = self._judged(lane, fine[i], trials[i], at(found, i)) if lane.reason is None else None
            if taken:
                self._take(lane, *taken)
            moved.append(taken is not None and lane.reason is None)
        self._propose(lanes, moved)

    def _evaluated(self, z: np.ndarray) -> tuple[Evaluation, np.ndarray]:
        """Evaluation, and which of them may be used."""
        found = jax.device_get(self.evaluate(jnp.asarray(z), self.multipliers))
        fine = np.isfinite(found.loss) & np.isfinite(found.gradient).all(axis=1) & (found.seen.diverged == 0)
        return found, fine & self.steady(z)

    def _judged(self, lane: Lane, fine: bool, z: np.ndarray, found: Evaluation) -> tuple[np.ndarray, Evaluation] | None:
        """The point to go to; or None, and another step to try."""
        lane.evaluations += 1
        lane.trials += 1
        slope = float(lane.gradient @ lane.update)
        longest = lane.t * np.max(np.abs(lane.update)) >= LONGEST * (1 - 1e-9)
        if fine and not self.searches:
            return z, found
        if not fine or float(found.loss) > lane.loss + ARMIJO * lane.t * slope:
            lane.high = lane.t
        elif float(found.gradient @ lane.update) < WOLFE * slope and not longest:
            lane.low, lane.better = lane.t, (z, found)
        else:
            lane.jumps = 0
            return z, found
        if lane.better and lane.trials >= TRIALS:
            lane.jumps += np.isfinite(lane.high)
            return lane.better
        lane.t = _next(lane, float(found.loss) if fine else np.inf, slope)
        if lane.t < SHORTEST:
            lane.reason = Reason.STEP
        return None

    def _take(self, lane: Lane, z: np.ndarray, found: Evaluation) -> None:
        gained = abs(lane.loss - float(found.loss))
        lane.idle = lane.idle + 1 if gained <= self.stopping.change * max(abs(lane.loss), 1e-12) else 0
        lane.z, lane.loss, lane.gradient, lane.seen = z, float(found.loss), found.gradient, found.seen
        lane.t, lane.low, lane.high, lane.better, lane.trials = 1.0, 0.0, np.inf, None, 0
        lane.iterations += 1
        lane.note()
        lane.reason = self._finished(lane)

    def _finished(self, lane: Lane) -> Reason | None:
        if np.max(np.abs(lane.gradient)) <= self.stopping.gradient:
            return Reason.GRADIENT
        if lane.idle >= PATIENCE:
            return Reason.CHANGE
        if lane.jumps >= JUMPS:
            return Reason.JUMP
        return Reason.LIMIT if lane.iterations >= self.stopping.iterations else None

    def _propose(self, lanes: list[Lane], fresh: list[bool]) -> None:
        """New updates for the starts that have moved; the others keep theirs."""
        if not any(fresh):
            return
        z, g = (jnp.stack([getattr(lane, name) for lane in lanes]) for name in ("z", "gradient"))
        loss = jnp.array([lane.loss for lane in lanes])
        g = jnp.where(jnp.isfinite(g), g, 0.0)
        updates, states = self._update(g, self.states, z, loss, self.multipliers)
        updates = np.array(updates)
        bad = [self.searches and not _descends(u, lane.gradient) for u, lane in zip(updates, lanes, strict=True)]
        if any(b and f for b, f in zip(bad, fresh, strict=True)):
            again, restarted = self._update(g, self._init(z), z, loss, self.multipliers)
            updates = np.where(np.array(bad)[:, None], again, updates)
            states = _chosen(np.array(bad), restarted, states)
        self.states = _chosen(np.array(fresh), states, self.states)
        for lane, update, new in zip(lanes, updates, fresh, strict=True):
            if new:
                lane.update = update * min(1.0, LONGEST / max(float(np.max(np.abs(update))), 1e-300))


def _next(lane: Lane, loss: float, slope: float) -> float:
    """The next step of a line search: longer, or between what is too short and what is too long; there the minimum of
    the parabola through what is known, where nothing is known to be too short."""
    if not np.isfinite(lane.high):
        return min(EXPANSION * lane.t, LONGEST / float(np.max(np.abs(lane.update))))
    if lane.low > 0 or not np.isfinite(loss):
        return 0.5 * (lane.low + lane.high) if lane.low > 0 else 0.25 * lane.high
    bend = loss - lane.loss - lane.t * slope
    return lane.t * min(0.5, max(0.1, -slope * lane.t / (2 * bend)))


def _descends(update: np.ndarray, gradient: np.ndarray) -> bool:
    size = np.linalg.norm(update) * np.linalg.norm(gradient)
    return bool(np.isfinite(size) and update @ gradient < -1e-10 * size)


def _chosen(which: np.ndarray, a: Any, b: Any) -> Any:
    """Start by start, a or b."""
    return jax.tree.map(lambda x, y: jnp.where(which.reshape(-1, *[1] * (jnp.ndim(x) - 1)), x, y), a, b)


def at(tree: Any, i: int) -> Any:
    """Return what is said of one start."""
    return jax.tree.map(lambda x: x[i], tree)
