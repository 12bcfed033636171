"""Decides when a run stops, based on its settings and counts. Pure."""

from __future__ import annotations

from millrace.learner.config.config import Config
from millrace.learner.run_folder.results import ALL_STEPS_DONE, DecidingReturns

BY_THE_POLICY_OF = " by the policy of "  # appended to the reason if training continued during the evaluation


def reason_to_stop(config: Config, returns: DecidingReturns, *, env_steps_after_next_update: int) -> str | None:
    """Why the run should end now; None if it should continue."""
    if target_reached(config, returns):
        before = returns.evaluated_before
        by = "" if before is None else f"{BY_THE_POLICY_OF}{before:,} env steps"
        return f"target return {config.target_return:g} reached{by}"
    target = config.target_mean_return
    if target is not None and returns.training is not None and returns.training >= target:
        return f"mean return {target:g} of the last episodes reached"
    return ALL_STEPS_DONE if env_steps_after_next_update > config.steps else None


def target_reached(config: Config, returns: DecidingReturns) -> bool:
    """Whether the newest evaluation reached `target_return`."""
    target = config.target_return
    return target is not None and returns.evaluation is not None and returns.evaluation >= target
