"""Collects rollouts that follow the row format (`protocol/rollout.py`), from a policy and the env copies of lanes.

Lanes that are collected together are stepped in lock-step, with one forward pass for all of them [L, N, ·]. The rollout of a
lane depends on the run's seed, the lane, the round, the weights and the lane's history, and on nothing else: neither on the
other lanes, nor on which workers collected the lane's earlier rollouts. The arrays of a rollout are new each time and are
never written again, so they can be sent without a copy.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import cache
from time import perf_counter
from types import MappingProxyType

import numpy as np

from millrace.protocol.arrays import Floats
from millrace.protocol.bounds import Stages
from millrace.protocol.envs.kinds_of_copies import copies_kind
from millrace.protocol.envs.which_copy import EnvCopy
from millrace.protocol.messages import Permit, Weights
from millrace.protocol.policy.called_policy import CalledPolicy
from millrace.protocol.policy.masks import stored_leaves
from millrace.protocol.policy.policy import Policy
from millrace.protocol.random_streams import Purpose, RoundStreams, generator
from millrace.protocol.rollout import Rollout
from millrace.protocol.specs import RunSpec
from millrace.workers.acting import ActedRows, RolloutActions
from millrace.workers.copies.env_copies import EnvCopies, check_spaces
from millrace.workers.copies.env_errors import environment_failures
from millrace.workers.copies.env_loop import Pulse
from millrace.workers.copies.open_lanes import OpenLanes
from millrace.workers.copies.saved_state import packed
from millrace.workers.copies.value_checks import check_acted, check_observed, check_rewards
from millrace.workers.lanes.bring_back import bring_back
from millrace.workers.lanes.lane import Lane
from millrace.workers.lanes.rows import Rows, RowsOfLane
from millrace.workers.lanes.runner import LaneRunner, Part, TogetherSteps
from millrace.workers.opponents import KnownOpponents, Match, Opponents, OtherTeams

OpenEnvCopies = Callable[[RunSpec, int, Pulse], EnvCopies]
"""Makes the env copies of the lane with this number."""


def open_env_copies(run: RunSpec, lane: int, pulse: Pulse) -> EnvCopies:
    """The env copies of a lane in this process, of the kind that the run asks for."""
    copies: EnvCopies = copies_kind(run.vector).open(run, EnvCopy(lane * run.copies, lane), pulse)
    return copies


class Collector:
    """Collects rollouts. It opens a lane when it is asked for the lane's first rollout."""

    def __init__(
        self,
        run: RunSpec,
        policy: Policy | CalledPolicy,
        open_copies: OpenEnvCopies = open_env_copies,
        together: TogetherSteps | None = None,
    ) -> None:
        """`together` steps the env copies of all lanes at once, if one vector environment holds them all."""
        self.note = ""
        """what the user should know about the environment, once a lane has seen it"""
        self.env_attributes = b""
        """attributes that each env copy gets before its next rollout (`Weights.env_attributes`)"""
        self.lanes = OpenLanes[Lane]()
        """the lanes that were opened for a rollout and have not been closed"""
        self._run = run
        self._runner = LaneRunner(run, policy, together)
        self._open_copies = open_copies
        self._opponents = KnownOpponents(run)
        self._action_streams = cache(lambda lane: RoundStreams(run.seed, Purpose.ACTIONS, lane))
        self._ended_steps = 0  # env steps of rollouts that are complete or were dropped
        self._under_way: list[Rows] = []

    @property
    def stages(self) -> Stages:
        """Seconds spent opening lanes (making copies and their first reset), choosing actions and stepping copies."""
        return self._runner.stages

    @property
    def steps(self) -> int:
        """Number of env steps made, including those of running rollouts. A step that only resets a copy doesn't count."""
        return self._ended_steps + sum(rows.env_steps() for rows in self._under_way)

    def load(self, parameters: Floats, buffers: Floats) -> None:
        """Use these weights from now on."""
        self._runner.acting.load(parameters, buffers)

    def collect(
        self,
        permits: Sequence[Permit],
        version: int,
        session: int,
        pulse: Pulse,
        held: Mapping[int, Weights] = MappingProxyType({}),
    ) -> list[Rollout]:
        """Collect one rollout for each permit. Returns them in the order of the permits.

        Each permit must name a different lane. `held` has the available weights, by version, including those of new
        opponents. `pulse` is called at every step and may raise. If `pulse` raises, or an environment does
        (`EnvironmentFailed`), these lanes are closed and the unfinished rollouts are dropped.
        """
        if len({permit.lane for permit in permits}) < len(permits):
            raise ValueError(f"collect: expected one permit for each lane, got {permits}")
        with self.lanes.in_use():
            try:
                return self._collect(permits, version, session, pulse, self._opponents.among(held))
            except BaseException:
                self.lanes.close(permit.lane for permit in permits)
                raise

    def _collect(
        self, permits: Sequence[Permit], version: int, session: int, pulse: Pulse, opponents: Opponents
    ) -> list[Rollout]:
        lanes = [self._lane_for(permit, pulse) for permit in permits]
        for lane, permit in zip(lanes, permits, strict=True):  # rule ATTRIBUTES
            lane.set_attributes(self.env_attributes, pulse)
            self._meet(lane, permit, opponents)
        states = [lane.state if lane.seats is None else lane.seats.state_before(lane.state) for lane in lanes]
        drawn = [self._action_streams(each.lane).of(each.round) for each in permits]
        parts = [self._part(lanes[among], drawn[among]) for among in self._runner.together.parts(len(lanes))]
        self._under_way = [part.rows for part in parts]
        try:
            self._runner.run(parts, pulse)
        finally:
            self._ended_steps += sum(rows.env_steps() for rows in self._under_way)
            self._under_way = []
        filled = [(rows, part.actions.columns(i)) for part in parts for i, rows in enumerate(part.rows.of_lanes)]
        return [
            self._rollout(rows, state, acted, permit, version, session)
            for (rows, acted), state, permit in zip(filled, states, permits, strict=True)
        ]

    def _part(self, lanes: Sequence[Lane], drawn: Sequence[np.random.Generator]) -> Part[RolloutActions]:
        """These lanes as a part that is ready for its first step; `drawn` has a random generator for each lane."""
        return Part(Rows(self._run, lanes, self._run.rollout_steps), self._runner.acting.begin(drawn))

    def _lane_for(self, permit: Permit, pulse: Pulse) -> Lane:
        """The lane in this incarnation; opened here if it isn't open yet."""
        number = permit.lane
        incarnation = permit.incarnation
        if (lane := self.lanes.here(number, incarnation)) is not None:
            return lane
        run = self._run

        def made() -> Lane:
            with environment_failures(number, "made"):
                copies = self._open_copies(run, number, pulse)
            return Lane(run, copies, run.copies, number=number, incarnation=incarnation)

        began = perf_counter()
        lane = self.lanes.open(number, made)
        check_spaces(run, lane.copies)
        if permit.past is None:
            lane.set_attributes(self.env_attributes, pulse)
            lane.start([0] * run.copies, pulse)
        else:  # rule PAST
            actions = self._runner.acting.begin([self._action_streams(number).of(0)])
            self.note = bring_back(run, lane, permit.past, self.env_attributes, pulse, actions) or self.note
        self.note = self.note or lane.copies.note
        self.stages["open"] += perf_counter() - began
        return lane

    def _meet(self, lane: Lane, permit: Permit, opponents: Opponents) -> None:
        """Set the opponent of the episodes that begin in the next rollout, if the permit names one."""
        if permit.opponent is None:
            return
        run = self._run
        number = permit.lane
        lane.opponent = opponents(permit.opponent)
        if lane.others is None:
            lane.others = OtherTeams(run, [Match(run.team_of(number, n), lane.opponent) for n in range(run.copies)])
        lane.others.generator = generator(run.seed, Purpose.OPPONENTS, number, permit.round)

    def _rollout(
        self, rows: RowsOfLane, state: Floats, acted: ActedRows, permit: Permit, version: int, session: int
    ) -> Rollout:
        """The rollout of a lane, made of views of its rows. `state` is the policy's state before the first row."""
        lane = rows.lane
        masked = self._run.masked
        axes = self._run.row_axes
        check_observed(lane.number, stored_leaves(self._run), rows.obs, axes)
        reward = check_rewards(lane.number, rows.reward, axes)
        check_acted(lane.number, "action", acted.action, rows.obs, axes)
        check_acted(lane.number, "log_prob", acted.log_prob, rows.obs, axes)
        rows.pass_on()
        states = lane.save()
        self.note = self.note or lane.copies.note
        of_states = (np.frombuffer(packed(states), np.uint8),) if states else ()
        sent = lane.sent
        return Rollout(  # rules TICKETS, LANES, SEQUENCE
            session=session,
            lane=permit.lane,
            ticket=permit.ticket,
            version=version,
            sequence=permit.sequence,
            obs=tuple(array[:, sent] for array in (rows.obs[:-1] if masked else rows.obs)),
            action=acted.action[:, sent],
            log_prob=acted.log_prob[:, sent],
            reward=reward[:, sent],
            terminated=rows.terminated[:, sent],
            truncated=rows.truncated[:, sent],
            valid=rows.valid[:, sent],
            state=state[sent],
            episodes=tuple(each.episode for each in rows.ended),
            mask=rows.obs[-1][:, sent] if masked else None,
            extras=tuple(extra[:, sent] for extra in acted.extras),
            resets=None if lane.seats is None else rows.resets,
            begun=lane.begun(),
            memory=(*lane.memory(), *of_states),
            saved=tuple(range(len(states))),
        )
