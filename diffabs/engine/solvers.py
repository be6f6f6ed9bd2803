"""Solvers: which steps a run takes."""

import dataclasses
import math
from typing import Any

from jax.core import Tracer

from diffabs.core import kinds
from diffabs.core.meanings import document_fields
from diffabs.core.types import PyTree

MAX_SOLVER_STEPS = 1e8


@document_fields
@dataclasses.dataclass(frozen=True)
class FixedStep:
    """Steps of equal length with the classical fourth-order Runge-Kutta method, up to a duration.

    A kink is an instant at which a comparison of the flow changes. Examples are a limit, the knot of a measured road,
    and a wheel that locks. A step that ends on the kink keeps its order. A step across it is exact to h^2, or to h
    where a rate jumps, and its derivative to one order less.

    A derivative is that of the computed run. Where steps end on events and kinks, its error falls as h^4, too. A step
    too long for the fastest part of a run costs the derivative more than the value. A parameter that moves an event
    changes where the later steps lie in the motion, and so the value's error. The derivative's error is then about the
    value's error times the derivative of the event's time, divided by h. The guide on derivatives has an example.

    See also:
        `Adaptive`: Steps as long as a tolerance allows.
        `solve`, `rollout`, `measure`: What takes steps.

    Notes:
        A step of length h takes four evaluations of the rates

            k1 = f(t, x),   k2 = f(t + h/2, x + h/2 k1),   k3 = f(t + h/2, x + h/2 k2),   k4 = f(t + h, x + h k3)
            x+ = x + h/6 (k1 + 2 k2 + 2 k3 + k4)

        with an error of h^5, so h^4 over a run. Steps are stable for h |lambda| < 2.8 about, with the fastest
        eigenvalue lambda; an unstable step is refused. Source: E. Hairer, S. P. Norsett and G. Wanner, Solving Ordinary
        Differential Equations I, 2nd ed., sec. II.1.

    Examples:
        Half the step has a sixteenth of the error:

        >>> import jax, math
        >>> import diffabs as d
        >>> jax.config.update("jax_enable_x64", True)
        >>> for step in (0.1, 0.05):
        ...     y = d.solve(lambda t, y, args: -y, 1.0, 0.0, 1.0, solver=d.FixedStep(step, 1.0)).y
        ...     print(f"{abs(y - math.exp(-1.0)):.1e}")
        3.3e-07
        2.0e-08
    """

    step: float = 1e-3
    """Length of a step [s]."""
    duration: float = 10.0
    """Longest time of the run [s]. The run ends at the first instant that is not before it."""
    every: int = 1
    """A trajectory keeps every `every`-th instant."""
    kinks: bool | None = None
    """True if steps end on kinks, which costs up to twice as much time; False if they do not. None means True for
    derivatives, and for values only if a rate jumps at a kink (conditional integration).
    """
    follow_slides: bool = False
    """True if a run that slides along a switching surface, because the rates of both sides push onto it, follows the
    surface and has derivatives. Such a run has steps that end on kinks. False reports it: see `Run.slid`.
    """

    @property
    def steps(self) -> int:
        """Number of steps: duration/step, rounded up."""
        # The factor keeps the rounding of the quotient from adding a step.
        return math.ceil(self.duration / self.step * (1 - 1e-12))


@document_fields
@dataclasses.dataclass(frozen=True)
class Adaptive:
    """Steps as long as their error allows, by Tsitouras' method of fifth order. The reference method remains
    `FixedStep`.

    Steps end on events, where a clock strikes, and where a comparison of the flow changes. Examples are a limit, the
    knot of a measured road, and a wheel that locks.

    The error of the states and of the plant's first signal controls the step. A signal that depends on time alone has
    no influence, unless states follow it. If a setpoint swings faster than every state, use fixed steps for an integral
    over it.

    See also:
        `FixedStep`: Steps of equal length.
        `solve`, `rollout`, `measure`: What takes steps.

    Notes:
        A step takes six evaluations of the rates. Its error e, that of the cubic between its ends, falls as h^4, so the
        next step has about the length

            0.85 h (rtol max|x|/e)^(1/4)

        within limits: stability, the surface where a comparison changes next, clocks. The states' largest values so far
        are the scales, so no part declares any. Source: Ch. Tsitouras, Runge-Kutta pairs of order 5(4) satisfying only
        the first column simplifying assumption, Comput. Math. Appl. 62 (2011).

    Examples:
        >>> import jax, math
        >>> import diffabs as d
        >>> jax.config.update("jax_enable_x64", True)
        >>> y = d.solve(lambda t, y, args: -y, 1.0, 0.0, 1.0, solver=d.Adaptive(1e-8)).y
        >>> print(abs(y - math.exp(-1.0)) < 1e-8)
        True
    """

    rtol: float = 1e-5
    """Error of a step, as a fraction of the greatest value so far of each state and of the plant's first signal.
    The error of a metric is some ten times as much (`estimate_accuracy` estimates it).
    """
    duration: float = 10.0
    """Longest time of the run [s]. The run ends at the first instant of the grid that is not before it."""
    step: float = 1e-3
    """Step of a grid [s]. Clocks strike and delays remember on this grid. No step of the integration has to end there.
    """
    every: int = 1
    """A trajectory keeps every `every`-th instant of the grid, by interpolation."""
    follow_slides: bool = False
    """True if a run that slides along a switching surface, because the rates of both sides push onto it, follows the
    surface and has derivatives. Such a run has steps that end on kinks. False reports it: see `Run.slid`.
    """

    @property
    def steps(self) -> int:
        """Number of instants of the grid after t = 0: duration/step, rounded up."""
        return math.ceil(self.duration / self.step * (1 - 1e-12))


