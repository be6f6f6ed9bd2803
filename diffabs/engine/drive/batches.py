"""Batches by XLA in which no run waits for another one: for values and not for gradients.

A batch under `jax.vmap` steps until its slowest run ends. Here only `LANES_AT_ONCE` runs step at a time. Every
`STEPS_PER_EXCHANGE` steps the runs that have ended are removed, and the next runs take their places.

XLA computes a program of small steps on one core. A batch is therefore dealt to threads, each with a share of the runs
(`run_on_all_cores`). Runs that step together are one program. A kernel has threads of its own.

On a mesh XLA divides the runs by itself if the axes are of type Auto. They suit programs that do not specify the
placement of their arrays, and no part of a loop specifies it.
"""

import contextlib
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.sharding import AxisType, Mesh, NamedSharding

from diffabs.core.first_order import first_order
from diffabs.core.jax_flags import default_flags
from diffabs.core.pytree import replace
from diffabs.core.tracing import split_batched
from diffabs.core.types import Array, Bool, Params, PyTree, Scalar, Vector
from diffabs.engine.drive.loops import STEPS_PER_BLOCK
from diffabs.engine.hybrid import Finish, HybridSample, HybridSystem, Objectives
from diffabs.engine.step.event_location import RunStatus
from diffabs.host.process import core_count, default_platform

LANES_AT_ONCE = 512  # runs that step at a time: their state stays in a processor's cache
STEPS_PER_EXCHANGE = 64  # steps between two exchanges of runs
VALUES_ONLY = "together=False has no derivatives by XLA: leave it out, or take engine='kernel' for forward mode"
MIN_RUNS_PER_CORE = 256  # a core gets at least so many runs
TRACED_EXPLICIT_AXES = (
    "lanes lie on a mesh with axes of type Explicit, within jit or a derivative; there they need Auto ones:"
    " jax.make_mesh(..., axis_types=(jax.sharding.AxisType.Auto,))"
)


class EarlyEnd(Protocol):
    """A condition that ends a run before its stop and its duration, because its outcome is already known; a pytree."""

    def data_of(self, number: Scalar) -> PyTree:
        """Return the data for run `number` that the condition needs, a pytree."""
        ...

    def has_reached(self, data: PyTree, sample: Any) -> Bool:
        """Return True if the run ends, given its `data` and the present `sample` of its signals."""
        ...


def run_packed(
    hybrid: HybridSystem,
    values: Params,
    keys: object,
    method: PyTree,
    objectives: Objectives,
    accepted: Vector,
    finish: Finish,
    enough: EarlyEnd | None = None,
    numbers: Array | None = None,
) -> PyTree:
    """Return the results, by `finish`, of runs that differ in their values and keys. Not for derivatives.

    A run that is not accepted is over from the beginning. `values` have shape (runs, ...) by dotted path, and `keys`,
    `accepted` and `numbers`, by which `enough` knows the runs, shape (runs,).
    """
    numbers = jnp.arange(len(accepted)) if numbers is None else numbers
    # Of the inputs themselves, not of tangents: so already their first derivative is an error.
    hybrid, values, objectives = first_order((hybrid, values, objectives), VALUES_ONLY)
    arguments = hybrid, values, objectives, method, keys, accepted, enough, numbers
    return _run(*arguments, finish=finish, width=LANES_AT_ONCE)


def split_by_lane(
    hybrid: HybridSystem, values: Params, objectives: Objectives
) -> tuple[PyTree, Callable[[PyTree], tuple[PyTree, PyTree]]]:
    """Return the leaves of the prepared systems that depend on the values, and a function from those of one run to its
    system and all its objectives. All other leaves are computed once.
    """
    leaves, whole = split_batched(lambda v: replace(hybrid, v).prepare_run(), values)

    def build_lane(lane_leaves: object) -> tuple[HybridSystem, Objectives]:
        lane_system, further = whole(lane_leaves)
        return lane_system, {**objectives, **further}

    return leaves, build_lane


def sample_now(hybrid: HybridSystem, carry: PyTree) -> HybridSample:
    """Return the sample of a run at its present point."""
    return hybrid.signals(carry.point.t, carry.point.state).sample


class _LaneSlots(NamedTuple):
    """Runs in progress and runs that have ended.

    Attributes:
        leaves: Leaves of the prepared systems that differ between the runs.
        keys: Random keys.
        carry: Carries.
        number: Number of the run in each slot; the number of runs in an empty slot.
        next: Number of the next run to start.
        ended: Results of the runs that have ended, by number.
    """

    leaves: PyTree
    keys: PyTree
    carry: PyTree
    number: Scalar
    next: Any
    ended: PyTree


