"""A line that says who waits for whom in a run, and for what share of the time. Pure: the state and `now` in, a line out.

Rule: waits shorter than `LONG_S` aren't mentioned. Between two long waits for rollouts, the line mentions the last wait, so
that the text does not appear and disappear all the time. While the learner waits, the line names the lanes whose rollouts
are missing for the next update. It also says how many of that update's env steps have been made, because with a slow
simulator the first update may be far away, and how long a call that may hang can take. While the learner learns, the line
says how many workers wait for weights. The shares are fractions of the training time since the learner started, without
evaluations.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Literal, get_args

from millrace.learner.members.held_up import LONG_S, held_up
from millrace.learner.members.member import Member
from millrace.learner.members.worker_processes import WorkerProcesses
from millrace.learner.rollouts.evaluation_dealer import PendingEvaluation
from millrace.learner.rollouts.ticket_coordinator import TicketCoordinator
from millrace.protocol.bounds import one_line

Phase = Literal["starting", "gathering", "learning", "evaluating"]
SHARES_AFTER_S = 30.0
SHORT_S = 180.0  # longer times are given in minutes
MOST_LANES = 4  # the largest number of lanes that a line names
LIMIT_AFTER_S = 20.0  # the line says how long a call may take once it has taken this long


class LearnerTime:
    """Records what the learner is doing, since when, and how it has spent its time."""

    def __init__(
        self, coordinator: TicketCoordinator, now: float, no_worker: Callable[[], str], processes: WorkerProcesses
    ) -> None:
        """While there is no member, `no_worker` returns a clause that says what the learner is waiting for."""
        self.phase: Phase = "starting"
        self.since_s = now
        self._last = ""  # the last wait for rollouts in words; empty if it was short
        self.spent_s: dict[Phase, float] = dict.fromkeys(get_args(Phase), 0.0)
        """total seconds of each phase, without the current one"""
        self._coordinator = coordinator
        self._no_worker = no_worker
        self._processes = processes

    @property
    def evaluating(self) -> bool:
        """Whether the learner waits for an evaluation."""
        return self.phase == "evaluating"

    def turn(self, phase: Phase, now: float) -> None:
        """Record that the learner enters this phase."""
        if self.phase == "gathering":
            waited_s = now - self.since_s
            self._last = f"waited {waited_s:.0f} s for rollouts" if waited_s >= LONG_S else ""
        self.spent_s = self.until(now)
        self.phase = phase
        self.since_s = now

    def learned(self, now: float) -> None:
        """Record that an update has ended, and that the workers waiting for its weights are about to get them."""
        if self.phase == "learning":
            if now - self.since_s >= LONG_S:
                self._last = self._learning(now)
            self.turn("learning", now)

    def until(self, now: float) -> dict[Phase, float]:
        """Total seconds of each phase until now."""
        return self.spent_s | {self.phase: self.spent_s[self.phase] + now - self.since_s}

    def line(self, now: float) -> str:
        """The line that says who waits for whom; empty if nobody has waited for long."""
        lasts_s = now - self.since_s
        members = self._coordinator.members
        spent_s = self.until(now)
        text = ""
        if members and self.evaluating and (evaluation := self._coordinator.evaluation.pending) is not None:
            what = "evaluating the best policy" if evaluation.plan.of_best else "evaluating"
            return one_line(f"{what} for {lasts_s:.0f} s: {self._played(evaluation, now)}")
        if lasts_s < LONG_S:
            text = self._last
        elif self.phase == "learning":
            text = self._learning(now)
        elif not members:
            text = f"waiting {lasts_s:.0f} s for {self._no_worker()}"
        elif self.phase == "gathering" and self._coordinator.rollouts.awaited():
            text = f"waiting {lasts_s:.0f} s for {self._awaited(now)}{self._collected(now)}"
        if text and (total_s := spent_s["gathering"] + spent_s["learning"]) >= SHARES_AFTER_S:
            gather = spent_s["gathering"] / total_s
            learn = spent_s["learning"] / total_s
            text += f"; so far {gather:.0%} waiting for rollouts, {learn:.0%} learning"
        return one_line(text)

    def _learning(self, now: float) -> str:
        """How long the learner has been learning, and how many workers have lanes but no ticket."""
        members = self._coordinator.members.values()
        idle = sum(not member.tickets for member in members if member.lanes)
        waiting = f", {idle} of {len(members)} workers waiting for weights" if idle else ""
        return f"learning for {now - self.since_s:.0f} s{waiting}"

    def _awaited(self, now: float) -> str:
        """A clause about the worker that has been held up longest, its awaited lanes, and how many others are awaited."""
        lanes = dict[bytes, set[int]]()
        members = self._coordinator.members
        for ticket in self._coordinator.rollouts.awaited():
            lanes.setdefault(ticket.peer, set()).add(ticket.permit.lane)
        peer = max(lanes, key=lambda peer: held_up(members[peer], now))
        mine = sorted(lanes.pop(peer))
        more = sum(map(len, lanes.values()))
        named = ", ".join(map(str, mine[:MOST_LANES])) + ", …" * (len(mine) > MOST_LANES)
        who = self._held_up_longest([members[peer]], now)
        return f"lane{'s' * (len(mine) > 1)} {named} ({who})" + (f" and {more} more" if more else "")

    def _collected(self, now: float) -> str:
        """How many env steps of the next update have been made, and how long the rest will take; empty if none was made."""
        coordinator = self._coordinator
        made = coordinator.collected()
        of = coordinator.steps_of_update()
        if not made:
            return ""
        which = "next" if coordinator.rollouts.rounds.next else "first"
        per_s = sum(member.status(now).steps_per_s for member in coordinator.membership.collectors())
        left = f", about {_in_words((of - made) / per_s)} left" if per_s and made < of else ""
        return f"; {which} rollouts: {made:,} of {of:,} env steps{left}"

    def _played(self, evaluation: PendingEvaluation, now: float) -> str:
        """How far an evaluation has got, and which of the workers playing it has been held up longest."""
        who = self._held_up_longest(evaluation.players, now)
        done = f"{evaluation.episodes_played} of {len(evaluation.plan.seeds)} episodes"
        return f"{done} (at most {evaluation.plan.longest_episode:,} env steps each); {who}"

    def _held_up_longest(self, members: list[Member], now: float) -> str:
        """The worker held up longest: one of these members or, if other workers step for them, one of the other workers."""
        who = self._processes.stepping() or members
        if not who:
            return "nobody plays"
        member = max(who, key=lambda member: held_up(member, now))
        *_, line = held_up(member, now)
        activity = member.activity
        silent = now - member.alive_s >= LONG_S
        if activity is None or silent or member.status(now).doing_s < LIMIT_AFTER_S:
            return line
        limits = self._coordinator.run.call_timeouts
        if limits.limit_s(activity.doing) == math.inf:
            return line
        return f"{line}, at most {limits.limit_in_words(activity.doing)}"


def _in_words(seconds: float) -> str:
    """A rough time in words: in seconds if it is short, otherwise in minutes."""
    return f"{seconds:.0f} s" if seconds < SHORT_S else f"{seconds / 60:,.0f} min"
