"""|S|, Nyquist and Bode curves of a linearised loop as options of Apache ECharts."""

import math
from collections.abc import Sequence

import numpy as np

from diffabs.core.types import JsonObject
from diffabs.output.explore.charts import BLUE, FONT, GREY, INK, RED, round_for_screen
from diffabs.output.explore.stability import BoxCurves, LoopCurves

LEAST_S_DB, S_TICK_DB = -40.0, 10  # lower end of the axis of |S|, and distance of its ticks
LEAST_L_DB, L_TICK_DB = -60.0, 20  # the same of |L|
PHASE_TICK, MOST_PHASE_TICKS = 90, 4  # degrees between two ticks; intervals before their distance doubles
LEAST_PHASE = -720.0  # lower end of the axis of the phase; a delay turns on without end [degrees]
# The window of the Nyquist chart, around -1, and its size on the screen. Both have the same ratio, so axes are equal.
NYQUIST_WINDOW = {"xAxis": (-3, 2), "yAxis": (-2, 2)}
NYQUIST_SIZE = {"width": 210, "height": 168}  # px
CIRCLE_POINTS = 72
LIGHT_BLUE, GRID_GREY = "rgba(0,114,178,0.28)", "#E4E7EB"

CURVE_LINE: JsonObject = {"type": "line", "showSymbol": False, "symbol": "none"}
DECIBELS = "v => v == null || isNaN(v) ? '-' : `${(+v).toPrecision(3)} dB`"
DEGREES = "v => v == null || isNaN(v) ? '-' : `${(+v).toPrecision(4)}°`"
POINT_OF_L = (
    "p => { const [re, im, w] = p.value;"
    " return `L = ${(+re).toPrecision(3)} ${im < 0 ? '-' : '+'} ${Math.abs(im).toPrecision(3)} j<br>`"
    " + `${(+w).toPrecision(4)} rad/s, |1 + L| = ${Math.hypot(1 + re, im).toPrecision(3)}`; }"
)


def sensitivity_chart() -> JsonObject:
    """Return the options of the empty chart of |S| over frequency: band of the box, loop, and goal."""
    curve, goal = _style(BLUE, 2, 4), _style(RED, 1.4, 3, "dashed")
    return _frame() | {
        "grid": {"left": 58, "right": 14, "top": 12, "bottom": 40},
        "tooltip": {"trigger": "axis", "confine": True, ":valueFormatter": DECIBELS},
        "axisPointer": {"label": {"precision": 3}},
        "xAxis": _axis("frequency [rad/s]", 24, type="log"),
        "yAxis": _axis("|S| [dB]", 42),
        "dataset": [
            {"id": "here", "source": {"w": [], "s": [], "goal": []}},
            {"id": "box", "source": {"w": [], "low": [], "step": []}},
        ],
        "series": [
            *_band("box", "low", "step"),
            {**CURVE_LINE, "name": "|S|", "datasetId": "here", "encode": {"x": "w", "y": "s"}, **curve},
            {**CURVE_LINE, "name": "goal", "datasetId": "here", "encode": {"x": "w", "y": "goal"}, **goal},
        ],
    }


def change_sensitivity(here: LoopCurves, box: BoxCurves, *, moved: bool) -> JsonObject:
    """Return the change of the chart that shows |S| of a loop, its goal, and the range over the box.

    The box is left as it was unless it has `moved`.
    """
    low, high, line, goal = (_to_db(gain) for gain in (box.low, box.high, here.gain, here.goal))
    limits = _tick_limits([low, high, line, goal], S_TICK_DB, LEAST_S_DB)
    axes: JsonObject = {"xAxis": [_decades(here, box)], "yAxis": [limits]}
    sources = {"here": {"w": here.w, "s": line, "goal": goal}}
    return axes | _datasets(sources | ({"box": {"w": box.w, "low": low, "step": high - low}} if moved else {}))


