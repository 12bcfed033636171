"""When a run stops, by its settings and numbers. Pure."""

from __future__ import annotations

from millrace.learner.config.config import Config
from millrace.learner.run_folder.results import ALL_STEPS_DONE

BY_THE_POLICY_OF = " by the policy of "  # follows the reason if training continued during the evaluation


def reason_to_stop(
    config: Config,
    *,
    env_steps_after_next_update: int,
    evaluation_return: float | None,
    training_return: float | None,
    evaluated_before: int | None = None,
) -> str | None:
    """Why the run should end now, or None.

    `evaluation_return`: mean return of the newest greedy evaluation, if there was one. `training_return`: mean return of
    the last episodes of training, if there were enough of them. `evaluated_before`: env steps of the evaluated policy, if
    training continued meanwhile.
    """
    target = config.target_return
    if target is not None and evaluation_return is not None and evaluation_return >= target:
        by = "" if evaluated_before is None else f"{BY_THE_POLICY_OF}{evaluated_before:,} env steps"
        return f"target return {target:g} reached{by}"
    target = config.target_mean_return
    if target is not None and training_return is not None and training_return >= target:
        return f"mean return {target:g} of the last episodes reached"
    return ALL_STEPS_DONE if env_steps_after_next_update > config.steps else None
