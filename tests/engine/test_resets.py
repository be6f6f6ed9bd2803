"""What the resets of events do to conditions: they leave them, or they set them, perhaps to zero."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from mutants import killed_by

import diffabs as d
from diffabs.engine.field import SolutionStatus

CROWDED, FINISHED, TERMINATED = SolutionStatus.CROWDED, SolutionStatus.FINISHED, SolutionStatus.TERMINATED
METHODS = pytest.mark.parametrize(
    ("solver", "engine"),
    [
        pytest.param(d.Adaptive(1e-8), "xla", id="adaptive"),
        pytest.param(d.FixedStep(1e-2), "xla", id="fixed", marks=pytest.mark.slow),
        pytest.param(d.Adaptive(1e-8), "kernel", id="adaptive, kernel", marks=pytest.mark.slow),
        pytest.param(d.FixedStep(1e-2), "kernel", id="fixed, kernel", marks=pytest.mark.slow),
    ],
)
ABOVE = jnp.array([0.0, 1e-16, 1e-14, 1e-12, 1e-10, 1e-9, 1e-8, 1e-7])  # how far above zero a reset sets a condition


def drain(t, y, args):
    """The first state falls at the rate 1. It has fallen through its level at 0.5, and the others rest."""
    return -jnp.eye(3)[0]


def solve(solver, engine, events, start=(1.0, 0.0, 0.0), above=ABOVE):
    def one(above):
        return d.solve(drain, jnp.array(start), 0.0, 3.0, above, solver=solver, events=events, engine=engine)

    return jax.jit(jax.vmap(one))(above)


LEVEL = d.Event(lambda t, y, above: y[0] - 0.5, lambda t, y, above: y.at[0].set(0.5 + above))


@pytest.mark.slow
@METHODS
@pytest.mark.parametrize("start", [1.0, 0.5], ids=["later", "at t0"])
@killed_by(
    "engine.field", "unmoved & ~(rise > 0), -small - after", "~(rise > 0), -small - after", case="later-adaptive"
)
@killed_by("engine.solve", "(status == SolutionStatus.DIVERGED) & (held.fault > 0)", "False", case="later-fixed")
def test_a_condition_that_its_reset_sets_near_zero_falls_again(solver, engine, start):
    """The state stays at 0.5: there are so many events that none of them is swallowed."""
    found = solve(solver, engine, [LEVEL], (start, 0.0, 0.0))
    assert set(found.status.tolist()) == {CROWDED}
    assert np.all(np.isnan(found.y))


@pytest.mark.slow
@METHODS
@killed_by(
    "engine.field", "zero & (happens | ~unmoved), new, old_lift", "zero & happens, new, old_lift", case="adaptive"
)
def test_a_condition_that_another_reset_sets_near_zero_falls(solver, engine):
    """A timer sets the state to 2 at 0.3. There the second event sets it to 5, of which 2.7 are left at 3; or it ends
    the run."""
    timer = d.Event(lambda t, y, above: 0.3 - t, lambda t, y, above: y.at[0].set(2.0 + above))
    refill = d.Event(lambda t, y, above: y[0] - 2.0, lambda t, y, above: y.at[0].set(5.0))
    for events in ([timer, refill], [refill, timer]):
        found = solve(solver, engine, events)
        np.testing.assert_allclose(found.y[:, 0], 2.3 + ABOVE, atol=1e-9)
        assert found.events.counts.tolist() == 8 * [[1, 1]]
    found = solve(solver, engine, [timer, d.Event(lambda t, y, above: y[0] - 2.0, terminal=True)])
    np.testing.assert_allclose(found.y[:, 0], 2.0, atol=1e-9)
    assert set(found.status.tolist()) == {TERMINATED}


@pytest.mark.slow
@METHODS
def test_a_condition_that_resets_leave_falls_once(solver, engine):
    """The reset counts, by a state of its own, or moves another one: the first state goes on, to -2 at 3."""
    for reset in (
        lambda t, y, above: y.at[1].add(1.0),
        lambda t, y, above: y @ jnp.diag(jnp.array([1.0, 3.0, -1.0])),
        None,
    ):
        found = solve(solver, engine, [d.Event(lambda t, y, above: y[0] - 0.5, reset)], above=ABOVE[:1])
        np.testing.assert_allclose(found.y[:, 0], -2.0, atol=1e-9)
        assert found.events.counts.tolist() == [[1]]


@pytest.mark.slow
@METHODS
def test_a_reset_that_goes_through_zero_step_by_step(solver, engine):
    """The first three resets set the state to its level, the fourth one to 1: four events at each of 0.5, 1.0, ... 2.5.

    Those at the end, at 3, do not happen."""

    def again(t, y, above):
        return y.at[0].set(jnp.where(y[1] < 3, 0.5 + above, 1.0)).at[1].set(jnp.where(y[1] < 3, y[1] + 1, 0.0))

    found = solve(solver, engine, [d.Event(lambda t, y, above: y[0] - 0.5, again)], above=ABOVE[:6])
    np.testing.assert_allclose(found.y[:, 0], 0.5, atol=1e-7)
    assert found.events.counts.tolist() == 6 * [[20]]
