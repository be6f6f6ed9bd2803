"""Output feedback in discrete time: a steady Kalman filter, and with a regulator the LQG controller of a balance.

    x+ = A x + B u + w,  y = C x + v,  cov w = W,  cov v = V
    P = A P A' - A P C' (C P C' + V)^-1 C P A' + W,   L = P C' (C P C' + V)^-1      x^ = x^- + L (y - C x^-)

The regulator's equation with A', C' in place of A, B: `dare` solves both. Separation: the poles of the closed loop are
those of A + B K and of A - A L C, whatever the noise.
"""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from diffabs.controllers import ObserverFeedback, Sampled
from diffabs.controllers.balance import MEASURED_NAMES, STATE_NAMES
from diffabs.core.protocols import Plant
from diffabs.linear.balance_model import BalanceModel
from diffabs.linear.lyapunov import as_float_arrays
from diffabs.linear.regulator import dlqr
from diffabs.linear.riccati import dare
from diffabs.linear.slip_model import Sampling

SELECTION = np.eye(len(STATE_NAMES))[[STATE_NAMES.index(name) for name in MEASURED_NAMES]]  # C: theta and psi


class Filter(NamedTuple):
    """Gain L (n, p) of the correction, covariance P (n, n) of the prediction, whether P is proven (`Riccati`)."""

    gain: Any
    P: Any
    stabilising: Any


def kalman(A: Any, C: Any, W: Any, V: Any) -> Filter:
    """The steady filter; A (n, n), C (p, n), W (n, n), V (p, p) > 0. Differentiable; NaN where there is none. Raises
    ValueError as `dare`."""
    A, C, W, V = as_float_arrays(A, C, W, V)
    found = dare(A.T, C.T, W, V)
    spread = C @ found.P @ C.T + V
    return Filter(jnp.linalg.solve(spread, C @ found.P).T, found.P, found.stabilising)


def lqg(
    plant: Plant,
    Q: Any,
    R: Any,
    *,
    period: float = 0.01,
    disturbance: Any = (1.0, 1.0, 1.0),
    noise: Any = (1e-3, 1e-3),
    voltage_max: float = np.inf,
) -> Sampled:
    """Return the computer's controller of a balance that measures theta and psi only: LQR on a Kalman filter, sampled.

    plant: the two-wheeler, linearised upright
    Q (6, 6), R a number: weights of the integral of x'Q x + R u^2, by its sum over the samples
    period: of the computer [s]
    disturbance: standard deviations of unknown accelerations of theta, psi, phi [rad/s^2], constant over a period; an
        estimate that the filter shall trust less wants more
    noise: of the angles theta and psi [rad]
    voltage_max: limit of the command [V]

    Raises ValueError as `dlqr`.
    """
    model = BalanceModel(plant=plant, sampling=Sampling(period=period))
    a, b = model.matrices()
    regulator = dlqr(a, b, period * jnp.asarray(Q), period * jnp.asarray(R).reshape(1, 1))
    spread = jnp.concatenate([0.5 * period**2 * jnp.asarray(disturbance), period * jnp.asarray(disturbance)])
    kicks = jnp.concatenate([jnp.eye(3), jnp.eye(3)]) * spread[:, None]
    filtered = kalman(a, SELECTION, kicks @ kicks.T, jnp.diag(jnp.asarray(noise) ** 2))
    observer = ObserverFeedback(
        gain=regulator.gain[0], transition=a, entry=b[:, 0], correction=filtered.gain, voltage_max=voltage_max
    )
    return Sampled(controller=observer, period=period)
