"""Errors of an environment, as a worker names them: the copy that raised, then the lane of that copy. Pure.

Rule: the line of an error of a lane names the lane, once, at its beginning. Whoever shows the line adds nothing to it.
"""

from __future__ import annotations

from traceback import format_exception

from protocol.errors import RunError, first_line


class CopyRaised(Exception):
    """An env copy raised; the environment's own exception is the cause.

    `copy` is its number within the lane, or None where a vector environment does not say which one it was.
    `doing` says what it did: "make", "reset" or a step.
    """

    def __init__(self, copy: int | None, doing: str) -> None:
        super().__init__(copy, doing)
        self.copy = copy
        self.doing = doing


class Unusable(CopyRaised):
    """An env copy returned what no array of the run can hold; `line` says what was expected and what it was."""

    def __init__(self, copy: int | None, line: str, doing: str = "reset") -> None:
        super().__init__(copy, doing)
        self.line = line


class LaneFailed(RunError):
    """The environment raised, or returned data that no rollout can hold. `detail` is its traceback, if it raised."""

    def __init__(self, lane: int, line: str, detail: str = "") -> None:
        super().__init__(f"lane {lane}, {line}", detail)
        self.lane = lane


def lane_failed(lane: int, doing: str, error: CopyRaised) -> LaneFailed:
    """The environment's own exception as an error of its lane: one line, with the traceback as its detail."""
    where = doing if error.copy is None else f"copy {error.copy}, {doing}"
    if isinstance(error, Unusable):
        return LaneFailed(lane, f"{where}: {error.line}")
    cause = error.__cause__ or error
    line = f"{where}: its environment raised {type(cause).__name__}: {first_line(cause, '')}"
    return LaneFailed(lane, line, "".join(format_exception(cause)))
