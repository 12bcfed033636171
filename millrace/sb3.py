"""A Stable-Baselines3 `VecEnv` whose env copies live in worker processes. It needs the pip extra `peers`.

It replaces `SubprocVecEnv`: one worker process steps several env copies, and workers may run on other machines.

from millrace.sb3 import make_vec_env
model = PPO("MlpPolicy", make_vec_env("CartPole-v1", n_envs=8, workers=2))
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any

import gymnasium
import msgspec
import numpy as np
from gymnasium.vector import AutoresetMode
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env.base_vec_env import VecEnv

import millrace
from millrace.arguments import checked
from millrace.learner.vector_env.env import ZmqVectorEnv
from millrace.protocol.arrays import Array
from millrace.protocol.env_spec import EnvLike, EnvSpec, Scalar
from millrace.protocol.envs.description import class_name
from millrace.protocol.envs.seats import SeatedEnv
from millrace.protocol.envs.spaces import make_flatten, make_unflatten
from millrace.protocol.errors import UsageError

Indices = int | Iterable[int] | None


@checked
def make_vec_env(
    env_id: EnvLike | Sequence[EnvLike],
    n_envs: int | None = None,
    seed: int | None = None,
    *,
    monitor: bool = True,
    wrapper_class: Callable[..., gymnasium.Env[Any, Any]] | None = None,
    env_kwargs: dict[str, Any] | None = None,
    wrapper_kwargs: dict[str, Any] | None = None,
    **keywords: Any,
) -> VecEnv:
    """Make a vector environment, as `stable_baselines3.common.env_util.make_vec_env` does.

    Args:
        env_id: `env` of `millrace.make_vec`. If the environment has several agents, each agent is a row of the `VecEnv`, and
            all of them must act at every step.
        n_envs: number of env copies; by default 1, or the length of the list.
        seed: seed for the first reset, in which copy n gets `seed + n`, and for sampling from `action_space`.
        monitor: record the return and length of each episode, for `rollout/ep_rew_mean`. As in SB3, these are recorded
            inside `wrapper_class`, so the wrapper doesn't affect them.
        wrapper_class: called in the workers with each env copy: a wrapper, or a function that applies several. Because it is
            code, it is sent over TCP only to workers that have a key.
        env_kwargs: keyword arguments of the environment.
        wrapper_kwargs: keyword arguments of `wrapper_class`.
        keywords: further keyword arguments of `millrace.make_vec`.

    Raises the errors that `millrace.make_vec` raises.

    env = make_vec_env("CartPole-v1", 8, wrapper_class=TimeLimit, wrapper_kwargs={"max_episode_steps": 100}, workers=2)
    """
    from stable_baselines3.common.vec_env import VecMonitor

    envs = env_id
    if wrapper_class is not None:
        wrap = _Wrapping(wrapper_class, wrapper_kwargs or {}, monitor)
        if isinstance(env_id, Sequence) and not isinstance(env_id, str):
            envs = [wrap(each) for each in env_id]
        else:
            envs = wrap(env_id)
    made = millrace.make_vec(envs, n_envs, autoreset_mode="SameStep", **keywords, **(env_kwargs or {}))
    env = Sb3VecEnv(made, monitored=monitor and wrapper_class is not None)
    if seed is not None:
        env.seed(seed)
        env.action_space.seed(seed)
    return VecMonitor(env) if monitor and wrapper_class is None else env


class Sb3VecEnv(VecEnv):
    """Gives a vector environment whose autoreset mode is `SameStep` the interface of SB3's `VecEnv`.

    If the environment has several agents, `num_envs` counts the agents of all copies. All agents must act at every step,
    because SB3 doesn't support anything else.
    """

    def __init__(self, env: ZmqVectorEnv, *, monitored: bool = False) -> None:
        """`monitored`: the workers record episodes as `Monitor` does. Raises `UsageError` for another autoreset mode."""
        if env.autoreset_mode is not AutoresetMode.SAME_STEP:
            raise UsageError(f"Sb3VecEnv: expected autoreset_mode SameStep, got {env.autoreset_mode.value}")
        env.merge_infos = False  # in merged infos, the values of all copies would have the same dtype and shape
        self.env = env
        self._monitored = monitored
        self._rows_of_copy = max(1, len(env.seats))
        space = env.single_action_space
        self._nested_actions = isinstance(space, gymnasium.spaces.Dict | gymnasium.spaces.Tuple)
        self._flatten = make_flatten(space)
        self._unflatten = make_unflatten(space)
        super().__init__(env.num_envs, env.single_observation_space, env.single_action_space)

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        """Set the seeds for the next reset: copy n gets `seed + n`, whatever the number of agents.

        Returns the seed of each row [num_envs].
        """
        first, *_ = super().seed(seed)
        if first is not None:
            self._seeds = [first + n // self._rows_of_copy for n in range(self.num_envs)]
        return self._seeds

    def reset(self) -> Any:
        """Begin episodes in all env copies, with the seeds and options that were set before. Returns the observations."""
        seeds = self._seeds[:: self._rows_of_copy] if any(seed is not None for seed in self._seeds) else None
        options = [each or None for each in self._options[:: self._rows_of_copy]] if any(self._options) else None
        observation, infos = self.env.reset(seed=seeds, options=options)
        self._check_all_act(infos)
        self.reset_infos = self._info_list()
        self._reset_seeds()
        self._reset_options()
        return observation

    def step_async(self, actions: Array | Sequence[Any]) -> None:
        """Start a step of every env copy with its element of `actions`, an array or a list."""
        if self._nested_actions:
            leaves = zip(*map(self._flatten, actions), strict=True)
            # gymnasium's form of a batch: an array for each leaf
            actions = self._unflatten([np.asarray(leaf) for leaf in leaves])
        self.env.step_async(actions)

    def step_wait(self) -> Any:
        """Wait until the step has ended. Returns observations, rewards [num_envs] float32, dones [num_envs] bool, and a list
        with the info of each row.
        """
        observation, reward, terminated, truncated, infos = self.env.step_wait()
        self._check_all_act(infos)
        done = terminated | truncated
        if not self.env.infos_by_row and not done.any():
            return observation, reward.astype(np.float32), done, [{"TimeLimit.truncated": False} for _ in done]
        info_list = self._info_list()
        for n, info in enumerate(info_list):
            if done[n]:
                final_info = info.pop("final_info", {})
                reset_info = dict(info)
                terminal_observation = reset_info.pop("final_obs")
                self.reset_infos[n] = reset_info
                info.clear()
                info.update(final_info, terminal_observation=terminal_observation)
            info["TimeLimit.truncated"] = bool(truncated[n] and not terminated[n])
        return observation, reward.astype(np.float32), done, info_list

    def _check_all_act(self, infos: dict[str, Any]) -> None:
        if self.env.seats and not infos["acts"].all():
            who = self.env.seats[int(np.argmin(infos["acts"])) % self._rows_of_copy]
            raise UsageError(
                f"Sb3VecEnv: expected all agents to act at every step, but {who} does not; for agents that leave, use "
                "wrappers=['supersuit:black_death_v3']; for others, millrace.make_vec, whose infos say who acts"
            )

    def close(self) -> None:
        """Close the vector environment, and end its local workers."""
        self.env.close()

    def get_attr(self, attr_name: str, indices: Indices = None) -> list[Any]:
        """The value of an attribute in each env copy."""
        return self._call_each(indices, attr_name)

    def has_attr(self, attr_name: str) -> bool:
        """Whether every env copy has this attribute. If it is a method, it isn't called."""
        return all(self._call_each(None, "has_wrapper_attr", attr_name))

    def set_attr(self, attr_name: str, value: Any, indices: Indices = None) -> None:
        """Set an attribute of each env copy to the same value."""
        copies = sorted(set(self._copies(indices)))
        self.env.calls.assign(copies, attr_name, [value] * len(copies))

    def env_method(self, method_name: str, *method_args: Any, indices: Indices = None, **method_kwargs: Any) -> list[Any]:
        """Call a method of each env copy. Returns the results."""
        return self._call_each(indices, method_name, *method_args, **method_kwargs)

    def env_is_wrapped(self, wrapper_class: type, indices: Indices = None) -> list[bool]:
        """Whether each env copy is wrapped in `wrapper_class`, compared by the name of the class."""
        copies = self._copies(indices)
        if self._monitored and issubclass(Monitor, wrapper_class):
            return [True for _ in copies]
        ascending = sorted(set(copies))
        name = class_name(wrapper_class)
        found = dict(zip(ascending, self.env.calls.describe(ascending), strict=True))
        return [(copy := found[n]) is not None and name in copy.wrappers for n in copies]

    def get_images(self) -> Sequence[Array | None]:
        """A rendered frame of each env copy, or None."""
        return self.env.render() if self.render_mode == "rgb_array" else [None] * self.num_envs

    def _call_each(self, indices: Indices, name: str, *args: Any, **kwargs: Any) -> list[Any]:
        """The attribute `name` of each env copy, in the order of `indices`; if it is a method, the result of calling it."""
        copies = self._copies(indices)
        ascending = sorted(set(copies))
        results = dict(zip(ascending, self.env.calls.call(ascending, name, args, kwargs), strict=True))
        return [results[n] for n in copies]

    def _copies(self, indices: Indices) -> list[int]:
        """The number of each row's copy, as plain integers. As in a list, row -1 is the last one."""
        return [range(self.num_envs)[n] // self._rows_of_copy for n in self._get_indices(indices)]

    def _info_list(self) -> list[dict[str, Any]]:
        """The newest info of each row, as the environment returned it."""
        return [self.env.infos_by_row.get(n, {}) for n in range(self.num_envs)]


class _Wrapping:
    """For each environment of a list, makes a factory that wraps the environment with `wrapper_class`."""

    def __init__(
        self, wrapper_class: Callable[..., gymnasium.Env[Any, Any]], keywords: dict[str, Any], monitor: bool
    ) -> None:
        self._wrapper_class = wrapper_class
        self._keywords = keywords
        self._monitor = monitor
        self._made: dict[object, Callable[..., gymnasium.Env[Any, Any]]] = {}

    def __call__(self, env: EnvLike) -> Callable[..., gymnasium.Env[Any, Any]]:
        """A factory for this environment, wrapped. Equal environments get the same factory, so that it is sent only once."""
        key = env if isinstance(env, str) else id(env)  # gymnasium's specs aren't hashable
        if key not in self._made:
            self._made[key] = _wrapped(env, self._wrapper_class, self._keywords, self._monitor)
        return self._made[key]


def _wrapped(
    env: EnvLike, wrapper_class: Callable[..., gymnasium.Env[Any, Any]], keywords: dict[str, Any], monitor: bool
) -> Callable[..., gymnasium.Env[Any, Any]]:
    """A factory for the wrapped environment. It is a nested function, so that a worker can call it without importing this
    module, which needs Stable-Baselines3.
    """
    inner = EnvSpec.of(env)

    def make(render_mode: str | None = None, **kwargs: Scalar) -> gymnasium.Env[Any, Any]:
        made = msgspec.structs.replace(inner, kwargs=kwargs).make(render_mode)
        if isinstance(made, SeatedEnv):
            raise UsageError(
                "make_vec_env: wrapper_class: expected none with agents; pass PettingZoo wrappers as wrappers=[...]"
            )
        return wrapper_class(gymnasium.wrappers.RecordEpisodeStatistics(made) if monitor else made, **keywords)

    make.__name__ = make.__qualname__ = inner.id
    return make
