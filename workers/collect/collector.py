"""Collects rollouts that keep the row format (`protocol/rollout.py`), from a policy and the env copies of lanes.

Lanes that are collected together are stepped in lock-step, with one forward pass for all of them [L, N, ·]. The rollout of
a lane depends on the run's seed, the lane, its incarnation and the weights, and on nothing else: not on the other lanes.
The arrays of a rollout are new each time and are never written again, so they can be sent without a copy.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from time import perf_counter
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from millrace.protocol.arrays import Array, Bools, Floats
from millrace.protocol.bounds import Stages
from millrace.protocol.envs.env_actions import action_converter_of
from millrace.protocol.envs.kinds_of_copies import copies_kind
from millrace.protocol.envs.which_copy import EnvCopy
from millrace.protocol.errors import EnvironmentFailed, PolicyFailed
from millrace.protocol.messages import Weights
from millrace.protocol.policy.called_policy import CalledPolicy
from millrace.protocol.policy.masks import stored_leaves
from millrace.protocol.policy.policy import Policy
from millrace.protocol.rollout import Episode, Rollout
from millrace.protocol.specs import RunSpec
from millrace.workers.acting import RolloutActions, acting_of
from millrace.workers.activity import ENV_CALLS, activity
from millrace.workers.collect.collected_lane import CollectedLane
from millrace.workers.conversation.held import Assignment
from millrace.workers.copies.env_copies import EnvCopies
from millrace.workers.copies.env_errors import CopyFailed, environment_failed
from millrace.workers.copies.env_loop import Pulse
from millrace.workers.copies.open_lanes import OpenLanes
from millrace.workers.copies.row_writers import write_numbers
from millrace.workers.copies.value_checks import check_acted, check_observed, check_rewards
from millrace.workers.opponents import KnownOpponents, Opponents

OpenEnvCopies = Callable[[RunSpec, int, Pulse], EnvCopies]
"""Makes the env copies of the lane of this number."""
StepAll = Callable[[Sequence[int], Array, Pulse], None]
"""Called with the numbers of L lanes and their actions [L, N, *action], before each of them is stepped."""


def open_env_copies(run: RunSpec, lane: int, pulse: Pulse) -> EnvCopies:
    """The env copies of a lane in this process, of the kind that the run asks for."""
    copies: EnvCopies = copies_kind(run.vector).open(run, EnvCopy(lane * run.copies, lane), pulse)
    return copies


def no_step_for_all(lanes: Sequence[int], actions: Array, pulse: Pulse) -> None:
    """Do nothing: each lane steps its own copies."""


class _CollectedRows(NamedTuple):
    """Arrays of the rollouts of L lanes while they are collected."""

    obs: tuple[Array, ...]  # [L, T+1, N, *leaf] each; in a masked run the last one is the mask
    state: Floats  # [L, N, S] recurrent state of the policy, updated at each step
    reward: Array  # [L, T, N] float64, so that returns are summed before they are rounded
    terminated: Array  # [L, T, N] bool
    truncated: Array  # [L, T, N] bool
    step_end_s: list[float]  # [T] by perf_counter


class _UnderWay:
    """Counts the env steps of rollouts while they are collected, also those of a row that is not whole.

    Rule: the count never falls, and only calls of the environment that have returned are in it.
    """

    def __init__(self, rows: _CollectedRows, lanes: Sequence[CollectedLane], copies: int) -> None:
        self._rows, self._lanes, self._copies = rows, lanes, copies
        self._calls = activity().numbers
        self._calls_before_row = 0

    def begin_row(self) -> None:
        """The row before is whole, and the next one begins."""
        self._calls_before_row = self._calls[ENV_CALLS]

    def env_steps(self) -> int:
        """Those made so far."""
        whole = len(self._rows.step_end_s)
        if whole == self._rows.reward.shape[1]:
            return self._of_rows(whole)
        before, after = self._of_rows(whole), self._of_rows(whole + 1)
        # Calls in this row that have returned. At worst the copies that it resets were called first.
        calls = self._calls[ENV_CALLS] - self._calls_before_row
        resets = len(self._lanes) * self._copies - (after - before)
        return min(after, before + max(0, calls - resets))

    def _of_rows(self, rows: int) -> int:
        """Of so many rows. It is known before a row is made which copies that row only resets."""
        return sum(rows * self._copies - self._resets(i, lane, rows) for i, lane in enumerate(self._lanes))

    def _resets(self, i: int, lane: CollectedLane, rows: int) -> int:
        if lane.seats is not None:
            return int(np.count_nonzero(lane.seats.resets[:rows]))
        if not rows:
            return 0
        ended = self._rows.terminated[i, : rows - 1] | self._rows.truncated[i, : rows - 1]  # [rows - 1, N]
        return int(np.count_nonzero(lane.ended) + np.count_nonzero(ended))


class Collector:
    """Collects rollouts. It opens a lane when a rollout of it is first asked for."""

    def __init__(
        self,
        run: RunSpec,
        policy: Policy | CalledPolicy,
        open_copies: OpenEnvCopies = open_env_copies,
        step_all: StepAll = no_step_for_all,
    ) -> None:
        """`step_all`: steps the env copies of all lanes at once, if one vector environment holds them all."""
        self.note = ""
        """what whoever trains should know of the environment, once a lane has seen it"""
        self._ended_steps = 0  # of rollouts that are whole or were dropped
        self._under_way: _UnderWay | None = None
        self.stages: Stages = {"open": 0.0, "act": 0.0, "step": 0.0}
        """seconds spent opening lanes (making copies and their first reset), choosing actions and stepping copies"""
        self.env_attributes = b""
        """attributes that each env copy gets before its next rollout (`Weights.env_attributes`)"""
        self._run = run
        self._stored = stored_leaves(run)
        self._acting = acting_of(run, policy)
        self._open_copies, self._step_all = open_copies, step_all
        self._to_env_action = action_converter_of(run.policy)
        self._opponents = KnownOpponents(run)
        self.lanes = OpenLanes[CollectedLane]()
        """the lanes with a rollout, until they are closed"""

    @property
    def steps(self) -> int:
        """Number of env steps made, also of rollouts that are under way. A step that only resets a copy is none."""
        return self._ended_steps + (0 if self._under_way is None else self._under_way.env_steps())

    def load(self, parameters: Floats, buffers: Floats) -> None:
        """Use these weights from now on."""
        self._acting.load(parameters, buffers)

    def collect(
        self,
        assignments: Sequence[Assignment],
        version: int,
        session: int,
        pulse: Pulse,
        held: Mapping[int, Weights] = MappingProxyType({}),
    ) -> list[Rollout]:
        """Collect one rollout for each assignment. Returns them in the order of the assignments.

        Each assignment must name a different lane. `held`: the weights of opponents that may be new, by version. `pulse` is
        called at every step and may raise. If `pulse` raises, or an environment does (`EnvironmentFailed`), these lanes are
        closed and the unfinished rollouts are dropped.
        """
        if len({assignment.lane for assignment in assignments}) < len(assignments):
            raise ValueError(f"collect: expected one assignment for each lane, got {assignments}")
        with self.lanes.in_use():
            try:
                return self._collect(assignments, version, session, pulse, self._opponents.among(held))
            except BaseException:
                self.lanes.close(assignment.lane for assignment in assignments)
                raise

    def _collect(
        self, assignments: Sequence[Assignment], version: int, session: int, pulse: Pulse, opponents: Opponents
    ) -> list[Rollout]:
        lanes = [self._lane_for(assignment, pulse) for assignment in assignments]
        for lane, assignment in zip(lanes, assignments, strict=True):
            lane.set_attributes(self.env_attributes, pulse)
            lane.begin(None if assignment.opponent is None else opponents(assignment.opponent))
        rows = self._new_rows(lanes)
        actions = self._acting.begin([lane.generator for lane in lanes])
        under_way = self._under_way = _UnderWay(rows, lanes, self._run.copies)
        try:
            try:
                self._act_and_step(rows, actions, lanes, pulse)
            finally:
                self._ended_steps += under_way.env_steps()
                self._under_way = None
            finished = [
                lane.finish(rows.reward[i], rows.terminated[i] | rows.truncated[i], rows.step_end_s)
                for i, lane in enumerate(lanes)
            ]
        except (EnvironmentFailed, PolicyFailed, IndexError):
            # An invalid observation or reward may have caused the error. Then these checks raise the clearer one.
            done = len(rows.step_end_s)
            for i, lane in enumerate(lanes):
                check_observed(lane.number, self._stored, [array[i, : done + 1] for array in rows.obs], self._run.row_axes)
                check_rewards(lane.number, rows.reward[i, :done], self._run.row_axes)
            raise
        return [
            self._rollout(rows, actions, i, lane, finished[i], assignment, version, session)
            for i, (lane, assignment) in enumerate(zip(lanes, assignments, strict=True))
        ]

    def _lane_for(self, assignment: Assignment, pulse: Pulse) -> CollectedLane:
        """The lane in this incarnation. It is opened if it does not exist."""
        number, incarnation = assignment.lane, assignment.incarnation
        if (lane := self.lanes.here(number, incarnation)) is not None:
            return lane

        def made() -> CollectedLane:
            try:
                copies = self._open_copies(self._run, number, pulse)
            except CopyFailed as error:
                raise environment_failed(number, error, "made") from error
            return CollectedLane(self._run, number, incarnation, copies)

        began = perf_counter()
        lane = self.lanes.open(number, made)
        lane.set_attributes(self.env_attributes, pulse)
        lane.reset(pulse)
        self.note = self.note or lane.copies.note
        self.stages["open"] += perf_counter() - began
        return lane

    def _new_rows(self, lanes: Sequence[CollectedLane]) -> _CollectedRows:
        L, T, N = len(lanes), self._run.rollout_steps, self._run.columns
        obs = tuple(np.empty((L, T + 1, N, *leaf.shape), leaf.dtype) for leaf in self._stored)
        for i, lane in enumerate(lanes):
            for array, leaf in zip(obs, lane.obs, strict=True):
                array[i, 0] = leaf
        return _CollectedRows(
            obs=obs,
            state=np.stack([lane.state for lane in lanes]),
            reward=np.empty((L, T, N)),
            terminated=np.empty((L, T, N), bool),
            truncated=np.empty((L, T, N), bool),
            step_end_s=[],
        )

    def _act_and_step(
        self, rows: _CollectedRows, actions: RolloutActions, lanes: Sequence[CollectedLane], pulse: Pulse
    ) -> None:
        """Step all lanes T times."""
        is_recurrent = rows.state.size > 0
        resets = np.zeros((len(lanes), self._run.columns), bool)  # [L, N] row t is not valid
        with_seats = [(i, lane.seats) for i, lane in enumerate(lanes) if lane.seats is not None]
        if not with_seats:
            resets[:] = [lane.ended for lane in lanes]
        lane_numbers = [lane.number for lane in lanes]
        stages, under_way = self.stages, self._under_way
        assert under_way is not None
        views = [  # of every lane
            (lane, (rows.reward[i], rows.terminated[i], rows.truncated[i]), lane.writer.joined(leaf[i] for leaf in rows.obs))
            for i, lane in enumerate(lanes)
        ]
        for t in range(self._run.rollout_steps):
            under_way.begin_row()
            pulse()
            began = perf_counter()
            with np.errstate(all="ignore"):  # a NaN is reported once the rollout is complete
                before = rows.state.copy() if with_seats else rows.state
                chosen = actions.act(t, [leaf[:, t] for leaf in rows.obs], rows.state)
                taken = self._to_env_action(chosen)
                for i, seats in with_seats:
                    if seats.others is not None:
                        seats.others.act([leaf[i, t] for leaf in rows.obs], seats.acts, taken[i])
                    seats.acted(t, actions.written(i), before[i], rows.state[i])
            acted = perf_counter()
            self._step_all(lane_numbers, taken, pulse)
            for i, (lane, numbers, obs) in enumerate(views):
                try:
                    row = lane.copies.step(taken[i], pulse)
                    write_numbers(numbers, t, (row.reward, row.terminated, row.truncated))
                    lane.writer.write(obs, t + 1, row.leaves)
                except CopyFailed as error:
                    raise environment_failed(lane.number, error, f"step {t}") from error
                if lane.seats is not None:
                    lane.seats.stepped(t, row, rows.state[i], perf_counter())
                elif row.facts:
                    lane.keep_facts(t, row.facts)
                if (lost := row.lost) is not None:
                    _truncate_lost(rows, i, lane, t, lost)
            if is_recurrent and not with_seats:
                rows.state[resets] = 0.0
                resets = rows.terminated[:, t] | rows.truncated[:, t]
            ended = perf_counter()
            rows.step_end_s.append(ended)
            stages["act"] += acted - began
            stages["step"] += ended - acted

    def _rollout(
        self,
        rows: _CollectedRows,
        actions: RolloutActions,
        i: int,
        lane: CollectedLane,
        finished: tuple[Bools, tuple[Episode, ...]],
        assignment: Assignment,
        version: int,
        session: int,
    ) -> Rollout:
        """The rollout of lane `i`, made of views of the rows."""
        valid, episodes = finished
        obs = tuple(array[i] for array in rows.obs)
        axes = self._run.row_axes
        check_observed(lane.number, self._stored, obs, axes)
        reward = check_rewards(lane.number, rows.reward[i], axes)
        acted = actions.columns(i)
        check_acted(lane.number, "action", acted.action, obs, axes)
        check_acted(lane.number, "log_prob", acted.log_prob, obs, axes)
        lane.obs = tuple(array[-1].copy() for array in obs)
        lane.state = rows.state[i].copy()
        resets, sent = None if lane.seats is None else lane.seats.resets, lane.sent
        return Rollout(
            session=session,
            lane=lane.number,
            ticket=assignment.ticket,
            version=version,
            sequence=assignment.sequence,
            obs=tuple(array[:, sent] for array in (obs[:-1] if self._run.masked else obs)),
            action=acted.action[:, sent],
            log_prob=acted.log_prob[:, sent],
            reward=reward[:, sent],
            terminated=rows.terminated[i][:, sent],
            truncated=rows.truncated[i][:, sent],
            valid=valid[:, sent],
            state=lane.state_before[sent],
            episodes=episodes,
            mask=obs[-1][:, sent] if self._run.masked else None,
            extras=tuple(extra[:, sent] for extra in acted.extras),
            resets=resets,
        )


def _truncate_lost(rows: _CollectedRows, i: int, lane: CollectedLane, t: int, lost: npt.NDArray[np.bool_]) -> None:
    """Lane `i` lost these copies [N] in step `t`: their episodes are truncated at the last step that was made.

    Rows `t` and `t + 1` are then not valid, because step `t` was not made.
    """
    rows.truncated[i, t] |= lost
    if t:
        rows.truncated[i, t - 1] |= lost & ~rows.terminated[i, t - 1]
    else:
        lane.ended |= lost  # the last rollout is already delivered, so no rollout has the end of the episode
