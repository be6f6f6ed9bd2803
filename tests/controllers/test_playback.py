"""A recorded command is played entry by entry, and its last entry stays."""

import jax.numpy as jnp
import numpy as np
import pytest
from delays import loop
from mutants import killed_by
from signals import Mean

import diffabs as d
from diffabs.parts.actuators import Limits
from diffabs.parts.controllers import PlayedCommand


@killed_by("parts.controllers.playback", "jnp.minimum(played, commands.size - 1)", "played % commands.size")
def test_entries_in_turn_and_the_last_one_stays():
    controller = PlayedCommand(commands=np.array([1.0, 4.0, 2.0]), period=0.01)
    run = d.rollout(loop(controller, Limits()), d.FixedStep(2e-3, 0.05), {"mean": Mean()})
    np.testing.assert_allclose(run.metrics["mean"][1], (1.0 + 4.0 + 3 * 2.0) / 5, rtol=1e-6)
    np.testing.assert_array_equal(run.trajectory.sample.control[:13:3], jnp.array([1.0, 1.0, 4.0, 4.0, 2.0]))


def test_an_empty_record_is_refused():
    given = loop(PlayedCommand(commands=np.zeros(0)), Limits())
    for use in (d.check, lambda given: d.rollout(given, d.FixedStep(2e-3, 0.05))):
        with pytest.raises(ValueError, match=r"commands has shape \(0,\); it needs \(n,\), n at least 1"):
            use(given)
