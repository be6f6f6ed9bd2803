"""The open loop of a control loop as a function of the loop's parameters, for derivatives and batches.

It is the loop of `linear.open_loop`, whose matrices are JAX arrays here. Where there is no linear model its entries are
NaN: at a kink, and for a plant that does not come to rest.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from diffabs.core.types import Array, Scalar
from diffabs.linear.linearization import StateSpace
from diffabs.linear.opened_loop import OpenLoop, open_traced
from diffabs.linear.responses.grid import FrequencyGrid, place_frequencies
from diffabs.linear.responses.loop_margins import Margin, find_gain_crossovers, nearest_margin
from diffabs.linear.responses.response import TracedSystem, as_arrays, loop_from, respond_sensitivity
from diffabs.linear.transfer import WHOLE_PERIOD_TOLERANCE
from diffabs.linear.zero_order_hold import discretise_held_input
from diffabs.loop.closed_loop import Loop

DELAY_NEWTON_STEPS = 12
MAX_DELAY_RESIDUE = 1e-9  # |1 + L| at a delay margin


def open_transfer(loop: Loop, target: Scalar | None = None) -> TracedSystem:
    """Return the open loop L of a loop at rest on its setpoint, opened at the controls, differentiable.

    Parameters of the loop may be tracers. States that do not influence L have poles that do not matter.

    Args:
        loop: Loop to open.
        target: Setpoint in the unit of the first signal, as in `linear.open_loop`.

    Raises:
        ValueError: A block acts at instants and is not `Sampled`.

    See also:
        `linear.open_loop`: The same loop in NumPy, with an error wherever it has no linear model.

    Examples:
        How the peak of the sensitivity of a PI loop changes with its gain:

        >>> import jax
        >>> from diffabs.core.pytree import replace
        >>> from diffabs.linear.responses import open_transfer, sensitivity_peak
        >>> from diffabs.scenario import load
        >>> loop = load("slip-lmi").loop
        >>> def peak(factor):
        ...     gain = [factor * k for k in (-11753.0, -48.0)]
        ...     return sensitivity_peak(open_transfer(replace(loop, {"controller.gain": gain}))).value
        >>> slope = jax.grad(peak)(1.0)
    """
    return join_halves(open_traced(loop, target))


def join_halves(halves: OpenLoop, more: Scalar = 0.0) -> TracedSystem:
    """Return L of the halves of an open loop with `more` delay [s]; whole periods stay a pure delay."""
    plant, controller, period = as_arrays(halves.plant), as_arrays(halves.controller, 0), halves.controller.period
    delay = jnp.asarray(halves.delay + more, jnp.result_type(float))
    if period is not None:
        whole = jnp.floor(delay / period + WHOLE_PERIOD_TOLERANCE)
        rest = jnp.clip(delay - whole * period, 0.0, period)
        plant, delay = _sample(plant, period, rest), whole * period
    n, m = len(plant.A), len(controller.A)
    a = jnp.block([[plant.A, jnp.zeros((n, m))], [controller.B @ plant.C, controller.A]])
    b = jnp.concatenate([plant.B, jnp.zeros((m, plant.B.shape[1]))])
    c = -jnp.hstack([controller.D @ plant.C, controller.C])
    direct = jnp.zeros((len(c), b.shape[1]))
    return _detach_unobserved(TracedSystem(a, b, c, direct, period, delay))


def _sample(plant: TracedSystem, period: Scalar, delay: Scalar) -> TracedSystem:
    """Return the plant with a held input that changes `delay` after each instant; the old input is a state."""
    a, b = discretise_held_input(StateSpace(plant.A, plant.B), period, delay)
    return TracedSystem(
        jnp.asarray(a),
        jnp.asarray(b),
        jnp.pad(plant.C, ((0, 0), (0, plant.B.shape[1]))),
        plant.D,
        period,
        jnp.zeros(()),
    )


def _detach_unobserved(system: TracedSystem) -> TracedSystem:
    """Return the same L in which states that it does not contain are stable, and influence nothing."""
    linked, observed = system.A != 0, jnp.any(system.C != 0, axis=0)
    for _ in range(len(system.A)):
        observed = observed | jnp.any(linked & observed[:, None], axis=0)
    a = jnp.where(observed[:, None] & observed, system.A, 0.0)
    detached = 0.0 if system.period is not None else -(jnp.sqrt(jnp.sum(jax.lax.stop_gradient(a) ** 2)) + 1.0)
    a = a + jnp.diag(jnp.where(observed, 0.0, detached))
    return system._replace(A=a, B=jnp.where(observed[:, None], system.B, 0.0))


class _Place(NamedTuple):
    """A frequency [rad/s] and an added delay [s]."""

    w: Array
    delay: Array


def sampled_delay_margin(halves: OpenLoop) -> Margin:
    """Return the smallest added delay that makes a stable loop with a sampled controller unstable [s]; differentiable.

    The plant is sampled again with each delay: 1 + L(w, delay) = 0. Newton's method starts at each crossover with the
    delay that would turn L to -1. The result is NaN if it does not find a root there.

    Args:
        halves: Open loop of `open_traced` with a sampled controller and one control.
    """
    loop = join_halves(halves)
    return sampled_delay_margin_on(halves, loop, place_frequencies(loop))


def sampled_delay_margin_on(halves: OpenLoop, loop: TracedSystem, grid: FrequencyGrid) -> Margin:
    """Return the sampled delay margin of halves whose open loop and frequencies are known."""
    roots, angles, decided = find_gain_crossovers(loop, grid)

    def residual(place: _Place) -> Array:
        value = 1 + loop_from(respond_sensitivity(join_halves(halves, place.delay), place.w[None]))[0, 0, 0]
        return jnp.stack([value.real, value.imag])

    def newton(place: _Place) -> _Place:
        columns = jax.jacfwd(residual)(place)
        jacobian = jax.lax.stop_gradient(jnp.stack(columns, axis=1))
        (a, b), (c, d) = jacobian
        first, second = residual(place)
        determinant = a * d - b * c
        return _Place(
            place.w - (d * first - b * second) / determinant, place.delay - (a * second - c * first) / determinant
        )

    def refine(w: Array, delay: Array) -> tuple[_Place, Array]:
        start = jax.lax.stop_gradient(_Place(w, delay))
        place = jax.lax.fori_loop(0, DELAY_NEWTON_STEPS, lambda _, p: jax.lax.stop_gradient(newton(p)), start)
        return newton(jax.lax.stop_gradient(place)), jnp.max(jnp.abs(residual(jax.lax.stop_gradient(place))))

    guesses = jnp.where(roots.valid, jnp.mod(angles, 2 * jnp.pi) / roots.w, 0.0)
    places, residues = jax.vmap(refine)(roots.w, guesses)
    solved = jnp.where(roots.valid, (residues < MAX_DELAY_RESIDUE) & (places.delay > 0), True)
    return nearest_margin(places.delay, places.w, roots.valid, decided & jnp.all(solved))
