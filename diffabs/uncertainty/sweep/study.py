"""The definition of a sweep: a loop, its varying parameters, its solver, and its metrics.

Run i is a function of (seed, i), and for a finite design of the number of samples (`sampling`). The design gives its
parameters, and `fold_in(key, i)` its noise. Chunk i // chunk contains it. It does not depend on the process, on the
time, or on which of several equal devices computes it.
"""

import contextlib
import dataclasses
from collections.abc import Callable, Iterator, Mapping

import jax
import numpy as np

from diffabs.compiler import pipeline
from diffabs.core.protocols import Objective
from diffabs.core.pytree import elements, get, parameters, replace
from diffabs.core.types import Bool, Int, JsonObject, Params, Table
from diffabs.core.units import resolve_unit, unit_at, units_of
from diffabs.core.validity import find_problems
from diffabs.engine.drive.engine import REQUESTABLE_ENGINES
from diffabs.engine.solvers import Solver, describe_solver, find_solver_faults
from diffabs.host.values import ScenarioError, as_plain, plain_fields, read_whole, unknown_name_error
from diffabs.loop.admissible import first_refusal
from diffabs.loop.closed_loop import Loop
from diffabs.parts.objectives import default_objectives
from diffabs.uncertainty.sweep.discrete import Categorical
from diffabs.uncertainty.sweep.variables import Space

DTYPES = ("float32", "float64")
RANGES = {"samples": (1, 2**32 - 1), "chunk": (1, 2**20), "seed": (0, 2**32 - 1)}  # keys are folded with 32 bits
# Noise keys fold this into the seed, where the random design folds the number of a sample: the streams never meet.
NOISE_STREAM = 2**32 - 1
FLAG_COLUMNS = ("stopped", "diverged", "refused")


