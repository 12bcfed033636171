"""The last line that a training program prints: why it ended, and how to continue the run.

Rule: it is one line. The error's notes (`BaseException.__notes__`) follow its message.
"""

from __future__ import annotations

import shlex
import sysconfig
import traceback
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

from millrace.flags.program_name import typed_name
from millrace.learner.run_folder.run_format import check_format
from millrace.protocol.bounds import MAX_TEXT, one_line
from millrace.protocol.errors import UsageError, UserFacingError, first_line

OURS = "millrace."  # prefix of the names of millrace's modules
OF_LEARNER = "millrace.learner."


def resume_command(run: Path) -> str:
    """The shell command that continues a run. It starts workers, unless run.json says that they were started elsewhere."""
    elsewhere = False
    with suppress(UsageError):
        elsewhere = check_format(run).workers_elsewhere
    where = f"./{run}" if str(run).startswith("-") else str(run)  # else it would be taken for a flag
    return f"{typed_name()} {'learner' if elsewhere else 'train'} --resume {shlex.quote(where)}"


def complete(folder: Path) -> str:
    """The note of an error that ends the program after training."""
    return f"the run is complete: {folder}"


def last_line(program: str, error: BaseException, hints: Sequence[str] = ()) -> str:
    """The line for a terminal that says why `program` ended. `hints` follow the notes of the error."""
    more = [note for note in getattr(error, "__notes__", ()) if isinstance(note, str)]
    match error:
        case KeyboardInterrupt():
            why = "interrupted"
            if (run := getattr(error, "run", None)) is not None:  # an `Interrupted`, whose class isn't imported here
                if getattr(error, "complete", False):
                    why += " after training"
                    more = [complete(run)]
                else:
                    more = [f"continue with: {resume_command(run)}"]
        case UserFacingError():
            why = str(error)
        case _:
            why = f"{users_code(error) or 'internal error'}: {type(error).__name__}: {first_line(error)}"
    return one_line("; ".join([f"{program}: {why}", *more, *hints]), MAX_TEXT)  # the text may quote a worker or a file


def users_code(error: BaseException) -> str:
    """The FILE:LINE where user code that the learner called, such as an algorithm's loss, raised the error; else empty.

    An error in a library counts as raised by the code that called the library.
    """
    where = ""
    libraries = tuple(sysconfig.get_path(name) for name in ("stdlib", "purelib", "platlib"))
    for frame, line in reversed([*traceback.walk_tb(error.__traceback__)]):
        module = str(frame.f_globals.get("__name__", ""))
        if f"{module}.".startswith(OURS):
            return where if module.startswith(OF_LEARNER) else ""
        file = frame.f_code.co_filename
        if not where and Path(file).is_absolute() and not file.startswith(libraries):
            where = f"{Path(file).name}:{line}"
    return ""
