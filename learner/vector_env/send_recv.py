"""Steps of lanes that do not wait for each other: `async_reset`, `send` and `recv` of a vector environment.

Rule: for the same seeds and actions, each lane gives the same rows as in lock-step, whatever the others do. A lost worker is
reported by `recv`, as truncated copies or as an error, and costs no other lane its results.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from gymnasium.error import AlreadyPendingCallError, NoAsyncCallError

from learner.vector_env.batch_arrays import BatchArrays
from learner.vector_env.batch_layout import BatchLayout
from learner.vector_env.lane_orders import packed, reset_order, step_order
from learner.vector_env.lost_lanes import LostLanes, replacement_seeds, worker_lost
from learner.vector_env.sent_lanes import AfterLoss, AskedReset, ReadyLane, Sent, SentLanes, WatchedTime, after_loss
from learner.vector_env.step_hub import StepHub
from protocol.arrays import Array, Bools, Bytes
from protocol.errors import NoWorkers, UsageError, WorkerLost
from protocol.messages import Answer, Stepped
from protocol.wire.shared_memory import SharedMemory

log = logging.getLogger("millrace.learner")


@dataclass(frozen=True)
class VectorEnvParts:
    """What a vector environment is made of, whichever way it is stepped."""

    hub: StepHub
    layout: BatchLayout
    batch: BatchArrays
    memory: SharedMemory | None
    lost_lanes: LostLanes
    read_actions: Callable[[Any, int], tuple[list[Array], bool]]
    """Takes actions and their number: arrays, and whether shared memory can hold them without rounding."""
    autoreset: Literal["NextStep", "SameStep", "Disabled"]
    seeds: list[int | None]
    """of each copy's last seeded reset"""
    ever_reset: Bools
    """[num_envs] whether the copy was ever reset"""

    def ended_copies(self, copies: Sequence[int]) -> list[int]:
        """Those of these copies that cannot step: they have ended, as the caller knows, and only the caller resets them."""
        if self.autoreset != "Disabled":
            return []
        ended = self.batch.terminated | self.batch.truncated
        for lane in self.lost_lanes.unreported:
            ended[self.layout.rows[lane]] = False  # the caller learns it from the result of the next step
        return [n for n in copies if ended[n]]

    def check_reset(self, copies: Mapping[int, Sequence[int]]) -> None:
        """Raise `UsageError` if a reset of these copies, by lane, leaves out copies of a lane that awaits a reset.

        All copies of such a lane are new. With SameStep no step resets a copy before its first episode.
        """
        for lane in self.lost_lanes.awaiting_reset & copies.keys() if self.autoreset == "SameStep" else ():
            if len(copies[lane]) < self.layout.size(lane):
                of_lane = self.layout.copies(lane)
                raise UsageError(
                    f"reset of copies {[of_lane[n] for n in copies[lane]]}: expected all copies of lane {lane} "
                    f"({of_lane[0]} to {of_lane[-1]}), which were lost with their worker; reset them together"
                )

    def replacement_seeds(self, lane: int) -> tuple[int | None, ...]:
        """Seeds for the copies that replace those of a lost lane."""
        return replacement_seeds(self.seeds[self.layout.rows[lane]], self.hub.incarnation(lane))


@dataclass(frozen=True)
class WaitSettings:
    """How `recv` waits."""

    min_envs: int
    timeout_s: float
    on_worker_loss: Literal["truncate", "raise"]


