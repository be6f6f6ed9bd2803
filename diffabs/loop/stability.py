"""The largest stable integration step of a loop.

RK4 is stable on a mode lambda while |R(h lambda)| <= 1, R(z) = 1 + z + z^2/2 + z^3/6 + z^4/24. A braking loop stiffens
as it slows down, because its slip rate is proportional to 1/v. So the loop is linearised where the plant says that it
may be stiffest, or else at its start and at rest. Held memories are constant in the linearisation: it does not judge a
sampled controller.

Few runs of a batch need the eigenvalues of their matrices, because rho(A) <= |(D^-1 A D)^k|^(1/k) for every diagonal D
and every k. With the D that balances the matrices of the first run, k = 1 is mostly enough. This costs less than the
matrices themselves. The size of the program does not depend on the number of runs.
"""

import dataclasses
from collections.abc import Callable
from functools import partial, reduce

import jax
import jax.extend.core
import jax.flatten_util
import jax.numpy as jnp
import numpy as np

from diffabs.core.channels import outputs_like
from diffabs.core.compiling import QUICK_COMPILE_OPTIONS, compile_once
from diffabs.core.protocols import Memory, Reference
from diffabs.core.pytree import canonical_dtypes, part, pytree, replace
from diffabs.core.tracing import used_inputs
from diffabs.core.types import Part, PyTree, Scalar
from diffabs.loop.closed_loop import Loop

BOUND_SQUARINGS = 4  # k = 16: within 3 % of the spectral radius for the loops of the papers
LANES_PER_CHUNK = 256  # at most
ENTRIES_PER_CHUNK = 1 << 19  # about; so many of all matrices of a chunk stay in a processor's cache
MIN_ENTRYWISE_MATRICES = 1 << 17  # number of matrices of all runs from which on they are computed entry by entry
MAX_ENTRYWISE_STATES = 12  # entry by entry, the program of a car (23 states) compiles for minutes
BALANCING_ROUNDS = 30
BOUND_SAFETY_FACTOR = 1.01  # covers the rounding of a bound in single precision
RADII = np.linspace(1e-3, 3.5, 3500)  # the stability region of RK4 lies within 3.5 of the origin


def stable_step(loop: Loop) -> float:
    """Return the largest step [s] at which RK4 is stable on every damped mode of the linearised loop.

    A linearisation that is not finite has no influence. Without any damped mode the result is infinite.
    """
    return float(stable_steps(jax.tree.map(lambda x: np.asarray(x)[None], canonical_dtypes(loop)))[0])


def stable_steps(loops: Loop) -> np.ndarray:
    """Return the result of `stable_step` for each loop of a batch with leaves (n, ...), shape (n,) [s]."""
    drain = np.asarray(_drain_rate(loops), float)
    limits = BOUNDARY_RADII[-1] / np.where(drain > 0, drain, np.nan)
    return np.fmin(_largest_stable_steps(np.asarray(_jacobians(loops))), limits)


def _largest_stable_steps(matrices: np.ndarray) -> np.ndarray:
    """Return the largest stable step of each run, shape (n,), for matrices of shape (n, k, d, d)."""
    finite = np.asarray(np.isfinite(matrices).all(axis=(-2, -1)))
    modes = np.linalg.eigvals(np.where(finite[..., None, None], matrices, 0.0))
    damped = (modes.real < 0) & finite[..., None]
    size = np.where(damped, np.abs(modes), 1.0)
    limits = np.where(damped, _radius(np.where(damped, modes, -1.0) / size) / size, np.inf)
    return limits.min(axis=tuple(range(1, limits.ndim)), initial=np.inf)


def is_step_stable(loop: object, values: object, step: float) -> np.ndarray:
    """Return True for each run for which the step [s] is stable, bool, shape (runs,).

    Without a common loop, `values` is a batch of loops whose leaves have a leading axis.
    """
    # Cheap bounds first, in single precision, where an overflow becomes infinite. Only runs without a proof go on to
    # tighter bounds and at last to eigenvalues.
    with jax.enable_x64(False), np.errstate(over="ignore"):
        stable = step * np.asarray(_bounds(*_as_single_precision(loop, values), squarings=0)) <= MIN_BOUNDARY_RADIUS
        for squarings in (BOUND_SQUARINGS, None):
            runs = np.flatnonzero(~stable)
            for lanes in np.split(runs, range(LANES_PER_CHUNK, len(runs), LANES_PER_CHUNK)) if len(runs) else ():
                stable[lanes] = _is_known_stable(loop, _at(values, np.resize(lanes, LANES_PER_CHUNK)), step, squarings)[
                    : len(lanes)
                ]
    return stable


