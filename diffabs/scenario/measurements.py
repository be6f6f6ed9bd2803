"""Measured runs as CSV files, with the columns that `diffabs simulate --csv` writes."""

import csv
import pathlib
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from diffabs.config.values import ScenarioError, format_given, unknown_name_error
from diffabs.runtime import files

MAX_MEASUREMENT_BYTES = 100_000_000  # bytes
TIME_COLUMN = "t [s]"
IGNORED = ("target [", "command [", "control [")  # columns of a simulation without a measurement


class Readings(NamedTuple):
    """The readings of a measured run.

    Attributes:
        t: Instants [s], increasing.
        columns: Readings at the instants, in SI, by the names of a plant's output.
        infinite: Names of the columns that are left out, because they are infinite in every row.
    """

    t: np.ndarray
    columns: dict[str, np.ndarray]
    infinite: tuple[str, ...] = ()


def read_measurements(path: pathlib.Path, units: Mapping[str, str]) -> Readings:
    """Return the readings in a CSV file.

    Args:
        path: File of UTF-8 text, at most `MAX_MEASUREMENT_BYTES` long, with the column `t [s]`. Columns of target,
            command and control are ignored. A column that is infinite in every row, such as a limit that the simulation
            lacks, is ignored if another column is left.
        units: Units of the plant's signals by name: a column's header is `name [unit]`.

    Raises:
        ScenarioError: The file cannot be read, a column is unknown, or there is no signal or no row. Also raised for a
            cell that is no finite number in a column that is read, and for an instant that is negative or not after the
            one before. The message names the line of such a cell or instant.
    """
    try:
        raw = files.read_content(path, MAX_MEASUREMENT_BYTES + 1)
    except OSError as error:
        raise ScenarioError(f"--data {path}: cannot be read, {error.strerror}") from None
    if len(raw) > MAX_MEASUREMENT_BYTES:
        raise ScenarioError(f"--data {path}: is larger than {MAX_MEASUREMENT_BYTES} bytes")
    try:
        rows = list(csv.reader(raw.decode("utf-8-sig").splitlines()))
    except (UnicodeDecodeError, csv.Error):
        raise ScenarioError(f"--data {path}: is not a CSV file of UTF-8 text") from None
    header = [cell.strip() for cell in rows[0]] if rows else []
    names = _names(header, path, units)
    used = [header.index(TIME_COLUMN), *names]
    numbers = np.array([_numbers(row, i, header, used, path) for i, row in enumerate(rows[1:], 2) if row], float)
    if not len(numbers):
        raise ScenarioError(f"--data {path}: has a header and no numbers")
    lines = [i for i, row in enumerate(rows[1:], 2) if row]
    t, *readings = numbers.T
    compared = dict(zip(names, readings, strict=True))
    unlimited = {i for i, column in compared.items() if np.isinf(column[0]) and (column == column[0]).all()}
    unlimited = unlimited if len(unlimited) < len(names) else set()
    for i, j in np.argwhere(~np.isfinite(numbers)):
        if used[j] not in unlimited:
            cell = rows[lines[i] - 1][used[j]].strip()
            raise ScenarioError(f"--data {path}, line {lines[i]}: {header[used[j]]} = {cell} is outside (-inf, inf)")
    late = np.flatnonzero(np.diff(t) <= 0)
    if t[0] < 0 or len(late):
        line, before = (lines[late[0] + 1], t[late[0]]) if len(late) else (lines[0], 0.0)
        at = t[late[0] + 1] if len(late) else t[0]
        raise ScenarioError(f"--data {path}, line {line}: t = {at:g} s does not come after {before:g} s")
    columns = {name: compared[i] for i, name in names.items() if i not in unlimited}
    return Readings(t, columns, tuple(name for name in names.values() if name not in columns))


def _names(header: Sequence[str], path: pathlib.Path, units: Mapping[str, str]) -> dict[int, str]:
    """Return the names of the compared columns by column number."""
    headers = {f"{name} [{unit}]": name for name, unit in units.items()}
    there = ", ".join((TIME_COLUMN, *headers))
    if TIME_COLUMN not in header:
        what = f"line 1 has no column {TIME_COLUMN}" if header else "is empty"
        raise ScenarioError(f"--data {path}: {what}; there is {there}")
    for name in header:
        if header.count(name) > 1:
            raise ScenarioError(f"--data {path}: column {format_given(name)} occurs twice")
        if name != TIME_COLUMN and name not in headers and not name.startswith(IGNORED):
            raise unknown_name_error(
                f"--data {path}: column {format_given(name)} is unknown", name, (TIME_COLUMN, *headers)
            )
    names = {i: headers[name] for i, name in enumerate(header) if name in headers}
    if not names:
        raise ScenarioError(f"--data {path}: has no column of a measured signal; there is {', '.join(headers)}")
    return names


def _numbers(
    row: Sequence[str], line: int, header: Sequence[str], used: Sequence[int], path: pathlib.Path
) -> list[float]:
    """Return the numbers of the `used` columns of a row."""
    if len(row) != len(header):
        raise ScenarioError(f"--data {path}, line {line}: has {len(row)} cells; the header has {len(header)}")
    found = []
    for i in used:
        try:
            found.append(float(row[i]))
        except ValueError:
            raise ScenarioError(
                f"--data {path}, line {line}: {header[i]} = {format_given(row[i])} is text; a number is needed"
            ) from None
    return found
