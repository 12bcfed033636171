"""Warnings, before a run starts, about settings that will make it slow. Pure functions of settings and shapes.

Rule: a warning is one line that gives the cost and how to reduce it. It is empty unless the cost is unusual.
"""

from __future__ import annotations

import math

from gymnasium.wrappers import TimeLimit

from millrace.learner.config.config import Config
from millrace.learner.config.evaluation_size import evaluation_size
from millrace.protocol.envs.description import DescribedEnv, class_name
from millrace.protocol.policy.arithmetic import multiply_adds
from millrace.protocol.specs import PolicySpec

MANY_MULTIPLY_ADDS = 1 << 24  # per observation; Atari's four frames of 84 x 84 pixels need half as many
PASSES = 3  # the cost of a forward and a backward pass, in forward passes; a backward pass costs as much as two


def large_observations(config: Config, policy: PolicySpec) -> str:
    """A warning about the cost of a minibatch, if observations are large; otherwise empty."""
    if (of_one := multiply_adds(policy)) < MANY_MULTIPLY_ADDS:
        return ""
    numbers = sum(math.prod(leaf.shape) for leaf in policy.observation)
    rows = config.algorithm.minibatch_rows(config.envs)
    smaller = (
        '--wrappers "gymnasium.wrappers:ResizeObservation(shape=(84, 84))"'
        if any(leaf.is_image for leaf in policy.observation)
        else "a wrapper that drops the numbers that don't matter, or a smaller --net"
    )
    return (
        f"an observation of {config.env} has {numbers:,} numbers, so a minibatch of {rows:,} takes "
        f"{PASSES * rows * of_one / 1e9:,.0f} billion multiply-adds: updates may take minutes; what helps: {smaller}, "
        "or an --encoder of your own"
    )


def endless_evaluations(config: Config, evaluation: DescribedEnv) -> str:
    """A warning about how long an evaluation may take, if nothing limits the length of its episodes; otherwise empty."""
    limited = evaluation.max_episode_steps is not None or class_name(TimeLimit) in evaluation.wrappers
    if limited or not (config.eval_every or config.eval_episodes):
        return ""
    size = evaluation_size(config)
    episodes = f"{size.episodes} episode{'s' * (size.episodes != 1)}"
    limit = "" if evaluation.seats else ' --wrappers "gymnasium.wrappers:TimeLimit(max_episode_steps=1000)" or'
    return (
        f"no time limit of {config.env} is known: if episodes do not end, an evaluation of {episodes} takes "
        f"{size.max_steps:,} env steps; limit it by{limit} --eval-max-steps"
    )
