"""Tianshou's PPO with its DummyVectorEnv, which is faster for CartPole than its subprocesses (`--how subproc`).

Adam's epsilon is 1e-5, as for all peers. This file sets the decreasing clip range and learning rate before each update.
"""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import torch
from tianshou.algorithm import PPO
from tianshou.algorithm.modelfree.reinforce import ProbabilisticActorPolicy
from tianshou.algorithm.optim import AdamOptimizerFactory
from tianshou.data import Collector, VectorReplayBuffer
from tianshou.env import DummyVectorEnv, SubprocVectorEnv
from tianshou.utils.net.common import Net
from tianshou.utils.net.discrete import DiscreteActor, DiscreteCritic
from tianshou.utils.torch_utils import policy_within_training_step

from benchmarks.peers.peer_run import PeerRun, scheduled


def main() -> None:
    torch.set_num_threads(1)
    run = PeerRun()
    s = run.settings
    np.random.seed(s["seed"])
    torch.manual_seed(s["seed"])
    vectorized = SubprocVectorEnv if run.how == "subproc" else DummyVectorEnv
    envs = vectorized([lambda: gymnasium.make(s["env"])] * s["envs"])
    envs.seed(s["seed"])
    space: Any = gymnasium.make(s["env"])
    shape = space.observation_space.shape

    def net() -> Any:
        return Net(state_shape=shape, hidden_sizes=(64, 64), activation=torch.nn.Tanh)

    actor = DiscreteActor(preprocess_net=net(), action_shape=space.action_space.n, softmax_output=False)
    critic = DiscreteCritic(preprocess_net=net())
    for module in [*actor.modules(), *critic.modules()]:
        if isinstance(module, torch.nn.Linear):
            torch.nn.init.orthogonal_(module.weight, 2**0.5)
            torch.nn.init.zeros_(module.bias)
    torch.nn.init.orthogonal_(actor.last.model[-1].weight, 0.01)
    torch.nn.init.orthogonal_(critic.last.model[-1].weight, 1.0)
    policy = ProbabilisticActorPolicy(
        actor=actor,
        dist_fn=lambda logits: torch.distributions.Categorical(logits=logits),
        action_space=space.action_space,
        action_scaling=False,
        action_bound_method=None,
    )
    algorithm = PPO(
        policy=policy,
        critic=critic,
        optim=AdamOptimizerFactory(lr=s["learning_rate"], eps=1e-5),
        eps_clip=s["clip_range"],
        vf_coef=s["vf_coef"],
        ent_coef=s["ent_coef"],
        max_grad_norm=s["max_grad_norm"],
        gae_lambda=s["gae_lambda"],
        gamma=s["gamma"],
        max_batchsize=s["batch_size"],
    )
    rows = s["envs"] * s["rollout_steps"]
    collector = Collector(algorithm, envs, VectorReplayBuffer(rows, s["envs"]))
    collector.reset()

    def greedy(obs: Any) -> Any:
        with torch.no_grad():
            return actor(obs)[0].argmax(-1).numpy()

    env_steps = 0
    ended = False
    while not ended:
        for group in algorithm.optim._optim.param_groups:
            group["lr"] = scheduled(s, "learning_rate", env_steps)
        algorithm.eps_clip = scheduled(s, "clip_range", env_steps)
        with policy_within_training_step(policy):
            collector.collect(n_step=rows)
            algorithm.update(collector.buffer, s["batch_size"], s["n_epochs"])
        collector.reset_buffer(keep_statistics=True)
        env_steps += rows
        ended = run.update(env_steps, greedy)


if __name__ == "__main__":
    main()
