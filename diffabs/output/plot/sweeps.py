"""Figures of a sweep: distributions, exceedance, worst runs, sensitivities, and a map of failures.

Columns that do not vary are left out. Diverged runs are left out except among the failures. Units are given by the name
of a column. Columns are in SI units; variables that are speeds are drawn in km/h.
"""

import pathlib
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from diffabs.core.types import Table
from diffabs.output.plot.style import (
    COLOURS,
    GREY,
    Axes,
    Figure,
    ListedColormap,
    Patch,
    Sheet,
    label_axes,
    make_logarithmic,
    save_figure,
    sheet,
)
from diffabs.output.plot.sweep_view import AxisVariable, SweepView, assign_cells
from diffabs.uncertainty.sweep.results import Results
from diffabs.uncertainty.sweep.statistics.estimates import Count, Tail
from diffabs.uncertainty.sweep.study import describe_wrong_end

# In distances between the outer quantiles. Values further outside are left out, or they would compress the histogram.
MAX_BOUND_DISTANCE = 2.0
LEVELS = 32  # corners of an exceedance curve along the share, along its logarithm, and over the greatest single runs
POINTS = 5000  # largest number of points of a scatter
FEW = 10  # fewer failures, or runs without failure, do not show which variables matter
ROW = 0.055  # height of a line of text beside the axes, as a share of their height
ABOVE = dict(loc="lower center", bbox_to_anchor=(0.5, 1), ncols=3, frameon=False, fontsize=9, handlelength=1.5)


def draw_sweep(results: Results, document: Table, folder: pathlib.Path, units: Mapping[str, str]) -> list[pathlib.Path]:
    """Write every figure that has content as PNG, and return the paths."""
    figures = {
        "distributions": draw_distributions(results, units),
        "exceedance": draw_exceedance(results, units, document["confidence"]),
        "worst": draw_worst(results, units),
        "sensitivity": draw_sensitivity(results, document),
        "failure_map": draw_failure_map(results, units),
    }
    return [save_figure(figure, folder / f"{name}.png") for name, figure in figures.items() if figure]


def draw_distributions(results: Results, units: Mapping[str, str] = {}) -> Figure | None:
    """Return histograms of each metric with its median and two quantiles, or None if no metric varies."""
    view = SweepView(results, units)
    figure, axes = _panels(view.varying, view.title("distributions of", np.sum(view.rows)))
    for ax, name in zip(axes, view.varying, strict=True):
        values = results.column(name)[view.known_rows(name, view.rows)]
        low, middle, high = np.quantile(values, (0.05, 0.5, 0.95))
        far = MAX_BOUND_DISTANCE * (high - low) or np.inf
        ends = max(values.min(), low - far), min(values.max(), high + far)
        counts, edges = np.histogram(values, min(60, max(8, int(len(values) ** 0.5))), ends)
        ax.stairs(counts, edges, fill=True, color=COLOURS[0], alpha=0.5)
        ax.axvline(middle, color="black", linewidth=1.4, label=f"median {middle:.4g}")
        for end, text in ((low, f"5 %, 95 %: {low:.4g}, {high:.4g}"), (high, None)):
            ax.axvline(end, color="black", linestyle="--", linewidth=1.1, label=text)
        ax.set_xlim(_limits(ax, *ends, view.bounds.get(name)))
        beyond = len(values) - counts.sum()
        outside = f" ({beyond} more outside)" if beyond else ""
        label_axes(ax, view.label(name), f"runs{outside}{view.never(name, view.rows)}", legend=False)
        ax.legend(**ABOVE)
    return figure


