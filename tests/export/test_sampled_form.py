"""The sampled form of a loop's controller."""

import pytest
from mutants import killed_by

import diffabs as d
from diffabs.output.export import sample_controller
from diffabs.parts.controllers import Sampled


@killed_by("output.export.sampling", "if isinstance(loop.controller, Sampled | SampledOnGrid):", "if False:")
def test_a_continuous_controller_is_sampled_once() -> None:
    loop = d.braking()
    sampled = sample_controller(loop, 2e-3)
    assert isinstance(sampled.controller, Sampled)
    assert (sampled.controller.controller, sampled.controller.period) == (loop.controller, 2e-3)
    assert sampled.plant is loop.plant
    with pytest.raises(ValueError, match="the controller is sampled"):
        sample_controller(sampled, 1e-3)


@killed_by("output.export.sampling", 'raise ValueError("; ".join(lines))', "pass")
def test_a_period_is_positive() -> None:
    with pytest.raises(ValueError, match=r"controller\.period = 0 is outside"):
        sample_controller(d.braking(), 0.0)
