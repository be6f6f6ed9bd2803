"""The largest integration step that is stable for a loop.

RK4 is stable on a mode lambda while |R(h lambda)| <= 1, R(z) = 1 + z + z^2/2 + z^3/6 + z^4/24. A braking loop stiffens
as it slows down, its slip rate going with 1/v, so the loop is linearised where the plant says that it may be stiffest;
else at its start and at rest. Held memories do not move: a sampled controller is not judged here.

Of many lanes few need the eigenvalues of their matrices: rho(A) <= |(D^-1 A D)^k|^(1/k) for every diagonal D and k, and
with the D that balances the matrices of the first lane k = 1 is mostly enough, which costs less than the matrices.
"""

import dataclasses
from collections.abc import Callable
from functools import partial, reduce
from typing import Any

import jax
import jax.extend.core
import jax.flatten_util
import jax.numpy as jnp
import numpy as np

from diffabs.core.compiling import SAME_RESULT_OPTIONS, compile_once
from diffabs.core.loop import Loop
from diffabs.core.protocols import Memory, Reference
from diffabs.core.pytree import Scalar, canonical_dtypes, part, pytree, replace
from diffabs.core.tracing import split_batched

BOUND_SQUARINGS = 4  # k = 16: within 3 % of the radius for the loops of the papers
LANES_PER_CHUNK = 256  # lanes whose matrices stay in a processor's cache
MIN_ENTRYWISE_MATRICES = 1 << 17  # matrices of all lanes, from which on they are worked out number by number
BALANCING_ROUNDS = 30  # rounds
BOUND_SAFETY_FACTOR = 1.01  # what single precision may take away from a bound
RADII = np.linspace(1e-3, 3.5, 3500)  # the stability region of RK4 lies within 3.5 of the origin


def stable_step(loop: Loop) -> float:
    """Largest step [s] at which RK4 damps every damped mode of the loop, between its initial speed and its stop."""
    return float(_largest_stable_steps(np.asarray(_jacobian(canonical_dtypes(loop)))[None])[0])


def stable_steps(loops: Loop) -> np.ndarray:
    """The same for a batch of loops, whose leaves have a leading axis (n,); returns (n,)."""
    return _largest_stable_steps(np.asarray(_jacobians(loops)))


def _largest_stable_steps(matrices: np.ndarray) -> np.ndarray:
    """The largest stable step of each lane (n,) for its matrices (n, k, d, d)."""
    known = np.asarray(np.isfinite(matrices).all(axis=(-2, -1)))
    modes = np.linalg.eigvals(np.where(known[..., None, None], matrices, 0.0))
    damped = (modes.real < 0) & known[..., None]
    size = np.where(damped, np.abs(modes), 1.0)
    limits = np.where(damped, _radius(np.where(damped, modes, -1.0) / size) / size, np.inf)
    return limits.min(axis=tuple(range(1, limits.ndim)), initial=np.inf)


def is_step_stable(loop: Any, values: Any, step: float) -> np.ndarray:
    """Whether a step [s] is stable for each lane of a loop that differ in these values (lanes,) by path; without a loop
    (None) the values are loops, whose leaves have a leading axis. Returns bool (lanes,)."""
    with jax.enable_x64(False), np.errstate(over="ignore"):  # what single precision cannot hold is infinite
        fine = step * np.asarray(_bounds(*_as_single_precision(loop, values), squarings=0)) <= MIN_BOUNDARY_RADIUS
        for squarings in (BOUND_SQUARINGS, None):
            left = np.flatnonzero(~fine)
            for lanes in np.split(left, range(LANES_PER_CHUNK, len(left), LANES_PER_CHUNK)) if len(left) else ():
                fine[lanes] = _is_known_stable(loop, _at(values, np.resize(lanes, LANES_PER_CHUNK)), step, squarings)[
                    : len(lanes)
                ]
    return fine


def _as_single_precision(*trees: Any) -> Any:
    """In single precision already here: several threads at once do not agree on what `enable_x64` makes of an array."""
    return jax.tree.map(lambda x: np.asarray(x, np.float32), trees)


def _at(values: Any, lanes: np.ndarray) -> Any:
    return jax.tree.map(lambda x: np.asarray(x)[lanes], values)


def _is_known_stable(loop: Any, values: Any, step: float, squarings: int | None) -> np.ndarray:
    """Whether the step is known to be stable; by the eigenvalues themselves if not by so many squarings."""
    if squarings is not None:
        return (
            step * np.asarray(_bounds(*_as_single_precision(loop, values), squarings=squarings)) <= MIN_BOUNDARY_RADIUS
        )
    with jax.enable_x64(True):
        return stable_steps(_build_loops(loop, values)) >= step


