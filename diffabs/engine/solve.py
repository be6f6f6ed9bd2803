"""Solutions of any field, with events; undeclared switches of the field are located, as in every run.

`field` has the hybrid system of a field with events, `admission` makes it of the arguments. Some runs have no right
answer, or none that could be computed: `SolutionStatus` names them, and their times and states are NaN.
"""

from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax._src.source_info_util import summarize  # JAX has no public function that names the line of an operation

from diffabs.core import kinds
from diffabs.core.compiling import is_traced
from diffabs.core.jax_flags import default_flags
from diffabs.core.numerics import invalidate
from diffabs.core.types import AnyArray, Array, Bool, Numbers, PyTree, Scalar
from diffabs.engine.admission import build_field, has_tracer, read_solver, trace_field
from diffabs.engine.drive.deferred import run_deferred
from diffabs.engine.drive.engine import resolve_request
from diffabs.engine.drive.loops import log_run, round_up_capacity
from diffabs.engine.drive.runs import RunPlan, run_differentiable
from diffabs.engine.field import COINCIDENCE_FRACTION, Event, Field, FieldSystem, Saves, SolutionStatus
from diffabs.engine.solvers import Adaptive, Solver
from diffabs.engine.step.adaptive import AdaptiveStepping
from diffabs.engine.step.event_location import RunStatus, end_unfinished
from diffabs.engine.step.fixed import FixedStepping
from diffabs.engine.step.inner_functions import SEARCHSORTED
from diffabs.engine.step.replay import log_attempt, log_capacity
from diffabs.engine.step.system import UNCONSTRAINED, build_system

MAX_EVENTS = 24  # kinds of events of a solution: the log of a run has one bit for each
SWITCH_SOLVER = Adaptive(1e-6)


class Switch(NamedTuple):
    """A comparison in a field that depends on time or state.

    Attributes:
        source: File and line of the comparison.
        operation: What JAX calls it: `gt`, `max`, `abs`, `clamp`, `searchsorted`.
        margin: Difference of its two sides, an array for a comparison of arrays; zero where the answer changes. For a
            search in knots, the distance to the nearest one.
        flips: Times at which an answer changes in a run; () without a run.
    """

    source: str
    operation: str
    margin: Numbers
    flips: tuple[float, ...]


class SolutionEvents(NamedTuple):
    """The events of a solution, in the order of the argument `events`.

    Attributes:
        times: Times of the first events of each kind, shape (events, kept), differentiable; NaN where there is none.
        counts: Number of events of each kind, shape (events,), integers.
    """

    times: Array
    counts: Array


class Solution(NamedTuple):
    """The solution of a field.

    Attributes:
        t: Time at the end, or the times `save`. A terminal event ends a solution before t1.
        y: State there, with an axis for the times in front of each leaf if there is `save`. An event at a save time
            before t1 is over there. After a terminal event the last state is repeated. NaN unless the status is valid.
        events: Times and counts of the events.
        status: A `SolutionStatus`, as an integer.
    """

    t: Array
    y: PyTree
    events: SolutionEvents
    status: Array


