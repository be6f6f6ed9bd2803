"""Curves, fan and poles as options of Apache ECharts, which draws the page's charts.

Numbers are stored in columns, once each.
"""

import math

import numpy as np

from diffabs.core.types import JsonObject
from diffabs.output.explore.panels import AIMS, DISPLAY_ROUNDING, Curves, Fan, Panel
from diffabs.output.explore.stability import Stability

BLUE, RED, GREEN, GREY, INK = "#0072B2", "#D55E00", "#009E73", "#767676", "#1F2933"
CURVE_COLOURS = (BLUE, RED, GREEN, "#CC79A7", "#E69F00", "#56B4E9")
CHART_DIGITS = 7  # significant digits of the numbers that go to the browser; a signal may move little, far from 0
QUANTITIES = {"rad": "angle", "rad/s": "rate", "km/h": "speed", "N m": "torque", "V": "voltage"}
OUTER, INNER = "5 to 95 % of the fan", "25 to 75 %"
BEFORE = "before"
FONT = "'Inter', 'Roboto', system-ui, sans-serif"
LIMIT_ROOM = 1.5  # the control's axis ends at this multiple of its largest magnitude
TOP, BOTTOM, BETWEEN = 6.0, 7.5, 6.5  # margins and gaps of the panels in percent of the height


def run_chart(curves: Curves) -> JsonObject:
    """Return the options of the chart of a run: axes, legends, and all lines, also those without data yet."""
    shown, change = curves.panels, change_curves(curves)
    count = len(shown)
    height = (100 - TOP - BOTTOM - BETWEEN * (count - 1)) / count
    tops = [TOP + i * (height + BETWEEN) for i in range(count)]
    return {
        "animation": False,
        "textStyle": {"fontFamily": FONT, "color": INK},
        "grid": [{"left": 68, "right": 18, "top": f"{top:.2f}%", "height": f"{height:.2f}%"} for top in tops],
        "legend": [_legend(panel, i, top) for i, (panel, top) in enumerate(zip(shown, tops, strict=True))],
        "tooltip": {
            "trigger": "axis",
            "confine": True,
            "textStyle": {"fontSize": 12},
            ":valueFormatter": "v => v == null || isNaN(v) ? '-' : (+v).toPrecision(4)",
        },
        "dataZoom": [{"type": "inside", "xAxisIndex": list(range(count)), "filterMode": "none"}],
        "axisPointer": {"link": [{"xAxisIndex": "all"}], "label": {"precision": 3}},
        "xAxis": [_x(i, last=i == count - 1) for i in range(count)],
        "yAxis": [_y(panel, i) | change["yAxis"][i] for i, panel in enumerate(shown)],
        # Series refer to these datasets by id: a change replaces columns and leaves the series alone.
        "dataset": [*change["dataset"], *({"id": name, "source": {"t": []}} for name in ("before", "fan"))],
        "series": [line for i, panel in enumerate(shown) for line in _series(panel, i)],
    }


def change_curves(curves: Curves, dataset: str = "now") -> JsonObject:
    """Return the change of the chart that shows a run.

    Args:
        dataset: "now" for the current run with all its curves, "before" for the `compared` signals of a run to compare
            with.
    """
    source = {"t": round_for_screen(curves.t)}
    for i, panel in enumerate(curves.panels):
        lines = panel.lines if dataset == "now" else panel.compared
        source |= {f"{i}.{j}": round_for_screen(line.values) for j, line in enumerate(lines)}
    change: JsonObject = {"dataset": [{"id": dataset, "source": source}]}
    if dataset == "now":
        change["yAxis"] = [_limits(panel) for panel in curves.panels]
    return change