def draw_exceedance(results: Results, units: Mapping[str, str] = {}, confidence: float = 0.95) -> Figure | None:
    """Return the share of runs above each value, for each metric, or None if no metric varies.

    Pointwise intervals of Clopper and Pearson are drawn unless the design is a grid or corners, which are not random.
    """
    view = SweepView(results, units)
    band = f"{100 * confidence:g} % band" + ("" if view.design == "random" else " (as if independent)")
    figure, axes = _panels(view.varying, view.title("how often a value is exceeded in", np.sum(view.rows)))
    for ax, name in zip(axes, view.varying, strict=True):
        values = np.sort(results.column(name)[view.known_rows(name, view.rows)])
        n, limits = len(values), _limits(ax, values[0], values[-1], view.bounds.get(name))
        x, counts = _exceedance_corners(values, *limits)
        ax.plot(x, counts / n, color=COLOURS[0], label=f"runs{view.never(name, view.rows)}")
        if view.design not in ("grid", "corners"):
            intervals = [Count(int(k), n).probability(confidence=confidence) for k in counts]
            ends = [interval.low for interval in intervals], [interval.high for interval in intervals]
            ax.fill_between(x, *ends, color=COLOURS[0], alpha=0.25, linewidth=0, label=band)
        make_logarithmic(ax, "y")
        ax.set_xlim(limits)
        ax.set_ylim(0.3 / n, 1.5)
        label_axes(ax, view.label(name), "share beyond [1]", legend=False)
        ax.legend(**ABOVE)
    return figure


def draw_worst(results: Results, units: Mapping[str, str] = {}, count: int = 10) -> Figure | None:
    """Return a scatter of the runs over two variables, coloured by a metric, or None if nothing varies.

    The metric is the first varying one with a bound of failure, else the first varying one. The variables are the two
    that influence it most, numeric ones first. With one variable, the figure shows the metric over it. The worst runs,
    with the greatest values, are marked with sample number and value.
    """
    view = SweepView(results, units)
    metric = view.leading
    good = view.known_rows(metric, view.good)
    paths = view.influential(good, results.column(metric)[good], numbers_first=True) if metric else []
    if not (variables := [view.variable(path, good) for path in paths]):
        return None
    values, samples = results.column(metric)[good], results.column("sample")[good]
    bound, tail = view.bounds.get(metric), Tail.of(values, samples, count)
    ends = np.searchsorted(samples, tail.indices)  # sample numbers ascend
    shown = np.union1d(np.random.default_rng(0).permutation(len(values))[: POINTS - count], ends)
    # Later points cover earlier ones: ascending values keep the worst run of a place visible.
    shown = shown[np.argsort(values[shown], kind="stable")]
    x, y = variables[0].values, variables[1].values if variables[1:] else values
    title = view.title(f"greatest {metric} of", np.sum(good)) + view.never(metric, view.good)
    figure, (ax,) = sheet(title=title, size=(8.4, 4.8))
    dots = ax.scatter(x[shown], y[shown], 10, values[shown], cmap="viridis", linewidths=0)
    bar = figure.colorbar(dots, ax=ax, label=view.label(metric))
    if bound is not None and values.min() < bound < values.max():
        bar.ax.axhline(bound, color=COLOURS[1], linewidth=2.5)
        bar.set_label(f"{view.label(metric)}, line: bound {bound:g}")
    ax.plot(x[ends], y[ends], "o", color=COLOURS[1], fillstyle="none", label=f"the worst {len(ends)}, sample: value")
    _callouts(ax, x[ends], y[ends], [f"{i}: {v:.4g}" for i, v in zip(tail.indices, tail.values, strict=True)])
    _name_axes(ax, variables, view.label(metric))
    ax.legend(**ABOVE)
    return figure


def draw_sensitivity(results: Results, document: Table) -> Figure | None:
    """Return bars with intervals for each metric, or None if the document has no sensitivities.

    The bars are rank correlations, or Sobol' indices for a Saltelli design.
    """
    view = SweepView(results)
    sobol = view.design == "saltelli"
    kinds, kind = (("first", "total"), "Sobol indices") if sobol else (("spearman",), "rank correlations")
    table = {name: rows for name in view.varying if (rows := document["sensitivity"].get(name))}
    paths = dict.fromkeys(path for rows in table.values() for path in rows)
    great = {path: max(abs(rows[path][kinds[-1]]["value"] or 0.0) for rows in table.values()) for path in paths}
    ordered = sorted((path for path in paths if great[path]), key=lambda path: -great[path])
    used = max((rows[path][kinds[-1]]["samples"] for rows in table.values() for path in rows), default=0) * view.period
    title = view.title(f"{kind} with {100 * document['confidence']:g} % intervals,", used)
    names, height = list(table) if ordered else [], 1.3 + 0.3 * len(ordered) * len(kinds)
    figure, axes = _panels(names, title, (4.4, height), sharey=True)
    for ax, (name, rows) in zip(axes, table.items(), strict=False):
        _bars(ax, [rows[path] for path in ordered], kinds)
        ax.set_yticks(range(len(ordered)), ordered)
        ax.set_ylim(len(ordered) - 0.4, -0.6)
        ax.set_xlim(*((None, None) if sobol else (-1.05, 1.05)))
        label_axes(ax, "share of the variance [1]" if sobol else "rank correlation [1]", "", name, legend=False)
    if figure and sobol:
        figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=2, frameon=False)
    return figure


