"""The hydraulic brake against SciPy with the equations written out, and against the closed form of an orifice."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from delays import loop
from mutants import killed_by
from scipy.integrate import solve_ivp

import diffabs as d
from diffabs.core.blocks import Series
from diffabs.core.protocols import Memory
from diffabs.core.pytree import pytree, replace
from diffabs.parts.actuators import DeadTime, HydraulicBrake
from diffabs.parts.controllers import PlayedCommand

BRAKE = HydraulicBrake()
PERIOD = 0.05
COMMANDS = np.array([1.0, 0.3, 0.0, 1.0, -0.2, 0.0, -1.0, 0.4, 3.0, -0.1])
GAIN = 2 * 0.38 * 2.55e-3 * 0.11
SOLVER = d.FixedStep(5e-4, 0.5)


@pytree
class LastControl:
    """The control at the end of a run."""

    unit = "N m"

    def start(self, sample):
        return Memory(held=sample.control)

    def flow(self, memory, sample):
        return ()

    def update(self, memory, segment):
        return segment.end.control

    def value(self, memory, ending):
        return memory.held


def torque(actuator=BRAKE, commands=COMMANDS, length=0.5):
    """Return the brake torque [N m] at the end of the commands."""
    played = loop(PlayedCommand(commands=np.array(commands, float), period=PERIOD), actuator)
    run = d.measure(played, dataclasses.replace(SOLVER, duration=length), {"torque": LastControl()})
    return float(run.metrics["torque"])


def integrate(switches, **numbers):
    """Return the fluid that came in and that went out, at the ends of [(length, command), ...]."""
    values = {"p0": 1.5e7, "in_time": 0.2, "out_time": 0.07, **numbers}

    def rates(t, x, opening):
        pressed = max(x[0] - x[1] - 0.15, 0.0) / 0.85
        pressure = 1e7 * (0.4 * pressed + 0.6 * pressed**2)
        flows = [gap / (gap**2 + 1e8) ** 0.25 / 1e7**0.5 for gap in (values["p0"] - pressure, pressure)]
        return [max(opening, 0.0) * flows[0] / values["in_time"], max(-opening, 0.0) * flows[1] / values["out_time"]]

    x = np.zeros(2)
    for length, command in switches:
        opening = min(max(command, -1.0), 1.0)
        x = solve_ivp(rates, (0.0, length), x, args=(opening,), rtol=1e-10, atol=1e-12, max_step=1e-3).y[:, -1]
    return x


def pressed_torque(inside):
    pressed = max(inside - 0.15, 0.0) / 0.85
    return GAIN * max(1e7 * (0.4 * pressed + 0.6 * pressed**2) - 5e4, 0.0)


@killed_by("parts.actuators.hydraulics", "quotient(larger(-opening, 0.0), self.outlet_time)", "0.0")
@killed_by("parts.actuators.hydraulics", "clamp(signal, -1.0, 1.0)", "signal")
def test_a_run_agrees_with_scipy_and_no_fluid_is_lost():
    """The torque follows from the inflow minus the outflow: ten commands, one of them beyond a full opening."""
    inflow, outflow = integrate([(PERIOD, command) for command in COMMANDS])
    assert outflow > 0.3
    np.testing.assert_allclose(torque(), pressed_torque(inflow - outflow), rtol=1e-6)


@killed_by("parts.actuators.hydraulics", "difference**2", "1.1 * difference**2")
@pytest.mark.parametrize("time", [0.05, 0.15, 0.3])
def test_an_orifice_fills_a_linear_cylinder_in_a_parabola(time):
    """sqrt((p0 - p)/P) = sqrt(p0/P) - t/(2 T1) for p = P V/V_P without a clearance."""
    linear = replace(BRAKE, {"stiffening": 0.0, "dead_share": 0.0, "laminar_pressure": 10.0, "push_out_pressure": 0.0})
    missing = (np.sqrt(1.5) - time / (2 * 0.2)) ** 2
    found = torque(linear, np.ones(10), time)
    np.testing.assert_allclose(found, GAIN * (1.5e7 - 1e7 * missing), rtol=1e-6)


def test_the_pressure_stays_between_reservoir_and_supply():
    """It reaches the supply's from below, and a long dump leaves the clearance filled and no torque."""
    full = float(BRAKE.torque(BRAKE.supply_pressure))
    assert 0.9999 * full < torque(commands=np.ones(10), length=5.0) <= full
    emptied = [*np.ones(5), *-np.ones(5)]
    assert torque(commands=emptied, length=5.0) == 0.0
    rates = [float(BRAKE.flow(0.0, Memory(flow=0.15), command)) for command in (-1.0, 0.0)]
    assert rates == [0.0, 0.0]


def test_it_builds_100_bar_in_a_fifth_of_a_second_and_dumps_faster():
    hundred = float(BRAKE.torque(1e7))
    assert torque(commands=np.ones(10), length=0.15) < hundred < torque(commands=np.ones(10), length=0.25)
    up_and_down = [*np.ones(4), *-np.ones(6)]
    assert torque(commands=up_and_down, length=0.3) < 0.1 * hundred < torque(commands=up_and_down, length=0.25)


def test_a_dead_time_before_the_valves_shifts_the_commands():
    """A rise comes 30 ms later and a fall 10 ms; commands change at 0, 100 and 150 ms."""
    valves = Series(blocks=(DeadTime(rise=0.03, fall=0.01), BRAKE))
    commands = [1.0, 1.0, 0.0, -1.0, -1.0, 0.5, 0.5, 0.5, 0.5, 0.5]
    shifted = [(0.03, 0.0), (0.08, 1.0), (0.05, 0.0), (0.12, -1.0), (0.12, 0.5)]
    inflow, outflow = integrate(shifted)
    np.testing.assert_allclose(torque(valves, commands, 0.4), pressed_torque(inflow - outflow), rtol=1e-6)


PATHS = [f"actuator.{name}" for name in ("supply_pressure", "inlet_time", "outlet_time", "dead_share", "stiffening")]


@pytest.mark.slow
def test_derivatives_are_differences_of_three_widths():
    """Through every opening of the valves and the closing of the clearance; the errors are fourth powers."""
    played = loop(PlayedCommand(commands=COMMANDS, period=PERIOD), BRAKE)

    @jax.jit
    def pressed(log):
        values = {path: jnp.exp(x) * jnp.asarray(BRAKE_VALUES[path]) for path, x in zip(PATHS, log, strict=True)}
        run = d.measure(replace(played, values), d.FixedStep(5e-4, 0.5, kinks=True), {"torque": LastControl()})
        return run.metrics["torque"]

    derivative = jax.jacfwd(pressed)(jnp.zeros(len(PATHS)))
    for i in range(len(PATHS)):
        for width in (1e-2, 3e-3, 1e-3):
            far, near, after, beyond = (pressed(jnp.zeros(len(PATHS)).at[i].set(n * width)) for n in (-2, -1, 1, 2))
            np.testing.assert_allclose(derivative[i], (8 * (after - near) - (beyond - far)) / (12 * width), rtol=1e-5)


BRAKE_VALUES = {path: getattr(BRAKE, path.removeprefix("actuator.")) for path in PATHS}