def change_fan(fan: Fan | None) -> JsonObject:
    """Return the change of the chart that shows a fan; None removes it."""
    if fan is None:
        return clear_curves("fan")
    source = {"t": round_for_screen(fan.t)}
    for i, bands in enumerate(fan.bands):
        for k, (low, quarter, _, third, high) in enumerate(bands):
            # Stacked areas: each entry is the distance to the quantile below.
            steps = (low, quarter - low, third - quarter, high - third)
            source |= {f"{i}.{k}.{j}": round_for_screen(values) for j, values in enumerate(steps)}
    return {"dataset": [{"id": "fan", "source": source}]}


def change_time_axis(end: float | None) -> JsonObject:
    """Return the change of the chart that sets the end of the time axis [s]; None shows the whole run."""
    return {
        "dataZoom": [
            {"start": 0, "end": 100} if end is None else {"startValue": 0, "endValue": round_for_screen([end])[0]}
        ]
    }


def clear_curves(dataset: str) -> JsonObject:
    """Return the change of the chart that removes curves, "before" or "fan"."""
    return {"dataset": [{"id": dataset, "source": {"t": []}}]}


def pole_chart() -> JsonObject:
    """Return the options of the empty map of poles in the s-plane; modes decay in the left half plane."""
    axis = {
        "type": "value",
        "nameLocation": "middle",
        "nameTextStyle": {"fontSize": 11},
        "axisLabel": {"fontSize": 10, "showMaxLabel": True},
    }
    axis |= {"splitLine": {"lineStyle": {"color": "#E4E7EB"}}, "axisLine": {"onZero": False}}
    unstable = {"silent": True, "itemStyle": {"color": "rgba(213,94,0,0.10)"}, "data": []}
    crosses = {"type": "scatter", "symbol": CROSS, "encode": {"x": 0, "y": 1}}
    return {
        "animation": False,
        "textStyle": {"fontFamily": FONT, "color": INK},
        "grid": {"left": 58, "right": 14, "top": 12, "bottom": 40},
        "tooltip": {"confine": True, ":formatter": POLE},
        "xAxis": {
            **axis,
            "axisLabel": {"fontSize": 10, "showMaxLabel": False},
            "name": "real part [1/s]",
            "nameGap": 24,
        },
        "yAxis": {**axis, "name": "imaginary part [rad/s]", "nameGap": 42},
        "series": [
            {"id": "box", **crosses, "symbolSize": 6, "itemStyle": {"color": "#9AA5B1"}, "data": []},
            {"id": "poles", **crosses, "symbolSize": 11, "itemStyle": {"color": BLUE}, "data": []}
            | {"markArea": unstable},
        ],
    }


DASH = "path://M0,6 h18 v3 h-18 Z M0,0 h18 v0.01 h-18 Z M0,15 h18 v0.01 h-18 Z"  # empty rectangles centre the line
CROSS = "path://M0,12 L12,0 L14,2 L2,14 Z M0,2 L2,0 L14,12 L12,14 Z"
POLE = (
    "p => { const [x, y] = p.data, w = Math.hypot(x, y);"
    " return `${x.toPrecision(4)} ${y < 0 ? '-' : '+'} ${Math.abs(y).toPrecision(4)} j 1/s<br>`"
    " + `damping ${(-x / w).toPrecision(3)}, ${w.toPrecision(4)} rad/s`; }"
)


def change_poles(stability: Stability | None) -> JsonObject:
    """Return the change of the map that shows the poles of a loop; None empties the map.

    Poles of a sampled loop are shown as ln(z)/T.
    """
    here = _points(stability.poles, stability.period) if stability else []
    around = _points(stability.box.poles, stability.period) if stability else []
    x, y = (np.array([point[i] for point in here + around] or [-1.0]) for i in (0, 1))
    far = _round_up_nicely(1.05 * max(float(np.max(np.abs(x))), 1e-3))
    right = max(0.1 * far, _round_up_nicely(1.05 * float(x.max())) if x.max() > 0 else 0.0)
    high = _round_up_nicely(1.1 * max(float(np.max(np.abs(y))), 0.1 * far))
    area = {"data": [[{"xAxis": 0}, {"xAxis": right}]]}
    return {
        "xAxis": [{"min": -far, "max": right, "interval": _tick_interval(far)}],
        "yAxis": [{"min": -high, "max": high, "interval": high / 2}],
        "series": [{"id": "box", "data": around}, {"id": "poles", "data": here, "markArea": area}],
    }