@default_flags()
def solve(
    field: Field,
    y0: object,
    t0: Array,
    t1: Scalar,
    args: object = None,
    *,
    solver: Solver,
    events: Sequence[Event] = (),
    save: AnyArray | None = None,
    engine: str = "auto",
    kept_events: int = 16,
) -> Solution:
    """Solve dy/dt = field(t, y, args) from t0 to t1, with events.

    Every comparison in the field that depends on t or y is a switch. Steps end where it changes, so that values keep
    the order of the method, and derivatives are right. `switches` lists them. The function works under `jax.jit`,
    `jax.vmap` and both modes of differentiation, by y0, t0, t1, args, `save` and all values that the functions close
    over. It is compiled again where a constant of a function has changed, so pass parameters by `args`.

    Args:
        field: Pure function of (t, y, args) that returns dy/dt, with the structure and shapes of y.
        y0: State at t0, any pytree of real numbers and arrays.
        t0: Start [unit of time of the field].
        t1: End; before t0, time runs backwards.
        args: Anything that the functions need, a pytree of arrays and numbers.
        solver: `FixedStep` or `Adaptive`. `step` or `rtol`, and `follow_slides`, are read: t0 and t1 replace the
            duration, and `save` the stride. Fixed steps are shortened to a whole number.
        events: Events; several at one instant happen in this order. One exactly at t1 does not happen. A terminal
            event at the instant of others may come before or after them; after it, none happens.
        save: Times between t0 and t1 at which the state is returned, shape (n,); None for the state at the end.
        engine: "xla", or "kernel": a program of this machine, with first derivatives in both modes. "auto" is that of
            $DIFFABS_ENGINE, or else a kernel inside JAX's transformations where one is possible, and XLA elsewhere.
        kept_events: Number of times that are kept of each event.

    Returns:
        The solution. Read its `status`: beyond `TERMINATED` its times and states are NaN, and its counts those so far.

    Raises:
        ValueError: An argument is invalid. A switch of the field cannot be located: it is no comparison, such as
            `jnp.floor`, or a loop hides it. A second derivative is asked of adaptive steps. A field with switches or
            events has float32 numbers.

    See also:
        `switches`: The comparisons of a field that the solution treats as switches.
        `Event`: A condition, and the state after it.
        `FixedStep`, `Adaptive`: The two methods.
        `rollout`: Runs of a loop made of parts.

    Notes:
        Between events the state follows y' = f(t, y, p). At an event, where a condition g falls through zero, it jumps
        to r(t, y, p). Derivatives pass the event by

            dt*/dp = -(g_y S + g_p)/(g_t + g_y f),   S+ = r_y S + r_p + (r_y f + r_t - f+) dt*/dp

        with S = dy/dp before and S+ after the jump, f before and f+ after it. Source: I. A. Hiskens and M. A. Pai,
        Trajectory sensitivity analysis of hybrid systems, IEEE Trans. Circuits Syst. I 47 (2000).

    Examples:
        >>> import jax
        >>> import diffabs as d
        >>> jax.config.update("jax_enable_x64", True)
        >>> solution = d.solve(lambda t, y, rate: -rate * y, 1.0, 0.0, 2.0, 0.5, solver=d.Adaptive(1e-8))
        >>> print(f"{solution.y:.6f}")
        0.367879

        The height of a ball after 1 s that falls from 1 m and bounces, and its derivative by gravity:

        >>> def height(g):
        ...     bounce = d.Event(lambda t, y, g: y[0], lambda t, y, g: (0.0, -0.8 * y[1]))
        ...     ball = lambda t, y, g: (y[1], -g)
        ...     return d.solve(ball, (1.0, 0.0), 0.0, 1.0, g, solver=d.Adaptive(1e-8), events=[bounce]).y[0]
        >>> print(f"{height(9.81):.4f} {jax.grad(height)(9.81):.4f}")  # in closed form 0.4680 and -0.0936
        0.4680 -0.0936
    """
    engine = resolve_request(engine)
    if not isinstance(events, list | tuple):
        raise ValueError(f"events = {kinds.format_value(events)} is no list of d.Event")
    events = tuple(events)
    if len(events) > MAX_EVENTS:
        raise ValueError(f"events has {len(events)} entries; at most {MAX_EVENTS} are possible")
    if isinstance(kept_events, bool) or not isinstance(kept_events, int | np.integer) or kept_events < 1:
        raise ValueError(f"kept_events = {kept_events!r} is no whole number of at least 1")
    system, save_objective = build_field(field, y0, t0, t1, args, events, save, int(kept_events))
    any_solver: Any = solver
    # The method's rule is `WatchedModes`: a run that slides or grazes is over.
    method, count = read_solver(any_solver, t0, t1, system.inputs["t0"].dtype)
    program = trace_field(system)
    switched = bool(program.bit_count or events)
    if switched and system.inputs["t0"].dtype != jnp.float64:
        raise ValueError(
            "float32 cannot locate the switches and events of a field; call"
            ' jax.config.update("jax_enable_x64", True), and give float64 numbers'
        )
    if not switched:
        method = method.without_switches()
    saves = {} if save_objective is None else {"saves": save_objective}

    room = count if isinstance(method, FixedStepping) else log_capacity(system, any_solver)
    plan = RunPlan(_finish_solution, None, round_up_capacity(room))
    run = system, saves, method, None
    if engine == "kernel" or (engine == "auto" and is_traced(system, saves)):
        return run_deferred(run_differentiable, plan, run, required=engine == "kernel")
    return run_differentiable(plan, run)


