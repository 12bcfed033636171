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

from learner.members.events import Failed
from learner.members.membership import Member
from learner.vector_env.arguments import Options, action_arrays, seed_list, take_reset_mask
from learner.vector_env.batch_arrays import BatchArrays
from learner.vector_env.batch_layout import BatchLayout
from learner.vector_env.calls import assign_orders, call_orders, call_results, described_copies
from learner.vector_env.infos import Infos, OfSomeCopies, unpack_infos
from learner.vector_env.lane_orders import packed, reset_order, step_order
from learner.vector_env.lost_lanes import RESET_ATTEMPTS, UNKNOWN_REASON, LostLanes, worker_lost
from learner.vector_env.order_coordinator import MakeOrder
from learner.vector_env.send_recv import SendRecv, VectorEnvParts, WaitSettings, numbered
from learner.vector_env.spec import VectorEnvDescription
from learner.vector_env.step_hub import StepHub
from protocol.arrays import Array
from protocol.envs.description import DescribedEnv
from protocol.envs.spaces import make_flatten
from protocol.errors import BadMessage, EnvironmentFailed, NoWorkers, UsageError, WorkerLost
from protocol.messages import DESCRIPTION, Answer, Status, Stepped
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
        self.merge_infos = True
        """whether infos are returned, merged as gymnasium does it; otherwise only `infos_by_copy` has them"""
        self.infos_by_copy: dict[int, Infos] = {}
        """the newest infos that are not empty, as each copy returned them"""
        self._described = {
            "spec": self.spec,
            "observation_space": self.single_observation_space,
            "action_space": self.single_action_space,
        }
        """attributes of every copy that are no plain data"""
        self._hub, self._memory = hub, memory
        self._autoreset = step.autoreset
        read = make_flatten(self.single_action_space)
        self._layout = BatchLayout(step.lanes)
        self._batch = BatchArrays(step, self._layout, self.single_observation_space, memory)
        self._lost_lanes = LostLanes()
        self._pending: Literal["", "step"] = ""
        self._asked: Sequence[int] = ()  # lanes that the last step was asked of
        self._stepping: Sequence[int] = ()  # lanes that the pending step was ordered of: those that are not lost
        self._ever_reset, self._all_were_reset = np.zeros(N, bool), False
        self._seeds: list[int | None] = [None] * N  # of each copy's last seeded reset
        self._warned_infos: set[str] = set()  # keys of infos that arrived as their repr
        parts = VectorEnvParts(
            hub=hub,
            layout=self._layout,
            batch=self._batch,
            memory=memory,
            lost_lanes=self._lost_lanes,
            read_actions=lambda actions, count: action_arrays(actions, read, step.action, count),
            autoreset=step.autoreset,
            seeds=self._seeds,
            ever_reset=self._ever_reset,
        )
        self._parts, self._send_recv = parts, SendRecv(parts)
        self._close_once = weakref.finalize(self, _call_in_process, os.getpid(), on_close)

    # ---------------------------------------------------------------- reset

    def reset(self, *, seed: int | Sequence[int | None] | None = None, options: Options = None) -> tuple[Any, Infos]:
        """Begin episodes in all copies, or in those that `options["reset_mask"]` selects. Returns observations and infos.

        A single seed s gives the copies s, s + 1, …. A list of options has those of each copy. Raises `WorkerLost` if each
        attempt loses a worker. With SameStep, copies that were lost with their worker are reset together; raises
        `UsageError` for a part of them.
        """
        self._check_idle("reset")
        seeds = seed_list(seed, self.num_envs)
        mask, options = take_reset_mask(options, self.num_envs)
        copies = self._layout.by_lane(np.flatnonzero(mask).tolist())
        self._parts.check_reset(copies)
        self._seeds[:] = [new if new is not None else old for new, old in zip(seeds, self._seeds, strict=True)]
        if mask.all():
            self._hub.rebalance()
        self._lost_lanes.add(self._hub.take_lost())
        self._lost_lanes.forget(lane for lane, chosen in copies.items() if len(chosen) == self._layout.size(lane))
        infos = self._reset_copies(copies, seeds, options)
        self._ever_reset |= mask
        return self._batch.observation(copy=self.copy), self._merge_infos(infos)

    def _reset_copies(
        self, copies: Mapping[int, list[int]], seeds: Sequence[int | None], options: Options
    ) -> dict[int, bytes]:
        """Begin episodes in these copies of these lanes, and again wherever a worker is lost. Packed infos by lane."""
        infos: dict[int, bytes] = {}
        waiting = dict(copies)
        for attempt in range(RESET_ATTEMPTS):
            orders = {}
            for lane, chosen in waiting.items():
                rows = self._layout.rows[lane]
                lane_seeds = seeds[rows]
                lane_options = [options[rows][n] for n in chosen] if isinstance(options, list) else options
                orders[lane] = reset_order(chosen, [lane_seeds[n] for n in chosen], packed(lane_options))
            self._hub.send_orders(orders)
            answers = self._hub.wait_for_answers(self.timeout_s)
            infos |= self._store(answers)
            waiting = {lane: chosen for lane, chosen in waiting.items() if lane not in answers}
            lost = self._hub.take_lost()
            self._lost_lanes.add({lane: why for lane, why in lost.items() if self._is_to_report(lane, waiting)})
            if not waiting:
                return infos
            if self.on_worker_loss == "raise" or attempt == RESET_ATTEMPTS - 1:
                self._lost_lanes.expect_reset(waiting)
                raise worker_lost(lost, self._layout)
        return infos

    def _is_to_report(self, lane: int, waiting: Mapping[int, list[int]]) -> bool:
        """Whether the next step reports a lane that was lost during a reset: if copies were lost that are not reset."""
        if lane in waiting:
            return len(waiting[lane]) < self._layout.size(lane)
        return not self._hub.is_started(lane)

    # ---------------------------------------------------------------- step

    def step(self, actions: Any) -> StepResult:
        """Step every copy. Returns observations, rewards, terminated, truncated and infos.

        `actions` and observations have a row for each copy, as `action_space` and `observation_space`. Rewards are
        [num_envs] float64; terminated and truncated are [num_envs] bool; infos are a dict, as gymnasium merges them.

        Raises `UsageError` for copies that must be reset first, `TypeError` and `ValueError` for wrong actions,
        `EnvironmentFailed`, `NoWorkers`, and with `on_worker_loss="raise"` `WorkerLost`.
        """
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
        arrays, fit = self._parts.read_actions(actions, self.num_envs)
        if not self._all_were_reset:
            if never := [n for n in self._copies_of(lanes) if not self._ever_reset[n]]:
                raise UsageError(f"step before reset of copies {never}: call reset() first")
            self._all_were_reset = bool(self._ever_reset.all())
        self._lost_lanes.add(self._hub.take_lost())
        if ended := self._parts.ended_copies(range(self.num_envs)):
            raise UsageError(
                f"copies {ended} have ended: autoreset_mode is Disabled, expected reset(options={{'reset_mask': ended}}) "
                "before the next step"
            )
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
        """Wait for the pending step. Returns and raises what `step` does, and `NoAsyncCallError` if there is none.

        A worker that does not answer within `timeout` seconds (`timeout_s` by default) is given up.
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
            seeds = self._parts.replacement_seeds(lane)
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
            seeds[self._layout.rows[lane]] = self._parts.replacement_seeds(lane)
        return seeds

    # ---------------------------------------------------------------- lanes that do not wait for each other

    def async_reset(
        self,
        env_ids: Sequence[int] | Array | None = None,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> None:
        """Begin episodes in these copies, by default in all. `recv` returns their first observations, with reward 0.

        A single seed s gives copy n the seed s + n; a list has one for each of `env_ids`. Raises `AlreadyPendingCallError`
        if one of the copies, or another one of its lane, has not come back.
        """
        self._check_no_step("async_reset")
        copies = numbered(env_ids, self.num_envs)
        if isinstance(seed, int | np.integer):
            seed = [int(seed) + n for n in copies]
        self._send_recv.reset(copies, seed_list(seed, len(copies)), options)

    def send(self, actions: Any, env_ids: Sequence[int] | Array | None = None) -> None:
        """Step these copies, by default all, with one action each, in the order of `env_ids`; `recv` returns the results.

        A lane is stepped as a whole: `env_ids` has all copies of a lane or none (`make_vec(lanes=num_envs)` makes each copy
        a lane). Actions are [len(env_ids), *leaf]. Autoreset is that of `step`.

        Raises `AlreadyPendingCallError` if one of the copies has not come back, `ValueError` for other numbers or a wrong
        number of actions, `UsageError` for copies that must be reset first. Then nothing was sent.

        envs = millrace.make_vec("CartPole-v1", 8, workers=2, lanes=8)
        envs.async_reset(seed=1)
        for _ in range(100):
            observation, reward, terminated, truncated, infos = envs.recv()
            envs.send(policy(observation), infos["env_id"])
        """
        self._check_no_step("send")
        self._send_recv.send(actions, numbered(env_ids, self.num_envs), self.on_worker_loss)

    def recv(self, min_envs: int = 1, timeout: float | None = None) -> StepResult:
        """The results of all copies that are ready; waits until at least `min_envs` are. 0 does not wait.

        Observations, rewards, terminated and truncated have a row for each of these copies, in ascending order of the
        copies; so have the infos, which also have `env_id`: int64[rows], the numbers of the copies. The arrays are the
        caller's. Each row is that which `step` or `reset` would have given.

        A worker that does not answer within `timeout` seconds (`timeout_s` by default), counted from the order while the
        caller waits, is given up, as by `step`. Raises `NoAsyncCallError` if nothing was sent, `EnvironmentFailed`,
        `WorkerLost` and `NoWorkers`. After an error, all other copies can still be received, and those that are lost come
        back truncated or are named by `WorkerLost`.
        """
        self._check_no_step("recv")
        wait = WaitSettings(min_envs, self.timeout_s if timeout is None else timeout, self.on_worker_loss)
        ready = self._send_recv.recv(wait)
        batch, copies = self._batch, [n for lane in ready for n in lane.copies]
        truncated = batch.truncated[copies]
        loss_infos = {n: dict(info) for lane in ready for n, info in lane.loss_infos.items()}
        truncated[[n in loss_infos for n in copies]] = True
        infos = self._merge_infos({lane.lane: lane.infos for lane in ready}, loss_infos, copies)
        infos["env_id"] = np.array(copies, np.int64)
        return batch.observation_of_some(copies), batch.reward[copies], batch.terminated[copies], truncated, infos

    @property
    def outstanding(self) -> list[int]:
        """The copies that were sent an action or a reset, and that `recv` has not returned."""
        return self._send_recv.copies()

    # ---------------------------------------------------------------- calls

    def call(self, name: str, *args: Any, **kwargs: Any) -> tuple[Any, ...]:
        """Call a method of every copy, or get an attribute. Arguments and results must be plain data.

        Raises `UsageError` for a name and `TypeError` for arguments that cannot be sent, `AttributeError` or
        `EnvironmentFailed` if an environment raised, and `WorkerLost` if a worker is lost.

        `spec`, `observation_space` and `action_space` are as a worker described them, for such objects cannot travel.
        """
        return self.call_some(range(self.num_envs), name, *args, **kwargs)

    def call_some(self, copies: Sequence[int], name: str, /, *args: Any, **kwargs: Any) -> tuple[Any, ...]:
        """As `call`, for some copies. The results are in ascending order of the copies."""
        if name in self._described:
            return (self._described[name],) * len(copies)
        self._check_idle("call")
        return call_results(name, self._answers_of_call(call_orders(self._layout, copies, name, args, kwargs)))

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
        call_results(name, self._answers_of_call(assign_orders(self._layout, copies, name, values)))

    def render(self) -> tuple[Any, ...]:
        """What `render` of every copy returns."""
        return self.call("render")

    @property
    def np_random_seed(self) -> tuple[int, ...]:  # type: ignore[override]
        """The seed of each copy's random generator, as `SyncVectorEnv` shows it."""
        return self.get_attr("np_random_seed")

    def describe_copies(self, copies: Sequence[int]) -> list[DescribedEnv | None]:
        """What each of these copies is, in ascending order; None where a client cannot say it. Raises as `call`."""
        self._check_idle("describe_copies")
        orders = call_orders(self._layout, copies, DESCRIPTION, (), {})
        described: list[DescribedEnv | None] = []
        for lane, answer in sorted(self._answers_of_call(orders).items()):
            count = len(self._layout.by_lane(copies)[lane])
            try:
                described += described_copies(answer, count)
            except BadMessage as error:
                self._hub.refuse_owner(lane, f"lane {lane}: description cannot be read: {error}")
                described += [None] * count
        return described

    def make_copies(self) -> None:
        """Make all copies, before they are reset. Raises as `reset`, and `EnvironmentFailed` also if their spaces differ."""
        expected = self.single_observation_space, self.single_action_space
        described: list[DescribedEnv | None] = []
        for attempt in range(RESET_ATTEMPTS):
            try:
                described = self.describe_copies(range(self.num_envs))
                break
            except WorkerLost:  # another worker may make them
                if attempt == RESET_ATTEMPTS - 1:
                    raise
        for n, copy in enumerate(described):
            if copy is not None and (copy.observation_space, copy.action_space) != expected:
                raise EnvironmentFailed(
                    f"copy {n}: its observations {copy.observation_space} and actions {copy.action_space} are not those of "
                    f"copy 0, {expected[0]} and {expected[1]}; all copies must have the same, and each machine the same "
                    "version of the environment"
                )

    def _answers_of_call(self, orders: Mapping[int, MakeOrder]) -> dict[int, Answer]:
        self._hub.send_orders(orders)
        answers = self._hub.wait_for_answers(self.timeout_s)
        if unanswered := [lane for lane in orders if lane not in answers]:
            self._lost_lanes.add(self._hub.take_lost())
            if self.on_worker_loss == "raise":
                raise worker_lost(self._lost_lanes.report(unanswered), self._layout)
            # The next step also reports it: a caller that goes on must see that the episodes ended.
            lost = self._lost_lanes.unreported
            raise worker_lost({lane: lost.get(lane, UNKNOWN_REASON) for lane in unanswered}, self._layout)
        return answers

    # ---------------------------------------------------------------- workers

    @property
    def address(self) -> str:
        """The address that workers connect to."""
        return self._hub.address

    @property
    def workers(self) -> int:
        """Number of workers that have joined."""
        return len(self.members())

    def members(self) -> list[Member]:
        """The workers that have joined, as the learner sees them. For any thread."""
        return self._hub.members

    def wait_for(self, workers: int, timeout_s: float) -> None:
        """Wait until this many workers have joined. Raises `NoWorkers`."""
        self._hub.wait_for(workers, timeout_s)

    def no_workers(self, timeout_s: float) -> NoWorkers:
        """The error when no worker has been there for this long."""
        return self._hub.no_workers(timeout_s)

    def watch(self, callback: Callable[[], None]) -> None:
        """Set what is called regularly during each wait. An exception that it raises ends the wait."""
        self._hub.call_while_waiting(callback)

    def call_on_death(self, callback: Callable[[Failed], None]) -> None:
        """Call this, in the thread that uses this, when a worker's process has ended in its environment."""
        self._hub.call_on_death(callback)

    def answer_for(self, run: Callable[[float], Status]) -> None:
        """Answer `millrace status` for this run, which acts on these copies. `run` takes the time and gives its status."""
        self._hub.answer_for(run)

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
        self._check_no_step(doing)
        if copies := self._send_recv.copies():
            raise AlreadyPendingCallError(f"{doing} while copies {copies} have not come back: expected recv() first", "send")

    def _check_no_step(self, doing: str) -> None:
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

    def _merge_infos(
        self,
        packed_infos: Mapping[int, bytes],
        loss_infos: Mapping[int, Infos] | None = None,
        copies: Sequence[int] | None = None,
    ) -> Infos:
        """Infos as gymnasium merges them, in the order of the copies, with a row for each of `copies`; None: for all."""
        by_copy: dict[int, Infos] = dict(loss_infos or {})
        for lane, data in packed_infos.items():
            if not data:
                continue
            try:
                for n, info in unpack_infos(data, self._layout.copies(lane)).items():
                    by_copy[n] = by_copy.get(n, {}) | info
            except BadMessage as error:
                self._hub.refuse_owner(lane, f"lane {lane}: infos cannot be read: {error}")
        self.infos_by_copy = by_copy
        infos: Infos = {}
        merged: VectorEnv[Any, Any, Array] = self if copies is None else OfSomeCopies(len(copies))
        row_of = range(self.num_envs) if copies is None else {n: row for row, n in enumerate(copies)}
        for n in sorted(by_copy):
            if self.merge_infos:
                infos = merged._add_info(infos, by_copy[n], row_of[n])
            for key in repr_paths(by_copy[n]):
                if key not in self._warned_infos:
                    self._warned_infos.add(key)
                    log.warning("info %s of copy %d is no plain data: it arrives as its repr, a string", key, n)
        return infos


def _call_in_process(pid: int, function: Callable[[], None]) -> None:
    """Call `function` only in process `pid`: a forked child inherits this object, but does not own the workers."""
    if os.getpid() == pid:
        function()
