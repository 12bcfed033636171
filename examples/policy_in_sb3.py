"""Loads a run's weights into Stable-Baselines3's MlpPolicy: `python examples/policy_in_sb3.py` (needs stable-baselines3).

It supports array observations and the default networks of PPO, A2C, IMPALA and REINFORCE. A run's files contain no critic,
so this policy's value estimates are meaningless.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import torch
from safetensors.torch import load_file
from stable_baselines3.common.policies import ActorCriticPolicy

import millrace


def stable_baselines3_actor(run: str | os.PathLike[str]) -> Callable[[Any], Any]:
    """A function that maps an observation to the greedy action of Stable-Baselines3's policy with a run's weights."""
    card = json.loads((Path(run) / "policy.json").read_text())
    arrays = load_file(Path(run) / "policy.safetensors")
    spec = card["policy"]
    env = gymnasium.make(card["env"], **card["env_kwargs"])  # register your own environment first
    policy = ActorCriticPolicy(
        env.observation_space,
        env.action_space,
        lambda _: 0.0,
        net_arch={"pi": spec["net"], "vf": spec["net"]},
        activation_fn={"tanh": torch.nn.Tanh, "relu": torch.nn.ReLU}[spec["activation"]],
    )
    env.close()

    state = policy.state_dict()
    for i in range(len(spec["net"])):
        for kind in ("weight", "bias"):  # every second layer of the policy's Sequential is an activation
            state[f"mlp_extractor.policy_net.{2 * i}.{kind}"] = arrays[f"actor.{i}.{kind}"]
    for kind in ("weight", "bias"):
        state[f"action_net.{kind}"] = arrays[f"actor.out.{kind}"]
    if "actor.log_std" in arrays:
        state["log_std"] = arrays["actor.log_std"]
    policy.load_state_dict(state)

    divisor = spec["observation"][0]["divisor"]  # 255 for bytes from 0 to 255, otherwise 1

    def act(observation: Any) -> Any:
        observation = np.asarray(observation) / np.float32(divisor)
        if "observation_mean" in arrays:
            mean, std = arrays["observation_mean"].numpy(), arrays["observation_std"].numpy()
            observation = np.clip((observation - mean) / std, -10, 10)
        return policy.predict(observation, deterministic=True)[0]

    return act


if __name__ == "__main__":
    trained = millrace.train("CartPole-v1", steps=5_000, eval_episodes=5)
    print(stable_baselines3_actor(trained)(np.array([0.0, 0.1, 0.0, -0.1], np.float32)))
