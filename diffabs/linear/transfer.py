"""A linear system with a pure delay, its frequency response, and python-control's form of it.

    x' = A x + B u(t - delay),   y = C x + D u(t - delay)          period is None
    x+ = A x + B u(k - delay/T), y = C x + D u(k - delay/T)        sampled every T, the delay whole periods

Matrices are NumPy arrays. The delay is kept as one, and exact: its response is e^(-j w delay), nothing is approximated.
"""

from typing import Any, NamedTuple

import numpy as np

WHOLE_PERIOD_TOLERANCE = 1e-9  # of a period: how far from whole periods the delay of a sampled system may be


class Transfer(NamedTuple):
    """A (n, n), B (n, m), C (p, n), D (p, m); sampling period [s], None in continuous time; delay [s]."""

    A: Any
    B: Any
    C: Any
    D: Any
    period: float | None = None
    delay: float = 0.0

    @property
    def poles(self) -> np.ndarray:
        """Of the rational part (n,): in s, or in z."""
        return np.linalg.eigvals(self.A) if len(self.A) else np.zeros(0)

    def rational_response(self, w: Any) -> np.ndarray:
        """The response (k, p, m) at w (k,) [rad/s], without the delay. Infinite at a pole."""
        w = np.atleast_1d(np.asarray(w, float))
        point = 1j * w if self.period is None else np.exp(1j * w * self.period)
        shifted = point[:, None, None] * np.eye(len(self.A)) - self.A
        with np.errstate(all="ignore"):
            return self.C @ _solve_or_infinite(shifted, np.asarray(self.B, complex)) + self.D

    def response(self, w: Any) -> np.ndarray:
        """The response (k, p, m) at w (k,) [rad/s]."""
        return self.rational_response(w) * np.exp(-1j * np.atleast_1d(np.asarray(w, float)) * self.delay)[:, None, None]

    def without_delay(self) -> "Transfer":
        """The same system with its whole periods of delay among its states: each input is shifted through as many.

        Raises:
            ValueError: a delay in continuous time, or one that is no whole number of periods.
        """
        if self.period is None:
            if self.delay:
                raise ValueError(f"delay = {self.delay:g} s: in continuous time a pure delay has no finite state")
            return self
        shifts = self.delay / self.period
        if abs(shifts - round(shifts)) > WHOLE_PERIOD_TOLERANCE:
            raise ValueError(f"delay = {self.delay:g} s is no whole number of periods of {self.period:g} s")
        system = self
        for _ in range(round(shifts)):
            system = _delay_one_period(system)
        return system._replace(delay=0.0)


def _solve_or_infinite(matrices: np.ndarray, right: np.ndarray) -> np.ndarray:
    """x (k, n, m) of M x = right for M (k, n, n), infinite where M is singular."""
    right = np.broadcast_to(right, (len(matrices), *right.shape))
    try:
        return np.linalg.solve(matrices, right)
    except np.linalg.LinAlgError:
        return np.stack([_solve_one_or_infinite(m, r) for m, r in zip(matrices, right, strict=True)])


def _solve_one_or_infinite(matrix: np.ndarray, right: np.ndarray) -> np.ndarray:
    try:
        return np.linalg.solve(matrix, right)
    except np.linalg.LinAlgError:
        return np.full(right.shape, complex(np.inf))


def _delay_one_period(system: Transfer) -> Transfer:
    """The system behind one period of delay: its inputs become states."""
    n, m = np.shape(system.B)
    a = np.block([[system.A, system.B], [np.zeros((m, n + m))]])
    b = np.concatenate([np.zeros((n, m)), np.eye(m)])
    return system._replace(A=a, B=b, C=np.hstack([system.C, system.D]), D=np.zeros_like(system.D))


def to_control(system: Transfer, *, pade: int | None = None) -> Any:
    """Return a system as python-control's `StateSpace`, in which a delay of whole periods is states.

    pade: the order of the approximation that stands for a delay in continuous time, for which python-control has none
    Raises:
        ModuleNotFoundError: python-control is not installed.
        ValueError: a delay in continuous time and no `pade`.
    """
    control: Any = _import_control()
    if system.period is None and system.delay:
        if pade is None:
            raise ValueError(
                f"delay = {system.delay:g} s: python-control has no pure delay in continuous time; say pade=ORDER"
            )
        delay = control.ss(control.tf(*control.pade(system.delay, pade)))
        return control.series(to_control(system._replace(delay=0.0)), delay)
    found = system.without_delay()
    return control.ss(found.A, found.B, found.C, found.D, 0 if found.period is None else found.period)


def from_control(system: Any) -> Transfer:
    """Return a `Transfer` of a system of python-control: a `StateSpace`, or a `TransferFunction`.

    Raises:
        ModuleNotFoundError: python-control is not installed.
        ValueError: a sampled system whose period is not said (dt=True).
    """
    control: Any = _import_control()
    found = control.ss(system)
    if found.dt is True:
        raise ValueError("dt is True: the system is sampled, but nothing says how often; give it a period [s]")
    matrices = (np.array(matrix, float) for matrix in (found.A, found.B, found.C, found.D))
    return Transfer(*matrices, period=float(found.dt) if found.dt else None)


def _import_control() -> Any:
    try:
        import control
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(
            'python-control needed: pip install ".[control]" in a clone', name="control"
        ) from error
    return control
