"""How many environment failures a run survives. Pure: failures and finished work in, a verdict out.

Rule: there are two counts of failures, and either can end the run.

* In a row: the failures of one lane since its last rollout. `max_env_failures` are allowed, but never more than
  `MOST_IN_A_ROW`, so that an environment that never works ends the run quickly even if many failures are allowed. A failure
  after env steps counts only as `AFTER_STEPS`, because a simulator that crashes often may happen to fail a few times before
  a rollout is complete.
* Within an hour: the failures of all lanes that occurred after env steps. `max_env_failures` × (1 + env copies × h + w /
  `WORK_S`) are allowed. Here, h is the number of hours since the learner began, but at most 1, and w is the total number of
  seconds that the failed workers had worked. As a result, a bug in an environment's code ends a run that has just begun,
  but a simulator that crashes now and then doesn't end a run, as long as its workers work most of the time.

These limits end a run late, so the log warns early: at the fourth failure within an hour, and whenever the number of
failures within an hour has doubled since the last warning.
"""

from __future__ import annotations

from collections.abc import Collection

from millrace.learner.members.events import Event, Failed
from millrace.protocol.errors import EnvironmentFailed, PolicyFailed

MOST_IN_A_ROW = 10
AFTER_STEPS = 0.25
HOUR_S = 3600.0
WORK_S = 30.0
TOLD_FIRST = 4


class FailureCount:
    """The failures of a run. Each is attributed to lanes (by number) or to a worker without a lane (by name)."""

    def __init__(self, allowed: int, copies: int = 1, began_s: float = 0.0) -> None:
        """`allowed` is `max_env_failures`, `copies` the number of env copies, `began_s` the time when the learner began."""
        self._allowed = allowed
        self._copies = copies
        self._began_s = began_s
        self._in_a_row: dict[int | str, float] = {}
        self._error: EnvironmentFailed | PolicyFailed | None = None
        self._within_hour: list[tuple[float, float]] = []  # per failure after env steps: time, and seconds worked before it
        self._told_at = TOLD_FIRST  # the number of failures within an hour at which the log warns next

    def failed(self, lanes: Collection[int | str], worked_s: float | None, now: float) -> str:
        """Count one failure that stopped these lanes. Returns why the run ends, or an empty string.

        `worked_s` is the number of seconds for which the worker had been taking env steps; None if its process is not known
        to have made one.
        """
        stepped = worked_s is not None
        for lane in lanes:
            self._in_a_row[lane] = self._in_a_row.get(lane, 0.0) + (AFTER_STEPS if stepped else 1.0)
        if worked_s is not None:
            recent = [(at_s, before_s) for at_s, before_s in self._within_hour if now - at_s < HOUR_S]
            self._within_hour = [*recent, (now, min(worked_s, HOUR_S))]
            failures = len(self._within_hour)
            allowed = self._allowed_within_hour(now)
            if failures > allowed:
                more = f"as many for each {WORK_S:g} s that the workers which failed had worked"
                copies = f"as many an hour for each of {self._copies} env copies"
                why = f"{self._allowed}, {more}, and {copies}; set it higher if need be"
                return f"failure {failures} within an hour; max_env_failures allows {allowed} ({why})"
        in_a_row = max(map(self._in_a_row.__getitem__, lanes))
        allowed = min(self._allowed, MOST_IN_A_ROW)
        if in_a_row <= allowed:
            return ""
        hint = "; shorter rollouts may help" if stepped else ""
        why = f" (one after env steps counts as {AFTER_STEPS:g}{hint})" if in_a_row % 1 else ""
        return f"failure {in_a_row:g} in a row{why}; max_env_failures allows {allowed} in a row"

    def count(self, event: Event, now: float) -> str:
        """Count an event if it is a failure of the environment or of the user's policy. Both are counted together.

        Returns a line for the log if the user should know how often the environment fails; otherwise an empty string.
        """
        if not isinstance(event, Failed) or event.spare or self._error is not None:
            return ""
        if why := self.failed(event.lanes or (event.worker,), event.worked_s, now):
            self._error = event.exception(why)
            return ""
        return self._how_often(now)

    def _allowed_within_hour(self, now: float) -> int:
        copy_hours = self._copies * min(1.0, (now - self._began_s) / HOUR_S)
        return int(self._allowed * (1 + copy_hours + self._worked_s() / WORK_S))

    def _worked_s(self) -> float:
        """How many seconds, in total, the workers that failed within the hour had worked."""
        return sum(before_s for _, before_s in self._within_hour)

    def _how_often(self, now: float) -> str:
        failures = len(self._within_hour)
        if failures < self._told_at:
            self._told_at = max(TOLD_FIRST, min(self._told_at, 2 * failures))  # the number of failures may have fallen
            return ""
        self._told_at = 2 * failures
        seconds = now - self._within_hour[0][0]
        worked_s = self._worked_s() / failures
        last = self._allowed_within_hour(now) + 1
        return (
            f"the environment has failed {failures} times in {seconds:.0f} s, after {worked_s:.0f} s of work on average; "
            f"its workers are started again, and failure {last} within an hour would end the run"
        )

    def check(self) -> None:
        """Raise the first failure that exceeded a limit, if there was one."""
        if self._error is not None:
            raise self._error

    def collected(self, lane: int) -> None:
        """Record that a rollout of this lane has arrived."""
        self._in_a_row.pop(lane, None)

    def evaluated(self, worker: str | None = None) -> None:
        """Record that evaluation episodes were played. They don't belong to a lane.

        `worker` is the worker that played them alongside training; None if the workers that collect rollouts played them.
        """
        if worker is None:
            self._in_a_row.clear()
        else:
            self._in_a_row.pop(worker, None)
