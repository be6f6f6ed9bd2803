"""A traced run whose engine is chosen where its number of runs is known: the primitives `run` and `run_derivative`.

`jax.vmap`, `jax.jvp` and `jax.grad` see one run at a time. So a run inside a transformation is bound as a primitive,
and its rules decide as late as JAX allows:

    values                 when XLA compiles the program: a kernel for a batch, XLA for a single run
    forward mode           when XLA compiles the program: a kernel
    reverse mode           when JAX linearizes: a kernel's Jacobian, by forward directions, if a run has few inputs;
                           a kernel's backward sweep, if a run with adaptive steps has more than one launch has
                           directions; else XLA's vector-Jacobian product
    second derivatives     XLA

Where a kernel is impossible, XLA makes everything.

`run_derivative` returns values and tangents together, so that a kernel computes values and up to eight tangents in one
launch. Reverse mode needs no transpose of a kernel: the Jacobian of each run is computed with its values, and JAX
transposes its product with the tangents. A number that all runs share counts as one input, and `jax.vmap` sums its
cotangents.

`levels` has one entry for each `jax.vmap` around the primitive, the innermost first: a tuple with True for each
argument that has an axis of it. An argument that all runs share has none, so it stays one number in the kernel's
registers. An axis of tangents only adds directions, not runs.
"""

import functools
import logging
import math
import os
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import jax
import jax.extend.core as jex
import jax.numpy as jnp
import numpy as np
from jax.core import ShapedArray, Tracer
from jax.interpreters import ad, batching, mlir
from jax.interpreters import partial_eval as pe
from jax.sharding import NamedSharding, PartitionSpec

from diffabs.core.jax_flags import default_flags
from diffabs.core.types import Array, PyTree
from diffabs.engine.drive.engine import EngineError, check_process, describe_engine, is_forked
from diffabs.engine.hybrid import Finish
from diffabs.engine.step.adaptive import AdaptiveStepping
from diffabs.host.process import default_platform

MIN_RUNS = 2  # runs whose values a kernel makes on a processor: one run waits longer for its compiler than for XLA
MIN_SWEEP_INPUTS = 9  # inputs of a run from which a kernel's sweep costs less than its Jacobian, then of two launches
MAX_DIRECTIONS = 32  # inputs of a run up to which a kernel's Jacobian costs about what XLA's reverse mode does
MANY_INPUTS_REASON = f"a run has more than {MAX_DIRECTIONS} inputs"
MAX_KEPT_PROGRAMS = 64  # traced kernels that are kept, by the structure and the shapes of their runs

Leaves = Sequence[PyTree]
Function = Callable[..., list[PyTree]]  # of flat arrays
Levels = tuple[tuple[bool, ...], ...]
log = logging.getLogger("diffabs")


class DeferredRun(NamedTuple):
    """What is known of a run while it is traced; equal for two runs that differ in numbers only.

    Attributes:
        structure: Structure of (system, objectives, method, key).
        key_kinds: For each leaf the implementation of its random key, or None for an array.
        results: Shapes and types of the leaves of the result of one run.
        plan: What `by_xla` needs besides the run: a hashable object with an attribute `finish`, the function that
            returns the result from system, objectives and the last carry.
        by_xla: Function of the plan and the run that returns the result by XLA, with both modes of derivatives.
        required: True if the engine is "kernel": XLA makes none of its values and first derivatives.
    """

    structure: Any
    key_kinds: tuple[Any, ...]
    results: tuple[jax.ShapeDtypeStruct, ...]
    plan: Any
    by_xla: Callable[[Any, PyTree], PyTree]
    required: bool

    @property
    def adaptive(self) -> bool:
        """True if the steps are adaptive: then a kernel has a backward sweep."""
        _, _, method, _ = jax.tree.unflatten(self.structure, range(len(self.key_kinds)))
        return isinstance(method, AdaptiveStepping)

    def call_xla(self, *leaves: Array) -> list[PyTree]:
        """Return the leaves of the run by XLA."""
        return jax.tree.leaves(self.by_xla(self.plan, _rebuild(self.structure, self.key_kinds, leaves)))

    def call_kernel(self, *leaves: Array) -> list[PyTree]:
        """Return the leaves of the run by a kernel; `Unsupported` or `NoCompiler` if that is impossible."""
        from diffabs.engine.drive.kernel import run_single  # `import diffabs` must not need the compiler

        hybrid, objectives, method, key = _rebuild(self.structure, self.key_kinds, leaves)
        return jax.tree.leaves(run_single(hybrid, objectives, method, self.plan.finish, key))


