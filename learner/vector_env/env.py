"""A `gymnasium.vector.VectorEnv` whose env copies live in worker processes, on this machine or on others.

Rule: the results are, bit for bit, those of `gymnasium.vector.SyncVectorEnv` for the same seeds and actions, whichever
way they travel. A lost worker is always reported, as truncated copies or as an error; it is never hidden.
"""

from __future__ import annotations

import logging
import os
import weakref
from collections.abc import Callable, Sequence
from typing import Any, Literal

import numpy as np
from gymnasium.error import AlreadyPendingCallError, ClosedEnvironmentError, NoAsyncCallError
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from learner.vector_env.batch_arrays import BatchArrays
from learner.vector_env.batch_layout import BatchLayout
from learner.vector_env.calls import CopyCalls
from learner.vector_env.infos import InfoReader, merged
from learner.vector_env.lost_lanes import LostLanes
from learner.vector_env.send_recv import SendRecv, VectorEnvParts, numbered
from learner.vector_env.sent_lanes import Infos, ReadyLane
from learner.vector_env.spec import VectorEnvDescription
from learner.vector_env.step_arguments import Options, action_arrays, seed_list, take_reset_mask
from learner.vector_env.step_hub import StepHub
from protocol.arrays import Array
from protocol.envs.spaces import make_flatten

log = logging.getLogger("millrace.learner")

StepResult = tuple[Any, Array, Array, Array, Infos]