@dataclasses.dataclass(frozen=True, eq=False)
class Study:
    """A complete description of a sweep.

    Attributes:
        loop: Loop with the values of all parameters that do not vary.
        space: Distributions by dotted path, `plant.mass` or `controller.gain.0`, and the design that draws from them.
        samples: Number of samples.
        solver: Solver of each run.
        objectives: Metrics by name; if empty, the usual ones for the plant's signals.
        seed: Seed of parameters and noise.
        chunk: Number of runs that are computed and stored together. Results are equal to the bit for equal `chunk`.
        dtype: "float32" or "float64".
        engine: "xla", "kernel" or "auto" (`simulate.ensemble.run_batch`). `sweep` replaces "auto" by one of the others,
            and a resumed sweep by the one that its manifest records. Results of the two differ in the last bits. Those
            of a kernel also depend on the compiler and the processor, which are part of the sweep's identity.
        parts: For a path drawn by a `Categorical` of names, the part that each name stands for.
        failures: Bounds of metrics; a larger value is a failure. A bound replaces the objective's own (`failure`),
            which otherwise applies. Divergence, and an end that the stop does not call a success, are always failures.
    """

    loop: Loop
    space: Space
    samples: int
    solver: Solver
    objectives: Mapping[str, Objective] = dataclasses.field(default_factory=dict)
    seed: int = 0
    chunk: int = 4096
    dtype: str = "float64"
    engine: str = "auto"
    parts: Mapping[str, Table] = dataclasses.field(default_factory=dict)
    failures: Mapping[str, float] = dataclasses.field(default_factory=dict)

    def __post_init__(self) -> None:
        """Replace empty objectives by the usual ones for the plant's signals, and arrays of one number by numbers."""
        for name in RANGES:
            object.__setattr__(self, name, as_plain(getattr(self, name)))
        if isinstance(self.solver, Solver):
            object.__setattr__(self, "solver", dataclasses.replace(self.solver, **plain_fields(self.solver)))
        if not self.objectives:
            object.__setattr__(self, "objectives", default_objectives(self.loop.plant))

    @property
    def success(self) -> bool:
        """Whether a run succeeds by reaching its stop."""
        return bool(self.loop.stop.success)

    def units(self) -> dict[str, str]:
        """Return the units of the varying parameters and of the metrics, by name, where they are known."""
        loop = units_of(self.loop.plant)
        declared = {
            ".".join([path, *map(str, at)]): unit_at(spec.unit, place, np.size(value))
            for path, spec, value in parameters(self.loop)
            for place, at in enumerate(np.ndindex(np.shape(value)))
        }
        varied = {path: declared[path] for path in self.space.paths if path in declared}
        measured = {
            name: resolve_unit(getattr(objective, "unit", ""), loop) for name, objective in self.objectives.items()
        }
        return {**varied, **{name: unit for name, unit in measured.items() if unit}}

    @property
    def failure_bounds(self) -> dict[str, float]:
        """Bounds of the metrics beyond which a run fails: those of the objectives, replaced by those of the study."""
        declared = {name: getattr(part, "failure", None) for name, part in self.objectives.items()}
        bounds = {name: float(bound) for name, bound in declared.items() if bound is not None}
        return bounds | {name: float(bound) for name, bound in self.failures.items()}

    @property
    def chunks(self) -> int:
        """Number of chunks; the last may be shorter."""
        return -(-self.samples // self.chunk)

    def bounds(self, chunk: int) -> tuple[int, int]:
        """Return the first sample of a `chunk`, and one past its last."""
        return chunk * self.chunk, min((chunk + 1) * self.chunk, self.samples)

    def check(self) -> "Study":
        """Return the study if it is valid.

        Raises:
            ValueError: The study has errors; one line lists all.
        """
        lines = [*self._number_problems(), *self._variable_problems()] or list(find_problems(self.loop))
        if lines:
            raise ValueError("; ".join(dict.fromkeys(lines)))
        return self

    def draw(self, start: int, stop: int) -> dict[str, np.ndarray]:
        """Return the values of samples start, ..., stop - 1 by path, each of shape (stop - start,)."""
        return self.space.draw(self.seed, start, stop, self.samples)

    def lane(self, i: int) -> tuple[Loop, jax.Array]:
        """Return the loop of sample i with its drawn values and parts in float64, and its random key for noise.

        Raises:
            ValueError: The sample is not in the sweep.
        """
        if not 0 <= i < self.samples:
            raise ValueError(f"sample {i} is outside [0, {self.samples - 1}]")
        values = {path: column[0] for path, column in self.draw(i, i + 1).items()}
        with precision("float64"):
            return replace(self.variant(values), self.numbers(values)), noise_key(self.seed, i)

    def accepted_lane(self, i: int) -> tuple[Loop, jax.Array]:
        """Return the `lane` of sample i.

        Raises:
            ValueError: The sample is not in the sweep.
            ScenarioError: It was refused.
        """
        loop, key = self.lane(i)
        if line := first_refusal(loop, {}, self.solver):
            raise ScenarioError(f"sample {i} was refused: {line}")
        return loop, key

    def numbers(self, values: Params) -> JsonObject:
        """Return the `values` by path that are numbers, and not names of parts."""
        return {path: value for path, value in values.items() if path not in self.parts}

    def variant(self, values: Params) -> Loop:
        """Return the loop with the alternative parts that `values` names by path; numbers in `values` are not set."""
        return replace(self.loop, {path: self.parts[path][str(values[path])] for path in self.parts})

    def table(self) -> JsonObject:
        """Return everything that decides the results, as JSON values; without "engine" for XLA.

        Raises:
            NoCompiler: The engine is a kernel, and there is no compiler.
        """
        entries: JsonObject = {name: getattr(self, name) for name in ("samples", "seed", "chunk", "dtype")}
        entries |= {"failures": self.failure_bounds, "success": self.success}
        if self.engine == "kernel":
            entries |= {"engine": {"name": self.engine, **pipeline.describe_kernel_build()}}
        entries |= {"solver": describe_solver(self.solver), "space": self.space.table()}
        return as_plain({**entries, "loop": self.loop, "parts": self.parts, "objectives": self.objectives})

    def _number_problems(self) -> Iterator[str]:
        for name, (low, high) in RANGES.items():
            try:
                read_whole(getattr(self, name), low, high, name)
            except ScenarioError as error:
                yield str(error)
        if self.dtype not in DTYPES:
            yield f"dtype = {self.dtype} is neither {' nor '.join(DTYPES)}"
        if self.engine not in REQUESTABLE_ENGINES:
            yield f"engine = {self.engine} is unknown; there is {', '.join(REQUESTABLE_ENGINES)}"
        yield from find_solver_faults(self.solver)
        for name in {"sample", *FLAG_COLUMNS, *self.space.paths} & self.objectives.keys():
            yield f"objectives.{name}: another column of the table has this name"
        for name, bound in self.failure_bounds.items():
            if name not in self.objectives:
                yield str(unknown_name_error(f"failures.{name} is not measured", name, self.objectives))
            elif not np.isfinite(bound):
                yield f"failures.{name} = {bound} is not a finite number"

    def _variable_problems(self) -> Iterator[str]:
        wrong = list(self.space.problems())
        yield from wrong
        specs = elements(self.loop)
        for path in self.space.paths:
            if path in self.parts:
                yield from _part_problems(path, self.space.variables.get(path), self.parts[path], self.loop)
            elif path not in specs:
                yield str(unknown_name_error(f"{path} is not a parameter of this loop", path, specs))
        yield from (f"parts.{path} has no distribution" for path in self.parts if path not in self.space.paths)
        if not wrong:
            yield from self.space.describe_out_of_range(specs)
            try:
                self.space.design.count(self.space.variables, self.samples)
            except ValueError as error:
                yield str(error)


def _part_problems(path: str, distribution: object, choices: Table, loop: Loop) -> Iterator[str]:
    try:
        get(loop, path)
    except KeyError as error:
        yield str(error.args[0])
    if not isinstance(distribution, Categorical):
        yield f"{path} stands for parts and needs a Categorical of their names"
    else:
        missing = [str(name) for name in distribution.choices if str(name) not in choices]
        if missing:
            yield f"{path}: no part is called {', '.join(missing)}; there is {', '.join(choices)}"
    for name, part in choices.items():
        yield from find_problems(part, f"{path} {name}: ")


@contextlib.contextmanager
def precision(dtype: str) -> Iterator[None]:
    """Set JAX's default type of numbers in this context."""
    with jax.enable_x64(dtype == "float64"):
        yield


def noise_key(seed: Int, i: Int) -> jax.Array:
    """Return the random key for the sensors of sample i."""
    return jax.random.fold_in(jax.random.fold_in(jax.random.key(seed), NOISE_STREAM), i)


def is_accepted(refused: Bool) -> np.ndarray:
    """Return which samples were run, shape (samples,): those whose reason in `refused`, of that shape, is empty."""
    return np.asarray(refused).astype(str) == ""


def failure_masks(
    column: Callable[[str], np.ndarray], bounds: Mapping[str, float], success: bool
) -> dict[str, np.ndarray]:
    """Return which samples failed, as {kind: mask}, each of shape (samples,).

    The kinds are "diverged", a wrong end ("stopped" or "not stopped"), and "METRIC > BOUND". A sample that was not run
    has not failed.
    """
    run = is_accepted(column("refused"))
    kinds = {"diverged": column("diverged"), describe_wrong_end(success): has_wrong_end(column("stopped"), success)}
    kinds |= {f"{name} > {bound:g}": column(name) > bound for name, bound in bounds.items()}
    return {name: failed & run for name, failed in kinds.items()}


def has_wrong_end(stopped: Bool, success: bool) -> np.ndarray:
    """Return which runs had a wrong end, shape (samples,): no stop though it is a success, or one that is not."""
    return np.asarray(stopped) != success


def describe_wrong_end(success: bool) -> str:
    """Return the name of a wrong end: "not stopped" if the stop is a success, else "stopped"."""
    return "not stopped" if success else "stopped"
