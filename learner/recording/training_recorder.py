"""`--record`: writes the whole episodes of training as a Minari dataset."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium

from millrace.learner.recording.episodes import EpisodeAssembler
from millrace.learner.recording.minari import MinariDataset
from millrace.learner.rollouts.lanes import AcceptedRollout
from millrace.protocol.envs.action_masks import without_mask
from millrace.protocol.envs.description import DescribedEnv
from millrace.protocol.envs.env_actions import action_converter_of
from millrace.protocol.errors import RunError
from millrace.protocol.specs import RunSpec


class TrainingRecorder:
    """Writes every whole episode of training into a dataset, with the actions as they were taken.

    Steps of episodes that cannot be whole are counted instead.
    """

    def __init__(self, dataset_id: str, env: DescribedEnv, run: RunSpec, about: str) -> None:
        """`env`: the environment as a worker described it. `about`: the description of the dataset.

        Raises `UsageError`, with a one-line message, if the dataset cannot be made.
        """
        self._assembler = EpisodeAssembler(action_converter_of(run.policy))
        self._id = dataset_id
        self._episodes = 0
        self._dataset = MinariDataset(dataset_id, EnvironmentOfDataset(env, masked=run.masked), about)

    def add(self, rollouts: Sequence[AcceptedRollout]) -> None:
        """Add the rollouts of an update. Raises `RunError` if the dataset cannot be written; then it is removed."""
        for arrived in rollouts:
            for episode in self._assembler.add(arrived.rollout, arrived.incarnation):
                try:
                    self._dataset.add(episode)
                except RunError:
                    self._episodes = 0
                    self._dataset.discard()
                    raise
                self._episodes += 1

    def close(self) -> str:
        """Finish the dataset. Returns one line that describes it. Without a whole episode, no dataset is written.

        Raises `RunError` if it cannot be written; then it is removed.
        """
        if self._episodes:
            with self._dataset:
                pass  # leaving it writes the episodes that are still in memory
        else:
            self._dataset.discard()
        parts = self._assembler.waiting + self._assembler.left_out
        return f"dataset {self._id}: {self._episodes:,} training episodes; {parts:,} steps of others left out"


class EnvironmentOfDataset(gymnasium.Env[Any, Any]):
    """What Minari reads of an environment: its spaces and its spec. Nobody steps it."""

    def __init__(self, env: DescribedEnv, *, masked: bool = False) -> None:
        """`env`: the environment as a worker described it. `masked`: a mask in its observations is not recorded."""
        self.observation_space, self.action_space = env.observation_space, env.action_space
        if masked:
            self.observation_space = without_mask(env.observation_space, env.action_space)
        self.metadata, self.spec = env.metadata, env.spec
