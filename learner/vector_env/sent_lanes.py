"""Bookkeeping of lanes that were asked for something and have not come back. Pure.

Rule: what was asked of a lane comes back exactly once: with its results, as lost, or in an error. Until then the lane takes
no other order, so that nothing overwrites its results.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import Enum
from typing import Any, Literal

from learner.vector_env.lane_orders import reset_order
from learner.vector_env.lost_lanes import RESET_ATTEMPTS
from learner.vector_env.order_coordinator import MakeOrder
from protocol.arrays import Bytes
from protocol.messages import Returned

Infos = dict[str, Any]
"""What the environment tells beside a row of one copy."""
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


@dataclass(slots=True)
class Sent:
    """What was asked of a lane."""

    copies: Sequence[int]
    """the copies that come back, numbered as in the whole batch"""
    since_s: float
    asked: AskedReset | Asked
    attempts: int = 1
    """how often a reset was sent"""
    last_observations: Mapping[int, Any] | None = None
    """Of copies that were lost and whose episodes end with these observations, while their new copies are reset."""


@dataclass(slots=True)
class ReadyLane:
    """A lane that comes back. Its observations, rewards and episode ends are in the batch."""

    lane: int
    copies: Sequence[int]
    """the copies that come back, numbered as in the whole batch"""
    result: bytes | Returned = b""
    """packed infos, or what a call returned"""
    loss_infos: Mapping[int, Infos] | None = None
    """of copies that come back truncated, because their worker was lost"""


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

    def __init__(self) -> None:
        self._under_way: dict[int, Sent] = {}
        self._ready: dict[int, ReadyLane] = {}

    @property
    def under_way(self) -> Mapping[int, Sent]:
        """Lanes that are not ready, and what they were asked for."""
        return self._under_way

    @property
    def ready_copies(self) -> int:
        """Number of copies that `take` would return."""
        return sum(len(ready.copies) for ready in self._ready.values())

    def copies(self) -> list[int]:
        """The copies that have not come back, in ascending order."""
        lanes: list[Sent | ReadyLane] = [*self._under_way.values(), *self._ready.values()]
        return sorted(n for lane in lanes for n in lane.copies)

    def among(self, lanes: Iterable[int]) -> list[int]:
        """Those of these lanes that have not come back."""
        return [lane for lane in lanes if lane in self._under_way or lane in self._ready]

    def send(self, lane: int, sent: Sent) -> None:
        """The lane was sent an order. Raises `ValueError` if an earlier one has not come back."""
        if lane in self._under_way or lane in self._ready:
            raise ValueError(f"lane {lane}: expected one that has come back, got one that has not")
        self._under_way[lane] = sent

    def reset_instead(self, lane: int, reset: AskedReset, now: float, last_observations: Mapping[int, Any]) -> None:
        """The lane was lost: its new copies are reset before it comes back."""
        sent = self._under_way[lane]
        again = 1 if sent.asked is Asked.STEP else sent.attempts + 1
        kept = last_observations or sent.last_observations
        self._under_way[lane] = replace(sent, asked=reset, attempts=again, since_s=now, last_observations=kept)

    def start_again(self, now: float) -> None:
        """From now on, every lane that is under way has its whole time again."""
        self._under_way = {lane: replace(sent, since_s=now) for lane, sent in self._under_way.items()}

    def ready(self, lane: int, result: bytes | Returned) -> None:
        """The lane has its results."""
        sent = self._under_way.pop(lane)
        if not sent.last_observations:
            self._ready[lane] = ReadyLane(lane, sent.copies, result)
            return
        losses: dict[int, Infos] = {
            n: {"worker_lost": True, "final_obs": last, "final_info": {"worker_lost": True}}
            for n, last in sent.last_observations.items()
        }
        self._ready[lane] = ReadyLane(lane, sent.copies, result, losses)

    def ready_as_lost(self, lane: int) -> None:
        """The lane comes back truncated, and is reset by the caller or by its next step."""
        copies = self._under_way.pop(lane).copies
        self._ready[lane] = ReadyLane(lane, copies, loss_infos={n: {"worker_lost": True} for n in copies})

    def drop(self, lanes: Iterable[int]) -> None:
        """These lanes do not come back: the caller gets an error that names them."""
        for lane in lanes:
            self._under_way.pop(lane, None)

    def clear(self) -> list[int]:
        """Nothing is waited for any more. Returns the lanes that were under way."""
        dropped = list(self._under_way)
        self._under_way.clear()
        self._ready.clear()
        return dropped

    def overdue(self, now: float, timeout_s: float) -> list[int]:
        """Lanes that have been under way for longer than `timeout_s`."""
        return [lane for lane, sent in self._under_way.items() if now - sent.since_s > timeout_s]

    def take(self) -> Sequence[ReadyLane]:
        """The lanes that are ready, in the order of their copies. They have come back now."""
        ready, self._ready = self._ready, {}
        return [ready[lane] for lane in sorted(ready)]


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
