"""Functions that were traced and compiled once, kept for the next process.

Tracing a loop, lowering it, and what XLA makes of it take longer than most runs. The compiled function is kept under
the digest of everything that decides it (`core.fingerprint`). Where nobody can tell that (a part from outside this
package, a file changed since the start) nothing is kept.

Only this module knows `jax.experimental.serialize_executable`. Such a file is code, as a library is."""

import contextlib
import hashlib
import importlib
import itertools
import json
import math
import os
import pathlib
import pickle
import threading
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
from jax.errors import JaxRuntimeError
from jax.experimental import serialize_executable

from diffabs.core import files, fingerprint, provenance
from diffabs.core.fingerprint import Unknown

OFF = "DIFFABS_NO_CACHE"  # if set, nothing is kept
ROOM = 1 << 27  # bytes of programs in a folder, some 600; beyond, the older half goes


class Shelf(Protocol):
    """Where programs are kept, and what belongs to them."""

    def folder(self) -> pathlib.Path | None:
        """None where nothing is kept."""
        ...

    def around(self) -> Any:
        """What decides a program besides its function, its arguments and what is the same for all."""
        ...

    def libraries(self, lowered: jax.stages.Lowered) -> list[str]:
        """The names of those that a program calls."""
        ...

    def load(self, library: str) -> None:
        """Have XLA know a library. Raises OSError for one that is gone."""
        ...


class Simple:
    """The shelf of programs that call nothing: a folder, if somebody named one (`put`)."""

    def __init__(self) -> None:
        """Nothing is kept."""
        self._folder: pathlib.Path | None = None

    def put(self, folder: pathlib.Path | None) -> None:
        """Keep programs there from now on; None keeps nothing."""
        self._folder = folder

    def folder(self) -> pathlib.Path | None:
        return self._folder

    def around(self) -> Any:
        return provenance.processor(), os.cpu_count()

    def libraries(self, lowered: jax.stages.Lowered) -> list[str]:
        del lowered
        return []

    def load(self, library: str) -> None:
        raise FileNotFoundError(library)


class Program(NamedTuple):
    """What was compiled, of flat arrays to flat arrays; the structure of its results; the libraries that it calls."""

    compiled: Any
    results: Any
    libraries: list[str]


class Programs:
    """Those of a function, one for each structure of its arguments.

    function: as it is traced; it may be one that `jax.jit` made, without options
    told: everything that decides it besides its arguments, the function of this package that it was made of included
    leading, names: its static arguments, that come first, or have these names and are given by them
    options: of XLA"""

    def __init__(
        self,
        function: Any,
        told: Any,
        shelf: Shelf,
        *,
        leading: int = 0,
        names: tuple[str, ...] = (),
        options: dict[str, Any] | None = None,
    ):
        """Nothing is looked for yet."""
        self.function, self.told, self.shelf = function, told, shelf
        self._leading, self._names, self._options = leading, names, options or {}
        self._known: dict[Any, Any] = {}
        self._lock = threading.Lock()

    def find(self, args: Any, more: Any = None) -> Callable[..., Any] | None:
        """Return what to call instead of the function: read, or compiled and kept. None where nothing can be kept.
        Raises what tracing raises."""
        if self.shelf.folder() is None or os.environ.get(OFF):
            return None
        fixed, given = self._apart(args, more or {})
        leaves, tree = jax.tree.flatten(given)
        device = _device(leaves)
        place = (_hashed(fixed), tree, tuple(map(jax.typeof, leaves)), device, jax.config.jax_enable_x64)  # pyright: ignore
        with self._lock:
            if place not in self._known:
                try:
                    self._known[place] = None if device is None else self._found(fixed, given, device)
                except Unknown:
                    self._known[place] = None
            return self._known[place]

    def forget(self) -> None:
        """As if nothing had been looked for."""
        self._known.clear()

    def _apart(self, args: Any, more: Any) -> tuple[Any, Any]:
        """What is static, and what is not."""
        fixed = {name: more[name] for name in self._names if name in more}
        others = {name: x for name, x in more.items() if name not in fixed}
        return (args[: self._leading], fixed), (args[self._leading :], others)

    def _found(self, fixed: Any, given: Any, device: Any) -> Callable[..., Any]:
        around = (fingerprint.surroundings(), self.shelf.around(), str(device))
        known = (self.told, fixed, self._options, *around)
        path = self._folder() / f"{fingerprint.digest(jax.tree.map(_described, given), known)}.program"
        program = _read(path, len(jax.tree.leaves(given)), device, self.shelf)
        if program is None:
            program = self._compiled(fixed, given)
            _write(path, program)
        return self._callable(program)

    def _folder(self) -> pathlib.Path:
        folder = self.shelf.folder()
        if folder is None:
            raise Unknown("there is no folder any more")
        return folder

    def _compiled(self, fixed: Any, given: Any) -> Program:
        """Raises what tracing raises, Unknown for results of another package."""
        leaves, tree = jax.tree.flatten(given)
        keys, results = [_is_key(x) for x in leaves], []

        def kept(*data: Any) -> list[Any]:
            whole = [jax.random.wrap_key_data(x) if key else x for x, key in zip(data, keys, strict=True)]
            args, more = tree.unflatten(whole)
            found = self.function(*fixed[0], *args, **fixed[1], **more)
            results[:] = [_skeleton(found)]
            return jax.tree.leaves(found)

        lowered = jax.jit(kept).lower(*map(_data, leaves))
        libraries = self.shelf.libraries(lowered)
        with _written_nowhere():
            compiled = lowered.compile(compiler_options=self._options)
        return Program(compiled, results[0], libraries)

    def _callable(self, program: Program) -> Callable[..., Any]:
        results = jax.tree.structure(_rebuilt(program.results, itertools.repeat(0)))

        def call(*args: Any, **more: Any) -> Any:
            leaves = jax.tree.leaves(self._apart(args, more)[1])
            return results.unflatten(program.compiled(*map(_data, leaves)))

        return call


