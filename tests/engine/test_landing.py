"""The moment of an event and its derivatives, against closed forms: on the grid; where the margin is bent, or flat."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from delays import H, Integrator, Proportional, Says, loop
from marks import cases
from mutants import killed_by
from signals import Mean, close

import diffabs as d
from diffabs.core.blocks import Direct
from diffabs.core.protocols import Memory, no_flow
from diffabs.core.pytree import param, pytree, replace
from diffabs.parts.controllers import Sampled
from diffabs.parts.stops import NoStop


@pytree
class Below(NoStop):
    """The slip has come down to a level."""

    level: float = param(default=0.1, unit="1")

    def margin(self, output):
        return output.slip - self.level


@pytree
class Bent(Below):
    """The same, by a margin that falls fifty times as fast before its zero as beyond."""

    def margin(self, output):
        excess = output.slip - self.level
        return jnp.where(excess > 0, 50.0 * excess, excess)


@pytree
class Slips:
    """From 2 to 5, where a margin that hardly falls goes through zero at last: a level less exp((t - end)/rise)."""

    level: float = param(default=1e-6, unit="1")
    end: float = param(default=8e-3, unit="s")
    rise: float = param(default=6e-5, unit="s")

    flow = no_flow

    def start(self, signal):
        return Memory(held=2.0 + 0.0 * signal.target)

    def output(self, t, memory, signal):
        return memory.held

    def margins(self, t, memory, signal, rate):
        return (jnp.where(memory.held < 3.0, self.level - jnp.exp((t - self.end) / self.rise), 1.0),)

    def event(self, t, memory, signal, fired):
        return Memory(held=jnp.where(fired[0], 5.0, memory.held))


@killed_by(
    "engine.step.event_location",
    "jnp.where(missed, RunStatus.SEEKING, RunStatus.REFINING if refines else RunStatus.LANDING)",
    "jnp.asarray(RunStatus.LANDING)",
)
@killed_by(
    "engine.step.event_location",
    "((distance > probe) | ((distance == 0) & (search.margin != 0)))",
    "(distance > probe)",
)
@killed_by(
    "engine.step.event_location",
    "missed & ~search.at_once & (search.tries < MAX_LOCATION_ATTEMPTS)",
    "missed & False",
)
@pytest.mark.parametrize(
    "solver", [d.FixedStep(H, 0.01, kinks=False), pytest.param(d.Adaptive(1e-5, 0.01, H), marks=pytest.mark.slow)]
)
def test_a_margin_that_falls_all_at_once_is_landed_on(solver):
    """Where it is still flat, a parabola through three tries may take it for near its zero, and its fall there leads
    hundreds of steps away."""

    @jax.jit
    def mean(level):
        there = loop(Slips(level=level), Direct())
        return d.measure(there, solver, {"mean": Mean()}).metrics["mean"][1]

    for level in np.geomspace(1e-7, 1e-5, 9):
        moment = 8e-3 + 6e-5 * np.log(level)
        close(mean(level) * 0.01, 2.0 * moment + 5.0 * (0.01 - moment), rtol=2e-5)


@killed_by("parts.controllers.sampled", "output, self._until(clock.t), jnp", "output, clock.t + self.delay, jnp")
@pytest.mark.parametrize("late", cases([2e-3, 4e-3, 2.3e-3, 5e-3], 2e-3, 4e-3, 5e-3))
@pytest.mark.parametrize(
    "solver", [pytest.param(d.FixedStep(H, 0.03), id="fixed"), pytest.param(d.Adaptive(1e-5, 0.03, H), id="adaptive")]
)
@pytest.mark.slow
def test_the_moment_of_an_event_on_the_grid_is_differentiable(late, solver):
    """A computer says the time, each 5 ms, and takes a while for it. Some of these moments are a rounding after the
    beginning of a step: an event at once has its derivatives as any other. Where it takes all the time that it may, a
    derivative is that of taking less."""

    def mean(late):
        sampled = Sampled(controller=Says(read=lambda t: 1.0 + 100.0 * t), period=5e-3, delay=late)
        return d.measure(loop(sampled, Direct()), solver, {"mean": Mean()}).metrics["mean"][1]

    levels = 1.0 + 100.0 * 5e-3 * np.arange(6)
    lengths = np.append(np.full(5, 5e-3), 5e-3 - late)
    value, slope = jax.value_and_grad(mean)(late)
    close(value * 0.03, levels @ lengths, rtol=1e-11)
    close(slope * 0.03, -levels[-1], rtol=1e-7)


@pytest.mark.slow
@pytest.mark.parametrize("derivative", [jax.jacfwd, jax.jacrev])
def test_derivatives_of_a_moment_are_those_at_the_zero(derivative):
    """x' = -k x comes down to a level, at steps of 0.4/k: against differences of the runs themselves. The last try
    ends up to a ten-thousandth of a step from there, in which a derivative that is taken at its end changes by 1e-5."""

    def moment(at):
        there = replace(loop(Proportional(k=at[0]), Direct(), Integrator(), 1.0), {"stop": Below(level=at[1])})
        return d.measure(there, d.FixedStep(10 * H, 0.1), {}).ending.sample.t

    for level in (0.61, 0.31, 0.13, 0.072):
        at = np.array([40.0, level])
        moves = 1e-4 * np.diag(at)
        expected = [(moment(at + move) - moment(at - move)) / 2e-4 for move in moves]
        close(derivative(moment)(at) * at, expected, rtol=2e-6)


@killed_by("engine.step.event_location", "jnp.where(old.margin > 0, -overshoot, overshoot)", "0.0")
@pytest.mark.parametrize("derivative", cases([jax.jacfwd, jax.jacrev], jax.jacfwd))
def test_a_margin_that_bends_at_its_zero_has_one_moment(derivative):
    """x' = -k x comes down to a level, at t = ln(1/level)/k. Rounding puts the end of a step on either side of the
    bend, and fifteen moments within a step lie on both."""

    def moment(k):
        there = replace(loop(Proportional(k=k), Direct(), Integrator(), 1.0), {"stop": Bent(level=0.3)})
        return d.measure(there, d.FixedStep(H, 0.1, kinks=False), {}).ending.sample.t

    k = np.linspace(20.0, 20.3, 15)
    slopes = jax.jit(jax.vmap(derivative(moment)))(k)
    close(slopes, np.log(0.3) / k**2, rtol=1e-8)