def run_deferred(by_xla: Callable[[Any, PyTree], PyTree], plan: Any, run: PyTree, required: bool = False) -> PyTree:
    """Return by_xla(plan, run), or the same result by a kernel; the arguments are those of `DeferredRun`.

    A kernel that is `required` and impossible is an EngineError at the time at which XLA compiles the program.
    """
    leaves, structure = jax.tree.flatten(run)
    if any(jnp.issubdtype(getattr(x, "dtype", float), jnp.complexfloating) for x in leaves):
        return by_xla(plan, run)  # a kernel has real numbers, and unit tangents are real
    is_key = [jnp.issubdtype(getattr(x, "dtype", float), jax.dtypes.prng_key) for x in leaves]
    kinds = tuple(jax.random.key_impl(x) if on else None for x, on in zip(leaves, is_key, strict=True))
    words = [jax.random.key_data(x) if on else jnp.asarray(x) for x, on in zip(leaves, is_key, strict=True)]
    words = _vary_alike(words)
    result = _result_shape(structure, kinds, plan.finish, tuple(map(_type, words)))
    deferred = DeferredRun(structure, kinds, tuple(jax.tree.leaves(result)), plan, by_xla, required)
    return jax.tree.unflatten(jax.tree.structure(result), _Call(deferred, ()).bind(*words))


@functools.lru_cache(MAX_KEPT_PROGRAMS)
def _result_shape(structure: object, kinds: tuple[Any, ...], finish: Finish, leaves: tuple[Any, ...]) -> PyTree:
    """Return the result of one run as shapes: that of a run which is over before its first step."""

    def finish_at_start(*leaves: Array) -> PyTree:
        hybrid, objectives, method, key = _rebuild(structure, kinds, leaves)
        hybrid, further = hybrid.prepare_run()
        objectives = {**objectives, **further}
        return finish(hybrid, objectives, method.start(hybrid, objectives, key))[0]

    return jax.tree.map(_type, jax.eval_shape(finish_at_start, *leaves))


def _rebuild(structure: object, kinds: tuple[Any, ...], leaves: Leaves) -> tuple[PyTree, PyTree, PyTree, PyTree]:
    """Return (system, objectives, method, key) of the leaves, whose random keys are words."""
    pairs = zip(leaves, kinds, strict=True)
    return jax.tree.unflatten(
        structure, [x if kind is None else jax.random.wrap_key_data(x, impl=kind) for x, kind in pairs]
    )


def _vary_alike(arrays: Leaves) -> list[PyTree]:
    """Return arrays that all vary between the devices of `jax.shard_map` if one does: JAX adds up the cotangents."""
    axis_sets = [_varying_axes(jax.typeof(x)) for x in arrays]
    every = frozenset().union(*axis_sets)
    return [
        jax.lax.pcast(x, tuple(every - axes), to="varying") if every - axes else x
        for x, axes in zip(arrays, axis_sets, strict=True)
    ]


def _varying_axes(kind: Any) -> frozenset[Any]:
    # The attribute's name depends on JAX's version.
    return kind.mat.varying if hasattr(kind, "mat") else kind.vma


def _type(x: Any) -> jax.ShapeDtypeStruct:
    return jax.ShapeDtypeStruct(jnp.shape(x), x.dtype)


def _is_real(x: Any) -> bool:
    return jnp.issubdtype(x.dtype, jnp.floating)


run_primitive = jex.Primitive("run")
derivative_primitive = jex.Primitive("run_derivative")
run_primitive.multiple_results = derivative_primitive.multiple_results = True


