"""An environment as a worker describes it and a learner reads it, in one process; and the specs that follow from it."""

from __future__ import annotations

from typing import Any

import gymnasium

from millrace.learner.config.config import Config
from millrace.learner.env_spaces import EnvSpaces
from millrace.learner.run_spec import run_spec as spec_of_run
from millrace.learner.vector_env.settings import VectorEnvSettings
from millrace.learner.vector_env.spec import requested_copies
from millrace.protocol.env_spec import EnvSpec
from millrace.protocol.envs.description import DescribedEnv, read_description
from millrace.protocol.messages import Describe, Described
from millrace.protocol.specs import RunSpec, StepSpec
from millrace.protocol.wire.codec import decode_to_learner, encode
from millrace.workers.copy_slots import close_described
from millrace.workers.described_copy import describe


def described(env: EnvSpec, vector: str = "loop", render_mode: str | None = None) -> DescribedEnv:
    """The description, sent and received. Raises what a worker would report."""
    description = describe(Describe(1, 1, env, vector, render_mode))
    close_described()
    message = decode_to_learner([bytes(frame) for frame in encode(Described(1, 1, description))])
    assert isinstance(message, Described)
    return read_description(message.description)


def with_spaces(observation: gymnasium.Space[Any], action: gymnasium.Space[Any]) -> gymnasium.Env[Any, Any]:
    """An environment of which only the spaces matter."""
    env = gymnasium.make("CartPole-v1").unwrapped
    env.observation_space, env.action_space = observation, action
    return env


def run_spec(config: Config, env: EnvSpec) -> RunSpec:
    """The run of this configuration. Raises `UsageError`."""
    return spec_of_run(config, env, EnvSpaces.of_description(described(env, config.vector)))


def step_spec(settings: VectorEnvSettings) -> StepSpec:
    """The vector environment of these settings."""
    requested = requested_copies(settings)
    return requested.description(described(requested.envs[0], render_mode=settings.render_mode)).step
