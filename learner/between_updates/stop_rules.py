"""Decides when a run stops, based on its settings and counts. Pure."""

from __future__ import annotations

from millrace.learner.config.config import Config
from millrace.learner.run_folder.results import ALL_STEPS_DONE

BY_THE_POLICY_OF = " by the policy of "  # appended to the reason if training continued during the evaluation


def reason_to_stop(
    config: Config,
    *,
    env_steps_after_next_update: int,
    evaluation_return: float | None,
    training_return: float | None,
    evaluated_before: int | None = None,
) -> str | None:
    """Why the run should end now; None if it should continue.

    `evaluation_return` is the mean return of the newest greedy evaluation, and `training_return` that of the last training
    episodes; each is None if there is none yet. If training has continued since that evaluation, `evaluated_before` is the
    number of env steps with which the evaluated policy was trained.
    """
    target = config.target_return
    if target is not None and evaluation_return is not None and evaluation_return >= target:
        by = "" if evaluated_before is None else f"{BY_THE_POLICY_OF}{evaluated_before:,} env steps"
        return f"target return {target:g} reached{by}"
    target = config.target_mean_return
    if target is not None and training_return is not None and training_return >= target:
        return f"mean return {target:g} of the last episodes reached"
    return ALL_STEPS_DONE if env_steps_after_next_update > config.steps else None
