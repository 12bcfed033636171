"""Checks, before a run is resumed, that the settings and the environment still fit the run's weights and state.

Rule: all checks are made before anything is written into the run folder, so a refused resume changes nothing. A launcher
needs a `Resumption`, which only `unless_finished` creates, so no launcher can skip the checks.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import msgspec

from millrace.learner.between_updates.stop_rules import BY_THE_POLICY_OF, reason_to_stop
from millrace.learner.config.config import Config
from millrace.learner.config.layers import config_of_run
from millrace.learner.config.resume_rules import Change, OnResume, changes, refusal
from millrace.learner.env_spaces import EnvSpaces
from millrace.learner.run_folder.policy_files import StoredPolicy
from millrace.learner.run_folder.results import ALL_STEPS_DONE, DecidingReturns
from millrace.learner.run_folder.run_folder import RunFolder
from millrace.protocol.bounds import one_line
from millrace.protocol.envs.found_names import moved
from millrace.protocol.errors import UsageError


class Resumption(NamedTuple):
    """A run that can be resumed with the given settings, and has something left to do."""

    run: Path
    differences: tuple[str, ...]
    """Lines that tell the user what will be different."""


def unless_finished(config: Config, resume: Path | None, train: Callable[[Resumption | None], Path]) -> Path:
    """Call `train`, unless the run to resume is already finished. Returns the run folder.

    If `resume` is given, that run is checked first. If it is finished, no worker is started. Raises `UsageError` if there is
    no such run or it cannot be resumed with these settings, and whatever `train` raises.
    """
    if resume is None:
        if config.start_from:
            policy_to_start_from(config)  # so that a wrong folder is reported before anything starts
        return train(None)
    lines = check_settings(config, resume)
    return resume if _is_finished(config, RunFolder.open(resume)) else train(Resumption(resume, tuple(lines)))


def policy_to_start_from(config: Config) -> StoredPolicy:
    """The policy from which a new run starts. Raises `UsageError` if it can't be read."""
    return RunFolder.open_policy(Path(config.start_from)).read_policy("best" if config.from_parts == "best" else "final")


def check_settings(config: Config, run: Path) -> list[str]:
    """Check that the run in this folder can be resumed with these settings. Returns lines that say what will be different.

    Raises `UsageError` if this isn't a run folder, or if fixed settings differ. The error names these settings.
    """
    RunFolder.open(run)
    before = _with_present_names(config_of_run(run, config.algo), config)
    changed = [*changes(before, config)]
    if before.algo == config.algo:  # otherwise the settings of the two algorithms can't be compared
        changed += changes(before.algorithm, config.algorithm)
    if why := refusal(changed):
        raise UsageError(f"run {run}: {why}; a run keeps this setting: resume it without the setting, or start a new run")
    had = before.algorithm
    has = config.algorithm
    if had.replays and had.core is not None and had.rollout_steps != has.rollout_steps:
        raise UsageError(
            f"run {run}: rollout_steps: expected {had.rollout_steps}, the length of the sequences in its replay buffer, "
            f"got {has.rollout_steps}; resume it without this setting, or start a new run"
        )
    return [f"run {run}: {line}" for line in _differences(before, config, changed)]


def check_spaces(run: Path, made_for: EnvSpaces, now: EnvSpaces) -> None:
    """Raise `UsageError` unless the environment has the spaces and agents that the policy was created for."""
    for what, expected, got in (
        ("agents", (made_for.seats,), (now.seats,)),
        ("observations", made_for.observation, now.observation),
        ("actions", (made_for.action,), (now.action,)),
    ):
        if found := first_difference(expected, got):
            raise UsageError(
                f"run {run}: the environment's {what} have changed: expected {found[0]}, got {found[1]}; "
                "install the version of the environment that the run was started with, or start a new run"
            )


def first_difference(expected: Iterable[object], got: Iterable[object]) -> tuple[str, str] | None:
    """The first pair of items that differ, or of counts, as one line of text each; None if everything is equal."""
    expected = [*expected]
    got = [*got]
    for one, other in zip(expected, got, strict=False):
        if one != other:
            return one_line(str(one)), one_line(str(other))
    return None if len(expected) == len(got) else (f"{len(expected)} arrays", f"{len(got)} arrays")


def _with_present_names(before: Config, now: Config) -> Config:
    """A run's settings, with the current names of its environment and wrappers if these were moved to a module."""
    wrappers_moved = len(before.wrappers) == len(now.wrappers) and all(map(moved, before.wrappers, now.wrappers))
    return msgspec.structs.replace(
        before,
        env=now.env if moved(before.env, now.env) else before.env,
        wrappers=now.wrappers if wrappers_moved else before.wrappers,
    )


def _is_finished(config: Config, folder: RunFolder) -> bool:
    """Whether the run has nothing left to do, because the reason why it ended still holds with these settings.

    Only the returns that ended training decide this. The evaluation of the final policy doesn't count, because it came
    later. If training ended because all env steps were done, the summary's mean training return doesn't count either,
    because it may be the mean of too few episodes.
    """
    summary = folder.summary()
    if summary is None or summary.evaluation is None:
        return False
    reason = reason_to_stop(
        config,
        DecidingReturns(
            evaluation=summary.ended_by,
            training=None if summary.stop_reason == ALL_STEPS_DONE else summary.return_mean_100,
        ),
        env_steps_after_next_update=summary.env_steps + config.algorithm.rollout_steps * config.envs,
    )
    return reason == summary.stop_reason.partition(BY_THE_POLICY_OF)[0]


def _differences(before: Config, config: Config, changed: Sequence[Change]) -> list[str]:
    same_copies = before.envs // before.lanes == config.envs // config.lanes
    goes_on = same_copies and config.lost_lanes == "continue"
    episodes = "its earlier lanes continue" if goes_on else "every lane begins new episodes"
    lines = [
        f"{name}: {given} now, {had} before; {episodes}"
        for name, on_resume, had, given in changed
        if on_resume is OnResume.ADAPTABLE
    ]
    was, now = (one.envs * one.algorithm.rollout_steps for one in (before, config))
    steps = config.algorithm.gradient_steps
    if steps and steps == before.algorithm.gradient_steps and was != now:
        lines.append(
            f"an update of {steps} gradient steps now follows {now} env steps, {was} before; "
            f"--gradient-steps {max(1, round(steps * now / was))} keeps the replay ratio"
        )
    return lines


@contextmanager
def naming_run(run: Path | None) -> Iterator[None]:
    """Make errors name the run that is resumed, because the wrong setting may be in its folder.

    `run` is None for a new run.
    """
    try:
        yield
    except UsageError as error:
        if run is None:
            raise
        raise UsageError(f"{run}: {error}") from error
