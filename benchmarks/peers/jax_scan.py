"""A scan of RK4 in plain JAX, as one writes it first: five states, the greatest slip of the grid, a linear crossing."""

import jax
import jax.numpy as jnp

from peers import on_devices
from peers.ladder import STEPS
from peers.problem import DURATION, J1, K1, K2, R1, R2, SLIP, STOP, W1, W2, W3, W4, A, G, P, U, holding

TITLE, PACKAGES, MANY = "JAX, fixed RK4 scan by hand", ("jax", "jaxlib"), None
LADDER = STEPS


def rates(y, mass, hold):
    """dy/dt of y = (omega2, omega1, x1, distance, IAE); also the peers'."""
    speed = R2 * y[0]
    error = 1 - R1 * y[1] / speed - SLIP
    s = jnp.clip(error + SLIP, 1e-6, 1.0)
    power = jnp.exp(P * jnp.log(s))
    mu = W4 * power / (A + power) + ((W3 * s + W2) * s + W1) * s
    torque = jnp.clip(hold + K1 * y[2] + K2 * error, 0.0, U)
    return (-2 * G / R2 * mu, mass * (G * R1 / J1) * mu - torque / J1, error, speed, jnp.abs(error))


def scanned(masses, speeds, h):
    """The four numbers of lanes."""
    hold, zero = holding(masses), jnp.zeros_like(masses)

    def moved(y, by, k):
        return tuple(a + by * b for a, b in zip(y, k, strict=True))

    def step(carry, _):
        y, top, t = carry
        k1 = rates(y, masses, hold)
        k2 = rates(moved(y, h / 2, k1), masses, hold)
        k3 = rates(moved(y, h / 2, k2), masses, hold)
        k4 = rates(moved(y, h, k3), masses, hold)
        new = tuple(a + h / 6 * (b + 2 * (c + d) + e) for a, b, c, d, e in zip(y, k1, k2, k3, k4, strict=True))
        running = R2 * y[0] > STOP
        stops = running & (R2 * new[0] <= STOP)
        part = jnp.where(stops, (R2 * y[0] - STOP) / (R2 * (y[0] - new[0])), 1.0)
        new = tuple(jnp.where(running, a + part * (b - a), a) for a, b in zip(y, new, strict=True))
        new = (jnp.where(stops, 0.999999 * STOP / R2, new[0]), *new[1:])
        return (new, jnp.maximum(top, 1 - R1 * new[1] / (R2 * new[0])), t + jnp.where(running, part * h, 0.0)), None

    start = ((speeds / R2, speeds / R1, zero, zero, zero), zero, zero)
    (y, top, t), _ = jax.lax.scan(step, start, length=round(DURATION / h))
    return t, y[3], top, y[4]


def prepared(masses, speeds, step, dtype, threads):
    """Lanes are dealt to host devices."""
    del threads
    return on_devices.spread(lambda m, v: scanned(m, v, step), masses, speeds, dtype)