class _Call(NamedTuple):
    """Parameters of one of the primitives.

    Attributes:
        deferred: The run.
        levels: Levels of vmap.
        tangent_leaves: Numbers of the leaves that have a tangent, in the order of the tangents, which follow the
            leaves among the arguments; None for `run`.
    """

    deferred: DeferredRun
    levels: Levels
    tangent_leaves: tuple[int, ...] | None = None

    def bind(self, *arrays: PyTree) -> list[PyTree]:
        """Bind the primitive of this call."""
        named = {"deferred": self.deferred, "levels": self.levels}
        if self.tangent_leaves is None:
            return run_primitive.bind(*arrays, **named)
        return derivative_primitive.bind(*arrays, **named, tangent_leaves=self.tangent_leaves)

    @property
    def leaf_count(self) -> int:
        """Number of leaves."""
        return len(self.deferred.key_kinds)

    def has_own_runs(self, level: tuple[bool, ...]) -> bool:
        """Return whether runs differ in this level; else only tangents do, and it adds directions."""
        return any(level[: self.leaf_count])

    def vectorize(self, run: Function) -> Function:
        """Return `run`, a function of the leaves of one run, as a function of the arguments of the primitive."""

        def derivative(*arrays: Array) -> tuple[list[PyTree], list[PyTree]]:
            leaves, tangents = arrays[: self.leaf_count], arrays[self.leaf_count :]
            if self.tangent_leaves is None:
                return run(*leaves), []
            values, rates = _push_forward(run, leaves, self.tangent_leaves, tangents)
            return values, [rate for value, rate in zip(values, rates, strict=True) if _is_real(value)]

        function = derivative
        for level in self.levels:
            axes = tuple(0 if mapped else None for mapped in level)
            function = jax.vmap(function, in_axes=axes, out_axes=(0 if self.has_own_runs(level) else None, 0))

        def flat(*arrays: Array) -> list[PyTree]:
            values, rates = function(*arrays)
            return [*values, *rates]

        return flat

    def split(self, results: Sequence[Any]) -> tuple[list[Any], list[Any]]:
        """Return the values among the results, and the tangents of the real ones."""
        count = len(self.deferred.results)
        return list(results[:count]), list(results[count:])

    def result_types(self, *arguments: ShapedArray) -> list[ShapedArray]:
        """Return shapes and types of the results for those of the arguments."""
        sizes = self.level_sizes(arguments)[::-1]  # the outermost level is the first axis
        runs = [size for size, level in zip(sizes, self.levels[::-1], strict=True) if self.has_own_runs(level)]

        def type_result(axes: list[int], result: jax.ShapeDtypeStruct) -> ShapedArray:
            shape = (*axes, *result.shape)
            if not any(map(_varying_axes, arguments[:1])):
                return ShapedArray(shape, result.dtype)
            # A result varies between the devices of `jax.shard_map` as the leaves do.
            place = NamedSharding(arguments[0].sharding.mesh, PartitionSpec(*(None for _ in shape)))
            return arguments[0].update(shape=shape, dtype=result.dtype, weak_type=False, sharding=place)

        values = [type_result(runs, x) for x in self.deferred.results]
        if self.tangent_leaves is None:
            return values
        return values + [type_result(sizes, x) for x in self.deferred.results if _is_real(x)]

    def level_sizes(self, arguments: Sequence[Any]) -> list[int]:
        """Return the number of members of each level, the innermost first."""
        sizes = []
        for number, level in enumerate(self.levels):
            argument = level.index(True)
            sizes.append(arguments[argument].shape[sum(outer[argument] for outer in self.levels[number + 1 :])])
        return sizes

    def count_runs(self, arguments: Sequence[Any]) -> int:
        """Return the number of runs."""
        sizes = zip(self.level_sizes(arguments), self.levels, strict=True)
        return math.prod(size for size, level in sizes if self.has_own_runs(level))

    def count_directions(self, arguments: Sequence[Any]) -> int:
        """Return the number of tangents of a run; 0 for values."""
        if self.tangent_leaves is None:
            return 0
        sizes = zip(self.level_sizes(arguments), self.levels, strict=True)
        return math.prod(size for size, level in sizes if not self.has_own_runs(level))


