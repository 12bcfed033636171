"""Lines of the log that a person must see and that warn of nothing: as the command that starts a worker.

Rule: a notice is logged as a warning is, because a program that sets up no logging shows warnings alone. What shows the log
calls it no warning.
"""

from __future__ import annotations

import logging


def log_notice(log: logging.Logger, line: str) -> None:
    """Log one line as a notice."""
    log.warning("%s", line, extra={"notice": True})


def is_notice(record: logging.LogRecord) -> bool:
    """Whether a record of the log is a notice."""
    return getattr(record, "notice", False) is True
