"""The log as JSON, one event per line (`--log-json`).

Every line has `time` (UTC, ISO 8601), `level`, `event` and `message`, the text for people. `event` is "joined",
"left", "refused", "environment_raised", "policy_raised", "process_failed" or "asked_to_rejoin" (`learner.members.events`,
whose fields stand beside it), "progress", or "said" for any other line of the log.
"""

from __future__ import annotations

import dataclasses
import logging
from datetime import UTC, datetime
from typing import Any

import msgspec

from learner.run_folder.progress import NOT_SHOWN, Progress
from protocol.logs.notices import is_notice


class JsonLines(logging.Formatter):
    """Formats a log record as one line of JSON."""

    def format(self, record: logging.LogRecord) -> str:
        """The line, without a line break."""
        event = getattr(record, "event", None)
        fields: dict[str, Any] = {} if event is None else dataclasses.asdict(event)
        kind = "said" if event is None else event.json_name
        level = "info" if is_notice(record) else record.levelname.lower()
        return _line(record.created, level, kind, record.getMessage(), fields)


def progress_line(progress: Progress, now: float) -> str:
    """The progress of the run as one line of JSON. `now` is wall-clock time."""
    message = f"{progress.env_steps} of {progress.total_steps} env steps"
    shown = (name for name in progress.__struct_fields__ if name not in NOT_SHOWN)
    fields = {name: msgspec.to_builtins(getattr(progress, name)) for name in shown}
    return _line(now, "info", "progress", message, fields)


def _line(time: float, level: str, event: str, message: str, fields: dict[str, Any]) -> str:
    stamp = datetime.fromtimestamp(time, UTC).isoformat(timespec="milliseconds")
    return msgspec.json.encode({"time": stamp, "level": level, "event": event, "message": message, **fields}).decode()
