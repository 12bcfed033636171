"""Bookkeeping of lanes that were sent an order and have not come back. Pure.

Rule: a lane that was sent an order comes back exactly once: with its results, as lost, or in an error. Until then the lane
gets no other order, so that nothing overwrites its results.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from enum import Enum
from typing import Any, Literal, NamedTuple

from millrace.learner.vector_env.batch_layout import BatchLayout
from millrace.learner.vector_env.lane_orders import reset_order
from millrace.learner.vector_env.lost_lanes import RESET_ATTEMPTS
from millrace.learner.vector_env.order_coordinator import MakeOrder
from millrace.protocol.arrays import Bytes
from millrace.protocol.messages import Returned

Infos = dict[str, Any]
"""The info that an environment returns alongside a row."""
LONGEST_GAP_S = 0.5  # a caller that looks less often is busy, or its process was suspended


@dataclass(frozen=True)
class AskedReset:
    """The reset that a lane was asked for, to be repeated if its worker is lost."""

    copies: tuple[int, ...]
    """the copies to reset, numbered within the lane"""
    seeds: tuple[int | None, ...]
    options: Bytes

    def order(self) -> MakeOrder:
        """The order for this reset."""
        return reset_order(self.copies, self.seeds, self.options)


class Asked(Enum):
    """The orders other than resets that a lane can be sent. They are not repeated after a loss."""

    STEP = 0
    CALL = 1


class Sent(NamedTuple):
    """The order that one or more lanes were sent, and when."""

    asked: AskedReset | Asked
    since_s: float
    attempts: int = 1
    """how many times the reset has been sent"""
    last_observations: Mapping[int, Any] | None = None
    """by row, the final observations of lost copies' episodes, while the new copies are reset"""


class Ready(NamedTuple):
    """The lanes that come back together. Their observations, rewards and episode ends are in the batch."""

    results: Mapping[int, bytes | Returned]
    """by lane, in ascending order: packed infos, or the results of a call"""
    losses: Mapping[int, Infos]
    """by row: the infos of rows that come back truncated because their worker was lost"""


class AfterLoss(Enum):
    """How to handle a lane that was lost before it came back."""

    RAISE = 0
    """the caller gets an error"""
    RESET_AGAIN = 1
    """new copies get the same reset"""
    RESET_NEW_COPIES = 2
    """the lane comes back truncated, together with the first observations of new copies, as SameStep requires"""
    COME_BACK = 3
    """the lane comes back truncated at its newest observations"""


def after_loss(
    sent: Sent, autoreset: Literal["NextStep", "SameStep", "Disabled"], on_worker_loss: Literal["truncate", "raise"]
) -> AfterLoss:
    """How to handle a lane that was sent this order, and whose worker is lost."""
    if on_worker_loss == "raise" or sent.asked is Asked.CALL:
        return AfterLoss.RAISE
    if sent.asked is not Asked.STEP:
        return AfterLoss.RESET_AGAIN if sent.attempts < RESET_ATTEMPTS else AfterLoss.RAISE
    return AfterLoss.RESET_NEW_COPIES if autoreset == "SameStep" else AfterLoss.COME_BACK


