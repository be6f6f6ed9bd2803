"""The 134 models of Astrom and Hagglund's test batch, their step responses, and printed tuning rules.

Models: K. J. Astrom, T. Hagglund, "Revisiting the Ziegler-Nichols step response method for PID control", Journal of
Process Control 14 (2004) 635-650, eq. (5); Advanced PID Control (ISA, 2006), section 7.2. Rules: AMIGO from there, SIMC
from S. Skogestad, "Simple analytic rules for model reduction and PID controller tuning", Journal of Process Control 13
(2003) 291-309.
"""

import dataclasses
import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from scipy import linalg

REACHED = 1 - math.exp(-1)  # share of a step whose time gives the lag: the 63 % of the rules
STEPS = 20_000  # of a step response


@dataclasses.dataclass(frozen=True)
class Process:
    """A stable process, or one with an integrator, of unit gain.

    Attributes:
        name: Name with the printed parameter.
        numerator: Coefficients, the highest power of s first.
        denominator: Coefficients, the highest power of s first; its last one is 0 for an integrator.
        delay: Delay [s].
    """

    name: str
    numerator: np.ndarray
    denominator: np.ndarray
    delay: float

    @property
    def integrates(self) -> bool:
        """Whether the process has an integrator."""
        return self.denominator[-1] == 0

    @property
    def duration(self) -> float:
        """Sum of delay and lags [s], the time scale."""
        denominator = self.denominator[:-1] if self.integrates else self.denominator
        rational = np.polyder(denominator)[-1] / denominator[-1] if len(denominator) > 1 else 0.0
        return self.delay + rational - np.polyder(np.append(0.0, self.numerator))[-1] / self.numerator[-1]

    def respond(self, w: np.ndarray) -> np.ndarray:
        """Return P(jw) at frequencies [rad/s]."""
        s = 1j * w
        return np.polyval(self.numerator, s) / np.polyval(self.denominator, s) * np.exp(-s * self.delay)

    def state_space(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return A (n, n), B (n, 1) and C (1, n) of the rational part in controllable form."""
        leading, *rest = self.denominator
        n = len(rest)
        a = np.eye(n, k=-1)
        a[0] = -np.array(rest) / leading
        c = np.zeros((1, n))
        c[0, n - len(self.numerator) :] = self.numerator / leading
        return a, np.eye(n, 1), c


def _product(factors: Sequence[Sequence[float]]) -> np.ndarray:
    result = np.ones(1)
    for factor in factors:
        result = np.polymul(result, factor)
    return result


def _model(name: str, *lags: Sequence[float], numerator: Sequence[float] = (1.0,), delay: float = 0.0) -> Process:
    return Process(name, np.array(numerator), _product(lags), delay)


def list_models() -> Iterator[Process]:
    """Yield the 134 models P1 to P9 in the printed order."""
    lags = (
        0.02,
        0.05,
        0.1,
        0.2,
        0.3,
        0.5,
        0.7,
        1.0,
        1.3,
        1.5,
        2.0,
        4.0,
        6.0,
        8.0,
        10.0,
        20.0,
        50.0,
        100.0,
        200.0,
        500.0,
    )
    lag = (1.0, 1.0)
    for t in (*lags, 1000.0):
        yield _model(f"P1 T={t:g}", (t, 1), delay=1.0)
    for t in (0.01, *lags):
        yield _model(f"P2 T={t:g}", (t, 1), (t, 1), delay=1.0)
    for t in (0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 2.0, 5.0, 10.0):
        yield _model(f"P3 T={t:g}", lag, (t, 1), (t, 1))
    for n in range(3, 9):
        yield _model(f"P4 n={n}", *[lag] * n)
    for tenth in range(1, 10):
        a = tenth / 10
        yield _model(f"P5 a={a:g}", *((a**power, 1) for power in range(4)))
    for delay in (0.01, 0.02, 0.05, 0.1, 0.2, 0.3, 0.5, 0.7, 0.9, 1.0):
        rest = [(1 - delay, 1)] if delay < 1 else []
        yield _model(f"P6 L1={delay:g}", (1, 0), *rest, delay=delay)
    for t in (1.0, 2.0, 5.0, 10.0):
        for delay in (0.01, 0.02, 0.05, 0.1, 0.3, 0.5, 0.7, 0.9, 1.0):
            rest = [(1 - delay, 1)] if delay < 1 else []
            yield _model(f"P7 T={t:g} L1={delay:g}", (t, 1), *rest, numerator=(t,), delay=delay)
    for tenth in range(1, 12):
        yield _model(f"P8 a={tenth / 10:g}", lag, lag, lag, numerator=(-tenth / 10, 1))
    for tenth in range(1, 11):
        t = tenth / 10
        yield _model(f"P9 T={t:g}", lag, (t * t, 1.4 * t, 1))


class StepFit(NamedTuple):
    """What rules read from a step response.

    Attributes:
        gain: Static gain, or slope at the end of a process with an integrator.
        delay: Where the steepest tangent meets the start value [s]: L.
        lag: Time to 63 % less L [s]; infinite with an integrator.
    """

    gain: float
    delay: float
    lag: float


def fit_step(process: Process) -> StepFit:
    """Return the fit of the step response, computed by the matrix exponential on an even grid."""
    if process.integrates:  # the slope grows up to its end value, whose tangent starts after all lags and delays
        return StepFit(process.numerator[-1] / process.denominator[-2], process.duration, np.inf)
    a, b, c = process.state_space()
    gain = process.numerator[-1] / process.denominator[-1]
    times, step = np.linspace(0.0, 6 * (process.duration - process.delay), STEPS + 1, retstep=True)
    # The input is a state that stays 1.
    held = np.block([[a, b], [np.zeros((1, len(a) + 1))]])
    transition = linalg.expm(held * step)
    states = np.empty((STEPS + 1, len(held)))
    states[0] = np.eye(len(held))[-1]
    for i in range(STEPS):
        states[i + 1] = transition @ states[i]
    response, slope = states[:, :-1] @ c[0], states @ held[:-1].T @ c[0]
    steepest = int(np.argmax(slope))
    after = int(np.argmax(response >= REACHED * gain))
    share = (REACHED * gain - response[after - 1]) / (response[after] - response[after - 1])
    reached = process.delay + times[after - 1] + share * step
    delay = process.delay + times[steepest] - response[steepest] / slope[steepest]
    return StepFit(gain, delay, reached - delay)


class Gains(NamedTuple):
    """Gains of C(s) = k + ki/s + kd s/(1 + s filter)."""

    k: float
    ki: float
    kd: float = 0.0


def _from_times(k: float, integral: float, derivative: float = 0.0) -> Gains:
    return Gains(k, k / integral, k * derivative)


def simc_pi(fit: StepFit) -> Gains:
    """Return SIMC's PI gains with a closed-loop time constant of the delay."""
    if math.isinf(fit.lag):
        return _from_times(0.5 / (fit.gain * fit.delay), 8 * fit.delay)
    return _from_times(0.5 * fit.lag / (fit.gain * fit.delay), min(fit.lag, 8 * fit.delay))


def amigo_pi(fit: StepFit) -> Gains:
    """Return AMIGO's PI gains."""
    gain, delay, lag = fit
    if math.isinf(lag):
        return _from_times(0.35 / (gain * delay), 13.4 * delay)
    k = (0.15 + (0.35 - delay * lag / (delay + lag) ** 2) * lag / delay) / gain
    return _from_times(k, 0.35 * delay + 13 * delay * lag**2 / (lag**2 + 12 * delay * lag + 7 * delay**2))


def amigo_pid(fit: StepFit) -> Gains:
    """Return AMIGO's PID gains."""
    gain, delay, lag = fit
    if math.isinf(lag):
        return _from_times(0.45 / (gain * delay), 8 * delay, 0.5 * delay)
    integral = (0.4 * delay + 0.8 * lag) / (delay + 0.1 * lag) * delay
    return _from_times((0.2 + 0.45 * lag / delay) / gain, integral, 0.5 * delay * lag / (0.3 * delay + lag))


def filter_time(fit: StepFit) -> float:
    """Return the time constant of the derivative's filter [s]: a tenth of AMIGO's derivative time."""
    gains = amigo_pid(fit)
    return gains.kd / gains.k / 10
