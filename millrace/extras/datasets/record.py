"""`millrace.record` and the command `record`: workers play episodes with a run's policy, which are written as a dataset."""

from __future__ import annotations

from millrace.extras.datasets.recording import record_episodes
from millrace.launch.policy_workers import policy_player
from millrace.learner.run_folder.results import RecordedDataset
from millrace.play_flags import RecordFlags
from millrace.playing import Given, ShowPlayed, playing_workers, policy_to_play
from millrace.protocol.errors import UsageError


def write_dataset(flags: RecordFlags, watch: ShowPlayed, given: Given | None = None) -> RecordedDataset:
    """Write the dataset.

    Raises `UserFacingError` if this fails, or `KeyboardInterrupt` if the user interrupts it. In both cases, no files are
    left behind.
    """
    saved = policy_to_play(flags, given)
    for found, why in (
        (saved.card.seats, f"{saved.env.id} has several agents"),
        (saved.card.policy.critic, "the run has critic_keys"),
    ):
        if found:
            raise UsageError(f"record: {why}, which a dataset can't have")
    with policy_player(saved, playing_workers(flags, flags.workers, 1), watch) as player:
        return record_episodes(
            player, flags.run, flags.out, flags.steps, flags.seed, stochastic=flags.stochastic, npy=flags.npy
        )