@contextlib.contextmanager
def _written_nowhere() -> Iterator[None]:
    """JAX's own cache takes nothing meanwhile: what it gives back cannot be written again, functions are missing."""
    name = "jax_persistent_cache_min_compile_time_secs"
    least = jax.config.values[name]
    jax.config.update(name, math.inf)
    try:
        yield
    finally:
        jax.config.update(name, least)


def _device(leaves: list[Any]) -> Any:
    """The processor that has these arrays. None where what is compiled cannot be kept: on several, in several
    processes, or on a GPU, where a launch calls Python, which is in no file."""
    if jax.process_count() > 1 or jax.config.jax_default_device is not None:  # pyright: ignore
        return None
    homes = {device for x in leaves if isinstance(x, jax.Array) for device in x.devices()} or {jax.devices()[0]}
    device = homes.pop()
    return None if homes or device.platform != "cpu" else device


def _hashed(fixed: Any) -> Any:
    return fixed[0], tuple(sorted(fixed[1].items()))


def _described(x: Any) -> jax.ShapeDtypeStruct:
    """Shape and type of an argument, which count for a program; its numbers do not."""
    kind = jax.typeof(x)
    return jax.ShapeDtypeStruct(kind.shape, kind.dtype, weak_type=kind.weak_type)


def _is_key(x: Any) -> bool:
    return hasattr(x, "dtype") and jnp.issubdtype(x.dtype, jax.dtypes.prng_key)


def _data(x: Any) -> Any:
    """An argument as it is, of a key its words."""
    return jax.random.key_data(x) if _is_key(x) else x


# files ----------------------------------------------------------------------------------------------------------------


def _read(path: pathlib.Path, arguments: int, device: Any, shelf: Shelf) -> Program | None:
    """None for one that is not there, is damaged, or whose libraries are gone."""
    try:
        head, _, body = path.read_bytes().partition(b"\n")
        told = json.loads(head)
        if hashlib.sha256(body).hexdigest() != told["digest"]:
            return None
        for name in told["libraries"]:
            shelf.load(name)
        given, found = jax.tree.structure(((0,) * arguments, {})), jax.tree.structure([0] * told["count"])
        compiled = serialize_executable.deserialize_and_load(
            body, given, found, backend=device.client, execution_devices=[device]
        )
        return Program(compiled, told["results"], told["libraries"])
    except (OSError, ValueError, KeyError, TypeError, pickle.UnpicklingError, JaxRuntimeError):
        return None


def _write(path: pathlib.Path, program: Program) -> None:
    """What JAX cannot write, or a folder that cannot be written, keeps nothing."""
    try:
        body, _, found = serialize_executable.serialize(program.compiled)
        head = {"digest": hashlib.sha256(body).hexdigest(), "count": found.num_leaves}
        head |= {"results": program.results, "libraries": program.libraries}
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        files.make_room(path.parent, "*.program", ROOM)
        files.write(path, json.dumps(head).encode() + b"\n" + body)
    except (OSError, ValueError, NotImplementedError, JaxRuntimeError):
        return


# structures -----------------------------------------------------------------------------------------------------------


def _skeleton(x: Any) -> Any:
    """The structure of a result, for a file: of mappings and named tuples of this package. Raises Unknown."""
    if x is None:
        return None
    if isinstance(x, dict):
        return {"keys": sorted(x), "items": [_skeleton(x[key]) for key in sorted(x)]}
    if isinstance(x, tuple):
        return {"class": "" if type(x) is tuple else fingerprint.named(type(x)), "items": [*map(_skeleton, x)]}
    if isinstance(x, jax.Array) or jnp.isscalar(x):
        return 0
    raise Unknown(f"a {type(x).__name__} among the results")


def _rebuilt(skeleton: Any, leaves: Iterator[Any]) -> Any:
    if skeleton is None:
        return None
    if skeleton == 0:
        return next(leaves)
    items = [_rebuilt(one, leaves) for one in skeleton["items"]]
    if "keys" in skeleton:
        return dict(zip(skeleton["keys"], items, strict=True))
    if not skeleton["class"]:
        return tuple(items)
    module, _, name = skeleton["class"].rpartition(".")
    return getattr(importlib.import_module(module), name)(*items)
