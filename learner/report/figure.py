"""A matplotlib figure that notebooks show as a PNG, whatever their back end is. Importing this file imports matplotlib."""

from __future__ import annotations

import io

from matplotlib.figure import Figure

DPI = 150


class PngFigure(Figure):
    """A figure of matplotlib, made without pyplot."""

    def _repr_png_(self) -> bytes:
        """The picture, which IPython asks for."""
        picture = io.BytesIO()
        self.savefig(picture, format="png", dpi=DPI)
        return picture.getvalue()
