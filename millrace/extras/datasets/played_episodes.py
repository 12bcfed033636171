"""Plays episodes with workers and keeps their rows. Each episode has a ticket of its own, and depends only on its seed."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from itertools import count
from typing import NamedTuple

import numpy as np

from millrace.extras.datasets.episodes import RecordedEpisode
from millrace.learner.policy_player import PolicyPlayer
from millrace.learner.rollouts.evaluation_dealer import EvaluationPlan, PlayedEpisode
from millrace.protocol.arrays import Array
from millrace.protocol.envs.env_actions import action_leaves_of
from millrace.protocol.messages import EpisodeRows
from millrace.protocol.random_streams import Purpose, env_seed

FIRST_EPISODES = 2  # number of episodes in the first plan, when their size isn't known yet
CHUNK_BYTES = 256 * 2**20  # approximate memory limit for the episodes of one plan
MOST_EPISODES = 256  # largest number of episodes in one plan


def recording_seeds(seed: int) -> Iterator[int]:
    """The reset seeds of a recording's episodes, one after another."""
    return (env_seed(seed, Purpose.RECORDING, episode) for episode in count())


class Played(NamedTuple):
    """An episode that workers played."""

    episode: RecordedEpisode
    result: PlayedEpisode
    """its return and length, and whether it was cut because it was too long"""
    frames: list[Array]
    """rendered frames [H, W, 3] uint8 of the first observations, if requested"""


class PlayedEpisodes:
    """Episodes of a policy, in the order of their seeds."""

    def __init__(self, player: PolicyPlayer, seeds: Iterable[int], *, stochastic: bool = False) -> None:
        """`seeds`: the reset seed of each episode. `stochastic`: sample actions from the policy; otherwise take the most
        probable ones.
        """
        self._player = player
        self._seeds = iter(seeds)
        self._stochastic = stochastic
        self._to_env_action = action_leaves_of(player.run.policy)
        self._episodes = self._steps = self._bytes = 0  # so far: episodes, their steps, and bytes of their observations

    def until(self, steps: int) -> Iterator[tuple[RecordedEpisode, bool]]:
        """Yield each episode, and whether it was cut, until the episodes have this number of steps in total.

        The last episode is finished, unless it would double the number of steps. Then it is cut, and its last step is marked
        as truncated.
        """
        taken = 0
        while taken < steps:
            for episode, result, _ in self.play(self._wanted(steps - taken), longest=2 * steps - taken):
                longest = 2 * steps - taken
                is_longer = episode.length > longest
                yield (_cut(episode, longest) if is_longer else episode), result.cut or is_longer
                taken += min(episode.length, longest)
                if taken >= steps:
                    break

    def play(self, number: int, longest: int, *, frames: bool = False) -> list[Played]:
        """Play the next episodes, of at most `longest` steps each. `frames`: also render. There must be enough seeds."""
        seeds = [next(self._seeds) for _ in range(number)]
        rows: list[list[EpisodeRows]] = [[] for _ in seeds]
        plan = EvaluationPlan(
            tuple(seeds),
            copies=1,
            most_steps=longest,
            greedy=not self._stochastic,
            send_rows=True,
            send_frames=frames,
        )
        results = self._player.play(plan, lambda n, some: rows[n].append(some), before=(self._episodes, self._steps))
        played = [
            Played(self._whole(some, seed), result, _frames(some))
            for some, seed, result in zip(rows, seeds, results, strict=True)
        ]
        self._episodes += number
        self._steps += sum(one.episode.length for one in played)
        self._bytes += sum(leaf.nbytes for one in played for leaf in one.episode.obs)
        return played

    def _wanted(self, steps: int) -> int:
        """Number of episodes to play next if this many steps are still needed."""
        if not self._episodes:
            return FIRST_EPISODES
        by_steps = -(-steps * self._episodes // self._steps)
        by_memory = CHUNK_BYTES * self._episodes // max(1, self._bytes)
        return max(1, min(by_steps, by_memory, MOST_EPISODES))

    def _whole(self, rows: Sequence[EpisodeRows], seed: int) -> RecordedEpisode:
        leaves = [[some.obs[i][bool(n) :] for n, some in enumerate(rows)] for i in range(len(rows[0].obs))]
        return RecordedEpisode(
            obs=tuple(np.concatenate(parts) for parts in leaves),
            action=self._to_env_action(np.concatenate([some.action for some in rows])),
            reward=np.concatenate([some.reward for some in rows]),
            terminated=np.concatenate([some.terminated for some in rows]),
            truncated=np.concatenate([some.truncated for some in rows]),
            seed=seed,
        )


def _frames(rows: Sequence[EpisodeRows]) -> list[Array]:
    return [frame for n, some in enumerate(rows) if some.frames is not None for frame in some.frames[bool(n) :]]


def _cut(episode: RecordedEpisode, length: int) -> RecordedEpisode:
    truncated = episode.truncated[:length].copy()
    truncated[-1] = True
    return RecordedEpisode(
        obs=tuple(leaf[: length + 1] for leaf in episode.obs),
        action=tuple(part[:length] for part in episode.action),
        reward=episode.reward[:length],
        terminated=episode.terminated[:length],
        truncated=truncated,
        seed=episode.seed,
    )