class ZmqVectorEnv(VectorEnv[Any, Any, Array]):
    """Env copies in worker processes that are stepped together. `millrace.make_vec` makes it."""

    def __init__(
        self,
        description: VectorEnvDescription,
        hub: StepHub,
        *,
        timeout_s: float = 60.0,
        on_worker_loss: Literal["truncate", "raise"] = "truncate",
        copy: bool = True,
        on_close: Callable[[], None] = lambda: None,
    ) -> None:
        """`timeout_s`: how long a worker may take to answer.

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
        self.copy = copy
        self.merge_infos = True
        """whether infos are returned, merged as gymnasium does it; otherwise only `infos_by_copy` has them"""
        self.infos_by_copy: dict[int, Infos] = {}
        """the newest infos that are not empty, as each copy returned them"""
        self.hub = hub
        """who is asked; it may be told what to call while it waits"""
        self._action_leaves, self._read_actions = step.action, make_flatten(self.single_action_space)
        self._layout = BatchLayout(step.lanes)
        memory = None if hub.shared is None else hub.shared.memory
        self._batch = BatchArrays(step, self._layout, self.single_observation_space, memory)
        self._step_is_pending = False
        self._info_reader = InfoReader(self._layout, hub.refuse_owner)
        seeds, ever_reset = list[int | None]([None] * N), np.zeros(N, bool)
        parts = VectorEnvParts(
            hub, self._layout, self._batch, LostLanes(), step.autoreset, seeds, ever_reset, on_worker_loss
        )
        self._send_recv = SendRecv(parts, timeout_s)
        spaces = {"observation_space": self.single_observation_space, "action_space": self.single_action_space}
        self.calls = CopyCalls(self._send_recv, parts, {"spec": self.spec, **spaces})
        """calls of some copies"""
        self._close_once = weakref.finalize(self, _call_in_process, os.getpid(), on_close)

    # ---------------------------------------------------------------- reset and step

    def reset(self, *, seed: int | Sequence[int | None] | None = None, options: Options = None) -> tuple[Any, Infos]:
        """Begin episodes in all copies, or in those that `options["reset_mask"]` selects. Returns observations and infos.

        A single seed s gives the copies s, s + 1, …. A list of options has those of each copy. Raises `WorkerLost` if each
        attempt loses a worker. With SameStep, copies that were lost with their worker are reset together; raises
        `UsageError` for a part of them.
        """
        self._check_idle("reset")
        seeds = seed_list(seed, self.num_envs)
        mask, options = take_reset_mask(options, self.num_envs)
        self._send_recv.reset(np.flatnonzero(mask).tolist(), seeds, options)
        ready = self._send_recv.recv_all()
        return self._batch.observation(copy=self.copy), self._infos(ready)

    def step(self, actions: Any) -> StepResult:
        """Step every copy. Returns observations, rewards, terminated, truncated and infos.

        `actions` and observations have a row for each copy, as `action_space` and `observation_space`. Rewards are
        [num_envs] float64; terminated and truncated are [num_envs] bool; infos are a dict, as gymnasium merges them.

        Raises `UsageError` for copies that must be reset first, `TypeError` and `ValueError` for wrong actions,
        `EnvironmentFailed`, `NoWorkers`, and with `on_worker_loss="raise"` `WorkerLost`.
        """
        self.step_async(actions)
        return self.step_wait()

    def step_async(self, actions: Any, lanes: Sequence[int] | None = None) -> None:
        """Order every copy to step, or those of these lanes; `step_wait` returns the results."""
        self._check_idle("step_async")
        arrays = action_arrays(actions, self._read_actions, self._action_leaves, self.num_envs)
        self._send_recv.step(self._layout.lanes if lanes is None else lanes, arrays, self._layout.rows, together=True)
        self._step_is_pending = True

    def step_wait(self, timeout: float | None = None) -> StepResult:
        """Wait for the pending step. Returns and raises what `step` does, and `NoAsyncCallError` if there is none.

        A worker that does not answer within `timeout` seconds (`timeout_s` by default) is given up.
        """
        if self.closed:
            raise ClosedEnvironmentError("step_wait after close()")
        if not self._step_is_pending:
            raise NoAsyncCallError("step_wait without step_async before it", "step")
        self._step_is_pending = False
        ready = self._send_recv.recv_all(timeout)
        batch, truncated = self._batch, self._batch.truncated.copy()
        if lost := [n for lane in ready if lane.loss_infos for n in lane.loss_infos]:
            truncated[lost] = True
        observation = batch.observation(copy=self.copy)
        return observation, batch.reward.copy(), batch.terminated.copy(), truncated, self._infos(ready)

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
        self._check_idle("async_reset", of_sent=True)
        copies = numbered(env_ids, self.num_envs)
        self._layout.check(copies)
        if isinstance(seed, int | np.integer):
            seed = [int(seed) + n for n in copies]
        seeds = np.full(self.num_envs, None)
        seeds[copies] = seed_list(seed, len(copies))
        self._send_recv.reset(copies, seeds.tolist(), options)

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
        self._check_idle("send", of_sent=True)
        copies = numbered(env_ids, self.num_envs)
        at = self._layout.positions(copies)
        arrays = action_arrays(actions, self._read_actions, self._action_leaves, len(copies))
        self._send_recv.step(list(at), arrays, at, together=False)

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
        self._check_idle("recv", of_sent=True)
        ready = self._send_recv.recv(min_envs, timeout)
        batch, copies = self._batch, [n for lane in ready for n in lane.copies]
        truncated = batch.truncated[copies]
        if lost := {n for lane in ready if lane.loss_infos for n in lane.loss_infos}:
            truncated[[n in lost for n in copies]] = True
        infos = self._infos(ready, copies)
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
        if name not in self.calls.known:
            self._check_idle("call")
        return self.calls.call(range(self.num_envs), name, args, kwargs)

    get_attr = call

    def set_attr(self, name: str, values: Any) -> None:
        """Set an attribute. A list or tuple has one value for each copy; any other value goes to all copies."""
        if not isinstance(values, list | tuple):
            values = [values] * self.num_envs
        if len(values) != self.num_envs:
            raise ValueError(f"values: expected one for each of {self.num_envs} copies, got {len(values)}")
        self._check_idle("call")
        self.calls.assign(range(self.num_envs), name, values)

    def render(self) -> tuple[Any, ...]:
        """What `render` of every copy returns."""
        return self.call("render")

    @property
    def np_random_seed(self) -> tuple[int, ...]:  # type: ignore[override]
        """The seed of each copy's random generator, as `SyncVectorEnv` shows it."""
        return self.get_attr("np_random_seed")

    # ---------------------------------------------------------------- workers

    @property
    def address(self) -> str:
        """The address that workers connect to."""
        return self.hub.address

    @property
    def workers(self) -> int:
        """Number of workers that have joined."""
        return len(self.hub.coordinator.members)

    # ---------------------------------------------------------------- close

    def close_extras(self, **kwargs: Any) -> None:
        """Ask the workers to leave, and end the local ones. Never hangs."""
        self._send_recv.closed = True
        self._close_once()

    def __enter__(self) -> ZmqVectorEnv:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    # ---------------------------------------------------------------- inside

    def _check_idle(self, doing: str, *, of_sent: bool = False) -> None:
        """Raise if this cannot be done now. `of_sent`: it may be done while copies have not come back."""
        if self.closed:
            raise ClosedEnvironmentError(f"{doing} after close()")
        if self._step_is_pending:
            raise AlreadyPendingCallError(f"{doing} while a step is pending: expected step_wait() first", "step")
        if not of_sent and (copies := self._send_recv.copies()):
            raise AlreadyPendingCallError(f"{doing} while copies {copies} have not come back: expected recv() first", "send")

    def _infos(self, ready: Sequence[ReadyLane], copies: Sequence[int] | None = None) -> Infos:
        self.infos_by_copy = self._info_reader.by_copy(ready)
        return merged(self.infos_by_copy, self, copies) if self.merge_infos else {}


def _call_in_process(pid: int, function: Callable[[], None]) -> None:
    """Call `function` only in process `pid`: a forked child inherits this object, but does not own the workers."""
    if os.getpid() == pid:
        function()
