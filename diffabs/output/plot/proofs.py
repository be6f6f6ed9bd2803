"""The map of a proof: its cells, each coloured by the bound that is proved in it."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from matplotlib.collections import PatchCollection
from matplotlib.patches import Rectangle

from diffabs.output.plot.style import COLOURS, GREY, Axes, Figure, Patch, label_axes, sheet
from diffabs.robust.reach.extremes import is_wide

if TYPE_CHECKING:
    from diffabs.scenario.parameter_paths import BoxSide
    from diffabs.scenario.proofs import Proof

LEFT_HATCH, UNBOUNDED = "////", "#DDDDDD"
MANY_CELLS = 3000  # their lines would cover them


class ProofMap(NamedTuple):
    """What a map shows, for one or two parameters, in the units of its labels.

    Attributes:
        labels: Labels of the parameters, with unit.
        box: Low and high end of each parameter, shape (parameters, 2).
        cells: Proved cells, shape (cells, parameters, 2).
        bounds: Bound that is proved in each cell, shape (cells,); not finite where nothing is proved of the quantity.
        undecided: Cells that are not proved, shape (left, parameters, 2).
        refuting: Cell in which every run violates a claim, shape (parameters, 2), or None; it may be a point.
        worst: The worst run found, its parameters, shape (parameters,), or None.
        worst_value: Value of the quantity in that run.
        quantity: Label of the bounds, with unit.
        claimed: Bound that was claimed, or None.
        title: Title.
    """

    labels: Sequence[str]
    box: np.ndarray
    cells: np.ndarray
    bounds: np.ndarray
    undecided: np.ndarray
    refuting: np.ndarray | None
    worst: np.ndarray | None
    worst_value: float | None
    quantity: str
    claimed: float | None
    title: str


def map_proof(proof: "Proof", sides: Sequence["BoxSide"], title: str) -> ProofMap:
    """Return the map of the first claim's quantity, else of the greatest slip, over the parameters that vary.

    Raises:
        ValueError: Of the `sides` of the box not one or two have more than one value.
    """
    sides = [side for side in sides if is_wide(side.ends)]
    if len(sides) not in (1, 2):
        raise ValueError(f"a map has one or two parameters; {len(sides)} have more than one value")
    paths = list(proof.over)
    axes, scales = [paths.index(side.path) for side in sides], np.array([side.scale for side in sides])
    claims, cover = proof.claims, proof.cover
    quantity = claims[0].quantity if claims else "greatest slip"
    word, _, signal = quantity.rpartition(" ")
    bounds = np.empty(0)
    if cover.rows is not None:
        times = {"stop_time": cover.rows.time, "stop_distance": cover.rows.distance}
        columns = cover.rows.lower if word == "least" else cover.rows.upper
        bounds = columns[:, cover.prover.signals.index(signal)] if word else times[quantity][:, 1]
    kind = "lower" if word == "least" else "upper"
    worst, ranges = proof.extremes.worst.get(quantity), proof.extremes.ranges

    def in_units(cells: np.ndarray) -> np.ndarray:
        return cells[..., axes, :] * scales[:, None]

    return ProofMap(
        labels=[side.label for side in sides],
        box=in_units(np.array(list(proof.over.values()))),
        cells=in_units(cover.cells),
        bounds=bounds,
        undecided=in_units(cover.undecided),
        refuting=None if cover.refuting is None else in_units(cover.refuting),
        worst=None if worst is None else np.array(worst)[axes] * scales,
        worst_value=ranges[quantity][1] if quantity in ranges else None,
        quantity=f"proved {kind} bound of {signal.replace('_', ' ')} [{proof.unit_of(quantity)}]",
        claimed=claims[0].bound if claims else None,
        title=f"{title}\n{proof.verdict}{f': {claims[0]}' if claims else ''}",
    )


def draw_proof(shown: ProofMap) -> Figure:
    """Return the map of a proof: rectangles over two parameters, or the bounds over one."""
    figure, (ax,) = sheet(title=shown.title, size=(7.0, 4.8))
    if len(shown.labels) == 2:
        _draw_rectangles(figure, ax, shown)
    else:
        _draw_intervals(ax, shown)
    handles, names = ax.get_legend_handles_labels()
    if len(shown.undecided):
        handles.append(Patch(facecolor="none", edgecolor=GREY, hatch=LEFT_HATCH))
        names.append("not proved")
    if len(shown.labels) == 2 and not np.isfinite(shown.bounds).all():
        handles.append(Patch(facecolor=UNBOUNDED))
        names.append("proved, but no bound of this")
    if handles:
        figure.legend(handles, names, loc="outside lower center", ncols=3, frameon=False, fontsize=9.5)
    return figure


def _draw_rectangles(figure: Figure, ax: Axes, shown: ProofMap) -> None:
    """Draw the cells over two parameters."""
    ax.grid(visible=False)
    bounded = np.isfinite(shown.bounds)
    thin = 0.3 if len(shown.cells) < MANY_CELLS else 0.05
    if bounded.any():
        proved = PatchCollection(_rectangles(shown.cells[bounded]), cmap="viridis", edgecolor="white", linewidth=thin)
        proved.set_array(shown.bounds[bounded])
        ax.add_collection(proved)
        figure.colorbar(proved, ax=ax, label=shown.quantity)
    if not bounded.all():
        ax.add_collection(PatchCollection(_rectangles(shown.cells[~bounded]), facecolor=UNBOUNDED, edgecolor="white"))
    if len(shown.undecided):
        hatched = PatchCollection(_rectangles(shown.undecided), facecolor="none", edgecolor=GREY, hatch=LEFT_HATCH)
        hatched.set_linewidth(thin)
        ax.add_collection(hatched)
    if shown.refuting is not None:
        (x, width), (y, height) = ((low, high - low) for low, high in shown.refuting)
        ax.add_patch(Rectangle((x, y), width, height, facecolor="none", edgecolor=COLOURS[1], linewidth=2.0))
        _mark(ax, (x + width / 2, y + height / 2), "X", "refutes the claim")
    if shown.worst is not None:
        _mark(ax, shown.worst, "o", _describe_worst(shown))
    ax.set_xlim(*_widen(shown.box[0]))
    ax.set_ylim(*_widen(shown.box[1]))
    label_axes(ax, *shown.labels, legend=False)


def _draw_intervals(ax: Axes, shown: ProofMap) -> None:
    """Draw the bound of each cell over one parameter."""
    sides = shown.cells[:, 0]
    ax.hlines(shown.bounds, sides[:, 0], sides[:, 1], color=COLOURS[0], linewidth=2.0, label="proved")
    for low, high in shown.undecided[:, 0]:
        ax.axvspan(low, high, facecolor="none", edgecolor=GREY, hatch=LEFT_HATCH, linewidth=0.5)
    if shown.claimed is not None:
        ax.axhline(shown.claimed, color="black", linestyle="--", linewidth=1.1, label="claimed")
    if shown.refuting is not None:
        low, high = shown.refuting[0]
        ax.axvspan(low, high, color=COLOURS[1], alpha=0.4)
        ax.axvline((low + high) / 2, color=COLOURS[1], label="refutes the claim")
    if shown.worst is not None and shown.worst_value is not None:
        _mark(ax, (shown.worst[0], shown.worst_value), "o", _describe_worst(shown))
    ax.set_xlim(*_widen(shown.box[0]))
    label_axes(ax, shown.labels[0], shown.quantity, legend=False)


def _describe_worst(shown: ProofMap) -> str:
    return "worst run found" + ("" if shown.worst_value is None else f": {shown.worst_value:.6g}")


def _mark(ax: Axes, place: Sequence[float] | np.ndarray, marker: str, name: str) -> None:
    """Draw a marker that stays whole at the edge of the axes; a cross is black and lies above a dot."""
    cross = marker == "X"
    look = {"color": "black" if cross else COLOURS[1], "markersize": 8 if cross else 13, "zorder": 6 if cross else 5}
    ax.plot(*place, marker, markeredgecolor="white", linestyle="none", clip_on=False, label=name, **look)


def _rectangles(cells: np.ndarray) -> list[Rectangle]:
    """Return cells of two parameters as rectangles."""
    return [Rectangle((x[0], y[0]), x[1] - x[0], y[1] - y[0]) for x, y in cells]


def _widen(ends: np.ndarray, share: float = 0.02) -> tuple[float, float]:
    """Return a range with a margin on each side."""
    room = share * (ends[1] - ends[0])
    return float(ends[0] - room), float(ends[1] + room)