def _as_single_precision(*trees: PyTree) -> PyTree:
    # NumPy arrays, because `enable_x64` is not consistent for JAX arrays made by several threads at once.
    return jax.tree.map(lambda x: np.asarray(x, np.float32), trees)


def _at(values: object, lanes: np.ndarray) -> PyTree:
    return jax.tree.map(lambda x: np.asarray(x)[lanes], values)


def _is_known_stable(loop: object, values: object, step: float, squarings: int | None) -> np.ndarray:
    """Return True for each run whose step is known to be stable. The proof is a bound with so many squarings; with None
    the eigenvalues.
    """
    if squarings is not None:
        return (
            step * np.asarray(_bounds(*_as_single_precision(loop, values), squarings=squarings)) <= MIN_BOUNDARY_RADIUS
        )
    with jax.enable_x64(True):
        return stable_steps(_build_loops(loop, values)) >= step


@jax.jit
def _build_loops(loop: object, values: object) -> Loop:
    return canonical_dtypes(jax.vmap(_lane_builder(loop))(values))


def _lane_builder(loop: Part) -> Callable[[PyTree], Loop]:
    """Return the function from the values of one run to its loop; without a common loop the values are the loop."""
    return lambda values: canonical_dtypes(values if loop is None else replace(loop, values))