def nyquist_chart() -> JsonObject:
    """Return the options of the empty Nyquist chart: L, its mirror image, L over the box, -1, and the circle of the
    goal, which a loop within the goal does not enter.
    """
    axes = {name: {"min": low, "max": high} for name, (low, high) in NYQUIST_WINDOW.items()}
    dots = {"type": "line", "showSymbol": True, "symbol": "circle", "symbolSize": 7}
    curve = _style(BLUE, 2, 4) | {"itemStyle": {"opacity": 0}, "emphasis": {"itemStyle": {"opacity": 1}}}
    quiet = {**CURVE_LINE, "silent": True}
    return _frame() | {
        "grid": {"left": 58, "top": 12, **NYQUIST_SIZE},
        "tooltip": {"confine": True, ":formatter": POINT_OF_L},
        "xAxis": _axis("real part of L", 24, interval=1) | axes["xAxis"],
        "yAxis": _axis("imaginary part of L", 30, interval=1) | axes["yAxis"],
        "dataset": [
            {"id": "here", "source": {"re": [], "im": [], "w": [], "mirrored": []}},
            {"id": "box", "source": {"re": [], "im": []}},
            {"id": "goal", "source": {"re": [], "im": []}},
        ],
        "series": [
            {**quiet, "name": "box", "datasetId": "box", "encode": {"x": "re", "y": "im"}, **_style(LIGHT_BLUE, 1, 2)},
            {**quiet, "name": "mirror", "datasetId": "here", "encode": {"x": "re", "y": "mirrored"}}
            | _style(BLUE, 0.8, 3, "dotted"),
            {**dots, "name": "L", "datasetId": "here", "encode": {"x": "re", "y": "im"}, **curve},
            {**quiet, "name": "goal", "datasetId": "goal", "encode": {"x": "re", "y": "im"}}
            | _style(RED, 1.4, 3, "dashed"),
            {"type": "scatter", "name": "-1", "symbol": PLUS, "symbolSize": 11, "silent": True}
            | {"itemStyle": {"color": RED}, "data": [[-1, 0]], "z": 5},
        ],
    }


PLUS = "path://M5,0 h2 v5 h5 v2 h-5 v5 h-2 v-5 h-5 v-2 h5 Z"


def change_nyquist(here: LoopCurves, box: BoxCurves, *, moved: bool) -> JsonObject:
    """Return the change of the Nyquist chart that shows L of a loop, |1 + L| = 1/Ms of its goal, and L over the box.

    The box is left as it was unless it has `moved`.
    """
    re, im = np.real(here.opened), np.imag(here.opened)
    angles = np.linspace(0, 2 * np.pi, CIRCLE_POINTS + 1)
    circle = -1 + np.exp(1j * angles) / here.peak if math.isfinite(here.peak) else np.empty(0)
    sources = {
        "here": {"re": re, "im": im, "w": here.w, "mirrored": -im},
        "goal": {"re": np.real(circle), "im": np.imag(circle)},
    }
    if moved:
        # A missing point between two loops keeps their lines apart.
        apart = np.pad(box.opened, ((0, 0), (0, 1)), constant_values=math.nan).ravel()
        sources["box"] = {"re": np.real(apart), "im": np.imag(apart)}
    return _datasets(sources)


def bode_chart() -> JsonObject:
    """Return the options of the empty Bode chart: magnitude above phase of L, each with the band of the box."""
    upper, lower = {"xAxisIndex": 0, "yAxisIndex": 0}, {"xAxisIndex": 1, "yAxisIndex": 1}
    grid = {"left": 58, "right": 14}
    curve = _style(BLUE, 2, 4)
    return _frame() | {
        "grid": [{**grid, "top": 10, "height": 80}, {**grid, "top": 104, "height": 76}],
        "tooltip": {"trigger": "axis", "confine": True},
        "axisPointer": {"link": [{"xAxisIndex": "all"}], "label": {"precision": 3}},
        "xAxis": [
            _axis("", 24, type="log", gridIndex=0) | {"axisLabel": {"show": False}},
            _axis("frequency [rad/s]", 24, type="log", gridIndex=1),
        ],
        "yAxis": [_axis("|L| [dB]", 42, gridIndex=0), _axis("phase [°]", 42, gridIndex=1)],
        "dataset": [
            {"id": "here", "source": {"w": [], "db": [], "phase": []}},
            {"id": "box", "source": {"w": [], "low": [], "step": [], "lag": [], "turn": []}},
        ],
        "series": [
            *(band | upper for band in _band("box", "low", "step")),
            *(band | lower for band in _band("box", "lag", "turn")),
            {**CURVE_LINE, "name": "|L|", "datasetId": "here", "encode": {"x": "w", "y": "db"}, **curve, **upper}
            | {"tooltip": {":valueFormatter": DECIBELS}, "markLine": _guide(0)},
            {**CURVE_LINE, "name": "phase", "datasetId": "here", "encode": {"x": "w", "y": "phase"}, **curve, **lower}
            | {"tooltip": {":valueFormatter": DEGREES}, "markLine": _guide(-180)},
        ],
    }


def change_bode(here: LoopCurves, box: BoxCurves, *, moved: bool) -> JsonObject:
    """Return the change of the Bode chart that shows L of a loop, and its range over the box.

    The box is left as it was unless it has `moved`.
    """
    around = _to_db(np.abs(box.opened))
    turned = _box_phases(box)
    phase, line = _phase_beside(here, box, turned), _to_db(np.abs(here.opened))
    (low, high), (lag, lead) = (_range(values, box.w.size) for values in (around, turned))
    x = _decades(here, box)
    phases = _tick_limits([phase, lag, lead], PHASE_TICK, LEAST_PHASE)
    intervals = (phases["max"] - phases["min"]) / PHASE_TICK if phases else 0
    phases |= {"interval": PHASE_TICK * math.ceil(intervals / MOST_PHASE_TICKS)} if phases else {}
    axes: JsonObject = {"xAxis": [x, x], "yAxis": [_tick_limits([low, high, line], L_TICK_DB, LEAST_L_DB), phases]}
    sources = {"here": {"w": here.w, "db": line, "phase": phase}}
    if moved:
        sources["box"] = {"w": box.w, "low": low, "step": high - low, "lag": lag, "turn": lead - lag}
    return axes | _datasets(sources)


