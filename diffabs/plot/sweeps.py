"""Figures of a sweep: what the metrics are like, how often they exceed a value, which runs are worst, what moves them,
and where runs fail. Columns that do not vary are left out, and so are runs that diverged, except among the failures.

Units are handed in by the name of a column. Columns are in SI; variables that are speeds are drawn in km/h."""

import pathlib
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from diffabs.plot.style import COLOURS, GREY, Axes, Figure, label_axes, make_logarithmic, save_figure, sheet
from diffabs.plot.sweep_view import AxisVariable, SweepView, assign_cells
from diffabs.sweep.engines import describe_wrong_end
from diffabs.sweep.results import Results
from diffabs.sweep.statistics.estimates import Count, Tail

MAX_BOUND_DISTANCE = (
    2.0  # widths between the outer quantiles: what lies further outside would press a histogram together
)
LEVELS = 32  # of an exceedance curve along the share, as many along its logarithm, and as many runs one by one
POINTS = 5000  # of a scatter
FEW = 10  # failures, or runs without, that are too few to tell which variables matter
ROW = 0.055  # of the axes' height, for a line of text beside them
ABOVE = dict(loc="lower center", bbox_to_anchor=(0.5, 1), ncols=3, frameon=False, fontsize=9, handlelength=1.5)


def draw_sweep(found: Results, document: Any, folder: pathlib.Path, units: Mapping[str, str]) -> list[pathlib.Path]:
    """Write every figure that has something in it as PNG.

    document: of `diffabs.sweep.statistics.summary.summarise_sweep`."""
    figures = {
        "distributions": draw_distributions(found, units),
        "exceedance": draw_exceedance(found, units, document["confidence"]),
        "worst": draw_worst(found, units),
        "sensitivity": draw_sensitivity(found, document),
        "failure_map": draw_failure_map(found, units),
    }
    return [save_figure(figure, folder / f"{name}.png") for name, figure in figures.items() if figure]


def draw_distributions(found: Results, units: Mapping[str, str] = {}) -> Figure | None:
    """A histogram of each metric, with its median and two quantiles. None where no metric varies."""
    view = SweepView(found, units)
    figure, axes = _panels(view.varying, view.title("distributions of", view.rows))
    for ax, name in zip(axes, view.varying, strict=True):
        values = found.column(name)[view.known(name, view.rows)]
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
        label_axes(ax, view.named(name), f"runs{outside}{view.never(name)}", legend=False)
        ax.legend(**ABOVE)
    return figure


def draw_exceedance(found: Results, units: Mapping[str, str] = {}, confidence: float = 0.95) -> Figure | None:
    """The share of runs beyond each value, with pointwise intervals of Clopper and Pearson unless nothing is random.
    None where no metric varies."""
    view = SweepView(found, units)
    band = f"{100 * confidence:g} % band" + ("" if view.design == "random" else " (as if independent)")
    figure, axes = _panels(view.varying, view.title("how often a value is exceeded in", view.rows))
    for ax, name in zip(axes, view.varying, strict=True):
        values = np.sort(found.column(name)[view.known(name, view.rows)])
        n, limits = len(values), _limits(ax, values[0], values[-1], view.bounds.get(name))
        x, counts = _exceedance_corners(values, *limits)
        ax.plot(x, counts / n, color=COLOURS[0], label=f"runs{view.never(name)}")
        if view.design not in ("grid", "corners"):
            known = [Count(int(k), n).probability(confidence=confidence) for k in counts]
            ends = [one.low for one in known], [one.high for one in known]
            ax.fill_between(x, *ends, color=COLOURS[0], alpha=0.25, linewidth=0, label=band)
        make_logarithmic(ax, "y")
        ax.set_xlim(limits)
        ax.set_ylim(0.3 / n, 1.5)
        label_axes(ax, view.named(name), "share beyond [1]", legend=False)
        ax.legend(**ABOVE)
    return figure