@default_flags()
def switches(
    field: Field,
    t: Array,
    y: object,
    args: object = None,
    *,
    t1: Scalar | None = None,
    solver: Adaptive = SWITCH_SOLVER,
) -> list[Switch]:
    """Return the switches of a field: its comparisons that depend on time or state, and where they flip.

    Args:
        field: Function of (t, y, args) that returns dy/dt, as in `solve`.
        t: Time.
        y: State at that time.
        args: What the function needs.
        t1: End of a run from (t, y) whose flips are listed; None for no run.
        solver: Solver of that run.

    Examples:
        >>> import diffabs as d
        >>> comparisons = d.switches(lambda t, y, args: -abs(y), 0.0, 3.0)
        >>> print(comparisons[0].operation, comparisons[0].margin)
        abs 3.0

    Raises:
        ValueError: An argument is invalid or traced, or a switch of the field cannot be located.
    """
    if has_tracer(t, y, args, t1):
        raise ValueError("switches lists numbers of one run: call it outside of jit, vmap and grad")
    system, _ = build_field(field, y, t, float(t) + 1.0 if t1 is None else t1, args, (), None, 1)
    program, zero = trace_field(system), jnp.zeros_like(system.inputs["t0"])
    observed = build_system(system, {}, zero, system.start(), {}, switched=True)
    surfaces = observed.evaluate(zero, system.start(), {}, UNCONSTRAINED).surfaces
    flips = [] if t1 is None else _list_flips(system, solver)
    comparisons = []
    for (first, shape), op in zip(program.places, program.origins, strict=True):
        bits = range(first, first + int(np.prod(shape)))
        margins = surfaces.values[np.isin(surfaces.numbers, bits)]
        searches = op.name == SEARCHSORTED  # its margins are the distances to the knots below and above
        margin = margins[jnp.argmin(jnp.abs(margins))] if searches else margins.reshape(shape)
        turned = op.queries[0][1] and not searches  # the distance to a knot has no side
        times = tuple(time for time, bit in flips if bit in bits)
        comparisons.append(Switch(summarize(op.source), op.name, -margin if turned else margin, times))
    return comparisons


def _list_flips(system: FieldSystem, solver: Adaptive) -> list[tuple[float, int]]:
    """Return time and number of each comparison that changes in a run."""
    method, _ = read_solver(solver, 0.0, 1.0, system.inputs["t0"].dtype)
    if not isinstance(method, AdaptiveStepping):
        raise ValueError(f"solver = {solver} has fixed steps; d.Adaptive is needed")

    @jax.jit
    def run(system: FieldSystem) -> PyTree:
        key: Any = None
        start = method.start(system, {}, key)
        step, renew = partial(method.step, system, {}, key), partial(method.renew, system)
        carry, log = log_run(step, renew, log_attempt, start, round_up_capacity(log_capacity(system, solver)))
        return _finish_solution(system, {}, end_unfinished(carry))[0].status, log

    status, log = run(system)
    if status != SolutionStatus.FINISHED:
        raise ValueError(f"t1: the run has no end, its status is {SolutionStatus(int(status)).name}")
    lands = np.ravel(log.lands)
    times = np.ravel(system.time(log.t))
    return [(float(times[i]), int(lands[i])) for i in np.flatnonzero(np.ravel(log.accepted) & (lands >= 0))]


