"""How a part is made: a frozen, keyword-only dataclass that is a JAX pytree.

A part's leaves are its parameters. So `jax.vmap` over a plant is a Monte-Carlo sweep, `jax.grad` with respect to a
controller is tuning, and no second dictionary of parameters exists. A field is one of three kinds:

    param(...)   a leaf: a float (or array), with unit and range; differentiable and batchable
    part(...)    another part, or a tuple of parts
    static(...)  a shape or a choice fixed at trace time

Ranges are not checked when a part is built, because JAX rebuilds parts with tracers and placeholders; `check(part)`
of `core.validity` does it on the host, and names every offender at once.
"""

import dataclasses
import math
from collections.abc import Iterable, Iterator, Mapping
from typing import Any, TypeVar, dataclass_transform

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from diffabs.core import kinds
from diffabs.core.arrays import as_array
from diffabs.core.compiling import is_traced
from diffabs.core.rules import as_rule_array
from diffabs.core.units import Units, resolve_unit, units_of

Scalar = Any  # a float, a NumPy or JAX scalar, a tracer; a batch of them under vmap
Vector = Any  # the same with one axis
Matrix = Any  # with two

T = TypeVar("T")


@dataclasses.dataclass(frozen=True)
class Spec:
    """What a parameter may be: its unit and the interval it lives in. `tunable` is False where the run does not depend
    on the value smoothly (a sampling period, say), so that its derivative is zero or not defined. `shape` is that of a
    part that is not batched; None where it is free."""

    unit: str
    low: float = -math.inf
    high: float = math.inf
    open_low: bool = False
    open_high: bool = False
    infinite: bool = False
    tunable: bool = True
    shape: tuple[int, ...] | None = dataclasses.field(default=None, compare=False)

    def interval(self) -> str:
        """The range as a person writes it: `(0, 1] kg`."""
        left = "(" if self.open_low or self.low == -math.inf else "["
        right = ")" if self.open_high or self.high == math.inf else "]"
        unit = "" if self.unit == "1" else f" {self.unit}"
        return f"{left}{self.low:g}, {self.high:g}{right}{unit}"

    def around(self, units: Units | None) -> "Spec":
        """The same in a loop, in whose units a relative unit is worked out."""
        unit = resolve_unit(self.unit, units)
        return self if unit == self.unit else dataclasses.replace(self, unit=unit)

    def within(self, value: Any) -> Any:
        """Whether every element lies in the range, also of traced numbers. Written so that NaN does not."""
        x = as_rule_array(value)
        above = x > self.low if self.open_low else x >= self.low
        below = x < self.high if self.open_high else x <= self.high
        return (above & below & ((abs(x) < math.inf) | self.infinite)).all()

    def holds(self, value: ArrayLike) -> bool:
        """The same of concrete numbers."""
        return bool(self.within(np.asarray(value, float)))


def param(
    *,
    default: Any = dataclasses.MISSING,
    unit: str,
    low: float = -math.inf,
    high: float = math.inf,
    above: float | None = None,
    below: float | None = None,
    infinite: bool = False,
    tunable: bool = True,
    free: bool = False,
) -> Any:
    """A parameter: one differentiable leaf. `low`/`high` belong to the range, `above`/`below` do not. Its shape is that
    of its default, unless it is `free`."""
    spec = Spec(
        unit,
        low if above is None else above,
        high if below is None else below,
        above is not None,
        below is not None,
        infinite,
        tunable,
        None if free or default is dataclasses.MISSING else np.shape(default),
    )
    if isinstance(default, tuple | list | np.ndarray):
        values = np.array(default, float)
        return dataclasses.field(default_factory=values.copy, metadata={"spec": spec})
    return dataclasses.field(default=default, metadata={"spec": spec})


def part(*, default: Any = dataclasses.MISSING) -> Any:
    """A field that holds another part, or a tuple of parts. `default` is a part or a class to call."""
    if default is dataclasses.MISSING:
        return dataclasses.field(metadata={"part": True})
    make = default if isinstance(default, type) else lambda: default
    return dataclasses.field(default_factory=make, metadata={"part": True})


def static(*, default: Any = dataclasses.MISSING) -> Any:
    """A field known at trace time: changing it compiles again."""
    return dataclasses.field(default=default, metadata={"static": True})


