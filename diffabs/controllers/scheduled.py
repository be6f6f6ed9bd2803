"""State feedback whose gain follows the measured speed.

    u = clamp(ff + K(v) x, u_min, u_max),   x = (integral of (slip - target), slip - target)

K is linear in v between nodes and constant beyond them: the gains that `diffabs.design.design` gives for a `Schedule`,
and what its certificate is about. Gain scheduling by a parameter-dependent Lyapunov function: W. J. Rugh and J. S.
Shamma, Research on gain scheduling, Automatica 36 (2000). The sign is that of `StateFeedback`."""

from collections.abc import Iterator
from typing import Any

import jax.numpy as jnp
import numpy as np

from diffabs.controllers.antiwindup import NoAntiWindup
from diffabs.controllers.pid import limit_problems
from diffabs.numerics import clamp
from diffabs.protocols import Memory, Tracking, no_jump
from diffabs.pytree import Scalar, Vector, param, part, pytree


@pytree
class ScheduledFeedback:
    """u = clamp(ff + k1(v) x1 + k2(v) x2, torque_min, torque_max); gains at increasing speeds."""

    speeds: Vector = param(default=(5 / 3.6, 50 / 3.6), unit="m/s", low=0.0)
    integral_gains: Vector = param(default=(-11753.0, -11753.0), unit="N m/s")
    gains: Vector = param(default=(-58.0, -158.0), unit="N m")
    torque_min: Scalar = param(default=-np.inf, unit="N m", infinite=True)
    torque_max: Scalar = param(default=np.inf, unit="N m", infinite=True)
    antiwindup: Any = part(default=NoAntiWindup)

    def start(self, signal: Tracking) -> Memory:
        """x1(0) = 0."""
        return Memory(flow=0.0 * signal.measured.slip)

    def flow(self, t: Scalar, memory: Memory, signal: Tracking) -> Scalar:
        """x1' = slip - target, unless the anti-windup says otherwise."""
        raw, limited = self._torque(memory, signal)
        error = signal.measured.slip - signal.target
        return self.antiwindup.rate(error, self._gain(signal, self.integral_gains), raw, limited)

    def output(self, t: Scalar, memory: Memory, signal: Tracking) -> Scalar:
        """Torque [N m]."""
        return self._torque(memory, signal)[1]

    jump = no_jump

    def _gain(self, signal: Tracking, gains: Vector) -> Any:
        return jnp.interp(signal.measured.speed, self.speeds, gains)

    def _torque(self, memory: Memory, signal: Tracking) -> tuple[Scalar, Scalar]:
        error = signal.measured.slip - signal.target
        integral, proportional = self._gain(signal, self.integral_gains), self._gain(signal, self.gains)
        raw = signal.feedforward + integral * memory.flow + proportional * error
        return raw, clamp(raw, self.torque_min, self.torque_max)

    def problems(self) -> Iterator[str]:
        """Lists of different lengths, speeds that do not increase, limits that exclude each other."""
        shapes = {name: np.shape(getattr(self, name)) for name in ("speeds", "integral_gains", "gains")}
        if len(set(shapes.values())) != 1 or len(shapes["speeds"]) != 1 or not shapes["speeds"][0]:
            yield f"speeds, integral_gains and gains have shapes {', '.join(map(str, shapes.values()))}; they need one"
        elif not (np.diff(self.speeds) > 0).all():
            yield f"speeds = {np.asarray(self.speeds).tolist()} m/s do not increase"
        yield from limit_problems(self.torque_min, self.torque_max)