def _push_forward(
    function: Function, primals: Leaves, places: Sequence[int], tangents: Leaves
) -> tuple[list[PyTree], list[PyTree]]:
    """Return values and tangents of a function, for tangents of the arguments `places`; the others are constants."""

    def call_with(arguments: list[PyTree]) -> list[PyTree]:
        return function(*_replace_leaves(primals, places, arguments))

    return jax.jvp(call_with, ([primals[i] for i in places],), (list(tangents),))


def _replace_leaves(leaves: Leaves, places: Sequence[int], new: Leaves) -> list[PyTree]:
    by_place = dict(zip(places, new, strict=True))
    return [by_place.get(i, x) for i, x in enumerate(leaves)]


# The kernel of a call: its program, or the reason against it.


@functools.lru_cache(MAX_KEPT_PROGRAMS)
def _trace_kernel(
    call: _Call, arguments: tuple[jax.ShapeDtypeStruct, ...], platform: str, compiler: str | None
) -> str | jex.ClosedJaxpr:
    """Return the call by a kernel as a closed jaxpr whose kernels are built, or one line on why that is impossible."""
    del platform, compiler  # parts of the key: on another device, or with another compiler, the answer may differ
    from diffabs.compiler.lower.rules import Unsupported
    from diffabs.compiler.runtime.jax_primitive import build_launches
    from diffabs.compiler.runtime.toolchain import NoCompiler

    try:
        program = jax.make_jaxpr(call.vectorize(call.deferred.call_kernel))(*arguments)
        build_launches(program.jaxpr)
    except (Unsupported, NoCompiler) as error:
        return str(error)
    return program


def _find_kernel(call: _Call, arguments: Sequence[Any], objection: str) -> tuple[Any, str]:
    """Return the closed jaxpr of a kernel for this call and "", or None and the reason for which XLA makes it.

    `objection` is a reason against a kernel that is already known, or "". A kernel that is required and impossible is
    an EngineError.
    """
    from diffabs.compiler.runtime.toolchain import COMPILER

    required, program = call.deferred.required, None
    if required:
        check_process()
    single = call.tangent_leaves is None and call.count_runs(arguments) < MIN_RUNS
    if not objection and single and default_platform() == "cpu" and not required:
        objection = "the values of a single run would wait for its compiler"
    if not objection:
        program = _trace_kernel(call, tuple(map(_type, arguments)), default_platform(), os.environ.get(COMPILER))
        if isinstance(program, str):
            objection, program = program, None
    if objection and required:
        raise EngineError.of(objection)
    return program, objection


@functools.cache  # a line once, since JAX may ask for an engine several times
def _log_choice(subject: str, objection: str) -> None:
    engine = f"XLA, not a kernel: {objection}" if objection else f"a kernel ({describe_engine('kernel')['compiler']})"
    log.info("%s: %s", subject, engine)


def find_kernels(program: jex.ClosedJaxpr) -> list[tuple[Any, str]]:
    """Return for each run of a traced program its kernel's closed jaxpr and "", or None and the reason for XLA.

    The kernels are built. A reverse mode by XLA has no run left in its program.
    """
    return [
        _find_kernel(_Call(**run.params), [x.aval for x in run.invars], _placement_objection((), 1))
        for run in _run_equations(program.jaxpr)
    ]


def _run_equations(jaxpr: jex.Jaxpr) -> Iterator[Any]:
    for equation in jaxpr.eqns:
        if equation.primitive in (run_primitive, derivative_primitive):
            yield equation
    for inner in jex.subjaxprs(jaxpr):
        yield from _run_equations(inner)


def _placement_objection(platforms: Sequence[str], devices: int) -> str:
    """Return why a program for these platforms and number of devices cannot call a kernel, or ""."""
    if devices > 1:
        return "the runs lie on several devices"
    home = default_platform()
    if any(platform not in (home, {"gpu": "cuda"}.get(home, home)) for platform in platforms):
        return f"the program is for {', '.join(platforms)}, and kernels are made for JAX's default device, {home}"
    if is_forked():
        return "the process was forked after JAX had started"
    return ""


