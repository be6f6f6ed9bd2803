"""A nonlinear loop as linear systems over ranges of parameters, with the gain of its controller to certify.

A gain in proportion to the speed gets the model in which it is constant (`speed_scaled`). A proof for that model covers
every fall of the speed that friction and resistances allow.
"""

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from diffabs.core.protocols import Plant
from diffabs.core.pytree import replace
from diffabs.core.types import AnyArray, Array, Part, Scalar
from diffabs.linear.balance_model import BalanceModel
from diffabs.linear.slip_model import SlipModel
from diffabs.loop.closed_loop import Loop
from diffabs.parts.controllers import ProportionalFeedback
from diffabs.parts.controllers.sampled import inner_controller
from diffabs.parts.plants import BrakeStart
from diffabs.robust.design import analysis
from diffabs.robust.design.parameter_box import polytope
from diffabs.robust.design.parameter_grid import grid_polytope
from diffabs.robust.design.polytopes import Polytope
from diffabs.robust.design.proof.certificate import Certificate
from diffabs.robust.design.spec import Spec
from diffabs.robust.design.speed_scaled import SpeedScaled, greatest_speed_fall
from diffabs.robust.design.state_feedback import ReducedLoop, feedback_gain, reduce_loop

# Samples of the friction curve and of the speed, and a factor for a maximum between two samples.
SLIPS, SPEEDS, MARGIN = 2001, 33, 1.01

Box = dict[str, tuple[float, float]]


class ProofTask(NamedTuple):
    """A loop reduced to linear systems, with the gain to certify.

    Attributes:
        loop: Loop.
        reduced: Linear loop, with the gain of its controller.
        gain: Gain to certify, one number per state.
        model: Linear model with one gain; the paths of the box are its parameters.
        states: Names of the model's states.
        over: Ranges (low, high) of the parameters, in SI.
        polytope: Polytope of the systems.
        spec: Specification of the closed loops.
    """

    loop: Loop
    reduced: ReducedLoop
    gain: np.ndarray
    model: object
    states: tuple[str, ...]
    over: Box
    polytope: Polytope
    spec: Spec

    def certify(self, spec: Spec | None = None) -> Certificate:
        """Return the certificate of the gain, with the largest decay rate that a common Lyapunov matrix proves.

        A property without a proof raises no error: the certificate leaves it out.

        Args:
            spec: Specification; by default that of the task.
        """
        return analysis.certify(self.gain, self.polytope, self.spec if spec is None else spec, fastest=True)

    def notes(self) -> Iterator[str]:
        """Yield what a proof about these systems leaves out or adds, one line each."""
        yield from (f"neglected: {line}" for line in self.reduced.neglected)
        if not self.reduced.exact:
            yield "note: the linear model differs from the loop's linearisation; the proof is about the model"
        spread = self.polytope.coverage.spread if self.polytope.coverage else 1.0
        cover = "note: the corners do not cover the ranges; the vertices are"
        if not self.polytope.corners:
            yield f"{cover} the corners of a box around the systems"
        elif not math.isclose(spread, 1.0):
            yield f"{cover} spread by {spread:.4g}"


def build_loop_task(
    loop: Loop,
    over: Mapping[str, tuple[float, float]],
    spec: Spec | None = None,
    gain: AnyArray | None = None,
    reduced: ReducedLoop | None = None,
) -> ProofTask:
    """Return the linear systems of a loop over ranges of parameters, with a gain to certify.

    Args:
        loop: Loop, linearised at its initial speed and its setpoint.
        over: Range (low, high) of each parameter of the linear model, by path, in SI units.
        spec: Specification of the closed loops; None stands for stability alone.
        gain: Gain of u = K x, one number per state; by default that of the controller.

    Raises:
        ValueError: A loop without linear model, or ranges that the model or its speeds do not allow.

    Examples:
        >>> from diffabs.robust.design.loop_task import build_loop_task
        >>> from diffabs.scenario import load
        >>> task = build_loop_task(load("slip-lmi").loop, {"plant.mass": (5.3, 6.2)})
        >>> task.states, task.polytope.vertices
        (('integral of slip error', 'slip error'), 2)
    """
    reduced, model, ranges = _follow_speed(loop, reduce_loop(loop) if reduced is None else reduced, dict(over))
    systems = grid_polytope(model, ranges) if isinstance(model, BalanceModel) else polytope(model, ranges)
    values = reduced.gain if gain is None else np.asarray(gain, float)
    return ProofTask(loop, reduced, values, model, tuple(model.states), ranges, systems, spec or Spec())


