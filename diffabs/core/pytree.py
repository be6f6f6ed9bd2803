"""The construction of parts: a part is a frozen, keyword-only dataclass that is a JAX pytree.

The leaves of a part are its parameters. So `jax.vmap` over a plant is a Monte-Carlo sweep, and `jax.grad` with respect
to a controller is tuning. A second dictionary of parameters does not exist. A field is one of three kinds:

    param(...)   a leaf: a float (or array), with unit and range; differentiable and batchable. A string below says
                 what it means
    part(...)    another part, or a tuple of parts; with `named` also parts by name, whose paths lack the field's name
    static(...)  a shape or a choice fixed at trace time

The construction of a part does not check ranges, because JAX rebuilds parts with tracers and placeholders.
`core.validity.check_part` checks them on the host, and names every parameter outside its range at once.
"""

import dataclasses
import math
from collections.abc import Callable, Iterable, Iterator
from typing import Any, TypeVar, dataclass_transform

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from diffabs.core import kinds
from diffabs.core.arrays import as_array, as_rule_array
from diffabs.core.compiling import is_traced
from diffabs.core.meanings import document_fields
from diffabs.core.renamed import RENAMED, current_name, refuse_old_names
from diffabs.core.types import Bool, Params, Part, PyTree, Scalar
from diffabs.core.units import Units, resolve_unit, units_inside, units_of

T = TypeVar("T")


