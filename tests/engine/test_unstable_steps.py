"""Steps that are too long for a loop are refused where values are known, and named where they are not."""

import logging

import jax
import numpy as np
import pytest
from decaying import decay_loop
from marks import cases
from mutants import killed_by
from seams import replace_seam

import diffabs as d
from diffabs.loop import admissible, arguments, ensemble
from diffabs.loop.faults import Fault
from diffabs.parts.objectives import IAE, StopDistance

MEASURED = {"distance": StopDistance()}
LONG = d.FixedStep(0.5, 8.0)  # a run with it stops after 57.1 m, with a stable step after 43.7 m


def said(caplog):
    return [one.getMessage() for one in caplog.records]


@pytest.fixture
def fresh(caplog, monkeypatch):
    """Warnings as in a new process."""
    for one in (arguments._warn_unchecked_step, ensemble._warn_refused):
        one.cache_clear()
    replace_seam(monkeypatch, "measured_step", admissible.find_unstable_step)
    monkeypatch.setattr(admissible, "_stable_steps", set())
    caplog.set_level(logging.WARNING, "diffabs")
    return caplog


@killed_by("loop.arguments", "lines or list(find_unstable_step(loop, solver))", "lines")
def test_an_unstable_step_is_refused(fresh):
    for simulate in (lambda: d.measure(d.braking(), LONG, MEASURED), lambda: d.rollout(d.braking(), LONG)):
        with pytest.raises(ValueError, match=r"^solver.step = 0.5 s is not stable: [^\n]* \(0, 0.0001\d*\] s$"):
            simulate()
    assert said(fresh) == []


@killed_by("loop.arguments", "if not was_step_checked(loop, solver):", "if False:")
@killed_by("loop.admissible", "        _stable_steps.add(", "        set().add(")
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


@killed_by("loop.ensemble", "np.count_nonzero(checks.codes == code)", "0")
@pytest.mark.slow
def test_a_batch_says_why_runs_are_refused(fresh):
    loop, measured = decay_loop(100.0), {"iae": IAE()}
    batch = d.Batch({"plant.rate": np.array([100.0, 101.0, -1.0])})
    run = d.run_batch(loop, batch, LONG, measured, engine="xla")
    assert run.diverged.tolist() == [True, True, True]
    assert np.isnan(run.metrics["iae"]).all()
    lines = said(fresh)
    assert any(one.startswith("2 of 3 runs are refused and count as diverged: solver.step = 0.5 s") for one in lines)
    assert any(one.startswith("1 of 3 runs are refused and count as diverged: plant.rate") for one in lines)
    d.run_batch(loop, d.Batch(), LONG, measured, engine="xla")
    assert said(fresh)[-1].startswith(
        "1 of 1 runs are refused and count as diverged: solver.step = 0.5 s is not stable:"
    )


@killed_by("loop.result", "RunStatus.REFUSED: Fault.REFUSED,", "")
@pytest.mark.parametrize("engine", cases(["xla", "kernel"], "xla"))
def test_a_run_says_why_it_diverged(engine):
    """Reference: what is done to each run, and for the second one that 0.5 s is far beyond the stable 0.19 ms."""

    def faults(loop, batch, solver, accepted=True):
        run = d.run_batch(loop, batch, solver, MEASURED, accepted=accepted, engine=engine)
        assert (np.asarray(run.fault) > 0).tolist() == run.diverged.tolist()
        return [Fault(code) for code in np.asarray(run.fault).tolist()], repr(run)

    masses = d.Batch({"plant.mass": np.array([14.0, np.nan, 15.0])})
    codes, text = faults(d.braking(), masses, LONG)
    assert codes[1] == Fault.NUMBER
    assert {codes[0], codes[2]} <= {Fault.AUDIT, Fault.METRIC, Fault.LANDING, Fault.NONE}
    assert f"1: {Fault.NUMBER.text}" in text
    codes, text = faults(d.braking(), masses, d.FixedStep(1e-4, 0.01), accepted=np.array([True, False, False]))
    assert codes == [Fault.NONE, Fault.REFUSED, Fault.REFUSED]
    assert f"2 diverged (2: {Fault.REFUSED.text})" in text
