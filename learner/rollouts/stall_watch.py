"""Decides whether a run has stalled, and which workers cause the stall. Pure.

Rule: env steps, constructions, resets and rollouts count as progress. While the learner waits for rollouts, the progress of
workers that only evaluate doesn't count. While an environment call is within its timeout, the run has not stalled, because
either the call ends or its worker is ended. If there is no progress for `stall_timeout_s`, the workers that hold tickets are
refused, and others get the tickets. The run ends only if no worker would remain. A worker is refused, whatever it claims, if
it holds its tickets for longer than all their environment calls together may take. This applies to tickets for rollouts and
for evaluations.

For an evaluation, that limit may be days. Therefore, if none of its episodes has arrived for `stall_timeout_s` while the
learner waits for it, a second worker plays the oldest ticket as well, whatever the first worker claims.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from millrace.learner.members.member import Member
from millrace.learner.rollouts.ticket_coordinator import TicketCoordinator
from millrace.protocol.call_timeouts import CallTimeouts

ENDED_WITHIN_S = 5.0  # how long after a call's timeout the learner may hear that the worker was ended
CHECK_BUDGETS_EVERY_S = 1.0


@dataclass(frozen=True)
class Standstill:
    """A verdict: refuse these members or, if there are no members, end the run."""

    refuse: tuple[Member, ...]
    why: str


@dataclass(frozen=True)
class Overdue:
    """A verdict: let a second worker play the oldest ticket of the evaluation as well."""


class StallWatch:
    """Watches one run for stalls."""

    def __init__(self, coordinator: TicketCoordinator, stall_timeout_s: float, timeouts: CallTimeouts) -> None:
        self._coordinator = coordinator
        self._stall_timeout_s = stall_timeout_s
        self._timeouts = timeouts
        self._mark: object = None
        self._progress_s = self._answered_s = 0.0
        self._answered = 0  # number of episodes of the pending evaluation that have arrived
        self._dealt_s: dict[tuple[bytes, int], float] = {}  # by worker and ticket, when this object first saw the ticket
        self._budgets_due_s = -math.inf

    def begin(self, now: float) -> None:
        """Record that the learner begins to wait."""
        self._progress_s = self._answered_s = now

    def check(self, now: float, progress: object, *, evaluating: bool = False) -> Standstill | Overdue | None:
        """The verdict; None if the run continues.

        `progress` is a value that changes whenever the awaited work makes progress. `evaluating` says whether the learner
        waits for an evaluation instead of rollouts.
        """
        of_collectors, of_evaluators = self._coordinator.membership.progress.values()
        mark = (of_collectors, evaluating and of_evaluators, progress)
        if mark != self._mark:
            self._mark = mark
            self._progress_s = now
        if now >= self._budgets_due_s:
            self._budgets_due_s = now + CHECK_BUDGETS_EVERY_S
            if over := self._over_budget(now):
                return Standstill(over, "it holds tickets for longer than they can take")
        overdue = Overdue() if evaluating and self._takes_too_long(now) else None
        if now - self._progress_s <= self._stall_timeout_s:
            return overdue
        coordinator = self._coordinator
        members = list(coordinator.members.values()) if evaluating else coordinator.membership.collectors()
        if any(self._in_call(member, now) for member in members):
            return overdue
        self._progress_s = now
        idle = tuple(member for member in members if member.tickets)
        if len(idle) == len(members):
            idle = ()
        return Standstill(idle, f"it holds tickets and has made no progress for {self._stall_timeout_s:.0f} s")

    def _takes_too_long(self, now: float) -> bool:
        """Whether no episode of the evaluation has arrived for too long. If so, restarts the timer."""
        evaluation = self._coordinator.evaluation.pending
        answered = 0 if evaluation is None else evaluation.episodes_played
        overdue = answered == self._answered and now - self._answered_s > self._stall_timeout_s
        if overdue or answered != self._answered:
            self._answered = answered
            self._answered_s = now
        return overdue

    def _in_call(self, member: Member, now: float) -> bool:
        """Whether the member, according to its supervisor, is in an environment call that is within its timeout."""
        said = member.activity
        if said is None or now - member.in_env_code_s > self._coordinator.worker_timeout_s:
            return False
        return said.for_s + now - member.activity_s <= self._timeouts.limit_s(said.doing) + ENDED_WITHIN_S

    def _over_budget(self, now: float) -> tuple[Member, ...]:
        """The members that have held their oldest ticket for longer than all their tickets together may take."""
        coordinator = self._coordinator
        evaluation = coordinator.evaluation.pending
        episodes_s = 0.0 if evaluation is None else self._longest_s(evaluation.plan.copies, evaluation.plan.most_steps)
        held = {
            (peer, number): self._rollout_s(number) if number in coordinator.rollouts.held else episodes_s
            for peer, member in coordinator.members.items()
            for number in member.tickets
        }
        self._dealt_s = {both: self._dealt_s.get(both, now) for both in held}
        oldest_s: dict[bytes, float] = {}
        allowed_s: dict[bytes, float] = {}
        for (peer, number), limit_s in held.items():
            oldest_s[peer] = min(oldest_s.get(peer, now), self._dealt_s[peer, number])
            allowed_s[peer] = allowed_s.get(peer, 0.0) + limit_s
        return tuple(coordinator.members[peer] for peer in oldest_s if now - oldest_s[peer] > allowed_s[peer])

    def _rollout_s(self, number: int) -> float:
        """How long the rollout of this ticket may take, including the steps that are replayed before it."""
        run = self._coordinator.run
        past = self._coordinator.rollouts.held[number].permit.past
        rollout_s = self._longest_s(run.copies, run.rollout_steps)
        if past is not None:
            rollout_s += run.copies * self._timeouts.limit_s("resetting")  # one more reset of each copy
        if past is not None and past.repeated_steps:
            rollout_s += past.repeated_steps * self._timeouts.limit_s("repeating")
        return rollout_s

    def _longest_s(self, copies: int, steps: int) -> float:
        limit_s = self._timeouts.limit_s
        opening_s = limit_s("making") + limit_s("resetting")
        step_s = max(limit_s("stepping"), limit_s("resetting"))
        if self._coordinator.membership.has_policy_code:
            opening_s += limit_s("preparing") + limit_s("acting")  # making the policy, and loading its weights
            step_s += 2 * limit_s("acting")  # one action of the policy, and one of this copy's opponent
        return copies * (opening_s + steps * step_s)
