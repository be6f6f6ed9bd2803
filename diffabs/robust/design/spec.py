"""Specifications of a design or a certificate; they combine freely, and all are optional."""

import dataclasses
import math
from typing import Any

import numpy as np

from diffabs.core.kinds import find_value_objection, format_value
from diffabs.core.pytree import ParameterSpec
from diffabs.core.types import Matrix, Part, PyTree, Scalar
from diffabs.linear.weights import as_weight_matrix

DECAY_RANGE = ParameterSpec("1/s", low=0.0)
DAMPING_RANGE = ParameterSpec("1", low=0.0, high=1.0, open_high=True)
MAX_STEP_DECAY = 700.0  # largest decay times the period, so that exp(-decay period) does not round to 0
L2_RANGE = ParameterSpec("1", low=0.0, open_low=True)


@dataclasses.dataclass(frozen=True, eq=False)
class InputLimit:
    """The bound |u_j(t)| <= limit_j at all times, from every start in the hull of the points.

    `certify` proves the smallest bounds in the ratio of `limit`; they may be above it.

    Attributes:
        limit: Bounds in the units of the inputs, shape (m,), or a number for one input; > 0.
        points: Starts, shape (k, n), or (n,) for one; not all zero.
    """

    limit: Any
    points: PyTree


@dataclasses.dataclass(frozen=True, eq=False)
class L2Gain:
    """The L2 bound |z|_2 <= bound |w|_2 from rest. Here z = C x + D u and x' = A x + B u + E w.

    It is an H-infinity bound for every frozen system, and it holds for every varying system too.

    Attributes:
        output: C, shape (z, n).
        feedthrough: D, shape (z, m), or a vector for one input or one output; None stands for 0.
        disturbance: E, shape (n, w), or (n,) for one disturbance; None lets w act at the input, E = B.
        bound: Bound of the gain that `design` keeps. None lets `design` minimise the gain, which excludes Q and R.
            `certify` ignores it and proves the smallest gain.
    """

    output: PyTree
    feedthrough: Any = None
    disturbance: Part = None
    bound: float | None = None


@dataclasses.dataclass(frozen=True, eq=False)
class Spec:
    """Specifications for x' = A x + B u, u = K x.

    Attributes:
        Q: State weight, shape (n, n), or its diagonal. The cost is the integral of x'Qx + u'Ru, a sum in discrete time.
            Q and R come together.
        R: Input weight, positive definite: shape (m, m), its diagonal, or a number.
        decay: Decay rate [1/s], >= 0: |x| <= c exp(-decay t).
        damping: Smallest damping ratio [1] of the poles of every frozen system, in [0, 1); continuous time only.
        input: Limit of the inputs.
        l2: L2 gain to bound, or to minimise.
        rates: Lowest and highest d(parameter)/dt of a `Schedule`, in the parameter's unit per second.
    """

    Q: Any = None
    R: Any = None
    decay: float = 0.0
    damping: float = 0.0
    input: InputLimit | None = None
    l2: L2Gain | None = None
    rates: tuple[float, float] | None = None

    def check(self, order: int, inputs: int, period: float | None = None, *, scheduled: bool = False) -> "Spec":
        """Return the specification with full matrices, for a system of `order` states and `inputs` inputs.

        `period` [s] is that of a system in discrete time. Only a schedule (`scheduled`) has rates.

        Raises:
            ValueError: A field that does not fit; the message names it, its value and the allowed range.
        """
        if (self.Q is None) != (self.R is None):
            raise ValueError("a quadratic cost needs both Q and R")
        weights = {}
        if self.Q is not None:
            weights = {
                "Q": as_weight_matrix("Q", self.Q, order, definite=False),
                "R": as_weight_matrix("R", self.R, inputs, definite=True),
            }
        fastest = math.inf if period is None else MAX_STEP_DECAY / period
        _check_number("decay", self.decay, dataclasses.replace(DECAY_RANGE, high=fastest))
        _check_number("damping", self.damping, DAMPING_RANGE)
        if self.damping and period is not None:
            raise ValueError(f"damping = {self.damping:g} needs continuous time; the system's period is {period:g} s")
        if self.rates is not None:
            _check_rates(self.rates)
            if not scheduled:
                raise ValueError("rates belong to a schedule: a polytope admits every rate, so a spec of it has none")
        if scheduled and (self.rates is None or period is not None):
            raise ValueError("a schedule needs rates, the bounds of its parameter's derivative, and continuous time")
        limit, gain = self.input, self.l2
        if scheduled and (self.damping or gain or limit):
            raise ValueError("a schedule allows decay and cost; damping, L2 gain, input limit need a polytope")
        if limit:
            values, points = np.atleast_1d(np.array(limit.limit, float)), np.atleast_2d(np.array(limit.points, float))
            if values.shape != (inputs,) or not (np.isfinite(values) & (values > 0)).all():
                raise ValueError(f"input limit = {values.tolist()}: {inputs} numbers in (0, inf) are needed")
            if points.shape[1:] != (order,) or not np.isfinite(points).all() or not points.any():
                needed = f"finite ones of shape (k, {order}), not all zero"
                raise ValueError(f"input points have shape {points.shape}; {needed}")
            limit = InputLimit(values, points)
        if gain:
            c = np.atleast_2d(np.array(gain.output, float))
            d = np.zeros((len(c), inputs)) if gain.feedthrough is None else _as_matrix(gain.feedthrough, len(c))
            e = None if gain.disturbance is None else _as_matrix(gain.disturbance, order)
            fits = c.shape[1:] == (order,) and d.shape == (len(c), inputs)
            if not (fits and np.isfinite(c).all() and np.isfinite(d).all()):
                needed = f"finite ones of ({len(c)}, {order}) and ({len(c)}, {inputs}) are needed"
                raise ValueError(f"L2 output C {c.shape} and feedthrough D {d.shape}: {needed}")
            if e is not None and not (e.ndim == 2 and len(e) == order and e.size and np.isfinite(e).all()):
                raise ValueError(f"L2 disturbance E {e.shape}: a finite one of ({order}, w) is needed")
            if gain.bound is not None:
                _check_number("L2 bound", gain.bound, L2_RANGE)
            gain = L2Gain(c, d, e, gain.bound)
        return dataclasses.replace(self, **weights, input=limit, l2=gain)


def _as_matrix(value: Matrix, rows: int) -> np.ndarray:
    """Return a matrix unchanged; a number or a vector becomes one column of so many rows, or else one row."""
    array = np.array(value, float)
    return array if array.ndim > 1 else array.reshape((rows, 1) if array.size == rows else (1, -1))


def _check_number(name: str, value: Scalar, allowed: ParameterSpec) -> None:
    if find_value_objection(value) or np.ndim(value):
        raise ValueError(f"{name} = {format_value(value)} is no number in {allowed.interval()}")
    if not allowed.holds(value):
        raise ValueError(f"{name} = {value:g} is outside {allowed.interval()}")


def _check_rates(rates: PyTree) -> None:
    if find_value_objection(rates) or np.shape(rates) != (2,) or not -np.inf < rates[0] <= rates[1] < np.inf:
        needed = "a pair (low, high) of finite numbers with low <= high, in the parameter's unit per second"
        raise ValueError(f"rates = {format_value(rates)} is not {needed}")
