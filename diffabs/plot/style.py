"""The look of all figures: sheets, axes and their words. The only importer of matplotlib (the extra
`plot`); it keeps no global state.

Speeds are drawn in km/h, everything else in SI units. Colours are those of M. Okabe and K. Ito, Color Universal Design
(2008), which colour-blind readers can tell apart; curves that lie close differ in their dashes as well.
"""

import json
import os
import pathlib
import textwrap
from typing import Any

import numpy as np

from diffabs.core import files, pictures

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
FEW_DECADES, PLAIN = 2.0, 4  # fewer have labels between them; powers of ten that are written out
RAISED = str.maketrans("-0123456789", "\u207b\u2070\u00b9\u00b2\u00b3\u2074\u2075\u2076\u2077\u2078\u2079")
TITLE_SIZE = 9  # characters per inch, with room to spare


class Sheet(Figure):
    """A figure that shows every text as it stands: a dollar sign, of a title or a name, begins no formula."""

    def draw(self, renderer: Any) -> None:
        """Draw it."""
        for ax in self.axes:
            _ = ax.get_xticklabels() + ax.get_yticklabels()  # made where they are asked for
        for words in self.findobj(Text):
            words.set_parse_math(False)  # pyright: ignore[reportAttributeAccessIssue]
        super().draw(renderer)


def sheet(rows: int = 1, columns: int = 1, *, title: str = "", size: tuple[float, float] = (5.4, 3.4), **kwargs: Any):
    """An empty figure in the house's look, and its axes, a list in reading order. `size` [inch] is that of one axes."""
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
    """Name the axes, with units, and show the legend if there is something in it."""
    ax.set_xlabel(x, fontsize=11)
    ax.set_ylabel(y, fontsize=11)
    if title:
        ax.set_title(title, fontsize=11)
    if legend and ax.get_legend_handles_labels()[1]:
        ax.legend(fontsize=9.5, framealpha=0.9, edgecolor="none")


def make_logarithmic(ax: Axes, axis: str) -> None:
    """Make an axis, "x" or "y", logarithmic, with as many labels as have room: over less than two decades 1, 2 and 5
    of each, as plain numbers, over more the decades."""
    (ax.set_xscale if axis == "x" else ax.set_yscale)("log")
    one = ax.xaxis if axis == "x" else ax.yaxis
    one.set_major_locator(_Decades())
    one.set_major_formatter(_Powers())
    one.set_minor_formatter(NullFormatter())


class _Decades(LogLocator):
    """Decades, and 2 and 5 of each where there are few."""

    def tick_values(self, vmin: float, vmax: float) -> Any:
        """Where labels are."""
        decades = np.log10(vmax / vmin) if vmin > 0 else np.inf
        self.set_params(subs=(1.0, 2.0, 5.0) if decades < FEW_DECADES else (1.0,))
        found = np.asarray(super().tick_values(vmin, vmax))
        return found if decades >= FEW_DECADES else found[(found >= vmin) & (found <= vmax)]


class _Powers(Formatter):
    """Powers of ten over many decades, plain numbers over few, unless they are long."""

    def __call__(self, x: float, pos: int | None = None) -> str:
        """The label of a place."""
        del pos
        low, high = np.sort(self.axis.get_view_interval())  # pyright: ignore[reportOptionalMemberAccess]
        few = low > 0 and np.log10(high / low) < FEW_DECADES
        if few and 10.0**-PLAIN <= x < 10.0 ** (PLAIN + 1):
            return f"{x:g}"
        power = int(np.floor(np.log10(x) + 1e-9)) if x > 0 else 0
        mantissa = x / 10.0**power
        head = "" if abs(mantissa - 1) < 1e-9 else f"{mantissa:.0f}\N{MULTIPLICATION SIGN}"
        return f"{head}10{str(power).translate(RAISED)}"


def save_figure(figure: Figure, path: str | os.PathLike[str]) -> pathlib.Path:
    """Write a figure in the format of the path's suffix, atomically: readers see the old file or the whole new one. A
    PNG has the numbers that it shows in it (`plot.shown`)."""
    path = pathlib.Path(path)
    with files.new_file(path) as temporary:
        write_figure(figure, temporary, path.suffix.lstrip(".") or "png")
    return path


def write_figure(figure: Figure, path: pathlib.Path, kind: str) -> None:
    """Write a figure in a format."""
    from diffabs.plot import shown

    figure.savefig(path, format=kind, dpi=DPI)
    if kind == "png":  # drawing has set the places of the axes
        text = json.dumps(shown.describe_axes(figure), separators=(",", ":"), allow_nan=False)
        path.write_bytes(pictures.with_text(path.read_bytes(), pictures.AXES_KEY, text))


def control_label(unit: str) -> str:
    """What an axis says of a plant's control in this unit."""
    return {"N m": "brake torque [N m]", "V": "voltage [V]"}.get(unit, f"control [{unit}]")


def signal_label(output: Any) -> str:
    """Return what an axis says of the first signal of an output."""
    name, unit = next(iter(output.units.items()))
    return f"{spaced_name(name)} [{unit}]"


def spaced_name(name: str) -> str:
    """Return what an axis says of a signal or a metric."""
    return name.replace("_", " ")
