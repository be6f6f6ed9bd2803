"""Mistakes in a part of the user's own: one line with the part, the method and what is needed."""

import math
import re
from types import MappingProxyType
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
import pytest
from mutants import killed_by

import diffabs as d
from diffabs import objectives, references
from diffabs.core.protocols import Memory, no_flow, no_memory
from diffabs.core.pytree import param, pytree
from diffabs.loop.contracts import find_misfits


class Temperature(NamedTuple):
    above: Any
    units = MappingProxyType({"above": "K"})


class Bare(NamedTuple):
    above: Any


@pytree
class Oven:
    """C dT/dt = heat - k T."""

    capacity: Any = param(default=500.0, unit="J/K", above=0.0)
    loss: Any = param(default=2.0, unit="W/K", above=0.0)
    shows, control_unit = Temperature, "W"

    def start(self, initial):
        return Temperature(0.0 * self.loss)

    project = output = lambda self, x: x

    def derivative(self, t, x, heat):
        return Temperature((heat - self.loss * x.above) / self.capacity)

    def holding(self, output, target):
        return self.loss * target


@pytree
class Proportional:
    """u = k e, and a memory that neither ticks nor has events."""

    k: Any = param(default=40.0, unit="control/signal")
    start, flow = no_memory, no_flow

    def output(self, t, memory, signal):
        return self.k * (signal.target - signal.measured.above)


@pytree
class Cold:
    """Ends the run at 1000 K."""

    success = False

    def margin(self, output):
        return 1000.0 - output.above

    def remainder(self, sample, stopped):
        return (0.0, 0.0)


@pytree
class Highest:
    """Greatest temperature at a step's end."""

    unit = "K"

    def start(self, sample):
        return Memory((), 0.0 * sample.output.above)

    def flow(self, memory, sample):
        return ()

    def update(self, memory, segment):
        return jnp.maximum(memory.held, segment.end.output.above)

    def value(self, memory, ending):
        return memory.held


def with_methods(kind, **methods):
    """An instance of a class like `kind` with other methods."""
    return pytree(type(kind.__name__, (kind,), methods))()


def measure(name, objective=None, **others):
    """The metric of a run in which the part of this name is another one."""
    parts = {"plant": Oven(), "controller": Proportional(), "stop": Cold(), **others}
    loop = d.Loop(initial=(), reference=references.Setpoint(value=180.0), **parts)
    run = d.measure(loop, d.FixedStep(0.5, 50.0), {name: objective or Highest()})
    return float(run.metrics[name])


def switching(**methods):
    """A controller with a memory, an event that never comes, and other methods."""
    usual = {
        "start": lambda self, signal: Memory((), 0.0),
        "margins": lambda self, t, memory, signal, rate: (1e6 - signal.measured.above,),
        "event": lambda self, t, memory, signal, fired: memory,
    }
    return with_methods(Proportional, **usual | methods)


def numbers(value):
    """A method that returns this, whatever its arguments."""
    return lambda self, *given: value


def two_states(self, t, x, heat):
    """The derivative of another plant."""
    above, rate = x
    return Temperature(rate - above)


