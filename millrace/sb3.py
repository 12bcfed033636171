"""A Stable-Baselines3 `VecEnv` whose env copies live in worker processes. It needs the extra `peers`.

It replaces `SubprocVecEnv`: a process steps many env copies, and it may run on another machine.

from millrace.sb3 import make_vec_env
model = PPO("MlpPolicy", make_vec_env("CartPole-v1", n_envs=8, workers=2))
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from stable_baselines3.common.vec_env.base_vec_env import VecEnv

import millrace
from learner.vector_env.env import ZmqVectorEnv
from learner.vector_env.settings import EnvLike
from protocol.arrays import Array

Indices = int | Iterable[int] | None


def make_vec_env(
    env_id: EnvLike | Sequence[EnvLike],
    n_envs: int | None = None,
    seed: int | None = None,
    *,
    monitor: bool = True,
    env_kwargs: dict[str, Any] | None = None,
    **keywords: Any,
) -> VecEnv:
    """Make a vector environment, as `stable_baselines3.common.env_util.make_vec_env` does.

    `env_kwargs` go to the environment, `keywords` to `millrace.make_vec`. `monitor` records the return and length of each
    episode, as SB3's `VecMonitor` does, for `rollout/ep_rew_mean`. Raises the errors of `millrace.make_vec`.
    """
    from stable_baselines3.common.vec_env import VecMonitor

    env = Sb3VecEnv(millrace.make_vec(env_id, n_envs, autoreset_mode="SameStep", **keywords, **(env_kwargs or {})))
    if seed is not None:
        env.seed(seed)
    return VecMonitor(env) if monitor else env


class Sb3VecEnv(VecEnv):
    """The SB3 interface of a vector environment whose autoreset mode is `SameStep`."""

    def __init__(self, env: ZmqVectorEnv) -> None:
        self.env = env
        super().__init__(env.num_envs, env.single_observation_space, env.single_action_space)

    def reset(self) -> Any:
        """Begin episodes in all env copies, with the seeds and options that were set. Returns the observations."""
        seeds = self._seeds if any(seed is not None for seed in self._seeds) else None
        options = self._options[0] or None
        if any(options_of_copy != self._options[0] for options_of_copy in self._options):
            raise ValueError("set_options: expected the same options for every copy, got different ones")
        observation, infos = self.env.reset(seed=seeds, options=options)
        self.reset_infos = self._info_list(infos)
        self._reset_seeds()
        self._reset_options()
        return observation

    def step_async(self, actions: Array) -> None:
        """Order every env copy to step."""
        self.env.step_async(actions)

    def step_wait(self) -> Any:
        """Observations, rewards (float32), dones and a list with one info for each env copy."""
        observation, reward, terminated, truncated, infos = self.env.step_wait()
        done = terminated | truncated
        if not infos and not done.any():
            return observation, reward.astype(np.float32), done, [{"TimeLimit.truncated": False} for _ in done]
        info_list = self._info_list(infos)
        for n, info in enumerate(info_list):
            if done[n]:
                final_info, reset_info = info.pop("final_info", {}), dict(info)
                terminal_observation = reset_info.pop("final_obs")
                self.reset_infos[n] = reset_info
                info.clear()
                info.update(final_info, terminal_observation=terminal_observation)
            info["TimeLimit.truncated"] = bool(truncated[n] and not terminated[n])
        return observation, reward.astype(np.float32), done, info_list

    def close(self) -> None:
        """Close the vector environment; its local workers end."""
        self.env.close()

    def get_attr(self, attr_name: str, indices: Indices = None) -> list[Any]:
        """An attribute of each env copy."""
        return self._call_each(indices, attr_name)

    def set_attr(self, attr_name: str, value: Any, indices: Indices = None) -> None:
        """Set an attribute of each env copy to the same value."""
        copies = sorted(self._get_indices(indices))
        self.env.assign_some(copies, attr_name, [value] * len(copies))

    def env_method(self, method_name: str, *method_args: Any, indices: Indices = None, **method_kwargs: Any) -> list[Any]:
        """Call a method of each env copy."""
        return self._call_each(indices, method_name, *method_args, **method_kwargs)

    def env_is_wrapped(self, wrapper_class: type, indices: Indices = None) -> list[bool]:
        """Always False: this process does not see the wrappers, which are in the workers."""
        return [False for _ in self._get_indices(indices)]

    def get_images(self) -> Sequence[Array | None]:
        """A rendered frame of each env copy, or None."""
        return self.env.render() if self.render_mode == "rgb_array" else [None] * self.num_envs

    def _call_each(self, indices: Indices, name: str, *args: Any, **kwargs: Any) -> list[Any]:
        """The result of each env copy, in the order of `indices`."""
        copies = list(self._get_indices(indices))
        ascending = sorted(set(copies))
        results = dict(zip(ascending, self.env.call_some(ascending, name, *args, **kwargs), strict=True))
        return [results[n] for n in copies]

    def _info_list(self, infos: dict[str, Any]) -> list[dict[str, Any]]:
        """Gymnasium's dict of arrays as a list of dicts, one for each env copy."""
        return [_info_of_copy(infos, n) for n in range(self.num_envs)]


def _info_of_copy(infos: dict[str, Any], n: int) -> dict[str, Any]:
    """The info of env copy `n`: it has the keys whose mask is true for this copy."""
    info = {}
    for key, values in infos.items():
        if key.startswith("_") and key[1:] in infos:
            continue
        mask = infos.get(f"_{key}")
        if mask is None or mask[n]:
            info[key] = _info_of_copy(values, n) if isinstance(values, dict) else values[n]
    return info