@dataclass_transform(
    frozen_default=True, kw_only_default=True, eq_default=False, field_specifiers=(param, part, static)
)
def pytree(cls: type[T]) -> type[T]:
    """Make a class a part. Raises TypeError for `__post_init__`, which JAX would call with tracers and None."""
    if "__post_init__" in cls.__dict__:
        raise TypeError(f"{cls.__name__}: no __post_init__ on a part; write rules(self) for check() instead")
    new = dataclasses.dataclass(frozen=True, kw_only=True, eq=False)(cls)
    fields = dataclasses.fields(new)  # pyright: ignore[reportArgumentType]  # just made a dataclass
    unknown = [f.name for f in fields if not {"spec", "part", "static"} & set(f.metadata)]
    if unknown:
        raise TypeError(f"{cls.__name__}: declare {', '.join(unknown)} with param, part or static")
    meta = [f.name for f in fields if "static" in f.metadata]
    _register(new, [f.name for f in fields if f.name not in meta], meta)
    return new


def _register(cls: type, data: list[str], meta: list[str]) -> None:
    """Tell JAX how to take a part apart and put it together.

    Not `jax.tree_util.register_dataclass`: with that, in JAX 0.10, the tree structures of two different classes compare
    equal if they have as many leaves and the same static values, and so jit, when their hashes meet, now and then runs
    what it compiled for the other class. No issue of JAX is known to us;
    `test_structures_of_different_classes_differ` shows it."""

    def flatten(part: Any) -> tuple[tuple[Any, ...], tuple[Any, ...]]:
        return tuple(getattr(part, name) for name in data), tuple(getattr(part, name) for name in meta)

    def flatten_with_keys(part: Any) -> tuple[tuple[tuple[Any, Any], ...], tuple[Any, ...]]:
        leaves, statics = flatten(part)
        return tuple(zip(map(jax.tree_util.GetAttrKey, data), leaves, strict=True)), statics

    def unflatten(statics: tuple[Any, ...], leaves: Iterable[Any]) -> Any:
        return cls(**dict(zip(data, leaves, strict=True)), **dict(zip(meta, statics, strict=True)))

    jax.tree_util.register_pytree_with_keys(cls, flatten_with_keys, unflatten, flatten)


def parameters(part: Any, prefix: str = "", units: Units | None = None) -> Iterator[tuple[str, Spec, Any]]:
    """Every parameter below `part` as (dotted path, spec, value), in the order of declaration. Units relative to a loop
    are worked out below a part with a plant, or in the `units` given."""
    units = units or units_of(getattr(part, "plant", None))
    for name, field, value in children(part, prefix):
        if field is not None and "spec" in field.metadata:
            yield name, field.metadata["spec"].around(units), value
        else:
            yield from parameters(value, f"{name}.", units)


def children(part: Any, prefix: str) -> Iterator[tuple[str, dataclasses.Field[Any] | None, Any]]:
    """What a part holds as (dotted path, field, value), but for static fields; items of a tuple have no field."""
    if isinstance(part, tuple):
        for i, item in enumerate(part):
            yield f"{prefix}{i}", None, item
    elif dataclasses.is_dataclass(part):
        for field in dataclasses.fields(part):
            if "static" not in field.metadata:
                yield prefix + field.name, field, getattr(part, field.name)


def parts(part: Any) -> Iterator[Any]:
    """The parts of which a part is made."""
    for _, field, value in children(part, ""):
        if field is None:
            yield value
        elif "part" in field.metadata:
            yield from value if isinstance(value, tuple) else (value,)


def elements(part: Any) -> dict[str, Spec]:
    """What each single number below `part` may be, by path; those of a list have their place at the end."""
    found: dict[str, Spec] = {}
    for path, spec, value in parameters(part):
        shape = np.shape(value)
        found |= {".".join([path, *map(str, at)]): spec for at in np.ndindex(shape)} if shape else {path: spec}
    return found


def get(part: Any, path: str) -> Any:
    """Return the value in `part` at a dotted `path`, `plant.road.scale`, or `controller.gain.0` for one of a list.
    Raises KeyError naming what is there instead."""
    for name in path.split("."):
        names = _names(part)
        if name not in names:
            raise KeyError(f"no '{name}' in {path}; there is {', '.join(names) or 'nothing'}")
        part = getattr(part, name) if dataclasses.is_dataclass(part) else part[int(name)]
    return part


def _names(part: Any) -> list[str]:
    if isinstance(part, tuple) or dataclasses.is_dataclass(part):
        return [child.rpartition(".")[2] for child, _, _ in children(part, "")]
    return [str(i) for i in range(np.shape(part)[0])] if np.ndim(part) else []


def replace(part: T, values: Mapping[str, Any]) -> T:
    """Return a copy of `part` with the parameters in `values`, by dotted path, replaced.

    >>> import diffabs as d
    >>> loop = d.replace(d.braking(), {"plant.mass": 12.0, "plant.road.mu.2": 0.8})
    >>> loop.plant.mass, round(float(loop.plant.road.mu[2]), 3)
    (12.0, 0.8)

    Works under jit, grad and vmap. Raises KeyError for a path that does not exist.
    """
    for path, value in values.items():
        get(part, path)
        part = _replace(part, path.split("."), value)
    return part