def draw_failure_map(results: Results, units: Mapping[str, str] = {}) -> Figure | None:
    """Return a map of the share of failed runs over two variables, or None if there is nothing to draw.

    The variables are the two that influence failure most. With fewer than ten failed runs, or fewer than ten others,
    they are the two that influence the metric of `draw_worst` most. If no run failed, the colour is the largest value
    of that metric in a cell. Cells with a run of infinite value (never) have a colour of their own. Cells without a run
    are grey.

    The function returns None if no variable varies, and if no run failed and no metric varies.
    """
    view = SweepView(results, units)
    failed = results.failed_samples()[every := view.accepted]
    if not (failed.any() or view.leading):
        return None
    rows, result = every, failed
    if view.leading and min(np.sum(failed), np.sum(~failed)) < FEW:
        rows = view.known_rows(view.leading, view.good)
        result = results.column(view.leading)[rows]
    if not (variables := [view.variable(path, every) for path in view.influential(rows, result)]):
        return None
    places, edges = zip(*(assign_cells(variable, len(variables)) for variable in variables), strict=True)
    shape = [len(edge) - 1 for edge in edges]
    cell = np.ravel_multi_index(places, shape)
    lanes, bad = (np.bincount(cell, w, np.prod(shape)).reshape(shape[0], -1) for w in (None, failed))
    figure, (ax,) = sheet(title=view.title(f"{np.sum(failed):,} failed of", np.sum(every)), size=(7.4, 5.0))
    if failed.any():
        table, words = bad / np.maximum(lanes, 1), "share of failed runs [1]"
        colours: dict[str, Any] = {"cmap": "Oranges", "vmin": 0, "vmax": np.max(table)}
    else:
        values, greatest = results.column(view.leading)[every], np.full(lanes.size, -np.inf)
        np.maximum.at(greatest, cell, values)
        table, bound = greatest.reshape(lanes.shape), view.bounds.get(view.leading)
        words = f"greatest {view.label(view.leading)}" + ("" if bound is None else f", fails beyond {bound:g}")
        colours = {"cmap": "viridis"}
    ends = [*edges, [0, 1]][:2]
    mesh = ax.pcolormesh(*ends, np.ma.masked_where(lanes == 0, table).T, **colours)
    figure.colorbar(mesh, ax=ax, label=words)
    if (never := (lanes > 0) & ~np.isfinite(table)).any():  # pcolormesh draws no infinite value
        ax.pcolormesh(*ends, np.ma.masked_where(~never, never).T, cmap=ListedColormap([COLOURS[1]]))
        worst = Patch(color=COLOURS[1], label=f"{view.leading}: never in a run")
        figure.legend(handles=[worst], loc="outside lower center", frameon=False)
    ax.set_facecolor("#BBBBBB")
    ax.yaxis.set_visible(len(variables) > 1)
    _name_axes(ax, variables)
    bounds = "".join(f", {name} > {bound:g}" for name, bound in view.bounds.items())
    ax.set_title(f"failed: diverged, {describe_wrong_end(results.study['success'])}{bounds}", fontsize=9.5)
    return figure


