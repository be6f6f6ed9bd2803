"""Measured runs as text files, with the columns that `diffabs simulate --csv` writes, or with those of a data logger.

The separator is a comma, a semicolon or a tab; without commas as separators, numbers may have a decimal comma. A column
`name [unit]` may also be called `name (unit)`, with - for the unit 1, and the time `t` or `time`, also without unit.
"""

import pathlib
import re
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from diffabs.core.channels import control_names
from diffabs.core.protocols import Plant
from diffabs.core.types import JsonObject
from diffabs.host import files, separated
from diffabs.host.values import ScenarioError, format_given, unknown_name_error
from diffabs.loop.closed_loop import LOOP_SIGNALS

MAX_MEASUREMENT_BYTES = 100_000_000  # bytes
TIME_COLUMN = "t [s]"
TIME_NAMES = ("t", "time", "time [s]")  # of the column, beside TIME_COLUMN, in small or capital letters
RENAME_HINT = '--rename "COLUMN=NAME" gives a column the name of a signal, or t'
MAX_LISTED = 20  # columns of the file that a message lists


class Readings(NamedTuple):
    """The readings of a measured run.

    Attributes:
        t: Instants [s], increasing.
        columns: Readings at the instants, in SI, by the names of a plant's output.
        infinite: Names of the columns that are left out, because they are infinite in every row.
        unread: Names of the columns that are left out, because they are unknown.
    """

    t: np.ndarray
    columns: dict[str, np.ndarray]
    infinite: tuple[str, ...] = ()
    unread: tuple[str, ...] = ()

    def select(self, names: Sequence[str], where: str = "column") -> "Readings":
        """Return the readings of these columns; without names, of all. Raises ScenarioError for an absent one."""
        for name in names:
            if name in self.infinite:
                raise ScenarioError(f"{where} {name} is infinite in every row of the data")
            if name not in self.columns:
                raise unknown_name_error(f"{where} {format_given(name)} is not in the data", name, self.columns)
        return Readings(self.t, {name: self.columns[name] for name in names or self.columns})

    def record(self) -> JsonObject:
        """Return the number of instants, the last one [s] and the names of the columns as JSON values."""
        return {"samples": len(self.t), "columns": list(self.columns), "until": float(self.t[-1])}


def loop_columns(plant: Plant) -> tuple[str, ...]:
    """Return the names of a simulation's columns that are no measurement: target, or target_level_1, and so on."""
    aims, controls = getattr(plant.shows, "tracked", ()), control_names(plant)
    channels = {name: aims if name in ("target", "setpoint") else controls for name in LOOP_SIGNALS}
    return tuple(full for name in LOOP_SIGNALS for full in [f"{name}_{key}" for key in channels[name]] or [name])


def read_separator(text: str | None, where: str) -> str | None:
    """Return the character between cells that a text names, None to guess it. Raises ScenarioError."""
    if text is None:
        return None
    separator = {"tab": "\t", "\\t": "\t"}.get(text, text)
    if len(separator) != 1 or separator.isalnum() or separator in "\"'+-.\r\n_":
        raise ScenarioError(f"{where} {format_given(text)} is no separator: `tab`, or a character such as ;")
    return separator


def read_measurements(
    path: pathlib.Path,
    units: Mapping[str, str],
    *,
    renamed: Mapping[str, str] | None = None,
    separator: str | None = None,
    strict: bool = True,
    ignored: Sequence[str] = LOOP_SIGNALS,
) -> Readings:
    """Return the readings in a file.

    Args:
        path: File of UTF-8 text, at most `MAX_MEASUREMENT_BYTES` long, with the column `t [s]`. A column that is
            infinite in every row, such as a limit that the simulation lacks, is ignored if another column is left.
        units: Units of the plant's signals by name: a column's header is `name [unit]`.
        renamed: Signal, or `t`, by the name of its column in the file. Its values have the signal's unit.
        separator: Character between the cells; None guesses comma, semicolon or tab.
        strict: Whether to refuse a column with an unknown name; otherwise it is left out.
        ignored: Names of the loop's other signals (`loop_columns`), whose columns are left out.

    Raises:
        ScenarioError: The file cannot be read, a column is unknown, or there is no signal or no row. Also raised for a
            cell that is no finite number in a column that is read, for decimal points beside decimal commas, and for an
            instant that is negative or not after the one before. The message names the line of such a cell or instant.
    """
    try:
        raw = files.read_content(path, MAX_MEASUREMENT_BYTES + 1)
    except OSError as error:
        raise ScenarioError(f"--data {path}: cannot be read, {error.strerror}") from None
    if len(raw) > MAX_MEASUREMENT_BYTES:
        raise ScenarioError(f"--data {path}: is larger than {MAX_MEASUREMENT_BYTES} bytes")
    try:
        text = raw.decode("utf-8-sig")
    except UnicodeDecodeError:
        raise ScenarioError(f"--data {path}: is not a CSV file of UTF-8 text") from None
    try:
        rows, separator = separated.split_rows(text, separator)
    except ValueError as error:
        hint = " with --separator" if str(error).startswith("separator") else ""
        raise ScenarioError(f"--data {path}: {error}{hint}") from None
    titles = [cell.strip() for cell in rows[0]] if rows else []
    header = _translate(titles, path, units, renamed or {})
    names, unread = _names(header, titles, path, units, strict, ignored)
    used = [header.index(TIME_COLUMN), *names]
    comma = _has_decimal_commas(rows, used, separator, path)
    numbers = np.array([_numbers(row, i, titles, used, comma, path) for i, row in enumerate(rows[1:], 2) if row], float)
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
            raise ScenarioError(f"--data {path}, line {lines[i]}: {titles[used[j]]} = {cell} is outside (-inf, inf)")
    late = np.flatnonzero(np.diff(t) <= 0)
    if t[0] < 0 or len(late):
        line, before = (lines[late[0] + 1], t[late[0]]) if len(late) else (lines[0], 0.0)
        at = t[late[0] + 1] if len(late) else t[0]
        raise ScenarioError(f"--data {path}, line {line}: t = {at:g} s does not come after {before:g} s")
    columns = {name: compared[i] for i, name in names.items() if i not in unlimited}
    return Readings(t, columns, tuple(name for name in names.values() if name not in columns), unread)


