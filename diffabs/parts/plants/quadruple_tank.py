"""Quadruple tank: two pumps fill four tanks, and the lower two levels are controlled.

    A1 h1' = -q1 + q3 + g1 k1 v1       A3 h3' = -q3 + (1 - g2) k2 v2       qi = ai sqrt(2 g hi)
    A2 h2' = -q2 + q4 + g2 k2 v2       A4 h4' = -q4 + (1 - g1) k1 v1

Each pump fills one lower tank and, through the upper tank of the other side, the other one. Two valves set the shares
g1 and g2. With g1 + g2 > 1 most water flows directly and the plant has no zero in the right half plane. With g1 + g2 <
1 it has one, so no control of both levels can be fast.

Source: K. H. Johansson, The quadruple-tank process: a multivariable laboratory process with an adjustable zero, IEEE
Transactions on Control Systems Technology 8 (2000), pp. 456-465, eq. (1) and the tables of parameters.
"""

from collections.abc import Mapping
from types import MappingProxyType
from typing import ClassVar, NamedTuple

import jax.numpy as jnp

from diffabs.core.numerics import larger
from diffabs.core.protocols import Objective
from diffabs.core.pytree import param, pytree
from diffabs.core.types import PyTree, Scalar
from diffabs.parts.actuators import Limits, PerControl
from diffabs.parts.controllers import PID, BackCalculation, HoldingInput, PerChannel
from diffabs.parts.objectives import IAE, FinalError, InChannel, Overshoot, SettlingTime
from diffabs.parts.references import PerTarget, Setpoint
from diffabs.parts.stops import NoStop

PUMP_HIGH = 10.0  # V, the highest voltage of the laboratory's pumps


class TankLevels(NamedTuple):
    """The fields of a `TankOutput`, and the state of a `QuadrupleTank`."""

    level_1: Scalar  # [m] lower tank, filled by pump 1
    level_2: Scalar  # [m] lower tank, filled by pump 2
    level_3: Scalar  # [m] upper tank above tank 1
    level_4: Scalar  # [m] upper tank above tank 2


class TankOutput(TankLevels):
    """The outputs of a quadruple tank; the lower two levels have targets."""

    __slots__ = ()
    units: ClassVar[Mapping[str, str]] = MappingProxyType(dict.fromkeys(TankLevels._fields, "m"))
    tracked: ClassVar[tuple[str, ...]] = ("level_1", "level_2")


class PumpSignals(NamedTuple):
    """The fields of `PumpVoltages`."""

    pump_1: Scalar  # [V]
    pump_2: Scalar  # [V]


class PumpVoltages(PumpSignals):
    """The controls of a quadruple tank."""

    __slots__ = ()
    units: ClassVar[Mapping[str, str]] = MappingProxyType({"pump_1": "V", "pump_2": "V"})


@pytree
class TankStart:
    """The four levels at t = 0; the defaults are near the rest of the minimum-phase setting at 3 V."""

    level_1: Scalar = param(default=0.124, unit="m", low=0.0)
    """Level of the lower tank 1."""
    level_2: Scalar = param(default=0.127, unit="m", low=0.0)
    """Level of the lower tank 2."""
    level_3: Scalar = param(default=0.018, unit="m", low=0.0)
    """Level of the upper tank 3."""
    level_4: Scalar = param(default=0.014, unit="m", low=0.0)
    """Level of the upper tank 4."""


