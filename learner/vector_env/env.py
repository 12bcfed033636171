"""A `gymnasium.vector.VectorEnv` whose env copies live in worker processes, on this machine or on others.

Rule: the results are, bit for bit, those of `gymnasium.vector.SyncVectorEnv` for the same seeds and actions, whichever
way they travel. A lost worker is always reported, as truncated copies or as an error; it is never hidden.
"""

from __future__ import annotations

import logging
import os
import weakref
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, Literal

import numpy as np
from gymnasium.error import AlreadyPendingCallError, ClosedEnvironmentError, NoAsyncCallError
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from learner.vector_env.arguments import action_arrays, seed_list, take_reset_mask
from learner.vector_env.batch_arrays import BatchArrays
from learner.vector_env.batch_layout import BatchLayout
from learner.vector_env.calls import assign_orders, call_orders, call_results
from learner.vector_env.infos import Infos, unpack_infos
from learner.vector_env.lane_orders import packed, reset_order, step_order
from learner.vector_env.lost_lanes import RESET_ATTEMPTS, UNKNOWN_REASON, LostLanes, replacement_seeds, worker_lost
from learner.vector_env.order_coordinator import MakeOrder
from learner.vector_env.spec import VectorEnvDescription
from learner.vector_env.step_hub import StepHub
from protocol.arrays import Array
from protocol.envs.spaces import make_flatten
from protocol.errors import BadMessage, UsageError, WorkerLost
from protocol.messages import Answer, Stepped
from protocol.wire.plain_values import repr_paths
from protocol.wire.shared_memory import SharedMemory

log = logging.getLogger("millrace.learner")

StepResult = tuple[Any, Array, Array, Array, Infos]