@dataclasses.dataclass(frozen=True)
class ParameterSpec:
    """The declaration of a parameter: its unit and its range.

    Attributes:
        unit: Unit, or a unit relative to the loop.
        low: Lower end of the range.
        high: Upper end of the range.
        open_low: Whether the lower end is outside the range.
        open_high: Whether the upper end is outside the range.
        infinite: Whether infinite values are allowed.
        tunable: False if a run does not depend smoothly on the value, for example on a sampling period. The derivative
            is then zero or undefined.
        shape: Shape in an unbatched part; None if it is free.
    """

    unit: str
    low: float = -math.inf
    high: float = math.inf
    open_low: bool = False
    open_high: bool = False
    infinite: bool = False
    tunable: bool = True
    shape: tuple[int, ...] | None = dataclasses.field(default=None, compare=False)

    def interval(self) -> str:
        """Return the range as text: `(0, 1] kg`."""
        opening = "(" if self.open_low or self.low == -math.inf else "["
        closing = ")" if self.open_high or self.high == math.inf else "]"
        unit = "" if self.unit == "1" else f" {self.unit}"
        return f"{opening}{self.low:g}, {self.high:g}{closing}{unit}"

    def around(self, units: Units | None) -> "ParameterSpec":
        """Return the declaration with `control` and `signal` in its unit replaced by the `units` of a loop; None keeps
        them.
        """
        unit = resolve_unit(self.unit, units)
        return self if unit == self.unit else dataclasses.replace(self, unit=unit)

    def within(self, value: Scalar) -> Bool:
        """Return whether every element of `value` lies in the range, also for traced numbers. NaN does not."""
        x = as_rule_array(value)
        # Comparisons that must be true, not ones that must be false: NaN fails each of them.
        above = x > self.low if self.open_low else x >= self.low
        below = x < self.high if self.open_high else x <= self.high
        return (above & below & ((abs(x) < math.inf) | self.infinite)).all()

    def holds(self, value: ArrayLike) -> bool:
        """Return whether every element of a concrete `value` lies in the range."""
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
    """Return the field of a parameter: one differentiable leaf, with the shape of its default.

    Args:
        low: Lower end of the range, which belongs to the range.
        high: Upper end of the range, which belongs to the range.
        above: Lower end of the range, which does not belong to the range.
        below: Upper end of the range, which does not belong to the range.
        infinite: Whether infinite values are allowed.
        tunable: False if a run does not depend smoothly on the value.
        free: Whether the value may have any shape.
    """
    spec = ParameterSpec(
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
        # A copy for each instance: dataclasses refuse mutable defaults.
        values = np.array(default, float)
        return dataclasses.field(default_factory=values.copy, metadata={"spec": spec})
    return dataclasses.field(default=default, metadata={"spec": spec})


def part(*, default: object = dataclasses.MISSING, named: bool = False) -> Any:
    """Return a field that holds another part, or a tuple or list of parts; a default that is a class is called.

    Args:
        named: Whether the field may also hold a dictionary of parts. The path of each is its key, beside the fields.
    """
    metadata = {"part": True, "named": named}
    if default is dataclasses.MISSING:
        return dataclasses.field(metadata=metadata)
    make = default if isinstance(default, type) else lambda: default
    return dataclasses.field(default_factory=make, metadata=metadata)


def static(*, default: object = dataclasses.MISSING) -> Any:
    """Return a field known at trace time; another value causes another compilation."""
    return dataclasses.field(default=default, metadata={"static": True})


@dataclass_transform(
    frozen_default=True, kw_only_default=True, eq_default=False, field_specifiers=(param, part, static)
)
def pytree(cls: type[T]) -> type[T]:
    """Return a class as a part: a frozen dataclass and a JAX pytree, of fields by `param`, `part` or `static`.

    A class with `__post_init__`, which JAX would call with tracers and None, is a TypeError; so is an undeclared field.
    """
    if "__post_init__" in cls.__dict__:
        raise TypeError(f"{cls.__name__}: no __post_init__ on a part; write rules(self) for check() instead")
    new = dataclasses.dataclass(frozen=True, kw_only=True, eq=False)(cls)
    fields = dataclasses.fields(new)  # pyright: ignore[reportArgumentType]  # just made a dataclass
    unknown = [f.name for f in fields if not {"spec", "part", "static"} & set(f.metadata)]
    if unknown:
        raise TypeError(f"{cls.__name__}: declare {', '.join(unknown)} with param, part or static")
    if cls.__name__ in RENAMED:
        new.__init__ = refuse_old_names(new.__init__)
    meta = [f.name for f in fields if "static" in f.metadata]
    _register(new, [f.name for f in fields if f.name not in meta], meta)
    return document_fields(new)


def _register(cls: type, data: list[str], meta: list[str]) -> None:
    """Register a class as a JAX pytree with keys.

    `jax.tree_util.register_dataclass` is not used. With it, in JAX 0.10, the tree structures of two different classes
    compare equal if they have as many leaves and the same static values. If their hashes meet, jit runs the program
    compiled for the other class. No issue of JAX is known to us; `test_structures_of_different_classes_differ` shows
    the error.
    """

    def flatten(part: object) -> tuple[tuple[PyTree, ...], tuple[PyTree, ...]]:
        return tuple(getattr(part, name) for name in data), tuple(getattr(part, name) for name in meta)

    def flatten_with_keys(part: object) -> tuple[tuple[tuple[PyTree, PyTree], ...], tuple[PyTree, ...]]:
        leaves, statics = flatten(part)
        return tuple(zip(map(jax.tree_util.GetAttrKey, data), leaves, strict=True)), statics

    def unflatten(statics: tuple[PyTree, ...], leaves: Iterable[PyTree]) -> object:
        return cls(**dict(zip(data, leaves, strict=True)), **dict(zip(meta, statics, strict=True)))

    jax.tree_util.register_pytree_with_keys(cls, flatten_with_keys, unflatten, flatten)


def parameters(
    part: object, prefix: str = "", units: Units | None = None
) -> Iterator[tuple[str, ParameterSpec, PyTree]]:
    """Yield every parameter below a part as (dotted path, spec, value), in the order of declaration.

    Relative units are resolved by the given `units`, or else by the plant of the part or of a part in it. `prefix` is
    the text before every path.
    """
    units = units or units_of(getattr(part, "plant", None))
    for name, field, value in children(part, prefix):
        if field is not None and "spec" in field.metadata:
            yield name, field.metadata["spec"].around(units), value
        else:
            yield from parameters(value, f"{name}.", units_inside(part, name.removeprefix(prefix), units))


def children(part: object, prefix: str) -> Iterator[tuple[str, dataclasses.Field[PyTree] | None, PyTree]]:
    """Yield (dotted path, field, value) of each field that is not static, without descending into the values.

    For a tuple or a list of parts it yields the items, with None as their field; so it does for parts by name. For any
    other value it yields nothing.
    """
    if isinstance(part, type):
        name = prefix.removesuffix(".") or "the part"
        raise ValueError(f"{name} = {part.__name__} is a class; {part.__name__}(...) is needed")
    if isinstance(part, tuple | list):
        for i, item in enumerate(part):
            yield f"{prefix}{i}", None, item
    elif dataclasses.is_dataclass(part):
        for field in dataclasses.fields(part):
            value = getattr(part, field.name)
            if isinstance(value, dict) and field.metadata.get("named"):
                yield from ((prefix + name, None, item) for name, item in value.items())
            elif "static" not in field.metadata:
                yield prefix + field.name, field, value


def parts(part: object) -> Iterator[PyTree]:
    """Yield the parts directly in a part, but not the parts in those; items of a tuple or list count singly."""
    for _, field, value in children(part, ""):
        if field is None:
            yield value
        elif "part" in field.metadata:
            yield from value if isinstance(value, tuple | list) else (value,)


def elements(part: object) -> dict[str, ParameterSpec]:
    """Return the declaration of every single number below a part by path: `controller.gain.0` for one of an array."""
    specs: dict[str, ParameterSpec] = {}
    for path, spec, value in parameters(part):
        shape = np.shape(value)
        specs |= {".".join([path, *map(str, at)]): spec for at in np.ndindex(shape)} if shape else {path: spec}
    return specs


def get(part: Part, path: str) -> PyTree:
    """Return the value in a part at a dotted path: a parameter, a part, or an element of an array
    (`controller.gain.0`).

    A path that does not exist, or leads to a static field, is a KeyError that names the fields that exist there.
    """
    words = path.split(".")
    for i, name in enumerate(words):
        names = _names(part, "".join(f"{word}." for word in words[:i]))
        if name not in names:
            new = current_name(name, names)
            hint = f"it is now {new}" if new else f"there is {', '.join(names) or 'nothing'}"
            raise KeyError(f"no '{name}' in {path}; {hint}")
        part = _child(part, name) if dataclasses.is_dataclass(part) else part[int(name)]
    return part


def _child(part: Part, name: str) -> Any:
    """Return the value of a field, or the part of this name in a field of parts by name."""
    return part_names(part)[name][name] if name in part_names(part) else getattr(part, name)


def part_names(part: Part) -> dict[str, dict[str, Any]]:
    """Return the field's value, a dictionary of parts, by the name of each part in it."""
    values = [getattr(part, field.name) for field in dataclasses.fields(part) if field.metadata.get("named")]
    return {name: value for value in values if isinstance(value, dict) for name in value}


def _names(part: Part, prefix: str) -> list[str]:
    if isinstance(part, tuple | list) or dataclasses.is_dataclass(part):
        return [child.rpartition(".")[2] for child, _, _ in children(part, prefix)]
    return [str(i) for i in range(np.shape(part)[0])] if np.ndim(part) else []


def replace(part: T, values: Params) -> T:
    """Return a copy of `part` with new values of parameters or whole parts, by dotted path. Works under jit, grad and
    vmap.

    The function does not check the ranges.

    Args:
        part: Part.
        values: New values by dotted path.

    Raises:
        KeyError: A path does not exist.

    See also:
        `Batch`: Values by path that differ between runs.
        `arrays`: Every parameter as an array.
        `check`: Lines about values out of range.

    Notes:
        Parts are immutable pytrees; the copy shares all other parts. A number in a path is an index of an array or
        tuple. A derivative by a replaced value is that by the parameter, so a function of one number suffices:

            jax.grad(lambda mass: metric(replace(loop, {"plant.mass": mass})))

    Examples:
        >>> import diffabs as d
        >>> loop = d.replace(d.braking(), {"plant.mass": 12.0, "plant.road.mu.2": 0.8})
        >>> loop.plant.mass, round(float(loop.plant.road.mu[2]), 3)
        (12.0, 0.8)
    """
    for path, value in values.items():
        get(part, path)
        part = _replace(part, path.split("."), value)
    return part


def _replace(part: Part, names: list[str], value: Scalar) -> Any:
    head, *tail = names
    if dataclasses.is_dataclass(part):
        new = _replace(_child(part, head), tail, value) if tail else value
        for field in dataclasses.fields(part):
            named = getattr(part, field.name)
            if isinstance(named, dict) and head in named:
                head, new = field.name, {**named, head: new}
        return dataclasses.replace(part, **{head: new})  # pyright: ignore[reportArgumentType]  # an instance
    i = int(head)
    new = _replace(part[i], tail, value) if tail else value
    if isinstance(part, tuple) or dataclasses.is_dataclass(part[i]):
        return (*part[:i], new, *part[i + 1 :])
    part = jnp.asarray(part)
    # An array of integers would round the new value.
    return part.astype(jnp.result_type(part, 0.0)).at[i].set(new)


def arrays(part: T) -> T:
    """Return the part with a JAX array in place of every parameter, for libraries that tell arrays from numbers.

    A new part has the Python floats that it was given. `jax.jit` and `jax.grad` take them as they are. Equinox takes
    them for constants: `eqx.filter_grad` differentiates arrays only, and `eqx.filter_jit` compiles again for each new
    float. All arrays have one data type, that of a run. Static fields stay. Works under jit, grad and vmap.

    Args:
        part: Part, or a whole loop.

    Raises:
        ValueError: A parameter is not a real number, or a float of fewer than 32 bits.

    >>> import diffabs as d
    >>> d.braking().plant.mass, d.arrays(d.braking()).plant.mass.shape
    (15.0, ())
    """
    return canonical_dtypes(stack_lists(part))


def stack_lists(part: T) -> T:
    """Return the part with arrays in place of parameters that are lists or tuples; other values stay.

    A list of plain numbers becomes a NumPy array. It leaves the data type of a run to the JAX arrays among the
    parameters.
    """
    listed = {path: value for path, _, value in parameters(part) if isinstance(value, list | tuple)}
    return replace(part, {path: as_rule_array(value) for path, value in listed.items()})


def canonical_dtypes(tree: T) -> T:
    """Return the tree with every leaf, also an integer, as a float array of one dtype.

    It is the common dtype of the float JAX arrays among the leaves, or JAX's default float if there are none. Python
    numbers are weakly typed: mixed with arrays they would cause a second compilation of the same function.
    """
    leaves, structure = jax.tree.flatten(tree)
    if any(map(kinds.find_value_objection, leaves)):
        paths = jax.tree_util.tree_leaves_with_path(tree)
        path, leaf = next((path, leaf) for path, leaf in paths if kinds.find_value_objection(leaf))
        name, objection = jax.tree_util.keystr(path).lstrip("."), kinds.find_value_objection(leaf)
        raise ValueError(f"{name} = {kinds.format_value(leaf)} {objection}")
    arrays = {x.dtype for x in leaves if isinstance(x, jax.Array) and jnp.issubdtype(x.dtype, jnp.floating)}
    dtype = jnp.result_type(*arrays) if arrays else jnp.result_type(float)
    if is_traced(leaves):
        return structure.unflatten([jnp.asarray(x, dtype) for x in leaves])
    with np.errstate(over="ignore"):  # a number too large for single precision becomes infinite
        return structure.unflatten([as_array(x, dtype) for x in leaves])


def prepare_parts(part: T) -> T:
    """Return the part ready for a run: each part in it with a method `prepared()` is replaced by the method's result.

    The results hold precomputed values that stay constant during a run. Differentiable; a run does it once, inside its
    compiled function.
    """
    return _rebuild_parts(part, "prepared", lambda prefix: ())


def refine_parts(part: T, times: int) -> T:
    """Return the part for shorter steps: each part in it with a method `refined(times)` is replaced by its result."""
    return _rebuild_parts(part, "refined", lambda prefix: (times,))


def prepare_derivatives(part: T, paths: Iterable[str]) -> T:
    """Return the part for derivatives by the parameters at these paths.

    Each part in it with a method `enable_derivatives(names)` is replaced by the method's result. `names` are the paths
    below that part, without the path of the part.
    """
    return _rebuild_parts(
        part,
        "enable_derivatives",
        lambda prefix: ({path.removeprefix(prefix) for path in paths if path.startswith(prefix)},),
    )


def _rebuild_parts(part: object, method: str, args: Callable[[str], tuple[PyTree, ...]], prefix: str = "") -> PyTree:
    """Return the part, with the method's result in place of each part that has the method, the innermost first.

    `args` returns the method's arguments for the path of a part, with a final dot.
    """
    if isinstance(part, tuple | list):
        return tuple(_rebuild_parts(item, method, args, f"{prefix}{i}.") for i, item in enumerate(part))
    if not dataclasses.is_dataclass(part):
        return part

    inner = {}
    for field in dataclasses.fields(part):
        value = getattr(part, field.name)
        if isinstance(value, dict) and field.metadata.get("named"):
            items = {key: _rebuild_parts(item, method, args, f"{prefix}{key}.") for key, item in value.items()}
            inner[field.name] = items
        elif "part" in field.metadata:
            inner[field.name] = _rebuild_parts(value, method, args, f"{prefix}{field.name}.")
    part = dataclasses.replace(part, **inner) if inner else part  # pyright: ignore[reportArgumentType]
    return getattr(part, method)(*args(prefix)) if hasattr(part, method) else part
