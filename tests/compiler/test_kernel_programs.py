"""The programs of a kernel, from the loop."""

import pytest
from mutants import killed_by

import diffabs as d
from diffabs import controllers, objectives
from diffabs.loop.kernel_programs import trace_kernel, tunable_numbers

LOOP = d.braking(controller=controllers.ConstantTorque(torque=5.0))
MEASURED = {"iae": objectives.IAE()}


@pytest.mark.usefixtures("any_step_is_stable")
@killed_by("loop.kernel_programs", '"eliminate": values.program(),', '"eliminate": derivative.program(),')
def test_the_programs_of_a_loop_are_counted_and_listed() -> None:
    programs = trace_kernel(LOOP, d.FixedStep(1e-3, 0.1), MEASURED, ["plant.mass"])
    counts = programs.counts()
    assert counts["eliminate"]["step"] < counts["lower"]["step"]
    assert counts["eliminate"]["step"] < counts["eliminate, with tangents"]["step"] < counts["jvp"]["step"]
    assert "d point.state.plant" not in programs.text("eliminate", tangents=False)
    assert "d point.state.plant" in programs.text("eliminate", tangents=True)


@killed_by("loop.kernel_programs", "spec.tunable and not np.ndim", "not np.ndim")
def test_tunable_numbers_are_single_numbers() -> None:
    loop = d.braking(controller=controllers.StateFeedback())
    numbers = tunable_numbers(loop)
    assert "plant.mass" in numbers
    assert "controller.gain" not in numbers
    sampled = tunable_numbers(d.braking(controller=controllers.Sampled(controller=controllers.PID())))
    assert "controller.controller.kp" in sampled
    assert "controller.period" not in sampled