@partial(jax.jit, static_argnames="squarings")
def _bounds(loop: object, values: object, *, squarings: int) -> jax.Array:
    """Return an upper bound on |lambda| of all modes for each run [1/s], shape (runs,); infinite if unknown."""
    build = _lane_builder(loop)
    drain = jax.vmap(lambda values: _drain_rate(build(values)))(values)
    first = jax.tree.map(lambda x: x[0], values)
    program = jax.make_jaxpr(lambda values: _jacobians_of(build(values)))(first)
    (shape,) = program.out_avals
    if not any(used_inputs(program.jaxpr)):  # the matrices of all runs are equal
        values = jax.tree.map(lambda x: x[:1], values)
    count = len(jax.tree.leaves(values)[0])
    number, states, _ = shape.shape
    entrywise = not squarings and states <= MAX_ENTRYWISE_STATES and number * count >= MIN_ENTRYWISE_MATRICES

    def bound(balance: jax.Array, values: object) -> tuple[jax.Array, jax.Array]:
        """Return the balance, and a bound for each run of a chunk."""
        if entrywise:
            matrices = jax.vmap(lambda values: _map_over_probes(_entries, build(values)))(values)
            bounds = jax.vmap(_norm_bound, (0, None))
        else:
            matrices = jax.vmap(jax.extend.core.jaxpr_as_fun(program))(*jax.tree.leaves(values))[0]
            bounds = jax.vmap(partial(_power_norm_bound, squarings=squarings), (0, None))

        def balance_first_run() -> jax.Array:
            first = jax.tree.map(lambda x: x[0], matrices)
            return _balance(jnp.moveaxis(jnp.array(first), -1, 0) if entrywise else first)

        # The first chunk sets the balance: to compute it before would put all matrices into the program twice.
        balance = jax.lax.cond(balance[0, 0] > 0, lambda: balance, balance_first_run)
        return balance, bounds(matrices, balance)

    lanes = LANES_PER_CHUNK if entrywise else min(LANES_PER_CHUNK, -(-ENTRIES_PER_CHUNK // shape.size))
    chunks = -(-count // (lanes := min(lanes, count)))
    # Whole chunks: a partial chunk would need a second program.
    places = jnp.minimum(jnp.arange(chunks * lanes), count - 1).reshape(chunks, lanes)
    unset = jnp.zeros(shape.shape[:-1], shape.dtype)
    rates = jax.lax.scan(bound, unset, jax.tree.map(lambda x: x[places], values))[1].reshape(-1)[:count]
    return jnp.maximum(rates, drain)


def _power_norm_bound(matrices: jax.Array, balance: jax.Array, squarings: int) -> jax.Array:
    """Return an upper bound on |lambda| of all eigenvalues of k matrices A (k, n, n), a scalar; infinite if unknown.

    The bound of a matrix is |(D^-1 A D)^p|^(1/p) with p = 2^`squarings`, in the smaller of row-sum and column-sum norm.
    `balance` holds the diagonals of D, shape (k, n).
    """
    a = matrices * (balance[:, None, :] / balance[:, :, None])
    log = jnp.zeros(len(a), a.dtype)  # logarithm of the k-th root of the scales that have been divided out
    for i in range(squarings):
        # Powers without scaling would overflow single precision.
        size = jnp.maximum(jnp.max(jnp.abs(a), axis=(-2, -1)), 1e-30)
        a, log = a / size[:, None, None], log + jnp.log(size) / 2**i
        a = jnp.matmul(a, a, precision="highest")
    rows, columns = (jnp.max(jnp.sum(jnp.abs(a), axis), -1) for axis in (-1, -2))
    bound = jnp.max(jnp.exp(log) * jnp.minimum(rows, columns) ** (1 / 2**squarings))
    return jnp.where(jnp.isfinite(bound), BOUND_SAFETY_FACTOR * bound, jnp.inf)


def _drain_rate(loop: Loop) -> Scalar:
    """Return the rate 1/Tt [1/s] at which an anti-windup drains the excess over a limit; 0 without one.

    The points of a linearisation may all lie within the limits.
    """
    tracking_time = getattr(getattr(loop.controller, "antiwindup", None), "tracking_time", None)
    return 0.0 if tracking_time is None else 1.0 / tracking_time


def _norm_bound(entries: list[list[jax.Array]], balance: jax.Array) -> jax.Array:
    """Return the result of `_power_norm_bound` without squarings, for matrices as n rows of n entries of shape (k,)."""
    # Scalars: for such small sums XLA on a CPU calls a library, and stores all matrices for it.
    sizes = [[jnp.abs(x * (balance[:, j] / balance[:, i])) for j, x in enumerate(row)] for i, row in enumerate(entries)]
    rows, columns = (reduce(jnp.maximum, map(sum, lines)) for lines in (sizes, zip(*sizes, strict=True)))
    bound = jnp.max(jnp.minimum(rows, columns))
    return jnp.where(jnp.isfinite(bound), BOUND_SAFETY_FACTOR * bound, jnp.inf)


def _balance(matrices: jax.Array) -> jax.Array:
    """Return D, shape (k, n), for which rows and columns of D^-1 A D are about as large.

    The method updates all entries at once and by half of Osborne's step.

    Source: E. E. Osborne, J. ACM 7 (1960).
    """
    size = jnp.abs(matrices) * (1 - jnp.eye(matrices.shape[-1]))

    def halve(_: object, log: jax.Array) -> jax.Array:
        scaled = size * jnp.exp(log[:, None, :] - log[:, :, None])
        rows, columns = jnp.sum(scaled, -1), jnp.sum(scaled, -2)
        regular = (rows > 0) & (columns > 0) & jnp.isfinite(rows / columns)
        change = 0.25 * jnp.log(jnp.where(regular, rows, 1.0) / jnp.where(regular, columns, 1.0))
        return jnp.clip(log + change, -30.0, 30.0)

    return jnp.exp(jax.lax.fori_loop(0, BALANCING_ROUNDS, halve, jnp.zeros(matrices.shape[:-1], matrices.dtype)))


def _radius(direction: np.ndarray) -> np.ndarray:
    """Return the greatest stable |h lambda| of RK4 along each direction, with the shape of `direction`.

    A direction is lambda/|lambda|, a complex number in the left half-plane.
    """
    angles = np.abs(np.angle(direction))  # the region is symmetric
    return np.interp(angles, BOUNDARY_ANGLES, BOUNDARY_RADII)


def _find_boundary_radii(angle: np.ndarray) -> np.ndarray:
    """Return the first of `RADII` at which RK4 grows, or the last one, along each direction of this `angle` [rad]."""
    # Bisection, because the region is star-shaped: a table of all radii would cost every command half a second.
    low, high = np.zeros(angle.shape, int), np.full(angle.shape, len(RADII) - 1)
    for _ in range(len(RADII).bit_length()):
        middle = (low + high) // 2
        z = RADII[middle] * np.exp(1j * angle)
        grows = np.abs(1 + z * (1 + z / 2 * (1 + z / 3 * (1 + z / 4)))) > 1 + 1e-9
        low, high = np.where(grows, low, np.minimum(middle + 1, high)), np.where(grows, middle, high)
    return RADII[high]


BOUNDARY_ANGLES = np.linspace(np.pi / 2, np.pi, 2001)
BOUNDARY_RADII = _find_boundary_radii(BOUNDARY_ANGLES)
MIN_BOUNDARY_RADIUS = float(BOUNDARY_RADII.min())  # every damped mode is stable up to this |h lambda|


def _jacobians_of(loop: Loop) -> jax.Array:
    """Return the Jacobians d(dz/dt)/dz [1/s], shape (k, n, n), at the points of `_map_over_probes`; z is the flow."""
    return _map_over_probes(_flow_jacobian, loop)


def _map_over_probes(function: Callable[[Loop], PyTree], loop: Loop) -> PyTree:
    """Return the results of `function` at k points, stacked: leaves (k, ...). A point is the loop with another start.

    The plant's `probes` returns starts where the loop may be stiffest. Without `probes` there are four points: the
    start and a start of zero, each with the loop's reference and with a target equal to the plant's signal
    (`_AtTarget`).
    """
    probes = getattr(loop.plant, "probes", None)
    if probes:
        starts = probes(loop.initial, loop.reference.setpoint(loop.start().reference), loop.stop)
        return jax.vmap(lambda start: function(dataclasses.replace(loop, initial=start)))(starts)
    arrived = dataclasses.replace(loop, reference=_AtTarget(reference=loop.reference))

    # The axis is that of the factors, because a start may be without numbers.
    def begin(factor: Scalar, base: Loop) -> PyTree:
        return function(dataclasses.replace(base, initial=jax.tree.map(lambda x: factor * x, loop.initial)))

    results = [jax.vmap(partial(begin, base=base))(jnp.array([0.0, 1.0])) for base in (loop, arrived)]
    return jax.tree.map(lambda *x: jnp.concatenate(x), *results)


# A caller waits for the compiler, and the limit is printed with three digits.
@compile_once(options=QUICK_COMPILE_OPTIONS)
def _jacobians(loops: Loop) -> jax.Array:
    return jax.vmap(_jacobians_of)(loops)


@pytree
class _AtTarget:
    """A reference whose target follows the plant: the controller is not at a limit there."""

    reference: Reference = part()

    def start(self, signal: object) -> Memory:
        return self.reference.start(signal)

    def flow(self, t: Scalar, memory: Memory, signal: object) -> PyTree:
        return self.reference.flow(t, memory, signal)

    def output(self, t: Scalar, memory: Memory, signal: PyTree) -> PyTree:
        del t
        return jax.lax.stop_gradient(outputs_like(signal, self.reference.setpoint(memory)))

    def setpoint(self, memory: Memory) -> PyTree:
        return self.reference.setpoint(memory)


def _flow_jacobian(loop: Loop) -> jax.Array:
    """Return the Jacobian d(dz/dt)/dz of the loop's flow z at its start [1/s], shape (n, n)."""
    state = loop.start()
    z, unravel = jax.flatten_util.ravel_pytree(state.flow())

    def flow(z: jax.Array) -> jax.Array:
        at = state.with_flow(unravel(z))
        return jax.flatten_util.ravel_pytree(loop.flow(0.0, at, loop.signals(0.0, at)))[0]

    # Differentiation of the traced program takes half the time of a second trace of `flow`.
    return jax.jacfwd(jax.extend.core.jaxpr_as_fun(jax.make_jaxpr(flow)(z)))(z)[0]


def _entries(loop: Loop) -> list[list[jax.Array]]:
    """Return the entries of the flow's Jacobian as n rows of n numbers, shape (k,) each in a batch."""
    # Entry by entry compiles longer than `_flow_jacobian` and runs faster for many runs.
    state = loop.start()
    leaves, tree = jax.tree.flatten(state.flow())

    def flow(*z: jax.Array) -> list[jax.Array]:
        at = state.with_flow(tree.unflatten(z))
        return jax.tree.leaves(loop.flow(0.0, at, loop.signals(0.0, at)))

    # The linear map skips what a state does not move. The values are computed once, not with each column.
    push, at_rest = jax.linearize(flow, *leaves)[1], [jnp.zeros_like(leaf) for leaf in leaves]
    columns = []
    for number, leaf in enumerate(leaves):
        moved = partial(lambda number, x: push(*at_rest[:number], x, *at_rest[number + 1 :]), number)
        for at in np.ndindex(leaf.shape):
            rates = jax.jvp(moved, (at_rest[number],), (at_rest[number].at[at].set(1.0),))[1]
            columns.append([rate[i] for rate in rates for i in np.ndindex(rate.shape)])
    return [list(row) for row in zip(*columns, strict=True)]
