"""The path of a run seen from above as options of Apache ECharts."""

import numpy as np

from diffabs.core.types import JsonObject
from diffabs.output.explore.charts import BLUE, FONT, GREY, INK, round_for_screen
from diffabs.output.explore.panels import Path, Strip
from diffabs.output.explore.path import PATH_RATIO

# Margins of the axes in percent of the element; with its ratio, in the style sheet, the axes are equal.
AXES_MARGINS = {"left": 7.0, "right": 2.0, "top": 4.0, "bottom": 26.0}
ELEMENT_RATIO = (
    PATH_RATIO
    * (100 - AXES_MARGINS["top"] - AXES_MARGINS["bottom"])
    / (100 - AXES_MARGINS["left"] - AXES_MARGINS["right"])
)
SLIPPERY, ROUGH = np.array([205, 229, 250]), np.array([214, 214, 214])  # colours of frictions 0 and 1
DECIMALS = 6  # of lengths and angles: a straight path has rounding errors
LABELLED_SHARE = 0.1  # of the window: shorter surfaces have no label
PLACE = (
    "p => { const [x, y, t, yaw] = p.value;"
    " return `${(+t).toPrecision(3)} s: x = ${(+x).toPrecision(3)} m, y = ${(+y).toPrecision(3)} m, "
    "yaw = ${(yaw * 180 / Math.PI).toPrecision(3)}°`; }"
)


def path_chart(path: Path) -> JsonObject:
    """Return the options of the chart of a path: the road, the path, outlines, and a path to compare with."""
    axis = {"type": "value", "nameLocation": "middle", "nameTextStyle": {"fontSize": 11}, "axisLabel": {"fontSize": 10}}
    axis |= {"axisLine": {"onZero": False, "lineStyle": {"color": "#9AA5B1"}}, "splitLine": {"show": False}}
    axis["axisLabel"] |= {"showMinLabel": False, "showMaxLabel": False, ":formatter": "v => +v.toPrecision(3)"}
    line = {"type": "line", "symbol": "circle", "encode": {"x": "x", "y": "y"}}
    quiet = {**line, "showSymbol": False, "silent": True}
    change = change_path(path)
    x, y = change["xAxis"][0], change["yAxis"][0]
    road = {"silent": True, "label": {"position": "insideTopLeft", "fontSize": 10, "color": GREY}}
    return {
        "animation": False,
        "textStyle": {"fontFamily": FONT, "color": INK},
        "grid": {side: f"{percent:g}%" for side, percent in AXES_MARGINS.items()},
        "tooltip": {"confine": True, ":formatter": PLACE, "textStyle": {"fontSize": 12}},
        "xAxis": {**axis, **x, "name": "place along the road [m]", "nameGap": 22},
        "yAxis": {**axis, **y, "name": "to the left [m]", "nameGap": 28, "splitNumber": 3},
        "dataset": [*change["dataset"], {"id": "before", "source": {"x": [], "y": []}}],
        "series": [
            {**quiet, "datasetId": "before", "lineStyle": {"color": GREY, "width": 1.5, "type": [6, 3]}, "z": 3},
            {**quiet, "datasetId": "outlines", "lineStyle": {"color": INK, "width": 1}, "z": 3},
            {
                **line,
                "id": "path",
                "datasetId": "now",
                "symbolSize": 7,
                "lineStyle": {"color": BLUE, "width": 2},
                "z": 4,
            }
            | {"itemStyle": {"color": BLUE, "opacity": 0}, "emphasis": {"itemStyle": {"opacity": 1}}}
            | {"markArea": road | change["series"][0]["markArea"]},
        ],
    }


def change_path(path: Path) -> JsonObject:
    """Return the change of the chart that shows a path."""
    # A missing point between two outlines keeps them apart.
    apart = np.pad(path.outlines, ((0, 0), (0, 1), (0, 0)), constant_values=np.nan).reshape(-1, 2)
    (x_low, x_high), (y_low, y_high) = path.window
    areas = [_area(strip, x_high - x_low) for strip in path.strips]
    return {
        "xAxis": [{"min": x_low, "max": x_high}],
        "yAxis": [{"min": y_low, "max": y_high}],
        "dataset": [
            {"id": "now", "source": _columns(x=path.x, y=path.y, t=path.t, yaw=path.yaw)},
            {"id": "outlines", "source": _columns(x=apart[:, 0], y=apart[:, 1])},
        ],
        "series": [{"id": "path", "markArea": {"data": areas}}],
    }


def change_path_before(path: Path | None) -> JsonObject:
    """Return the change of the chart that shows a path to compare with; None removes it."""
    source = _columns(x=path.x, y=path.y) if path else {"x": [], "y": []}
    return {"dataset": [{"id": "before", "source": source}]}


def _columns(**values: np.ndarray) -> JsonObject:
    return {name: round_for_screen(np.round(column, DECIMALS)) for name, column in values.items()}


def _area(strip: Strip, width: float) -> list[JsonObject]:
    """Return a coloured rectangle with its friction."""
    red, green, blue = (SLIPPERY + (ROUGH - SLIPPERY) * min(strip.friction, 1.0)).round().astype(int).tolist()
    labelled = strip.x[1] - strip.x[0] > LABELLED_SHARE * width
    words = f"friction {strip.friction:.2f}" if labelled else ""
    first = {"xAxis": strip.x[0], "yAxis": strip.y[0], "name": words}
    return [first | {"itemStyle": {"color": f"rgb({red},{green},{blue})"}}, {"xAxis": strip.x[1], "yAxis": strip.y[1]}]
