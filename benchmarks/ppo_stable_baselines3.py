"""PPO of Stable-Baselines3 as a program of its own, with our names for its settings: a peer of `train.py` and `memory.py`.

One torch thread, which is its fastest here. Each update is a line of JSON: env steps, and when by the monotonic clock.
"""

from __future__ import annotations

import argparse
import json
import time
from typing import Any

import torch
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback, CallbackList, EvalCallback, StopTrainingOnRewardThreshold
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv


class Told(BaseCallback):
    """A line for each update."""

    def _on_step(self) -> bool:
        return True

    def _on_rollout_start(self) -> None:
        print(json.dumps({"env_steps": self.num_timesteps, "at_s": time.monotonic()}), flush=True)


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("settings", type=json.loads)
    parser.add_argument("--subproc", action="store_true")
    parser.add_argument("--target", type=float, help="stop as soon as a greedy evaluation averages at least this")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    s: dict[str, Any] = arguments.settings
    linear = s["learning_rate_schedule"] == "linear"
    rate, clip = s["learning_rate"], s["clip_range"]
    env = make_vec_env(s["env"], s["envs"], s["seed"], vec_env_cls=SubprocVecEnv if arguments.subproc else DummyVecEnv)
    model = PPO(
        "MlpPolicy",
        env,
        n_steps=s["rollout_steps"],
        batch_size=s["batch_size"],
        n_epochs=s["n_epochs"],
        gamma=s["gamma"],
        gae_lambda=s["gae_lambda"],
        ent_coef=s["ent_coef"],
        vf_coef=s["vf_coef"],
        max_grad_norm=s["max_grad_norm"],
        learning_rate=(lambda left: left * rate) if linear else rate,
        clip_range=(lambda left: left * clip) if linear else clip,
        seed=s["seed"],
        device="cpu",
    )
    callbacks: list[BaseCallback] = [Told()]
    if arguments.target is not None:
        callbacks.append(
            EvalCallback(
                make_vec_env(s["env"], 8, 1000),
                callback_on_new_best=StopTrainingOnRewardThreshold(arguments.target),
                n_eval_episodes=s["eval_episodes"],
                eval_freq=max(1, s["eval_every"] // s["envs"]),
                verbose=0,
            )
        )
    model.learn(s["steps"], CallbackList(callbacks))
    env.close()


if __name__ == "__main__":
    main()
