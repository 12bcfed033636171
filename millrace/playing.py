"""`evaluate` and `record`: the functions in Python, and what they share with the commands of the same names.

Rule: each keyword of the function is a flag of the command with the same name and default. Worker processes play
the episodes; the caller's process runs no environment code.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple, TypedDict, TypeVar, Unpack

import msgspec

from millrace.arguments import checked
from millrace.flags.fields import fields_of
from millrace.flags.values import convert, with_whole_numbers
from millrace.keywords import EvaluateKeywords, RecordKeywords
from millrace.launch.policy_workers import PlayingWorkers, policy_player
from millrace.learner.config.config import Config
from millrace.learner.config.rollout_config import RolloutConfig
from millrace.learner.extras import started_by
from millrace.learner.policy_player import PolicyPlayer, SavedPolicy, saved_policy, useful_workers
from millrace.learner.rollouts.evaluation_dealer import EvaluationPlan, evaluation_of
from millrace.learner.run_folder.results import Evaluation, RecordedDataset
from millrace.learner.run_folder.run_folder import RunFolder, Which
from millrace.learner.run_folder.run_format import CONFIG_FILE, read_config
from millrace.play_flags import EvaluateFlags, PlayFlags, RecordFlags
from millrace.protocol.bounds import Count, Natural
from millrace.protocol.env_spec import EnvLike
from millrace.protocol.envs.wrappers import WrapperLike
from millrace.protocol.errors import UsageError, did_you_mean
from millrace.terminal import count_line

WORKERS = 2  # worker processes that play, unless a flag or the run's limit on env copies says otherwise
NOT_KEYWORDS = ("wrappers",)  # Python code may pass objects for these flags, so functions declare parameters for them
ShowPlayed = Callable[[str], None]
"""Takes the progress as text, and shows it."""
_Flags = TypeVar("_Flags", bound=PlayFlags)
RecordVideos = Callable[[PolicyPlayer, Path, int, int, int, str], tuple[Evaluation, list[Path]]]
"""Takes the player, run folder, episodes, seed, max_steps, and the prefix of the videos' file names. Returns the evaluation
and the paths of the videos.
"""


class SettingsOfRun(msgspec.Struct, frozen=True):
    """The settings of a run that also apply to the episodes that are played later. The names are those in config.toml."""

    eval_copies: Count = Config().eval_copies
    max_env_copies: Natural = 0
    start_timeout_s: float = RolloutConfig().start_timeout_s
    step_timeout_s: float = RolloutConfig().step_timeout_s

    @staticmethod
    def read(run: Path) -> SettingsOfRun:
        """Read them from a run folder. If it contains only a policy, they have their defaults.

        Raises `UsageError` if config.toml can't be read.
        """
        if not (run / CONFIG_FILE).is_file():
            return SettingsOfRun()
        try:
            return msgspec.convert(read_config(run), SettingsOfRun)
        except msgspec.ValidationError as error:
            raise UsageError(f"{run / CONFIG_FILE} is damaged: {error}; restore it") from error

    def copies(self) -> int:
        """How many episodes a worker plays at the same time."""
        return min(self.eval_copies, self.max_env_copies or self.eval_copies)

    def workers(self, copies: int) -> int:
        """How many workers play, each with this many copies, so that the run's limit on env copies is kept."""
        return max(1, min(WORKERS, self.max_env_copies // copies)) if self.max_env_copies else WORKERS


class Given(NamedTuple):
    """The environment and the wrappers to use in place of those that the run stores by name; None: use the stored ones."""

    env: EnvLike | None = None
    wrappers: Sequence[WrapperLike] | None = None


WriteDataset = Callable[[RecordFlags, ShowPlayed, Given], RecordedDataset]


class ShownKeywords(TypedDict, total=False):
    """Keywords of `Run.evaluate` and `Run.record` that aren't flags of the commands."""

    env: EnvLike | None
    wrappers: Sequence[WrapperLike] | None
    progress: bool


class RunEvaluateKeywords(EvaluateKeywords, ShownKeywords, total=False):
    """Keywords of `Run.evaluate`."""


class RunRecordKeywords(RecordKeywords, ShownKeywords, total=False):
    """Keywords of `Run.record`."""


@checked
def evaluate(
    run: str | os.PathLike[str],
    episodes: int | None = None,
    *,
    env: EnvLike | None = None,
    wrappers: Sequence[WrapperLike] | None = None,
    progress: bool = True,
    **keywords: Unpack[EvaluateKeywords],
) -> Evaluation:
    """Play greedy episodes of a run's policy with worker processes, as `millrace evaluate` does.

    Arguments:
        run: A `Run`, or a run folder.
        episodes: Number of episodes; by default 100, or 3 with `video`.
        env: The environment that the run was started with, if it can't be found by its name because it was made in another
            script or notebook. (The `Run` that `train` returned knows its environment, so its `evaluate` doesn't need it.)
        wrappers: The wrappers that the run was started with, if they can't be found by their names either.
        progress: Show the progress.
        **keywords: The flags of `millrace evaluate`: `seed`, the episodes' seed; `best`, to use the policy with the best
            evaluation during the run instead of the newest; `against`, the run folder of a policy that plays the other teams
            of a game; `workers`, the number of worker processes, and `copies`, the number of episodes that each plays at the
            same time; `max_steps`, the limit on the env steps of all episodes together; `video`, to record the episodes as
            videos; `transport`, `bind`, `inference` and `max_env_failures`.

    Returns an `Evaluation`: `return_mean`, `return_std`, `length_mean`, `episodes` and `cut`. The result does not depend on
    the number of workers. If this fails, raises `UserFacingError` with a one-line message.

    >>> import millrace
    >>> result = millrace.evaluate(run, episodes=2, workers=1)
    >>> result.episodes, result.cut
    (2, 0)
    """
    flags = flags_of(EvaluateFlags, "evaluate", run=Path(run), episodes=episodes, **keywords)
    with count_line("evaluating", show=progress) as watch:
        return play(flags, watch, Given(env, wrappers))[0]


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
    """Write episodes of a run's policy as a Minari dataset, as `millrace record` does. This needs the pip extra `record`.

    Arguments:
        run: A `Run`, or a run folder.
        out: Id of the dataset, such as `cartpole/expert-v0`. It is written to MINARI_DATASETS_PATH, or to
            ~/.minari/datasets.
        steps: Number of env steps. The last episode is finished, unless that would take more than twice this number.
        env: The environment that the run was started with, if it can't be found by its name because it was made in another
            script or notebook. (The `Run` that `train` returned knows its environment, so its `record` doesn't need it.)
        wrappers: The wrappers that the run was started with, if they can't be found by their names either.
        progress: Show the progress.
        **keywords: The flags of `millrace record`: `stochastic`, to sample actions; `npy`, a file to which each step is also
            written as a row of observation and action; `seed`, `best`, `workers`, `transport`, `bind`, `inference` and
            `max_env_failures`.

    Returns a `RecordedDataset`: `dataset_id`, `episodes`, `steps`, `return_mean`, `return_std` and `cut`. The dataset does
    not depend on the number of workers. If this fails, raises `UserFacingError` with a one-line message, and leaves no files
    behind.

    >>> import millrace
    >>> millrace.record(run, "cartpole/example-v0", steps=20, workers=1).dataset_id
    'cartpole/example-v0'
    """
    flags = flags_of(RecordFlags, "record", run=Path(run), out=out, steps=steps, **keywords)
    with count_line("recording", show=progress) as watch:
        write: WriteDataset = started_by("millrace.record")
        return write(flags, watch, Given(env, wrappers))


def flags_of(kind: type[_Flags], name: str, **keywords: Any) -> _Flags:
    """Make a record of type `kind` from these keyword arguments. Raises a `UsageError` that names the wrong keyword.

    `name`: the function that was called, for errors.
    """
    fields = fields_of(kind)
    for keyword in keywords:
        if keyword not in fields or keyword in NOT_KEYWORDS:
            raise UsageError(f"{name}: unknown keyword {keyword}{did_you_mean(keyword, fields)}")
    values = {keyword: with_whole_numbers(fields[keyword], value) for keyword, value in keywords.items()}
    return convert(values, kind, {keyword: f"{name}: {keyword}" for keyword in keywords})


def play(flags: EvaluateFlags, watch: ShowPlayed, given: Given | None = None) -> tuple[Evaluation, list[Path]]:
    """Play greedy episodes. Returns their evaluation and the paths of the videos, if any.

    Raises `UserFacingError` if this fails, or `KeyboardInterrupt` if the user interrupts it.
    """
    episodes = flags.episodes if flags.episodes is not None else 3 if flags.video else 100
    record_videos: RecordVideos | None = None
    if flags.video:
        if flags.inference == "learner":
            raise UsageError("video: expected inference workers, got learner; only a worker that acts renders its episodes")
        record_videos = started_by("video")()
    saved = policy_to_play(flags, given)
    of_run = SettingsOfRun.read(flags.run)
    copies = 1 if flags.video else flags.copies or of_run.copies()
    count = useful_workers(flags.workers or of_run.workers(copies), episodes, copies)
    workers = playing_workers(flags, count, min(copies, episodes), of_run)
    if flags.against is not None:
        saved = saved._replace(against=RunFolder.open_policy(flags.against).read_policy(_which(flags)))
    with policy_player(saved, workers, watch) as player:
        if record_videos is not None:
            prefix = "" if flags.against is None else f"against-{flags.against.resolve().name}-"
            return record_videos(player, flags.run, episodes, flags.seed, flags.max_steps, prefix)
        played = player.play(EvaluationPlan.of(episodes, flags.seed, copies, flags.max_steps), bound="--max-steps:")
        return evaluation_of(played, player.run.facts), []


def playing_workers(flags: PlayFlags, count: int | None, copies: int, of_run: SettingsOfRun | None = None) -> PlayingWorkers:
    """`count` local workers that play the episodes, or workers that join from elsewhere at `flags.bind`.

    If `count` is None, it is derived from the run's settings. The timeouts are those of the run. `of_run`: the run's
    settings, if they have been read already.

    `copies`: see `PlayingWorkers.copies`.
    """
    of_run = of_run or SettingsOfRun.read(flags.run)
    settings = RolloutConfig(
        max_env_failures=flags.max_env_failures,
        start_timeout_s=of_run.start_timeout_s,
        step_timeout_s=of_run.step_timeout_s,
    )
    return PlayingWorkers(count or of_run.workers(copies), flags.transport, flags.bind, flags.inference, copies, settings)


def _which(flags: PlayFlags) -> Which:
    return "best" if flags.best else "final"


def policy_to_play(flags: PlayFlags, given: Given | None) -> SavedPolicy:
    """The policy to play and its environment. Raises `UserFacingError` if one of them can't be found or can't be played."""
    env, wrappers = given or Given(flags.env or None, flags.wrappers or None)
    saved = saved_policy(flags.run, _which(flags), env=env, wrappers=wrappers)
    if saved.card.seats and flags.inference == "learner":
        raise UsageError(
            f"inference learner: {saved.env.id} has several agents, and workers must act; use --inference workers"
        )
    return saved
