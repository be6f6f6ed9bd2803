"""diffrax: Tsit5, its PID controller of the step, an Event with a root finder, vmap over blocks of lanes. It has no
running maximum: the slip is saved around its peak, which is where it is told to look."""

import diffrax
import jax
import jax.numpy as jnp
import optimistix

from peers import on_devices
from peers.jax_scan import rates
from peers.ladder import TOLERANCES
from peers.problem import DURATION, R1, R2, STOP, holding

TITLE, PACKAGES, MANY = "diffrax, Tsit5 with Event", ("diffrax", "jax", "jaxlib", "equinox", "optimistix"), None
LADDER = TOLERANCES
BLOCK, SAVED, WINDOW = 64, 241, 0.12  # [s], in which every lane has its greatest slip
MOST_STEPS = 100_000


def one(mass, speed, tolerance, **settings):
    """The four numbers of one lane. Further settings are diffeqsolve's."""
    hold = holding(mass)
    root = 1e-9 if mass.dtype == jnp.float64 else 1e-5
    at_end = diffrax.SubSaveAt(t1=True)
    times = jnp.linspace(0.0, WINDOW, SAVED, dtype=mass.dtype)
    slips = diffrax.SubSaveAt(ts=times, fn=lambda t, y, args: 1 - R1 * y[1] / (R2 * y[0]))
    zero = jnp.zeros_like(mass)
    run = diffrax.diffeqsolve(
        diffrax.ODETerm(lambda t, y, args: rates(y, mass, hold)),
        diffrax.Tsit5(),
        t0=zero,
        t1=zero + DURATION,
        dt0=zero + 1e-4,
        y0=(speed / R2, speed / R1, zero, zero, zero),
        stepsize_controller=diffrax.PIDController(rtol=tolerance, atol=1e-2 * tolerance, pcoeff=0.3, icoeff=0.4),
        saveat=diffrax.SaveAt(subs=[at_end, slips]),
        event=diffrax.Event(lambda t, y, args, **_: R2 * y[0] - STOP, optimistix.Newton(rtol=root, atol=root)),
        max_steps=MOST_STEPS,
        throw=False,
        **settings,
    )
    y, values = jax.tree.map(lambda x: x[-1], run.ys[0]), run.ys[1]
    i = jnp.clip(jnp.argmax(values), 1, SAVED - 2)
    a, b, c = values[i - 1], values[i], values[i + 1]
    return run.ts[0][-1], y[3], b + (a - c) ** 2 / (8 * (2 * b - a - c)), y[4]


def prepared(masses, speeds, tolerance, dtype, threads):
    """Lanes are dealt to host devices."""
    del threads
    solve = on_devices.in_blocks(jax.vmap(lambda m, v: one(m, v, tolerance)), BLOCK)
    return on_devices.spread(solve, masses, speeds, dtype)
