"""Columns of numbers in files: CSV with names in its first line, or Parquet."""

import decimal
import pathlib

import numpy as np
import pyarrow as pa
import pyarrow.csv as pc
import pyarrow.parquet as pq

from diffabs.host import files
from diffabs.host.separated import read_decimal
from diffabs.host.values import unknown_name_error

# Of bytes: a thread of pyarrow that still holds an open Python file ends the process when Python ends.
TABLE_READERS = {".csv": pc.read_csv, ".parquet": pq.read_table}


def read_column(path: pathlib.Path, column: str) -> np.ndarray:
    """Return a column of numbers of a .csv or .parquet file as float64, shape (rows,)."""
    if path.suffix.lower() not in TABLE_READERS:
        raise ValueError(f"{path} is neither {' nor '.join(TABLE_READERS)}")
    try:
        with files.open_regular(path) as file:
            data = pa.BufferReader(file.read())
        table = TABLE_READERS[path.suffix.lower()](data)
        names = table.column_names
    except OSError as error:
        raise ValueError(f"cannot read {path}: {error.strerror or str(error).splitlines()[0]}") from None
    except (pa.ArrowException, UnicodeDecodeError) as error:
        raise ValueError(f"{path} is no {path.suffix[1:]} file: {str(error).splitlines()[0]}") from None
    if column not in names:
        raise unknown_name_error(f"{path} has no column {column}", column, names)
    if (count := names.count(column)) > 1:
        raise ValueError(f"{path} has {count} columns called {column}; one is needed")
    values, where = table.column(column), f"{path}, column {column}"
    if len(values) == 0:
        raise ValueError(f"{where} is empty")
    numbers = np.array([_parse_number(value) for value in values.to_pylist()])
    wrong = np.flatnonzero(~np.isfinite(numbers))
    if len(wrong):
        raise ValueError(f"{where}: {values[wrong[0]].as_py()!r} in row {wrong[0] + 1} is no finite number")
    return numbers


def _parse_number(value: object) -> float:
    """Return a value as a float; NaN for a missing value, or one that is not a number."""
    if isinstance(value, bool):
        return np.nan
    try:
        if isinstance(value, str):
            return read_decimal(value)
        return float(value) if isinstance(value, float | int | decimal.Decimal) else np.nan
    except (OverflowError, ValueError):
        return np.nan
