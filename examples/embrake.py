"""An electro-mechanical brake: a motor with a gear moves the brake pads, written as a user would.

    L I' = u - (R + K^2/d) I,   x' = K/(i d) I

The rotor has no inertia: its speed is K I/d, from the torque K I against the viscous friction d. The benchmark BRKDC01
of the ARCH competition closes the loop by a PI that a computer runs every 0.1 ms.

    diffabs simulate embrake.toml --parts embrake

Source: T. Strathmann and J. Oehlerking, Verifying Properties of an Electro-Mechanical Braking System, ARCH 2015.
"""

from types import MappingProxyType
from typing import Any, NamedTuple

from diffabs.core.pytree import param, pytree
from diffabs.core.types import Scalar


class CaliperOutput(NamedTuple):
    """State and output of the brake; the target is of the first signal.

    Attributes:
        position: Position x of the pads [m].
        current: Current I of the motor [A].
    """

    position: Scalar
    current: Scalar

    units = MappingProxyType({"position": "m", "current": "A"})


@pytree
class CaliperStart:
    """Start of a run, without current."""

    position: Scalar = param(default=0.0, unit="m")


@pytree
class EMBrake:
    """L I' = u - (R + K^2/d) I and x' = K/(i d) I, under a voltage u.

    In the letters of the module's equations, the fields are L, R, K, d and i.
    """

    inductance: Scalar = param(default=1e-3, unit="H", above=0.0)
    resistance: Scalar = param(default=0.5, unit="ohm", above=0.0)
    constant: Scalar = param(default=0.02, unit="N m/A", above=0.0)
    friction: Scalar = param(default=0.1, unit="N m s/rad", above=0.0)
    gear: Scalar = param(default=113.1167, unit="rad/m", above=0.0)

    shows = CaliperOutput
    control_unit = "V"

    def start(self, initial: CaliperStart) -> CaliperOutput:
        """Return the state for a position, without current."""
        return CaliperOutput(initial.position, 0.0 * initial.position)

    def derivative(self, t: Scalar, state: CaliperOutput, control: Scalar) -> CaliperOutput:
        """Return dx/dt under a voltage `control` [V]."""
        del t
        turns = self.constant * state.current / self.friction  # rad/s
        induced = control - self.resistance * state.current - self.constant * turns
        return CaliperOutput(turns / self.gear, induced / self.inductance)

    def project(self, state: CaliperOutput) -> CaliperOutput:
        """Return the state: every state is admissible."""
        return state

    def output(self, state: CaliperOutput) -> CaliperOutput:
        """Return the state."""
        return state

    def holding(self, output: CaliperOutput, target: Scalar) -> Scalar:
        """Return the voltage that holds a position [V]: 0, since nothing pushes the pads."""
        del output
        return 0.0 * target

    def usual_parts(self) -> dict[str, Any]:
        """Return the parts that a scenario need not name."""
        return {"initial": CaliperStart()}