@pytree
class QuadrupleTank:
    """Four tanks and two pumps; the defaults are the minimum-phase setting of the source."""

    area_1: Scalar = param(default=28e-4, unit="m^2", above=0.0)
    """Cross-section of tank 1."""
    area_2: Scalar = param(default=32e-4, unit="m^2", above=0.0)
    """Cross-section of tank 2."""
    area_3: Scalar = param(default=28e-4, unit="m^2", above=0.0)
    """Cross-section of tank 3."""
    area_4: Scalar = param(default=32e-4, unit="m^2", above=0.0)
    """Cross-section of tank 4."""
    outlet_1: Scalar = param(default=0.071e-4, unit="m^2", above=0.0)
    """Cross-section of the outlet of tank 1."""
    outlet_2: Scalar = param(default=0.057e-4, unit="m^2", above=0.0)
    """Cross-section of the outlet of tank 2."""
    outlet_3: Scalar = param(default=0.071e-4, unit="m^2", above=0.0)
    """Cross-section of the outlet of tank 3."""
    outlet_4: Scalar = param(default=0.057e-4, unit="m^2", above=0.0)
    """Cross-section of the outlet of tank 4."""
    flow_1: Scalar = param(default=3.33e-6, unit="m^3/(V s)", above=0.0)
    """Flow k1 of pump 1 per volt."""
    flow_2: Scalar = param(default=3.35e-6, unit="m^3/(V s)", above=0.0)
    """Flow k2 of pump 2 per volt."""
    share_1: Scalar = param(default=0.70, unit="1", low=0.0, high=1.0)
    """Share g1 of pump 1 that flows into tank 1."""
    share_2: Scalar = param(default=0.60, unit="1", low=0.0, high=1.0)
    """Share g2 of pump 2 that flows into tank 2."""
    gravity: Scalar = param(default=9.81, unit="m/s^2", above=0.0)
    """Acceleration g of gravity."""
    film: Scalar = param(default=1e-4, unit="m", above=0.0)
    """Depth below which an outlet no longer follows the square root, whose slope is infinite at an empty tank."""

    shows = TankOutput
    controls = PumpVoltages

    def start(self, initial: TankStart) -> TankLevels:
        """Return the levels of `initial`."""
        return TankLevels(*(getattr(initial, name) for name in TankLevels._fields))

    def outflows(self, levels: TankLevels) -> tuple[Scalar, ...]:
        """Return the flow out of each tank [m^3/s]: a sqrt(2 g h), to a share of (film/h)^2/4."""
        outlets = (self.outlet_1, self.outlet_2, self.outlet_3, self.outlet_4)
        return tuple(self._outflow(outlet, h) for outlet, h in zip(outlets, levels, strict=True))

    def derivative(self, t: Scalar, state: TankLevels, control: PumpVoltages) -> TankLevels:
        """Return the rates of the levels [m/s] under the voltages of the pumps [V]."""
        del t
        q1, q2, q3, q4 = self.outflows(state)
        p1, p2 = self.flow_1 * control.pump_1, self.flow_2 * control.pump_2
        return TankLevels(
            (-q1 + q3 + self.share_1 * p1) / self.area_1,
            (-q2 + q4 + self.share_2 * p2) / self.area_2,
            (-q3 + (1 - self.share_2) * p2) / self.area_3,
            (-q4 + (1 - self.share_1) * p1) / self.area_4,
        )

    def project(self, state: TankLevels) -> TankLevels:
        """Return the levels, none of them below the bottom."""
        return TankLevels(*(larger(level, 0.0) for level in state))

    def output(self, state: TankLevels) -> TankOutput:
        """Return the levels [m]."""
        return TankOutput(*state)

    def holding(self, output: TankOutput, target: PyTree) -> PumpVoltages:
        """Return the voltages [V] that hold the lower levels at the target; g1 + g2 = 1 has none.

        The flows out of the lower tanks are then those of both pumps, in shares g1, 1 - g2 and 1 - g1, g2.
        """
        del output
        q1, q2 = self._outflow(self.outlet_1, target.level_1), self._outflow(self.outlet_2, target.level_2)
        determinant = self.share_1 + self.share_2 - 1
        p1 = (self.share_2 * q1 - (1 - self.share_2) * q2) / determinant
        p2 = (self.share_1 * q2 - (1 - self.share_1) * q1) / determinant
        return PumpVoltages(p1 / self.flow_1, p2 / self.flow_2)

    def usual_parts(self) -> dict[str, PyTree]:
        """Return the source's decentralised PI controllers, whose levels were measured with 50 V/m, and 0 to 10 V."""
        gains = {"pump_1": (150.0, 5.0), "pump_2": (135.0, 3.375)}
        pumps = {"pump_1": "level_1", "pump_2": "level_2"}
        controllers = {
            name: PID(kp=kp, ki=ki, cutoff=1.0, low=0.0, high=PUMP_HIGH, antiwindup=BackCalculation(tracking_time=30.0))
            for name, (kp, ki) in gains.items()
        }
        return {
            "initial": TankStart(),
            "reference": PerTarget(reference={"level_1": Setpoint(value=0.134), "level_2": Setpoint(value=0.127)}),
            "feedforward": HoldingInput(),
            "controller": PerChannel(controllers, pumps),
            "actuator": PerControl(actuator={name: Limits(low=0.0, high=PUMP_HIGH) for name in pumps}),
            "stop": NoStop(),
        }

    def usual_objectives(self) -> dict[str, Objective]:
        """Return the usual metrics of tracking for each of both levels."""
        each = {
            "overshoot": Overshoot(),
            "settling_time": SettlingTime(band=5e-4),
            "iae": IAE(),
            "final_error": FinalError(),
        }
        return {
            f"{metric}_{number}": InChannel(objective=objective, output=f"level_{number}", control=f"pump_{number}")
            for number in (1, 2)
            for metric, objective in each.items()
        }

    def _outflow(self, outlet: Scalar, level: Scalar) -> Scalar:
        return outlet * jnp.sqrt(2 * self.gravity) * level / (level**2 + self.film**2) ** 0.25
