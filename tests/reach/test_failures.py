"""Why a cell is not proved is said, and a box that no budget helps is given up at once."""

import numpy as np
import pytest

from diffabs.robust.reach.cover import RunClaim, cover_box
from diffabs.robust.reach.engine import FAILURES, Prover
from diffabs.robust.reach.equations import derive_equations
from diffabs.scenario.scenario import load

pytestmark = pytest.mark.usefixtures("native_prover")


def test_a_slip_that_becomes_negative_is_named() -> None:
    """Air decelerates the car of [pedro] before its brake does, so its wheel first runs faster than the road."""
    loop = load("literature-pedro", integrated=False).loop
    proof = cover_box(loop, {"plant.mass": (435.0, 445.0)}, [RunClaim("greatest slip", 0.9)], horizon=1.0, budget=60)
    assert (proof.verdict, proof.tried, len(proof.cells)) == ("undecided", 0, 0)
    assert proof.failure == "even one run is not proved: the slip may become negative"


@pytest.mark.slow
def test_a_cell_that_is_too_wide_is_named() -> None:
    limits = ["controller.low=0", "controller.high=9.03"]
    prover = Prover(
        derive_equations(load("slip-lmi", limits, integrated=False).loop, ["plant.mass", "initial.speed"]),
        ("slip",),
        2.0,
    )
    prover.choose_weights(np.array([5.3, 13.5]))
    wide, single = (
        prover.prove(np.array([cell]), 1) for cell in ([[5.3, 5.4], [13.0, 13.5]], [[5.3, 5.3], [6.0, 6.0]])
    )
    assert (wide.status[0], FAILURES[wide.failure[0]]) == (0, "a set of states grows too wide")
    assert (single.status[0], single.failure[0]) == (1, 0)
