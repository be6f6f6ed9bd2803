"""How a chunk is told from a damaged, exchanged or foreign one.

The name of its file holds the first 16 digits of the SHA-256 of all its bytes, so a changed bit anywhere is seen. In
it, as key-value metadata of Parquet (DuckDB: `parquet_kv_metadata`), are its number, the seed, and its owner: a digest
of everything in the manifest that decides its numbers. Whoever reads a chunk compares all of them, and its samples."""

import hashlib
import io
import json
import pathlib
import re
from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from diffabs.core.values import ScenarioError

CHUNK_NAME_PATTERN = re.compile(r"part-(\d{8,})-([0-9a-f]{16})\.parquet")
DIGEST_DIGITS = 16


class SweepError(ScenarioError):
    """A sweep that cannot be started, continued or read; one line."""


class DamagedError(SweepError):
    """A chunk that is not what was written, and can be computed again."""


class Seal(NamedTuple):
    """What a chunk says of itself, and which samples and columns it must have."""

    owner: str
    chunk: int
    seed: int
    rows: tuple[int, int]  # its first sample, and one past its last
    columns: frozenset[str] = frozenset()

    def metadata(self) -> dict[bytes, bytes]:
        """As kept in the file."""
        told = {"owner": self.owner, "chunk": str(self.chunk), "seed": str(self.seed)}
        return {f"diffabs.{name}".encode(): value.encode() for name, value in told.items()}


def json_digest(value: Any) -> str:
    """SHA-256 of values of JSON. The order of names counts: it is that of a design's columns."""
    return hashlib.sha256(json.dumps(value, separators=(",", ":")).encode()).hexdigest()


def encode_chunk(columns: Mapping[str, np.ndarray], seal: Seal, units: Mapping[str, str] | None = None) -> bytes:
    """A chunk as the bytes of its Parquet file: the same columns of the same sweep give the same bytes. A column whose
    unit is known has it in its field's metadata, under `unit`."""
    arrays = {name: _arrow_array(column) for name, column in columns.items()}
    told = {name: {"unit": unit} for name, unit in (units or {}).items()}
    schema = pa.schema([pa.field(n, array.type, metadata=told.get(n)) for n, array in arrays.items()], seal.metadata())
    buffer = io.BytesIO()
    pq.write_table(pa.table(list(arrays.values()), schema), buffer, compression="zstd")
    return buffer.getvalue()


def _arrow_array(column: np.ndarray) -> pa.Array:
    return pa.array(column.astype(str)).dictionary_encode() if column.dtype.kind in "OU" else pa.array(column)


def chunk_file_name(chunk: int, data: bytes) -> str:
    """The name of a chunk's file."""
    return f"part-{chunk:08d}-{hashlib.sha256(data).hexdigest()[:DIGEST_DIGITS]}.parquet"


def verify_chunk(data: bytes, path: pathlib.Path, seal: Seal) -> pq.ParquetFile:
    """The chunk in these bytes of a file. Raises DamagedError, or SweepError for a chunk of another sweep."""
    if chunk_file_name(seal.chunk, data) != path.name:
        raise DamagedError(f"{path} is damaged: its contents do not match its name; --resume computes it again")
    try:
        found = pq.ParquetFile(pa.BufferReader(data))
        told = found.schema_arrow.metadata or {}
        wrong = next((key for key, value in seal.metadata().items() if told.get(key) != value), None)
        if wrong in (b"diffabs.owner", b"diffabs.seed"):
            raise SweepError(f"{path} is a chunk of another sweep: its {_describe_metadata(wrong, told)}; move it away")
        if wrong:
            raise DamagedError(
                f"{path} is not that chunk: its {_describe_metadata(wrong, told)}; --resume computes it again"
            )
        _check_table(found, path, seal)
    except (pa.ArrowException, OSError) as error:
        raise DamagedError(f"{path} is no chunk: {_line(error)}; --resume computes it again") from None
    return found


def _describe_metadata(key: bytes, told: Mapping[bytes, bytes]) -> str:
    kind = key.decode().removeprefix("diffabs.")
    return (
        f"{kind} is {told[key].decode(errors='replace')[:DIGEST_DIGITS]!r}" if key in told else f"{kind} is not in it"
    )


def _check_table(found: pq.ParquetFile, path: pathlib.Path, seal: Seal) -> None:
    """Raises DamagedError for columns that are missing, or other samples."""
    missing = sorted(seal.columns - set(found.schema_arrow.names))
    if missing:
        raise DamagedError(f"{path} has no column {missing[0]}; --resume computes it again")
    samples = found.read(["sample"]).column("sample").to_numpy()
    if not np.array_equal(samples, np.arange(*seal.rows)):
        wanted = f"samples {seal.rows[0]} to {seal.rows[1] - 1}"
        raise DamagedError(f"{path} does not have {wanted}; --resume computes it again")


def tables_digest(tables: Iterable[pa.Table]) -> str:
    """SHA-256 over names, types and values of all columns: equal for equal tables, whatever file they are in."""
    whole = hashlib.sha256()
    for table in tables:
        for column, values in zip(table.column_names, table.columns, strict=True):
            plain = values.combine_chunks()
            data = plain.to_numpy(zero_copy_only=False)
            whole.update(f"{column}\0{data.dtype}\0".encode())
            whole.update("\0".join(data).encode() if data.dtype.kind == "O" else np.ascontiguousarray(data).data)
    return whole.hexdigest()


def _line(error: BaseException) -> str:
    return " ".join(str(error).split())
