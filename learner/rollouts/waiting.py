"""Who waits for whom in a run, and for what share of the time: one line. Pure: the state and `now` in, a sentence out.

Rule: what takes less than `LONG_S` is not said. Between two long waits for rollouts, the line tells of the last one, so that
it does not come and go. While the learner waits, the line names lanes whose tickets are with workers: with a lag above 0,
any of these may bring the next rollout. While it learns, the workers that hold no ticket wait for weights. The shares are
those of training since the learner started: evaluations do not count.
"""

from __future__ import annotations

from typing import Literal, get_args

from learner.members.held_up import LONG_S, held_up
from learner.rollouts.evaluation_tickets import EvaluationPlan
from learner.rollouts.ticket_coordinator import TicketCoordinator
from protocol.bounds import one_line

Phase = Literal["starting", "gathering", "learning", "evaluating"]
SHARES_AFTER_S = 30.0
MOST_LANES = 4  # that are named by their numbers


class LearnerTime:
    """What the learner does, since when, and how it has spent its time."""

    def __init__(self, now: float) -> None:
        self.phase: Phase = "starting"
        self.since_s, self._last = now, ""  # who waited last; empty if the last wait for rollouts was short
        self.spent_s: dict[Phase, float] = dict.fromkeys(get_args(Phase), 0.0)
        """seconds of the phases that have ended"""

    def turn(self, phase: Phase, now: float) -> None:
        """From now on the learner does this."""
        if self.phase == "gathering":
            waited_s = now - self.since_s
            self._last = f"waited {waited_s:.0f} s for rollouts" if waited_s >= LONG_S else ""
        self.spent_s, self.phase, self.since_s = self.until(now), phase, now

    def learned(self, coordinator: TicketCoordinator, now: float) -> None:
        """New weights are about to be sent to the workers that wait for them."""
        if self.phase == "learning":
            self._last = _learning(coordinator, now - self.since_s) or self._last
            self.turn("learning", now)

    def until(self, now: float) -> dict[Phase, float]:
        """Seconds of each phase until now."""
        return self.spent_s | {self.phase: self.spent_s[self.phase] + now - self.since_s}

    def line(self, coordinator: TicketCoordinator, now: float, no_worker: str, stepping: str = "") -> str:
        """Who waits for whom; empty if nobody waits long. `no_worker`: what is awaited if there is none.

        `stepping`: who is held up, if the members do not step the environment themselves.
        """
        lasts_s, spent_s, members, text = now - self.since_s, self.until(now), coordinator.members, ""
        total_s = spent_s["gathering"] + spent_s["learning"]
        if members and (plan := coordinator.evaluation.plan) is not None:
            return _played(coordinator, plan, lasts_s, now, stepping)
        if lasts_s < LONG_S:
            text = self._last
        elif self.phase == "learning":
            text = _learning(coordinator, lasts_s)
        elif not members:
            text = f"waiting {lasts_s:.0f} s for {no_worker}"
        elif coordinator.tickets and self.phase == "gathering":
            text = f"waiting {lasts_s:.0f} s for {_awaited(coordinator, now, stepping)}"
        if text and total_s >= SHARES_AFTER_S:
            gather, learn = spent_s["gathering"] / total_s, spent_s["learning"] / total_s
            text += f"; so far {gather:.0%} waiting for rollouts, {learn:.0%} learning"
        return one_line(text)


def _learning(coordinator: TicketCoordinator, for_s: float) -> str:
    """For how long the learner learns, and how many workers have lanes and no ticket; empty if it is not for long."""
    members = coordinator.members.values()
    idle = sum(not member.tickets for member in members if member.lanes) if for_s >= LONG_S else 0
    waiting = f", {idle} of {len(members)} workers waiting for weights" if idle else ""
    return f"learning for {for_s:.0f} s{waiting}" if for_s >= LONG_S else ""


def _awaited(coordinator: TicketCoordinator, now: float, stepping: str) -> str:
    """The lanes of the worker that is held up longest, that worker, and how many other lanes are awaited."""
    lanes: dict[bytes, set[int]] = {}
    for ticket in coordinator.tickets.values():
        lanes.setdefault(ticket.peer, set()).add(ticket.lane)
    (*_, who), peer = max((held_up(coordinator.members[peer], now), peer) for peer in lanes)
    mine, more = sorted(lanes.pop(peer)), sum(map(len, lanes.values()))
    named = ", ".join(map(str, mine[:MOST_LANES])) + ", …" * (len(mine) > MOST_LANES)
    return f"lane{'s' * (len(mine) > 1)} {named} ({stepping or who})" + (f" and {more} more" if more else "")


def _played(coordinator: TicketCoordinator, plan: EvaluationPlan, for_s: float, now: float, stepping: str) -> str:
    """How far an evaluation is, and who is held up longest of those that play it."""
    evaluation = coordinator.evaluation
    (*_, who) = max((held_up(coordinator.members[peer], now) for peer in evaluation.holders), default=("nobody plays",))
    done = f"{evaluation.episodes_played} of {len(plan.seeds)} episodes (at most {plan.most_steps:,} env steps each)"
    return one_line(f"evaluating{' the best policy' * plan.of_best} for {for_s:.0f} s: {done}; {stepping or who}")
