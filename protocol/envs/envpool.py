"""The environments that envpool has compiled, under the ids that gymnasium has for them; or in one line why not.

The law: an id means what gymnasium means by it, so its spaces must be gymnasium's, and its time limit is. Here is what it is
called and how it is made; `workers/collect/envpool_copies.py` keeps the law of a row.
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

from protocol.env_spec import EnvSpec
from protocol.envs.vectorized import check_spaces, vector_alternative
from protocol.errors import UsageError
from protocol.specs import ActionSpec, Leaf

LONGEST = 2**31 - 1  # steps: envpool counts them in an int32
_ALONE = threading.Lock()


class EnvpoolSpec(NamedTuple):
    """How envpool makes copies of an environment."""

    task: str
    """envpool's name"""
    options: dict[str, Any]
    """keyword arguments of `envpool.make`"""
    limit: int
    """steps after which an episode is truncated, which is not left to envpool (see `workers.collect.envpool_copies`)"""
    observation_space: gymnasium.Space[Any]
    action_space: gymnasium.Space[Any]
    """both of one copy"""

    def make(self, seeds: Sequence[int]) -> VectorEnv[Any, Any, Any]:
        """A copy for each seed, which envpool takes only here; in one thread, for there is a worker for each core."""
        import envpool

        options = {**self.options, "num_threads": 1, "env_seed": list(seeds)}
        with _quietly():
            made: VectorEnv[Any, Any, Any] = envpool.make_gymnasium(self.task, num_envs=len(seeds), **options)
            _ = made.observation_space  # made when first asked for
        return made


@contextmanager
def _quietly() -> Iterator[None]:
    """Without the warnings of bounds that float32 rounds. What is ignored is the process's: one thread at a time."""
    with _ALONE, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield


def envpool_spec(env: EnvSpec) -> EnvpoolSpec:
    """What envpool has for this id. Raises `UsageError`."""
    if env.factory is not None:
        raise UsageError(f"environment {env.id}: vector envpool expected an id that gymnasium registers, got a callable")
    try:
        import envpool
    except ImportError as error:
        line = f"environment {env.id}: vector envpool needs envpool ({error}); pip install 'millrace-rl[envpool]'"
        raise UsageError(line) from error
    known = env.registered()
    task, options = _named(env, known)
    if task not in envpool.list_all_envs():
        raise UsageError(f"environment {env.id}: envpool has none of this name; {vector_alternative(env)}")
    try:
        with _quietly():
            made = envpool.make_spec(task, **options)
            observation, action = made.gymnasium_observation_space, made.gymnasium_action_space
            if isinstance(action, spaces.Box):  # it casts what it is given
                action = spaces.Box(action.low.astype(np.float32), action.high.astype(np.float32))
    except (TypeError, AssertionError) as error:
        says = str(error).strip().removeprefix("Config.__new__() ")
        raise UsageError(f"environment {env.id}: envpool cannot make it: {says}; use --vector loop") from error
    limit = options.get("max_episode_steps") or known.max_episode_steps or made.config.max_episode_steps
    return EnvpoolSpec(task, {**options, "max_episode_steps": min(limit + 1, LONGEST)}, limit, observation, action)


def _named(env: EnvSpec, known: gymnasium.envs.registration.EnvSpec) -> tuple[str, dict[str, Any]]:
    """Name and options in envpool: those that the entry point's attribute `envpool` gives, or gymnasium's own.

    Whoever registers an id of their own under a name that envpool has, too, means another environment: it has no name there.
    """
    creator = load_env_creator(known.entry_point) if isinstance(known.entry_point, str) else known.entry_point
    if (translate := getattr(creator, "envpool", None)) is not None:
        task, options = translate(**{**known.kwargs, **env.kwargs})
        return task, options
    of_gymnasium = str(getattr(creator, "__module__", "")).startswith("gymnasium.")
    return known.id if of_gymnasium else "", dict(env.kwargs)


def check_envpool(env: EnvSpec, observation: tuple[Leaf, ...], action: ActionSpec) -> None:
    """Raises `UsageError` unless envpool's environment can stand for copies with these spaces."""
    pool = envpool_spec(env)
    check_spaces(env, "envpool's", pool.observation_space, pool.action_space, observation, action)
