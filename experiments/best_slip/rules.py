"""The rules for the target slip. PI and brake are those of Aoki and Nakamura."""

import dataclasses
from collections.abc import Iterator
from typing import Any

import jax.numpy as jnp
import numpy as np

from diffabs import Batch, Loop
from diffabs.core.blocks import Direct, Series
from diffabs.core.protocols import BrakeOutput, Memory, no_flow, no_memory
from diffabs.core.pytree import param, pytree
from diffabs.core.types import Scalar
from diffabs.parts.controllers import PID, BackCalculation
from diffabs.parts.plants import QuarterCar
from diffabs.parts.references import ExtremumSeeking, FixedSlip, PeakLatch, PeakRobust, SlipByDeceleration
from diffabs.parts.roads import MagicFormula, Patches
from diffabs.parts.sensors import IntegratedAccelerometer, Noise
from diffabs.parts.stops import Standstill
from diffabs.scenario.defaults import braking
from experiments.best_slip.bound import INERTIA
from experiments.best_slip.fixed import ERRORS, Fixed, Lanes

PAPER, KNOWN = "latch, the paper's gains", "peak known"
LATCH, ROBUST, FIXED = "latch", "robust latch", "fixed slip"
SEEKING, SCHEDULED = "extremum seeking", "slip by deceleration"
RULES = (LATCH, ROBUST, SEEKING, FIXED, SCHEDULED)


@dataclasses.dataclass(frozen=True)
class Ranges:
    """The tuned numbers of each rule with their ranges, and the start of the PI's gains."""

    ki: float = 5e4  # N m/s, with an anti-windup: ten times the paper's
    tracking_time: float = 0.05  # s
    arming: float = 0.5  # m/s^2, of the robust latch: at its usual 3 it would find nothing on roads below 0.3
    controller: tuple[tuple[str, Any, Any], ...] = (
        ("controller.kp", 500.0, 12000.0),
        ("controller.ki", 10.0, 1e5),
        ("controller.antiwindup.tracking_time", 0.005, 1.0),
    )
    first: tuple[float, float] = (0.03, 0.9)  # target slip of the latches
    filters: tuple[float, float] = (0.005, 0.05)  # s, of the robust latch
    threshold: tuple[float, float] = (0.005, 0.1)
    slip: tuple[float, float] = (0.03, 0.4)  # of the others
    delay: tuple[float, float] = (0.005, 0.5)  # s, of the filter before the table
    gain: tuple[float, float] = (0.05, 30.0)  # 1/s, of extremum seeking, and its other numbers
    dither: tuple[float, float] = (0.005, 0.4)
    frequency: tuple[float, float] = (5.0, 100.0)  # rad/s
    memory: tuple[float, float] = (0.02, 1.0)  # s

    def of(self, rule: str) -> dict[str, tuple[Any, Any]]:
        """Ranges by path."""
        nodes = len(SlipByDeceleration().slips)
        of_reference: dict[str, Any] = {
            LATCH: {"slip": self.first},
            ROBUST: {"slip": self.first, "time_constant": self.filters, "threshold": self.threshold},
            FIXED: {"slip": self.slip},
            SCHEDULED: {"slips": tuple((end,) * nodes for end in self.slip), "time_constant": self.delay},
            SEEKING: {
                "slip": self.slip,
                "gain": self.gain,
                "dither": self.dither,
                "frequency": self.frequency,
                "time_constant": self.memory,
            },
        }[rule]
        shared = {path: (low, high) for path, low, high in self.controller}
        return shared | {f"reference.{name}": ends for name, ends in of_reference.items()}


@pytree
class PeakAtPlace:
    """The slip of the peak of the present surface, up to an edge and beyond it. No sensor tells it."""

    before: Scalar = param(default=0.1, unit="1", above=0.0, high=1.0)
    beyond: Scalar = param(default=0.1, unit="1", above=0.0, high=1.0)
    edge: Scalar = param(default=10.0, unit="m", low=0.0)

    start = no_memory
    flow = no_flow

    def output(self, t: Scalar, memory: Memory, signal: BrakeOutput) -> Any:
        """Target slip [1]."""
        del t, memory
        return jnp.where(signal.distance < self.edge, self.before, self.beyond)

    def setpoint(self, memory: Memory) -> Scalar:
        """That of the last surface."""
        del memory
        return self.beyond


def references(ranges: Ranges) -> dict[str, Any]:
    """Return where the search for each rule starts."""
    return {
        LATCH: PeakLatch(),
        ROBUST: PeakRobust(arming=ranges.arming),
        SEEKING: ExtremumSeeking(),
        FIXED: FixedSlip(slip=0.12),
        SCHEDULED: SlipByDeceleration(),
    }


def loop(fixed: Fixed, sensors: str, reference: Any, controller: PID) -> Loop:
    """A car on a road with an edge."""
    road = Patches(roads=(MagicFormula(), MagicFormula()), edges=np.array([10.0]), width=fixed.roads.width)
    noise = Noise(deceleration=fixed.noise, period=fixed.period)
    sensor = Series(blocks=(noise, IntegratedAccelerometer(floor=fixed.floor))) if sensors == ERRORS else Direct()
    parts = {"sensor": sensor, "reference": reference, "stop": Standstill(speed=fixed.stop)}
    controller = dataclasses.replace(controller, high=fixed.torque)
    return braking(plant=QuarterCar(inertia=INERTIA, road=road), controller=controller, **parts)


def start(ranges: Ranges, fixed: Fixed, sensors: str, rule: str) -> Loop:
    """Return the loop before its tuning."""
    pi = PID(ki=ranges.ki, antiwindup=BackCalculation(tracking_time=ranges.tracking_time), low=0.0, high=90.0)
    return loop(fixed, sensors, references(ranges)[rule], pi)


def untuned(ranges: Ranges, fixed: Fixed, sensors: str) -> Iterator[tuple[str, Loop]]:
    """The paper's rule, and others with the paper's gains."""
    paper = PID(ki=5000.0, low=0.0, high=90.0)
    yield PAPER, loop(fixed, sensors, PeakLatch(), paper)
    yield "robust latch, the paper's gains", loop(fixed, sensors, PeakRobust(arming=ranges.arming), paper)
    yield "fixed slip 0.2, the paper's gains", loop(fixed, sensors, FixedSlip(), paper)


def told_the_peak(fixed: Fixed, sensors: str, controller: Any, lanes: Lanes) -> tuple[Loop, Batch]:
    """Return the loop that knows every road, under the controller of another loop, and its lanes."""
    batch, (before, beyond) = lanes.batch(sensors), lanes.bound.peaks
    edges = np.asarray(lanes.family.values["plant.road.edges"])[:, 0]
    surfaces = {"reference.before": before, "reference.beyond": beyond, "reference.edge": edges}
    informed = loop(fixed, sensors, PeakAtPlace(), controller)
    return informed, dataclasses.replace(batch, values=dict(batch.values) | surfaces)
