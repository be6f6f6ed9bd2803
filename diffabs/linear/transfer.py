"""A linear system with a pure delay, its frequency response, and conversions from and to python-control.

    x' = A x + B u(t - delay),   y = C x + D u(t - delay)          period is None
    x+ = A x + B u(k - delay/T), y = C x + D u(k - delay/T)        sampled every T, the delay whole periods

Matrices are NumPy arrays. The delay is exact: its response is e^(-j w delay), without an approximation.
"""

import contextlib
import math
from types import ModuleType
from typing import NamedTuple

import numpy as np
from jax.typing import ArrayLike

from diffabs.core.shapes import Float
from diffabs.core.types import Any

WHOLE_PERIOD_TOLERANCE = 1e-9  # of a period: how far from whole periods the delay of a sampled system may be


class Transfer(NamedTuple):
    """A linear system with a pure delay.

    Attributes:
        A: State matrix, shape (n, n).
        B: Input matrix, shape (n, m).
        C: Output matrix, shape (p, n).
        D: Direct path, shape (p, m).
        period: Sampling period [s]; None in continuous time.
        delay: Pure delay [s], at least 0, a whole number of periods for a sampled system.
    """

    A: Float[np.ndarray, "n n"]
    B: Float[np.ndarray, "n m"]
    C: Float[np.ndarray, "p n"]
    D: Float[np.ndarray, "p m"]
    period: float | None = None
    delay: float = 0.0

    @property
    def poles(self) -> np.ndarray:
        """Poles (n,) of the rational part: in s, or in z if sampled."""
        return np.linalg.eigvals(self.A) if len(self.A) else np.zeros(0)

    def rational_response(self, w: ArrayLike) -> np.ndarray:
        """Return the response (k, p, m) at frequencies w (k,) [rad/s], without the delay; infinite at a pole."""
        w = np.atleast_1d(np.asarray(w, float))
        # z - A = (z - 1) - (A - 1) keeps the digits of slow modes, whose z is near 1.
        identity = np.eye(len(self.A))
        point, a = (1j * w, self.A) if self.period is None else (np.expm1(1j * w * self.period), self.A - identity)
        shifted = point[:, None, None] * identity - a
        with np.errstate(all="ignore"):
            return self.C @ _solve_or_infinite(shifted, np.asarray(self.B, complex)) + self.D

    def response(self, w: ArrayLike) -> np.ndarray:
        """Return the response (k, p, m) at frequencies w (k,) [rad/s]."""
        return self.rational_response(w) * np.exp(-1j * np.atleast_1d(np.asarray(w, float)) * self.delay)[:, None, None]

    def without_delay(self) -> "Transfer":
        """Return the same system with its whole periods of delay as states: a chain of shifts for each input.

        Raises:
            ValueError: The system has a delay in continuous time, or one that is negative or no whole number of
                periods.
        """
        check_transfer(self)
        if self.period is None:
            if self.delay:
                raise ValueError(f"delay = {self.delay:g} s: in continuous time a pure delay has no finite state")
            return self
        system = self
        for _ in range(self.count_periods()):
            system = _delay_one_period(system)
        return system._replace(delay=0.0)

    def count_periods(self) -> int:
        """Return the delay of a sampled system in periods.

        Raises:
            ValueError: The system is not sampled, or the delay is no whole number of periods.
        """
        if self.period is None:
            raise ValueError("period = None: a system in continuous time has no periods to count")
        shifts = self.delay / self.period
        if abs(shifts - round(shifts)) > WHOLE_PERIOD_TOLERANCE * max(1.0, shifts):
            raise ValueError(f"delay = {self.delay:g} s is no whole number of periods of {self.period:g} s")
        return round(shifts)


