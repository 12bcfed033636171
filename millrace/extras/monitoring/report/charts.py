"""Charts as SVG text: axes, lines, bands, dots. Pure. The style sheet sets the colors, by class, so that dark mode works.

Rule: up to 56 lines look different. After the style sheet's seven colors, the colors are reused with dashes.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from html import escape
from typing import NamedTuple

import numpy as np

from millrace.protocol.arrays import Doubles

COLORS = 7  # number of colors in the style sheet
DASHES = ("", "7 6", "0.1 5", "9 5 0.1 5", "15 6", "9 5 0.1 5 0.1 5", "3 5", "14 5 4 5")  # dashes have round ends
LEFT = 52
RIGHT = 14
TOP = 10
BOTTOM = 40
MOST_POINTS = 500
LEAST_SPAN = 1e-300  # for a smaller span, steps between ticks could underflow
ON_A_PHONE = 420, 300
MINUS = "\N{MINUS SIGN}"


class Series(NamedTuple):
    """Data that are drawn over env steps in one color and with one pattern of dashes."""

    kind: str
    """line (bold), thin, band or dots; this is also its class in the style sheet"""
    color: int
    """number that stands for a color and a pattern of dashes"""
    x: Doubles  # [K]
    y: Doubles  # [K]; for a band, [K, 2]: lower and upper edge
    tooltip: str = ""
    """text that is shown when the pointer is on the series"""


def ticks(low: float, high: float, about: int) -> list[float]:
    """Round numbers from `low` to `high`, roughly `about` of them. Their spacing is 1, 2 or 5 times a power of ten."""
    span = high - low
    if not LEAST_SPAN < span < math.inf:
        return [low]
    power = 10.0 ** math.floor(math.log10(span / about))
    step = min((factor * power for factor in (1, 2, 5, 10)), key=lambda step: abs(span / step - about))
    first = math.ceil(low / step - 1e-9)
    last = math.floor(high / step + 1e-9)
    return [i * step for i in range(first, last + 1)]


def with_si_prefix(value: float) -> str:
    """A number with k, M or G, such as 20k for 20000 and 1.5M for 1.5e6."""
    for size, unit in ((1e9, "G"), (1e6, "M"), (1e3, "k")):
        if abs(value) >= size:
            return f"{value / size:g}{unit}".replace("-", MINUS)
    return f"{value:g}".replace("-", MINUS)


def chart(all_series: Sequence[Series], width: int, height: int, x_label: str, describe: str) -> str:
    """Draw several series on common axes. The x axis begins at 0. `describe`: the text for screen readers."""
    x_max = max((float(series.x.max()) for series in all_series if series.x.size), default=1.0) or 1.0
    ys = [series.y for series in all_series if series.y.size]
    low, high = (min(float(y.min()) for y in ys), max(float(y.max()) for y in ys)) if ys else (0.0, 1.0)
    if low == high:
        margin = max(1.0, 1e-9 * abs(low))  # relative, because adding 1 doesn't change a very large number
        low = low - margin
        high = high + margin
    room = 0.05 * (high - low)
    low = 0.0 if 0 <= low < 0.4 * high else low - room
    high += room
    plot_w = width - LEFT - RIGHT
    plot_h = height - TOP - BOTTOM

    def x_pixels(x: Doubles | float) -> Doubles:
        return np.asarray(LEFT + np.asarray(x) / x_max * plot_w)

    def y_pixels(y: Doubles | float) -> Doubles:
        return np.asarray(TOP + (high - np.asarray(y)) / (high - low) * plot_h)

    size = f'viewBox="0 0 {width} {height}" width="{width}" height="{height}"'
    parts = [f'<svg class="chart" {size} role="img" aria-label="{escape(describe)}">']
    for y in ticks(low, high, 5):
        at = float(y_pixels(y))
        parts.append(f'<line class="grid" x1="{LEFT}" x2="{width - RIGHT}" y1="{at:.1f}" y2="{at:.1f}"/>')
        parts.append(f'<text class="tick y" x="{LEFT - 8}" y="{at + 4:.1f}">{escape(with_si_prefix(y))}</text>')
    base = height - BOTTOM
    parts.append(f'<line class="axis" x1="{LEFT}" x2="{width - RIGHT}" y1="{base}" y2="{base}"/>')
    for x in ticks(0, x_max, max(4, plot_w // 110)):
        at = float(x_pixels(x))
        parts.append(f'<line class="axis" x1="{at:.1f}" x2="{at:.1f}" y1="{base}" y2="{base + 4}"/>')
        parts.append(f'<text class="tick x" x="{at:.1f}" y="{base + 17}">{escape(with_si_prefix(x))}</text>')
    parts.append(f'<text class="label" x="{width - RIGHT}" y="{height - 5}">{escape(x_label)}</text>')
    ordered = sorted(all_series, key=lambda series: ("band", "thin", "line", "dots").index(series.kind))
    parts += [_svg(series, x_pixels(series.x), y_pixels(series.y)) for series in ordered if series.x.size]
    return "\n".join([*parts, "</svg>"])


def chart_for_all_widths(all_series: Sequence[Series], wide: tuple[int, int], x_label: str, describe: str) -> str:
    """The chart in two sizes. The style sheet shows the one that fits, because a chart's text must not shrink with it."""
    sizes = {"for-wide": wide, "for-narrow": ON_A_PHONE}
    return "".join(f'<div class="{css}">{chart(all_series, *size, x_label, describe)}</div>' for css, size in sizes.items())