@default_flags()
def _lower(context: Any, *operands: Any, **named: Any) -> Any:
    """Return the operations of a call: of its kernel, or of XLA's program."""
    call = _Call(**named)
    module = context.module_context
    devices = getattr(module.axis_context, "num_devices", None) or 1
    program, objection = _find_kernel(call, context.avals_in, _placement_objection(module.platforms, devices))
    runs, directions = call.count_runs(context.avals_in), call.count_directions(context.avals_in)
    subject = f"{runs} run{'s' * (runs > 1)}"
    if directions:
        subject += f" with {directions} derivative{'s' * (directions > 1)}"
    _log_choice(subject, objection)
    function = call.vectorize(call.deferred.call_xla) if program is None else jex.jaxpr_as_fun(program)
    return mlir.lower_fun(function, multiple_results=True)(context, *operands)


@functools.lru_cache(MAX_KEPT_PROGRAMS)
def _compile_call(call: _Call) -> Callable[..., list[PyTree]]:
    # Eager calls of one structure share one compiled program.
    return jax.jit(call.bind)


@default_flags()
def _evaluate(*arrays: Array, **named: Any) -> list[PyTree]:
    """Return the results of an eager call, compiled; under `jax.disable_jit` by XLA's single operations."""
    call = _Call(**named)
    without_jit = jax.config.jax_disable_jit  # pyright: ignore
    function = call.vectorize(call.deferred.call_xla) if without_jit else _compile_call(call)
    return function(*arrays)


@default_flags()
def _add_level(
    arrays: Sequence[PyTree], axes: Sequence[int | None], **named: Any
) -> tuple[list[PyTree], list[int | None]]:
    """Return the results under one more vmap, whose axis comes first in the arguments and results that have it."""
    call = _Call(**named)
    mapped = tuple(axis is not None for axis in axes)
    arrays = [x if axis is None else jnp.moveaxis(x, axis, 0) for x, axis in zip(arrays, axes, strict=True)]
    results = call._replace(levels=(*call.levels, mapped)).bind(*arrays)
    values, rates = call.split(results)
    return results, [0 if call.has_own_runs(mapped) else None] * len(values) + [0] * len(rates)


@default_flags()
def _differentiate(primals: Leaves, tangents: Leaves, **named: Any) -> tuple[PyTree, PyTree]:
    """Return values and tangents of `run`, by one call of `run_derivative`."""
    call = _Call(**named)
    pairs = zip(primals, tangents, strict=True)
    tangent_leaves = tuple(i for i, (x, dx) in enumerate(pairs) if _has_real_tangent(x, dx))
    if not tangent_leaves:
        values = call.bind(*primals)
        return values, [_zero(x) for x in values]
    # A tangent has the axes of its leaf.
    levels = tuple((*level, *(level[i] for i in tangent_leaves)) for level in call.levels)
    derivative = _Call(call.deferred, levels, tangent_leaves)
    values, rates = derivative.split(derivative.bind(*primals, *(tangents[i] for i in tangent_leaves)))
    real_rates = iter(rates)
    return values, [next(real_rates) if _is_real(x) else _zero(x) for x in values]


@default_flags()
def _differentiate_twice(primals: Leaves, tangents: Leaves, **named: Any) -> tuple[PyTree, PyTree]:
    """Return results and tangents of `run_derivative`, by XLA."""
    call = _Call(**named)
    places = [i for i, (x, dx) in enumerate(zip(primals, tangents, strict=True)) if _has_real_tangent(x, dx)]
    return _push_forward(call.vectorize(call.deferred.call_xla), primals, places, [tangents[i] for i in places])


def _has_real_tangent(x: object, tangent: object) -> bool:
    return type(tangent) is not ad.Zero and _is_real(x)


def _zero(x: object) -> ad.Zero:
    return ad.Zero(jax.typeof(x).to_tangent_aval())


