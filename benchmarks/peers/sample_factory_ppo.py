"""Sample Factory's APPO: `--how serial` in one process, `async` two workers and a learner, `own` its documented settings.

Cannot be said to it: a clip range that falls (stays 0.2, from 1 / 1.2 to 1.2), a truncated episode's true last value. With
`async` and `own` weights may be some updates old. Its learner is another process then, which is where updates are told.
"""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path
from typing import Any

import gymnasium
import torch
from sample_factory.algo.learning.learner import Learner
from sample_factory.cfg.arguments import parse_full_cfg, parse_sf_args
from sample_factory.envs.env_utils import register_env
from sample_factory.train import run_rl

from benchmarks.peers.told import Told

WORKERS = 2
ARGV = "BENCHMARKED"  # an environment variable: a child process of its own kind is started with other arguments


class TellingLearner:
    """What Sample Factory's learner does after an update, besides."""

    told: Told | None = None
    train = Learner.train
    ended = False

    @staticmethod
    def tell(learner: Any, batch: Any) -> Any:
        stats = TellingLearner.train(learner, batch)
        if TellingLearner.told is None:
            torch.set_num_threads(1)
            TellingLearner.told = Told(json.loads(os.environ[ARGV]))
        if not TellingLearner.ended and TellingLearner.told.update(learner.env_steps, lambda obs: _greedy(learner, obs)):
            TellingLearner.ended = True
            learner.env_steps += int(learner.cfg.train_for_env_steps)  # so that the whole of it ends
        return stats


def _greedy(learner: Any, obs: Any) -> Any:
    net = learner.actor_critic
    training = net.training
    net.eval()
    with torch.no_grad():
        seen = net.normalize_obs({"obs": torch.from_numpy(obs)})
        found = net(seen, torch.zeros(len(obs), 1))["action_logits"].argmax(-1).numpy()
    net.train(training)
    return found


Learner.train = TellingLearner.tell  # in every process that imports this file


def make(name: str, cfg: Any = None, env_config: Any = None, render_mode: Any = None) -> Any:
    """One copy."""
    return gymnasium.make(name, render_mode=render_mode)


def arguments(s: dict[str, Any], how: str) -> list[str]:
    """Its names for the settings."""
    common = {
        "env": s["env"], "algo": "APPO", "experiment": "benchmark", "train_dir": Path.cwd(), "seed": s["seed"],
        "train_for_env_steps": s["steps"], "device": "cpu", "use_rnn": False, "num_workers": WORKERS,
        "save_every_sec": 10**6, "save_best_every_sec": 10**6, "with_vtrace": False,
    }  # fmt: skip
    if how == "own":  # as in its documentation's example for CartPole
        own = {"num_envs_per_worker": 20, "policy_workers_per_policy": 2, "recurrence": 1, "batch_size": 512}
        named = common | own | {"reward_scale": 0.1}
    else:
        serial = how == "serial"
        rows = s["envs"] * s["rollout_steps"]
        named = common | {
            "serial_mode": serial, "async_rl": not serial, "num_workers": 1 if serial else WORKERS,
            "num_envs_per_worker": s["envs"] if serial else s["envs"] // WORKERS, "worker_num_splits": 1 if serial else 2,
            "rollout": s["rollout_steps"], "recurrence": 1, "batch_size": s["batch_size"],
            "num_batches_per_epoch": rows // s["batch_size"], "num_epochs": s["n_epochs"], "shuffle_minibatches": True,
            "gamma": s["gamma"], "gae_lambda": s["gae_lambda"], "learning_rate": s["learning_rate"],
            "ppo_clip_ratio": s["clip_range"], "ppo_clip_value": 1e9, "value_loss_coeff": s["vf_coef"],
            "exploration_loss_coeff": s["ent_coef"], "max_grad_norm": s["max_grad_norm"], "adam_eps": 1e-5,
            "nonlinearity": "tanh", "actor_critic_share_weights": False, "normalize_input": False,
            "normalize_returns": False, "value_bootstrap": True,
        }  # fmt: skip
        return [*(f"--{name}={value}" for name, value in named.items()), "--encoder_mlp_layers", "64", "64"]
    return [f"--{name}={value}" for name, value in named.items()]


def main() -> int:
    torch.set_num_threads(1)
    os.environ[ARGV] = json.dumps(sys.argv[1:])
    told = Told()
    register_env(told.settings["env"], make)
    argv = arguments(told.settings, told.how)
    parser, _ = parse_sf_args(argv=argv)
    cfg = parse_full_cfg(parser, argv)
    if told.how != "own" and told.settings["learning_rate_schedule"] == "linear":
        cfg.lr_schedule = "linear_decay"  # it knows this one; its command line does not
    return int(run_rl(cfg))


if __name__ == "__main__":
    sys.exit(main())