def _translate(
    titles: Sequence[str], path: pathlib.Path, units: Mapping[str, str], renamed: Mapping[str, str]
) -> list[str]:
    """Return the header with `name [unit]` for each name that is renamed, or written in another way."""
    headers = {"t": TIME_COLUMN} | {name: f"{name} [{unit}]" for name, unit in units.items()}
    for column, name in renamed.items():
        if column not in titles:
            message = f"--rename {format_given(column)} is no column of {path}"
            raise unknown_name_error(message, column, titles)
        if name not in headers and name not in headers.values():
            raise unknown_name_error(f"--rename {format_given(name)} is not a signal", name, headers)

    def translate(column: str) -> str:
        if column in renamed:
            return headers.get(renamed[column], renamed[column])
        plain = re.sub(r"\s*[\[(]\s*(.*?)\s*[\])]$", r" [\1]", column).replace("[-]", "[1]")
        return TIME_COLUMN if plain.lower() in TIME_NAMES else plain if plain in headers.values() else column

    return [translate(column) for column in titles]


def _names(
    header: Sequence[str],
    titles: Sequence[str],
    path: pathlib.Path,
    units: Mapping[str, str],
    strict: bool,
    ignored: Sequence[str],
) -> tuple[dict[int, str], tuple[str, ...]]:
    """Return the names of the compared columns by column number, and the names of unknown columns."""
    headers = {f"{name} [{unit}]": name for name, unit in units.items()}
    expected = ", ".join((TIME_COLUMN, *headers))
    has = f"the file has {', '.join(format_given(name) for name in titles[:MAX_LISTED])}"
    has += f" and {len(titles) - MAX_LISTED} more" if len(titles) > MAX_LISTED else ""
    if TIME_COLUMN not in header:
        message = f"line 1 has no column {TIME_COLUMN}; {has}" if header else "is empty"
        raise ScenarioError(f"--data {path}: {message}; there is {expected}{'; ' + RENAME_HINT if header else ''}")
    unread = []
    for name in header:
        is_known = name == TIME_COLUMN or name in headers
        if is_known and header.count(name) > 1:
            raise ScenarioError(f"--data {path}: column {format_given(name)} occurs twice")
        others = tuple(f"{signal} [" for signal in ignored)
        if is_known or not name or name.startswith(others):  # without a name: a separator at the end of the lines
            continue
        if strict:
            message = f"--data {path}: column {format_given(name)} is unknown"
            error = unknown_name_error(message, name, (TIME_COLUMN, *headers))
            raise ScenarioError(f"{error}; {has}; {RENAME_HINT}")
        unread.append(name)
    names = {i: headers[name] for i, name in enumerate(header) if name in headers}
    if not names:
        hint = f"{has}; {RENAME_HINT}"
        raise ScenarioError(f"--data {path}: has no column of a measured signal; there is {', '.join(headers)}; {hint}")
    return names, tuple(unread)


def _has_decimal_commas(rows: Sequence[Sequence[str]], used: Sequence[int], separator: str, path: pathlib.Path) -> bool:
    """Return whether the numbers have decimal commas; raise a ScenarioError if some have a comma and some a point."""
    first = {}
    for line, row in enumerate(rows[1:], 2):
        for i in used:
            for mark in ",.":
                if i < len(row) and mark in row[i]:
                    first.setdefault(mark, (line, row[i].strip()))
    if len(first) == 2:
        (line, cell), (_, other_cell) = sorted(first.values(), reverse=True)
        raise ScenarioError(
            f"--data {path}, line {line}: {format_given(cell)} has another decimal mark than {format_given(other_cell)}"
        )
    return "," in first


def _numbers(
    row: Sequence[str], line: int, header: Sequence[str], used: Sequence[int], comma: bool, path: pathlib.Path
) -> list[float]:
    """Return the numbers of the `used` columns of a row."""
    if len(row) != len(header):
        raise ScenarioError(f"--data {path}, line {line}: has {len(row)} cells; the header has {len(header)}")
    numbers = []
    for i in used:
        try:
            numbers.append(separated.read_decimal(row[i], comma))
        except ValueError:
            raise ScenarioError(
                f"--data {path}, line {line}: {header[i]} = {format_given(row[i])} is text; a number is needed"
            ) from None
    return numbers
