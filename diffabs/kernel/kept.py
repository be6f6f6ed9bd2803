"""Functions that were traced and compiled once, kept for the next process beside the libraries that they call.

Tracing a loop, translating it, and what XLA makes of starts and judgements take longer than most runs. The compiled
function is kept under the digest of everything that decides it (`core.fingerprint`). Where nobody can tell that (a part
from outside this package, a file changed since the start) it is traced as ever.

Only this module knows `jax.experimental.serialize_executable`. Such a file is code, as the libraries beside it are."""

import contextlib
import hashlib
import importlib
import itertools
import json
import math
import os
import pathlib
import pickle
import re
import threading
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.errors import JaxRuntimeError
from jax.experimental import serialize_executable

from diffabs.core import files, fingerprint
from diffabs.core.compiling import traced
from diffabs.core.fingerprint import Unknown
from diffabs.kernel import compilers, launch

OFF = "DIFFABS_NO_CACHE"  # if set, nothing is kept
ROOM = 1 << 27  # bytes of programs, some 600; beyond, the older half goes
FOLDER = "programs"  # in that of the libraries


class Program(NamedTuple):
    """What was compiled, of flat arrays to flat arrays; the structure of its results; the libraries that it calls."""

    compiled: Any
    results: Any
    libraries: list[str]


class Kept:
    """A function that `jax.jit` made, as one that is traced once for all processes.

    told: everything that decides it besides its arguments, the function of this package that it was made of included"""

    def __init__(self, function: Any, told: Any):
        """`function` has no static arguments."""
        self.function, self.told = function, told
        self._known: dict[Any, Any] = {}
        self._lock = threading.Lock()

    def __call__(self, *args: Any) -> Any:
        """Return function(*args)."""
        call = None if traced(args) else self._program(args)
        return self.function(*args) if call is None else call(*args)

    def ready(self, *args: Any) -> None:
        """Have it traced for arguments like these, which are numbers; raises what tracing raises."""
        if self._program(args) is None:
            self.function.lower(*args)

    def forget(self) -> None:
        """As if it had never been called."""
        self._known.clear()
        self.function.clear_cache()

    def _program(self, args: Any) -> Callable[..., Any] | None:
        """What to call instead of the function: from the folder, or compiled and put there. None if it cannot be."""
        leaves, tree = jax.tree.flatten(args)
        device = _device(leaves)
        place = (tree, tuple(map(jax.typeof, leaves)), device, jax.config.jax_enable_x64)  # pyright: ignore
        with self._lock:
            if place not in self._known:
                try:
                    self._known[place] = None if device is None else self._found(args, device)
                except Unknown:
                    self._known[place] = None
            return self._known[place]

    def _found(self, args: Any, device: Any) -> Callable[..., Any] | None:
        around = (fingerprint.surroundings(), launch.described(), launch.threads(), str(device))
        path = compilers.cache_folder() / FOLDER / f"{fingerprint.digest(args, (self.told, *around))}.program"
        program = _read(path, len(jax.tree.leaves(args)), device)
        if program is None:
            program = self._compiled(args)
            _write(path, program)
        return _callable(program)

    def _compiled(self, args: Any) -> Program:
        """Raises what tracing raises, Unknown for results of another package."""
        leaves, tree = jax.tree.flatten(args)
        keys, results = [launch.is_key(x) for x in leaves], []

        def kept(*given: Any) -> list[Any]:
            whole = [jax.random.wrap_key_data(x) if key else x for x, key in zip(given, keys, strict=True)]
            found = self.function(*tree.unflatten(whole))
            results[:] = [_skeleton(found)]
            return jax.tree.leaves(found)

        lowered = jax.jit(kept).lower(*map(launch.data, leaves))
        called = sorted(set(re.findall(launch.NAME + r"\w+", lowered.as_text())))
        with _written_nowhere():
            compiled = lowered.compile()
        return Program(compiled, results[0], [launch.path(name).name for name in called])


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
    """The processor that has these arrays. None where what is compiled cannot be kept: on several, or on a GPU, where a
    launch calls Python, which is in no file."""
    homes = {device for x in leaves if isinstance(x, jax.Array) for device in x.devices()} or {jax.devices()[0]}
    device = homes.pop()
    return None if homes or device.platform != "cpu" or os.environ.get(OFF) else device


def _callable(program: Program) -> Callable[..., Any]:
    results = jax.tree.structure(_rebuilt(program.results, itertools.repeat(0)))

    def call(*args: Any) -> Any:
        return results.unflatten(program.compiled(*map(launch.data, jax.tree.leaves(args))))

    return call


# files ----------------------------------------------------------------------------------------------------------------


def _read(path: pathlib.Path, arguments: int, device: Any) -> Program | None:
    """None for one that is not there, is damaged, or whose libraries are gone."""
    try:
        head, _, body = path.read_bytes().partition(b"\n")
        told = json.loads(head)
        if hashlib.sha256(body).hexdigest() != told["digest"]:
            return None
        for name in told["libraries"]:
            launch.register(compilers.cache_folder() / name)
        given, found = jax.tree.structure(((0,) * arguments, {})), jax.tree.structure([0] * told["count"])
        compiled = serialize_executable.deserialize_and_load(
            body, given, found, backend=device.client, execution_devices=[device]
        )
        return Program(compiled, told["results"], told["libraries"])
    except (OSError, ValueError, KeyError, TypeError, pickle.UnpicklingError, compilers.NoCompiler, JaxRuntimeError):
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
