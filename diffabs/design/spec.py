"""What a design has to achieve, or a certificate to prove. Specifications combine freely; all are optional."""

import dataclasses
import math
from typing import Any

import numpy as np

from diffabs.linear.weights import as_weight_matrix


@dataclasses.dataclass(frozen=True, eq=False)
class InputLimit:
    """|u_j(t)| <= limit_j at all times, from every start in the hull of `points` (k, n)."""

    limit: Any
    points: Any


@dataclasses.dataclass(frozen=True, eq=False)
class L2Gain:
    """|z|_2 <= bound |w|_2 from rest, z = C x + D u, x' = A x + B u + E w: an H-infinity bound for every frozen system,
    and for every varying one. `bound` None asks for the smallest; `disturbance` E (n, w) None acts where u does."""

    output: Any
    feedthrough: Any = None
    disturbance: Any = None
    bound: float | None = None


@dataclasses.dataclass(frozen=True, eq=False)
class Spec:
    """Specifications for x' = A x + B u, u = K x.

    Q (n, n) or its diagonal, R (m, m), its diagonal, or a number: cost integral of x'Qx + u'Ru (a sum in discrete time)
    decay [1/s]: |x| <= c exp(-decay t)
    damping [1]: at least this, for the poles of every frozen system
    input, l2: see `InputLimit` and `L2Gain`
    rates: lowest and highest d(parameter)/dt of a `Schedule`
    """

    Q: Any = None
    R: Any = None
    decay: float = 0.0
    damping: float = 0.0
    input: InputLimit | None = None
    l2: L2Gain | None = None
    rates: tuple[float, float] | None = None

    def checked(self, order: int, inputs: int) -> "Spec":
        """The same with full matrices. Raises ValueError naming what does not fit, its value and the allowed range."""
        if (self.Q is None) != (self.R is None):
            raise ValueError("a quadratic cost needs both Q and R")
        weights = {}
        if self.Q is not None:
            weights = {
                "Q": as_weight_matrix("Q", self.Q, order, definite=False),
                "R": as_weight_matrix("R", self.R, inputs, definite=True),
            }
        if not (math.isfinite(self.decay) and self.decay >= 0):
            raise ValueError(f"decay = {self.decay:g} is outside [0, inf) 1/s")
        if not 0 <= self.damping < 1:
            raise ValueError(f"damping = {self.damping:g} is outside [0, 1)")
        if self.rates is not None and not (np.isfinite(self.rates).all() and self.rates[0] <= self.rates[1]):
            raise ValueError(f"rates = {self.rates} are not a lower and an upper bound")
        limit, gain = (
            self.input and _check_input_limit(self.input, order, inputs),
            self.l2 and _check_l2_gain(self.l2, order, inputs),
        )
        return dataclasses.replace(self, **weights, input=limit, l2=gain)


def _check_input_limit(limit: InputLimit, order: int, inputs: int) -> InputLimit:
    values, points = np.atleast_1d(np.array(limit.limit, float)), np.atleast_2d(np.array(limit.points, float))
    if values.shape != (inputs,) or not (np.isfinite(values) & (values > 0)).all():
        raise ValueError(f"input limit = {values.tolist()}: {inputs} numbers in (0, inf) are needed")
    if points.shape[1:] != (order,) or not np.isfinite(points).all() or not points.any():
        raise ValueError(f"input points have shape {points.shape}; finite ones of shape (k, {order}), not all zero")
    return InputLimit(values, points)


def _check_l2_gain(gain: L2Gain, order: int, inputs: int) -> L2Gain:
    c = np.atleast_2d(np.array(gain.output, float))
    d = (
        np.zeros((len(c), inputs))
        if gain.feedthrough is None
        else np.array(gain.feedthrough, float).reshape(len(c), -1)
    )
    e = None if gain.disturbance is None else np.array(gain.disturbance, float).reshape(order, -1)
    if c.shape[1:] != (order,) or d.shape != (len(c), inputs) or not (np.isfinite(c).all() and np.isfinite(d).all()):
        fitting = f"({len(c)}, {order}) and ({len(c)}, {inputs})"
        raise ValueError(f"L2 output C {c.shape} and feedthrough D {d.shape}: finite ones of {fitting} are needed")
    if e is not None and not np.isfinite(e).all():
        raise ValueError("the L2 disturbance matrix has an entry that is not finite")
    if gain.bound is not None and not (math.isfinite(gain.bound) and gain.bound > 0):
        raise ValueError(f"L2 bound = {gain.bound:g} is outside (0, inf)")
    return L2Gain(c, d, e, gain.bound)
