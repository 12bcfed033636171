"""Notices: log lines that the user must see but that aren't warnings, such as the command that starts a worker.

Rule: a notice has the level WARNING, because a program that doesn't set up logging shows only warnings. Millrace itself
shows it without the word "warning".
"""

from __future__ import annotations

import logging


def log_notice(log: logging.Logger, line: str, *, kept: bool = True) -> None:
    """Log one line as a notice. `kept`: whether it may also be written to a file; False for an address with a token."""
    log.warning("%s", line, extra={"notice": True, "kept": kept})


def is_notice(record: logging.LogRecord) -> bool:
    """Whether a record of the log is a notice."""
    return getattr(record, "notice", False) is True
