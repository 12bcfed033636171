"""Bookkeeping of lanes that were asked for something and have not come back. Pure.

Rule: what was asked of a lane comes back exactly once: with its results, as lost, or in an error. Until then the lane takes
no other order, so that nothing overwrites its results.
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
"""What the environment tells beside a row."""
LONGEST_GAP_S = 0.5  # a caller that looks less often was busy, or its process was stopped


@dataclass(frozen=True)
class AskedReset:
    """The reset that a lane was asked for, to be repeated if its worker is lost."""

    copies: tuple[int, ...]
    """numbered in the lane"""
    seeds: tuple[int | None, ...]
    options: Bytes

    def order(self) -> MakeOrder:
        """Makes the order for it."""
        return reset_order(self.copies, self.seeds, self.options)


class Asked(Enum):
    """What else a lane was asked for."""

    STEP = 0
    CALL = 1


class Sent(NamedTuple):
    """What was asked of a lane, or of several alike."""

    asked: AskedReset | Asked
    since_s: float
    attempts: int = 1
    """how often a reset was sent"""
    last_observations: Mapping[int, Any] | None = None
    """by row: those with which the episodes of lost copies end, while their new copies are reset"""


class Ready(NamedTuple):
    """The lanes that come back together. Their observations, rewards and episode ends are in the batch."""

    results: Mapping[int, bytes | Returned]
    """by lane, in ascending order: packed infos, or what a call returned"""
    losses: Mapping[int, Infos]
    """by row: infos of those that come back truncated, because their worker was lost"""


class AfterLoss(Enum):
    """What to do about a lane that was lost before it came back."""

    RAISE = 0
    """the caller gets an error"""
    RESET_AGAIN = 1
    """new copies get the same reset"""
    RESET_NEW_COPIES = 2
    """the lane comes back truncated, together with the first observations of new copies, as SameStep says"""
    COME_BACK = 3
    """the lane comes back truncated, at its newest observations"""


def after_loss(
    sent: Sent, autoreset: Literal["NextStep", "SameStep", "Disabled"], on_worker_loss: Literal["truncate", "raise"]
) -> AfterLoss:
    """What to do about a lane that was sent this, and whose worker is lost."""
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
        """by lane: what the lanes that have not come back were asked for"""
        self._results: dict[int, bytes | Returned] = {}  # of those that are ready
        self._losses: dict[int, Infos] = {}  # by row, of those that are ready

    @property
    def all_ready(self) -> bool:
        """Whether no lane is under way."""
        return len(self._results) == len(self.sent)

    def are_ready(self, lanes: Iterable[int]) -> bool:
        """Whether none of these lanes is under way."""
        return all(lane in self._results or lane not in self.sent for lane in lanes)

    @property
    def under_way(self) -> list[int]:
        """Lanes that are not ready."""
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
        """These lanes were sent an order. Raises `ValueError` if an earlier one of theirs has not come back."""
        if early := self.among(lanes):
            raise ValueError(f"lanes {early}: expected some that have come back, got some that have not")
        self.sent |= dict.fromkeys(lanes, sent)

    def reset_instead(self, lane: int, reset: AskedReset, now: float, last_observations: Mapping[int, Any]) -> None:
        """The lane was lost: its new copies are reset before it comes back."""
        sent = self.sent[lane]
        again = 1 if sent.asked is Asked.STEP else sent.attempts + 1
        self.sent[lane] = Sent(reset, now, again, last_observations or sent.last_observations)

    def start_again(self, now: float) -> None:
        """From now on, every lane that is under way has its whole time again."""
        self.sent = {lane: sent._replace(since_s=now) for lane, sent in self.sent.items()}

    def ready(self, results: Mapping[int, bytes | Returned]) -> None:
        """These lanes have their results."""
        self._results |= results
        for lane in results:
            for row, last in (self.sent[lane].last_observations or {}).items():
                self._losses[row] = {"worker_lost": True, "final_obs": last, "final_info": {"worker_lost": True}}

    def ready_as_lost(self, lane: int) -> None:
        """The lane comes back truncated, and is reset by the caller or by its next step."""
        self._results[lane] = b""
        self._losses |= {row: {"worker_lost": True} for row in self._layout.rows_of(self._layout.copies(lane))}

    def drop(self, lane: int) -> None:
        """The lane does not come back: the caller gets an error that names it."""
        del self.sent[lane]

    def clear(self) -> list[int]:
        """Nothing is waited for any more. Returns the lanes that were under way."""
        dropped = self.under_way
        self.sent = {}
        self._results = {}
        self._losses = {}
        return dropped

    def overdue(self, now: float, timeout_s: float) -> list[int]:
        """Lanes that have been under way for longer than `timeout_s`."""
        return [lane for lane in self.under_way if now - self.sent[lane].since_s > timeout_s]

    def take(self) -> Ready:
        """The lanes that are ready. They have come back now."""
        ready = Ready(dict(sorted(self._results.items())), self._losses)
        self._results = {}
        self._losses = {}
        for lane in ready.results:
            del self.sent[lane]
        return ready

    def take_some(self, lanes: Iterable[int]) -> Ready:
        """Those of these lanes that are ready. They have come back now; other lanes stay ready."""
        taken = [lane for lane in sorted(lanes) if lane in self._results]
        rows = self._layout.rows_of(self._layout.copies_of(taken)) if self._losses else ()
        for lane in taken:
            del self.sent[lane]
        return Ready(
            {lane: self._results.pop(lane) for lane in taken},
            {row: self._losses.pop(row) for row in rows if row in self._losses},
        )

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
    """A clock for what a worker may take: of a longer time in which nobody looked, only `LONGEST_GAP_S` counts.

    So a learner that computed for a minute, or was stopped together with its workers, gives up nobody for that.
    """

    def __init__(self, now: float) -> None:
        self._looked_s = now
        self._total_s = 0.0

    def look(self, now: float) -> float:
        """Seconds watched until now."""
        self._total_s += min(now - self._looked_s, LONGEST_GAP_S)
        self._looked_s = now
        return self._total_s
