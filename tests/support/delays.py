"""A loop whose control is written down, an integrator for its plant, and a delay between."""

from collections.abc import Callable
from typing import Any

from signals import Script, seen

import diffabs as d
from diffabs.core.protocols import BrakeOutput, no_flow, no_memory
from diffabs.core.pytree import param, pytree, static
from diffabs.parts.references import FixedSlip
from diffabs.parts.stops import NoStop

H = 1e-3


@pytree
class Says:
    """A controller that says read(t)."""

    read: Callable = static()

    start = no_memory
    flow = no_flow

    def output(self, t, memory, signal):
        return self.read(t) + 0.0 * signal.target


@pytree
class Integrator:
    """x' = u, x(0) = initial, seen as the slip."""

    shows = BrakeOutput
    control_unit = "N m"

    def start(self, initial):
        return 1.0 * initial

    def derivative(self, t, state, control):
        return control + 0.0 * state

    def project(self, state):
        return state

    def output(self, state):
        return BrakeOutput(state, 1.0 + 0.0 * state, 0.0 * state, 0.0 * state, 0.0 * state)

    def holding(self, output, target):
        return 0.0 * target


@pytree
class Proportional:
    """u = -k x."""

    k: Any = param(default=1.0, unit="1")

    start = no_memory
    flow = no_flow

    def output(self, t, memory, signal):
        return -self.k * signal.measured.slip


STILL = Script(read=lambda t: seen(0.1 + 0.0 * t))  # one, as what is said below: loops of it are one program


def loop(controller, actuator, plant=STILL, initial=0.0):
    return d.Loop(
        plant=plant,
        initial=initial,
        stop=NoStop(),
        reference=FixedSlip(),
        controller=controller,
        actuator=actuator,
    )