def _follow_speed(loop: Loop, reduced: ReducedLoop, box: Box) -> tuple[ReducedLoop, Part, Box]:
    """Return the linear model and its box. A gain that follows the speed gets the model in which it is constant."""
    controller = inner_controller(loop.controller)
    if not isinstance(controller, ProportionalFeedback) or not isinstance(reduced.model, SlipModel):
        return reduced, reduced.model, box
    model = SpeedScaled(model=reduced.model, reference_speed=controller.reference_speed)
    if model.period is None:
        raise ValueError("controller proportional-feedback: only sampled it can be brought to one gain")
    speeds = speeds_of_box(box, float(reduced.model.speed))
    decelerations = greatest_decelerations(loop.plant, box, speeds)
    # The relative fall grows with a/v: friction makes that greatest at the slowest speed, air drag at the fastest.
    i = int(np.argmax(decelerations / speeds))
    falls = (0.0, greatest_speed_fall(float(decelerations[i]), float(speeds[i]), float(model.period)))
    neglected = tuple(line for line in reduced.neglected if "fall of the speed" not in line)
    over = {f"model.{path}": ends for path, ends in box.items()} | {"fall": falls}
    gain = np.asarray(feedback_gain(loop, model.states), float)  # at the reference speed
    return reduced._replace(gain=gain, neglected=neglected), model, over


def speeds_of_box(box: Mapping[str, tuple[float, float]], speed: float) -> np.ndarray:
    """Return the ends of the box in the speed [m/s] and speeds between them, shape (SPEEDS,).

    The ends suffice for friction and air drag: a = f + c v^2 and a/v are convex. Friction may depend on the speed.

    Args:
        speed: Speed [m/s] of a box that has no range of it.
    """
    return np.linspace(*box.get("speed", (speed, speed)), SPEEDS)


def greatest_decelerations(
    plant: Plant, over: Mapping[str, tuple[float, float]], speeds: Sequence[float] | np.ndarray
) -> np.ndarray:
    """Return an upper bound of a brake's deceleration [m/s^2] at each speed [m/s], over all slips from 0 to 1.

    The greatest value at 2,001 slips and at the corners of the box, times 1.01, allows for a greater one between two
    slips.

    Args:
        over: Ranges (low, high) by path. Ranges of parameters of the plant count, `plant.mass` for example.

    Examples:
        >>> import diffabs as d
        >>> from diffabs.robust.design.loop_task import greatest_decelerations
        >>> plant = d.braking(speed=20.0).plant
        >>> bound = greatest_decelerations(plant, {"plant.mass": (300.0, 400.0)}, [10.0, 20.0])
        >>> bound.shape
        (2,)
    """
    inside = {path.removeprefix("plant."): ends for path, ends in over.items() if path.startswith("plant.")}
    speeds = np.asarray(speeds, float)

    @jax.jit
    def greatest(plant: Plant) -> Array:
        def deceleration(speed: Scalar, slip: Scalar) -> Scalar:
            return plant.output(plant.start(BrakeStart(speed=speed, slip=slip))).deceleration

        every = jax.vmap(jax.vmap(deceleration, (None, 0)), (0, None))
        return jnp.max(every(speeds, np.linspace(0.0, 1.0, SLIPS)), axis=1)

    plants = (replace(plant, dict(zip(inside, corner, strict=True))) for corner in itertools.product(*inside.values()))
    return MARGIN * np.max([np.asarray(greatest(corner_plant)) for corner_plant in plants], axis=0)
