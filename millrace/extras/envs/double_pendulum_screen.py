"""Draws the cart and its two links with pygame, which is imported when the first picture is drawn."""

from __future__ import annotations

import importlib
import math
import os
from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from gymnasium.error import DependencyNotInstalled

SCREEN = (600, 400)  # pixels: width, height


class Screen:
    """Draws states with pygame. Pictures are drawn at twice the size and then scaled down, so that edges are smooth."""

    def __init__(self, window: bool, track_m: float, link_m: float) -> None:
        os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")
        try:
            self._pygame: Any = importlib.import_module("pygame")
        except ImportError as error:
            raise DependencyNotInstalled(
                'rendering CartDoublePendulum needs pygame; install it: pip install "gymnasium[classic-control]"'
            ) from error
        self._track_m = track_m
        self._link_m = link_m
        width, height = SCREEN
        self._scale = 2 * min(
            width / (2 * track_m + 0.8), 0.6 * height / (2 * link_m)
        )  # pixels per meter in the large picture
        self._canvas = self._pygame.Surface((2 * width, 2 * height))
        self._window = self._clock = None
        if window:
            self._pygame.display.init()
            self._pygame.display.set_caption("millrace/CartDoublePendulum")
            self._window = self._pygame.display.set_mode(SCREEN)
            self._clock = self._pygame.time.Clock()

    def show(self, state: Sequence[float], push: float, fps: int) -> npt.NDArray[np.uint8] | None:
        """Draw the state in the window; without a window, return the pixels [400, 600, 3] uint8."""
        self._draw(state[0], state[1], state[2], push)
        picture = self._pygame.transform.smoothscale(self._canvas, SCREEN)
        if self._window is None or self._clock is None:
            return np.transpose(self._pygame.surfarray.array3d(picture), (1, 0, 2)).copy()
        self._window.blit(picture, (0, 0))
        self._pygame.event.pump()
        self._clock.tick(fps)
        self._pygame.display.flip()
        return None

    def _draw(self, x_m: float, theta_rad: float, phi_rad: float, push: float) -> None:
        draw = self._pygame.draw
        canvas = self._canvas
        scale = self._scale
        width, height = canvas.get_size()
        ground = 0.72 * height
        cart_x = width / 2 + scale * x_m
        top = 0.72 * height - 66
        left, right = (width / 2 + scale * side for side in (-self._track_m, self._track_m))
        canvas.fill("#f6f4ef")
        draw.line(canvas, "#d9d4c7", (width / 2, ground + 8), (width / 2, ground + 34), 3)  # marks the middle of the track
        draw.rect(canvas, "#8a8577", (left, ground, right - left, 8))
        for end in (left, right):
            draw.rect(canvas, "#8a8577", (end - 6, ground - 44, 12, 52), border_radius=6)
        draw.rect(canvas, "#33415c", (cart_x - 70, top, 140, 48), border_radius=14)
        for wheel in (cart_x - 40, cart_x + 40):
            draw.circle(canvas, "#1b2438", (wheel, ground - 15), 15)
            draw.circle(canvas, "#f6f4ef", (wheel, ground - 15), 5)
        if abs(push) > 0.02:
            side = math.copysign(1, push)
            tip = cart_x + math.copysign(92, push) + 110 * push
            draw.line(canvas, "#c8553d", (cart_x + 84 * side, top + 24), (tip, top + 24), 8)
            draw.polygon(canvas, "#c8553d", [(tip, top + 10), (tip + 22 * side, top + 24), (tip, top + 38)])
        joint = (cart_x, top)
        for angle_rad, color in ((theta_rad, "#2a9d8f"), (phi_rad, "#e9a23b")):
            reach = scale * self._link_m
            end_point = (joint[0] + reach * math.sin(angle_rad), joint[1] - reach * math.cos(angle_rad))
            self._rod(joint, end_point, color)
            draw.circle(canvas, "#33415c", joint, 9)
            joint = end_point
            draw.circle(canvas, color, joint, 20)
        draw.circle(canvas, "#f6f4ef", joint, 7)

    def _rod(self, start: tuple[float, float], end: tuple[float, float], color: str) -> None:
        """Draw a thick line with perpendicular ends, unlike pygame's lines."""
        (x1, y1) = start
        (x2, y2) = end
        across = 8 / (math.hypot(x2 - x1, y2 - y1) or 1)
        dx = (y2 - y1) * across
        dy = (x1 - x2) * across
        points = [(x1 + dx, y1 + dy), (x1 - dx, y1 - dy), (x2 - dx, y2 - dy), (x2 + dx, y2 + dy)]
        self._pygame.draw.polygon(self._canvas, color, points)

    def close(self) -> None:
        """Close the window."""
        if self._window is not None:
            self._pygame.display.quit()
            self._window = None
