"""`--record`: a callback that writes every whole episode of training into a Minari dataset.

Rule: the dataset contains the rollouts that updates have used. The rollouts of an update that is undone are not recorded,
    because a resumed run uses them, or collects them again. A resumed run makes another dataset. If the dataset can't be
    written, training continues. The dataset is then removed, and the run ends with an error.
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

    def __init__(self, dataset_id: str, env: DescribedEnv, run: RunSpec, name: str, resumed_at: int | None = None) -> None:
        """`env`: the environment as a worker described it. `name`: the run's name.

        `resumed_at`: the number of env steps at which the run was resumed; None for a new run. If a resumed run finds a
        dataset with this id, it takes the next free version. Raises `UsageError`, with a one-line message, if the dataset
        cannot be made.
        """
        resumed = resumed_at is not None
        self._assembler = EpisodeAssembler(action_leaves_of(run.policy))
        self._episodes = 0
        since = f" that began after it was resumed at {resumed_at:,} env steps" if resumed else ""
        about = f"All whole training episodes of millrace run {name}{since}, as acted."
        env_of_dataset = EnvironmentOfDataset(env, masked=run.masked)
        self._dataset = MinariDataset(dataset_id, env_of_dataset, about, free_version=resumed)
        if self._dataset.id != dataset_id:
            log.warning("dataset %s is there already: episodes from now on go to %s", dataset_id, self._dataset.id)
        self._gathered: Progress | None = None  # the newest rollouts, until an update has used them
        self._refused: RunError | None = None

    def on_rollouts(self, progress: Progress) -> None:
        """Keep the rollouts until an update has used them."""
        self._record(progress.updates)
        self._gathered = progress

    def on_update(self, progress: Progress) -> None:
        """Add the rollouts of this update."""
        self._record(progress.updates)

    def _record(self, updates: int) -> None:
        """Add the kept rollouts if the run has made the update that uses them. `updates` is the run's number of updates."""
        gathered = self._gathered
        self._gathered = None
        if gathered is None or gathered.updates == updates or self._refused is not None:
            return
        try:
            for arrived in zip(gathered.rollouts, gathered.incarnations, gathered.fresh, strict=True):
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
        self._record(progress.updates)  # another callback may have raised before `on_update` was called here
        if self._refused is None:
            self._finish()
        elif not progress.cut_short:
            raise self._refused

    def _finish(self) -> None:
        if self._episodes:
            with self._dataset:
                pass  # leaving the context writes the episodes that are still in memory
        parts = self._assembler.waiting + self._assembler.left_out
        log.warning(f"dataset {self._dataset.id}: {self._episodes:,} training episodes; {parts:,} steps of others left out")


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
