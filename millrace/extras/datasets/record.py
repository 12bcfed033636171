"""`millrace.record`, `Run.record` and the command `record`: episodes of a run's policy, played by workers, as a dataset.

Rule: a keyword of the function is the flag of the command, by the same name and with the same default.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Unpack

from millrace.arguments import checked
from millrace.extras.datasets.recording import record_episodes
from millrace.keywords import RecordKeywords
from millrace.launch.policy_workers import policy_player
from millrace.learner.run_folder.results import RecordedDataset
from millrace.play_flags import RecordFlags
from millrace.playing import Given, ShowPlayed, flags_of, playing_workers, policy_to_play
from millrace.protocol.env_spec import EnvLike
from millrace.protocol.envs.wrappers import WrapperLike
from millrace.protocol.errors import UsageError
from millrace.terminal import count_line


@checked
def record(
    run: str | os.PathLike[str],
    out: str,
    steps: int = 50_000,
    *,
    env: EnvLike | None = None,
    wrappers: Sequence[WrapperLike] | None = None,
    progress: bool = True,
    **keywords: Unpack[RecordKeywords],
) -> RecordedDataset:
    """Write episodes of a run's policy as a Minari dataset, as `millrace record` does. It needs the extra `record`.

    Arguments:
        run: A `Run`, or a run folder.
        out: Id of the dataset, as `cartpole/expert-v0`. It is written to MINARI_DATASETS_PATH, or to ~/.minari/datasets.
        steps: Number of env steps. The last episode is finished, unless that would take more than twice as many.
        env: The environment that the run was started with, if it is not found by its name: it was made in another script or
            notebook. (`Run.record` of the `Run` that `train` returned knows it.)
        wrappers: Likewise the wrappers.
        progress: Show how far it is.
        **keywords: The flags of `millrace record`: `stochastic`, to sample actions; `npy`, a file for rows of observation
            and action; `seed`, `best`, `workers`, `transport`, `bind`, `inference` and `max_env_failures`.

    Returns a `RecordedDataset`: `dataset_id`, `episodes`, `steps`, `return_mean`, `return_std` and `cut`. It does not depend
    on the number of workers. Raises `UserFacingError` with a message of one line; then it leaves no files.

    >>> import millrace
    >>> millrace.record(run, "cartpole/example-v0", steps=20, workers=1).dataset_id
    'cartpole/example-v0'
    """
    flags = flags_of(RecordFlags, "record", run=Path(run), out=out, steps=steps, **keywords)
    with count_line("recording", show=progress) as watch:
        return write_dataset(flags, watch, Given(env, wrappers))


def write_dataset(flags: RecordFlags, watch: ShowPlayed, given: Given | None = None) -> RecordedDataset:
    """Write a dataset. Raises `UserFacingError`, or `KeyboardInterrupt` if the user stops it; then it leaves no files."""
    saved = policy_to_play(flags, given)
    for found, why in ((saved.seats, f"{saved.env.id} has several agents"), (saved.spec.critic, "the run has critic_keys")):
        if found:
            raise UsageError(f"record: {why}, which a dataset has not")
    with policy_player(saved, playing_workers(flags, flags.workers, 1), watch) as player:
        return record_episodes(
            player, flags.run, flags.out, flags.steps, flags.seed, stochastic=flags.stochastic, npy=flags.npy
        )
