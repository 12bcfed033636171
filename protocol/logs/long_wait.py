"""When the log mentions a wait: after `FIRST_S`, and then every `AGAIN_S`. Pure."""

from __future__ import annotations

FIRST_S = 30.0
AGAIN_S = 60.0


class LongWait:
    """One wait."""

    def __init__(self, began_s: float) -> None:
        self._began_s = began_s
        self._due_s = began_s + FIRST_S

    def due(self, now: float) -> bool:
        """Whether to log it now."""
        if now < self._due_s:
            return False
        self._due_s = now + AGAIN_S
        return True

    def seconds(self, now: float) -> float:
        """How long it has lasted."""
        return now - self._began_s
