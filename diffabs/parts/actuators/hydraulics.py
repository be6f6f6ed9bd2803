"""Hydraulic brake of a wheel: a cylinder that an inlet valve fills and an outlet valve empties.

    x' = max(u, 0) s(p0 - p)/T1 - max(-u, 0) s(p)/T2,   u = clamp(command, -1, 1)
    s(d) = d/(P^2 (d^2 + d_lam^2))^(1/4)
    p = P ((1 - k) z + k z^2),   z = max(x - x0, 0)/(1 - x0)
    torque = 2 mu A r max(p - p_push, 0)

x = V/V_P is the fluid V in the cylinder over the fluid V_P that it has at the pressure P = 100 bar. The first x0 of it
closes the clearance between pads and disc, without a pressure. The flow through an orifice of area a is
c a sqrt(2 d/rho); so s is sqrt(d/P), and

    T1 = V_P/(c a sqrt(2 P/rho))

is the time in which the open inlet passes V_P under a constant difference of 100 bar. Differences below d_lam have a
laminar flow: s then has finite derivatives at d = 0, and the pressure stays within [0, p0]. The reservoir behind the
outlet has pressure 0.

A command of 1 opens the inlet, -1 the outlet; 0 holds the fluid. The dead time of the valves is a block before this
one: `Series(blocks=(DeadTime(rise=..., fall=...), HydraulicBrake()))`. An actuator does not see the speed of the wheel,
so the pads do not heat up, and their friction is constant.

Source: J. C. Gerdes and J. K. Hedrick, Brake System Modeling, Control and Integrated Brake/Throttle Switching: Phase I,
UCB-ITS-PRR-97-21, 1997, for the flow proportional to the root of the pressure difference, the pressure as a function of
the volume, and the push-out pressure. The default numbers are of no particular brake, which reaches 100 bar in 0.2 s.
"""

import jax.numpy as jnp

from diffabs.core.numerics import clamp, larger, quotient
from diffabs.core.protocols import Memory
from diffabs.core.pytree import param, pytree
from diffabs.core.types import Scalar

FULL_PRESSURE = 1e7  # Pa, P: pressure of a full cylinder


@pytree
class HydraulicBrake:
    """A valve's command in [-1, 1] becomes a brake torque: 1 builds pressure, 0 holds it, -1 dumps it.

    See also:
        `actuators.DeadTime`: Dead time of the valves, in a `Series` before the brake.
        `actuators.IntegratingValve`: A brake that fills and empties at a constant rate.
        `controllers.FivePhase`: A logic that commands the valves.

    Notes:
        An axle with two equal brakes has twice the `piston_area`; the other numbers are those of one wheel.

    Examples:
        >>> from diffabs.parts.actuators import HydraulicBrake
        >>> brake = HydraulicBrake()
        >>> print(f"{brake.pressure(0.5) / 1e5:.1f} bar, {brake.torque(50e5):.0f} N m at 50 bar")
        26.6 bar, 1055 N m at 50 bar
    """

    supply_pressure: Scalar = param(default=1.5e7, unit="Pa", above=0.0)
    """Pressure p0 before the inlet valve, of the pump or of the accumulator."""
    inlet_time: Scalar = param(default=0.2, unit="s", above=0.0)
    """Time T1 in which the open inlet valve fills the cylinder under a difference of 100 bar."""
    outlet_time: Scalar = param(default=0.07, unit="s", above=0.0)
    """Time T2 in which the open outlet valve empties it under that difference."""
    laminar_pressure: Scalar = param(default=1e4, unit="Pa", above=0.0)
    """Pressure difference d_lam below which the flow is laminar."""
    dead_share: Scalar = param(default=0.15, unit="1", low=0.0, below=1.0)
    """Share x0 of the fluid that closes the clearance of the pads."""
    stiffening: Scalar = param(default=0.6, unit="1", low=0.0, high=1.0)
    """Share k of the pressure that grows with the square of the fluid."""
    push_out_pressure: Scalar = param(default=5e4, unit="Pa", low=0.0)
    """Pressure p_push from which on the pads press on the disc."""
    pad_friction: Scalar = param(default=0.38, unit="1", above=0.0)
    """Friction coefficient mu of the pads."""
    piston_area: Scalar = param(default=2.55e-3, unit="m^2", above=0.0)
    """Area A of the pistons on one side of the disc."""
    pad_radius: Scalar = param(default=0.11, unit="m", above=0.0)
    """Radius r at which the pads act on the disc."""

    def start(self, signal: Scalar) -> Memory:
        """Return the memory of an empty brake: x = 0 [1]."""
        return Memory(flow=0.0 * signal)

    def flow(self, t: Scalar, memory: Memory, signal: Scalar) -> Scalar:
        """Return x' [1/s] under a valve's command."""
        del t
        pressure, opening = self.pressure(memory.flow), clamp(signal, -1.0, 1.0)
        inflow = quotient(larger(opening, 0.0), self.inlet_time) * self._orifice_flow(self.supply_pressure - pressure)
        return inflow - quotient(larger(-opening, 0.0), self.outlet_time) * self._orifice_flow(pressure)

    def output(self, t: Scalar, memory: Memory, signal: Scalar) -> Scalar:
        """Return the brake torque [N m]."""
        del t, signal
        return self.torque(self.pressure(memory.flow))

    def pressure(self, filling: Scalar) -> Scalar:
        """Return the pressure [Pa] of a cylinder with the `filling` x [1]."""
        pressed = quotient(larger(filling - self.dead_share, 0.0), 1.0 - self.dead_share)
        return FULL_PRESSURE * pressed * (1.0 - self.stiffening + self.stiffening * pressed)

    def torque(self, pressure: Scalar) -> Scalar:
        """Return the brake torque [N m] under a `pressure` [Pa]."""
        pressing = larger(pressure - self.push_out_pressure, 0.0)
        return 2.0 * self.pad_friction * self.piston_area * self.pad_radius * pressing

    def _orifice_flow(self, difference: Scalar) -> Scalar:
        """Return the flow under a pressure `difference` [Pa] over that under 100 bar [1]."""
        root = jnp.sqrt(jnp.sqrt(difference**2 + self.laminar_pressure**2))
        return quotient(difference, root) / FULL_PRESSURE**0.5