MISTAKES = {
    "plant": {
        "plant.start returns Temperature(above=int); real numbers are needed, of type float": {
            "start": numbers(Temperature(0))
        },
        "plant.project returns None; Temperature(above=float) is needed, like the state": {"project": numbers(None)},
        "plant.derivative returns (float,); Temperature(above=float) is needed, like the state": {
            "derivative": numbers((0.0,))
        },
        "plant.derivative returns Temperature(above=float[2]); Temperature(above=float) is needed, like the state": {
            "derivative": lambda self, t, x, heat: Temperature(jnp.stack([heat, x.above]))
        },
        "plant.output returns (float,); Temperature(...) is needed, as plant.shows says": {"output": numbers((0.0,))},
        "plant.shows: Bare.units lacks a unit of above": {"shows": Bare},
        "plant.shows = 'K' is no class of NamedTuple": {"shows": "K"},
        "plant.control_unit = None is no text, such as 'N m'": {"control_unit": None},
        "plant: Oven has no method output; diffabs.core.protocols lists what it needs": {"output": None},
        "plant.output needs a number's value, which JAX traces without; use jnp.where for if": {
            "output": lambda self, x: x if x.above > 0 else Temperature(0.0)
        },
        "plant.derivative needs a number's value, which JAX traces without; use": {
            "derivative": lambda self, t, x, heat: Temperature(math.sqrt(x.above))
        },
        "plant.project needs a number's value": {"project": lambda self, x: Temperature(np.maximum(x.above, 0.0))},
        "plant.derivative fails: ValueError: not enough values to unpack (expected 2, got 1) (test_contracts.py": {
            "derivative": two_states
        },
        "plant.derivative fails: TypeError: ": {"derivative": lambda self, x, heat: x},
        "plant.derivative fails: 'Oven' object has no attribute 'losses' (test_contracts.py, line ": {
            "derivative": lambda self, t, x, heat: Temperature(-self.losses * x.above)
        },
    },
    "controller": {
        "controller: proportional needs slip; there is only above: these parts do not fit together (test": {
            "output": lambda self, t, memory, signal: signal.measured.slip
        },
        "controller.output returns bool; one real number is needed, a float without axes": {"output": numbers(True)},
        "controller.output returns Memory(flow=(), held=()); one real number is needed": {"output": numbers(Memory())},
        "controller.start returns float; Memory(flow, held) is needed": {"start": numbers(0.0)},
        "controller.start, in held, returns str; numbers or arrays are needed": {"start": numbers(Memory((), "off"))},
        "controller.start, in flow, returns int; real numbers are needed": {"start": numbers(Memory(0))},
        "controller.flow returns (); float is needed, like memory.flow": {"start": numbers(Memory(0.0))},
        "controller.tick returns float; Memory(flow=(), held=()) is needed, like memory": {"tick": numbers(1.0)},
    },
    "stop": {
        "stop.margin returns bool; one real number is needed": {"margin": lambda self, output: output.above < 100},
        "stop: Cold has no method remainder": {"remainder": None},
        "stop.remainder returns float; (time left [s], distance left [m]) is needed": {"remainder": numbers(0.0)},
    },
}
KINDS = {"plant": Oven, "controller": Proportional, "stop": Cold}


@pytest.mark.parametrize(
    ("family", "line"),
    [pytest.param(family, line, id=f"{family}-{i}") for family in MISTAKES for i, line in enumerate(MISTAKES[family])],
)
@killed_by("loop.contracts", "    if not lines:", "    if True:")
@killed_by("loop.arguments", "    refuse_misfits(loop, objectives)\n", "")
def test_a_mistake_in_a_part_is_one_line(family, line):
    part = with_methods(KINDS[family], **MISTAKES[family][line])
    for _ in range(2):  # a structure with a mistake is not remembered as one that fits
        with pytest.raises(ValueError, match=f"^{re.escape(line)}[^\n]*$"):
            measure("highest", **{family: part})


EVENTS = {
    "controller.margins returns float; a tuple of real numbers is needed": {"margins": numbers(1.0)},
    "controller.margins returns bool; one real number is needed": {"margins": numbers((True,))},
    "controller.event returns None; Memory(flow=(), held=float) is needed, like memory": {"event": numbers(None)},
    "controller.tick returns Memory(flow=(), held=int); Memory(flow=(), held=float) is needed, like memory": {
        "tick": numbers(Memory((), 1))
    },
    "controller: Proportional has no method event": {"event": None},
}


@pytest.mark.parametrize("line", [pytest.param(line, id=str(i)) for i, line in enumerate(EVENTS)])
def test_a_mistake_in_an_event_is_one_line(line):
    with pytest.raises(ValueError, match=f"^{re.escape(line)}"):
        measure("highest", controller=switching(**EVENTS[line]))