@default_flags()
def _linearize(trace: Any, *tracers: Any, **named: Any) -> Sequence[Any]:
    """Return the results of `run_derivative` for known leaves and unknown tangents: known values and linear tangents.

    JAX asks for it in `jax.grad`, `jax.vjp` and `jax.linearize`.
    """
    call = _Call(**named)
    known_values = [tracer.pval.get_known() for tracer in tracers]
    leaves, tangents = known_values[: call.leaf_count], tracers[call.leaf_count :]
    if any(x is None for x in leaves) or all(x is not None for x in known_values):
        return trace.default_process_primitive(derivative_primitive, tracers, named)
    if results := _sweep(trace, call, tracers):
        return results
    if not _has_cheap_jacobian(call, leaves):
        with jex.set_current_trace(trace):
            return [trace.to_jaxpr_tracer(x) for x in call.vectorize(call.deferred.call_xla)(*tracers)]
    wider, units = _unit_tangents(call, leaves)
    values, jacobian = wider.split(wider.bind(*leaves, *units))
    with jex.set_current_trace(trace):
        rates = _multiply(call, jacobian, tangents)
    return [trace.to_jaxpr_tracer(x) for x in (*values, *rates)]


@default_flags()
def _split_for_checkpoint(
    saveable: Any, unknown: Sequence[bool], staged: Sequence[bool], equation: Any
) -> tuple[Any, Any, list[bool], list[bool], list[Any]]:
    """Return an equation of known values, the whole equation for the backward pass, and what that needs.

    `jax.checkpoint` asks for it, where tangents are unknown and values must be known.
    """
    del saveable  # the backward pass computes the run again from its arguments
    call = _Call(**equation.params)
    arguments, results = list(equation.invars), list(equation.outvars)
    residuals = [x for x, is_staged in zip(arguments, staged, strict=True) if not is_staged and isinstance(x, jex.Var)]
    values, _ = call.split(results)
    if not any(unknown):
        return equation, None, [False] * len(results), [False] * len(results), []
    if any(unknown[: call.leaf_count]):
        return None, equation, [True] * len(results), [True] * len(results), residuals

    def compute_values(*leaves: PyTree) -> list[PyTree]:
        tangents = [jnp.zeros(x.aval.shape, x.aval.dtype) for x in arguments[call.leaf_count :]]
        return call.split(call.bind(*leaves, *tangents))[0]

    leaves = arguments[: call.leaf_count]
    program = jax.make_jaxpr(compute_values)(*(_type(x.aval) for x in leaves))
    known_equation = jex.new_jaxpr_eqn(
        leaves, values, jex.primitives.closed_call_p, {"call_jaxpr": program}, program.effects, equation.source_info
    )
    unknown_results = [i >= len(values) for i in range(len(results))]
    return known_equation, equation, unknown_results, [True] * len(results), residuals


def _sweep(trace: Any, call: _Call, tracers: Leaves) -> list[Any]:
    """Return what `_linearize` does by a kernel, which JAX then transposes.

    Return [] if a kernel cannot, or if something else costs less: few inputs, or fixed steps.
    """
    from diffabs.compiler.lower.rules import Unsupported
    from diffabs.compiler.runtime.toolchain import NoCompiler

    leaves = [tracer.pval.get_known() for tracer in tracers[: call.leaf_count]]
    few = _count_inputs(call, leaves) < MIN_SWEEP_INPUTS
    if few or not call.deferred.adaptive or any(map(_has_tangent, leaves)) or _placement_objection((), 1):
        return []
    try:
        with jex.set_current_trace(trace):
            results = [trace.to_jaxpr_tracer(x) for x in call.vectorize(call.deferred.call_kernel)(*tracers)]
    except (Unsupported, NoCompiler):
        return []
    _log_choice("reverse mode", "")
    return results


def _has_cheap_jacobian(call: _Call, leaves: Leaves) -> bool:
    """Return whether a kernel's Jacobian of each run costs less than XLA's vector-Jacobian product."""
    directions, objection = _count_inputs(call, leaves), _placement_objection((), 1)
    if not call.deferred.required and any(map(_has_tangent, leaves)):
        objection = objection or "it has second derivatives"
    if not call.deferred.required and directions > MAX_DIRECTIONS:
        objection = objection or MANY_INPUTS_REASON
    if objection and not call.deferred.required:
        _log_choice("reverse mode", objection)  # before unit vectors take memory, the square of the directions
        return False
    wider, units = _unit_tangents(call, leaves)
    program, objection = _find_kernel(wider, [*leaves, *units], objection)
    if objection:
        _log_choice("reverse mode", objection)
    return program is not None


def _count_inputs(call: _Call, leaves: Leaves) -> int:
    """Return the number of inputs of one run that have a tangent."""
    return sum(map(math.prod, _input_shapes(call, leaves)))