def _points(values: np.ndarray, period: float | None) -> list[list[float]]:
    poles = np.asarray(values, complex)
    poles = poles[np.isfinite(poles)]  # a loop that is not well-posed has none
    if period is not None:
        poles = np.log(poles[np.abs(poles) > 1e-9]) / period  # a pole at z = 0 is a delay; its logarithm is -inf
    return [[float(f"{p.real:.5g}"), float(f"{p.imag:.5g}")] for p in poles]


def round_for_screen(values: object) -> list[float | None]:
    """Return numbers rounded to `CHART_DIGITS` digits, with None for numbers that are not finite."""
    numbers = np.asarray(values, float).tolist()
    return [float(f"{x:.{CHART_DIGITS}g}") if math.isfinite(x) else None for x in numbers]


def _legend(panel: Panel, i: int, top: float) -> JsonObject:
    names = [*dict.fromkeys(line.name for line in panel.lines)] + ([BEFORE, OUTER, INNER] if i == 0 else [])
    style = {"fontSize": 11, "color": INK}
    place = {"right": 18, "top": f"{top - 5.2:.2f}%", "itemWidth": 18, "itemHeight": 8, "itemGap": 12, "icon": DASH}
    return {"data": names, "textStyle": style, **place}


def _x(i: int, *, last: bool) -> JsonObject:
    name = {"name": "time [s]", "nameLocation": "middle", "nameGap": 26} if last else {}
    return {
        "type": "value",
        "gridIndex": i,
        "min": 0,
        "axisLabel": {"show": last, "fontSize": 11, "hideOverlap": True, ":formatter": "v => +v.toPrecision(3)"},
        "axisTick": {"show": last},
        "splitLine": {"lineStyle": {"color": "#EDF0F2"}},
        "axisLine": {"onZero": False, "lineStyle": {"color": "#9AA5B1"}},
        "nameTextStyle": {"fontSize": 12, "color": INK},
        **name,
    }


def _y(panel: Panel, i: int) -> JsonObject:
    return {
        "type": "value",
        "gridIndex": i,
        "scale": True,  # a level may move little, and far from 0
        "name": axis_label(panel),
        "nameLocation": "middle",
        "nameGap": 48,
        "nameTextStyle": {"fontSize": 12, "color": INK},
        "splitNumber": 4,
        "axisLabel": {"fontSize": 11},
        "splitLine": {"lineStyle": {"color": "#EDF0F2"}},
        "axisLine": {"show": True, "onZero": False, "lineStyle": {"color": "#9AA5B1"}},
    }


def axis_label(panel: Panel) -> str:
    """Return the label of a panel's vertical axis: quantity and unit."""
    signals = [line.name for line in panel.lines if line.name not in AIMS]
    single = signals[0] if len(signals) == 1 and signals[0] != "control" else ""
    words = panel.quantity or single or QUANTITIES.get(panel.unit, "")
    return f"{words or ', '.join(signals[:2])} [{panel.unit}]"


