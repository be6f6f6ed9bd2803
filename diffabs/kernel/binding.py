"""Lanes to their ends as an operation of JAX: under jit, a batch of it (vmap), and its derivatives, forward.

A batch is more lanes: what was the same for all of them, and differs in the batch, is then each lane's own. A batch of
tangents alone (`jax.jacfwd`) is one launch with so many tangents. The only module that knows how JAX is extended."""

import functools
import math
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.extend.core as jex
import jax.numpy as jnp
from jax.interpreters import ad, batching, mlir
from jax.interpreters import partial_eval as pe

from diffabs.kernel import tangents
from diffabs.kernel.graph import Level, real
from diffabs.kernel.program import Functions, Program
from diffabs.kernel.tangents import LEVELS, Derivative, Key

MOST = 8  # tangents of one launch
REVERSE = "a kernel has no reverse mode: forward mode (jax.jvp, jax.jacfwd) has its derivatives, engine = 'xla' both"


class Lanes:
    """Functions of one lane, and what was made of them so far. Equal only to itself."""

    def __init__(
        self,
        functions: Functions,
        launch: Callable[[Program, list[Any], list[Any]], list[Any]],
        wanted: tuple[int, ...] | None = None,
    ):
        """launch: of a program, the arrays before those of the carry, and these; returns the carry. wanted: arrays of
        the carry whose tangents matter in the end, None for all. Translated at once: raises Unsupported."""
        self.functions, self.launch, self.wanted = functions, launch, wanted
        self._made: dict[Any, Any] = {}
        self.derivative(None)

    def derivative(self, begins: tuple[tuple[Level, int], ...] | None) -> Derivative:
        """Return the program in which these arrays have tangents, one each. Raises Unsupported."""
        if begins not in self._made:
            moving = {level: tuple(i for one, i in begins or () if one == level) for level in LEVELS}
            plain = begins is None
            self._made[begins] = (
                tangents.plain(self.functions) if plain else tangents.derivative(self.functions, moving, self.wanted)
            )
        return self._made[begins]

    def program(self, begins: Any, many: int, as_lanes: frozenset[int]) -> Program:
        """Return the program of so many tangents. Raises Unsupported."""
        one = self.derivative(begins)
        if begins is None and not as_lanes:
            return one.program
        return tangents.spread(self.functions, one, many, as_lanes)

    @functools.cached_property
    def keys(self) -> list[Key]:
        """Arrays without their tangents, in the order of the operation's arguments."""
        return [Key(level, i, False) for level in LEVELS for i in range(len(self.functions.types[level]))]

    def slopes(self, begins: Any) -> list[Key]:
        """Those that begin with tangents, which follow."""
        return [Key(level, i, True) for level, i in begins or ()]

    def ends(self, begins: Any) -> list[Key]:
        """The results: the carry, and those of it that have tangents."""
        carry = range(len(self.functions.types[Level.STEP]))
        do = self.derivative(begins).do[Level.STEP]
        return [*(Key(Level.STEP, i, False) for i in carry), *(Key(Level.STEP, i, True) for i in do)]


operation = jex.Primitive("run_lanes")
operation.multiple_results = True


def bound(lanes: Lanes, arrays: Sequence[Any]) -> list[Any]:
    """Return the carry of lanes that are all over; of the arrays of all lanes, the lanes and their carry, as words."""
    return operation.bind(*arrays, lanes=lanes, begins=None, many=0, as_lanes=frozenset())


@operation.def_impl
def _run(*arrays: Any, **how: Any) -> list[Any]:
    return jax.jit(functools.partial(operation.bind, **how))(*arrays)


@operation.def_abstract_eval
def _shapes(*arrays: Any, lanes: Lanes, begins: Any, many: int, as_lanes: frozenset[int]) -> list[Any]:
    carry = arrays[len(lanes.keys) - len(lanes.functions.types[Level.STEP]) : len(lanes.keys)]

    def shape(key: Key) -> Any:
        x = carry[key.number]
        return x.update(shape=(x.shape[0], many, *x.shape[1:])) if key.tangent else x.update(weak_type=False)

    return [shape(key) for key in lanes.ends(begins)]


def _call(*arrays: Any, lanes: Lanes, begins: Any, many: int, as_lanes: frozenset[int]) -> list[Any]:
    """With some more zeros, if the tangents are many, so that each launch has as many."""
    keys = [*lanes.keys, *lanes.slopes(begins)]
    launches = max(1, math.ceil(many / MOST))
    each = math.ceil(many / launches)
    given = dict(zip(keys, arrays, strict=True))
    if not many:
        return _launched(lanes, begins, 0, as_lanes, given)

    def part(first: int) -> list[Any]:
        def cut(key: Key, x: Any) -> Any:
            axis = 0 if key.level == Level.UNIFORM and key.number not in as_lanes else 1
            lacking = max(0, first + each - many)
            wide = [(0, lacking if i == axis else 0) for i in range(x.ndim)]
            return jax.lax.slice_in_dim(jnp.pad(x, wide), first, first + each, axis=axis)

        some = {key: cut(key, x) if key.tangent else x for key, x in given.items()}
        return _launched(lanes, begins, each, as_lanes, some)

    parts = [part(first) for first in range(0, each * launches, each)]
    return [
        jnp.concatenate([one[i] for one in parts], 1)[:, :many] if key.tangent else parts[0][i]
        for i, key in enumerate(lanes.ends(begins))
    ]


mlir.register_lowering(operation, mlir.lower_fun(_call, multiple_results=True))


