"""State feedback with a gain that depends on the measured speed.

    u = clamp(ff + K(v) x, u_min, u_max),   x = (integral of (slip - target), slip - target)

K is linear in v between nodes and constant beyond them. `diffabs.robust.design.design` returns such gains for a
`Schedule`, and its certificate holds for them. The sign convention is that of `StateFeedback`.

Source: gain scheduling by a parameter-dependent Lyapunov function: W. J. Rugh and J. S. Shamma, Research on gain
scheduling, Automatica 36 (2000).
"""

from collections.abc import Iterator

import jax.numpy as jnp
import numpy as np

from diffabs.core.numerics import interpolate_shares, interval_shares
from diffabs.core.protocols import Tracking
from diffabs.core.pytree import param, part, pytree
from diffabs.core.rules import Rule, increase_rule
from diffabs.core.types import Part, Scalar, Vector
from diffabs.parts.controllers.antiwindup import NoAntiWindup
from diffabs.parts.controllers.feedback import StateFeedback


@pytree
class ScheduledFeedback:
    """u = clamp(ff + k1(v) x1 + k2(v) x2, low, high), with gains at increasing speeds."""

    speeds: Vector = param(default=(5 / 3.6, 50 / 3.6), unit="m/s", low=0.0, free=True)
    """Nodes v, increasing."""
    integral_gains: Vector = param(default=(-11753.0, -11753.0), unit="control/signal/s", free=True)
    """Gains k1 at the nodes."""
    gains: Vector = param(default=(-58.0, -158.0), unit="control/signal", free=True)
    """Gains k2 at the nodes."""
    low: Scalar = param(default=-np.inf, unit="control", below=np.inf, infinite=True)
    """Lower limit of the control."""
    high: Scalar = param(default=np.inf, unit="control", above=-np.inf, infinite=True)
    """Upper limit of the control."""
    antiwindup: Part = part(default=NoAntiWindup)
    """Anti-windup strategy of the integral."""

    start, limits, flow, output = StateFeedback.start, StateFeedback.limits, StateFeedback.flow, StateFeedback.output
    _torque = StateFeedback._torque

    def _gain(self, signal: Tracking) -> tuple[Scalar, Scalar]:
        speeds, integral_gains, gains = map(jnp.asarray, (self.speeds, self.integral_gains, self.gains))
        rise = interval_shares(signal.measured.speed, speeds)
        return interpolate_shares(rise, integral_gains), interpolate_shares(rise, gains)

    def problems(self) -> Iterator[str]:
        """Yield a message if `speeds`, `integral_gains` and `gains` differ in shape, or are empty."""
        shapes = {name: np.shape(getattr(self, name)) for name in ("speeds", "integral_gains", "gains")}
        if len(set(shapes.values())) != 1 or len(shapes["speeds"]) != 1 or not shapes["speeds"][0]:
            yield f"speeds, integral_gains and gains have shapes {', '.join(map(str, shapes.values()))}; they need one"

    def rules(self) -> Iterator[Rule]:
        """Yield the rules that the speeds increase and that low <= high."""
        yield increase_rule("speeds", self.speeds, "do not increase", "m/s")
        yield from StateFeedback.rules(self)  # pyright: ignore[reportArgumentType]  # same fields of limits


@pytree
class ProportionalFeedback:
    """u = clamp(ff + (v/v0) (k1 x1 + k2 x2), low, high): gains proportional to the measured speed.

    At a frozen speed the gain from torque to slip of a braked wheel is proportional to 1/v, eq. (16) of Maeda and
    Sugiura. The factor v/v0 cancels this, so the loop is equally fast at every speed.
    """

    gain: Vector = param(default=(-11753.0, -158.0), unit="control/signal/s, control/signal")
    """(k1, k2) at the speed v0, shape (2,)."""
    reference_speed: Scalar = param(default=50 / 3.6, unit="m/s", above=0.0)
    """Speed v0 at which gains and rates have their stated values."""
    low: Scalar = param(default=-np.inf, unit="control", below=np.inf, infinite=True)
    """Lower limit of the control."""
    high: Scalar = param(default=np.inf, unit="control", above=-np.inf, infinite=True)
    """Upper limit of the control."""
    antiwindup: Part = part(default=NoAntiWindup)
    """Anti-windup strategy of the integral."""

    start, limits, flow, output = StateFeedback.start, StateFeedback.limits, StateFeedback.flow, StateFeedback.output
    rules, _torque = StateFeedback.rules, StateFeedback._torque

    def _gain(self, signal: Tracking) -> Vector:
        return jnp.asarray(self.gain) * (signal.measured.speed / self.reference_speed)
