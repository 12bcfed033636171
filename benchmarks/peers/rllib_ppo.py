"""RLlib's PPO: two env runners with half of the env copies each, and a learner in the driver.

RLlib lacks these settings: a decreasing clip range (it stays 0.2), and an epsilon of 1e-5 for Adam. It adds rows at the end
of episodes, so a minibatch may contain a few more rows than requested.
"""

from __future__ import annotations

import logging
from typing import Any

import torch
from ray import init, shutdown
from ray.rllib.algorithms.ppo import PPOConfig
from ray.rllib.core.rl_module.default_model_config import DefaultModelConfig

from benchmarks.peers.peer_run import PeerRun

RUNNERS = 2


def main() -> None:
    torch.set_num_threads(1)
    run = PeerRun()
    s = run.settings
    logging.getLogger("ray").setLevel(logging.ERROR)
    runners = s.get("processes", RUNNERS)
    init(num_cpus=runners + 1, include_dashboard=False, log_to_driver=False, logging_level=logging.ERROR)
    rate = s["learning_rate"]
    rows = s["envs"] * s["rollout_steps"]
    config = (
        PPOConfig()
        .environment(s["env"])
        .framework("torch", torch_skip_nan_gradients=False)
        .env_runners(
            num_env_runners=runners,
            num_envs_per_env_runner=s["envs"] // runners,
            rollout_fragment_length=s["rollout_steps"],
        )
        .learners(num_learners=0)
        .training(
            lr=[[0, rate], [s["steps"], 0.0]] if s["learning_rate_schedule"] == "linear" else rate,
            gamma=s["gamma"],
            lambda_=s["gae_lambda"],
            train_batch_size_per_learner=rows,
            minibatch_size=s["batch_size"],
            num_epochs=s["n_epochs"],
            clip_param=s["clip_range"],
            vf_clip_param=float("inf"),
            use_kl_loss=False,
            vf_loss_coeff=s["vf_coef"],
            entropy_coeff=s["ent_coef"],
            grad_clip=s["max_grad_norm"],
            grad_clip_by="global_norm",
        )
        .rl_module(model_config=DefaultModelConfig(fcnet_hiddens=[64, 64], fcnet_activation="tanh", vf_share_layers=False))
        .reporting(min_time_s_per_iteration=0, min_sample_timesteps_per_iteration=0)
        .debugging(seed=s["seed"], log_level="ERROR")
    )
    algorithm = config.build_algo()

    def greedy(obs: Any) -> Any:
        module: Any = algorithm.get_module()
        with torch.no_grad():
            return module.forward_inference({"obs": torch.from_numpy(obs)})["action_dist_inputs"].argmax(-1).numpy()

    ended = False
    try:
        while not ended:
            result = algorithm.train()
            ended = run.update(int(result["num_env_steps_sampled_lifetime"]), greedy)
    finally:
        algorithm.stop()
        shutdown()


if __name__ == "__main__":
    main()
