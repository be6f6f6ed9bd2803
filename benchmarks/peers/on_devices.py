"""Programs of JAX on its host devices, of which serve.py makes as many as there are threads."""

import concurrent.futures

import jax
import jax.numpy as jnp
import numpy as np

DEAL = 64  # neighbouring lanes that stay together


def dealt(count, devices):
    """Return the lanes of each device, (devices, count/devices): runs of them in turn, so that none has only long ones.
    Raises ValueError where they are not as many for each."""
    if count % devices:
        raise ValueError(f"{count} lanes are not shared equally by {devices} devices")
    each = count // devices
    run = next(n for n in range(min(DEAL, each), 0, -1) if each % n == 0)
    return np.arange(count).reshape(-1, devices, run).transpose(1, 0, 2).reshape(devices, each)


def spread(solve, masses, speeds, dtype, *, compiled=True):
    """Return a function without arguments: the (4, lanes) of solve(masses, speeds) -> four (lanes,), on all devices.

    compiled: whether `solve` is compiled here, or compiles itself"""
    devices = jax.devices()
    which = dealt(len(masses), len(devices))
    columns = [
        tuple(jax.device_put(jnp.asarray(x[mine], dtype), device) for x in (masses, speeds))
        for mine, device in zip(which, devices, strict=True)
    ]
    one = jax.jit(solve)
    calls = [one.lower(*pair).compile() if compiled else solve for pair in columns]
    pool = concurrent.futures.ThreadPoolExecutor(len(devices))
    back = np.argsort(which.ravel())

    def run():
        parts = pool.map(lambda call, pair: jax.block_until_ready(call(*pair)), calls, columns)
        return np.concatenate([np.stack([np.asarray(x) for x in part]) for part in parts], axis=1)[:, back]

    return run


def in_blocks(solve, size):
    """Return `solve` for blocks of lanes, one after another: a block stays in the cache, and stops by itself."""

    def run(masses, speeds):
        if masses.shape[0] <= size:
            return solve(masses, speeds)
        if masses.shape[0] % size:
            raise ValueError(f"{masses.shape[0]} lanes are no whole number of blocks of {size}")
        blocks = jax.lax.map(lambda pair: solve(*pair), (masses.reshape(-1, size), speeds.reshape(-1, size)))
        return tuple(x.reshape(-1) for x in blocks)

    return run
