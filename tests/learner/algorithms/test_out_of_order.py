"""Rollouts of a lane that are used in another order than collected: nothing joins what does not belong together."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

from millrace.learner.algorithms.replay.replay_buffer import ReplayBuffer
from millrace.learner.algorithms.running_statistics import RewardScaler, RunningMoments
from millrace.learner.rollouts.lane_history import LaneHistories
from millrace.learner.rollouts.lanes import TicketedLane
from millrace.protocol.messages import Permit
from millrace.protocol.policy.policy import make_policy
from millrace.protocol.rollout import Batch, Rollout, stack_rollouts
from millrace.protocol.specs import RunSpec
from millrace.workers.collect.collector import Collector
from tests.support.in_process.collectors import random_weights, run_of

GAMMA, N_STEP = 0.9, 3
ORDER = (0, 2, 1, 3, 4)  # 3 follows 1 and continues nothing; 4 continues 3
CHAINS = ((0,), (2,), (1,), (3, 4))


def collected(run: RunSpec) -> list[Rollout]:
    """Rollouts of lane 0 in the order in which they were collected."""
    policy = make_policy(run.policy)
    policy.load(*random_weights(run.policy))
    collector = Collector(run, policy)
    found = [collector.collect([Permit(n, 0, 0, n, n)], 0, 1, lambda: None)[0] for n in range(len(ORDER))]
    collector.lanes.close_all()
    return found


HISTORIES = LaneHistories(copies=2, most_steps=1000)


def batches(rollouts: Sequence[Rollout], split: Sequence[int]) -> list[Batch]:
    """Batches of so many rollouts, used in `ORDER` and marked as the coordinator marks them."""
    lane, found, at = TicketedLane(0), list[Batch](), 0
    for count in split:
        used = [rollouts[n] for n in ORDER[at : at + count]]
        found.append(stack_rollouts(used, [lane.take(0, rollout, b"", HISTORIES, from_past=False) for rollout in used]))
        at += count
    return found


def transitions(run: RunSpec, added: Sequence[Batch]) -> set[bytes]:
    """All n-step transitions of a replay buffer to which these batches were added."""
    replay = ReplayBuffer(run.policy.observation, size=500, n_step=N_STEP, gamma=GAMMA, seed=1)
    for batch in added:
        replay.add(batch)
    sample = replay.sample(100 * len(replay))
    columns = (*sample.leaves, sample.action, sample.reward, sample.discount, *sample.next_leaves)
    found = {b"".join(np.ascontiguousarray(column[n]).tobytes() for column in columns) for n in range(len(sample.slots))}
    assert len(found) == len(replay), "some transitions were not drawn"
    return found


@pytest.mark.parametrize("split", [(1, 1, 1, 1, 1), (1, 2, 2), (3, 2), (5,)])
def test_replay_joins_only_what_follows(split: tuple[int, ...]) -> None:
    run = run_of("CartPole-v1", T=8, N=2)
    rollouts = collected(run)
    chains = [
        stack_rollouts([rollouts[n]], [n == chain[0]]) for chain in CHAINS for n in chain
    ]  # each is joined to the one before it in its chain
    assert transitions(run, batches(rollouts, split)) == transitions(run, chains)
    whole = [stack_rollouts([rollout]) for rollout in rollouts]
    assert transitions(run, whole) != transitions(run, chains), "nothing is joined over rollouts, so this shows nothing"


@pytest.mark.parametrize("split", [(1, 1, 1, 1, 1), (1, 2, 2), (3, 2), (5,)])
def test_the_reward_scale_continues_only_returns_that_follow(split: tuple[int, ...]) -> None:
    run = run_of("CartPole-v1", T=8, N=2)
    rollouts = collected(run)
    scaler, expected = RewardScaler(GAMMA), RunningMoments()
    for batch in batches(rollouts, split):
        scaler.count_and_scale(batch)
    for chain in CHAINS:
        now = np.zeros(run.copies)
        for n in chain:
            rollout = rollouts[n]
            for reward, valid, ends in zip(
                rollout.reward, rollout.valid, rollout.terminated | rollout.truncated, strict=True
            ):
                now = np.where(valid, GAMMA * now + reward, now)
                expected.update(now[valid])
                now = np.where(ends, 0, now)
    moments = scaler.state_dict()["moments"]
    assert moments["count"] == expected.count
    assert float(moments["mean"]) == pytest.approx(float(expected.mean), rel=1e-6)
    assert float(moments["squares"]) == pytest.approx(float(expected.state_dict()["squares"]), rel=1e-6)
    unmarked = RewardScaler(GAMMA)
    for n in ORDER:
        unmarked.count_and_scale(stack_rollouts([rollouts[n]]))
    assert unmarked.state_dict()["moments"]["mean"] != moments["mean"], "the marks change nothing, so this shows nothing"
