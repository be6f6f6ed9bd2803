"""Steps that are too long for a loop are named where values are known, and unchecked ones where they are not."""

import logging
import re

import jax
import numpy as np
import pytest
from mutants import killed_by
from seams import replace_seam

import diffabs as d
from diffabs.objectives import StopDistance
from diffabs.simulate import admissible, arguments, ensemble

MEASURED = {"distance": StopDistance()}
LONG = d.FixedStep(0.5, 8.0)  # a run with it stops after 57.1 m, with a stable step after 43.7 m


def said(caplog):
    return [one.getMessage() for one in caplog.records]


@pytest.fixture
def fresh(caplog, monkeypatch):
    """Warnings as in a new process."""
    for one in (arguments._warn_unchecked_step, arguments._warn_unstable_step, ensemble._warn_refused):
        one.cache_clear()
    replace_seam(monkeypatch, "measured_step", admissible.find_unstable_step)
    monkeypatch.setattr(admissible, "_stable_steps", set())
    caplog.set_level(logging.WARNING, "diffabs")
    return caplog


@killed_by("simulate/arguments.py", "        _warn_unstable_step(line)", "        del line")
def test_an_unstable_step_is_named_once(fresh):
    for simulate in (lambda: d.measure(d.braking(), LONG, MEASURED), lambda: d.rollout(d.braking(), LONG)):
        simulate()
        (line,) = said(fresh)
        assert line.startswith("solver.step = 0.5 s is not stable: RK4 follows the fastest mode of this loop")
        assert re.search(r"only with steps in \(0, 0.0001\d*\] s", line)


@killed_by("simulate/arguments.py", "if not was_step_checked(loop, solver):", "if False:")
@killed_by("simulate/admissible.py", "        _stable_steps.add(", "        set().add(")
def test_a_traced_step_is_named_once_unless_it_was_checked(fresh):
    def distance(mass, step):
        loop = d.replace(d.braking(), {"plant.mass": mass})
        return d.measure(loop, d.FixedStep(step, 8.0), MEASURED).metrics["distance"]

    for _ in range(2):
        jax.eval_shape(lambda mass: distance(mass, 0.5), 14.0)
    (line,) = said(fresh)
    assert line.startswith("solver.step = 0.5 s is not checked for stability, because the loop is traced; d.check(")
    d.check(d.braking(), d.FixedStep(1e-4, 8.0))
    jax.eval_shape(lambda mass: distance(mass, 1e-4), 14.0)
    assert len(said(fresh)) == 1


@killed_by("simulate/ensemble.py", "np.count_nonzero(found.codes == code)", "0")
def test_a_batch_says_why_runs_are_refused(fresh):
    batch = d.Batch({"plant.mass": np.array([14.0, 15.0, -1.0])})
    run = d.run_batch(d.braking(), batch, LONG, MEASURED, engine="xla")
    assert run.diverged.tolist() == [True, True, True]
    assert np.isnan(run.metrics["distance"]).all()
    lines = said(fresh)
    assert any(one.startswith("2 of 3 runs are refused and count as diverged: solver.step = 0.5 s") for one in lines)
    assert any(one.startswith("1 of 3 runs are refused and count as diverged: plant.mass") for one in lines)
    d.run_batch(d.braking(), d.Batch(), LONG, MEASURED, engine="xla")
    assert said(fresh)[-1].startswith(
        "1 of 1 runs are refused and count as diverged: solver.step = 0.5 s is not stable:"
    )