def key(color: int) -> str:
    """A short line of this color and its dashes, for legends."""
    x = np.array([2.0, 32.0])
    y = np.array([5.0, 5.0])
    return f'<svg class="key" width="34" height="10">{_svg(Series("line", color, x, y), x, y)}</svg>'


DOT_KEY = '<svg class="key" width="34" height="10"><g class="dots"><circle cx="17" cy="5" r="3.2"/></g></svg>'
"""A dot in a neutral color, for legends"""


class Segment(NamedTuple):
    """A part of a bar."""

    begin: float
    """where the segment begins, as a share of the bar's length"""
    share: float
    """length of the segment, as a share of the bar's length"""
    css: str
    """class of the segment in the style sheet, which sets its color"""
    tooltip: str = ""
    text: str = ""


def bar(segments: Iterable[Segment]) -> str:
    """A bar of colored segments, as wide as the page allows. Sizes are attributes, because pages forbid inline styles."""
    parts = []
    for each in segments:
        x = f"{100 * each.begin:.2f}%"
        rect = f'<rect class="{each.css}" x="{x}" width="{100 * each.share:.2f}%" height="100%">'
        parts.append(f"{rect}<title>{escape(each.tooltip)}</title></rect>")
        if each.text:
            of_wait = " on-wait" if each.css == "wait" else ""
            parts.append(f'<text class="on-bar{of_wait}" x="{x}" dx="7" y="50%" dy="4">{escape(each.text)}</text>')
    return f'<svg class="bar">{"".join(parts)}</svg>'


def _svg(series: Series, x: Doubles, y: Doubles) -> str:
    tooltip = f"<title>{escape(series.tooltip)}</title>" if series.tooltip else ""
    css = f'class="{series.kind} c{series.color % COLORS}"'
    if series.kind == "dots":
        dots = "".join(f'<circle cx="{a:.1f}" cy="{b:.1f}" r="3.2"/>' for a, b in zip(x, y, strict=True))
        return f"<g {css}>{tooltip}{dots}</g>"
    x, y = _subsampled(x, y)
    if series.kind == "band":
        path = _path(np.concatenate([np.column_stack([x, y[:, 0]]), np.column_stack([x, y[:, 1]])[::-1]])) + "Z"
    else:
        path = _path(np.column_stack([x, y]))
    dashes = DASHES[series.color // COLORS % len(DASHES)]
    dashed = f' stroke-dasharray="{dashes}"' if dashes else ""
    return f'<path {css}{dashed} d="{path}">{tooltip}</path>'


def _subsampled(x: Doubles, y: Doubles) -> tuple[Doubles, Doubles]:
    """Keep about 500 of the points, because more wouldn't be visible. The last point is always kept."""
    every = math.ceil(len(x) / MOST_POINTS)
    keep = np.unique([*range(0, len(x), every), len(x) - 1])
    return x[keep], y[keep]


def _path(points: Doubles) -> str:
    """Points [K, 2] as SVG path commands."""
    return "M" + "L".join(f"{x:.1f} {y:.1f}" for x, y in points.tolist())
