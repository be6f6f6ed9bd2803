"""What a published result consists of: rows, figures, honest notes, and where the numbers come from."""

import dataclasses
import json
import math
import pathlib
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from rich.console import Console
from rich.table import Table

from diffabs import plot
from diffabs.core import files, provenance
from diffabs.simulate.solution import FixedStep, Run


def lane(run: Run, i: int) -> Run:
    """One run out of a batch, as NumPy arrays."""
    return jax.tree.map(lambda x: np.asarray(x[i]), run)


def computed_row(
    name: str, quantity: str, unit: str, ours: Any, *, published: float | None = None, reference: float | None = None
) -> dict[str, Any]:
    """A line of a table, with the paper's number, or one that was computed independently, or neither."""
    ours, expected = float(ours), reference if published is None else published
    difference = None if expected is None else ours - expected
    line = {"name": name, "quantity": quantity, "unit": unit, "ours": ours}
    return {**line, "published": published, "reference": reference, "difference": difference}


def printed_row(name: str, quantity: str, unit: str, ours: Any, published: float, digits: int = 2) -> dict[str, Any]:
    """A line of a table whose published number has so many decimals; `matches` if ours rounds to it."""
    line = computed_row(name, quantity, unit, ours, published=published)
    return {**line, "matches": round(line["ours"], digits) == round(published, digits)}


def format_time(time: Any) -> float | str:
    """Return a time [s] as a summary has it: "never" where it is infinite."""
    return "never" if math.isinf(float(time)) else float(time)


def solver_settings(step: FixedStep, **more: Any) -> dict[str, Any]:
    """How it was integrated."""
    dtype = str(jnp.result_type(float))
    return {"method": "RK4, fixed step", "step": step.step, "duration": step.duration, "dtype": dtype, **more}


def origin_of_numbers() -> dict[str, str]:
    """Of everything that can change a number, and the commit where there is one."""
    return provenance.describe_platform("jaxlib", "numpy", "matplotlib") | provenance.commit()


def write_summary(folder: pathlib.Path, summary: dict[str, Any], name: str = "summary.json") -> dict[str, Any]:
    """Write a summary, whole or not at all, and return it as a reader would get it. Raises ValueError for a number
    that is not finite."""
    text = json.dumps(summary, indent=2, allow_nan=False, ensure_ascii=False)
    files.write_file(folder / name, f"{text}\n".encode())
    return json.loads(text)


def save_figures(figures: Mapping[str, Any], folder: pathlib.Path) -> list[str]:
    """Write figures into a folder, and return the names of their files."""
    return [plot.save_figure(figure, folder / f"{name}.png").name for name, figure in figures.items()]


def print_rows(title: str, rows: Sequence[Mapping[str, Any]]) -> None:
    """Print rows of equal keys as a table; floats with five significant digits or four decimals."""
    table = Table(title=title, title_justify="left")
    for name in rows[0]:
        table.add_column(name, justify="left" if isinstance(rows[0][name], str) else "right")
    for line in rows:
        table.add_row(*(_short(value) for value in line.values()))
    console = Console(markup=False, emoji=False, highlight=False)
    if not console.is_terminal:
        console.width = 160
    console.print(table)


def _short(value: Any) -> str:
    if not isinstance(value, float):
        return "" if value is None else str(value)
    return f"{value:.5g}" if abs(value) < 1 or abs(value) >= 1000 else f"{value:.4f}"


def experiment(config: Any, results: Mapping[str, Any], figures: Mapping[str, Any]) -> dict[str, Any]:
    """Write an experiment's figures and `results.json` into its folder `config.out`, with config and versions; returns
    what was written."""
    folder = pathlib.Path(config.out)
    folder.mkdir(parents=True, exist_ok=True)
    names = save_figures(figures, folder)
    whole = {"config": dataclasses.asdict(config), **results, "figures": names, "versions": origin_of_numbers()}
    return write_summary(folder, whole, "results.json")