def _input_shapes(call: _Call, leaves: Leaves) -> list[tuple[int, ...]]:
    """Return the shapes of the leaves that have a tangent, in one run."""
    return [leaves[i].shape[sum(level[i] for level in call.levels) :] for i in call.tangent_leaves or ()]


def _has_tangent(x: object) -> bool:
    """Return whether a derivative around this one has a tangent of x: then the Jacobian is differentiated, by XLA."""
    while isinstance(x, Tracer):
        # JAX exports no classes of its tracers: those of derivatives have `tangent` and `primal`, that of vmap `val`.
        if hasattr(x, "tangent"):
            return True
        x = getattr(x, "val", None)
    return False


def _unit_tangents(call: _Call, leaves: Leaves) -> tuple[_Call, list[np.ndarray]]:
    """Return the call for all directions of one run, and the tangents: unit vectors, which all runs share."""
    tangent_leaves, shapes = call.tangent_leaves or (), _input_shapes(call, leaves)
    counts = [math.prod(shape) for shape in shapes]
    columns = np.split(np.eye(sum(counts)), np.cumsum(counts)[:-1], axis=1)
    units = [
        column.reshape(len(column), *shape).astype(leaves[i].dtype)
        for i, shape, column in zip(tangent_leaves, shapes, columns, strict=True)
    ]
    levels = [(*level[: call.leaf_count], *(False for _ in tangent_leaves)) for level in call.levels]
    levels.append((*(False for _ in leaves), *(True for _ in tangent_leaves)))
    return call._replace(levels=tuple(levels)), units


def _multiply(call: _Call, jacobian: list[PyTree], tangents: Leaves) -> list[PyTree]:
    """Return the products of each run's Jacobian, shape (directions, ...) for each result, with its tangents."""

    def product(jacobian: list[PyTree], tangents: list[PyTree]) -> list[PyTree]:
        flat = jnp.concatenate([jnp.ravel(x) for x in tangents])
        return [jnp.tensordot(flat, columns, 1, precision="highest") for columns in jacobian]

    function = product
    for level in call.levels:
        # The directions are the Jacobian's first axis, so that of a level is the second one.
        has_runs, axes = call.has_own_runs(level), [0 if mapped else None for mapped in level[call.leaf_count :]]
        function = jax.vmap(function, in_axes=(1 if has_runs else None, axes))
    return function(jacobian, list(tangents))


@default_flags()
def _transpose(cotangents: Sequence[PyTree], *arguments: Array, **named: Any) -> list[PyTree]:
    """Return the cotangents of the tangents of a `run_derivative` that JAX has staged as it is."""
    call = _Call(**named)
    unknown = [i for i, x in enumerate(arguments) if ad.is_undefined_primal(x)]
    types = [jax.ShapeDtypeStruct(arguments[i].aval.shape, arguments[i].aval.dtype) for i in unknown]

    def rates(*tangents: Array) -> list[PyTree]:
        return call.split(call.vectorize(call.deferred.call_xla)(*_replace_leaves(arguments, unknown, tangents)))[1]

    _, cotangents = call.split(cotangents)
    real_cotangents = [ad.instantiate_zeros(x) for x in cotangents]
    transposed = dict(zip(unknown, jax.linear_transpose(rates, *types)(real_cotangents), strict=True))
    return [transposed.get(i) for i in range(len(arguments))]


for _primitive in (run_primitive, derivative_primitive):
    _primitive.def_impl(_evaluate)
    _primitive.def_abstract_eval(lambda *types, **named: _Call(**named).result_types(*types))
    mlir.register_lowering(_primitive, _lower)
batching.primitive_batchers[run_primitive] = _add_level
batching.primitive_batchers[derivative_primitive] = _add_level
ad.primitive_jvps[run_primitive] = _differentiate
ad.primitive_jvps[derivative_primitive] = _differentiate_twice
ad.primitive_transposes[derivative_primitive] = _transpose
pe.custom_partial_eval_rules[derivative_primitive] = _linearize
pe.partial_eval_jaxpr_custom_rules[derivative_primitive] = _split_for_checkpoint
