"""Sample Factory's APPO. `--how`: `serial` in one process, `async` with two workers and a learner, or `own` settings.

`own` uses the settings in its documentation. Sample Factory lacks these settings: a decreasing clip range (it stays 0.2,
which clips ratios to 1 / 1.2 … 1.2), and the true last value of a truncated episode. With `async` and `own`, the learner is
a separate process, which reports the updates, and weights may be several updates old.
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

from benchmarks.peers.peer_run import PeerRun

WORKERS = 2
ARGV = "BENCHMARKED"  # environment variable for the arguments, because child processes are started with other ones


class ReportingLearner:
    """Makes Sample Factory's learner report each update."""

    run: PeerRun | None = None
    train = Learner.train
    ended = False

    @staticmethod
    def train_and_report(learner: Any, batch: Any) -> Any:
        stats = ReportingLearner.train(learner, batch)
        if ReportingLearner.run is None:
            torch.set_num_threads(1)
            ReportingLearner.run = PeerRun(json.loads(os.environ[ARGV]))
        if not ReportingLearner.ended and ReportingLearner.run.update(learner.env_steps, lambda obs: _greedy(learner, obs)):
            ReportingLearner.ended = True
            learner.env_steps += int(learner.cfg.train_for_env_steps)  # so that all of Sample Factory's processes end
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


Learner.train = ReportingLearner.train_and_report  # at import, so that it applies in every process that imports this file


def make(name: str, cfg: Any = None, env_config: Any = None, render_mode: Any = None) -> Any:
    """Make one env copy."""
    return gymnasium.make(name) if render_mode is None else gymnasium.make(name, render_mode=render_mode)


def arguments(s: dict[str, Any], how: str) -> list[str]:
    """The settings as flags of Sample Factory."""
    workers = s.get("processes", WORKERS)
    common = {
        "env": s["env"], "algo": "APPO", "experiment": "benchmark", "train_dir": Path.cwd(), "seed": s["seed"],
        "train_for_env_steps": s["steps"], "device": "cpu", "use_rnn": False, "num_workers": workers,
        "save_every_sec": 10**6, "save_best_every_sec": 10**6, "with_vtrace": False,
    }  # fmt: skip
    if how == "own":  # from the example for CartPole in its documentation
        own = {"num_envs_per_worker": 20, "policy_workers_per_policy": 2, "recurrence": 1, "batch_size": 512}
        named = common | own | {"reward_scale": 0.1}
    else:
        serial = how == "serial"
        rows = s["envs"] * s["rollout_steps"]
        splits = 1 if serial or s["envs"] == workers else 2
        named = common | {
            "serial_mode": serial, "async_rl": not serial, "num_workers": 1 if serial else workers,
            "num_envs_per_worker": s["envs"] if serial else s["envs"] // workers, "worker_num_splits": splits,
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
    run = PeerRun()
    register_env(run.settings["env"], make)
    argv = arguments(run.settings, run.how)
    parser, _ = parse_sf_args(argv=argv)
    cfg = parse_full_cfg(parser, argv)
    if run.how != "own" and run.settings["learning_rate_schedule"] == "linear":
        cfg.lr_schedule = "linear_decay"  # Sample Factory has this setting, but its command line does not
    return int(run_rl(cfg))


if __name__ == "__main__":
    sys.exit(main())
