"""Writes episodes of a run's policy as a Minari dataset, and optionally also as a .npy file of rows.

Rule: a dataset consists of whole episodes with raw rewards. It is complete, or doesn't exist. It contains episodes in the
order of their seeds, so that short episodes aren't favored; each seed is stored with its episode. The last episode is
finished, so a dataset may have more steps than requested. If this would double the number of steps, the episode is cut, and
its last step is marked as truncated.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from millrace.extras.datasets.minari import MinariDataset
from millrace.extras.datasets.npy_rows import NpyRows
from millrace.extras.datasets.played_episodes import PlayedEpisodes, recording_seeds
from millrace.extras.datasets.training_recorder import EnvironmentOfDataset
from millrace.learner.policy_player import PolicyPlayer
from millrace.learner.run_folder.results import RecordedDataset
from millrace.protocol.errors import UsageError


def record_episodes(
    player: PolicyPlayer,
    run: Path,
    dataset_id: str,
    steps: int,
    seed: int,
    *,
    stochastic: bool = False,
    npy: Path | None = None,
) -> RecordedDataset:
    """Let the workers of `player` play this run folder's policy, and write a dataset of at least `steps` env steps.

    `stochastic`: sample actions from the policy; otherwise take the most probable ones. `npy`: also write this file. If this
    fails, it raises `UserFacingError` and leaves no files behind.
    """
    if npy is not None and not npy.parent.is_dir():
        raise UsageError(f"{npy} cannot be written: no such folder {npy.parent}")
    env = EnvironmentOfDataset(player.describe(), masked=player.run.masked)
    how = "drawn from" if stochastic else "the most probable of"
    about = f"Actions {how} the policy of millrace run {run.resolve().name}; seed {seed}."
    returns: list[float] = []
    taken = cut = 0
    with MinariDataset(dataset_id, env, about) as dataset, NpyRows(npy) as rows:
        for episode, was_cut in PlayedEpisodes(player, recording_seeds(seed), stochastic=stochastic).until(steps):
            dataset.add(episode)
            rows.add(episode)
            returns.append(episode.episode_return)
            taken += episode.length
            cut += was_cut
        dataset.close()  # before the rows are written, so that the dataset is removed if that fails
    return RecordedDataset(
        dataset_id=dataset_id,
        episodes=len(returns),
        steps=taken,
        return_mean=float(np.mean(returns)),
        return_std=float(np.std(returns)),
        cut=cut,
    )
