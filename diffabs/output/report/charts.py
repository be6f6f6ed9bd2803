"""A small line chart as SVG, for results without a drawn figure."""

import math
from collections.abc import Sequence
from xml.sax.saxutils import escape

from diffabs.core.summary import round_for_table

CHART_WIDTH, HEIGHT, LEFT, RIGHT, AXIS_TOP, AXIS_BOTTOM = 640, 280, 90, 20, 14, 46
TICKS = 4


def draw_lines(points: Sequence[tuple[float, float]], across: str, up: str) -> str:
    """Return an SVG of points joined by a line, with axes; empty without a finite point.

    The vertical axis is logarithmic if all values are positive and differ by more than a factor of 20. Points with a
    missing or infinite coordinate are left out.
    """
    points = [(x, y) for x, y in points if x is not None and y is not None and math.isfinite(x) and math.isfinite(y)]
    if not points:
        return ""
    xs, ys = zip(*points, strict=True)
    logarithmic = min(ys) > 0 and max(ys) > 20 * min(ys)
    heights = [math.log10(y) if logarithmic else y for y in ys]
    low, high = _widen_range(min(heights), max(heights))
    first, last = _widen_range(min(xs), max(xs), 0.0)

    def at(x: float, y: float) -> tuple[float, float]:
        across = LEFT + (x - first) / (last - first) * (CHART_WIDTH - LEFT - RIGHT)
        return round(across, 2), round(
            HEIGHT - AXIS_BOTTOM - (y - low) / (high - low) * (HEIGHT - AXIS_TOP - AXIS_BOTTOM), 2
        )

    parts = [f'<rect width="{CHART_WIDTH}" height="{HEIGHT}" fill="#fff"/>']
    for i in range(TICKS + 1):
        level, place = low + (high - low) * i / TICKS, first + (last - first) * i / TICKS
        (_, y), (x, _) = at(first, level), at(place, low)
        value = 10**level if logarithmic else level
        parts.append(f'<path d="M{LEFT} {y}H{CHART_WIDTH - RIGHT}" stroke="#ddd"/>')
        parts.append(f'<text x="{LEFT - 8}" y="{y + 4}" text-anchor="end">{round_for_table(value, 3)}</text>')
        parts.append(
            f'<text x="{x}" y="{HEIGHT - AXIS_BOTTOM + 18}" text-anchor="middle">{round_for_table(place, 3)}</text>'
        )
    path = " ".join(",".join(map(str, at(x, y))) for x, y in zip(xs, heights, strict=True))
    parts.append(f'<polyline points="{path}" fill="none" stroke="#0b62a4" stroke-width="2"/>')
    for x, y in zip(xs, heights, strict=True):
        across_, up_ = at(x, y)
        parts.append(f'<circle cx="{across_}" cy="{up_}" r="2.5" fill="#0b62a4"/>')
    middle = (AXIS_TOP + HEIGHT - AXIS_BOTTOM) / 2
    parts.append(
        f'<text x="{(LEFT + CHART_WIDTH - RIGHT) / 2}" y="{HEIGHT - 8}" text-anchor="middle">{escape(across)}</text>'
    )
    parts.append(f'<text transform="translate(14 {middle}) rotate(-90)" text-anchor="middle">{escape(up)}</text>')
    size = f'viewBox="0 0 {CHART_WIDTH} {HEIGHT}" width="{CHART_WIDTH}" height="{HEIGHT}"'
    return f'<svg xmlns="http://www.w3.org/2000/svg" role="img" {size} font-size="12">{"".join(parts)}</svg>'


def _widen_range(low: float, high: float, share: float = 0.05) -> tuple[float, float]:
    """Return the range with a margin of `share` on each side; a range of one value gets a width."""
    room = share * (high - low)
    return (low - room, high + room) if high > low else (low - (abs(low) or 1.0) / 2, high + (abs(high) or 1.0) / 2)
