"""PPO, A2C, DQN, SAC and TD3 of Stable-Baselines3 as a program whose settings have millrace's names.

`benchmarks/train.py`, `benchmarks/continuous.py` and `benchmarks/real_sizes.py` run it. It uses one torch thread, which is
fastest for small networks, or `--threads`. For each update it prints a line of JSON with the env steps and the time by the
monotonic clock. Two settings differ: millrace's DQN counts the age of a hard target in gradient steps, and may have several
env copies.
"""

from __future__ import annotations

import argparse
import json
import time
from typing import Any

import torch
from stable_baselines3 import A2C, DQN, PPO, SAC, TD3
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback, CallbackList, EvalCallback, StopTrainingOnRewardThreshold
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.preprocessing import is_image_space
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnv

import millrace.extras.envs  # noqa: F401  # registers millrace/Atari-v0


class PrintUpdates(BaseCallback):
    """Prints a line for each update."""

    def _on_step(self) -> bool:
        return True

    def _on_rollout_start(self) -> None:
        print(json.dumps({"env_steps": self.num_timesteps, "at_s": time.monotonic()}), flush=True)


def make(s: dict[str, Any], env: VecEnv) -> BaseAlgorithm:
    """Make the algorithm that the settings describe."""
    linear = s.get("learning_rate_schedule") == "linear"
    rate = s["learning_rate"]
    seed = {"seed": s["seed"], "device": "cpu", "gamma": s["gamma"]}
    match s["algo"]:
        case "dqn":
            return DQN(
                "MlpPolicy",
                env,
                learning_rate=rate,
                batch_size=s["batch_size"],
                buffer_size=s["replay_size"],
                learning_starts=s["learning_starts"],
                train_freq=s["envs"] * s["rollout_steps"],  # because SB3's DQN has a single env copy here
                gradient_steps=s["gradient_steps"],
                target_update_interval=10,  # in env steps; in effect, the target is copied before each update
                exploration_fraction=s["epsilon_steps"] / s["steps"],
                exploration_final_eps=s["epsilon_end"],
                max_grad_norm=s["max_grad_norm"],
                policy_kwargs={"net_arch": s["net"]},
                **seed,
            )
        case "sac" | "td3":
            replay = {name: s[name] for name in ("learning_starts", "batch_size", "tau")}
            kind: Any = {"sac": SAC, "td3": TD3}[s["algo"]]
            made: BaseAlgorithm = kind(
                "MlpPolicy",
                env,
                learning_rate=rate,
                buffer_size=s["replay_size"],
                policy_kwargs={"net_arch": s["net"]},
                **seed,
                **replay,
            )
            return made
        case "a2c":
            names = ("gae_lambda", "ent_coef", "vf_coef", "max_grad_norm")
            return A2C(
                "MlpPolicy",
                env,
                learning_rate=rate,
                n_steps=s["rollout_steps"],
                **seed,
                **{name: s[name] for name in names},
            )
        case _:
            clip = s["clip_range"]
            return PPO(
                "CnnPolicy" if is_image_space(env.observation_space) else "MlpPolicy",
                env,
                n_steps=s["rollout_steps"],
                batch_size=s["batch_size"],
                n_epochs=s["n_epochs"],
                gae_lambda=s["gae_lambda"],
                ent_coef=s["ent_coef"],
                vf_coef=s["vf_coef"],
                max_grad_norm=s["max_grad_norm"],
                learning_rate=(lambda left: left * rate) if linear else rate,
                clip_range=(lambda left: left * clip) if linear else clip,
                **seed,
            )


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("settings", type=json.loads)
    parser.add_argument("--how", choices=("one", "subproc"), default="one")
    parser.add_argument("--target", type=float, help="stop as soon as a greedy evaluation averages at least this")
    parser.add_argument("--threads", type=int, default=1)
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    s: dict[str, Any] = arguments.settings
    copies = 1 if s["algo"] in ("dqn", "sac", "td3") else s["envs"]
    env = make_vec_env(s["env"], copies, s["seed"], vec_env_cls=SubprocVecEnv if arguments.how == "subproc" else DummyVecEnv)
    evaluate: EvalCallback | None = None
    if arguments.target is not None:
        evaluate = EvalCallback(
            make_vec_env(s["env"], 8, 1000),
            callback_on_new_best=StopTrainingOnRewardThreshold(arguments.target),
            n_eval_episodes=s["eval_episodes"],
            eval_freq=max(1, s["eval_every"] // copies),
            verbose=0,
        )
    make(s, env).learn(s["steps"], CallbackList([PrintUpdates(), *([evaluate] if evaluate else [])]))
    if evaluate and evaluate.best_mean_reward >= arguments.target:
        print(json.dumps({"solved": float(evaluate.best_mean_reward), "at_s": time.monotonic()}), flush=True)
    env.close()


if __name__ == "__main__":
    main()
