"""A rate-limited log of workers' messages and events.

Rule: lines and bytes are limited for each worker, and for all workers with the same key together; workers without keys share
one limit. This way, a peer that keeps joining under new names, or sends long strings, cannot fill the log. Omitted lines are
counted.
"""

from __future__ import annotations

import logging
from collections.abc import Callable

from millrace.learner.members.events import LoggedEvent, WorkerToldToRejoin, as_extra
from millrace.protocol.bounds import MAX_TEXT, one_line
from millrace.protocol.logs.log_rate_limiter import Allowance, LogBudget, LogRateLimiter, suppressed_note
from millrace.protocol.wire.learner_link import LearnerLink

log = logging.getLogger("millrace.learner")

MOST_WORKERS = 1_000  # how many workers' budgets are remembered
OF_A_WORKER = Allowance(lines=30, lines_per_s=0.2, bytes=MAX_TEXT, bytes_per_s=100)
OF_A_KEY = Allowance(lines=5_000, lines_per_s=1, bytes=6 * MAX_TEXT, bytes_per_s=100)
LINE_BYTES = 100  # size of a line without its text: time, level, line break


class MemberLog:
    """Writes log lines about workers, but only a few for each worker and for each key, however much they send."""

    def __init__(self, link: LearnerLink, clock: Callable[[], float]) -> None:
        self._link = link
        self._clock = clock
        self._limit = LogRateLimiter()
        self._of_key: dict[str, LogBudget] = {}  # one for each key, and one for workers without keys
        self._traceback = ""  # the newest traceback that was logged
        self._of_worker: dict[tuple[str, str], LogBudget] = {}  # by key and name, because two keys may share a name

    def warn_limited(self, peer: bytes, line: str) -> None:
        """Warn about a peer's message, unless there was a line about this peer a short while ago."""
        if (kept_back := self._limit.due(self._link.name_for_log(peer), self._clock())) is not None:
            self._write(logging.WARNING, [self._budget_of_key(peer)], one_line(line), suppressed_note(kept_back))

    def log_event(self, level: int, event: LoggedEvent, lines: str, cause: bytes | None) -> None:
        """Log an event. Lines after the first are a traceback, which is left out if it is too long or equals the last one.

        `cause` is the peer whose message caused the event; None if no message did. Requests to join again are limited
        more strictly, because a restart of the learner causes a flood of them.
        """
        source = self._source(cause)
        kept_back: int | None = 0
        if isinstance(event, WorkerToldToRejoin):
            kept_back = self._limit.due(f"told {event.worker} {source}", self._clock())
        if kept_back is None:
            return
        budgets = [self._budget_of_worker(source, event.worker), self._budget_of_key(cause)]
        self._write(level, budgets, lines, suppressed_note(kept_back), event)

    def _write(self, level: int, budgets: list[LogBudget], lines: str, note: str, event: LoggedEvent | None = None) -> None:
        now = self._clock()
        first, _, more = lines.partition("\n")
        if more and not all(budget.covers(_size(lines), now) for budget in budgets):
            lines = f"{first} (its traceback is left out: too much was logged about this worker)"
            event = None  # the event would bring the traceback into the log, too
        size = _size(lines)
        if not all(budget.covers(size, now) for budget in budgets):
            for budget in budgets:
                budget.suppress()
            return
        suppressed = max(budget.spend(size) for budget in budgets)
        note += f" ({suppressed} more lines about it, or about workers of the same key, were left out)" if suppressed else ""
        first, _, more = lines.partition("\n")
        if more and more == self._traceback:
            first = f"{first}; its traceback is the same as the one before"
            more = ""
        self._traceback = more or self._traceback
        log.log(level, "%s%s%s", first, note, f"\n{more}" if more else "", extra=None if event is None else as_extra(event))

    def _budget_of_key(self, peer: bytes | None) -> LogBudget:
        return self._of_key.setdefault(self._source(peer), LogBudget(OF_A_KEY))

    def _source(self, peer: bytes | None) -> str:
        return self._link.source(peer) if peer else ""

    def _budget_of_worker(self, source: str, worker: str) -> LogBudget:
        budget = self._of_worker.pop((source, worker), None) or LogBudget(OF_A_WORKER)
        self._of_worker[source, worker] = budget  # moved to the end, so the first worker is the one logged least recently
        if len(self._of_worker) > MOST_WORKERS:
            del self._of_worker[next(iter(self._of_worker))]
        return budget


def _size(text: str) -> int:
    return len(text.encode(errors="replace")) + LINE_BYTES
