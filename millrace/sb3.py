"""A Stable-Baselines3 `VecEnv` whose copies live in worker processes: `SubprocVecEnv`, generalised. Needs the extra `peers`.

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
    """As `stable_baselines3.common.env_util.make_vec_env`; `keywords` are those of `millrace.make_vec`.

    `monitor`: record each episode's return and length, as SB3's Monitor does, for `rollout/ep_rew_mean`.
    """
    from stable_baselines3.common.vec_env import VecMonitor

    env = Sb3VecEnv(millrace.make_vec(env_id, n_envs, autoreset_mode="SameStep", **keywords, **(env_kwargs or {})))
    if seed is not None:
        env.seed(seed)
    return VecMonitor(env) if monitor else env


class Sb3VecEnv(VecEnv):
    """SB3's face of a vector environment that resets in the ending step."""

    def __init__(self, env: ZmqVectorEnv) -> None:
        self.env = env
        super().__init__(env.num_envs, env.single_observation_space, env.single_action_space)

    def reset(self) -> Any:
        """Begin episodes in all copies, with the seeds and options that were set."""
        seeds = self._seeds if any(seed is not None for seed in self._seeds) else None
        options = self._options[0] or None
        if any(one != self._options[0] for one in self._options):
            raise ValueError("set_options expected the same options for every copy")
        observation, infos = self.env.reset(seed=seeds, options=options)
        self.reset_infos = self._listed(infos)
        self._reset_seeds()
        self._reset_options()
        return observation

    def step_async(self, actions: Array) -> None:
        """Tell every copy to step."""
        self.env.step_async(actions)

    def step_wait(self) -> Any:
        """Observations, rewards, dones and a list of infos."""
        observation, reward, terminated, truncated, infos = self.env.step_wait()
        done = terminated | truncated
        if not infos and not done.any():
            return observation, reward.astype(np.float32), done, [{"TimeLimit.truncated": False} for _ in done]
        listed = self._listed(infos)
        for n, info in enumerate(listed):
            if done[n]:
                last, after = info.pop("final_info", {}), dict(info)
                terminal = after.pop("final_obs")
                self.reset_infos[n] = after
                info.clear()
                info.update(last, terminal_observation=terminal)
            info["TimeLimit.truncated"] = bool(truncated[n] and not terminated[n])
        return observation, reward.astype(np.float32), done, listed

    def close(self) -> None:
        """End the workers."""
        self.env.close()

    def get_attr(self, attr_name: str, indices: Indices = None) -> list[Any]:
        """An attribute of each copy."""
        return self._each(indices, attr_name)

    def set_attr(self, attr_name: str, value: Any, indices: Indices = None) -> None:
        """Set an attribute of each copy."""
        copies = sorted(self._get_indices(indices))
        self.env.assign_some(copies, attr_name, [value] * len(copies))

    def env_method(self, method_name: str, *method_args: Any, indices: Indices = None, **method_kwargs: Any) -> list[Any]:
        """Call a method of each copy."""
        return self._each(indices, method_name, *method_args, **method_kwargs)

    def env_is_wrapped(self, wrapper_class: type, indices: Indices = None) -> list[bool]:
        """Never, as far as this process can see: wrappers stand where the copies are, and classes do not travel."""
        return [False for _ in self._get_indices(indices)]

    def get_images(self) -> Sequence[Array | None]:
        """A frame of each copy."""
        return self.env.render() if self.render_mode == "rgb_array" else [None] * self.num_envs

    def _each(self, indices: Indices, name: str, *args: Any, **kwargs: Any) -> list[Any]:
        """What each copy gives, in the order of `indices`."""
        copies = list(self._get_indices(indices))
        found = dict(zip(sorted(set(copies)), self.env.call_some(sorted(set(copies)), name, *args, **kwargs), strict=True))
        return [found[n] for n in copies]

    def _listed(self, infos: dict[str, Any]) -> list[dict[str, Any]]:
        """Gymnasium's dict of arrays, as a list of dicts."""
        return [_of_copy(infos, n) for n in range(self.num_envs)]


def _of_copy(infos: dict[str, Any], n: int) -> dict[str, Any]:
    """One copy's own info, again: of each key with a mask that is true for it."""
    own = {}
    for key, values in infos.items():
        if key.startswith("_") and key[1:] in infos:
            continue
        mask = infos.get(f"_{key}")
        if mask is None or mask[n]:
            own[key] = _of_copy(values, n) if isinstance(values, dict) else values[n]
    return own