def _launched(lanes: Lanes, begins: Any, many: int, as_lanes: frozenset[int], given: dict[Key, Any]) -> list[Any]:
    """The results of one launch; what begins without tangents has zeros."""

    def array(key: Key) -> Any:
        if key in given:
            return given[key]
        x = given[key._replace(tangent=False)]
        return jnp.zeros((x.shape[0], many, *x.shape[1:]), x.dtype)

    order = tangents.arranged(lanes.functions, lanes.derivative(begins).do, as_lanes)
    carry = [array(key) for key in order[Level.STEP]]
    before = [array(key) for level in (Level.UNIFORM, Level.LANE) for key in order[level]]
    return lanes.launch(lanes.program(begins, many, as_lanes), before, carry)


def _push(arrays: Sequence[Any], slopes: Sequence[Any], *, lanes: Lanes, begins: Any, many: int, as_lanes: Any) -> Any:
    """Values and tangents."""
    if begins is not None:
        raise ValueError("a kernel has no second derivatives; engine = 'xla' has")
    moving = [type(x) is not ad.Zero and real(jax.typeof(x).dtype) for x in slopes]
    begins = tuple((key.level, key.number) for key, on in zip(lanes.keys, moving, strict=True) if on)
    if not begins:
        found = operation.bind(*arrays, lanes=lanes, begins=None, many=0, as_lanes=as_lanes)
        return found, [_none(x) for x in found]

    lanes.derivative(begins)  # now: where JAX 0.12 asks for shapes nothing can be traced

    def alone(key: Key, x: Any) -> Any:
        return jnp.expand_dims(x, 0 if key.level == Level.UNIFORM and key.number not in as_lanes else 1)

    given = [alone(key, x) for key, x, on in zip(lanes.keys, slopes, moving, strict=True) if on]
    found = operation.bind(*arrays, *given, lanes=lanes, begins=begins, many=1, as_lanes=as_lanes)
    values = found[: len(lanes.functions.types[Level.STEP])]
    results = [_none(x) for x in values]
    for key, x in zip(lanes.ends(begins)[len(values) :], found[len(values) :], strict=True):
        results[key.number] = x[:, 0]
    return values, results


ad.primitive_jvps[operation] = _push


def _none(x: Any) -> Any:
    return ad.Zero(jax.typeof(x).to_tangent_aval())


def _batched(arrays: Sequence[Any], axes: Sequence[Any], *, lanes: Lanes, begins: Any, many: int, as_lanes: Any) -> Any:
    """More tangents, or more lanes."""
    values = len(lanes.keys)
    size = next(x.shape[axis] for x, axis in zip(arrays, axes, strict=True) if axis is not None)
    how = {"lanes": lanes, "begins": begins}
    if all(axis is None for axis in axes[:values]):
        slopes = zip(lanes.slopes(begins), arrays[values:], axes[values:], strict=True)
        more = [_more_tangents(key, x, axis, size, as_lanes) for key, x, axis in slopes]
        found = operation.bind(*arrays[:values], *more, **how, many=size * many, as_lanes=as_lanes)
        results = [
            x.reshape(x.shape[0], size, many, *x.shape[2:]) if key.tangent else x
            for key, x in zip(lanes.ends(begins), found, strict=True)
        ]
        return results, [1 if key.tangent else None for key in lanes.ends(begins)]
    keys = [*lanes.keys, *lanes.slopes(begins)]
    own = {k.number for k, axis in zip(keys, axes, strict=True) if k.level == Level.UNIFORM and axis is not None}
    given = [
        _more_lanes(key, x, axis, size, own, as_lanes, _count(lanes, arrays, axes))
        for key, x, axis in zip(keys, arrays, axes, strict=True)
    ]
    found = operation.bind(*given, **how, many=many, as_lanes=as_lanes | own)
    return [x.reshape(size, -1, *x.shape[1:]) for x in found], [0] * len(found)


batching.primitive_batchers[operation] = _batched


def _count(lanes: Lanes, arrays: Sequence[Any], axes: Sequence[Any]) -> int:
    """Lanes before there were more."""
    last = len(lanes.keys) - 1
    return arrays[last].shape[1 if axes[last] == 0 else 0]


def _more_tangents(key: Key, x: Any, axis: int | None, size: int, as_lanes: frozenset[int]) -> Any:
    """(batch, tangents) where there were tangents."""
    at = 0 if key.level == Level.UNIFORM and key.number not in as_lanes else 1
    x = jnp.broadcast_to(x, (size, *x.shape)) if axis is None else jnp.moveaxis(x, axis, 0)
    x = jnp.moveaxis(x, 0, at)
    return x.reshape(*x.shape[:at], -1, *x.shape[at + 2 :])


def _more_lanes(
    key: Key, x: Any, axis: int | None, size: int, own: set[int], as_lanes: frozenset[int], count: int
) -> Any:
    """(batch, lanes) where there were lanes; and where what was the same for all of them is no more."""
    shared = key.level == Level.UNIFORM and key.number not in as_lanes
    if shared and key.number not in own:
        return x
    x = jnp.broadcast_to(x, (size, *x.shape)) if axis is None else jnp.moveaxis(x, axis, 0)
    if shared:
        x = jnp.broadcast_to(x[:, None], (size, count, *x.shape[1:]))
    return x.reshape(-1, *x.shape[2:])


def _unknown(trace: Any, *tracers: Any, **how: Any) -> Any:
    """A derivative is to be known only later, when it is transposed: reverse mode, or `jax.linearize`."""
    del trace, tracers, how
    raise ValueError(REVERSE)


def _transposed(*args: Any, **how: Any) -> Any:
    del args, how
    raise ValueError(REVERSE)


pe.custom_partial_eval_rules[operation] = _unknown
ad.primitive_transposes[operation] = _transposed