def _replace(part: Any, names: list[str], value: Any) -> Any:
    head, *rest = names
    if not dataclasses.is_dataclass(part) and not isinstance(part, tuple):
        return jnp.asarray(part).at[int(head)].set(_replace(part[int(head)], rest, value) if rest else value)
    if isinstance(part, tuple):
        i = int(head)
        return (*part[:i], _replace(part[i], rest, value) if rest else value, *part[i + 1 :])
    new = _replace(getattr(part, head), rest, value) if rest else value
    return dataclasses.replace(part, **{head: new})  # pyright: ignore[reportArgumentType]  # an instance


def as_arrays(part: T) -> T:
    """The same part with arrays where a parameter is a list or a tuple of numbers."""
    listed = {path: value for path, _, value in parameters(part) if isinstance(value, list | tuple)}
    return replace(part, {path: jnp.asarray(value) for path, value in listed.items()})


def canonical_dtypes(tree: T) -> T:
    """Every leaf as a float array of one dtype: that of the arrays among the leaves, else JAX's default float.

    Python numbers are weakly typed: mixed with arrays they would cause a second compilation of the same function.
    Raises ValueError for a leaf that is no real number, or a float of fewer than 32 bits.
    """
    leaves, structure = jax.tree.flatten(tree)
    if any(map(kinds.find_value_objection, leaves)):
        raise ValueError(_first_unfit(tree))
    arrays = {x.dtype for x in leaves if isinstance(x, jax.Array) and jnp.issubdtype(x.dtype, jnp.floating)}
    dtype = jnp.result_type(*arrays) if arrays else jnp.result_type(float)
    if is_traced(leaves):
        return structure.unflatten([jnp.asarray(x, dtype) for x in leaves])
    with np.errstate(over="ignore"):  # what single precision cannot hold is infinite
        return structure.unflatten([as_array(x, dtype) for x in leaves])


def _first_unfit(tree: Any) -> str:
    """The first leaf that is no number of a run."""
    leaves = jax.tree_util.tree_leaves_with_path(tree)
    path, leaf = next((path, leaf) for path, leaf in leaves if kinds.find_value_objection(leaf))
    return f"{jax.tree_util.keystr(path).lstrip('.')} = {kinds.format_value(leaf)} {kinds.find_value_objection(leaf)}"


def prepare_parts(part: Any) -> Any:
    """The same parts, with everything worked out that does not change during a run: a part that has a method
    `prepared()` is replaced by what it returns. Differentiable; a run does it once, inside its compiled function."""
    return _rebuild_parts(part, "prepared")


def refine_parts(part: Any, times: int) -> Any:
    """The same parts for steps that are so many times shorter: a part whose memory is as long as so many steps has a
    method `refined(times)`."""
    return _rebuild_parts(part, "refined", times)


def prepare_derivatives(part: Any, paths: Iterable[str], prefix: str = "") -> Any:
    """The same parts, where derivatives by the parameters at these paths are asked for: a part that has a method
    `differentiated(names)` is replaced by what it returns for those of its own."""
    if isinstance(part, tuple):
        return tuple(prepare_derivatives(item, paths, f"{prefix}{i}.") for i, item in enumerate(part))
    if not dataclasses.is_dataclass(part):
        return part
    fields = [field.name for field in dataclasses.fields(part) if "part" in field.metadata]
    inner = {name: prepare_derivatives(getattr(part, name), paths, f"{prefix}{name}.") for name in fields}
    part = dataclasses.replace(part, **inner) if inner else part  # pyright: ignore[reportArgumentType]
    own = {path.removeprefix(prefix) for path in paths if path.startswith(prefix)}
    return part.differentiated(own) if hasattr(part, "differentiated") else part


def _rebuild_parts(part: Any, method: str, *args: Any) -> Any:
    """The same parts, each that has this method replaced by what it returns; the innermost first."""
    if isinstance(part, tuple):
        return tuple(_rebuild_parts(item, method, *args) for item in part)
    if not dataclasses.is_dataclass(part):
        return part
    fields = [field.name for field in dataclasses.fields(part) if "part" in field.metadata]
    inner = {name: _rebuild_parts(getattr(part, name), method, *args) for name in fields}
    part = dataclasses.replace(part, **inner) if inner else part  # pyright: ignore[reportArgumentType]
    return getattr(part, method)(*args) if hasattr(part, method) else part
