"""The last line of a program that trains: why it ended, and how to go on with the run. Pure.

Rule: it is one line. Notes that were added to the error on its way (`BaseException.__notes__`) follow it.
"""

from __future__ import annotations

import shlex
from collections.abc import Sequence

from protocol.bounds import escaped
from protocol.errors import UserFacingError, first_line


def last_line(program: str, error: BaseException, command: str, hints: Sequence[str] = ()) -> str:
    """Why `program` ended, for a terminal. `command` is the one that resumes runs; `hints` follow the notes of the error."""
    more = list(getattr(error, "__notes__", ()))
    match error:
        case KeyboardInterrupt():
            why = "interrupted"
            if (run := getattr(error, "run", None)) is not None:  # `Interrupted`; its class need not be imported for this
                more = [f"go on with: {command} --resume {shlex.quote(str(run))}"]
        case UserFacingError():
            why = str(error)
        case _:
            why = f"internal error: {type(error).__name__}: {first_line(error)}"
    return escaped("; ".join([f"{program}: {why}", *more, *hints]))  # it may quote what a worker said
