"""The kinds of env copies that are stepped all at once: `--vector native` and `--vector envpool`."""

from __future__ import annotations

from typing import Any

import gymnasium

from millrace.extras.envs.envpool import envpool_spec
from millrace.extras.envs.envpool_copies import EnvpoolCopies
from millrace.extras.envs.vector_copies import VectorCopies
from millrace.extras.envs.vectorized import make_native
from millrace.protocol.env_spec import EnvSpec
from millrace.protocol.envs.kinds_of_copies import CopiesKind
from millrace.protocol.envs.which_copy import FIRST_COPY, EnvCopy
from millrace.protocol.specs import RunSpec
from millrace.workers.activity import MAKING, activity
from millrace.workers.copies.env_loop import Pulse
from millrace.workers.copy_slots import close_copy, make_copy


def open_native(run: RunSpec, first: EnvCopy, pulse: Pulse) -> VectorCopies:
    """Make the copies of a lane in the environment's own vectorized form."""
    with activity().during(MAKING):
        env = make_copy(first, lambda: make_native(run.env, run.copies))
        return VectorCopies(env, run.info_keys, masked=run.masked, critic_keys=run.policy.critic_keys)


def open_envpool(run: RunSpec, first: EnvCopy, pulse: Pulse) -> EnvpoolCopies:
    """Make the copies of a lane with envpool."""
    with activity().during(MAKING):  # importing the module that registers the environment may take a long time
        return make_copy(first, lambda: EnvpoolCopies(envpool_spec(run.env), run.copies, run.info_keys))


def native_spaces(env: EnvSpec) -> tuple[gymnasium.Space[Any], gymnasium.Space[Any]]:
    """Observation and action space of one copy. To find them, this function makes a vector environment and closes it."""
    made = make_copy(FIRST_COPY, lambda: make_native(env, 1))
    spaces = made.single_observation_space, made.single_action_space
    close_copy(made)
    return spaces


def envpool_spaces(env: EnvSpec) -> tuple[gymnasium.Space[Any], gymnasium.Space[Any]]:
    """Observation and action space of one copy. No copy is made."""
    pool = envpool_spec(env)
    return pool.observation_space, pool.action_space


NATIVE = CopiesKind(open_native, native_spaces)
ENVPOOL = CopiesKind(open_envpool, envpool_spaces, has_masks=False, has_attributes=False)
