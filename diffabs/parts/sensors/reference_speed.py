"""Reference speed of a car: the vehicle speed that its wheels show, and the slips computed with it.

A car measures the speeds w_i of its rims and its deceleration, not its speed. `SelectHigh` takes the fastest rim,
because a braked wheel is not faster than the car, and lets the reference fall no faster than a slope:

    v_k = max(w_1, ..., w_n, v_(k-1) - slope T, floor)             every period T
    slip_i = (v_k - w_i)/v_k

While all wheels slip, the reference falls with the slope. Is the slope greater than the car's deceleration, it hides
slip; is it smaller, it shows slip of rolling wheels, and the brakes are released. `SpeedEstimator` reads the
accelerometer instead of a slope.

Source: U. Kiencke and L. Nielsen, Automotive Control Systems, 2nd ed., on the reference speed of anti-lock brakes.
"""

from functools import reduce

import jax.numpy as jnp

from diffabs.core.channels import select_output
from diffabs.core.numerics import larger
from diffabs.core.protocols import Clock, Memory, no_flow
from diffabs.core.pytree import param, pytree
from diffabs.core.rules import period_on_grid
from diffabs.core.types import PyTree, Scalar


def rim_speeds(signal: PyTree) -> list[Scalar]:
    """Return the speeds of the rims [m/s] of the wheels of a signal, or of its only wheel."""
    return [wheel.wheel_speed for _, wheel in _wheels(signal)]


def fastest_rim(signal: PyTree) -> Scalar:
    """Return the speed of the fastest rim [m/s]."""
    return reduce(larger, rim_speeds(signal))


def show_speed(signal: PyTree, speed: Scalar) -> PyTree:
    """Return the signal with a vehicle `speed` [m/s] and the slips (speed - w)/speed of its wheels."""
    for name, wheel in _wheels(signal):
        slip = (speed - wheel.wheel_speed) / speed
        signal = signal.with_channel(name, wheel._replace(slip=slip)) if name else signal._replace(slip=slip)
    return signal._replace(speed=speed)


def _wheels(signal: PyTree) -> list[tuple[str, PyTree]]:
    """Return the outputs of each wheel by the name of its slip; the only wheel of a signal has no name."""
    slips = getattr(type(signal), "tracked", None)
    return [("", signal)] if slips is None else [(slip, select_output(signal, slip)) for slip in slips]


@pytree
class SelectHigh:
    """The fastest rim as the vehicle speed, which falls no faster than a slope, and the slips computed with it.

    See also:
        `sensors.SpeedEstimator`: A filter of the wheels and an accelerometer.
        `sensors.PerOutput`: Errors of single wheels, in a `Series` before this sensor.

    Notes:
        All wheels of a `HalfCarOutput` or a `CarOutput` count, or the single wheel of a `BrakeOutput`.

    Examples:
        >>> from diffabs.parts.plants import BrakeStart, HalfCar
        >>> from diffabs.parts.sensors import SelectHigh
        >>> car = HalfCar()
        >>> output = car.output(car.start(BrakeStart(speed=20.0, slip=0.1)))
        >>> sensor = SelectHigh()
        >>> shown = sensor.output(0.0, sensor.start(output), output)
        >>> print(f"{shown.speed:.1f} m/s, slip {shown.front_slip:.2f}")  # both axles slip alike
        18.0 m/s, slip 0.00
    """

    slope: Scalar = param(default=10.0, unit="m/s^2", above=0.0)
    """Greatest deceleration of the reference speed."""
    period: Scalar = param(default=1e-3, unit="s", above=0.0, tunable=False)
    """Period of the samples T, a whole multiple of the integration step."""
    floor: Scalar = param(default=0.05, unit="m/s", above=0.0)
    """Least speed that is shown."""

    flow = no_flow
    grid_rules = period_on_grid

    def start(self, signal: PyTree) -> Memory:
        """Return the memory with the speed of the fastest rim [m/s]."""
        return Memory(held=larger(fastest_rim(signal), self.floor))

    def output(self, t: Scalar, memory: Memory, signal: PyTree) -> PyTree:
        """Return the signal with the reference speed and its slips."""
        del t
        return show_speed(signal, memory.held)

    def tick(self, clock: Clock, memory: Memory, signal: PyTree) -> Memory:
        """Return the memory with a new reference speed if a period begins, else the old memory."""
        now, number = clock.ticks(self.period)
        fallen = memory.held - jnp.where(number > 0, self.slope * self.period, 0.0)
        reference = larger(larger(fastest_rim(signal), fallen), self.floor)
        return Memory(held=jnp.where(now, reference, memory.held))