def _box_phases(box: BoxCurves) -> np.ndarray:
    """Return the phase of each loop of a box [degrees], continuous; at the crossover of the first loop all are within
    half a turn of that loop.
    """
    if not len(box.opened):
        return np.empty((0, 0))
    angles = np.degrees(np.unwrap(np.angle(box.opened)))
    place = _crossover_place(box.opened[0])
    angles[0] -= 360 * np.ceil(angles[0, place] / 360)
    return angles - 360 * np.round((angles[:, place, None] - angles[0, place]) / 360)


def _phase_beside(here: LoopCurves, box: BoxCurves, turned: np.ndarray) -> np.ndarray:
    """Return the phase of L [degrees], continuous; at its crossover it is within half a turn of the box, or without
    one in (-360, 0].
    """
    angles = np.degrees(np.unwrap(np.angle(here.opened)))
    place = _crossover_place(here.opened)
    if len(turned):
        beside = np.interp(np.log(here.w[place]), np.log(box.w), turned[0])
        return angles - 360 * np.round((angles[place] - beside) / 360)
    return angles - 360 * np.ceil(angles[place] / 360)


def _crossover_place(opened: np.ndarray) -> int:
    """Return the index at which |L| is closest to 1."""
    with np.errstate(divide="ignore"):
        return int(np.argmin(np.abs(np.log(np.abs(opened)))))


def _range(values: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the least and the greatest values (k, n) at each frequency; empty without loops."""
    return (values.min(axis=0), values.max(axis=0)) if len(values) else (np.empty(count), np.empty(count))


def _decades(here: LoopCurves, box: BoxCurves) -> JsonObject:
    """Return the limits of an axis of frequency, whole powers of ten."""
    w = np.concatenate([here.w, box.w])
    return {"min": 10.0 ** math.floor(math.log10(w.min())), "max": 10.0 ** math.ceil(math.log10(w.max()))}


def _tick_limits(curves: Sequence[np.ndarray], tick: int, lower_end: float) -> JsonObject:
    """Return limits of an axis at multiples of a tick, not below its lower end; nothing without finite values."""
    values = np.concatenate(curves)
    values = values[np.isfinite(values)]
    if not values.size:
        return {}
    bottom, top = tick * math.floor(values.min() / tick), tick * math.ceil(values.max() / tick)
    return {"min": max(lower_end, bottom), "max": max(top, bottom + tick), "interval": tick}


def _to_db(gain: np.ndarray) -> np.ndarray:
    with np.errstate(divide="ignore"):  # a zero has -inf dB, which the chart leaves out
        return 20 * np.log10(gain)


def _datasets(sources: dict[str, dict[str, np.ndarray]]) -> JsonObject:
    return {
        "dataset": [
            {"id": name, "source": {key: round_for_screen(values) for key, values in source.items()}}
            for name, source in sources.items()
        ]
    }


def _frame() -> JsonObject:
    return {"animation": False, "textStyle": {"fontFamily": FONT, "color": INK}}


def _axis(name: str, gap: int, **more: object) -> JsonObject:
    return {
        "type": "value",
        "name": name,
        "nameLocation": "middle",
        "nameGap": gap,
        "nameTextStyle": {"fontSize": 11},
        "axisLine": {"onZero": False},
        "axisLabel": {"fontSize": 10},
        "splitLine": {"lineStyle": {"color": GRID_GREY}},
        **more,
    }


def _style(colour: str, width: float, z: int, dashes: str = "solid") -> JsonObject:
    return {"lineStyle": {"color": colour, "width": width, "type": dashes}, "itemStyle": {"color": colour}, "z": z}


def _band(stack: str, low: str, step: str) -> list[JsonObject]:
    """Return the two areas of a band; the lower one is transparent and lifts the upper one to the least value."""
    area = {**CURVE_LINE, "datasetId": "box", "stack": f"{stack} {low}", "stackStrategy": "all", "silent": True}
    area |= {"lineStyle": {"width": 0}, "tooltip": {"show": False}}
    return [
        {**area, "name": "", "encode": {"x": "w", "y": low}, "areaStyle": {"opacity": 0}},
        {**area, "name": "box", "encode": {"x": "w", "y": step}, "areaStyle": {"color": BLUE, "opacity": 0.2}},
    ]


def _guide(level: float) -> JsonObject:
    line = {"color": GREY, "width": 1, "type": "solid"}
    return {"silent": True, "symbol": "none", "label": {"show": False}, "lineStyle": line, "data": [{"yAxis": level}]}