def draw_worst(found: Results, units: Mapping[str, str] = {}, count: int = 10) -> Figure | None:
    """The runs over the two variables, numbers first, that move a metric most; the worst with their sample numbers. The
    metric is the first that has a bound of failure and varies, or else the first that varies. With one variable, the
    metric over it. None where nothing varies."""
    view = SweepView(found, units)
    metric = view.leading
    good = view.known(metric, view.good)
    paths = view.influential(good, found.column(metric)[good], numbers_first=True) if metric else []
    if not (ones := [view.variable(path, good) for path in paths]):
        return None
    values, samples = found.column(metric)[good], found.column("sample")[good]
    bound, tail = view.bounds.get(metric), Tail.of(values, samples, count)
    ends = np.searchsorted(samples, tail.indices)
    shown = np.union1d(np.random.default_rng(0).permutation(len(values))[: POINTS - count], ends)
    shown = shown[np.argsort(values[shown], kind="stable")]  # of runs at one place the worst is seen
    x, y = ones[0].values, ones[1].values if ones[1:] else values
    figure, (ax,) = sheet(title=view.title(f"greatest {metric} of", good), size=(8.4, 4.8))
    dots = ax.scatter(x[shown], y[shown], 10, values[shown], cmap="viridis", linewidths=0)
    bar = figure.colorbar(dots, ax=ax, label=view.named(metric))
    if bound is not None and values.min() < bound < values.max():
        bar.ax.axhline(bound, color=COLOURS[1], linewidth=2.5)
        bar.set_label(f"{view.named(metric)}, line: bound {bound:g}")
    ax.plot(x[ends], y[ends], "o", color=COLOURS[1], fillstyle="none", label=f"the worst {len(ends)}, sample: value")
    _callouts(ax, x[ends], y[ends], [f"{i}: {v:.4g}" for i, v in zip(tail.indices, tail.values, strict=True)])
    _name_axes(ax, ones, view.named(metric))
    ax.legend(**ABOVE)
    return figure


def draw_sensitivity(found: Results, document: Mapping[str, Any]) -> Figure | None:
    """Bars with intervals for each metric: rank correlations, or Sobol' indices for a Saltelli design. None where the
    document has none."""
    view = SweepView(found)
    sobol = view.design == "saltelli"
    kinds, what = (("first", "total"), "Sobol indices") if sobol else (("spearman",), "rank correlations")
    table = {name: rows for name in view.varying if (rows := document["sensitivity"].get(name))}
    paths = dict.fromkeys(path for rows in table.values() for path in rows)
    great = {path: max(abs(rows[path][kinds[-1]]["value"] or 0.0) for rows in table.values()) for path in paths}
    most = sorted((path for path in paths if great[path]), key=lambda path: -great[path])
    title = view.title(f"{what} with {100 * document['confidence']:g} % intervals,", view.good)
    names, height = list(table) if most else [], 1.3 + 0.3 * len(most) * len(kinds)
    figure, axes = _panels(names, title, (4.4, height), sharey=True)
    for ax, (name, rows) in zip(axes, table.items(), strict=False):
        _bars(ax, [rows[path] for path in most], kinds)
        ax.set_yticks(range(len(most)), most)
        ax.set_ylim(len(most) - 0.4, -0.6)
        ax.set_xlim(*((None, None) if sobol else (-1.05, 1.05)))
        label_axes(ax, "share of the variance [1]" if sobol else "rank correlation [1]", "", name, legend=False)
    if figure and sobol:
        figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=2, frameon=False)
    return figure


def draw_failure_map(found: Results, units: Mapping[str, str] = {}) -> Figure | None:
    """The share of failed runs in cells of the two variables that move it most, or that move the metric of `worst` most
    if too few failed, or did not; cells without a run are grey. Where none failed the colour is the greatest value of
    that metric in a cell. None where no variable varies, or nothing failed and no metric varies."""
    view = SweepView(found, units)
    failed = found.failed()[every := view.accepted]
    if not (failed.any() or view.leading):
        return None
    rows, result = every, failed
    if view.leading and min(np.sum(failed), np.sum(~failed)) < FEW:
        rows = view.known(view.leading, view.good)
        result = found.column(view.leading)[rows]
    if not (ones := [view.variable(path, every) for path in view.influential(rows, result)]):
        return None
    places, edges = zip(*(assign_cells(one, len(ones)) for one in ones), strict=True)
    shape = [len(edge) - 1 for edge in edges]
    cell = np.ravel_multi_index(places, shape)
    lanes, bad = (np.bincount(cell, w, np.prod(shape)).reshape(shape[0], -1) for w in (None, failed))
    figure, (ax,) = sheet(title=view.title(f"{np.sum(failed):,} failed of", every), size=(7.4, 5.0))
    if failed.any():
        table, words = bad / np.maximum(lanes, 1), "share of failed runs [1]"
        colours = {"cmap": "Oranges", "vmin": 0, "vmax": np.max(table)}
    else:
        table, words = _greatest(cell, found.column(view.leading)[every], lanes), _draw_bound(view)
        colours = {"cmap": "viridis"}
    mesh = ax.pcolormesh(*[*edges, [0, 1]][:2], np.ma.masked_where(lanes == 0, table).T, **colours)
    figure.colorbar(mesh, ax=ax, label=words)
    ax.set_facecolor("#BBBBBB")
    ax.yaxis.set_visible(len(ones) > 1)
    _name_axes(ax, ones)
    bounds = "".join(f", {name} > {bound:g}" for name, bound in view.bounds.items())
    ax.set_title(f"failed: diverged, {describe_wrong_end(found.study['success'])}{bounds}", fontsize=9.5)
    return figure


