"""The largest integration step that is stable for a loop.

RK4 is stable on a mode lambda while |R(h lambda)| <= 1, R(z) = 1 + z + z^2/2 + z^3/6 + z^4/24. A braking loop stiffens
as it slows down, its slip rate going with 1/v, so the loop is linearised at speeds down to the stop: at slips close to
the setpoint, where the controller is not at a limit, and at slips all over the friction curve, which is steepest near
0. A balance is linearised upright and at its start. Held memories do not move: a sampled controller is not judged here.
"""

import dataclasses

import jax
import jax.flatten_util
import jax.numpy as jnp
import numpy as np

from diffabs.loop import Loop, task
from diffabs.pytree import replace, strong

SPEEDS = 6  # between start and stop, in geometric progression: the ends decide
OFFSETS = (0.0, 1e-4, 3e-4, 1e-3, 3e-3, 0.01, 0.03, 0.1)  # slip below and above the setpoint
SLIPS = (0.001, 0.003, 0.01, 0.03, 0.1, 0.3, 1.0)  # where a run may pass
RADII = np.linspace(1e-3, 3.5, 3500)  # the stability region of RK4 lies within 3.5 of the origin


def stable_step(loop: Loop) -> float:
    """Largest step [s] at which RK4 damps every damped mode of the loop, between its initial speed and its stop."""
    return float(stable_steps(jax.tree.map(lambda x: x[None], strong(loop)))[0])


def stable_steps(loops: Loop) -> np.ndarray:
    """The same for a batch of loops, whose leaves have a leading axis (n,); returns (n,)."""
    matrices = np.asarray(_jacobians(loops))
    known = np.asarray(np.isfinite(matrices).all(axis=(-2, -1)))
    modes = np.linalg.eigvals(np.where(known[..., None, None], matrices, 0.0))
    damped = (modes.real < 0) & known[..., None]
    size = np.where(damped, np.abs(modes), 1.0)
    limits = np.where(damped, _radius(np.where(damped, modes, -1.0) / size) / size, np.inf)
    return limits.min(axis=tuple(range(1, limits.ndim)), initial=np.inf)


def _radius(direction: np.ndarray) -> np.ndarray:
    """How far along each direction of the complex plane RK4 stays stable."""
    angles = np.abs(np.angle(direction))  # the region is symmetric
    return np.interp(angles, ANGLES, REACH)


def _reach(angle: np.ndarray) -> np.ndarray:
    z = RADII * np.exp(1j * angle[:, None])
    grows = np.abs(1 + z * (1 + z / 2 * (1 + z / 3 * (1 + z / 4)))) > 1 + 1e-9
    return np.where(grows.any(axis=1), RADII[np.argmax(grows, axis=1)], RADII[-1])


ANGLES = np.linspace(np.pi / 2, np.pi, 2001)
REACH = _reach(ANGLES)


@jax.jit
@jax.vmap
def _jacobians(loop: Loop) -> jax.Array:
    """d(flow)/d(flow) over the grid of speeds and slips (SPEEDS, slips, n, n), or over two states (1, 2, n, n)."""
    if task(loop.plant) == "balance":
        return jax.vmap(lambda share: _balance_jacobian(loop, share))(jnp.array([0.0, 1.0]))[None]
    state = loop.start()
    setpoint = loop.reference.setpoint(state.reference)
    near = jnp.concatenate([setpoint - jnp.array(OFFSETS), setpoint + jnp.array(OFFSETS)])
    slips = jnp.concatenate([jnp.clip(near, 1e-4, 1.0), jnp.array(SLIPS)])
    speeds = jnp.geomspace(loop.initial.speed, loop.stop.speed, SPEEDS)  # pyright: ignore[reportAttributeAccessIssue]
    return jax.vmap(jax.vmap(lambda v, s: _jacobian(loop, v, s), (None, 0)), (0, None))(speeds, slips)


def _jacobian(loop: Loop, speed: jax.Array, slip: jax.Array) -> jax.Array:
    return _of_flow(replace(loop, {"initial.speed": speed, "initial.slip": slip}))


def _balance_jacobian(loop: Loop, share: jax.Array) -> jax.Array:
    """At a share of the initial angles and rates."""
    return _of_flow(dataclasses.replace(loop, initial=jax.tree.map(lambda x: share * x, loop.initial)))


def _of_flow(loop: Loop) -> jax.Array:
    state = loop.start()
    z, unravel = jax.flatten_util.ravel_pytree(state.flow())

    def flow(z: jax.Array) -> jax.Array:
        at = state.with_flow(unravel(z))
        return jax.flatten_util.ravel_pytree(loop.flow(0.0, at, loop.signals(0.0, at)))[0]

    return jax.jacfwd(flow)(z)
