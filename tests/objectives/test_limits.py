"""No part for any plant has a brake's limits; what a run at a limit, and one that never settles, say."""

import json
import math
from typing import Any, NamedTuple

import commands
import jax
import numpy as np
import pytest
from mutants import killed_by

import diffabs as d
from diffabs import actuators, controllers, objectives, references, stops
from diffabs.core.protocols import Memory, Tracking
from diffabs.core.pytree import param, pytree
from diffabs.parts.objectives import SettlingTime, at_limits
from diffabs.parts.plants import Car
from diffabs.scenario.tuning import numbers_at_bounds


class Position(NamedTuple):
    """[m]"""

    position: Any

    units = {"position": "m"}  # noqa: RUF012  # as every output has it


@pytree
class Spring:
    """Damper and spring, pulled: c x' = u - k x, x in m, u in N."""

    stiffness: Any = param(default=20e3, unit="N/m", above=0.0)
    damping: Any = param(default=1e3, unit="N s/m", above=0.0)
    shows, control_unit = Position, "N"

    def start(self, initial: Any) -> Position:
        return Position(0.0 * self.stiffness)

    def derivative(self, t: Any, state: Position, control: Any) -> Position:
        return Position((control - self.stiffness * state.position) / self.damping)

    def project(self, state: Position) -> Position:
        return state

    output = project

    def holding(self, output: Any, target: Any) -> Any:
        return self.stiffness * target


def pulled(controller, target=0.03, **more):
    reference = references.Setpoint(value=target)
    return d.Loop(plant=Spring(), initial=(), reference=reference, controller=controller, stop=stops.NoStop(), **more)


SOLVER = d.FixedStep(1e-3, 0.4)
WEAK = controllers.PID(kp=60e3)  # holds 60/80 of the target: x = 0.03 * 0.75 (1 - exp(-80 t))


def test_controllers_have_no_brake_limits_by_default():
    end = d.measure(pulled(WEAK), SOLVER, {"error": objectives.FinalError()}).metrics["error"]
    assert 0.03 - end == pytest.approx(0.0225, rel=1e-6)  # 90 N would give 0.0045 m
    far = Tracking(1.0, Position(0.0), 0.0)
    assert controllers.SlidingMode(gain=5e3).output(0.0, Memory(), far) == 5e3
    assert actuators.Limits().output(0.0, Memory(), 5e3) == 5e3
    assert d.braking().controller.high == 90.0
    assert d.braking().controller.low == 0.0


@pytest.mark.slow
def test_a_run_says_for_how_long_its_control_is_at_a_limit():
    """At 1,200 N from the start until 60e3 (0.03 - x) falls below it, x = 0.01: x = 0.06 (1 - exp(-20 t))."""
    pid = controllers.PID(kp=60e3, low=-1e6, high=1200.0)
    for loop in (pulled(pid), pulled(WEAK, actuator=actuators.Limits(high=1200.0))):
        share = d.measure(loop, d.FixedStep(1e-4, 0.4), {"share": at_limits(loop)}).metrics["share"]
        assert share == pytest.approx(-math.log(1 - 0.01 / 0.06) / 20 / 0.4, abs=5e-4)
    limits = at_limits(pulled(controllers.Sampled(controller=pid), actuator=actuators.Limits(low=-50.0)))
    assert (limits.low, limits.high) == (-50.0, 1200.0)
    assert at_limits(pulled(controllers.Relay())).high == np.inf  # levels, not limits


@killed_by("parts.objectives.tracking", "smaller(memory.held / jnp.where(t > 0, t, 1.0), 1.0)", "memory.held / t")
@pytest.mark.slow
def test_a_run_always_at_a_limit_is_valid():
    """In single precision the sum of 1,333 steps exceeds their end by 2e-5."""
    loop = d.replace(d.braking(), {"controller.high": 2.0, "controller.kp": 500.0})
    with jax.enable_x64(False):
        assert d.measure(loop, d.FixedStep(3e-3, 4.0), {"share": at_limits(loop)}).metrics["share"] == 1.0


@killed_by("parts.actuators.motor", "return -self.high, self.high", "return -1e9, 1e9")
def test_the_limits_are_those_of_the_command():
    """Of a motor's supply. A valve's command is a rate, which its limits do not bound."""
    limits = at_limits(pulled(WEAK, actuator=actuators.VoltageLimit(high=24.0)))
    assert (limits.low, limits.high) == (-24.0, 24.0)
    limits = at_limits(pulled(WEAK, actuator=actuators.IntegratingValve()))
    assert (limits.low, limits.high) == (-np.inf, np.inf)


def test_a_run_settles_within_a_share_of_its_step_or_never():
    """The weak controller stays 25 % below any target, however small: +-0.01 m called that settled early."""
    times = {"30 %": SettlingTime(share=0.3), "2 %": SettlingTime(), "10 mm": SettlingTime(band=0.01)}
    found = d.measure(pulled(WEAK), SOLVER, times)
    assert not found.diverged
    assert found.metrics["30 %"] == pytest.approx(-math.log(0.05 / 0.75) / 80, rel=1e-6)
    assert found.metrics["2 %"] == np.inf
    assert found.metrics["10 mm"] == pytest.approx(-math.log((0.01 - 0.0075) / 0.0225) / 80, rel=1e-6)
    assert d.measure(pulled(WEAK, target=0.0), SOLVER, times).metrics["2 %"] == 0.0  # stays on its target


@pytest.mark.slow
@pytest.mark.parametrize(("limit", "warned"), [(90.0, False), (5.0, True)])
def test_the_command_warns_of_a_run_at_a_limit(limit, warned):
    changes = ("--set", f"controller.high={limit}", "--set", "solver.step=1.5e-4")
    result = commands.run("simulate", "slip-estimator", "--json", *changes)
    document = json.loads(result.stdout)
    lines = [line for line in document["warnings"] if "at a limit (0 to 5 N m) for 100 % of the run" in line]
    assert bool(lines) is warned is (document["at_limit"] > 0.5)
    assert all(f"warning: {line}" in result.stderr for line in lines)


@pytest.mark.slow
def test_runs_that_never_settle_are_counted_in_a_sweep(tmp_path):
    changes = ("solver.step=1e-3", "controller.high=1.5", "controller.low=0")
    result = commands.run(
        *("sweep", "slip-lmi", "--samples", "16", "--out", tmp_path / "out", "--json", "--engine", "xla", "--figures"),
        *(word for change in changes for word in ("--set", change)),
    )
    document = json.loads(result.stdout)
    assert document["never"]["settling_time"]["count"] > 0
    assert set(document["never"]) == {"settling_time"}
    assert document["metrics"]["iae"]["mean"]["value"] > 0


def test_a_tuning_says_on_which_bounds_it_stands():
    free = {
        "controller.gain": {"after": [-9999.9, -40.0], "low": [-1e4, -60.0], "high": [-100.0, -20.0]},
        "reference.slip": {"after": 0.35, "low": 0.05, "high": 0.35},
        "controller.kp": {"after": 7.0, "low": 0.0, "high": math.inf},
    }
    assert list(numbers_at_bounds(free)) == ["controller.gain.0 (lower, -10000)", "reference.slip (upper, 0.35)"]


def test_a_control_without_a_channel_has_no_limits():
    """The steer angle of a car whose brakes have limits."""
    limits = at_limits(d.Loop(plant=Car(), **Car().usual_parts()))
    np.testing.assert_array_equal(limits.high, [2000.0] * 4 + [np.inf])
