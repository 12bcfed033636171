"""Charts as SVG text: axes, lines, bands, dots. Pure. Colours are the style sheet's, by class, so that dark is dark."""

from __future__ import annotations

import math
from collections.abc import Sequence
from html import escape
from typing import NamedTuple

import numpy as np

from protocol.arrays import Doubles

COLOURS = 7  # that the style sheet has
LEFT, RIGHT, TOP, BOTTOM = 52, 14, 10, 40
MOST_POINTS = 500
MINUS = "\N{MINUS SIGN}"


class Trace(NamedTuple):
    """Something drawn over env steps."""

    kind: str
    """line (bold), thin, band or dots: a class of the style sheet"""
    colour: int
    x: Doubles  # [K]
    y: Doubles  # [K], or [K, 2] of a band
    says: str = ""
    """shown when the pointer rests on it"""


def ticks(low: float, high: float, about: int) -> list[float]:
    """Round numbers, 1, 2 or 5 times a power of ten apart, that lie within."""
    span = high - low
    if not (span > 0 and math.isfinite(span)):
        return [low]
    power = 10.0 ** math.floor(math.log10(span / about))
    step = min((factor * power for factor in (1, 2, 5, 10)), key=lambda step: abs(span / step - about))
    first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
    return [i * step for i in range(first, last + 1)]


def engineering(value: float) -> str:
    """20000 as 20k, 1.5e6 as 1.5M."""
    for size, unit in ((1e9, "G"), (1e6, "M"), (1e3, "k")):
        if abs(value) >= size:
            return f"{value / size:g}{unit}".replace("-", MINUS)
    return f"{value:g}".replace("-", MINUS)


def chart(traces: Sequence[Trace], width: int, height: int, x_label: str, describe: str) -> str:
    """Traces on common axes; x begins at 0."""
    x_max = max((float(trace.x.max()) for trace in traces if trace.x.size), default=1.0) or 1.0
    ys = [trace.y for trace in traces if trace.y.size]
    low, high = (min(float(y.min()) for y in ys), max(float(y.max()) for y in ys)) if ys else (0.0, 1.0)
    if low == high:
        low, high = low - 1, high + 1
    low, high = (0.0 if 0 <= low < 0.4 * high else low - 0.05 * (high - low)), high + 0.05 * (high - low)
    plot_w, plot_h = width - LEFT - RIGHT, height - TOP - BOTTOM

    def across(x: Doubles | float) -> Doubles:
        return np.asarray(LEFT + np.asarray(x) / x_max * plot_w)

    def down(y: Doubles | float) -> Doubles:
        return np.asarray(TOP + (high - np.asarray(y)) / (high - low) * plot_h)

    parts = [f'<svg class="chart" viewBox="0 0 {width} {height}" role="img" aria-label="{escape(describe)}">']
    for y in ticks(low, high, 5):
        at = float(down(y))
        parts.append(f'<line class="grid" x1="{LEFT}" x2="{width - RIGHT}" y1="{at:.1f}" y2="{at:.1f}"/>')
        parts.append(f'<text class="tick y" x="{LEFT - 8}" y="{at + 4:.1f}">{escape(engineering(y))}</text>')
    base = height - BOTTOM
    parts.append(f'<line class="axis" x1="{LEFT}" x2="{width - RIGHT}" y1="{base}" y2="{base}"/>')
    for x in ticks(0, x_max, max(4, plot_w // 110)):
        at = float(across(x))
        parts.append(f'<line class="axis" x1="{at:.1f}" x2="{at:.1f}" y1="{base}" y2="{base + 4}"/>')
        parts.append(f'<text class="tick x" x="{at:.1f}" y="{base + 17}">{escape(engineering(x))}</text>')
    parts.append(f'<text class="label" x="{width - RIGHT}" y="{height - 5}">{escape(x_label)}</text>')
    drawn = sorted(traces, key=lambda trace: ("band", "thin", "line", "dots").index(trace.kind))
    parts += [_drawn(trace, across(trace.x), down(trace.y)) for trace in drawn if trace.x.size]
    return "\n".join([*parts, "</svg>"])


def _drawn(trace: Trace, x: Doubles, y: Doubles) -> str:
    says = f"<title>{escape(trace.says)}</title>" if trace.says else ""
    css = f'class="{trace.kind} c{trace.colour % COLOURS}"'
    match trace.kind:
        case "dots":
            dots = "".join(f'<circle cx="{a:.1f}" cy="{b:.1f}" r="3.2"/>' for a, b in zip(x, y, strict=True))
            return f"<g {css}>{says}{dots}</g>"
        case "band":
            x, y = _thinned(x, y)
            outline = np.concatenate([np.column_stack([x, y[:, 0]]), np.column_stack([x, y[:, 1]])[::-1]])
            return f'<path {css} d="{_path(outline)}Z">{says}</path>'
        case _:
            return f'<path {css} d="{_path(np.column_stack(_thinned(x, y)))}">{says}</path>'


def _thinned(x: Doubles, y: Doubles) -> tuple[Doubles, Doubles]:
    """At most about 500 of the points, the last one among them: more than that is not seen."""
    every = math.ceil(len(x) / MOST_POINTS)
    keep = np.unique([*range(0, len(x), every), len(x) - 1])
    return x[keep], y[keep]


def _path(points: Doubles) -> str:
    """[K, 2] as path commands."""
    return "M" + "L".join(f"{x:.1f} {y:.1f}" for x, y in points)
