"""Style of all figures: sheets, axes and their labels. It keeps no global state of matplotlib (the extra `plot`).

Speeds are drawn in km/h, everything else in SI units. The colours are safe for colour-blind readers. Curves that lie
close to each other differ in their dashes as well.

Source: M. Okabe and K. Ito, Color Universal Design (2008).
"""

import io
import os
import pathlib
import textwrap
from typing import Any

import numpy as np
from matplotlib.backend_bases import RendererBase

from diffabs.core.types import PyTree
from diffabs.host import files

try:
    from matplotlib.axes import Axes
    from matplotlib.colors import ListedColormap as ListedColormap
    from matplotlib.figure import Figure
    from matplotlib.patches import Patch as Patch
    from matplotlib.text import Text
    from matplotlib.ticker import Formatter, LogLocator, NullFormatter
except ModuleNotFoundError as error:
    raise ModuleNotFoundError('figures need matplotlib: pip install ".[plot]" in a clone', name=error.name) from error

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
DASHES = ("-", "--", "-.", ":", "-", "--", "-.")
GREY = "#767676"
KMH = 3.6  # km/h per m/s
DPI = 150
NOTEBOOK_DPI = 75  # a figure is as wide as a cell
FEW_DECADES, PLAIN = 2.0, 4  # below FEW_DECADES 2 and 5 have labels, too; powers of ten up to PLAIN are written out
RAISED = str.maketrans("-0123456789", "\u207b\u2070\u00b9\u00b2\u00b3\u2074\u2075\u2076\u2077\u2078\u2079")
TITLE_SIZE = 9  # characters per inch, with room to spare


class Sheet(Figure):
    """A figure that shows every text literally: a dollar sign in a title or a name starts no formula."""

    def draw(self, renderer: RendererBase) -> None:
        """Draw the figure with the `renderer`, without formulas in its texts."""
        for ax in self.axes:
            # matplotlib makes tick labels on access; without it findobj would miss them.
            _ = ax.get_xticklabels() + ax.get_yticklabels()
        for words in self.findobj(Text):
            words.set_parse_math(False)  # pyright: ignore[reportAttributeAccessIssue]
        super().draw(renderer)

    def _repr_png_(self) -> bytes:
        """Return the figure as a PNG, which a notebook shows for the last expression of a cell."""
        picture = io.BytesIO()
        self.savefig(picture, format="png", dpi=NOTEBOOK_DPI)
        return picture.getvalue()


def sheet(
    rows: int = 1, columns: int = 1, *, title: str = "", size: tuple[float, float] = (5.4, 3.4), **kwargs: Any
) -> tuple[Sheet, list[Axes]]:
    """Return an empty figure in the common style, and its axes as a list in reading order.

    Args:
        rows: Number of rows.
        columns: Number of columns.
        title: Title of the figure; long lines are wrapped.
        size: Width and height of one axes [inch].
        kwargs: Further arguments of `Figure.subplots`.
    """
    figure = Sheet(figsize=(size[0] * columns, size[1] * rows), dpi=DPI, layout="constrained")
    axes = list(figure.subplots(rows, columns, squeeze=False, **kwargs).flat)
    for ax in axes:
        ax.spines[["top", "right"]].set_visible(False)
        ax.spines[["left", "bottom"]].set_color(GREY)
        ax.tick_params(labelsize=10, colors="#333333")
        ax.grid(color="#DDDDDD", linewidth=0.7)
        ax.set_axisbelow(True)
    if title:
        width = int(TITLE_SIZE * size[0] * columns)
        lines = "\n".join(textwrap.fill(line, width, max_lines=4) for line in title.splitlines())
        figure.suptitle(lines, fontsize=12.5, fontweight="bold")
    return figure, axes


