"""The picture that `millrace plot` draws: the learning curves of the report as one SVG, or that SVG as a PNG.

Rule: lines, colors and legends are those of the report. The SVG has its own style, in light colors. The PNG is the same on
every machine, because its font comes with Pillow; a machine needs fonts of its own only for other writing systems.
"""

from __future__ import annotations

import logging
import math
import os
import re
from collections.abc import Sequence
from html import escape
from pathlib import Path
from tempfile import NamedTemporaryFile
from textwrap import shorten, wrap

from millrace.extras.monitoring.report.charts import MINUS, chart
from millrace.extras.monitoring.report.page import STYLE
from millrace.extras.monitoring.report.panels import WHAT_IS_DRAWN, Panel, how_it_is_drawn, panels
from millrace.extras.monitoring.report.reported_runs import ReportData, group_runs, read_run
from millrace.learner.run_folder.atomic_write import write_file
from millrace.protocol.errors import UsageError

WIDTH = 640  # width of a panel's chart
HEIGHT = 380
MARGIN = 28
HEAD = 50
LINE = 20
LETTERS = 92  # about how many letters fit into WIDTH
ZOOM = 2  # the PNG is this many times as large as the SVG
OWN_STYLE = (
    ".picture { font: 13px system-ui, sans-serif; color: var(--soft); }",
    ".picture text { fill: currentColor; }",
    ".picture .title { font-size: 17px; font-weight: 600; fill: var(--ink); }",
)

log = logging.getLogger("millrace.learner")


class Drawing:
    """Learning curves as a picture that notebooks display."""

    def __init__(self, svg: str) -> None:
        self.svg = svg
        """the picture as SVG text"""

    def _repr_svg_(self) -> str:
        return self.svg

    def png(self) -> bytes:
        """The picture as the bytes of a PNG file. Raises `UsageError` if the packages for this are not installed."""
        try:
            from PIL import ImageFont
            from resvg_py import svg_to_bytes
        except ModuleNotFoundError as error:
            install = "pip install pillow resvg_py, or write an .svg, which needs neither"
            raise UsageError(f"a PNG needs {error.name}, which is not installed; {install}") from error
        font = ImageFont.load_default(size=12)
        assert isinstance(font, ImageFont.FreeTypeFont)
        with NamedTemporaryFile(suffix=".ttf") as file:
            file.write(font.font_bytes)
            file.flush()
            text = self.svg.replace(MINUS, "-")  # the font has no other minus sign
            png: bytes = svg_to_bytes(text, zoom=ZOOM, font_files=[file.name], sans_serif_family=font.getname()[0])
        return png

    def save(self, out: str | os.PathLike[str]) -> Path:
        """Write the picture to a file, whose name ends in .svg or .png. Raises `UserFacingError` with a one-line message."""
        path = Path(out)
        match path.suffix:
            case ".svg":
                content = self.svg.encode()
            case ".png":
                content = self.png()
            case _:
                raise UsageError(f"{out}: expected a file that ends in .svg or .png")
        write_file(path, lambda file: file.write(content))
        return path


def draw(runs: Sequence[Path]) -> Drawing:
    """Draw the learning curves of these runs. Runs in which no episode has ended are left out, with a warning for each.

    Raises `UsageError` if a folder can't be read, or if there is nothing to draw.
    """
    reported = [read_run(run) for run in dict.fromkeys(runs)]
    empty = [f"run {run.path}: nothing to plot, no episode has ended" for run in reported if run.curve is None]
    if len(empty) == len(reported):
        raise UsageError(empty[0])
    for line in empty:
        log.warning("%s; it is left out", line)
    return Drawing(_svg(group_runs([run for run in reported if run.curve is not None])))


def _svg(report: ReportData) -> str:
    drawn = panels(report)
    columns = math.ceil(math.sqrt(len(drawn)))
    width = MARGIN + columns * (WIDTH + MARGIN)
    bottom = MARGIN
    parts = list[str]()
    for begin in range(0, len(drawn), columns):
        row = [_panel(panel) for panel in drawn[begin : begin + columns]]
        parts += [_at(MARGIN + i * (WIDTH + MARGIN), bottom, inner) for i, (inner, _) in enumerate(row)]
        bottom += max(height for _, height in row) + MARGIN
    for line in wrap(how_it_is_drawn(report), columns * LETTERS):
        parts.append(_text(MARGIN, bottom, line))
        bottom += LINE
    size = f'viewBox="0 0 {width} {bottom}" width="{width}" height="{bottom}"'
    begin_svg = f'<svg class="picture" xmlns="http://www.w3.org/2000/svg" {size} role="img" aria-label="Learning curves">'
    background = '<rect width="100%" height="100%" fill="#ffffff"/>'
    text = "\n".join([begin_svg, f"<style>\n{_style()}\n</style>", background, *parts, "</svg>\n"])
    return "".join(letter if letter.isprintable() or letter == "\n" else "\N{REPLACEMENT CHARACTER}" for letter in text)


def _panel(panel: Panel) -> tuple[str, int]:
    """A panel as SVG text, and its height."""
    title = shorten(panel.env, LETTERS * 3 // 4, placeholder=" …")
    drawn = chart(panel.series, WIDTH, HEIGHT, "env steps", f"Learning curves of {panel.env}")
    parts = [_text(0, 14, title, "title"), _text(0, 36, WHAT_IS_DRAWN), _at(0, HEAD, drawn)]
    top = HEAD + HEIGHT + 8
    across = 2 if len(panel.legend) > 3 and max(len(text) for _, text in panel.legend) < LETTERS // 2 - 6 else 1
    for begin in range(0, len(panel.legend), across):
        entries = [(sample, wrap(text, LETTERS - 6)) for sample, text in panel.legend[begin : begin + across]]
        for i, (sample, lines) in enumerate(entries):
            parts += [_at(i * WIDTH // 2, top, sample)]
            parts += [_text(i * WIDTH // 2 + 44, top + 9 + j * LINE, line) for j, line in enumerate(lines)]
        top += LINE * max(len(lines) for _, lines in entries)
    return "\n".join(parts), top


def _text(x: float, y: float, text: str, css: str = "") -> str:
    return f'<text class="{css}" x="{x}" y="{y}">{escape(text)}</text>'


def _at(x: float, y: float, inner: str) -> str:
    return f'<g transform="translate({x} {y})">{inner}</g>'


def _style() -> str:
    """The style sheet's rules for charts, and the picture's own rules.

    Variables are replaced by their values, because few programs other than browsers support them.
    """
    sheet = STYLE.read_text()
    colors = dict(re.findall(r"(--\w+): (#\w+)", sheet.partition("@media")[0]))
    rules = re.findall(r"^(?:\.chart |path\.|\.dots |\.c\d).*$", sheet, re.MULTILINE)
    return re.sub(r"var\((--\w+)\)", lambda name: colors[name[1]], "\n".join([*rules, *OWN_STYLE]))
