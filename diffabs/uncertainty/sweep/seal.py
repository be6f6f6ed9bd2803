"""Detection of chunks that are damaged, exchanged, or from another sweep.

The file name of a chunk contains the first 16 digits of the SHA-256 of its bytes. They detect any changed bit. The file
contains, as key-value metadata of Parquet (DuckDB: `parquet_kv_metadata`), its number, the seed, and its owner. The
owner is a digest of everything in the manifest that decides the numbers. A reader compares all of these, and the
samples.
"""

import hashlib
import io
import json
import pathlib
import re
from collections.abc import Iterable, Mapping
from typing import NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from diffabs.host.values import ScenarioError

CHUNK_NAME_PATTERN = re.compile(r"part-(\d{8,})-([0-9a-f]{16})\.parquet")
DIGEST_DIGITS = 16


class SweepError(ScenarioError):
    """A sweep that cannot be started, continued or read; the message is one line."""


class DamagedError(SweepError):
    """A chunk that differs from the written one, and can be computed again."""


class Seal(NamedTuple):
    """The identity of a chunk, with its samples and columns.

    Attributes:
        owner: Digest of format, study and versions.
        chunk: Number of the chunk.
        seed: Seed of the sweep.
        rows: First sample of the chunk, and one past its last.
        columns: Names of the columns that the chunk must have.
    """

    owner: str
    chunk: int
    seed: int
    rows: tuple[int, int]
    columns: frozenset[str] = frozenset()

    def metadata(self) -> dict[bytes, bytes]:
        """Return owner, number and seed as metadata of the file."""
        entries = {"owner": self.owner, "chunk": str(self.chunk), "seed": str(self.seed)}
        return {f"diffabs.{name}".encode(): value.encode() for name, value in entries.items()}


def json_digest(value: object) -> str:
    """Return the SHA-256 of JSON values; the order of names counts, because it is the order of a design's columns."""
    return hashlib.sha256(json.dumps(value, separators=(",", ":")).encode()).hexdigest()


def encode_chunk(columns: Mapping[str, np.ndarray], seal: Seal, units: Mapping[str, str] | None = None) -> bytes:
    """Return a chunk as the bytes of its Parquet file. The same columns of the same sweep give the same bytes.

    The metadata of a field holds its unit, where it is known, under `unit`.
    """
    arrays = {
        name: pa.array(column.astype(str)).dictionary_encode() if column.dtype.kind in "OU" else pa.array(column)
        for name, column in columns.items()
    }
    field_metadata = {name: {"unit": unit} for name, unit in (units or {}).items()}
    schema = pa.schema(
        [pa.field(n, array.type, metadata=field_metadata.get(n)) for n, array in arrays.items()], seal.metadata()
    )
    buffer = io.BytesIO()
    pq.write_table(pa.table(list(arrays.values()), schema), buffer, compression="zstd")
    return buffer.getvalue()


def chunk_file_name(chunk: int, data: bytes) -> str:
    """Return the name of a chunk's file."""
    return f"part-{chunk:08d}-{hashlib.sha256(data).hexdigest()[:DIGEST_DIGITS]}.parquet"


def verify_chunk(data: bytes, path: pathlib.Path, seal: Seal) -> pq.ParquetFile:
    """Return the chunk in a file's bytes; raise DamagedError for damage, SweepError for a chunk of another sweep."""
    if chunk_file_name(seal.chunk, data) != path.name:
        raise DamagedError(f"{path} is damaged: its contents do not match its name; --resume computes it again")
    try:
        file = pq.ParquetFile(pa.BufferReader(data))
        metadata = file.schema_arrow.metadata or {}
        wrong = next((key for key, value in seal.metadata().items() if metadata.get(key) != value), None)
        if wrong in (b"diffabs.owner", b"diffabs.seed"):
            raise SweepError(
                f"{path} is a chunk of another sweep: its {_describe_metadata(wrong, metadata)}; move it away"
            )
        if wrong:
            raise DamagedError(
                f"{path} is not that chunk: its {_describe_metadata(wrong, metadata)}; --resume computes it again"
            )
        missing = sorted(seal.columns - set(file.schema_arrow.names))
        if missing:
            raise DamagedError(f"{path} has no column {missing[0]}; --resume computes it again")
        samples = file.read(["sample"]).column("sample").to_numpy()
        if not np.array_equal(samples, np.arange(*seal.rows)):
            expected = f"samples {seal.rows[0]} to {seal.rows[1] - 1}"
            raise DamagedError(f"{path} does not have {expected}; --resume computes it again")
    except (pa.ArrowException, OSError) as error:
        why = " ".join(str(error).split())
        raise DamagedError(f"{path} is no chunk: {why}; --resume computes it again") from None
    return file


def _describe_metadata(key: bytes, metadata: Mapping[bytes, bytes]) -> str:
    kind = key.decode().removeprefix("diffabs.")
    return (
        f"{kind} is {metadata[key].decode(errors='replace')[:DIGEST_DIGITS]!r}"
        if key in metadata
        else f"{kind} is not in it"
    )


def tables_digest(tables: Iterable[pa.Table]) -> str:
    """Return the SHA-256 over names, types and values of all columns; equal for equal tables in any files."""
    whole = hashlib.sha256()
    for table in tables:
        for column, values in zip(table.column_names, table.columns, strict=True):
            plain = values.combine_chunks()
            data = plain.to_numpy(zero_copy_only=False)
            whole.update(f"{column}\0{data.dtype}\0".encode())
            whole.update("\0".join(data).encode() if data.dtype.kind == "O" else np.ascontiguousarray(data).data)
    return whole.hexdigest()
