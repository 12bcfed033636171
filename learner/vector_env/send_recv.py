"""Sends every step, reset and call of a vector environment to its lanes, and collects the results.

Rule: for the same seeds and actions, each lane gives the same rows, whether or not the caller waits for all lanes together,
and whether steps are sent as messages or through shared memory. A lost worker is reported once, as truncated copies or as an
error, and no other lane loses its results.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, Literal

import numpy as np
from gymnasium.error import AlreadyPendingCallError, NoAsyncCallError

from millrace.learner.vector_env.batch_arrays import BatchArrays
from millrace.learner.vector_env.batch_layout import BatchLayout
from millrace.learner.vector_env.lane_orders import packed, packed_each, step_order
from millrace.learner.vector_env.lost_lanes import LostLanes, replacement_seeds, worker_lost
from millrace.learner.vector_env.order_coordinator import MakeOrder
from millrace.learner.vector_env.sent_lanes import (
    AfterLoss,
    Asked,
    AskedReset,
    Ready,
    Sent,
    SentLanes,
    WatchedTime,
    after_loss,
)
from millrace.learner.vector_env.step_arguments import Options
from millrace.learner.vector_env.step_hub import StepHub
from millrace.protocol.arrays import Array
from millrace.protocol.errors import NoWorkers, UsageError, WorkerLost
from millrace.protocol.messages import Stepped

log = logging.getLogger("millrace.learner")


class SendRecv:
    """Sends orders to lanes and receives their results. It keeps track of the lanes that have not come back."""

    def __init__(
        self,
        hub: StepHub,
        layout: BatchLayout,
        batch: BatchArrays,
        *,
        autoreset: Literal["NextStep", "SameStep", "Disabled"],
        on_worker_loss: Literal["truncate", "raise"] = "truncate",
        timeout_s: float,
    ) -> None:
        """`timeout_s` is how many seconds a worker may take, unless a call gives another time."""
        self.timeout_s = timeout_s
        self._hub = hub
        self._layout = layout
        self._batch = batch
        self._autoreset = autoreset
        self._on_worker_loss = on_worker_loss
        self._sent = SentLanes(layout)
        self._lost_lanes = LostLanes()
        self._seeds: list[int | None] = [None] * layout.count  # the seed of each copy's last reset with a seed
        self._ever_reset = np.zeros(layout.count, bool)  # for each copy, whether it has been reset at least once
        self._all_were_reset = False
        self._reset_lanes: dict[int, int] = {}  # ready lanes of which all copies were reset, and the copies' incarnation
        self._to_raise: dict[int, str] = {}  # lanes whose loss the caller gets as an error, and why they were lost
        self._watched = WatchedTime(hub.now())

    def copies(self) -> list[int]:
        """The copies that have not come back."""
        return self._sent.copies

    def begin_anew(self) -> None:
        """Forget everything that was sent, after a call that was cut short. All copies must be reset next."""
        self._hub.begin_anew()
        self._sent = SentLanes(self._layout)
        self._to_raise = {}
        self._reset_lanes = {}

    # ---------------------------------------------------------------- out

    def reset(self, copies: Sequence[int], seeds: Sequence[int | None], options: Options) -> None:
        """Begin episodes in these copies. `seeds`, and `options` if it is a list, have an entry for every copy.

        Raises `TypeError` for options that aren't plain data. With SameStep, raises `UsageError` if `copies` has only some
        copies of a lane that was lost, because no step would reset the others.
        """
        self._layout.check(copies)
        by_lane = self._layout.by_lane(sorted(copies))
        self.check_back(by_lane)
        self._check_whole(by_lane)
        resets = {lane: self._asked_reset(lane, chosen, seeds, options) for lane, chosen in by_lane.items()}
        for n in copies:
            self._seeds[n] = seeds[n] if seeds[n] is not None else self._seeds[n]
        if len(copies) == self._layout.count:
            self._hub.listen()  # a loss that is noticed now needs no report, because the copies are reset
        self._lost_lanes.add(self._hub.coordinator.take_lost())
        now = self._watched.look(self._hub.now())
        try:
            for lane, reset in resets.items():
                self._sent.send([lane], Sent(reset, now))
                self._hub.send_order(lane, reset.order())
        except Exception:
            self.abandon(list(resets))
            raise

    def step(
        self,
        lanes: Sequence[int],
        actions: tuple[list[Array], bool],
        at: Mapping[int, Any] | Sequence[Any],
        *,
        together: bool,
    ) -> None:
        """Step these lanes.

        `actions` is a pair: the arrays of actions, and whether shared memory can hold them without rounding. `at[lane]`
        selects a lane's rows in these arrays. `together` says that `recv_all` will take the results.

        Raises `UsageError` for copies that must be reset first, and, with `on_worker_loss="raise"`, `WorkerLost` for copies
        that were lost. If it raises one of these, nothing is sent.
        """
        self.check_back(lanes)
        self._lost_lanes.add(self._hub.coordinator.take_lost())
        self._check_steppable(lanes)
        now = self._watched.look(self._hub.now())
        try:
            self._sent.send(lanes, Sent(Asked.STEP, now))
            self._order_steps(lanes, actions, at, together=together)
        except Exception:
            self.abandon(lanes)
            raise

    def call(self, orders: Mapping[int, MakeOrder]) -> None:
        """Send each of these lanes, which have come back, its own order. The copies continue their episodes."""
        now = self._watched.look(self._hub.now())
        self._sent.send(orders, Sent(Asked.CALL, now))
        for lane, make in orders.items():
            self._hub.send_order(lane, make)

    def check_back(self, lanes: Iterable[int]) -> None:
        """Raise `AlreadyPendingCallError` if one of these lanes has not come back."""
        if out := self._sent.among(lanes):
            copies = self._layout.copies_of(out)
            raise AlreadyPendingCallError(
                f"copies {copies} have not come back: expected recv() to return them first", "send"
            )

    # ---------------------------------------------------------------- in

    def recv(self, min_envs: int, timeout_s: float | None = None) -> tuple[Ready, list[int]]:
        """Wait until at least `min_envs` copies are ready. Returns the ready lanes, and the numbers of their copies.

        May raise `EnvironmentFailed`, `WorkerLost` or `NoWorkers`. Even then, the next call can take the lanes that are
        ready.
        """
        sent = self._sent
        if not (out := sent.copies):
            raise NoAsyncCallError("recv without send before it", "send")
        if not 0 <= min_envs <= len(out):
            raise ValueError(f"min_envs: expected 0 to {len(out)}, the copies that have not come back; got {min_envs}")
        timeout_s = self.timeout_s if timeout_s is None else timeout_s
        self._hub.listen_if_due()
        while True:
            self.look(timeout_s)
            self._raise_losses()
            if len(copies := sent.ready_copies) >= min_envs:
                return self._returned(sent.take()), copies
            self._hub.wait(timeout_s, together=False)

    def recv_all(self, timeout_s: float | None = None) -> Ready:
        """Wait until every lane is ready, and take them. Raises what `recv` raises, after giving up on all lanes."""
        sent = self._sent
        timeout_s = self.timeout_s if timeout_s is None else timeout_s
        look_first = bool(self._lost_lanes.unreported)
        self._wait_until(lambda: sent.all_ready, timeout_s, self._layout.lanes, look_first=look_first, together=True)
        return self._returned(sent.take())

    def recv_some(self, lanes: Sequence[int]) -> Ready:
        """Wait until these lanes are ready, and take them. Raises what `recv` raises, after giving up on these lanes only.

        Raises `NoAsyncCallError` for lanes that were sent nothing, or that were given up afterwards.
        """
        sent = self._sent
        if idle := [lane for lane in lanes if lane not in sent.sent]:
            raise NoAsyncCallError(f"lanes {idle} are not under way: expected an order to them first", "send")
        # Look first: a result may have arrived during a wait for other lanes, and then no worker wakes this process again.
        self._wait_until(lambda: sent.are_ready(lanes), self.timeout_s, lanes, look_first=True, together=False)
        return self._returned(sent.take_some(lanes))

    def look(self, timeout_s: float) -> None:
        """Record which of the lanes under way have returned a result or were lost. Never waits.

        Raises `EnvironmentFailed` if an environment has failed, and `NoWorkers` if a lane has had no worker for
        `timeout_s`.
        """
        self._take_results()
        self._hub.raise_failure()
        if not self._sent.all_ready:
            self._give_up_late(timeout_s)
            self._handle_losses()

    def abandon(self, lanes: Sequence[int]) -> None:
        """Stop waiting for these lanes. Those whose step was under way count as reported if they were lost meanwhile.

        If a lane was lost before its reset, the next step reports the loss, because the caller gets no results of the reset.
        """
        sent = self._sent
        steps = [lane for lane in sent.under_way if lane in lanes and sent.sent[lane].asked is Asked.STEP]
        for lane in lanes:
            self._to_raise.pop(lane, None)
            self._reset_lanes.pop(lane, None)
        self._hub.forget(sent.give_up(lanes))
        self._lost_lanes.add(self._hub.coordinator.take_lost())
        self._lost_lanes.report([lane for lane in steps if lane in self._lost_lanes.unreported])

    # ---------------------------------------------------------------- inside

    def _order_steps(
        self,
        lanes: Sequence[int],
        actions: tuple[list[Array], bool],
        at: Mapping[int, Any] | Sequence[Any],
        *,
        together: bool,
    ) -> None:
        """Order these lanes to step; see `step`."""
        (arrays, fit) = actions
        shared = []
        unreported = self._lost_lanes.unreported
        awaiting_reset = self._lost_lanes.awaiting_reset
        for lane in lanes:
            if lane in unreported:
                continue  # this step reports the loss in place of a result
            if lane in awaiting_reset:  # as in NextStep mode, the step after a truncation resets
                self._hub.send_order(lane, self._reset_of_new_copies(lane).order())
            elif fit and self._hub.can_share(lane):
                shared.append(lane)
            else:
                self._hub.send_order(lane, step_order([array[at[lane]] for array in arrays]))
        if shared:
            assert self._hub.shared is not None
            for memory, values in zip(self._hub.shared.memory.actions, arrays, strict=True):
                if at is self._layout.rows and len(shared) == len(at):
                    memory[:] = values
                    continue
                for lane in shared:
                    memory[self._layout.rows[lane]] = values[at[lane]]
            self._hub.send_steps(shared, together=together)

    def _wait_until(
        self, ready: Callable[[], bool], timeout_s: float, lanes: Sequence[int], *, look_first: bool, together: bool
    ) -> None:
        """Wait until these lanes are `ready`. Raises what `recv` raises, after giving up on them."""
        try:
            if look_first:
                self.look(timeout_s)
            while not ready():
                self._hub.wait(timeout_s, together=together)
                self.look(timeout_s)
            self._raise_losses()
        except Exception:
            self.abandon(lanes)
            raise

    def _check_whole(self, copies: Mapping[int, Sequence[int]]) -> None:
        for lane in self._lost_lanes.awaiting_reset & copies.keys() if self._autoreset == "SameStep" else ():
            if len(copies[lane]) < self._layout.size(lane):
                of_lane = self._layout.copies(lane)
                raise UsageError(
                    f"reset of copies {[of_lane[n] for n in copies[lane]]}: expected all copies of lane {lane} "
                    f"({of_lane[0]} to {of_lane[-1]}), which were lost with their worker; reset them together"
                )

    def _check_steppable(self, lanes: Sequence[int]) -> None:
        lost_lanes = self._lost_lanes
        if not self._all_were_reset:
            if never := [n for n in self._layout.copies_of(lanes) if not self._ever_reset[n]]:
                raise UsageError(f"step before reset of copies {never}: call reset(), or reset_async() and recv(), first")
            self._all_were_reset = bool(self._ever_reset.all())
        if self._autoreset == "Disabled":
            over = self._batch.over
            # Lanes with an unreported loss are left out, because the result of this step reports the loss.
            if ended := [
                n for n in self._layout.copies_of(lane for lane in lanes if lane not in lost_lanes.unreported) if over[n]
            ]:
                raise UsageError(
                    f"copies {ended} have ended: autoreset_mode is Disabled, expected reset_async(env_ids={ended}) or "
                    "reset(options={'reset_mask': ended}) before the next step"
                )
        awaiting = [lane for lane in lanes if lane in lost_lanes.awaiting_reset] if self._on_worker_loss == "raise" else ()
        if awaiting:
            copies = self._layout.copies_of(awaiting)
            raise WorkerLost(
                f"lanes {awaiting} were lost with their worker; call reset() or reset_async(env_ids={copies}) first"
            )

    def _replacement_seeds(self, lane: int) -> tuple[int | None, ...]:
        """Seeds for the copies that replace a lost lane's copies."""
        seeds = [self._seeds[n] for n in self._layout.copies(lane)]
        return replacement_seeds(seeds, self._hub.coordinator.lanes[lane].incarnation)

    def _reset_of_new_copies(self, lane: int) -> AskedReset:
        """The reset of the copies that replace a lost lane's copies."""
        return AskedReset(tuple(range(self._layout.size(lane))), self._replacement_seeds(lane), packed(None))

    def _asked_reset(self, lane: int, chosen: Sequence[int], seeds: Sequence[int | None], options: Options) -> AskedReset:
        copies = [self._layout.copies(lane)[n] for n in chosen]
        of_lane = packed_each([options[n] for n in copies]) if isinstance(options, list) else packed(options)
        return AskedReset(tuple(chosen), tuple(seeds[n] for n in copies), of_lane)

    def _reset_instead(self, lane: int, reset: AskedReset, last_observations: Mapping[int, Any]) -> None:
        """Reset the new copies of a lost lane before the lane comes back."""
        self._sent.reset_instead(lane, reset, self._watched.look(self._hub.now()), last_observations)
        self._hub.send_order(lane, reset.order())

    def _take_results(self) -> None:
        """Record which lanes are done."""
        came = self._hub.take()
        self._sent.ready({lane: self._stored(lane, one) if isinstance(one, Stepped) else one for lane, one in came.items()})

    def _stored(self, lane: int, answer: Stepped) -> bytes:
        """Write the results that arrived as a message to the batch. Returns the packed infos."""
        asked = self._sent.sent[lane].asked
        self._batch.store(lane, answer)
        self._lost_lanes.answered({lane})
        if isinstance(asked, AskedReset):
            self._ever_reset[[self._layout.copies(lane)[n] for n in asked.copies]] = True
            if len(asked.copies) == self._layout.size(lane):
                self._reset_lanes[lane] = answer.incarnation
        return bytes(answer.infos.data)

    def _returned(self, ready: Ready) -> Ready:
        """Forget the losses before a reset of all copies of a lane, because the caller gets the reset's results now."""
        for lane in self._reset_lanes.keys() & ready.results.keys():
            if self._reset_lanes.pop(lane) == self._hub.coordinator.lanes[lane].incarnation:  # not lost since
                self._lost_lanes.forget(lane)
        return ready

    def _give_up_late(self, timeout_s: float) -> None:
        """Treat workers that take too long as lost. Raises `NoWorkers` if a lane had no worker all that time."""
        now = self._watched.look(self._hub.now())
        for lane in self._sent.overdue(now, timeout_s):
            try:
                self._hub.give_up(lane, timeout_s)
            except NoWorkers:
                self._sent.start_again(now)
                raise

    def _handle_losses(self) -> None:
        """Handle the lanes that were lost while they were under way."""
        sent = self._sent
        self._lost_lanes.add(self._hub.coordinator.take_lost())
        unreported = self._lost_lanes.unreported
        under_way = sent.under_way if unreported else ()
        for lane in [lane for lane in unreported if lane in under_way and not self._hub.is_awaited(lane)]:
            copies = self._layout.copies(lane)
            asked = sent.sent[lane].asked
            match after_loss(sent.sent[lane], self._autoreset, self._on_worker_loss):
                case AfterLoss.RAISE:
                    self._to_raise[lane] = unreported[lane]
                    if asked is not Asked.CALL or self._on_worker_loss == "raise":
                        self._lost_lanes.report([lane])  # otherwise, the next step reports it
                    sent.drop(lane)
                case AfterLoss.RESET_AGAIN:
                    assert isinstance(asked, AskedReset)
                    self._reset_instead(lane, asked, {})
                case AfterLoss.RESET_NEW_COPIES:
                    self._warn(lane, self._lost_lanes.report([lane])[lane])
                    last = {row: self._batch.observation_of(row) for row in self._layout.rows_of(copies)}
                    self._reset_instead(lane, self._reset_of_new_copies(lane), last)
                case AfterLoss.COME_BACK:
                    self._warn(lane, self._lost_lanes.report([lane])[lane])
                    self._batch.truncate(lane)
                    sent.ready_as_lost(lane)

    def _raise_losses(self) -> None:
        if self._to_raise:
            lost = self._to_raise
            self._to_raise = {}
            raise worker_lost(lost, self._layout)

    def _warn(self, lane: int, why: str) -> None:
        copies = self._layout.copies(lane)
        log.warning("%s; its lane %d comes back truncated (copies %d to %d)", why, lane, copies[0], copies[-1])
