"""A position servo: a DC motor that turns a load, behind an amplifier of limited voltage.

    angle' = w,   J w' = K i - b w - Tc tanh(w/ws) - T,   L i' = clamp(u, -u_max, u_max) - R i - K w

Parts for diffabs: `--parts dc_servo`, or install this folder.
"""

import math
from types import MappingProxyType
from typing import Any, NamedTuple

import jax.numpy as jnp

from diffabs.core.numerics import clamp
from diffabs.core.protocols import Ending, Memory, Sample, Segment
from diffabs.core.pytree import param, pytree
from diffabs.core.types import Scalar


class ServoOutput(NamedTuple):
    """What the servo shows; the target is of the first signal."""

    angle: Scalar
    speed: Scalar
    current: Scalar

    units = MappingProxyType({"angle": "rad", "speed": "rad/s", "current": "A"})


@pytree
class ServoStart:
    """Where a run starts, without current."""

    angle: Scalar = param(default=0.0, unit="rad")
    speed: Scalar = param(default=0.0, unit="rad/s")


@pytree
class DCMotor:
    """J w' = K i - b w - Tc tanh(w/ws) - T and L i' = u - R i - K w, under a limited voltage u."""

    inertia: Scalar = param(default=2e-3, unit="kg m^2", above=0.0)
    damping: Scalar = param(default=1e-3, unit="N m s/rad", low=0.0)
    constant: Scalar = param(default=0.1, unit="N m/A", above=0.0)
    resistance: Scalar = param(default=1.0, unit="ohm", above=0.0)
    inductance: Scalar = param(default=2e-3, unit="H", above=0.0)
    coulomb: Scalar = param(default=0.01, unit="N m", low=0.0)
    slow: Scalar = param(default=0.5, unit="rad/s", above=0.0)
    load: Scalar = param(default=0.0, unit="N m")
    voltage_max: Scalar = param(default=24.0, unit="V", above=0.0)

    shows = ServoOutput
    control_unit = "V"

    def start(self, initial: ServoStart) -> ServoOutput:
        """The state has the signals that are shown."""
        return ServoOutput(initial.angle, initial.speed, 0.0 * initial.angle)

    def derivative(self, t: Scalar, state: ServoOutput, control: Scalar) -> ServoOutput:
        """Rates under a voltage [V]."""
        del t
        _, speed, current = state
        voltage = clamp(control, -self.voltage_max, self.voltage_max)
        friction = self.damping * speed + self.coulomb * jnp.tanh(speed / self.slow)
        torque = self.constant * current - friction - self.load
        induced = voltage - self.resistance * current - self.constant * speed
        return ServoOutput(speed, torque / self.inertia, induced / self.inductance)

    def project(self, state: ServoOutput) -> ServoOutput:
        """Every state is admissible."""
        return state

    def output(self, state: ServoOutput) -> ServoOutput:
        """The state."""
        return state

    def holding(self, output: ServoOutput, target: Scalar) -> Scalar:
        """The voltage [V] that carries the load."""
        del output
        return self.resistance * self.load / self.constant + 0.0 * target

    def usual_parts(self) -> dict[str, Any]:
        """What a scenario need not name."""
        return {"initial": ServoStart()}


@pytree
class PeakCurrent:
    """Greatest |i|."""

    unit = "A"
    physical = (0.0, math.inf)

    def start(self, sample: Sample) -> Memory:
        """The first."""
        return Memory(held=jnp.abs(sample.output.current))

    def flow(self, memory: Memory, sample: Sample) -> Any:
        """Nothing is integrated."""
        del memory, sample
        return ()

    def update(self, memory: Memory, segment: Segment) -> Scalar:
        """The greatest of the step, from its cubic."""
        current = segment.output(lambda output: output.current)
        return jnp.maximum(memory.held, jnp.maximum(current.greatest(), current.times(-1.0).greatest()))

    def value(self, memory: Memory, ending: Ending) -> Scalar:
        """The greatest."""
        del ending
        return memory.held