@partial(jax.jit, static_argnames=("finish", "width"))
def _run(
    hybrid: HybridSystem,
    values: Params,
    objectives: Objectives,
    method: PyTree,
    keys: PyTree,
    accepted: Vector,
    enough: EarlyEnd | None,
    numbers: Array,
    *,
    finish: Finish,
    width: int,
) -> PyTree:
    """Return the results of all runs, in their order; `width` runs step at a time, by the stepping method `method`."""
    count = len(accepted)
    leaves, build_lane = split_by_lane(hybrid, values, objectives)
    step_all = jax.vmap(lambda lane_leaves, key, carry: method.step(*build_lane(lane_leaves), key, carry))
    renew_all = jax.vmap(lambda lane_leaves, carry: method.renew(build_lane(lane_leaves)[0], carry))
    start = jax.vmap(lambda lane_leaves, key: method.start(*build_lane(lane_leaves), key))
    finish_all = jax.vmap(lambda lane_leaves, carry: finish(*build_lane(lane_leaves), carry)[0])

    def take_lanes(number: Scalar) -> tuple[PyTree, PyTree, PyTree]:
        """Return leaves, keys and carries of these runs at t = 0; beyond the last run a copy that does not step."""
        lane_leaves, key, run = jax.tree.map(lambda x: x[jnp.minimum(number, count - 1)], (leaves, keys, accepted))
        carry = start(lane_leaves, key)
        status = jnp.where(run & (number < count), carry.status, RunStatus.REFUSED)
        return lane_leaves, key, carry._replace(status=status.astype(carry.status.dtype))

    def step_and_exchange(slots: _LaneSlots) -> _LaneSlots:
        def step_once(carry: PyTree, _: object) -> tuple[PyTree, None]:
            return step_all(slots.leaves, slots.keys, carry), None

        def renew_and_step(carry: object, _: object) -> tuple[PyTree, None]:
            return jax.lax.scan(step_once, renew_all(slots.leaves, carry), length=STEPS_PER_BLOCK)[0], None

        slots = slots._replace(
            carry=jax.lax.scan(renew_and_step, slots.carry, length=STEPS_PER_EXCHANGE // STEPS_PER_BLOCK)[0]
        )
        free = ~slots.carry.running | _lanes_ended_early(enough, build_lane, slots, numbers)
        return _exchange_lanes(slots, free, finish_all, take_lanes, count)

    number = jnp.arange(min(width, count))
    first = take_lanes(number)
    shapes = jax.eval_shape(finish_all, first[0], first[2])
    ended = jax.tree.map(lambda x: jnp.zeros((count, *x.shape[1:]), x.dtype), shapes)
    slots = _LaneSlots(*first, number, number[-1] + 1, ended)
    return jax.lax.while_loop(lambda slots: jnp.any(slots.number < count), step_and_exchange, slots).ended


def _lanes_ended_early(
    enough: EarlyEnd | None, build_lane: Callable[[PyTree], PyTree], slots: _LaneSlots, numbers: Array
) -> Bool:
    """Return True for each slot whose run ends early; `build_lane` returns the system and objectives of one run."""
    if enough is None:
        return jnp.zeros_like(slots.carry.running)
    sample = jax.vmap(lambda lane_leaves, carry: sample_now(build_lane(lane_leaves)[0], carry))(
        slots.leaves, slots.carry
    )
    lane_numbers = numbers[jnp.minimum(slots.number, len(numbers) - 1)]
    return jax.vmap(lambda number, sample: enough.has_reached(enough.data_of(number), sample))(lane_numbers, sample)


def _exchange_lanes(
    slots: _LaneSlots,
    free: PyTree,
    finish: Callable[[PyTree, PyTree], PyTree],
    take_lanes: Callable[[PyTree], PyTree],
    count: int,
) -> _LaneSlots:
    """Return the slots with the results of free slots stored (by `finish`) and the next runs in them (`take_lanes`)."""
    place, runs = jnp.where(free, slots.number, count), finish(slots.leaves, slots.carry)
    # Slots that are not free write to the place `count`, beyond the end: the mode "drop" discards them.
    ended = jax.tree.map(lambda all, x: all.at[place].set(x, mode="drop"), slots.ended, runs)
    # The cumulative sum gives free slots consecutive numbers.
    number = jnp.where(free, slots.next + jnp.cumsum(free) - 1, slots.number)
    old = (slots.leaves, slots.keys, slots.carry)
    lane_leaves, key, carry = jax.tree.map(partial(_select_lanes, free), take_lanes(number), old)
    return _LaneSlots(lane_leaves, key, carry, jnp.minimum(number, count), slots.next + jnp.sum(free), ended)


def _select_lanes(free: Array, a: Array, b: Scalar) -> Array:
    if jnp.issubdtype(a.dtype, jax.dtypes.prng_key):
        return jax.random.wrap_key_data(_select_lanes(free, jax.random.key_data(a), jax.random.key_data(b)))
    return jnp.where(free.reshape(-1, *[1] * (a.ndim - 1)), a, b)


def describe_placement(data: object) -> str:
    """Return the reason why only XLA can run these arrays where they lie, or "" if a kernel can, too.

    A kernel is made for the kind of device that JAX uses by default, and for one device.
    """
    # JAX moves an array that is not committed to its device.
    places = [x.sharding.device_set for x in jax.tree.leaves(data) if isinstance(x, jax.Array) and x.committed]
    if any(len(devices) > 1 for devices in places):
        return "the runs lie on several devices"
    foreign = {device.platform for devices in places for device in devices} - {default_platform()}
    if foreign:
        return f"the runs lie on a device ({', '.join(sorted(foreign))}) of another kind than JAX's default"
    return ""


def run_on_all_cores(run: Callable[[PyTree, Array], PyTree], columns: object, count: int) -> PyTree:
    """Return run(columns, numbers of the runs), computed on all cores of this processor, one thread each.

    All shares have one shape, so one program, and at least `MIN_RUNS_PER_CORE` runs: a small batch uses fewer cores.
    Arrays on several devices, or on another device than a processor, are left to XLA.
    """
    cores = min(core_count(), count // MIN_RUNS_PER_CORE)
    if cores < 2 or default_platform() != "cpu" or describe_placement(columns):
        return run(columns, jnp.arange(count))
    # Threads do not inherit these settings.
    wide, each = jnp.result_type(float) == jnp.float64, -(-count // cores)
    device = jax.config.jax_default_device  # pyright: ignore[reportAttributeAccessIssue]

    def run_share(numbers: np.ndarray) -> PyTree:
        with default_flags(), jax.enable_x64(wide), jax.default_device(device):
            share = jax.tree.map(lambda x: x[numbers], columns)
            return jax.block_until_ready(run(share, jnp.asarray(numbers)))

    # Every `cores`-th run: neighbours take about equally long. Copies of the last run fill shares of one shape, so that
    # all shares have one program.
    shares = [np.minimum(np.arange(i, i + each * cores, cores), count - 1) for i in range(cores)]
    with ThreadPoolExecutor(cores) as pool:
        results = list(pool.map(run_share, shares))
    order = np.arange(each * cores).reshape(cores, each).T.ravel()[:count]
    return jax.tree.map(lambda *x: jnp.concatenate(x)[order], *results)


def run_on_auto_mesh(run: Callable[..., PyTree], arguments: tuple[PyTree, ...]) -> PyTree:
    """Return run(*arguments), with arrays on meshes of Explicit axes moved to Auto axes of the same devices.

    No data move between devices. Results return to the original mesh. A traced array on Explicit axes is a ValueError.
    """
    meshes = {_auto_mesh(x.sharding.mesh): x.sharding.mesh for x in jax.tree.leaves(arguments) if _has_explicit_axes(x)}
    if not meshes:
        return run(*arguments)

    def back(x: Array) -> Array:
        mesh = getattr(getattr(x, "sharding", None), "mesh", None)
        return _put_on_mesh(x, meshes[mesh]) if mesh in meshes else x

    # A mesh set around the call must be replaced, too: it would otherwise conflict with the Auto mesh of the arrays.
    meant = jax.sharding.get_abstract_mesh().axis_names
    with jax.set_mesh(next(iter(meshes))) if meant else contextlib.nullcontext():
        results = run(
            *jax.tree.map(
                lambda x: _put_on_mesh(x, _auto_mesh(x.sharding.mesh)) if _has_explicit_axes(x) else x, arguments
            )
        )
    return jax.tree.map(back, results)


def _has_explicit_axes(x: Scalar) -> bool:
    """Return True if an array lies on a mesh whose axes are part of its type; raise a ValueError if it is traced."""
    if not isinstance(x, jax.Array):
        return False
    sharding = jax.typeof(x).sharding if isinstance(x, Tracer) else x.sharding
    explicit = isinstance(sharding, NamedSharding) and AxisType.Explicit in sharding.mesh.axis_types
    if explicit and isinstance(x, Tracer):
        raise ValueError(TRACED_EXPLICIT_AXES)
    return explicit


def _auto_mesh(mesh: Any) -> Mesh:
    return Mesh(mesh.devices, mesh.axis_names, axis_types=(AxisType.Auto,) * len(mesh.axis_names))


def _put_on_mesh(x: jax.Array, mesh: Mesh) -> jax.Array:
    return jax.device_put(x, NamedSharding(mesh, x.sharding.spec))  # pyright: ignore[reportAttributeAccessIssue]
