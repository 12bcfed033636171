"""TorchRL's PPO: its collector with two processes of serial env copies (`--how sync` or `async`), its GAE and clipped loss.

`async`, which is faster, returns the data of the first process that is ready. A batch is then from a single process, is
twice as long, and may be one version old.
"""

from __future__ import annotations

from typing import Any

import torch
from tensordict.nn import TensorDictModule
from torchrl.collectors import MultiAsyncCollector, MultiSyncCollector
from torchrl.data import LazyTensorStorage, ReplayBuffer, SamplerWithoutReplacement
from torchrl.envs import GymWrapper, SerialEnv
from torchrl.modules import MLP, ProbabilisticActor, ValueOperator
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

from benchmarks.peers.peer_run import PeerRun, scheduled

PROCESSES = 2


class Make:
    """Makes the env copies of one process. It is a class, so that it can be pickled and sent to that process."""

    def __init__(self, env: str, copies: int) -> None:
        self.env = env
        self.copies = copies

    def one(self) -> Any:
        import gymnasium

        return GymWrapper(gymnasium.make(self.env), categorical_action_encoding=True)

    def __call__(self) -> Any:
        torch.set_num_threads(1)
        return SerialEnv(self.copies, self.one)


def network(inputs: int, outputs: int, last: float) -> Any:
    """A 64-64 tanh network with orthogonal initialization, as for all peers."""
    net = MLP(in_features=inputs, out_features=outputs, num_cells=[64, 64], activation_class=torch.nn.Tanh)
    layers = [module for module in net.modules() if isinstance(module, torch.nn.Linear)]
    for layer in layers:
        torch.nn.init.orthogonal_(layer.weight, last if layer is layers[-1] else 2**0.5)
        torch.nn.init.zeros_(layer.bias)
    return net


def main() -> None:
    torch.set_num_threads(1)
    run = PeerRun()
    s = run.settings
    torch.manual_seed(s["seed"])
    processes = s.get("processes", PROCESSES)
    copies = s["envs"] // processes
    rows = s["envs"] * s["rollout_steps"]
    make = Make(s["env"], copies)
    one = make.one()
    inputs = one.observation_spec["observation"].shape[-1]
    outputs = one.action_spec.space.n
    pi = network(inputs, outputs, 0.01)
    actor = ProbabilisticActor(
        TensorDictModule(pi, in_keys=["observation"], out_keys=["logits"]),
        in_keys=["logits"],
        spec=one.action_spec,
        distribution_class=torch.distributions.Categorical,
        return_log_prob=True,
    )
    critic = ValueOperator(network(inputs, 1, 1.0), in_keys=["observation"])
    gae = GAE(gamma=s["gamma"], lmbda=s["gae_lambda"], value_network=critic, average_gae=False)
    loss = ClipPPOLoss(
        actor_network=actor,
        critic_network=critic,
        clip_epsilon=s["clip_range"],
        entropy_bonus=s["ent_coef"] > 0,
        entropy_coeff=s["ent_coef"],
        critic_coeff=s["vf_coef"],
        loss_critic_type="l2",
        normalize_advantage=True,
        log_explained_variance=False,
    )
    adam = torch.optim.Adam(loss.parameters(), lr=s["learning_rate"], eps=1e-5)
    buffer = ReplayBuffer(storage=LazyTensorStorage(rows), sampler=SamplerWithoutReplacement(), batch_size=s["batch_size"])
    collector = (MultiAsyncCollector if run.how == "async" else MultiSyncCollector)(
        [make] * processes,
        actor,
        frames_per_batch=rows,
        total_frames=-1,
        **({} if run.how == "async" else {"cat_results": 0}),
    )
    collector.set_seed(s["seed"])

    def greedy(obs: Any) -> Any:
        with torch.no_grad():
            return pi(torch.from_numpy(obs)).argmax(-1).numpy()

    env_steps = 0
    try:
        for batch in collector:
            with torch.no_grad():
                gae(batch)
            for group in adam.param_groups:
                group["lr"] = scheduled(s, "learning_rate", env_steps)
            loss.clip_epsilon.fill_(scheduled(s, "clip_range", env_steps))
            buffer.extend(batch.reshape(-1))
            for _ in range(s["n_epochs"]):
                for minibatch in buffer:
                    found = loss(minibatch)
                    objective = found["loss_objective"] + found["loss_critic"] + found.get("loss_entropy", 0.0)
                    adam.zero_grad()
                    objective.backward()
                    torch.nn.utils.clip_grad_norm_(loss.parameters(), s["max_grad_norm"])
                    adam.step()
            buffer.empty()
            collector.update_policy_weights_()
            env_steps += batch.numel()
            if run.update(env_steps, greedy):
                break
    finally:
        collector.shutdown()


if __name__ == "__main__":
    main()