def _series(panel: Panel, i: int) -> list[JsonObject]:
    chart = {"type": "line", "xAxisIndex": i, "yAxisIndex": i, "showSymbol": False, "symbol": "none"}
    series, several = [], len(panel.compared) > 1
    for k in range(len(panel.compared)):
        colour = CURVE_COLOURS[k % len(CURVE_COLOURS)]
        series += _bands(chart, f"{i}.{k}", colour, light=several)
        before = {"lineStyle": {"color": colour if several else GREY, "width": 1.5, "type": [6, 3]}, "z": 2}
        before |= {"itemStyle": {"color": GREY}, "encode": {"x": "t", "y": f"{i}.{k}"}}
        series.append({**chart, "name": BEFORE, "datasetId": "before", **before})
    signals = sum(line.name not in AIMS for line in panel.lines)
    followed = sum(line.name == panel.lines[-1].name for line in panel.lines)
    for j, line in enumerate(panel.lines):
        aim = line.name in AIMS
        # Aims of several signals have the colours of their signals, in the same order.
        place = (j - signals) % followed if aim else j
        colour = CURVE_COLOURS[place % len(CURVE_COLOURS)]
        if aim and followed == 1:
            colour = INK if line.name == "setpoint" else RED
        width = 2.0 if j == 0 else 1.4 if followed == 1 or not aim else 1.0
        look = {"lineStyle": {"color": colour, "width": width, "type": AIMS.get(line.name, "solid")}}
        look |= {"itemStyle": {"color": colour}, "z": 4 if j == 0 else 3}
        series.append({**chart, "name": line.name, "datasetId": "now", "encode": {"x": "t", "y": f"{i}.{j}"}, **look})
    return series


def _bands(chart: JsonObject, place: str, colour: str, *, light: bool) -> list[JsonObject]:
    """Return the areas of the fan of a signal, whose columns begin with `place`; `light` ones may overlap."""
    # The lowest band of the stack is transparent; it lifts the others to the 5 % quantile.
    hidden = {**chart, "datasetId": "fan", "stack": f"fan {place}", "stackStrategy": "all", "silent": True}
    hidden |= {"lineStyle": {"width": 0}, "tooltip": {"show": False}, "z": 1}
    names = ("", OUTER, INNER, OUTER)
    shades = (0.0, 0.08, 0.16, 0.08) if light else (0.0, 0.13, 0.26, 0.13)
    return [
        {**hidden, "name": name or f"fan {place}", "encode": {"x": "t", "y": f"{place}.{j}"}}
        | {"areaStyle": {"color": colour, "opacity": shade}, "itemStyle": {"color": "#8FBFDC" if j != 2 else "#5FA3CC"}}
        for j, (name, shade) in enumerate(zip(names, shades, strict=True))
    ]


def _limits(panel: Panel) -> JsonObject:
    """Return the limits of a control's axis from the delivered control, and nothing for other axes.

    The command may lie far beyond the control's range.
    """
    if panel.lines[-1].name != "command":
        return {}
    values = np.concatenate([line.values for line in panel.lines if line.name != "command"])
    values = values[np.isfinite(values)]
    greatest = float(np.max(np.abs(values))) if values.size else 0.0
    if greatest < DISPLAY_ROUNDING:
        return {"min": -1, "max": 1}
    nice = _round_up_nicely(LIMIT_ROOM * greatest)
    low, high = -nice if values.min() < 0 else 0, nice if values.max() > 0 else 0
    return {"min": low, "max": high, "interval": nice / 2 if low and high else _tick_interval(nice)}


def _tick_interval(end: float) -> float:
    """Return the tick distance of an axis from 0 to a number of `_round_up_nicely`, for three to five intervals."""
    # Formatting gives exact keys: 0.3/0.1 is 2.9999... in binary.
    mantissa = float(f"{end:.1e}".partition("e")[0])
    return end / {1.0: 4, 1.5: 3, 2.0: 4, 3.0: 3, 4.0: 4, 5.0: 5, 6.0: 3, 8.0: 4}[mantissa]


def _round_up_nicely(value: float) -> float:
    """Return the next larger of 1, 1.5, 2, 3, 4, 5, 6, 8, 10 times a power of ten."""
    unit = 10.0 ** math.floor(math.log10(value))
    return next(float(f"{n * unit:.12g}") for n in (1, 1.5, 2, 3, 4, 5, 6, 8, 10) if n * unit >= value * (1 - 1e-9))
