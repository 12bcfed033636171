"""When to mention a long wait in the log: after `FIRST_S` seconds, and then every `AGAIN_S` seconds. Pure."""

from __future__ import annotations

FIRST_S = 30.0
AGAIN_S = 60.0


class LongWait:
    """One wait, which began at `began_s`."""

    def __init__(self, began_s: float) -> None:
        self._began_s = began_s
        self._due_s = began_s + FIRST_S

    def due(self, now: float) -> bool:
        """Whether to mention the wait in the log now. Assumes that the caller then does so."""
        if now < self._due_s:
            return False
        self._due_s = now + AGAIN_S
        return True

    def seconds(self, now: float) -> float:
        """How long the wait has lasted, in seconds."""
        return now - self._began_s
