"""When a run stops, by its settings and numbers. Pure."""

from __future__ import annotations

from learner.config.config import Config


def reason_to_stop(
    config: Config, *, env_steps_after_next_update: int, evaluation_return: float | None, training_return: float | None
) -> str | None:
    """Why the run should end now, or None.

    `evaluation_return`: mean return of the newest greedy evaluation, if there was one. `training_return`: mean return of
    the last episodes of training, if there were enough of them.
    """
    target = config.target_return
    if target is not None and evaluation_return is not None and evaluation_return >= target:
        return f"target return {target:g} reached"
    target = config.target_mean_return
    if target is not None and training_return is not None and training_return >= target:
        return f"mean return {target:g} of the last episodes reached"
    return "all steps done" if env_steps_after_next_update > config.steps else None
