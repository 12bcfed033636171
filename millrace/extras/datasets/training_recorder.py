"""`--record`: a callback that writes every whole episode of training into a Minari dataset.

Rule: if the dataset can't be written, training doesn't stop. The dataset is removed, and the run fails when it has ended.
"""

from __future__ import annotations

import logging
from typing import Any

import gymnasium

from millrace.extras.datasets.episodes import EpisodeAssembler
from millrace.extras.datasets.minari import MinariDataset
from millrace.learner.callbacks.callback import Callback
from millrace.learner.run_folder.progress import Progress
from millrace.protocol.envs.action_masks import without_mask
from millrace.protocol.envs.description import DescribedEnv
from millrace.protocol.envs.env_actions import action_leaves_of
from millrace.protocol.errors import RunError
from millrace.protocol.specs import RunSpec

log = logging.getLogger("millrace.learner")


class TrainingRecorder(Callback):
    """Writes every whole episode of training into a dataset, with the actions that the environment took.

    Steps of incomplete episodes are only counted. If no episode is whole, no dataset is written.
    """

    def __init__(self, dataset_id: str, env: DescribedEnv, run: RunSpec, about: str) -> None:
        """`env`: the environment as a worker described it. `about`: the description of the dataset.

        Raises `UsageError`, with a one-line message, if the dataset cannot be made.
        """
        self._assembler = EpisodeAssembler(action_leaves_of(run.policy))
        self._id = dataset_id
        self._episodes = 0
        self._dataset = MinariDataset(dataset_id, EnvironmentOfDataset(env, masked=run.masked), about)
        self._refused: RunError | None = None

    def on_rollouts(self, progress: Progress) -> None:
        """Add the rollouts of an update."""
        if self._refused is not None:
            return
        try:
            for arrived in zip(progress.rollouts, progress.incarnations, progress.fresh, strict=True):
                for episode in self._assembler.add(*arrived):
                    self._dataset.add(episode)
                    self._episodes += 1
        except RunError as error:
            log.warning("%s; it is removed, and training continues", error)
            self._dataset.discard()
            self._refused = error

    def on_end(self, progress: Progress) -> None:
        """Finish the dataset, and log one line that describes it.

        If the dataset couldn't be written, now or earlier, it is removed. Then raises `RunError`, unless something else
        ended the run.
        """
        if self._refused is None:
            self._finish()
        elif not progress.cut_short:
            raise self._refused

    def _finish(self) -> None:
        if self._episodes:
            with self._dataset:
                pass  # leaving the context writes the episodes that are still in memory
        parts = self._assembler.waiting + self._assembler.left_out
        log.warning(f"dataset {self._id}: {self._episodes:,} training episodes; {parts:,} steps of others left out")


class EnvironmentOfDataset(gymnasium.Env[Any, Any]):
    """The part of an environment that Minari reads: its spaces and its spec. It is never stepped."""

    def __init__(self, env: DescribedEnv, *, masked: bool = False) -> None:
        """`env`: the environment as a worker described it. `masked`: leave out the action mask in its observations."""
        self.observation_space = env.observation_space
        self.action_space = env.action_space
        if masked:
            self.observation_space = without_mask(env.observation_space, env.action_space)
        self.metadata = env.metadata
        self.spec = env.spec