def _exceedance_corners(ordered: np.ndarray, low: float, high: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the corners of the step function 1 - F from low to high, for `ordered` values.

    The corners are the values, each twice, and the number of runs that reach and that exceed them. Of many values a
    selection is returned.
    """
    n = len(ordered)
    # Corners are dense among the greatest runs, where the logarithmic axis shows each of them.
    some = [np.arange(1, min(n, LEVELS) + 1), np.geomspace(1, n, LEVELS), np.linspace(1, n, LEVELS)]
    x = np.unique(ordered[n - np.unique(np.concatenate(some).astype(int))])
    sides = [n - np.searchsorted(ordered, x, side="left"), n - np.searchsorted(ordered, x, side="right")]
    return np.array([low, *np.repeat(x, 2), high]), np.array([n, *np.stack(sides, axis=1).ravel(), 0])


def _bars(ax: Axes, rows: Sequence[Table], kinds: Sequence[str]) -> None:
    """Draw one row per variable with a bar for each kind; the interval is left out if the document has none."""
    for j, kind in enumerate(kinds):
        at = np.arange(len(rows)) + (j + 0.5) * 0.8 / len(kinds) - 0.4
        ax.barh(
            at, [row[kind]["value"] or 0 for row in rows], 0.7 / len(kinds), color=COLOURS[j], alpha=0.6, label=kind
        )
        for y, interval in zip(at, (row[kind] for row in rows), strict=True):
            if interval["low"] is not None and interval["high"] is not None:
                ax.plot([interval["low"], interval["high"]], [y, y], "|-", color="black", linewidth=1, markersize=5)
    ax.axvline(0, color=GREY, linewidth=0.9)


def _callouts(ax: Axes, x: np.ndarray, y: np.ndarray, texts: Sequence[str]) -> None:
    """Write texts in a column beside the axes, with a line to each point, in the order of the points' heights.

    The worst points lie close together, and texts at their places would cover each other.
    """
    line = {"arrowstyle": "-", "color": GREY, "linewidth": 0.7, "shrinkA": 1, "shrinkB": 4, "relpos": (0, 0.5)}
    (low, high), half = ax.get_ylim(), ROW * (len(texts) - 1) / 2
    # Centre the column on the points, but keep it within the axes.
    middle = np.clip((np.mean(y) - low) / (high - low), half, 1 - half)
    for height, i in zip(np.linspace(middle - half, middle + half, len(texts)), np.lexsort((-x, y)), strict=True):
        place = {"xytext": (1.06, height), "textcoords": "axes fraction", "va": "center", "annotation_clip": False}
        ax.annotate(texts[int(i)], (x[i], y[i]), fontsize=9, arrowprops=line, **place)


def _limits(ax: Axes, low: float, high: float, bound: float | None) -> tuple[float, float]:
    """Return the limits of the value axis, and draw the bound.

    The bound is inside if that leaves half of the axis to the data.
    """
    width = high - low
    if bound is not None:
        ax.axvline(bound, color=COLOURS[1], linewidth=1.6, label=f"bound {bound:g}")
        if max(high, bound) - min(low, bound) <= 2 * width:
            low, high = min(low, bound), max(high, bound)
    return low - 0.03 * width, high + 0.03 * width


def _panels(
    names: Sequence[str], title: str, size: tuple[float, float] = (5.0, 3.1), **kwargs: Any
) -> tuple[Sheet | None, list[Any]]:
    """Return a figure and one axes for each name, or None and no axes without names."""
    if not names:
        return None, []
    columns = min(len(names), 2 if len(names) <= 4 else 3)
    figure, axes = sheet(-(-len(names) // columns), columns, title=title, size=size, **kwargs)
    for ax in axes[: len(names)]:
        ax.locator_params(axis="x", nbins=6)
    for ax in axes[len(names) :]:
        ax.remove()
    return figure, axes[: len(names)]


def _name_axes(ax: Axes, variables: Sequence[AxisVariable], upward: str = "") -> None:
    label_axes(ax, variables[0].label, variables[1].label if variables[1:] else upward, legend=False)
    for axis, variable in zip((ax.xaxis, ax.yaxis), variables, strict=False):
        if variable.names:
            axis.set_ticks(range(len(variable.names)), variable.names)
