"""envpool's compiled environments under gymnasium's ids.

Rule: an id stands for the same environment as in gymnasium. Spaces that differ from gymnasium's are an error, and
gymnasium's time limit applies. This file maps ids to envpool tasks and makes the env copies; `envpool_copies.py` makes their
rows follow the row format.
"""

from __future__ import annotations

import threading
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any, NamedTuple

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.envs.registration import load_env_creator
from gymnasium.vector import VectorEnv

from millrace.extras.envs.vectorized import check_unwrapped_id
from millrace.protocol.env_spec import EnvSpec
from millrace.protocol.envs.advice.atari_ids import instead_of_vector
from millrace.protocol.errors import UsageError

MAX_EPISODE_STEPS = 2**31 - 1  # envpool counts steps in an int32
_WARNINGS_LOCK = threading.Lock()


class EnvpoolSpec(NamedTuple):
    """How envpool makes copies of an environment."""

    task: str
    """envpool's name for the environment"""
    options: dict[str, Any]
    """keyword arguments for `envpool.make`"""
    limit: int
    """number of steps after which `EnvpoolCopies` truncates an episode; envpool itself doesn't"""
    observation_space: gymnasium.Space[Any]
    action_space: gymnasium.Space[Any]
    """Observation and action space of one copy."""

    def make(self, seeds: Sequence[int]) -> VectorEnv[Any, Any, Any]:
        """Make one env copy for each seed, because envpool accepts seeds only when copies are made.

        envpool uses one thread, because each core already has a worker.
        """
        import envpool

        options = {**self.options, "num_threads": 1, "env_seed": list(seeds)}
        with _ignore_warnings():
            made: VectorEnv[Any, Any, Any] = envpool.make_gymnasium(self.task, num_envs=len(seeds), **options)
            _ = made.observation_space  # envpool creates it, with warnings, at the first access
        return made


@contextmanager
def _ignore_warnings() -> Iterator[None]:
    """Ignore warnings, such as those about rounded bounds. Warning filters are global, so only one thread may do this."""
    with _WARNINGS_LOCK, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield


def envpool_spec(env: EnvSpec) -> EnvpoolSpec:
    """How envpool makes this environment. Raises `UsageError` if it can't."""
    check_unwrapped_id(env, "envpool")
    try:
        import envpool
    except ImportError as error:
        line = f"environment {env.id}: vector envpool needs envpool ({error}); pip install envpool"
        raise UsageError(line) from error
    known = env.registered()
    try:
        task, options = _task_and_options(env, known)
        if task not in envpool.list_all_envs():
            raise UsageError(f"environment {env.id}: envpool has no environment of this name; {instead_of_vector(env.id)}")
        with _ignore_warnings():
            made = envpool.make_spec(task, **options)
            observation = made.gymnasium_observation_space
            action = made.gymnasium_action_space
            if isinstance(action, spaces.Box):  # envpool casts actions to float32
                action = spaces.Box(action.low.astype(np.float32), action.high.astype(np.float32))
    except (TypeError, AssertionError) as error:
        says = str(error).strip().partition("() ")  # removes the name of the function that got a wrong argument
        raise UsageError(f"environment {env.id}: envpool cannot make it: {says[2] or says[0]}; use --vector loop") from error
    limit = options.get("max_episode_steps") or known.max_episode_steps or made.config.max_episode_steps
    return EnvpoolSpec(task, {**options, "max_episode_steps": min(limit + 1, MAX_EPISODE_STEPS)}, limit, observation, action)


def _task_and_options(env: EnvSpec, known: gymnasium.envs.registration.EnvSpec) -> tuple[str, dict[str, Any]]:
    """The environment's task and options in envpool: what the entry point's attribute `envpool` returns, or the same id and
    keyword arguments as in gymnasium.

    The task is empty if the id was registered by a package other than gymnasium, because it is then another environment.
    """
    creator = load_env_creator(known.entry_point) if isinstance(known.entry_point, str) else known.entry_point
    if (translate := getattr(creator, "envpool", None)) is not None:
        task, options = translate(**{**known.kwargs, **env.kwargs_of_copy()})
        return task, options
    of_gymnasium = str(getattr(creator, "__module__", "")).startswith("gymnasium.")
    return known.id if of_gymnasium else "", env.kwargs_of_copy()
