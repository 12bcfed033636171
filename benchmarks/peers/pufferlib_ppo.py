"""PufferLib's PPO with its serial vector environment, its fastest on two cores. `--how own` selects its own settings.

PufferLib lacks these settings: minibatches of single rows (its minibatches are whole segments), a decreasing clip range (it
stays 0.2), a learning rate that decreases linearly (it decreases like a cosine), and a separate network for the value in its
own policy class (so the class below is ours). It recomputes values within an update, and the advantages with them, as in
V-trace. It clips rewards to [-1, 1].
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import gymnasium
import pufferlib.emulation
import pufferlib.models
import pufferlib.pytorch
import pufferlib.vector
import torch

from benchmarks.peers.peer_run import PeerRun

OWN_COPIES = 16
OWN_STEPS = 500_000  # from its classic_control.ini: the learning rate decreases over these steps, then the run ends


class Policy(torch.nn.Module):
    """Separate 64-64 tanh networks for the actor and the critic."""

    def __init__(self, env: Any) -> None:
        super().__init__()
        inputs = env.single_observation_space.shape[0]
        self.actor = self._net(inputs, env.single_action_space.n, 0.01)
        self.critic = self._net(inputs, 1, 1.0)
        self.hidden_size = 64

    @staticmethod
    def _net(inputs: int, outputs: int, last: float) -> torch.nn.Sequential:
        init: Any = pufferlib.pytorch.layer_init
        hidden = [init(torch.nn.Linear(inputs, 64)), torch.nn.Tanh(), init(torch.nn.Linear(64, 64)), torch.nn.Tanh()]
        return torch.nn.Sequential(*hidden, init(torch.nn.Linear(64, outputs), std=last))

    def forward(self, obs: Any, state: Any = None) -> Any:
        return self.actor(obs), self.critic(obs)

    forward_eval = forward


def make(env: str, **kwargs: Any) -> Any:
    """Make one env copy."""
    return pufferlib.emulation.GymnasiumPufferEnv(gymnasium.make(env), **kwargs)


def config(s: dict[str, Any], own: bool) -> dict[str, Any]:
    """The settings in PufferLib's default.ini. Unless `own`, the common settings replace them."""
    from pufferlib.pufferl import load_config

    argv = sys.argv
    sys.argv = sys.argv[:1]
    found: dict[str, Any] = load_config("default")["train"]
    sys.argv = argv
    found |= {
        "device": "cpu", "seed": s["seed"], "total_timesteps": s["steps"], "env": s["env"], "use_rnn": False,
        "data_dir": str(Path.cwd()), "checkpoint_interval": 10**9,
    }  # fmt: skip
    if own:
        # Its minibatch of 8,192 rows needs 128 copies. With 16 copies, one step on the whole batch is too little to reach
        # a return of 475, so a minibatch is a quarter of the batch.
        return found | {"minibatch_size": OWN_COPIES * found["bptt_horizon"] // 4, "total_timesteps": OWN_STEPS}
    return found | {
        "optimizer": "adam", "adam_beta1": 0.9, "adam_beta2": 0.999, "adam_eps": 1e-5,
        "learning_rate": s["learning_rate"], "anneal_lr": s["learning_rate_schedule"] == "linear",
        "gamma": s["gamma"], "gae_lambda": s["gae_lambda"], "update_epochs": s["n_epochs"],
        "bptt_horizon": s["rollout_steps"], "minibatch_size": s["batch_size"], "clip_coef": s["clip_range"],
        "vf_coef": 2.0 * s["vf_coef"],  # because its value loss is half the squared error
        "vf_clip_coef": 1e9, "max_grad_norm": s["max_grad_norm"], "ent_coef": s["ent_coef"],
        "prio_alpha": 0.0, "prio_beta0": 1.0,
    }  # fmt: skip


def main() -> None:
    from pufferlib.pufferl import PuffeRL

    torch.set_num_threads(1)
    run = PeerRun()
    s = run.settings
    own = run.how == "own"
    if own:
        s["steps"] = max(s["steps"], OWN_STEPS) if run.until_solved else s["steps"]
    torch.manual_seed(s["seed"])
    copies = OWN_COPIES if own else s["envs"]
    in_processes: dict[str, Any] = {
        "backend": pufferlib.vector.Multiprocessing,
        "num_workers": s.get("processes"),
        "overwork": True,  # allow more processes than cores, because they wait for their environments
    }
    how = in_processes if run.how == "processes" else {"backend": pufferlib.vector.Serial}
    envs = pufferlib.vector.make(make, env_kwargs={"env": s["env"]}, num_envs=copies, seed=s["seed"], **how)
    policy: Any = pufferlib.models.Default(envs.driver_env, hidden_size=64) if own else Policy(envs.driver_env)
    trainer = PuffeRL(config(s, own), envs, policy)
    trainer.print_dashboard = lambda *_, **__: None

    def greedy(obs: Any) -> Any:
        with torch.no_grad():
            return policy(torch.from_numpy(obs))[0].argmax(-1).numpy()

    ended = False
    while not ended:
        trainer.evaluate()
        trainer.train()
        ended = run.update(trainer.global_step, greedy)
    trainer.close()


if __name__ == "__main__":
    main()
