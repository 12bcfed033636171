"""Reads a Minari dataset as batches from which an algorithm can learn. Minari is an optional dependency.

Rule: a dataset is used only if its observations and actions are those of the run's policy, and if all of its numbers are
finite and of their spaces. Each episode becomes one batch with a single column, so its rows follow the row format and no row
is left out.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from protocol.arrays import Array
from protocol.bounds import one_line
from protocol.envs.spaces import action_spec, make_flatten, observation_leaves, stored_actions_of
from protocol.errors import UsageError, first_line
from protocol.rollout import Batch
from protocol.rows.array_checks import wrong_values
from protocol.specs import PolicySpec

NO_LANE = -1  # `Batch.lane` of prior data


class PriorDataset:
    """A Minari dataset from the folder that MINARI_DATASETS_PATH names, checked against the policy of a run."""

    def __init__(self, dataset_id: str, policy: PolicySpec) -> None:
        """Raises `UsageError` if there is no such dataset, if it does not fit the policy, or if Minari is not installed."""
        self._id, self._policy = dataset_id, policy
        self._dataset = _open(dataset_id)
        self._check_spaces()
        self.rows = int(self._dataset.total_steps)
        """number of transitions"""
        self.episodes = int(self._dataset.total_episodes)
        if not self.rows:
            raise UsageError(f"prior {dataset_id}: expected transitions, got an empty dataset")

    def batches(self) -> Iterator[Batch]:
        """One batch for each episode, in the order of the dataset. Raises `UsageError` if an episode cannot be used."""
        flatten = make_flatten(self._dataset.observation_space)
        to_stored = stored_actions_of(self._policy)
        for episode in self._dataset.iterate_episodes():
            leaves = zip(flatten(episode.observations), self._policy.observation, strict=True)
            yield self._batch(
                int(episode.id),
                tuple(np.asarray(array).astype(leaf.dtype, copy=False)[:, None] for array, leaf in leaves),
                to_stored(np.asarray(episode.actions))[:, None],
                np.asarray(episode.rewards, np.float32)[:, None],
                np.asarray(episode.terminations, bool)[:, None],
                np.asarray(episode.truncations, bool)[:, None],
            )

    def _batch(
        self, number: int, obs: tuple[Array, ...], action: Array, reward: Array, terminated: Array, truncated: Array
    ) -> Batch:
        """An episode [T, 1] as a batch. Its last row ends the episode, whatever the dataset says: no row follows it."""
        T = len(reward)
        where = f"prior {self._id}: episode {number}"
        if any(len(leaf) != T + 1 for leaf in obs) or len(action) != T:
            raise UsageError(f"{where}: expected {T + 1} observations and {T} actions, got {len(obs[0])} and {len(action)}")
        leaves = [(leaf.name, array, leaf) for leaf, array in zip(self._policy.observation, obs, strict=True)]
        for name, array, space in [("reward", reward, None), ("action", action, self._policy.action), *leaves]:
            if why := wrong_values(array, space, axes=("step",)):
                raise UsageError(f"{where}: {name}: {why}")
        if (terminated | truncated)[:-1].any():
            raise UsageError(
                f"{where}: expected an end in its last step alone, got one in step {int((terminated | truncated).argmax())}"
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
            copies=1,
            episodes=(),
        )

    def _check_spaces(self) -> None:
        dataset, policy = self._dataset, self._policy
        for what, expected, got in (
            ("observations", policy.observation, observation_leaves(dataset.observation_space)),
            ("actions", (policy.action,), (action_spec(dataset.action_space),)),
        ):
            if expected != got:
                raise UsageError(
                    f"prior {self._id}: {what}: expected {one_line(str(expected))}, got {one_line(str(got))}; "
                    "the dataset must be of the same environment"
                )


def _open(dataset_id: str) -> Any:
    try:
        import h5py  # noqa: F401
        import minari
    except ImportError as error:
        raise UsageError("--prior needs minari; pip install 'minari[hdf5]'") from error
    try:
        return minari.load_dataset(dataset_id)
    except FileNotFoundError:
        have = ", ".join(sorted(minari.list_local_datasets())[:5]) or "none"
        raise UsageError(
            f"prior {dataset_id}: no such dataset here; there are: {have}. `minari download` gets others"
        ) from None
    except Exception as error:
        raise UsageError(
            f"prior {dataset_id}: it cannot be read: {one_line(first_line(error, type(error).__name__))}"
        ) from error
