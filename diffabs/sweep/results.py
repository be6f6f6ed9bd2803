"""A sweep's folder, opened to be read."""

import hashlib
import pathlib
from collections.abc import Sequence
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from diffabs.sweep.engines import accepted
from diffabs.sweep.store import CHUNKS, NAME, SweepError, read_manifest
from diffabs.sweep.study import FLAGS


class Results:
    """The chunks that are there. One row for each sample: parameters, metrics, `stopped`, `diverged`, `refused`.

    A sample that `simulate` would refuse was not run: `refused` says why, its metrics are NaN, `diverged` is set
    lest it enter a mean, and it is in no statistic.

    The folder `chunks` is a Parquet data set, for `pandas.read_parquet`, `polars.scan_parquet` and DuckDB as it is.
    """

    def __init__(self, folder: str | pathlib.Path):
        """Raises SweepError for a folder that is no sweep."""
        self.folder = pathlib.Path(folder)
        self.manifest = read_manifest(self.folder)
        named = ((NAME.fullmatch(p.name), p) for p in sorted((self.folder / CHUNKS).glob("*.parquet")))
        self.files = {int(name[1]): path for name, path in named if name}
        if not self.files:
            raise SweepError(f"{self.folder} has no finished chunk yet; --resume continues it")

    @property
    def study(self) -> dict[str, Any]:
        """What was swept, as values of JSON."""
        return self.manifest["study"]

    @property
    def complete(self) -> bool:
        """Whether every chunk is there."""
        return len(self.files) == -(-self.study["samples"] // self.study["chunk"])

    @property
    def metrics(self) -> list[str]:
        """Names of what was measured."""
        return list(self.study["objectives"])

    @property
    def variables(self) -> list[str]:
        """Paths of what varies."""
        known = {"sample", *FLAGS, *self.metrics}
        return [name for name in self._schema().names if name not in known]

    def is_number(self, name: str) -> bool:
        """Whether a column holds numbers, not names."""
        kind = self._schema().field(name).type
        return pa.types.is_floating(kind) or pa.types.is_integer(kind)

    def _schema(self) -> pa.Schema:
        return pq.read_schema(next(iter(self.files.values())))

    @property
    def digest(self) -> str:
        """SHA-256 over the contents of all chunks in order: equal for equal tables."""
        whole = hashlib.sha256()
        for chunk in sorted(self.files):
            whole.update(hashlib.sha256(self.files[chunk].read_bytes()).digest())
        return whole.hexdigest()

    def table(self, columns: Sequence[str] | None = None) -> pa.Table:
        """Rows in the order of the samples; some columns, or all."""
        files = [self.files[chunk] for chunk in sorted(self.files)]
        names = list(columns) if columns is not None else None
        return pa.concat_tables([pq.ParquetFile(file).read(columns=names) for file in files]).unify_dictionaries()

    def column(self, name: str) -> np.ndarray:
        """A column in the order of the samples. Raises KeyError."""
        return self.table([name]).column(name).to_numpy()

    def pandas(self) -> Any:
        """A pandas.DataFrame, indexed by sample."""
        return self.table().to_pandas().set_index("sample")

    def polars(self) -> Any:
        """A polars.DataFrame."""
        import polars  # pyright: ignore[reportMissingImports]  # the user has it, or not

        return polars.from_arrow(self.table())

    def xarray(self) -> Any:
        """An xarray.Dataset over the dimension `sample`."""
        return self.pandas().to_xarray()

    @property
    def accepted(self) -> np.ndarray:
        """Which samples were run, in their order."""
        return accepted(self.column("refused"))

    def diverged(self) -> pa.Table:
        """The rows of lanes that were run and diverged: they are in no statistic."""
        return self.table().filter(pa.array(self.column("diverged") & self.accepted))

    def worst(self, metric: str, count: int = 10) -> pa.Table:
        """The rows with the greatest values of a metric, the worst first."""
        values = self.column(metric)
        order = np.argsort(np.where(np.isnan(values), -np.inf, values), kind="stable")[::-1][:count]
        return self.table().take(order)
