"""Results of a sweep, read from its folder."""

import contextlib
import os
import pathlib
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from diffabs.core.optional import import_optional
from diffabs.core.shapes import Bool, Shaped
from diffabs.core.summary import Summary
from diffabs.core.types import JsonObject, Scalar
from diffabs.host import files
from diffabs.host.values import ScenarioError, unknown_name_error
from diffabs.uncertainty.sweep import seal
from diffabs.uncertainty.sweep.manifest import Seals, read_manifest
from diffabs.uncertainty.sweep.seal import SweepError
from diffabs.uncertainty.sweep.store import list_chunks, read_chunk
from diffabs.uncertainty.sweep.study import FLAG_COLUMNS, failure_masks, is_accepted

if TYPE_CHECKING:
    import pandas
    import xarray


class Results:
    """The finished chunks of a sweep as one table, with a row for each sample.

    The columns are `sample` (its number), parameters, metrics, `stopped`, `diverged` and `refused`. A sample that
    `simulate` would refuse does not run, and `refused` gives the reason. Its metrics are NaN, and `diverged` is set so
    that no mean includes it. No statistic counts it.

    Each file is verified before its first number is used, and again after a change. The folder `chunks` is a Parquet
    data set for `pandas.read_parquet`, `polars.scan_parquet` and DuckDB; these do not verify it.
    """

    def __init__(self, folder: str | pathlib.Path):
        """Open the results in `folder`.

        Raises:
            SweepError: The folder contains no sweep, no finished chunk, or one chunk twice. Methods that read chunks
                raise it for damaged files.
        """
        self.folder: pathlib.Path = pathlib.Path(folder)
        self.manifest: JsonObject = read_manifest(self.folder)
        self._seals = Seals(self.manifest)
        named, strays = list_chunks(self.folder, self._seals.count)
        self.strays: list[pathlib.Path] = strays
        if twice := next((paths for paths in named.values() if len(paths) > 1), None):
            raise SweepError(f"{twice[0]} and {twice[1].name} are the same chunk; --resume finds out which is damaged")
        self.files: dict[int, pathlib.Path] = {chunk: paths[0] for chunk, paths in named.items()}
        self._verified: dict[int, tuple[int, ...]] = {}
        if not self.files:
            raise SweepError(f"{self.folder} has no finished chunk yet; --resume continues it")

    @property
    def study(self) -> JsonObject:
        """Table of the study, as JSON values."""
        return self.manifest["study"]

    @property
    def complete(self) -> bool:
        """Whether every chunk is finished."""
        return len(self.files) == self._seals.count

    @property
    def metrics(self) -> list[str]:
        """Names of the metrics."""
        return list(self.study["objectives"])

    @property
    def units(self) -> dict[str, str]:
        """Units of the columns, by name, where they are known."""
        return dict(self.manifest.get("units", {}))

    def __repr__(self) -> str:
        """Return a summary of the sweep as text."""
        return str(self._summary())

    def _repr_html_(self) -> str:
        return self._summary()._repr_html_()

    def _summary(self) -> Summary:
        run, lost, failed = self.accepted, self.column("diverged"), int(self.failed_samples().sum())
        rows = []
        for name in self.metrics:
            good = self.column(name)[run & ~lost]
            good = good[np.isfinite(good)]  # a run that never settles has an infinite settling time
            spread = (good.mean(), good.min(), good.max()) if len(good) else ("", "", "")
            rows.append((name, *spread, self.units.get(name, "")))
        whole = "" if self.complete else f" of {self.study['samples']}, not complete"
        title = f"Sweep of {len(run)} samples{whole}: {failed} failed, {int((lost & run).sum())} diverged"
        note = f"over {', '.join(self.variables)}; in {self.folder}"
        return Summary(title, ("metric", "mean", "least", "greatest", "unit"), tuple(rows), note)

    @property
    def variables(self) -> list[str]:
        """Paths of the parameters that vary."""
        fixed_columns = {"sample", *FLAG_COLUMNS, *self.metrics}
        return [name for name in self._schema().names if name not in fixed_columns]

    def is_number(self, name: str) -> bool:
        """Return whether the column `name` contains numbers, and not names."""
        kind = self._schema().field(name).type
        return pa.types.is_floating(kind) or pa.types.is_integer(kind)

    def _schema(self) -> pa.Schema:
        with self._open_chunk(min(self.files)) as file:
            return file.schema_arrow

    @contextlib.contextmanager
    def _open_chunk(self, chunk: int) -> Iterator[pq.ParquetFile]:
        """Open a chunk, and verify it unless its file is unchanged since the last verification."""
        path = self.files[chunk]
        state = _file_identity(path)
        if state is not None and self._verified.get(chunk) == state:
            with files.open_regular(path) as file:
                yield pq.ParquetFile(file)
            return
        verified = seal.verify_chunk(read_chunk(path), path, self._seals.of(chunk))
        if state is not None:
            self._verified[chunk] = state
        yield verified

    def _read_table(self, chunk: int, names: list[str] | None) -> pa.Table:
        try:
            with self._open_chunk(chunk) as file:
                return file.read(columns=names).replace_schema_metadata()
        except (pa.ArrowException, OSError) as error:
            raise SweepError(f"{self.files[chunk]} cannot be read: {' '.join(str(error).split())}") from None

    @property
    def digest(self) -> str:
        """SHA-256 over the contents of all chunks in order; equal for equal tables with chunks of one size."""
        return seal.tables_digest(self._read_table(chunk, None) for chunk in sorted(self.files))

    def failures(self) -> dict[str, Bool[np.ndarray, " runs"]]:
        """Return which samples failed, as {kind: mask}, each of shape (samples,).

        The kinds are "diverged", a wrong end ("stopped" or "not stopped"), and "METRIC > BOUND". A sample may have
        several. A refused sample has not failed.
        """
        return failure_masks(self.column, self.study["failures"], self.study["success"])

    def failed_samples(self) -> Bool[np.ndarray, " runs"]:
        """Return which samples failed, of any kind, shape (samples,)."""
        return np.any(list(self.failures().values()), axis=0)

    def table(self, columns: Sequence[str] | None = None) -> pa.Table:
        """Return the rows in the order of the samples, with some `columns` or all.

        Raises:
            ScenarioError: No column has one of the names.
        """
        names, available = list(columns) if columns is not None else None, self._schema().names
        for name in names or ():
            if name not in available:
                raise unknown_name_error(f"{name} is no column of {self.folder}", name, available)
        return pa.concat_tables([self._read_table(chunk, names) for chunk in sorted(self.files)]).unify_dictionaries()

    def column(self, name: str) -> Shaped[np.ndarray, " runs"]:
        """Return the column `name` in the order of the samples, shape (samples,).

        Raises:
            ScenarioError: No column has this name.
        """
        return self.table([name]).column(name).to_numpy()

    def pandas(self) -> "pandas.DataFrame":
        """Return a pandas.DataFrame indexed by sample, with a column `failed`, and units in `attrs["units"]`."""
        import_optional("pandas")
        frame = self.table().to_pandas().set_index("sample").assign(failed=self.failed_samples())
        frame.attrs["units"] = self.units
        return frame

    def polars(self) -> Scalar:
        """Return a polars.DataFrame with a column `failed`."""
        polars = import_optional("polars")
        frame = polars.from_arrow(self.table())
        return frame.with_columns(polars.Series("failed", self.failed_samples()))

    def xarray(self) -> "xarray.Dataset":
        """Return an xarray.Dataset over the dimension `sample`, with `units` at its variables."""
        import_optional("xarray")
        data = self.pandas().to_xarray()
        for name, unit in self.units.items():
            if name in data:
                data[name].attrs["units"] = unit
        return data

    @property
    def accepted(self) -> Bool[np.ndarray, " runs"]:
        """Mask of the samples that were run, in their order, shape (samples,)."""
        return is_accepted(self.column("refused"))

    def diverged_rows(self) -> pa.Table:
        """Return the rows of the diverged runs, which no statistic includes."""
        return self.table().filter(pa.array(self.column("diverged") & self.accepted))

    def worst(self, metric: str, count: int = 10) -> pa.Table:
        """Return the `count` rows with the largest values of a `metric`, the largest first; NaN comes last.

        Raises:
            ScenarioError: No column has this name, or its values are texts.
        """
        values = self.column(metric)
        if values.dtype.kind == "O":
            raise ScenarioError(f"{metric} holds texts; a column of numbers is needed")
        order = np.argsort(np.where(np.isnan(values), -np.inf, values), kind="stable")[::-1][:count]
        return self.table().take(order)


def _file_identity(path: pathlib.Path) -> tuple[int, ...] | None:
    """Return numbers that change with the file, or None if the file cannot be examined."""
    with contextlib.suppress(OSError):
        status = os.stat(path)
        return status.st_dev, status.st_ino, status.st_size, status.st_mtime_ns, status.st_ctime_ns
    return None
