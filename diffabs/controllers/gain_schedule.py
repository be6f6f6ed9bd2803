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
from diffabs.controllers.feedback import StateFeedback
from diffabs.core.numerics import interpolate_shares, interval_shares
from diffabs.core.protocols import Memory, Tracking
from diffabs.core.pytree import Scalar, Vector, param, part, pytree
from diffabs.core.rules import Rule, increase_rule


@pytree
class ScheduledFeedback:
    """u = clamp(ff + k1(v) x1 + k2(v) x2, torque_min, torque_max); gains at increasing speeds."""

    speeds: Vector = param(default=(5 / 3.6, 50 / 3.6), unit="m/s", low=0.0, free=True)
    integral_gains: Vector = param(default=(-11753.0, -11753.0), unit="control/signal/s", free=True)
    gains: Vector = param(default=(-58.0, -158.0), unit="control/signal", free=True)
    torque_min: Scalar = param(default=-np.inf, unit="control", infinite=True)
    torque_max: Scalar = param(default=np.inf, unit="control", infinite=True)
    antiwindup: Any = part(default=NoAntiWindup)

    start, limits = StateFeedback.start, StateFeedback.limits

    def flow(self, t: Scalar, memory: Memory, signal: Tracking) -> Any:
        """x1' = slip - target, unless the anti-windup says otherwise."""
        return self._here(signal).flow(t, memory, signal)

    def output(self, t: Scalar, memory: Memory, signal: Tracking) -> Any:
        """Torque [N m]."""
        return self._here(signal).output(t, memory, signal)

    def _here(self, signal: Tracking) -> StateFeedback:
        """The feedback at the measured speed. Raises ValueError for lists of different lengths."""
        shapes = [np.shape(x) for x in (self.speeds, self.integral_gains, self.gains)]
        if len(set(shapes)) != 1:
            raise ValueError(f"speeds, integral_gains and gains have shapes {', '.join(map(str, shapes))}")
        rise = interval_shares(signal.measured.speed, jnp.asarray(self.speeds))
        rows = (interpolate_shares(rise, jnp.asarray(gains)) for gains in (self.integral_gains, self.gains))
        limits = {"torque_min": self.torque_min, "torque_max": self.torque_max}
        return StateFeedback(gain=jnp.stack(list(rows)), **limits, antiwindup=self.antiwindup)

    def problems(self) -> Iterator[str]:
        """Lists of different lengths."""
        shapes = {name: np.shape(getattr(self, name)) for name in ("speeds", "integral_gains", "gains")}
        if len(set(shapes.values())) != 1 or len(shapes["speeds"]) != 1 or not shapes["speeds"][0]:
            yield f"speeds, integral_gains and gains have shapes {', '.join(map(str, shapes.values()))}; they need one"

    def rules(self) -> Iterator[Rule]:
        """Speeds that increase, limits that do not exclude each other."""
        yield increase_rule("speeds", self.speeds, "do not increase", "m/s")
        yield from StateFeedback.rules(self)  # pyright: ignore[reportArgumentType]  # has the same limits


@pytree
class ProportionalFeedback:
    """u = clamp(ff + (v/v0) (k1 x1 + k2 x2), torque_min, torque_max): gains in proportion to the measured speed.

    At a frozen speed the slip of a braked wheel answers to torque with a gain that goes with 1/v, eq. (16) of Maeda and
    Sugiura; this cancels it, and the loop is equally fast at every speed. `gain` is that at `reference_speed` v0.
    """

    gain: Vector = param(default=(-11753.0, -158.0), unit="control/signal/s, control/signal")
    reference_speed: Scalar = param(default=50 / 3.6, unit="m/s", above=0.0)
    torque_min: Scalar = param(default=-np.inf, unit="control", infinite=True)
    torque_max: Scalar = param(default=np.inf, unit="control", infinite=True)
    antiwindup: Any = part(default=NoAntiWindup)

    start, limits = StateFeedback.start, StateFeedback.limits
    problems, rules = StateFeedback.problems, StateFeedback.rules
    flow, output = ScheduledFeedback.flow, ScheduledFeedback.output

    def _here(self, signal: Tracking) -> StateFeedback:
        """The feedback at the measured speed."""
        gain = jnp.asarray(self.gain) * (signal.measured.speed / self.reference_speed)
        limits = {"torque_min": self.torque_min, "torque_max": self.torque_max}
        return StateFeedback(gain=gain, **limits, antiwindup=self.antiwindup)