class SentLanes:
    """The lanes that were sent an order: those that are under way, and those that are ready to come back."""

    def __init__(self, layout: BatchLayout) -> None:
        self._layout = layout
        self.sent: dict[int, Sent] = {}
        """the orders of the lanes that have not come back, by lane"""
        self._results: dict[int, bytes | Returned] = {}  # results of the lanes that are ready, by lane
        self._losses: dict[int, Infos] = {}  # infos of lost rows in the lanes that are ready, by row

    @property
    def all_ready(self) -> bool:
        """Whether no lane is under way."""
        return len(self._results) == len(self.sent)

    def are_ready(self, lanes: Iterable[int]) -> bool:
        """Whether none of these lanes is under way."""
        return all(lane in self._results or lane not in self.sent for lane in lanes)

    @property
    def under_way(self) -> list[int]:
        """The lanes that were sent an order and are not ready."""
        return [lane for lane in self.sent if lane not in self._results]

    @property
    def copies(self) -> list[int]:
        """The copies that have not come back, in ascending order."""
        return self._copies(sorted(self.sent)) if self.sent else []

    @property
    def ready_copies(self) -> list[int]:
        """The copies that `take` would return, in ascending order."""
        return self._copies(sorted(self._results))

    def among(self, lanes: Iterable[int]) -> list[int]:
        """The lanes among these that have not come back."""
        return [lane for lane in lanes if lane in self.sent] if self.sent else []

    def send(self, lanes: Iterable[int], sent: Sent) -> None:
        """Record that these lanes were sent an order. Raises `ValueError` if one still has an earlier order."""
        if early := self.among(lanes):
            raise ValueError(f"lanes {early}: expected some that have come back, got some that have not")
        self.sent |= dict.fromkeys(lanes, sent)

    def reset_instead(self, lane: int, reset: AskedReset, now: float, last_observations: Mapping[int, Any]) -> None:
        """Record that the lane was lost, and that its new copies are reset before it comes back."""
        sent = self.sent[lane]
        again = 1 if sent.asked is Asked.STEP else sent.attempts + 1
        self.sent[lane] = Sent(reset, now, again, last_observations or sent.last_observations)

    def start_again(self, now: float) -> None:
        """Restart the clock of every lane that is under way, so that each has its whole time again."""
        self.sent = {lane: sent._replace(since_s=now) for lane, sent in self.sent.items()}

    def ready(self, results: Mapping[int, bytes | Returned]) -> None:
        """Record the results of these lanes, which are now ready."""
        self._results |= results
        for lane in results:
            for row, last in (self.sent[lane].last_observations or {}).items():
                self._losses[row] = {"worker_lost": True, "final_obs": last, "final_info": {"worker_lost": True}}

    def ready_as_lost(self, lane: int) -> None:
        """Record that the lane is ready and comes back truncated. The caller or its next step resets it."""
        self._results[lane] = b""
        self._losses |= {row: {"worker_lost": True} for row in self._layout.rows_of(self._layout.copies(lane))}

    def drop(self, lane: int) -> None:
        """Forget a lane that does not come back, because the caller gets an error that names it."""
        del self.sent[lane]

    def give_up(self, lanes: Iterable[int]) -> list[int]:
        """Forget these lanes and their results. Returns the lanes that were under way."""
        self.take_some(lanes)
        dropped = self.among(lanes)
        for lane in dropped:
            self.drop(lane)
        return dropped

    def overdue(self, now: float, timeout_s: float) -> list[int]:
        """The lanes that have been under way for longer than `timeout_s`."""
        return [lane for lane in self.under_way if now - self.sent[lane].since_s > timeout_s]

    def take(self) -> Ready:
        """Take the lanes that are ready. From now on they count as having come back."""
        return self.take_some(self._results)

    def take_some(self, lanes: Iterable[int]) -> Ready:
        """Take whichever of these lanes are ready; they now count as having come back. Others are left for later."""
        taken = [lane for lane in sorted(lanes) if lane in self._results]
        rows = self._layout.rows_of(self._layout.copies_of(taken)) if self._losses else ()
        losses = {row: self._losses.pop(row) for row in rows if row in self._losses}
        results = {lane: self._results.pop(lane) for lane in taken}
        for lane in taken:
            del self.sent[lane]
        return Ready(results, losses)

    def _copies(self, lanes: Iterable[int]) -> list[int]:
        found: list[int] = []
        for lane in lanes:
            match self.sent[lane].asked:
                case Asked.STEP:
                    found += self._layout.copies(lane)
                case AskedReset(copies):
                    found += [self._layout.copies(lane)[n] for n in copies]
        return found


class WatchedTime:
    """A clock for the timeouts of workers. Between two looks at the clock, at most `LONGEST_GAP_S` counts.

    This way, no worker is treated as lost because the learner computed for a minute, or was suspended together with its
    workers.
    """

    def __init__(self, now: float) -> None:
        self._looked_s = now
        self._total_s = 0.0

    def look(self, now: float) -> float:
        """Look at the clock. Returns the seconds that have counted so far."""
        self._total_s += min(now - self._looked_s, LONGEST_GAP_S)
        self._looked_s = now
        return self._total_s
