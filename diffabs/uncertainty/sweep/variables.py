"""The joint distribution of a sweep's parameters: distributions by path, their correlation, and the sampling design."""

import dataclasses
from collections.abc import Iterator, Mapping

import numpy as np

from diffabs.core.pytree import ParameterSpec
from diffabs.core.types import AnyArray, JsonObject, Matrix, Params, Table
from diffabs.host import values
from diffabs.host.values import (
    as_plain,
    check_sound,
    kebab_case,
    list_reader,
    plain_fields,
    read_any_number,
    table_field,
    table_reader,
)
from diffabs.uncertainty.sweep import distributions, sampling
from diffabs.uncertainty.sweep.discrete import Rows as Rows
from diffabs.uncertainty.sweep.discrete import is_numeric
from diffabs.uncertainty.sweep.distributions import Distribution, describe_out_of_range
from diffabs.uncertainty.sweep.sampling import Grid, LatinHypercube, Random, SamplingDesign, Sobol

MIN_CORRELATION_EIGENVALUE = 1e-10  # below it, the Cholesky factor of a correlation matrix loses its digits
CORRELATION_TOLERANCE = 1e-9  # of entries that must be equal


@dataclasses.dataclass(frozen=True, eq=False)
class Correlation:
    """A Gaussian copula: each variable is the quantile of its distribution at Phi(z), with correlated z.

        z = L n,   L L^T = matrix,   n independent standard normals

    Normal variables without limits are then jointly normal, with these correlations.

    Attributes:
        paths: Correlated variables; all others are independent.
        matrix: Correlation matrix, shape (paths, paths).
    """

    paths: tuple[str, ...]
    matrix: Matrix = table_field(list_reader(list_reader(read_any_number)))

    def correlate(self, z: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Return L z, correlated normals, for independent standard normals z by path."""
        factor = np.linalg.cholesky(np.asarray(self.matrix, float))
        # Term by term: a matrix product may round a sample differently in chunks of different lengths.
        return {
            path: np.add.reduce([factor[i, j] * z[self.paths[j]] for j in range(i + 1)])
            for i, path in enumerate(self.paths)
        }

    def problems(self, name: str, variables: Table | None = None) -> Iterator[str]:
        """Yield an error for each field that is wrong, alone or with these variables."""
        for path in dict.fromkeys(self.paths):
            if self.paths.count(path) > 1:
                yield f"{name}: {path} is named {self.paths.count(path)} times"
            if variables is not None and (path not in variables or isinstance(variables[path], Rows)):
                yield f"{name}: {path} is not a variable with a distribution of its own"
        n = len(self.paths)
        try:
            matrix = np.asarray(self.matrix, float)
        except (TypeError, ValueError):  # ragged, or no numbers
            matrix = np.empty(0)
        if matrix.shape != (n, n):
            yield f"{name}: matrix needs {n} rows of {n} numbers, as many as paths"
        elif not np.isfinite(matrix).all():
            yield f"{name}: matrix is not finite"
        elif not np.allclose(matrix, matrix.T, rtol=0, atol=CORRELATION_TOLERANCE):
            yield f"{name}: matrix is not symmetric"
        elif not np.allclose(np.diag(matrix), 1, rtol=0, atol=CORRELATION_TOLERANCE):
            yield f"{name}: matrix has {np.diag(matrix).tolist()} on its diagonal, not ones"
        elif (smallest := np.linalg.eigvalsh(matrix)[0]) < MIN_CORRELATION_EIGENVALUE:
            low = f"its least eigenvalue is {smallest:.3g}, below {MIN_CORRELATION_EIGENVALUE:g}"
            yield f"{name}: matrix is not positive definite: {low}"


def read_correlation(table: object, where: str) -> Correlation:
    """Return the correlation of a table."""
    return check_sound(values.read_table(Correlation, table, where), where)


def _read_variable(entry: object, where: str) -> Distribution:
    return distributions.read_distribution(entry, where, distributions.DISTRIBUTION_TYPES | {"rows": Rows})


@dataclasses.dataclass(frozen=True, eq=False)
class Space:
    """The variables of a sweep, in the order of the columns of its design.

    Attributes:
        variables: `Distribution` of a parameter by path, or `Rows` of several parameters under any name.
        correlation: Correlation of some variables, or None.
        design: Sampling design.
    """

    variables: Mapping[str, Distribution | Rows] = table_field(table_reader(_read_variable))
    correlation: Correlation | None = table_field(read_correlation, None)
    design: SamplingDesign = table_field(sampling.read_sampling_design, Random)

    @property
    def dimension(self) -> int:
        """Number of uniforms for one sample."""
        return len(self.variables)

    @property
    def paths(self) -> tuple[str, ...]:
        """Paths of the parameters, in order."""
        paths = []
        for name, item in self.variables.items():
            paths += item.columns if isinstance(item, Rows) else [name]
        return tuple(paths)

    def check(self, samples: int | None = None) -> int:
        """Return the number of samples of the design; `samples` is the wanted number, or None.

        Raises:
            ValueError: The space has errors; one line lists all.
        """
        if lines := list(self.problems()):
            raise ValueError("; ".join(lines))
        return self.design.count(self.variables, samples)

    def draw(self, seed: int, start: int, stop: int, samples: int) -> dict[str, np.ndarray]:
        """Return samples start, ..., stop - 1 of `samples` by path, each of shape (stop - start,).

        `seed` selects the points of the design. The space must be valid, see `check`.

        Raises:
            ValueError: The design does not have these samples.
        """
        count = self.design.count(self.variables, samples)
        if not 0 <= start <= stop <= count:
            raise ValueError(f"samples [{start}, {stop}) are outside [0, {count})")
        from scipy.special import ndtri

        design = self.design.over(self.variables) if isinstance(self.design, Grid) else self.design
        u = self._columns(design.unit(seed, start, stop, self.dimension, count))
        z = (
            self.correlation.correlate({name: ndtri(u[name]) for name in self.correlation.paths})
            if self.correlation
            else {}
        )
        drawn = {
            name: item.from_normal(z[name]) if name in z else item.value(u[name])
            for name, item in self.variables.items()
        }
        return _flatten_rows(drawn)

    def normal(self, z: AnyArray) -> dict[str, np.ndarray]:
        """Return the values at independent standard normal coordinates z (n, dimension) by path, each of shape (n,).

        Those of `Uniform`, `Normal`, `LogNormal` and `Triangular` are correct to their last digits in both tails.
        """
        columns = self._columns(np.asarray(z, float))
        columns |= self.correlation.correlate(columns) if self.correlation else {}
        return _flatten_rows({name: item.from_normal(columns[name]) for name, item in self.variables.items()})

    def _columns(self, points: np.ndarray) -> dict[str, np.ndarray]:
        return dict(zip(self.variables, np.ascontiguousarray(points.T), strict=True))

    def problems(self) -> Iterator[str]:
        """Yield an error for each problem of the space."""
        if not self.variables:
            yield "variables are empty: nothing varies"
        lines = [line for name, item in self.variables.items() for line in item.problems(name)]
        yield from lines
        yield from (
            f"{path} is given {n} times" for path in dict.fromkeys(self.paths) if (n := self.paths.count(path)) > 1
        )
        # A design or a correlation examines only valid variables.
        yield from self.design.problems("design", None if lines else self.variables)
        if self.correlation:
            yield from self.correlation.problems("correlation", self.variables)
            if not isinstance(self.design, Random | Sobol | LatinHypercube):
                yield f"correlation: a {kebab_case(type(self.design).__name__)} design needs independent variables"

    def describe_out_of_range(self, specs: Mapping[str, ParameterSpec], prefix: str = "") -> Iterator[str]:
        """Yield a line for each parameter that can leave its range in `specs`; `prefix` stands before its name."""
        for name, item in self.variables.items():
            if isinstance(item, Rows):
                for path, column in item.columns.items():
                    if path in specs and not is_numeric(column):
                        needed = f"a number in {specs[path].interval()} is needed"
                        yield f"{prefix}{name}: column {path} is text; {needed}"
                    elif path in specs and not specs[path].holds(column):
                        reached = f"{np.min(column):g} ... {np.max(column):g}"
                        yield f"{prefix}{name}: column {path} = {reached} leaves {specs[path].interval()}"
            elif name in specs and (line := describe_out_of_range(item, specs[name], prefix + name)):
                yield line

    def table(self) -> JsonObject:
        """Return the space as TOML values, the input of `read_space`."""
        correlation = {"correlation": plain_fields(self.correlation)} if self.correlation else {}
        variables = {name: as_plain(item, brief=True) for name, item in self.variables.items()}
        return {"variables": variables, **correlation, "design": as_plain(self.design, brief=True)}


def read_space(table: object, where: str) -> Space:
    """Return the space of a table with `variables`, and optionally `correlation` and `design`."""
    return values.read_table(Space, table, where)


def _flatten_rows(values: Params) -> dict[str, np.ndarray]:
    """Return the values with `Rows` replaced by their columns."""
    flat = {}
    for name, drawn in values.items():
        flat |= drawn if isinstance(drawn, dict) else {name: drawn}
    return flat