def label_axes(ax: Axes, x: str, y: str, title: str = "", *, legend: bool = True) -> None:
    """Label the axes, and show the legend if it has entries.

    Args:
        ax: Axes to label.
        x: Label of the horizontal axis, with unit.
        y: Label of the vertical axis, with unit.
        title: Title of the axes, or "".
        legend: Whether to show the legend.
    """
    ax.set_xlabel(x, fontsize=11)
    ax.set_ylabel(y, fontsize=11)
    if title:
        ax.set_title(title, fontsize=11)
    if legend and ax.get_legend_handles_labels()[1]:
        ax.legend(fontsize=9.5, framealpha=0.9, edgecolor="none")


def make_logarithmic(ax: Axes, axis: str) -> None:
    """Make an axis logarithmic, with as many labels as have room.

    Over two decades or more the labels are the decades. Over less they are 1, 2 and 5 of each decade, as plain numbers.

    Args:
        ax: Axes to change.
        axis: "x" or "y".
    """
    (ax.set_xscale if axis == "x" else ax.set_yscale)("log")
    scale_axis = ax.xaxis if axis == "x" else ax.yaxis
    scale_axis.set_major_locator(_Decades())
    scale_axis.set_major_formatter(_Powers())
    scale_axis.set_minor_formatter(NullFormatter())


class _Decades(LogLocator):
    """A locator of decades, with 2 and 5 of each over less than two decades."""

    def tick_values(self, vmin: float, vmax: float) -> np.ndarray:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Return the places of the labels between `vmin` and `vmax`."""
        decades = np.log10(vmax / vmin) if vmin > 0 else np.inf
        self.set_params(subs=(1.0, 2.0, 5.0) if decades < FEW_DECADES else (1.0,))
        places = np.asarray(super().tick_values(vmin, vmax))
        return places if decades >= FEW_DECADES else places[(places >= vmin) & (places <= vmax)]


class _Powers(Formatter):
    """A formatter with powers of ten over two decades or more, and plain numbers over less unless they are long."""

    def __call__(self, x: float, pos: int | None = None) -> str:
        """Return the label of the place x."""
        del pos
        low, high = np.sort(self.axis.get_view_interval())  # pyright: ignore[reportOptionalMemberAccess]
        few = low > 0 and np.log10(high / low) < FEW_DECADES
        if few and 10.0**-PLAIN <= x < 10.0 ** (PLAIN + 1):
            return f"{x:g}"
        # 1e-9 keeps the exponent if the logarithm of a power of ten is rounded down.
        power = int(np.floor(np.log10(x) + 1e-9)) if x > 0 else 0
        mantissa = x / 10.0**power
        head = "" if abs(mantissa - 1) < 1e-9 else f"{mantissa:g}\N{MULTIPLICATION SIGN}"
        return f"{head}10{str(power).translate(RAISED)}"


def save_figure(figure: Figure, path: str | os.PathLike[str]) -> pathlib.Path:
    """Write a figure to a file atomically, and return its path.

    Readers see the old file or the whole new one.

    Args:
        figure: Figure to write.
        path: Path of the file; its suffix is the format, PNG without a suffix.
    """
    path = pathlib.Path(path)
    with files.new_file(path) as temporary:
        figure.savefig(temporary, format=path.suffix.lstrip(".") or "png", dpi=DPI)
    return path


def curve_style(i: int) -> dict[str, Any]:
    """Return the colour and the dashes of a curve, as arguments of `plot`; those of the first 49 curves all differ."""
    return {"color": COLOURS[i % 7], "linestyle": DASHES[(i + i // 7) % 7]}


def control_label(unit: str) -> str:
    """Return the axis label of a plant's control.

    Args:
        unit: Unit of the control.
    """
    return {"N m": "brake torque [N m]", "V": "voltage [V]"}.get(unit, f"control [{unit}]")


def signal_label(output: PyTree) -> str:
    """Return the axis label of the signals of an output that have a target.

    Args:
        output: Output of a plant, with `units`.
    """
    names = getattr(output, "tracked", tuple(output.units)[:1])
    units = dict.fromkeys(output.units[name] for name in names)
    return f"{', '.join(map(spaced_name, names))} [{', '.join(units)}]"


def spaced_name(name: str) -> str:
    """Return the name of a signal or metric with spaces instead of underscores."""
    return name.replace("_", " ")
