"""The exception that the user's code raised in a worker, made again where its traceback arrives. Pure.

Rule: a traceback is text that a peer sent; nothing is unpickled or imported for it, and it is shown without control
characters. Only an exception of Python's own is made again, by its name and with its message as the one argument; any other
is a `WorkerTraceback`.
"""

from __future__ import annotations

import builtins
from itertools import dropwhile

from protocol.bounds import escaped


class WorkerTraceback(Exception):
    """The worker's traceback, shown in the place of this process's own, which does not have the frames."""

    def __str__(self) -> str:
        return f'\n"""\n{super().__str__()}\n"""'  # as the standard library shows that of another process


def worker_exception(traceback: str) -> Exception | None:
    """The exception of which this is the traceback; None if there is no text. Its own cause is the `WorkerTraceback`."""
    if not traceback:
        return None
    traceback = escaped(traceback).rstrip()
    text, lines = WorkerTraceback(traceback), traceback.split("\n")
    last_frame = max((n for n, line in enumerate(lines) if line.startswith('  File "')), default=len(lines))
    raised = dropwhile(lambda line: line.startswith(" "), lines[last_frame:])
    name, colon, message = "\n".join(raised).partition(": ")
    kind = vars(builtins).get(name)
    if not isinstance(kind, type) or not issubclass(kind, Exception):
        return text
    try:
        error = kind(message) if colon else kind()
    except TypeError:  # it takes other arguments, as UnicodeDecodeError does
        return text
    error.__cause__ = text
    return error
