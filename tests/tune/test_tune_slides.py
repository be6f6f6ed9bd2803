"""A tuning that comes to runs that slide ends beside them, and says so."""

import pytest
import sliding
from mutants import killed_by

import diffabs as d
from diffabs.loop.closed_loop import Loop
from diffabs.parts.controllers import PID
from diffabs.parts.objectives import IAE
from diffabs.parts.references import Setpoint
from diffabs.parts.stops import NoStop
from diffabs.tune import Reason, build_problem, tune

END = 3.0


@killed_by("tune.descent", "bool(evaluation.evaluation.slid > 0)", "False")
@pytest.mark.slow
def test_a_search_ends_beside_sliding_runs():
    """A block with speed 1 and dry friction F is at rest from t = 1/F on, so a run slides if F > 1/END.

    The distance, the integral of |speed|, falls with F, so the search comes there.
    """
    loop = Loop(
        plant=sliding.Block(Fc=0.2), initial=(), reference=Setpoint(value=0.0), controller=PID(kp=0.0), stop=NoStop()
    )
    problem = build_problem(
        loop,
        free={"plant.Fc": (0.1, 2.0)},
        objective={"distance": 1.0},
        measured={"distance": IAE()},
        solver=d.FixedStep(2e-3, END),
    )
    tuned = tune(problem)
    assert tuned.reason is Reason.SLIDE
    assert "slide along a switching surface" in str(tuned)
    assert 0.3 < tuned.part.plant.Fc <= 1 / END
