"""A small chart as SVG, for what no command has drawn."""

import math
from collections.abc import Sequence
from xml.sax.saxutils import escape

from diffabs.core.summary import number

WIDTH, HEIGHT, LEFT, RIGHT, TOP, BOTTOM = 640, 280, 90, 20, 14, 46
TICKS = 4


def lines(points: Sequence[tuple[float, float]], across: str, up: str) -> str:
    """Return points (x, y) joined by a line, with axes; the vertical one is logarithmic where values differ by more
    than a factor of 20. Points that are no numbers are left out."""
    points = [(x, y) for x, y in points if x is not None and y is not None and math.isfinite(x) and math.isfinite(y)]
    if not points:
        return ""
    xs, ys = zip(*points, strict=True)
    logarithmic = min(ys) > 0 and max(ys) > 20 * min(ys)
    heights = [math.log10(y) if logarithmic else y for y in ys]
    low, high = _widened(min(heights), max(heights))
    first, last = _widened(min(xs), max(xs), 0.0)

    def at(x: float, y: float) -> tuple[float, float]:
        across = LEFT + (x - first) / (last - first) * (WIDTH - LEFT - RIGHT)
        return round(across, 2), round(HEIGHT - BOTTOM - (y - low) / (high - low) * (HEIGHT - TOP - BOTTOM), 2)

    parts = [f'<rect width="{WIDTH}" height="{HEIGHT}" fill="#fff"/>']
    for i in range(TICKS + 1):
        level, place = low + (high - low) * i / TICKS, first + (last - first) * i / TICKS
        (_, y), (x, _) = at(first, level), at(place, low)
        value = 10**level if logarithmic else level
        parts.append(f'<path d="M{LEFT} {y}H{WIDTH - RIGHT}" stroke="#ddd"/>')
        parts.append(f'<text x="{LEFT - 8}" y="{y + 4}" text-anchor="end">{number(value, 3)}</text>')
        parts.append(f'<text x="{x}" y="{HEIGHT - BOTTOM + 18}" text-anchor="middle">{number(place, 3)}</text>')
    path = " ".join(",".join(map(str, at(x, y))) for x, y in zip(xs, heights, strict=True))
    parts.append(f'<polyline points="{path}" fill="none" stroke="#0b62a4" stroke-width="2"/>')
    for x, y in zip(xs, heights, strict=True):
        across_, up_ = at(x, y)
        parts.append(f'<circle cx="{across_}" cy="{up_}" r="2.5" fill="#0b62a4"/>')
    middle = (TOP + HEIGHT - BOTTOM) / 2
    parts.append(
        f'<text x="{(LEFT + WIDTH - RIGHT) / 2}" y="{HEIGHT - 8}" text-anchor="middle">{escape(across)}</text>'
    )
    parts.append(f'<text transform="translate(14 {middle}) rotate(-90)" text-anchor="middle">{escape(up)}</text>')
    size = f'viewBox="0 0 {WIDTH} {HEIGHT}" width="{WIDTH}" height="{HEIGHT}"'
    return f'<svg xmlns="http://www.w3.org/2000/svg" role="img" {size} font-size="12">{"".join(parts)}</svg>'


def _widened(low: float, high: float, share: float = 0.05) -> tuple[float, float]:
    room = share * (high - low)
    return (low - room, high + room) if high > low else (low - (abs(low) or 1.0) / 2, high + (abs(high) or 1.0) / 2)