OBJECTIVES = {
    "objectives.mine.start returns float; Memory(flow, held) is needed": {"start": numbers(0.0)},
    "objectives.mine.flow returns float; () is needed, like memory.flow": {"flow": numbers(1.0)},
    "objectives.mine.update returns None; float is needed, like memory.held": {"update": numbers(None)},
    "objectives.mine.value returns bool; real numbers are needed": {
        "value": lambda self, memory, ending: ending.stopped
    },
    "objectives.mine.value returns None; real numbers are needed": {"value": numbers(None)},
    "objectives.mine: highest needs slip; there is only above: these parts do not fit together": {
        "update": lambda self, memory, segment: segment.end.output.slip
    },
}


@pytest.mark.parametrize("line", [pytest.param(line, id=str(i)) for i, line in enumerate(OBJECTIVES)])
def test_a_mistake_in_an_objective_is_one_line(line):
    with pytest.raises(ValueError, match=f"^{re.escape(line)}"):
        measure("mine", objective=with_methods(Highest, **OBJECTIVES[line]))


@pytree
class Weighted(Proportional):
    """As many weights as the loop has signals."""

    weights: Any = param(default=(1.0, 1.0), unit="1", free=True)

    def output(self, t, memory, signal):
        return jnp.dot(self.weights, jnp.stack([signal.target, -signal.measured.above]))


@killed_by("loop.contracts", "structure = structure, *map(np.shape, leaves)", "structure = structure, ()")
def test_a_shape_that_does_not_fit_is_found_after_one_that_fits():
    parts = {"plant": Oven(), "initial": (), "reference": references.Setpoint(value=180.0), "stop": Cold()}
    fits, broken = (d.Loop(controller=Weighted(weights=np.ones(count)), **parts) for count in (2, 3))
    assert list(find_misfits(fits, {})) == []
    assert re.match(r"controller.output fails: TypeError: .*\(test_contracts.py", *find_misfits(broken, {}))


def test_objectives_without_names_are_refused():
    given, solver = [objectives.Overshoot()], d.FixedStep(1e-3, 1.0)
    for run in (
        lambda: d.measure(d.braking(), solver, given),
        lambda: d.rollout(d.braking(), solver, given),
        lambda: d.run_batch(d.braking(), d.Batch({"plant.mass": [12.0]}), solver, given),
    ):
        with pytest.raises(ValueError, match=r"objectives = \[.*\] is no mapping by name"):
            run()


def test_an_objective_that_is_a_class_is_refused():
    with pytest.raises(ValueError, match=r"objectives.o = Overshoot is a class; Overshoot\(...\) is needed"):
        d.measure(d.braking(), d.FixedStep(1e-3, 1.0), {"o": objectives.Overshoot})  # pyright: ignore


def test_a_batch_that_is_a_dictionary_is_refused():
    with pytest.raises(ValueError, match=r"batch = \{.*\} is no Batch; d.Batch\(values by path\) is needed"):
        d.run_batch(d.braking(), {"plant.mass": [12.0]}, d.FixedStep(1e-3, 1.0))  # pyright: ignore


@pytest.mark.slow
def test_a_tick_may_read_the_signal_before_it():
    tick = lambda self, clock, memory, signal: Memory((), clock.before.measured.above)  # noqa: E731
    assert measure("highest", controller=switching(tick=tick)) == measure("highest", controller=switching())


def test_a_loop_and_a_solver_of_another_type_are_refused():
    with pytest.raises(ValueError, match=r"loop = 'slip-lmi' is no Loop"):
        d.measure("slip-lmi", d.FixedStep(1e-3, 1.0), {})  # pyright: ignore
    with pytest.raises(ValueError, match=r"solver = 0.001 is no solver; d.FixedStep\(step=..., duration=...\)"):
        d.measure(d.braking(), 1e-3, {})  # pyright: ignore


def test_parts_without_mistakes_run():
    """A first-order lag: T(t) = T_end (1 - exp(-t/tau)) with T_end = k target/(k + loss), tau = C/(k + loss)."""
    settled, tau = 180.0 * 40.0 / 42.0, 500.0 / 42.0
    assert measure("highest") == pytest.approx(settled * (1 - math.exp(-50.0 / tau)), rel=1e-6)
    assert measure("highest", controller=switching()) == measure("highest")
