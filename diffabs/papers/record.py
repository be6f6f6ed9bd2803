"""Record of a published result: rows, figures, notes, and the origin of the numbers."""

import dataclasses
import json
import math
import pathlib
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from rich.console import Console
from rich.table import Table

from diffabs.core.types import JsonObject, Params, Scalar
from diffabs.engine.solvers import FixedStep
from diffabs.host import documents, files, provenance
from diffabs.loop.result import Run
from diffabs.output import plot
from diffabs.papers.digest import Digest


def lane(run: Run, i: int) -> Run:
    """Return one run of a batch, as NumPy arrays."""
    return jax.tree.map(lambda x: np.asarray(x[i]), run)


def computed_row(
    name: str, quantity: str, unit: str, ours: Any, *, published: float | None = None, reference: object = None
) -> JsonObject:
    """Return a row of a table with our number and, if known, the paper's or an independent number.

    "difference" is ours less the published number, else ours less the reference; None without either, or beside a word.
    """
    ours = ours if isinstance(ours, str) else float(ours)
    expected = reference if published is None else published
    difference = None if expected is None or isinstance(expected, str) or isinstance(ours, str) else ours - expected
    line = {"name": name, "quantity": quantity, "unit": unit, "ours": ours}
    return {**line, "published": published, "reference": reference, "difference": difference}


def printed_row(name: str, quantity: str, unit: str, ours: object, published: float, digits: int = 2) -> JsonObject:
    """Return the row of `computed_row` with "matches": whether ours and the published number round alike.

    Args:
        digits: Decimals of the paper's number, to which both are rounded.
    """
    line = computed_row(name, quantity, unit, ours, published=published)
    return {**line, "matches": round(line["ours"], digits) == round(published, digits)}


def format_time(time: Scalar) -> float | str:
    """Return a time [s], or distance [m], for a summary, or "never" if it is infinite."""
    return "never" if math.isinf(float(time)) else float(time)


def solver_settings(step: FixedStep, **more: object) -> JsonObject:
    """Return the settings of the integration for a summary."""
    dtype = str(jnp.result_type(float))
    return {"method": "RK4, fixed step", "step": step.step, "duration": step.duration, "dtype": dtype, **more}


def origin_of_numbers() -> dict[str, str]:
    """Return the versions of everything that can change a number, and the commit if there is one."""
    return provenance.describe_platform("jaxlib", "numpy", "matplotlib") | provenance.source_commit()


def write_summary(
    folder: pathlib.Path,
    summary: JsonObject,
    compact: Callable[[Params], Digest] | None = None,
    name: str = "summary.json",
) -> JsonObject:
    """Write a summary atomically, with its digest if `compact` makes one, and return it as it reads back."""
    content = json.loads(json.dumps(summary, allow_nan=False))
    if compact:
        content = documents.stamp("reproduce", {**content, "digest": compact(content)._asdict()})
    text = json.dumps(content, indent=2, allow_nan=False, ensure_ascii=False)
    files.write_file(folder / name, f"{text}\n".encode())
    return json.loads(text)


def save_figures(figures: Params, folder: pathlib.Path) -> list[str]:
    """Write figures into a folder, and return the names of their files."""
    return [plot.save_figure(figure, folder / f"{name}.png").name for name, figure in figures.items()]


def print_rows(title: str, rows: Sequence[Params]) -> None:
    """Print rows of equal keys as a table, with floats at five significant digits or four decimals."""
    table = Table(title=title, title_justify="left")
    for name in rows[0]:
        table.add_column(name, justify="left" if isinstance(rows[0][name], str) else "right")
    for line in rows:
        table.add_row(*(_short(value) for value in line.values()))
    console = Console(markup=False, emoji=False, highlight=False)
    if not console.is_terminal:
        console.width = 160
    console.print(table)


def _short(value: Scalar) -> str:
    if not isinstance(value, float):
        return "" if value is None else str(value)
    return f"{value:.5g}" if abs(value) < 1 or abs(value) >= 1000 else f"{value:.4f}"


def experiment(config: Any, results: Params, figures: Params) -> JsonObject:
    """Write an experiment's figures and `results.json` with config and versions, and return the contents of this file.

    Args:
        results: Results, as for JSON; a number that is not finite, such as the mean of no run, becomes None.
    """
    results = json.loads(json.dumps(results), parse_constant=lambda _: None)
    folder = pathlib.Path(config.out)
    folder.mkdir(parents=True, exist_ok=True)
    names = save_figures(figures, folder)
    whole = {"config": dataclasses.asdict(config), **results, "figures": names, "versions": origin_of_numbers()}
    return write_summary(folder, whole, name="results.json")
