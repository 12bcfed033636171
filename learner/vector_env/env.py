"""A `gymnasium.vector.VectorEnv` whose env copies live in worker processes, on this machine or on others.

Rule: for the same seeds and actions, the results equal those of `gymnasium.vector.SyncVectorEnv` bit for bit, whether they
are sent as messages or through shared memory. A lost worker is always reported, as truncated copies or as an error; it is
never hidden. If Ctrl-C interrupts a method, call `reset` before any other method except `close`.

With A seats, each row of a batch belongs to a seat, and the rows of a copy are consecutive; `num_envs` counts rows.
Arguments that address an environment count copies instead: seeds, options, `reset_mask`, `env_ids`, calls and attributes.
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
from gymnasium.vector.async_vector_env import AsyncState
from gymnasium.vector.utils import batch_space

from millrace.learner.vector_env.batch_arrays import BatchArrays
from millrace.learner.vector_env.batch_layout import BatchLayout
from millrace.learner.vector_env.calls import CopyCalls
from millrace.learner.vector_env.cut_short import CutShort
from millrace.learner.vector_env.infos import InfoReader, merged
from millrace.learner.vector_env.send_recv import SendRecv
from millrace.learner.vector_env.sent_lanes import Infos, Ready
from millrace.learner.vector_env.spec import VectorEnvDescription
from millrace.learner.vector_env.step_arguments import Options, action_arrays, numbered, reset_arguments
from millrace.learner.vector_env.step_hub import StepHub
from millrace.protocol.arrays import Array
from millrace.protocol.envs.spaces import make_flatten

log = logging.getLogger("millrace.learner")

GymnasiumStep = tuple[Any, Array, Array, Array, Infos]


class ZmqVectorEnv(VectorEnv[Any, Any, Array]):
    """A vector environment whose env copies live in worker processes. Make one with `millrace.make_vec`."""

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
        """`timeout_s` is how many seconds a worker may take to answer.

        `on_close` is called once: by `close`, when this object is garbage collected, or when the interpreter exits.
        """
        step = description.step
        self.seats = step.seats
        """the names of the agents of each copy; empty for a gymnasium environment"""
        self._layout = BatchLayout(step.lanes, step.seats_of_copy)
        self.num_envs = N = self._layout.rows[-1].stop
        self.metadata = description.metadata
        self.autoreset_mode = AutoresetMode(step.autoreset)  # SyncVectorEnv has this attribute, and TorchRL reads it
        self.render_mode = description.render_mode
        self.spec = description.spec
        self.max_episode_steps = description.max_episode_steps
        """time limit of an episode, in env steps; None if there is none"""
        self.single_observation_space = description.observation_space
        self.single_action_space = description.action_space
        self.observation_space = batch_space(self.single_observation_space, N)
        self.action_space = batch_space(self.single_action_space, N)
        self.copy = copy
        self.merge_infos = True
        """whether to return infos, merged as gymnasium does; if not, only `infos_by_row` has them"""
        self.infos_by_row: dict[int, Infos] = {}
        """the newest non-empty infos, by row, as each copy returned them"""
        self.hub = hub
        """the hub that sends the orders; set its `while_waiting` to have a function called while it waits"""
        self.address = hub.address
        """the address to which workers connect"""
        self._action_leaves = step.action
        self._read_actions = make_flatten(self.single_action_space)
        memory = None if hub.shared is None else hub.shared.memory
        self._batch = BatchArrays(step, self._layout, self.single_observation_space, memory)
        self._state = AsyncState.DEFAULT
        self._cut_short = CutShort()
        self._info_reader = InfoReader(self._layout, hub.refuse_owner)
        self._send_recv = SendRecv(
            hub,
            self._layout,
            self._batch,
            autoreset=step.autoreset,
            on_worker_loss=on_worker_loss,
            timeout_s=timeout_s,
        )
        spaces = {"observation_space": self.single_observation_space, "action_space": self.single_action_space}
        self.calls = CopyCalls(self._send_recv, hub, self._layout, self._cut_short, {"spec": self.spec, **spaces})
        """calls methods of some of the copies, and reads and assigns their attributes"""
        self._close_once = weakref.finalize(self, _call_in_process, os.getpid(), on_close)

    # ---------------------------------------------------------------- reset and step
    # Rule: after an error, these methods await no lane to which they sent an order, so that `reset` is possible.

    def reset(self, *, seed: int | Sequence[int | None] | None = None, options: Options = None) -> tuple[Any, Infos]:
        """Begin episodes in all copies, or in those that `options["reset_mask"]` selects. Returns observations and infos.

        A single seed s gives the copies the seeds s, s + 1, …. A list of options has one entry for each copy. Raises
        `WorkerLost` if every attempt loses a worker. With SameStep, copies that were lost with their worker must be reset
        together; raises `UsageError` if only some of them are.
        """
        copies, seeds, options = reset_arguments(None, seed, options, self._layout.count)
        self._check_idle("reset", resets=copies)
        with self._cut_short:
            try:
                self._send_recv.reset(copies, seeds, options)
                observation, _, _, _, infos = self._rows(self._send_recv.recv_all())
                return observation, infos
            except Exception:
                self.abandon()
                raise

    def reset_async(
        self,
        seed: int | Sequence[int | None] | None = None,
        options: Options = None,
        *,
        env_ids: Sequence[int] | Array | None = None,
    ) -> None:
        """Begin episodes as `reset` does, but only in the copies that `env_ids` names, if it is given.

        With `env_ids`, a list of seeds has one seed for each of these copies. Get the results with `reset_wait`, which
        returns what `reset` returns, or with `recv`, which returns the copies that are ready, with reward 0. Raises
        `AlreadyPendingCallError` if one of the copies, or another copy of its lane, has not come back from an earlier call.
        """
        copies, seeds, options = reset_arguments(env_ids, seed, options, self._layout.count)
        self._check_idle("reset_async", of_sent=True, resets=copies)
        with self._cut_short:
            alone = not self.outstanding
            try:
                self._send_recv.reset(copies, seeds, options)
                self._state = AsyncState.WAITING_RESET if alone else AsyncState.DEFAULT
            except Exception:
                if alone:
                    self.abandon()
                raise

    def reset_wait(self, timeout: float | None = None) -> tuple[Any, Infos]:
        """Wait for the pending reset. Returns what `reset` returns.

        Raises what `reset` raises, and `NoAsyncCallError` if no reset is pending. For `timeout`, see `step_wait`.
        """
        observation, _, _, _, infos = self._wait(AsyncState.WAITING_RESET, timeout)
        return observation, infos

    def step(self, actions: Any) -> GymnasiumStep:
        """Step every copy. Returns observations, rewards, terminated, truncated and infos.

        `actions` and observations have a row for each copy, as in `action_space` and `observation_space`. Rewards are
        [num_envs] float64; terminated and truncated are [num_envs] bool; infos are a dict, merged as gymnasium does.

        With seats, the action of a row counts only if `infos["acts"]` was True for it in the previous results.
        `infos["complete"]` says which rows are complete transitions. Such a transition leads from the observation at which
        the row's seat last acted to the current one, with this reward, terminated and truncated. Agents that take turns may
        have acted some steps earlier, so keep their actions until their rows are complete. Don't learn from other rows;
        `infos["outside"]` has rewards that belong to no transition. An episode is over when no seat of its copy acts. If a
        worker is lost, its rows are truncated and not complete.

        Raises `UsageError` for copies that must be reset first, and `TypeError` or `ValueError` for wrong actions. Raises
        `EnvironmentFailed` if an environment fails, `NoWorkers` if a lane has no worker and gets none in time, and, with
        `on_worker_loss="raise"`, `WorkerLost` if a worker is lost.
        """
        self._check_idle("step_async")
        with self._cut_short:
            try:
                self._step(self._layout.lanes, actions, together=True)
                return self._rows(self._send_recv.recv_all())
            except Exception:
                self.abandon()
                raise

    def step_async(self, actions: Any) -> None:
        """Begin a step of every copy; `step_wait` returns the results."""
        self._check_idle("step_async")
        with self._cut_short:
            try:
                self._step(self._layout.lanes, actions, together=True)
                self._state = AsyncState.WAITING_STEP
            except Exception:
                self.abandon()
                raise

    def step_wait(self, timeout: float | None = None) -> GymnasiumStep:
        """Wait for the pending step. Returns what `step` returns.

        Raises what `step` raises, and `NoAsyncCallError` if no step is pending. A worker that does not answer within
        `timeout` seconds (by default, the vector environment's timeout) is treated as lost.
        """
        return self._wait(AsyncState.WAITING_STEP, timeout)

    # ---------------------------------------------------------------- some lanes, while others step

    def incarnations(self) -> list[int]:
        """For each copy, a number that rises when the copy is lost with its worker and a new one replaces it."""
        lanes = self.hub.coordinator.lanes
        return [lanes[lane].incarnation for lane in self._layout.lanes for _ in self._layout.copies(lane)]

    def begin_step(self, lanes: Sequence[int], actions: Any) -> None:
        """Start a step of these lanes; others may still be stepping. `actions` has a row for every copy of all lanes."""
        self._check_idle("begin_step", of_sent=True)
        with self._cut_short:
            self._step(lanes, actions, together=False)

    def end_step(self, lanes: Sequence[int]) -> GymnasiumStep:
        """Wait for the step of these lanes. Returns what `step` returns, but only the rows of these lanes are meaningful.

        Raises what `step` raises, and `NoAsyncCallError` for lanes whose step is not under way. After an error, these lanes
        are no longer awaited, but other lanes still are.
        """
        self._check_idle("end_step", of_sent=True)
        with self._cut_short:
            return self._rows(self._send_recv.recv_some(lanes))

    def abandon(self) -> None:
        """Stop waiting for all lanes. The results of the orders that were sent are dropped."""
        if self.outstanding:
            self._send_recv.abandon(self._layout.lanes)
        self._state = AsyncState.DEFAULT

    # ---------------------------------------------------------------- lanes that do not wait for each other

    def send(self, actions: Any, env_ids: Sequence[int] | Array | None = None) -> None:
        """Begin a step of these copies, by default all, with one action each; `recv` returns the results.

        Actions are [len(env_ids), *leaf], in the order of `env_ids`. A lane is stepped as a whole, so `env_ids` must contain
        all copies of a lane or none (`make_vec(lanes=num_envs)` makes each copy a lane). Autoreset works as in `step`.

        Raises `AlreadyPendingCallError` if one of the copies has not come back, `ValueError` for invalid `env_ids` or a
        wrong number of actions, and `UsageError` for copies that must be reset first. If it raises, nothing was sent.

        envs = millrace.make_vec("CartPole-v1", 8, workers=2, lanes=8)
        envs.reset_async(seed=1)
        for _ in range(100):
            observation, reward, terminated, truncated, infos = envs.recv()
            envs.send(policy(observation), infos["env_id"])
        """
        self._check_idle("send", of_sent=True)
        copies = numbered(env_ids, self._layout.count)
        at = self._layout.positions(copies)
        arrays = action_arrays(actions, self._read_actions, self._action_leaves, len(self._layout.rows_of(copies)))
        with self._cut_short:
            self._send_recv.step(list(at), arrays, at, together=False)
            self._state = AsyncState.DEFAULT

    def recv(self, min_envs: int = 1, timeout: float | None = None) -> GymnasiumStep:
        """Wait until at least `min_envs` copies are ready (0 does not wait). Returns the results of all ready copies.

        Observations, rewards, terminated, truncated and infos have a row for each of these copies, or for each of their
        seats, in ascending order of the copies. `infos["env_id"]` has the numbers of the copies, int64. You may keep the
        arrays, because later calls don't change them. Each row equals the one that `step` or `reset` would have returned.

        A worker that does not answer within `timeout` seconds (by default, the vector environment's timeout) is treated as
        lost, just as by `step`; only the time that you spend waiting for it counts.

        Raises `NoAsyncCallError` if nothing was sent. Raises `EnvironmentFailed`, `WorkerLost` and `NoWorkers` in the same
        cases as `step` and `reset`. After an error, all other copies can still be received, and those that are lost come
        back truncated or are named by `WorkerLost`.
        """
        self._check_idle("recv", of_sent=True)
        with self._cut_short:
            self._state = AsyncState.DEFAULT
            ready, copies = self._send_recv.recv(min_envs, timeout)
            rows = self._rows(ready, copies)
            rows[-1]["env_id"] = np.array(copies, np.int64)
            return rows

    @property
    def outstanding(self) -> list[int]:
        """The copies that were sent an action or a reset, and that `recv` has not returned yet."""
        return self._send_recv.copies()

    # ---------------------------------------------------------------- calls

    def call(self, name: str, *args: Any, **kwargs: Any) -> tuple[Any, ...]:
        """Call a method of every copy, or get an attribute. Arguments and results must be plain data.

        Raises `UsageError` for a name that cannot be sent, `TypeError` for arguments that cannot be sent, `AttributeError`
        or `EnvironmentFailed` if an environment raised, and `WorkerLost` if a worker is lost.

        `spec`, `observation_space` and `action_space` can't be sent, so they are made from a worker's description of them.
        """
        if name not in self.calls.known:  # else, no worker is asked
            self._check_idle("call")
        return self.calls.call(range(self._layout.count), name, args, kwargs)

    get_attr = call

    def set_attr(self, name: str, values: Any) -> None:
        """Set an attribute of every copy. A list or tuple has one value for each copy; any other value goes to all."""
        if not isinstance(values, list | tuple):
            values = [values] * self._layout.count
        if len(values) != self._layout.count:
            raise ValueError(f"values: expected one for each of {self._layout.count} copies, got {len(values)}")
        self._check_idle("call")
        self.calls.assign(range(self._layout.count), name, values)

    def render(self) -> tuple[Any, ...]:
        """Render every copy. Returns the results of their `render`."""
        return self.call("render")

    @property
    def np_random_seed(self) -> tuple[int, ...]:  # type: ignore[override]
        """The seed of each copy's random generator, just as in `SyncVectorEnv`."""
        return self.get_attr("np_random_seed")

    # ---------------------------------------------------------------- close

    def close_extras(self, **kwargs: Any) -> None:
        """Ask the workers to leave, and end the local worker processes. Never hangs."""
        self._close_once()

    def __enter__(self) -> ZmqVectorEnv:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    # ---------------------------------------------------------------- inside

    def _step(self, lanes: Sequence[int], actions: Any, *, together: bool) -> None:
        """Order the copies of these lanes to step. If `together`, no other lane steps before these come back."""
        arrays = action_arrays(actions, self._read_actions, self._action_leaves, self.num_envs)
        self._send_recv.step(lanes, arrays, self._layout.rows, together=together)

    def _check_idle(self, doing: str, *, of_sent: bool = False, resets: Sequence[int] = ()) -> None:
        """Raise if `doing` is not possible now. `of_sent` says that it is possible while copies have not come back.

        `resets` are the copies that it resets.
        """
        if self.closed:
            raise ClosedEnvironmentError(f"{doing} after close()")
        if len(resets) < self._layout.count:
            self._cut_short.check(doing)
        elif self._cut_short:
            self._send_recv.begin_anew()
            self._state = AsyncState.DEFAULT
        if self._state is AsyncState.WAITING_STEP or (self._state is AsyncState.WAITING_RESET and not of_sent):
            pending = self._state.value
            raise AlreadyPendingCallError(f"{doing} while a {pending} is pending: expected {pending}_wait() first", pending)
        if not of_sent and (copies := self._send_recv.copies()):
            raise AlreadyPendingCallError(f"{doing} while copies {copies} have not come back: expected recv() first", "send")

    def _wait(self, awaited: AsyncState, timeout_s: float | None) -> GymnasiumStep:
        """Wait for the pending step or reset. Raises `NoAsyncCallError` unless the call `awaited` is pending."""
        if self.closed:
            raise ClosedEnvironmentError(f"{awaited.value}_wait after close()")
        self._cut_short.check(f"{awaited.value}_wait")
        if self._state is not awaited:
            raise NoAsyncCallError(f"{awaited.value}_wait without {awaited.value}_async before it", awaited.value)
        with self._cut_short:
            try:
                ready = self._send_recv.recv_all(timeout_s)
                self._state = AsyncState.DEFAULT
            except Exception:
                self.abandon()
                raise
            return self._rows(ready)

    def _rows(self, ready: Ready, copies: list[int] | None = None) -> GymnasiumStep:
        """The results of these copies, or of all copies if None, after they have come back."""
        batch = self._batch
        some = None if copies is None else self._layout.rows_of(copies)
        rows = slice(None) if some is None else some
        truncated = batch.truncated.copy()
        if ready.losses:
            truncated[list(ready.losses)] = True
        self.infos_by_row = self._info_reader.by_row(ready)
        infos = merged(self.infos_by_row, self, some) if self.merge_infos else {}
        if self.seats:
            infos |= batch.of_seats(rows)
        observation = batch.observation(copy=self.copy) if some is None else batch.observation_of_some(some)
        return observation, batch.reward[rows].copy(), batch.terminated[rows].copy(), truncated[rows], infos


def _call_in_process(pid: int, function: Callable[[], None]) -> None:
    """Call `function` only in process `pid`, because a forked child inherits this object but does not own the workers."""
    if os.getpid() == pid:
        function()
