"""Output feedback in discrete time: a steady-state Kalman filter, and the LQG controller of a balancing plant.

    x+ = A x + B u + w,  y = C x + v,  cov w = W,  cov v = V
    P = A P A' - A P C' (C P C' + V)^-1 C P A' + W,   L = P C' (C P C' + V)^-1      x^ = x^- + L (y - C x^-)

This is the regulator's equation with A', C' in place of A, B, so `dare` solves both. Separation principle: for any
noise covariance, the closed-loop poles are the eigenvalues of A + B K and of A - A L C.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from diffabs.core.jax_flags import default_flags
from diffabs.core.protocols import Plant
from diffabs.core.renamed import refuse_old_names
from diffabs.core.shapes import Bool, Float, Num
from diffabs.core.types import AnyArray, Rows
from diffabs.linear.balance_model import BalanceModel
from diffabs.linear.lyapunov import as_float_arrays
from diffabs.linear.regulator import dlqr
from diffabs.linear.riccati import dare, symmetric_part
from diffabs.linear.slip_model import Sampling
from diffabs.linear.weights import as_weight_matrix, check_symmetric
from diffabs.parts.controllers import ObserverFeedback, Sampled
from diffabs.parts.controllers.balance import MEASURED_NAMES, STATE_NAMES

SELECTION = np.eye(len(STATE_NAMES))[[STATE_NAMES.index(name) for name in MEASURED_NAMES]]  # C: theta and psi


class Filter(NamedTuple):
    """A steady-state Kalman filter.

    Attributes:
        gain: Gain L of the correction, shape (n, p).
        P: Covariance of the prediction error, shape (n, n).
        stabilising: Whether P is proven to be the stabilising solution, as in `Riccati`.
    """

    gain: Float[AnyArray, "*batch n p"]
    P: Float[AnyArray, "*batch n n"]
    stabilising: Bool[AnyArray, "*batch"]


@default_flags()
def kalman(
    A: Num[AnyArray, "n n"] | Rows,
    C: Num[AnyArray, "p n"] | Rows,
    W: Num[AnyArray, "n n"] | Rows,
    V: Num[AnyArray, "p p"] | Rows,
) -> Filter:
    """Return the steady-state Kalman filter of x+ = A x + w, y = C x + v; NaN where no such filter exists.

    The gain L corrects the prediction: x^ = x^- + L (y - C x^-). The predictor's gain is A L. The result is
    differentiable in every argument. Of traced covariances only the symmetric part counts.

    Args:
        A: State matrix, shape (n, n).
        C: Output matrix, shape (p, n).
        W: Covariance of w, shape (n, n), positive semidefinite.
        V: Covariance of v, shape (p, p), positive definite.

    Raises:
        ValueError: The shapes do not fit, there is no state or no output, or the matrices are complex or float32. For
            covariances that are not traced also: W or V is not symmetric and finite, or W is not positive semidefinite,
            or V not positive definite.
    """
    A, C, W, V = as_float_arrays(A, C, W, V)
    for name, covariance, size in (("W", W, len(A)), ("V", V, len(C))):
        if not isinstance(covariance, Tracer):
            check_symmetric(name, covariance, size)
            as_weight_matrix(name, covariance, size, definite=name == "V")
    riccati = dare(A.T, C.T, W, V)
    spread = C @ riccati.P @ C.T + symmetric_part(V)
    return Filter(jnp.linalg.solve(spread, C @ riccati.P).T, riccati.P, riccati.stabilising)


@default_flags()
@refuse_old_names
def lqg(
    plant: Plant,
    Q: AnyArray,
    R: AnyArray,
    *,
    period: float = 0.01,
    disturbance: object = (1.0, 1.0, 1.0),
    noise: object = (1e-3, 1e-3),
    predicted_high: float = np.inf,
) -> Sampled:
    """Return a sampled LQG controller for a balancing plant, which measures only theta and psi.

    It is an LQR on the estimate of a steady-state Kalman filter. Each sample corrects the estimate before the command
    is computed, without a computing delay.

    Args:
        plant: Two-wheeler; it is linearised upright.
        Q: Weight of the states in the integral of x'Q x + R u^2, shape (6, 6). The design replaces the integral by
            `period` times a sum over the samples.
        R: Weight of the control in the same integral, a number.
        period: Sampling period of the controller [s].
        disturbance: Standard deviations of unknown accelerations of theta, psi, phi [rad/s^2], constant over a period.
            With larger values the filter trusts its prediction less.
        noise: Standard deviations of the measured angles theta and psi [rad].
        predicted_high: Upper limit of the voltage in the filter's prediction [V]. The command itself has no limit.

    Raises:
        ValueError: A standard deviation in `noise` is not positive and finite, or the same cases as in `dlqr`.
    """
    noise = jnp.asarray(noise)
    if not isinstance(noise, Tracer) and not (jnp.isfinite(noise) & (noise > 0)).all():
        raise ValueError(f"noise = {noise.tolist()} is outside (0, inf) rad")
    model = BalanceModel(plant=plant, sampling=Sampling(period=period))
    a, b = model.matrices()
    regulator = dlqr(a, b, period * jnp.asarray(Q), period * jnp.asarray(R).reshape(1, 1))
    # An acceleration d, constant over the period T, moves an angle by d T^2/2 and its rate by d T.
    spread = jnp.concatenate([0.5 * period**2 * jnp.asarray(disturbance), period * jnp.asarray(disturbance)])
    kicks = jnp.concatenate([jnp.eye(3), jnp.eye(3)]) * spread[:, None]
    filtered = kalman(a, SELECTION, kicks @ kicks.T, jnp.diag(noise**2))
    observer = ObserverFeedback(
        gain=regulator.gain[0], transition=a, entry=b[:, 0], correction=filtered.gain, predicted_high=predicted_high
    )
    return Sampled(controller=observer, period=period)
