"""A curve as one line of text: blocks of five heights, over the run so far. Pure.

Rule: a curve's memory is bounded. The run is divided into equal parts, and only the last point of each part is kept.
"""

from __future__ import annotations

import math

BLOCKS = "▁▂▃▅▇"
ASCII = ".:=*#"
COLUMNS = 16
MOST_POINTS = 1_000


class Sparkline:
    """A curve of values `y` over a growing `x`. `str` renders it as one line."""

    def __init__(self, blocks: str = BLOCKS) -> None:
        """`blocks`: the characters to draw with, the lowest first."""
        self._blocks = blocks
        self._points: list[tuple[float, float]] = []

    def add(self, x: float, y: float | None) -> None:
        """Add the value `y` at `x`, unless `y` is None or not finite, or `x` has not grown."""
        if y is not None and math.isfinite(y) and (not self._points or x > self._points[-1][0]):
            self._points.append((x, y))
            if len(self._points) > MOST_POINTS:
                self._points = self._last_of_parts(MOST_POINTS // 2)

    def __str__(self) -> str:
        if len(self._points) < 2:
            return ""
        values = [y for _, y in self._last_of_parts(COLUMNS)]
        low = min(values)
        high = max(values)
        step = (high - low) / (len(self._blocks) - 1) or 1.0
        return "".join(self._blocks[round((y - low) / step)] for y in values)

    def _last_of_parts(self, parts: int) -> list[tuple[float, float]]:
        """The last point of each of `parts` parts of the run. The newest point is one part; the others are equally long."""
        first = self._points[0][0]
        last = self._points[-1][0]
        return list({int((parts - 1) * (x - first) / (last - first)): (x, y) for x, y in self._points}.values())