class SendRecv:
    """The lanes that were sent an order, until `recv` has returned them."""

    def __init__(self, parts: VectorEnvParts) -> None:
        self._parts = parts
        self._sent = SentLanes()
        self._watched = WatchedTime(parts.hub.now())

    def copies(self) -> list[int]:
        """The copies that have not come back."""
        return self._sent.copies()

    # ---------------------------------------------------------------- out

    def reset(self, copies: Sequence[int], seeds: Sequence[int | None], options: dict[str, Any] | None) -> None:
        """Begin episodes in these copies, with a seed for each. Raises `TypeError` for options that are no plain data."""
        parts, layout, hub = self._parts, self._parts.layout, self._parts.hub
        layout.check(copies)
        options_bytes = packed(options)
        by_lane = layout.by_lane(copies)
        self._check_back(by_lane)
        parts.check_reset(by_lane)
        seed_of = dict(zip(copies, seeds, strict=True))
        whole = [lane for lane, chosen in by_lane.items() if len(chosen) == layout.size(lane)]
        if len(whole) == len(layout.lanes):
            hub.rebalance()
        parts.lost_lanes.add(hub.take_lost())
        parts.lost_lanes.forget(whole)
        now = self._watched.look(parts.hub.now())
        for lane, chosen in by_lane.items():
            mine = sorted(chosen)
            numbers = tuple(layout.copies(lane)[n] for n in mine)
            for n in numbers:
                parts.seeds[n] = seed_of[n] if seed_of[n] is not None else parts.seeds[n]
            reset = AskedReset(tuple(mine), tuple(seed_of[n] for n in numbers), options_bytes)
            self._sent.send(lane, Sent(numbers, now, reset))
            self._send_reset(lane, reset)

    def send(self, actions: Any, copies: Sequence[int], on_worker_loss: Literal["truncate", "raise"]) -> None:
        """Step these copies, which are all copies of some lanes, with one action each, in the order of `copies`."""
        parts, lost_lanes = self._parts, self._parts.lost_lanes
        positions = parts.layout.positions(copies)
        self._check_back(positions)
        arrays, fit = parts.read_actions(actions, len(copies))
        if never := [n for n in copies if not parts.ever_reset[n]]:
            raise UsageError(f"send before reset of copies {never}: call reset(), or async_reset() and recv(), first")
        lost_lanes.add(parts.hub.take_lost())
        if ended := parts.ended_copies(copies):
            raise UsageError(
                f"copies {ended} have ended: autoreset_mode is Disabled, expected async_reset({ended}) before the next send"
            )
        awaiting_reset = [lane for lane in positions if lane in lost_lanes.awaiting_reset]
        if awaiting_reset and on_worker_loss == "raise":
            again = [n for lane in awaiting_reset for n in parts.layout.copies(lane)]
            raise WorkerLost(f"lanes {awaiting_reset} were lost with their worker; call async_reset({again}) first")
        now = self._watched.look(parts.hub.now())
        for lane, at in positions.items():
            self._sent.send(lane, Sent(tuple(parts.layout.copies(lane)), now))
            if lane not in lost_lanes.unreported:  # else `recv` reports the loss
                self._send_step(lane, [array[at] for array in arrays], fit)

    def _send_step(self, lane: int, actions: list[Array], fit: bool) -> None:
        parts, hub, rows = self._parts, self._parts.hub, self._parts.layout.rows[lane]
        if lane in parts.lost_lanes.awaiting_reset:  # as NEXT_STEP: the step after a truncation resets
            self._send_reset(lane, self._reset_of_new_copies(lane))
        elif fit and parts.memory is not None and hub.uses_shared_memory(lane):
            for array, values in zip(parts.memory.actions, actions, strict=True):
                array[rows] = values
            hub.begin_shared_step(lane)
        else:
            hub.send_order(lane, step_order(actions))

    def _send_reset(self, lane: int, reset: AskedReset) -> None:
        self._parts.hub.send_order(lane, reset_order(reset.copies, reset.seeds, reset.options))

    def _reset_of_new_copies(self, lane: int) -> AskedReset:
        return AskedReset(tuple(range(self._parts.layout.size(lane))), self._parts.replacement_seeds(lane), NO_OPTIONS)

    def _check_back(self, lanes: Iterable[int]) -> None:
        if out := self._sent.among(lanes):
            copies = [n for lane in out for n in self._parts.layout.copies(lane)]
            raise AlreadyPendingCallError(
                f"copies {copies} have not come back: expected recv() to return them first", "send"
            )

    # ---------------------------------------------------------------- in

    def recv(self, wait: WaitSettings) -> Sequence[ReadyLane]:
        """Wait until enough copies are ready, and take the lanes that are.

        Raises `EnvironmentFailed`, `WorkerLost` and `NoWorkers`; then lanes that are ready stay so for the next call.
        """
        sent, hub = self._sent, self._parts.hub
        if not (out := sent.copies()):
            raise NoAsyncCallError("recv without send before it", "send")
        if not 0 <= wait.min_envs <= len(out):
            raise ValueError(f"min_envs: expected 0 to {len(out)}, the copies that have not come back; got {wait.min_envs}")
        hub.listen_if_due()
        while True:
            self._look(wait)
            if sent.ready_copies >= wait.min_envs:
                return sent.take()
            hub.wait_for_any(wait.timeout_s)

    def _look(self, wait: WaitSettings) -> None:
        """Note what has happened to the lanes that are under way."""
        parts, sent, hub = self._parts, self._sent, self._parts.hub
        for lane in list(sent.under_way):
            if (result := hub.take_result(lane)) is not None:
                self._keep(lane, result)
        hub.raise_failures()
        now = self._watched.look(parts.hub.now())
        for lane in sent.overdue(now, wait.timeout_s):
            try:
                hub.give_up(lane, wait.timeout_s)
            except NoWorkers:
                sent.start_again(now)
                raise
        parts.lost_lanes.add(hub.take_lost())
        lost = {lane: why for lane, why in parts.lost_lanes.unreported.items() if lane in sent.under_way}
        self._handle_losses({lane: why for lane, why in lost.items() if not hub.is_ordered(lane)}, wait, now)

    def _keep(self, lane: int, result: Answer | bytes) -> None:
        """Keep the results of a lane for `recv`."""
        parts, reset = self._parts, self._sent.under_way[lane].reset
        if not isinstance(result, bytes):
            assert isinstance(result, Stepped)
            parts.batch.store(lane, result)
            result = bytes(result.infos.data)
            parts.lost_lanes.answered({lane})
        if reset is not None:
            parts.ever_reset[list(self._sent.under_way[lane].copies)] = True
        self._sent.ready(lane, result)

    def _handle_losses(self, lost: dict[int, str], wait: WaitSettings, now: float) -> None:
        """Lanes that are under way were lost, for these reasons. Raises `WorkerLost`."""
        parts, sent = self._parts, self._sent
        next_steps = {lane: after_loss(sent.under_way[lane], parts.autoreset, wait.on_worker_loss) for lane in lost}
        for lane in lost:
            copies, reset = parts.layout.copies(lane), sent.under_way[lane].reset
            match next_steps[lane]:
                case AfterLoss.RAISE:
                    pass
                case AfterLoss.RESET_AGAIN:
                    assert reset is not None
                    if len(reset.copies) == len(copies):
                        parts.lost_lanes.forget([lane])  # else the next step reports the copies that were not reset
                    sent.reset_instead(lane, reset, now, {})
                    self._send_reset(lane, reset)
                case AfterLoss.RESET_NEW_COPIES:
                    self._warn(lane, parts.lost_lanes.report([lane])[lane])
                    new = self._reset_of_new_copies(lane)
                    sent.reset_instead(lane, new, now, {n: parts.batch.observation_of(n) for n in copies})
                    self._send_reset(lane, new)
                case AfterLoss.COME_BACK:
                    self._warn(lane, parts.lost_lanes.report([lane])[lane])
                    parts.batch.truncate(lane)
                    sent.ready_as_lost(lane)
        if raised := {lane: why for lane, why in lost.items() if next_steps[lane] is AfterLoss.RAISE}:
            parts.lost_lanes.report(list(raised))
            sent.drop(raised)
            raise worker_lost(raised, parts.layout)

    def _warn(self, lane: int, why: str) -> None:
        copies = self._parts.layout.copies(lane)
        log.warning("%s; its lane %d comes back truncated (copies %d to %d)", why, lane, copies[0], copies[-1])


NO_OPTIONS: Bytes = packed(None)


def numbered(env_ids: Any, num_envs: int) -> list[int]:
    """The copies that `env_ids` names; None names all. Raises `TypeError` for what are not whole numbers."""
    if env_ids is None:
        return list(range(num_envs))
    array = np.asarray(env_ids)
    if array.ndim != 1 or (array.size and array.dtype.kind not in "iu"):
        raise TypeError(f"env_ids: expected a list of whole numbers, got {array.dtype}{list(array.shape)}")
    return [int(n) for n in array]
