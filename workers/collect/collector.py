"""A policy and the env copies of some lanes -> rollouts that keep the law of a row (`protocol/rollout.py`).

Lanes that are asked for together are stepped in lock-step, with one stacked forward pass [L, N, ·]. What a lane yields
depends on the run's seed, the lane, its incarnation and the weights, and on nothing else: not on the lanes beside it.
The arrays of a rollout are new each time and never written again, so they can be sent as they lie.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from time import perf_counter
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from protocol.arrays import Array, Floats
from protocol.envs.envpool import envpool_spec
from protocol.envs.spaces import make_action_converter
from protocol.envs.vectorized import make_native
from protocol.errors import EnvironmentFailed
from protocol.policy.distributions import distribution
from protocol.policy.policy import Policy
from protocol.rollout import Rollout
from protocol.specs import RunSpec
from workers.collect.collected_lane import CollectedLane
from workers.collect.env_copies import EnvCopies, LoopedCopies, VectorCopies
from workers.collect.envpool_copies import EnvpoolCopies
from workers.collect.held_rollouts import Assignment
from workers.env_errors import CopyRaised, LaneFailed, lane_failed
from workers.env_loop import Pulse

OpenCopies = Callable[[RunSpec, int, Pulse], EnvCopies]
"""The copies of the lane of this number."""
Begin = Callable[[Sequence[int], Array, Pulse], None]
"""Told the numbers of L lanes and their actions [L, N, *action], before the first of them is stepped."""


def copies_of(run: RunSpec, lane: int, pulse: Pulse) -> EnvCopies:
    """The copies of one lane, as the run says: what a worker opens unless it is told otherwise."""
    match run.vector:
        case "native":
            return VectorCopies(make_native(run.env, run.copies))
        case "envpool":
            return EnvpoolCopies(envpool_spec(run.env), run.copies)
        case "loop":
            return LoopedCopies([run.env.make] * run.copies, pulse)


def each_by_itself(lanes: Sequence[int], actions: Array, pulse: Pulse) -> None:
    """Nothing begins before a lane is stepped."""


class _Rows(NamedTuple):
    """The rows of L lanes while they are collected."""

    obs: tuple[Array, ...]  # [L, T+1, N, *leaf] each
    state: Floats  # [L, N, S] what the policy remembers, moved on from step to step
    noise: Floats  # [L, T, N, noise]
    params: Floats  # [L, T, N, P]
    action: Array  # [L, T, N, *action]
    reward: Array  # [L, T, N] float64, so that episodes are summed before they are rounded
    terminated: Array  # [L, T, N] bool
    truncated: Array  # [L, T, N] bool
    clock: list[float]  # [T] seconds, when each step was over


class Collector:
    """Collects rollouts on lanes that it opens as they are asked for."""

    def __init__(
        self,
        run: RunSpec,
        policy: Policy,
        open_copies: OpenCopies = copies_of,
        begin: Begin = each_by_itself,
    ) -> None:
        """`begin`: for copies that are stepped all at once, whichever lane they are of."""
        self.steps = 0
        """env steps collected: valid rows"""
        self.stages = {"open": 0.0, "act": 0.0, "step": 0.0}
        """seconds spent making and first resetting copies, choosing actions, stepping copies"""
        self._run = run
        self._policy = policy
        self._open_copies, self._begin = open_copies, begin
        self._distribution = distribution(run.policy)
        self._write = make_action_converter(run.policy.action)
        self._lanes: dict[int, CollectedLane] = {}
        self._leaving: list[CollectedLane] = []  # closed by a pulse, while their copies may be in mid-step
        self._collecting = False

    def load(self, parameters: Floats, buffers: Floats) -> None:
        """Act with these weights from now on."""
        self._policy.load(parameters, buffers)

    def collect(self, assignments: Sequence[Assignment], version: int, session: int, pulse: Pulse) -> list[Rollout]:
        """One rollout for each assignment, in their order; each is of another lane.

        `pulse` is called at every step and may raise. Whatever raises, it or an environment (`LaneFailed`), these
        lanes are closed: half a rollout is nobody's.
        """
        if len({assignment.lane for assignment in assignments}) < len(assignments):
            raise ValueError(f"collect expected one assignment for each lane, got {assignments}")
        self._collecting = True
        try:
            lanes = [self._living(assignment, pulse) for assignment in assignments]
            rows = self._new_rows(lanes)
            try:
                self._fill(rows, lanes, pulse)
            except (LaneFailed, EnvironmentFailed, IndexError):  # a nonsensical row explains what came of it
                done = len(rows.clock)
                for i, lane in enumerate(lanes):
                    lane.check_sense([array[i, : done + 1] for array in rows.obs], rows.reward[i, :done])
                raise
            return [
                self._rollout(rows, i, lane, assignment, version, session)
                for i, (lane, assignment) in enumerate(zip(lanes, assignments, strict=True))
            ]
        except BaseException:
            self.close(assignment.lane for assignment in assignments)
            raise
        finally:
            self._collecting = False
            self.close(())

    def close(self, lanes: Iterable[int]) -> None:
        """Let go of these lanes, those that are here; a pulse may ask for it, and then it is done after the collection."""
        self._leaving += [self._lanes.pop(lane) for lane in lanes if lane in self._lanes]
        while self._leaving and not self._collecting:
            self._leaving.pop().copies.close()

    def close_all(self) -> None:
        """Let go of every lane."""
        self.close(list(self._lanes))

    def _living(self, assignment: Assignment, pulse: Pulse) -> CollectedLane:
        """The lane in this incarnation, opened if need be."""
        lane = self._lanes.get(assignment.lane)
        if lane is not None and lane.incarnation == assignment.incarnation:
            return lane
        began = perf_counter()
        self.close([assignment.lane])
        try:
            copies = self._open_copies(self._run, assignment.lane, pulse)
        except CopyRaised as error:
            raise lane_failed(assignment.lane, "made", error) from error
        lane = self._lanes[assignment.lane] = CollectedLane(self._run, assignment.lane, assignment.incarnation, copies)
        lane.reset(pulse)
        self.stages["open"] += perf_counter() - began
        return lane

    def _new_rows(self, lanes: Sequence[CollectedLane]) -> _Rows:
        L, T, N = len(lanes), self._run.rollout_steps, self._run.copies
        action = self._run.policy.action
        obs = tuple(np.empty((L, T + 1, N, *leaf.shape), leaf.dtype) for leaf in self._run.policy.observation)
        for i, lane in enumerate(lanes):
            for array, leaf in zip(obs, lane.obs, strict=True):
                array[i, 0] = leaf
        return _Rows(
            obs=obs,
            state=np.stack([lane.state for lane in lanes]),
            noise=np.stack([self._distribution.noise(lane.generator, (T, N)) for lane in lanes]),
            params=np.empty((L, T, N, self._distribution.params_size), np.float32),
            action=np.empty((L, T, N, *action.shape), action.stored_dtype),
            reward=np.empty((L, T, N)),
            terminated=np.empty((L, T, N), bool),
            truncated=np.empty((L, T, N), bool),
            clock=[],
        )

    def _fill(self, rows: _Rows, lanes: Sequence[CollectedLane], pulse: Pulse) -> None:
        """Step all lanes T times."""
        remembers = rows.state.size > 0
        resets = np.stack([lane.ended for lane in lanes])  # [L, N] row t is not valid
        numbers = [lane.number for lane in lanes]
        stages = self.stages
        each = [  # the parts of every lane
            (i, lane, rows.reward[i], rows.terminated[i], rows.truncated[i], [array[i] for array in rows.obs])
            for i, lane in enumerate(lanes)
        ]
        for t in range(self._run.rollout_steps):
            pulse()
            began = perf_counter()
            with np.errstate(all="ignore"):  # a NaN is named once the rows are full
                params = self._policy([leaf[:, t] for leaf in rows.obs], rows.state)
                action = self._distribution.sample(params, rows.noise[:, t])
                taken = self._write(action)
            rows.params[:, t] = params
            rows.action[:, t] = action
            acted = perf_counter()
            self._begin(numbers, taken, pulse)
            for i, lane, reward, terminated, truncated, obs in each:
                row = lane.step(taken[i], t, pulse)
                try:
                    leaves, reward[t], terminated[t], truncated[t], lost = row
                    for array, leaf in zip(obs, leaves, strict=True):
                        array[t + 1] = leaf
                except (TypeError, ValueError) as error:
                    raise LaneFailed(lane.number, f"step {t}: its environment gave what cannot be kept: {error}") from error
                if lost is not None:
                    _cut_short(rows, i, lane, t, lost)
            if remembers:
                rows.state[resets] = 0.0
                resets = rows.terminated[:, t] | rows.truncated[:, t]
            over = perf_counter()
            rows.clock.append(over)
            stages["act"] += acted - began
            stages["step"] += over - acted

    def _rollout(self, rows: _Rows, i: int, lane: CollectedLane, about: Assignment, version: int, session: int) -> Rollout:
        """Lane `i` of the rows, as views."""
        valid, episodes = lane.finish(rows.reward[i], rows.terminated[i] | rows.truncated[i], rows.clock)
        obs = tuple(array[i] for array in rows.obs)
        with np.errstate(over="ignore"):
            reward = rows.reward[i].astype(np.float32)
        lane.check_sense(obs, reward)
        lane.obs = tuple(array[-1].copy() for array in obs)
        before, lane.state = lane.state, rows.state[i].copy()
        self.steps += int(np.count_nonzero(valid))
        return Rollout(
            session=session,
            lane=lane.number,
            ticket=about.ticket,
            version=version,
            sequence=about.sequence,
            obs=obs,
            action=rows.action[i],
            log_prob=self._distribution.log_prob(rows.params[i], rows.action[i]),
            reward=reward,
            terminated=rows.terminated[i],
            truncated=rows.truncated[i],
            valid=valid,
            state=before,
            episodes=episodes,
        )


def _cut_short(rows: _Rows, i: int, lane: CollectedLane, t: int, lost: npt.NDArray[np.bool_]) -> None:
    """Lane `i` lost these copies [N] in step `t`: their episodes end, truncated, with the last step that was made.

    Rows `t` and `t + 1` are then not valid: nothing is made up for the step that was not.
    """
    rows.truncated[i, t] |= lost
    if t:
        rows.truncated[i, t - 1] |= lost & ~rows.terminated[i, t - 1]
    else:
        lane.ended |= lost  # the last rollout is delivered: the episode's end is in none