class ZmqVectorEnv(VectorEnv[Any, Any, Array]):
    """Env copies in worker processes that are stepped together. `millrace.make_vec` makes it."""

    def __init__(
        self,
        description: VectorEnvDescription,
        hub: StepHub,
        *,
        memory: SharedMemory | None = None,
        timeout_s: float = 60.0,
        on_worker_loss: Literal["truncate", "raise"] = "truncate",
        copy: bool = True,
        on_close: Callable[[], None] = lambda: None,
    ) -> None:
        """`memory` is shared with local workers. `timeout_s`: how long a worker may take to answer.

        `on_close` is called once: by `close`, when this object is garbage collected, or when the interpreter exits.
        """
        if on_worker_loss not in ("truncate", "raise"):
            raise UsageError(f"on_worker_loss: expected 'truncate' or 'raise', got {on_worker_loss!r}")
        step = description.step
        self.num_envs = N = len(step.copies)
        self.metadata = description.metadata
        self.autoreset_mode = AutoresetMode(step.autoreset)  # as SyncVectorEnv has it; TorchRL reads it
        self.render_mode = description.render_mode
        self.spec = description.spec
        self.single_observation_space = description.observation_space
        self.single_action_space = description.action_space
        self.observation_space = batch_space(self.single_observation_space, N)
        self.action_space = batch_space(self.single_action_space, N)
        self.timeout_s, self.on_worker_loss, self.copy = timeout_s, on_worker_loss, copy
        self._described = {
            "spec": self.spec,
            "observation_space": self.single_observation_space,
            "action_space": self.single_action_space,
        }
        """attributes of every copy that are no plain data"""
        self._hub, self._memory = hub, memory
        self._autoreset, self._action_leaves = step.autoreset, step.action
        self._read_actions = make_flatten(self.single_action_space)
        self._layout = BatchLayout(step.lanes)
        self._batch = BatchArrays(step, self._layout, self.single_observation_space, memory)
        self._lost_lanes = LostLanes()
        self._pending: Literal["", "step"] = ""
        self._asked: Sequence[int] = ()  # lanes that the last step was asked of
        self._stepping: Sequence[int] = ()  # lanes that the pending step was ordered of: those that are not lost
        self._ever_reset, self._all_were_reset = np.zeros(N, bool), False
        self._seeds: list[int | None] = [None] * N  # of each copy's last seeded reset
        self._warned_infos: set[str] = set()  # keys of infos that arrived as their repr
        self._close_once = weakref.finalize(self, _call_in_process, os.getpid(), on_close)

    # ---------------------------------------------------------------- reset

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, Infos]:
        """Begin episodes in all copies, or in those that `options["reset_mask"]` selects. Returns observations and infos.

        A single seed s gives the copies s, s + 1, …. Raises `WorkerLost` if each attempt loses a worker.
        """
        self._check_idle("reset")
        seeds = seed_list(seed, self.num_envs)
        mask, options = take_reset_mask(options, self.num_envs)
        self._seeds = [new if new is not None else old for new, old in zip(seeds, self._seeds, strict=True)]
        if mask.all():
            self._hub.rebalance()
            self._lost_lanes.forget_unreported()
            self._hub.take_lost()
        infos = self._reset_copies(self._layout.by_lane(np.flatnonzero(mask).tolist()), seeds, options)
        self._ever_reset |= mask
        self._all_were_reset = bool(self._ever_reset.all())
        return self._batch.observation(copy=self.copy), self._merge_infos(infos)

    def _reset_copies(
        self, copies: Mapping[int, list[int]], seeds: Sequence[int | None], options: dict[str, Any] | None
    ) -> dict[int, bytes]:
        """Begin episodes in these copies of these lanes, and again wherever a worker is lost. Packed infos by lane."""
        packed_options = packed(options)
        infos: dict[int, bytes] = {}
        waiting = dict(copies)
        for attempt in range(RESET_ATTEMPTS):
            orders = {}
            for lane, chosen in waiting.items():
                lane_seeds = seeds[self._layout.rows[lane]]
                orders[lane] = reset_order(chosen, [lane_seeds[n] for n in chosen], packed_options)
            self._hub.send_orders(orders)
            answers = self._hub.wait_for_answers(self.timeout_s)
            infos |= self._store(answers)
            waiting = {lane: chosen for lane, chosen in waiting.items() if lane not in answers}
            lost = self._hub.take_lost()
            self._lost_lanes.add(
                {lane: why for lane, why in lost.items() if lane not in waiting and not self._hub.is_started(lane)}
            )
            if not waiting:
                return infos
            if self.on_worker_loss == "raise" or attempt == RESET_ATTEMPTS - 1:
                self._lost_lanes.expect_reset(waiting)
                raise worker_lost(lost, self._layout)
        return infos

    # ---------------------------------------------------------------- step

    def step(self, actions: Any) -> StepResult:
        """Step every copy. Returns observations, rewards, terminated, truncated and infos."""
        self.step_async(actions)
        return self.step_wait()

    def step_lanes(self, lanes: Sequence[int], actions: Any) -> StepResult:
        """Step the copies of these lanes only. Actions and results have a row for every copy, which other copies ignore."""
        self._order_step(lanes, actions)
        return self.step_wait()

    def step_async(self, actions: Any) -> None:
        """Order every copy to step; `step_wait` returns the results."""
        self._order_step(self._layout.lanes, actions)

    def _order_step(self, lanes: Sequence[int], actions: Any) -> None:
        self._check_idle("step_async")
        arrays, fit = action_arrays(actions, self._read_actions, self._action_leaves, self.num_envs)
        if not self._all_were_reset and (never := [n for n in self._copies_of(lanes) if not self._ever_reset[n]]):
            raise UsageError(f"step before reset of copies {never}: call reset() first")
        if self._autoreset == "Disabled" and (ended := self._batch.terminated | self._batch.truncated).any():
            raise UsageError(
                f"copies {np.flatnonzero(ended).tolist()} have ended: autoreset_mode is Disabled, expected "
                "reset(options={'reset_mask': ended}) before the next step"
            )
        self._lost_lanes.add(self._hub.take_lost())
        awaiting_reset, lost = self._lost_lanes.awaiting_reset, self._lost_lanes.unreported
        if awaiting_reset and self.on_worker_loss == "raise":
            raise WorkerLost(f"lanes {sorted(awaiting_reset)} were lost with their worker; call reset() first")
        self._asked = lanes
        self._stepping = [lane for lane in lanes if lane not in lost]
        self._pending = "step"
        if (
            fit
            and self._memory is not None
            and not awaiting_reset
            and all(map(self._hub.uses_shared_memory, self._stepping))
        ):
            for array, leaf in zip(self._memory.actions, arrays, strict=True):
                array[:] = leaf
            self._hub.step_shared(self._stepping)
        else:
            self._hub.send_orders({lane: self._step_order(lane, arrays) for lane in self._stepping})

    def step_wait(self, timeout: float | None = None) -> StepResult:
        """Wait for the pending step. A worker that does not answer within `timeout` seconds is given up.

        `timeout` is `timeout_s` by default.
        """
        if self.closed:
            raise ClosedEnvironmentError("step_wait after close()")
        if self._pending != "step":
            raise NoAsyncCallError("step_wait without step_async before it", "step")
        hub, timeout_s = self._hub, self.timeout_s if timeout is None else timeout
        try:
            answers = hub.wait_for_answers(timeout_s)
        except Exception:
            self._pending = ""
            self._lost_lanes.expect_reset(hub.take_lost())
            raise
        self._pending = ""
        infos = self._store(answers)
        if hub.stepped:
            infos |= {lane: hub.infos(lane, timeout_s) for lane in sorted(hub.stepped)}
        if any(lane in self._asked for lane in self._lost_lanes.unreported) or len(answers) + len(hub.stepped) < len(
            self._stepping
        ):
            return self._step_result_with_losses(infos, {*answers, *hub.stepped})
        batch = self._batch
        return (
            batch.observation(copy=self.copy),
            batch.reward.copy(),
            batch.terminated.copy(),
            batch.truncated.copy(),
            self._merge_infos(infos),
        )

    def _copies_of(self, lanes: Sequence[int]) -> list[int]:
        return [n for lane in lanes for n in self._layout.copies(lane)]

    def _step_order(self, lane: int, actions: Sequence[Array]) -> MakeOrder:
        rows = self._layout.rows[lane]
        if lane in self._lost_lanes.awaiting_reset:  # as NEXT_STEP: the step after a truncation resets
            seeds = replacement_seeds(self._seeds[rows], self._hub.incarnation(lane))
            return reset_order(range(len(seeds)), seeds, packed(None))
        return step_order([array[rows] for array in actions])

    def _step_result_with_losses(self, infos: dict[int, bytes], answered: set[int]) -> StepResult:
        """The result of a step that some lanes did not answer: their copies are truncated at their newest observation."""
        batch, layout = self._batch, self._layout
        self._lost_lanes.add(self._hub.take_lost())
        lost = self._lost_lanes.report([lane for lane in self._asked if lane not in answered])
        if self.on_worker_loss == "raise":
            raise worker_lost(lost, layout)
        for lane, why in lost.items():
            copies = layout.copies(lane)
            log.warning("%s; its lane %d comes back truncated (copies %d to %d)", why, lane, copies[0], copies[-1])
            batch.truncate(lane)
        results = batch.reward.copy(), batch.terminated.copy(), batch.truncated.copy()
        loss_infos: dict[int, Infos] = {n: {"worker_lost": True} for lane in lost for n in layout.copies(lane)}
        if self._autoreset == "SameStep":
            for n, info in loss_infos.items():
                info |= {"final_obs": batch.observation_of(n), "final_info": {"worker_lost": True}}
            infos |= self._reset_copies(
                {lane: list(range(layout.size(lane))) for lane in lost}, self._replacement_seeds(lost), None
            )
        return batch.observation(copy=self.copy), *results, self._merge_infos(infos, loss_infos)

    def _replacement_seeds(self, lost: Iterable[int]) -> list[int | None]:
        """The seeds of all copies, with new ones for the copies of lost lanes."""
        seeds = list(self._seeds)
        for lane in lost:
            rows = self._layout.rows[lane]
            seeds[rows] = replacement_seeds(seeds[rows], self._hub.incarnation(lane))
        return seeds

    # ---------------------------------------------------------------- calls

    def call(self, name: str, *args: Any, **kwargs: Any) -> tuple[Any, ...]:
        """Call a method of every copy, or get an attribute. Arguments and results must be plain data.

        `spec`, `observation_space` and `action_space` are as a worker described them, for such objects cannot travel.
        """
        return self.call_some(range(self.num_envs), name, *args, **kwargs)

    def call_some(self, copies: Sequence[int], name: str, /, *args: Any, **kwargs: Any) -> tuple[Any, ...]:
        """As `call`, for some copies. The results are in ascending order of the copies."""
        if name in self._described:
            return (self._described[name],) * len(copies)
        self._check_idle("call")
        return self._results_of_call(name, call_orders(self._layout, copies, name, args, kwargs))

    def get_attr(self, name: str) -> tuple[Any, ...]:
        """An attribute of every copy; see `call`."""
        return self.call(name)

    def set_attr(self, name: str, values: Any) -> None:
        """Set an attribute. A list or tuple has one value for each copy; any other value goes to all copies."""
        if not isinstance(values, list | tuple):
            values = [values] * self.num_envs
        if len(values) != self.num_envs:
            raise ValueError(f"values: expected one for each of {self.num_envs} copies, got {len(values)}")
        self.assign_some(range(self.num_envs), name, values)

    def assign_some(self, copies: Sequence[int], name: str, values: Sequence[Any]) -> None:
        """Set an attribute of some copies, in ascending order, to one value each."""
        self._check_idle("call")
        self._results_of_call(name, assign_orders(self._layout, copies, name, values))

    def render(self) -> tuple[Any, ...]:
        """What `render` of every copy returns."""
        return self.call("render")

    @property
    def np_random_seed(self) -> tuple[int, ...]:  # type: ignore[override]
        """The seed of each copy's random generator, as `SyncVectorEnv` shows it."""
        return self.get_attr("np_random_seed")

    def _results_of_call(self, name: str, orders: Mapping[int, MakeOrder]) -> tuple[Any, ...]:
        self._hub.send_orders(orders)
        answers = self._hub.wait_for_answers(self.timeout_s)
        if unanswered := [lane for lane in orders if lane not in answers]:
            lost = self._hub.take_lost()
            self._lost_lanes.add(lost)
            raise worker_lost({lane: lost.get(lane, UNKNOWN_REASON) for lane in unanswered}, self._layout)
        return call_results(name, answers)

    # ---------------------------------------------------------------- workers

    @property
    def address(self) -> str:
        """The address that workers connect to."""
        return self._hub.address

    @property
    def workers(self) -> int:
        """Number of workers that have joined."""
        return self._hub.worker_count

    def wait_for(self, workers: int, timeout_s: float) -> None:
        """Wait until this many workers have joined. Raises `NoWorkers`."""
        self._hub.wait_for(workers, timeout_s)

    def watch(self, callback: Callable[[], None]) -> None:
        """Set what is called regularly during each wait. An exception that it raises ends the wait."""
        self._hub.call_while_waiting(callback)

    # ---------------------------------------------------------------- close

    def close_extras(self, **kwargs: Any) -> None:
        """Ask the workers to leave, and end the local ones. Never hangs."""
        self._close_once()

    def __enter__(self) -> ZmqVectorEnv:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    # ---------------------------------------------------------------- inside

    def _check_idle(self, doing: str) -> None:
        if self.closed:
            raise ClosedEnvironmentError(f"{doing} after close()")
        if self._pending:
            raise AlreadyPendingCallError(f"{doing} while a step is pending: expected step_wait() first", self._pending)

    def _store(self, answers: Mapping[int, Answer]) -> dict[int, bytes]:
        """Write results that came as messages to the batch. Packed infos by lane."""
        infos = {}
        for lane, answer in answers.items():
            if isinstance(answer, Stepped) and answer.ticket > 0:
                self._batch.store(lane, answer)
                infos[lane] = bytes(answer.infos.data)
        self._lost_lanes.answered(answers.keys())
        return infos

    def _merge_infos(self, packed_infos: Mapping[int, bytes], loss_infos: Mapping[int, Infos] | None = None) -> Infos:
        """Infos of all copies as gymnasium merges them, in the order of the copies."""
        by_copy: dict[int, Infos] = dict(loss_infos or {})
        for lane, data in packed_infos.items():
            if not data:
                continue
            try:
                for n, info in unpack_infos(data, self._layout.copies(lane)).items():
                    by_copy[n] = by_copy.get(n, {}) | info
            except BadMessage as error:
                self._hub.refuse_owner(lane, f"lane {lane}: infos cannot be read: {error}")
        infos: Infos = {}
        for n in sorted(by_copy):
            infos = self._add_info(infos, by_copy[n], n)
            for key in repr_paths(by_copy[n]):
                if key not in self._warned_infos:
                    self._warned_infos.add(key)
                    log.warning("info %s of copy %d is no plain data: it arrives as its repr, a string", key, n)
        return infos


def _call_in_process(pid: int, function: Callable[[], None]) -> None:
    """Call `function` only in process `pid`: a forked child inherits this object, but does not own the workers."""
    if os.getpid() == pid:
        function()