@jax.jit
def _build_loops(loop: Any, values: Any) -> Loop:
    return canonical_dtypes(jax.vmap(_lane(loop))(values))


def _lane(loop: Any) -> Callable[[Any], Loop]:
    return lambda values: canonical_dtypes(values if loop is None else replace(loop, values))


@partial(jax.jit, static_argnames="squarings")
def _bounds(loop: Any, values: Any, *, squarings: int) -> jax.Array:
    """What the modes of every lane are not faster than [1/s] (lanes,); infinite where that is not known."""
    count = len(jax.tree.leaves(values)[0])

    def matrices(values: Any) -> jax.Array:
        return jnp.reshape(found := _jacobians_of(_lane(loop)(values)), (-1, *found.shape[-2:]))

    one = matrices(jax.tree.map(lambda x: x[0], values))
    balance = _balance(one)
    if not split_batched(matrices, values)[0]:  # no lane has other matrices than the first
        return jnp.full(count, _power_norm_bound(one, balance, squarings))
    places = jnp.minimum(
        jnp.arange(-(-count // LANES_PER_CHUNK) * LANES_PER_CHUNK), count - 1
    )  # whole batches: one program
    filled = jax.tree.map(lambda x: x[places], values) if count > LANES_PER_CHUNK else values

    def bound(values: Any) -> jax.Array:
        if squarings or len(one) * count < MIN_ENTRYWISE_MATRICES:
            return _power_norm_bound(matrices(values), balance, squarings)
        return _norm(_map_over_probes(_entries, _lane(loop)(values)), balance)

    return jax.lax.map(bound, filled, batch_size=min(LANES_PER_CHUNK, count))[:count]


def _power_norm_bound(matrices: jax.Array, balance: jax.Array, squarings: int) -> jax.Array:
    """The greatest bound of some matrices (k, n, n) with their D (k, n); the norm is that of rows, or of columns."""
    a = matrices * (balance[:, None, :] / balance[:, :, None])
    log = jnp.zeros(len(a), a.dtype)  # of what has been divided out, to the power of one over k
    for i in range(squarings):
        size = jnp.maximum(jnp.max(jnp.abs(a), axis=(-2, -1)), 1e-30)  # else powers would leave single precision
        a, log = a / size[:, None, None], log + jnp.log(size) / 2**i
        a = jnp.matmul(a, a, precision="highest")
    rows, columns = (jnp.max(jnp.sum(jnp.abs(a), axis), -1) for axis in (-1, -2))
    bound = jnp.max(jnp.exp(log) * jnp.minimum(rows, columns) ** (1 / 2**squarings))
    return jnp.where(jnp.isfinite(bound), BOUND_SAFETY_FACTOR * bound, jnp.inf)


def _norm(entries: list[list[jax.Array]], balance: jax.Array) -> jax.Array:
    """The same without squarings, of n rows of n numbers (k,): for sums over so few XLA on a CPU calls a library, and
    stores all matrices for it."""
    sizes = [[jnp.abs(x * (balance[:, j] / balance[:, i])) for j, x in enumerate(row)] for i, row in enumerate(entries)]
    rows, columns = (reduce(jnp.maximum, map(sum, lines)) for lines in (sizes, zip(*sizes, strict=True)))
    bound = jnp.max(jnp.minimum(rows, columns))
    return jnp.where(jnp.isfinite(bound), BOUND_SAFETY_FACTOR * bound, jnp.inf)


def _balance(matrices: jax.Array) -> jax.Array:
    """D (k, n) for which rows and columns of D^-1 A D are about as large. E. E. Osborne, J. ACM 7 (1960), all at once
    and by half."""
    size = jnp.abs(matrices) * (1 - jnp.eye(matrices.shape[-1]))

    def halve(_: Any, log: jax.Array) -> jax.Array:
        scaled = size * jnp.exp(log[:, None, :] - log[:, :, None])
        rows, columns = jnp.sum(scaled, -1), jnp.sum(scaled, -2)
        fine = (rows > 0) & (columns > 0) & jnp.isfinite(rows / columns)
        change = 0.25 * jnp.log(jnp.where(fine, rows, 1.0) / jnp.where(fine, columns, 1.0))
        return jnp.clip(log + change, -30.0, 30.0)

    return jnp.exp(jax.lax.fori_loop(0, BALANCING_ROUNDS, halve, jnp.zeros(matrices.shape[:-1], matrices.dtype)))


def _radius(direction: np.ndarray) -> np.ndarray:
    """How far along each direction of the complex plane RK4 stays stable."""
    angles = np.abs(np.angle(direction))  # the region is symmetric
    return np.interp(angles, BOUNDARY_ANGLES, BOUNDARY_RADII)


def _find_boundary_radii(angle: np.ndarray) -> np.ndarray:
    """The first of RADII along each direction at which RK4 grows, or the last one: by bisection, since the region is
    star-shaped and a table of all of them would cost every command half a second."""
    low, high = np.zeros(angle.shape, int), np.full(angle.shape, len(RADII) - 1)
    for _ in range(len(RADII).bit_length()):
        middle = (low + high) // 2
        z = RADII[middle] * np.exp(1j * angle)
        grows = np.abs(1 + z * (1 + z / 2 * (1 + z / 3 * (1 + z / 4)))) > 1 + 1e-9
        low, high = np.where(grows, low, np.minimum(middle + 1, high)), np.where(grows, middle, high)
    return RADII[high]


BOUNDARY_ANGLES = np.linspace(np.pi / 2, np.pi, 2001)
BOUNDARY_RADII = _find_boundary_radii(BOUNDARY_ANGLES)
MIN_BOUNDARY_RADIUS = float(BOUNDARY_RADII.min())  # a damped mode of whatever direction is stable up to here


def _jacobians_of(loop: Loop) -> jax.Array:
    """d(flow)/d(flow) (k, n, n) where `_map_over_probes` looks."""
    return _map_over_probes(_flow_jacobian, loop)


def _map_over_probes(function: Callable[[Loop], Any], loop: Loop) -> Any:
    """What a function says of the loop (k, ...) where the plant says that it may be stiffest (`probes`); else at its
    start and at a start of zero, far from the target and on it."""
    probes = getattr(loop.plant, "probes", None)
    if probes:
        starts = probes(loop.initial, loop.reference.setpoint(loop.start().reference), loop.stop)
        return jax.vmap(lambda start: function(dataclasses.replace(loop, initial=start)))(starts)
    starts = jax.tree.map(lambda x: jnp.array([0.0, 1.0]) * x, loop.initial)
    arrived = dataclasses.replace(loop, reference=_AtTarget(reference=loop.reference))
    found = [
        jax.vmap(lambda start, one=one: function(dataclasses.replace(one, initial=start)))(starts)
        for one in (loop, arrived)
    ]
    return jax.tree.map(lambda *x: jnp.concatenate(x), *found)


_jacobian = compile_once(options=SAME_RESULT_OPTIONS)(_jacobians_of)


@compile_once(options=SAME_RESULT_OPTIONS)
def _jacobians(loops: Loop) -> jax.Array:
    return jax.vmap(_jacobians_of)(loops)


@pytree
class _AtTarget:
    """A reference whose target is wherever the plant is: the controller is not at a limit there."""

    reference: Reference = part()

    def start(self, signal: Any) -> Memory:
        return self.reference.start(signal)

    def flow(self, t: Scalar, memory: Memory, signal: Any) -> Any:
        return self.reference.flow(t, memory, signal)

    def output(self, t: Scalar, memory: Memory, signal: Any) -> Scalar:
        del t, memory
        return jax.lax.stop_gradient(signal[0])

    def setpoint(self, memory: Memory) -> Scalar:
        return self.reference.setpoint(memory)


def _flow_jacobian(loop: Loop) -> jax.Array:
    state = loop.start()
    z, unravel = jax.flatten_util.ravel_pytree(state.flow())

    def flow(z: jax.Array) -> jax.Array:
        at = state.with_flow(unravel(z))
        return jax.flatten_util.ravel_pytree(loop.flow(0.0, at, loop.signals(0.0, at)))[0]

    return jax.jacfwd(jax.extend.core.jaxpr_as_fun(jax.make_jaxpr(flow)(z)))(z)[0]  # half the time of tracing `flow`


def _entries(loop: Loop) -> list[list[jax.Array]]:
    """The same number by number, n rows of n: compiles longer, and runs faster for many lanes."""
    state = loop.start()
    leaves, tree = jax.tree.flatten(state.flow())

    def flow(*z: jax.Array) -> list[jax.Array]:
        at = state.with_flow(tree.unflatten(z))
        return jax.tree.leaves(loop.flow(0.0, at, loop.signals(0.0, at)))

    once = jax.extend.core.jaxpr_as_fun(jax.make_jaxpr(flow)(*leaves))
    columns = []
    for number, leaf in enumerate(leaves):
        moved = partial(lambda number, one: once(*leaves[:number], one, *leaves[number + 1 :]), number)
        for at in np.ndindex(leaf.shape):
            rates = jax.jvp(moved, (leaf,), (jnp.zeros_like(leaf).at[at].set(1.0),))[1]
            columns.append([rate[i] for rate in rates for i in np.ndindex(rate.shape)])
    return [list(row) for row in zip(*columns, strict=True)]
