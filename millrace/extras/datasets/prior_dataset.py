"""Reads a Minari dataset as batches from which an algorithm can learn. Minari is an optional dependency.

Rule: a dataset is used only if it has the spaces of the run's policy, and if all of its numbers are finite and in these
spaces. Each episode becomes one batch with a single column, so its rows follow the row format and no row is left out.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from millrace.extras.datasets.dataset_files import DatasetFiles
from millrace.learner.algorithms.prior_data import PriorData
from millrace.protocol.arrays import Array
from millrace.protocol.bounds import one_line
from millrace.protocol.envs.env_actions import stored_actions_of
from millrace.protocol.errors import UsageError
from millrace.protocol.rollout import Batch
from millrace.protocol.rows.array_checks import wrong_values
from millrace.protocol.specs import PolicySpec

NO_LANE = -1  # `Batch.lane` of prior data


class PriorDataset(PriorData):
    """A Minari dataset from the folder that MINARI_DATASETS_PATH names, checked against a run's policy."""

    def __init__(self, dataset_id: str, policy: PolicySpec) -> None:
        """Raises `UsageError` if there is no such dataset, if it does not fit the policy, or if Minari is not installed."""
        self._id = dataset_id
        self._policy = policy
        self._files = _open(dataset_id)
        self._check_spaces()
        if not self.rows:
            raise UsageError(f"prior {dataset_id}: expected transitions, got an empty dataset")

    @property
    def rows(self) -> int:
        """Number of transitions."""
        return self._files.rows

    @property
    def episodes(self) -> int:
        """Number of episodes."""
        return self._files.episodes

    def batches(self) -> Iterator[Batch]:
        """One batch for each episode, in the order of the dataset. Raises `UsageError` if an episode cannot be used."""
        to_stored = stored_actions_of(self._policy)
        for episode in self._files.read_episodes():
            yield self._batch(
                episode.number,
                tuple(leaf[:, None] for leaf in episode.obs),
                to_stored(episode.action)[:, None],
                episode.reward[:, None],
                episode.terminated[:, None],
                episode.truncated[:, None],
            )

    def _batch(
        self, number: int, obs: tuple[Array, ...], action: Array, reward: Array, terminated: Array, truncated: Array
    ) -> Batch:
        """An episode of arrays [T, 1, …] as a batch. Its last row always ends the episode, because no row follows it."""
        T = len(reward)
        where = f"prior {self._id}: episode {number}"
        leaves = [(leaf.name, array, leaf) for leaf, array in zip(self._policy.observation, obs, strict=True)]
        for name, array, space in [("reward", reward, None), ("action", action, self._policy.action), *leaves]:
            if why := wrong_values(array, space, axes=("step",)):
                raise UsageError(f"{where}: {name}: {why}")
        if (terminated | truncated)[:-1].any():
            raise UsageError(
                f"{where}: expected an end only in its last step, got one in step {int((terminated | truncated).argmax())}"
            )
        truncated = truncated.copy()
        truncated[-1] |= ~terminated[-1]
        return Batch(
            obs=obs,
            action=action,
            log_prob=np.zeros((T, 1), np.float32),
            reward=reward,
            terminated=terminated,
            truncated=truncated,
            valid=np.ones((T, 1), bool),
            state=np.zeros((1, self._policy.state_size), np.float32),
            lane=np.array([NO_LANE]),
            fresh=np.array([True]),
            columns_per_rollout=1,
            episodes=(),
        )

    def _check_spaces(self) -> None:
        files = self._files
        policy = self._policy
        for what, expected, got in (
            ("observations", policy.observation, files.observation),
            ("actions", (policy.action,), (files.action,)),
        ):
            if expected != got:
                raise UsageError(
                    f"prior {self._id}: {what}: expected {one_line(str(expected))}, got {one_line(str(got))}; "
                    "the dataset must be of the same environment"
                )


def _open(dataset_id: str) -> DatasetFiles:
    from minari.storage import get_dataset_path

    folder = get_dataset_path(dataset_id) / "data"
    if not os.path.lexists(folder):
        have = ", ".join(sorted(_ids(get_dataset_path()))[:5]) or "none"
        raise UsageError(f"prior {dataset_id}: no such dataset here; there are: {have}. `minari download` gets others")
    return DatasetFiles(f"prior {dataset_id}", folder)


def _ids(root: Path) -> Iterator[str]:
    """The ids of the datasets in this folder. Their files aren't read."""
    for folder, inside, _ in os.walk(root):
        if "data" in inside:
            inside.clear()
            yield Path(folder).relative_to(root).as_posix()