Solver = FixedStep | Adaptive
SOLVER_TYPES: dict[str, type[PyTree]] = {"fixed": FixedStep, "adaptive": Adaptive}  # by their names in a scenario
ADAPTIVE_ERROR_ORDER = 4  # order of the error of an adaptive step in its length


def refine_solver(solver: Solver, times: int) -> Solver:
    """Return the solver with `times` as many steps, or instants of the grid, over the same time.

    The time is the original duration, rounded up to whole steps. An `Adaptive` solver also gets `rtol`/`times`^4, so
    that its own steps shrink about as much.
    """
    step = solver.step / times
    # The duration is a multiple of the original step, so both solvers end at the same time.
    shorter = dataclasses.replace(solver, step=step, duration=solver.steps * times * step)
    if isinstance(shorter, Adaptive):
        return dataclasses.replace(shorter, rtol=shorter.rtol / times**ADAPTIVE_ERROR_ORDER)
    return shorter


def describe_solver(solver: Solver) -> dict[str, PyTree]:
    """Return the fields of a solver that decide the metrics, by name, as JSON values: step and duration [s].

    `Adaptive` adds its type and `rtol`, `FixedStep` its `kinks` unless they are None; both add `follow_slides` if True.
    """
    fields: dict[str, PyTree] = {"step": solver.step, "duration": solver.duration}
    if solver.follow_slides:
        fields["follow_slides"] = True
    if isinstance(solver, Adaptive):
        return fields | {"type": "adaptive", "rtol": solver.rtol}
    return fields if solver.kinks is None else fields | {"kinks": solver.kinks}


def find_solver_faults(solver: Solver) -> list[str]:
    """Return one line for each fault of a solver, independent of the loop; an empty list if there is none.

    `kinks` must be True, False or None, `follow_slides` True or False. Each other field must be a positive, finite
    number, `rtol` below 1. The step must not be longer than the duration. At most `MAX_SOLVER_STEPS` steps are allowed.
    """
    if not isinstance(solver, FixedStep | Adaptive):
        solvers = "d.FixedStep(step=..., duration=...) or d.Adaptive(rtol=..., duration=...)"
        return [f"solver = {kinds.format_value(solver)} is no solver; {solvers} is needed"]
    names = ["step", "duration", "every", *(["rtol"] if isinstance(solver, Adaptive) else [])]
    if lines := [f"solver.{name} {line}" for name in names if (line := _find_field_fault(name, getattr(solver, name)))]:
        return lines
    kinks = getattr(solver, "kinks", None)
    if not (kinks is None or isinstance(kinks, bool)):
        return [f"solver.kinks = {kinks!r} is not a Python bool; True, False or None is needed"]
    if not isinstance(solver.follow_slides, bool):
        return [f"solver.follow_slides = {solver.follow_slides!r} is not a Python bool; True or False is needed"]
    if solver.follow_slides and kinks is False:
        return ["solver.kinks = False: a run follows a switching surface only with steps that end there; leave it out"]
    step, duration = solver.step, solver.duration
    if step > duration:
        return [
            f"solver.step = {step:g} s is outside (0, {duration:g}] s: longer than solver.duration = {duration:g} s"
        ]
    if duration / step > MAX_SOLVER_STEPS:
        shortest = duration / MAX_SOLVER_STEPS
        return [f"solver.step = {step:g} s is outside [{shortest:g}, {duration:g}] s: too many steps"]
    return []


def _find_field_fault(name: str, value: Any) -> str:
    """Return the fault in the value of one field of a solver, or an empty string."""
    if isinstance(value, Tracer):
        return "is traced; a number that is known before the trace is needed"
    if line := kinds.find_value_objection(value) or (
        kinds.value_shape(value) and f"has shape {kinds.value_shape(value)}"
    ):
        return f"= {kinds.format_value(value)} {line}; a number is needed"
    if not 0 < value < math.inf:
        return f"= {value} is not positive and finite"
    if name == "rtol" and value >= 1:
        return f"= {value} is outside (0, 1)"
    return f"= {value} is no whole number" if name == "every" and value != int(value) else ""