def _finish_solution(system: FieldSystem, objectives: dict[str, Saves], carry: PyTree) -> tuple[Solution, None]:
    point, held = carry.point, carry.point.state.events
    statuses = {
        RunStatus.TIMED_OUT: SolutionStatus.FINISHED,
        RunStatus.STOPPED: SolutionStatus.TERMINATED,
        RunStatus.SLID: SolutionStatus.SLID,
        RunStatus.GRAZED: SolutionStatus.GRAZED,
    }
    status: Scalar = jnp.asarray(SolutionStatus.DIVERGED.value)
    for run_status, meant in statuses.items():
        status = jnp.where(carry.status == run_status, meant.value, status)
    # A fault of an event ends the run by rates that are NaN.
    lost: Scalar = (status == SolutionStatus.DIVERGED) & (held.fault > 0)
    status = jnp.where(lost, held.fault.astype(status.dtype), status)
    check = partial(invalidate, invalid=status > SolutionStatus.TERMINATED, inputs=system.inputs)
    # The sum of the steps of a grid may miss t1 by its rounding.
    t = jnp.where(status == SolutionStatus.FINISHED, system.inputs["t1"], system.time(point.t))
    y = point.state.y
    if objectives:
        t, places = objectives["saves"].times, objectives["saves"].places
        over = places > jax.lax.stop_gradient(point.t) - COINCIDENCE_FRACTION
        # At t1 the state moves with its own time. After a terminal event it is repeated.
        late = jnp.where(over & (status == SolutionStatus.FINISHED), t - system.time(point.t), 0.0)
        late -= jax.lax.stop_gradient(late)
        rates = system.field(point.t, y)
        outside = jnp.where(jnp.abs(places - 0.5) <= 0.5 + COINCIDENCE_FRACTION, 1.0, jnp.nan)

        def pick(y: Array, rate: Array, saved: Array) -> Array:
            shape = (-1, *(jnp.ndim(y) * [1]))
            moved = y + jnp.reshape(late, shape) * rate
            return jnp.reshape(outside, shape) * jnp.where(jnp.reshape(over, shape), moved, saved)

        y = jax.tree.map(pick, y, rates, point.accumulators["saves"].held)
    events = _count_events(system, carry, status == SolutionStatus.TERMINATED)
    times = check(system.time(events.times))
    return Solution(check(t), jax.tree.map(check, y), events._replace(times=times), status), None


def _count_events(system: FieldSystem, carry: PyTree, terminated: Bool) -> SolutionEvents:
    """Return times, in units of the span, and counts of all events in their order."""
    point, held = carry.point, carry.point.state.events
    distances = [system.distance(event.condition, point) for event in system.code.terminal]
    last = jnp.argmin(jnp.stack(distances)) if distances else 0
    last = jnp.where(held.ends > 0, held.ends - 1.0, last)
    never = jnp.full(system.times_per_event, jnp.nan, point.t.dtype)
    inner, ends, rows = iter(range(len(system.code.inner))), iter(range(len(distances))), []
    for event in system.code.events:
        if event.terminal:
            happens = jnp.asarray(terminated & (last == next(ends)))
            rows.append((jnp.where(happens, never.at[0].set(point.t), never), happens.astype(point.t.dtype)))
        else:
            i = next(inner)
            rows.append((held.times[i], held.counts[i]))
    times = jnp.stack([time for time, _ in rows]) if rows else jnp.zeros((0, system.times_per_event), point.t.dtype)
    counts = jnp.stack([count for _, count in rows]) if rows else jnp.zeros(0, point.t.dtype)
    return SolutionEvents(times, counts.astype(int))