def check_transfer(system: Transfer) -> Transfer:
    """Return a system with its matrices as arrays if its fields fit each other."""
    matrices = {name: _as_matrix(name, getattr(system, name)) for name in "ABCD"}
    n, (p, m) = len(matrices["A"]), matrices["D"].shape
    for name, shape in {"A": (n, n), "B": (n, m), "C": (p, n)}.items():
        if matrices[name].shape != shape:
            raise ValueError(
                f"{name} has shape {matrices[name].shape}; it needs {shape}, as A has {n} rows and D {p, m}"
            )
    if system.period is not None and not 0 < system.period < math.inf:
        raise ValueError(f"period = {system.period:g} s is outside (0, inf) s")
    if not 0 <= system.delay < math.inf:
        raise ValueError(f"delay = {system.delay:g} s is outside [0, inf) s")
    return system._replace(**matrices)


def _as_matrix(name: str, value: object) -> np.ndarray:
    try:
        matrix = np.asarray(value, float)
    except (TypeError, ValueError):
        raise ValueError(f"{name} is no matrix of real numbers") from None
    if matrix.ndim != 2:
        raise ValueError(f"{name} has shape {matrix.shape}; it needs two dimensions")
    if not np.isfinite(matrix).all():
        raise ValueError(f"{name} = {matrix[~np.isfinite(matrix)][0]:g} is outside (-inf, inf)")
    return matrix


def _solve_or_infinite(matrices: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Return x (k, n, m) of M x = right for M (k, n, n); infinite where M is singular."""
    right = np.broadcast_to(right, (len(matrices), *right.shape))
    try:
        return np.linalg.solve(matrices, right)
    except np.linalg.LinAlgError:
        solutions = np.full(right.shape, complex(np.inf))
        for x, matrix, column in zip(solutions, matrices, right, strict=True):
            with contextlib.suppress(np.linalg.LinAlgError):
                x[:] = np.linalg.solve(matrix, column)
        return solutions


def _delay_one_period(system: Transfer) -> Transfer:
    """Return the system behind one period of delay, whose inputs become states."""
    n, m = np.shape(system.B)
    a = np.block([[system.A, system.B], [np.zeros((m, n + m))]])
    b = np.concatenate([np.zeros((n, m)), np.eye(m)])
    return system._replace(A=a, B=b, C=np.hstack([system.C, system.D]), D=np.zeros_like(system.D))


def to_control(system: Transfer, *, pade: int | None = None) -> Any:
    """Return a system as python-control's `StateSpace`, with whole periods of delay as states.

    Args:
        system: System to convert.
        pade: Order of the Pade approximation of a delay in continuous time; python-control has no such delay.

    Raises:
        ModuleNotFoundError: python-control is not installed.
        ValueError: The system has a delay in continuous time and `pade` is None.
    """
    control = _import_control()
    if system.period is None and system.delay:
        if pade is None:
            raise ValueError(
                f"delay = {system.delay:g} s: python-control has no pure delay in continuous time; say pade=ORDER"
            )
        delay = control.ss(control.tf(*control.pade(system.delay, pade)))
        return control.series(to_control(system._replace(delay=0.0)), delay)
    undelayed = system.without_delay()
    return control.ss(
        undelayed.A, undelayed.B, undelayed.C, undelayed.D, 0 if undelayed.period is None else undelayed.period
    )


def from_control(system: object) -> Transfer:
    """Return the `Transfer` of a python-control `StateSpace` or `TransferFunction`.

    Args:
        system: System of python-control.

    Raises:
        ModuleNotFoundError: python-control is not installed.
        ValueError: The system is sampled with an unknown period (dt=True).
    """
    control = _import_control()
    model = control.ss(system)
    if model.dt is True:
        raise ValueError("dt is True: the system is sampled, but nothing says how often; give it a period [s]")
    matrices = (np.array(matrix, float) for matrix in (model.A, model.B, model.C, model.D))
    return Transfer(*matrices, period=float(model.dt) if model.dt else None)


def _import_control() -> ModuleType:
    try:
        import control
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(
            'python-control needed: pip install ".[control]" in a clone', name="control"
        ) from error
    return control