def _greatest(cell: Any, values: np.ndarray, lanes: np.ndarray) -> np.ndarray:
    """The greatest value in each cell."""
    table = np.full(lanes.size, -np.inf)
    np.maximum.at(table, cell, values)
    return table.reshape(lanes.shape)


def _draw_bound(view: SweepView) -> str:
    """What the colour is where nothing failed."""
    bound = view.bounds.get(view.leading)
    return f"greatest {view.named(view.leading)}" + ("" if bound is None else f", fails beyond {bound:g}")


def _exceedance_corners(ordered: np.ndarray, low: float, high: float) -> tuple[np.ndarray, np.ndarray]:
    """Corners of 1 - F from low to high: values, each twice, and how many reach it and are greater. Of many, some."""
    n = len(ordered)
    some = [np.arange(1, min(n, LEVELS) + 1), np.geomspace(1, n, LEVELS), np.linspace(1, n, LEVELS)]
    x = np.unique(ordered[n - np.unique(np.concatenate(some).astype(int))])
    sides = [n - np.searchsorted(ordered, x, side="left"), n - np.searchsorted(ordered, x, side="right")]
    return np.array([low, *np.repeat(x, 2), high]), np.array([n, *np.stack(sides, axis=1).ravel(), 0])


def _bars(ax: Axes, rows: Sequence[Mapping[str, Any]], kinds: Sequence[str]) -> None:
    """One row below the other, a bar for each kind; no interval where the document has none."""
    for j, kind in enumerate(kinds):
        at = np.arange(len(rows)) + (j + 0.5) * 0.8 / len(kinds) - 0.4
        ax.barh(
            at, [row[kind]["value"] or 0 for row in rows], 0.7 / len(kinds), color=COLOURS[j], alpha=0.6, label=kind
        )
        for y, one in zip(at, (row[kind] for row in rows), strict=True):
            if one["low"] is not None and one["high"] is not None:
                ax.plot([one["low"], one["high"]], [y, y], "|-", color="black", linewidth=1, markersize=5)
    ax.axvline(0, color=GREY, linewidth=0.9)


def _callouts(ax: Axes, x: np.ndarray, y: np.ndarray, texts: Sequence[str]) -> None:
    """Texts in a column beside the axes with a line to each point, in the order of their heights: points that are worst
    lie close together, and names at their places would cover each other."""
    line = {"arrowstyle": "-", "color": GREY, "linewidth": 0.7, "shrinkA": 1, "shrinkB": 4, "relpos": (0, 0.5)}
    (low, high), half = ax.get_ylim(), ROW * (len(texts) - 1) / 2
    middle = np.clip((np.mean(y) - low) / (high - low), half, 1 - half)
    for height, i in zip(np.linspace(middle - half, middle + half, len(texts)), np.lexsort((-x, y)), strict=True):
        place = {"xytext": (1.06, height), "textcoords": "axes fraction", "va": "center", "annotation_clip": False}
        ax.annotate(texts[int(i)], (x[i], y[i]), fontsize=9, arrowprops=line, **place)


def _limits(ax: Axes, low: float, high: float, bound: float | None) -> tuple[float, float]:
    """Of the values' axis: with the bound, whose line is drawn, if that leaves half of it to the data."""
    width = high - low
    if bound is not None:
        ax.axvline(bound, color=COLOURS[1], linewidth=1.6, label=f"bound {bound:g}")
        if max(high, bound) - min(low, bound) <= 2 * width:
            low, high = min(low, bound), max(high, bound)
    return low - 0.03 * width, high + 0.03 * width


def _panels(names: Sequence[str], title: str, size: tuple[float, float] = (5.0, 3.1), **kwargs: Any) -> Any:
    """A figure with as many axes, and these; no figure without names."""
    if not names:
        return None, []
    columns = min(len(names), 2 if len(names) <= 4 else 3)
    figure, axes = sheet(-(-len(names) // columns), columns, title=title, size=size, **kwargs)
    for ax in axes[: len(names)]:
        ax.locator_params(axis="x", nbins=6)
    for ax in axes[len(names) :]:
        ax.remove()
    return figure, axes[: len(names)]


def _name_axes(ax: Axes, ones: Sequence[AxisVariable], upward: str = "") -> None:
    label_axes(ax, ones[0].label, ones[1].label if ones[1:] else upward, legend=False)
    for axis, one in zip((ax.xaxis, ax.yaxis), ones, strict=False):
        if one.names:
            axis.set_ticks(range(len(one.names)), one.names)
