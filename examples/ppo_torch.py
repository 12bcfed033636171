"""PPO in PyTorch over `millrace.RolloutService`: `python examples/ppo_torch.py`.

The workers act with the policy `MLP(300, 300)`. Everything else is in this file: the critic, the advantages, the loss, the
optimizer. With these settings, the weights are bit for bit those of `millrace train --algo ppo`, which also uses PyTorch for
layers of more than 256 units.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import linear, log_softmax

import millrace
from millrace.algorithms import Purpose, torch_seed


@dataclass(frozen=True)
class Settings:
    """The settings, named as in `millrace train`."""

    env: str = "CartPole-v1"
    steps: int = 100_000
    workers: int = 2
    envs: int = 8
    lanes: int = 4
    rollout_steps: int = 64
    net: tuple[int, ...] = (300, 300)
    n_epochs: int = 10
    batch_size: int = 128
    learning_rate: float = 3e-4
    gamma: float = 0.99
    gae_lambda: float = 0.95
    clip_range: float = 0.2
    vf_coef: float = 0.5
    max_grad_norm: float = 0.5
    seed: int = 1


class ActorCritic:
    """An actor and a critic whose parameters are one flat vector that begins with the actor's, as workers expect them."""

    def __init__(self, actor: tuple[millrace.Piece, ...], inputs: int, settings: Settings) -> None:
        widths = (inputs, *settings.net)
        critic = [(f"critic.{i}", widths[i + 1], widths[i], 2**0.5) for i in range(len(settings.net))]
        shapes = [(piece.name, piece.shape, piece.gain) for piece in actor]
        for name, rows, columns, gain in [*critic, ("critic.out", 1, widths[-1], 1.0)]:
            shapes += [(f"{name}.weight", (rows, columns), gain), (f"{name}.bias", (rows,), 0.0)]
        generator = torch.Generator().manual_seed(torch_seed(settings.seed, Purpose.WEIGHTS))
        parts = []
        for _, shape, gain in shapes:
            part = torch.zeros(shape)
            parts.append((torch.nn.init.orthogonal_(part, gain, generator) if gain else part).flatten())
        self.flat = torch.cat(parts)
        self.grad = self.flat.grad = torch.zeros_like(self.flat)
        self.actor_size = sum(piece.size for piece in actor)
        self.depth = len(settings.net)
        self.parameters: dict[str, Tensor] = {}
        views = (torch.split(flat, [len(part) for part in parts]) for flat in (self.flat, self.grad))
        for (name, shape, _), view, grad in zip(shapes, *views, strict=True):
            self.parameters[name] = view.view(shape).detach().requires_grad_()
            self.parameters[name].grad = grad.view(shape)

    def _mlp(self, name: str, x: Tensor) -> Tensor:
        for i in range(self.depth):
            x = linear(x, self.parameters[f"{name}.{i}.weight"], self.parameters[f"{name}.{i}.bias"]).tanh()
        return linear(x, self.parameters[f"{name}.out.weight"], self.parameters[f"{name}.out.bias"])

    def log_prob(self, obs: Tensor, action: Tensor) -> Tensor:
        """Log π(action) [B] for obs [B, D]."""
        return log_softmax(self._mlp("actor", obs), -1).gather(-1, action[:, None])[:, 0]

    def value(self, obs: Tensor) -> Tensor:
        """V(obs) [B]."""
        return self._mlp("critic", obs)[:, 0]


def advantages(batch: millrace.RolloutBatch, values: np.ndarray, gamma: float, gae_lambda: float) -> np.ndarray:
    """Generalized advantage estimates [T, N]; values are [T+1, N]."""
    bootstrap = np.where(batch.terminated, np.float32(0), values[1:])
    found = np.where(batch.valid, batch.reward + np.float32(gamma) * bootstrap - values[:-1], np.float32(0))
    goes_on = (batch.valid & ~batch.terminated & ~batch.truncated) * np.float32(gamma * gae_lambda)
    for t in range(len(found) - 2, -1, -1):
        found[t] += goes_on[t] * found[t + 1]
    return found


def learn(
    agent: ActorCritic,
    optimizer: torch.optim.Optimizer,
    generator: torch.Generator,
    batch: millrace.RolloutBatch,
    settings: Settings,
) -> None:
    """One update: several epochs of minibatches."""
    rows = batch.valid.size
    obs = torch.from_numpy(batch.obs.reshape(rows + batch.obs.shape[1], -1))
    with torch.no_grad():
        values = agent.value(obs).numpy().reshape(batch.obs.shape[:2])
    estimates = advantages(batch, values, settings.gamma, settings.gae_lambda)
    target, advantage = (torch.from_numpy(each.reshape(rows)) for each in (estimates + values[:-1], estimates))
    action, log_prob = torch.from_numpy(batch.action.reshape(rows)), torch.from_numpy(batch.log_prob.reshape(rows))
    index = np.flatnonzero(batch.valid)
    for _ in range(settings.n_epochs):
        shuffled = torch.from_numpy(index[torch.randperm(len(index), generator=generator).numpy()])
        for some in shuffled.tensor_split(-(-len(index) // settings.batch_size)):
            std, mean = torch.std_mean(advantage[some])
            scaled = (advantage[some] - mean) / (std + 1e-8)
            ratio = (agent.log_prob(obs[some], action[some]) - log_prob[some]).exp()
            clipped = ratio.clamp(1 - settings.clip_range, 1 + settings.clip_range)
            policy_loss = -torch.minimum(ratio * scaled, clipped * scaled).mean()
            value_loss = (agent.value(obs[some]) - target[some]).square().mean()
            agent.grad.zero_()
            (policy_loss + settings.vf_coef * value_loss).backward()  # type: ignore[no-untyped-call]
            norm = agent.grad.norm().item()
            if norm > settings.max_grad_norm:
                agent.grad.mul_(settings.max_grad_norm / norm)
            optimizer.step()


def train(settings: Settings) -> np.ndarray:
    """Train. Returns the actor's parameters [P]."""
    torch.set_num_threads(1)
    names = ("rollout_steps", "workers", "envs", "lanes", "seed")
    collecting: dict[str, Any] = {name: getattr(settings, name) for name in names}
    with millrace.RolloutService(settings.env, millrace.MLP(*settings.net), **collecting) as service:
        inputs = service.policy.layout[0].shape[1]
        agent = ActorCritic(service.policy.layout, inputs, settings)
        optimizer = torch.optim.Adam([agent.flat], lr=settings.learning_rate, eps=1e-5, fused=True)
        generator = torch.Generator().manual_seed(torch_seed(settings.seed, Purpose.SHUFFLES))
        service.publish(agent.flat[: agent.actor_size].numpy())
        for batch in service:
            learn(agent, optimizer, generator, batch, settings)
            service.publish(agent.flat[: agent.actor_size].numpy())
            if service.env_steps + settings.rollout_steps * settings.envs > settings.steps:
                break
        print(service.evaluate(20))
        return agent.flat[: agent.actor_size].numpy()


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="PPO in PyTorch over millrace's rollout service")
    parser.add_argument("--steps", type=int, default=Settings.steps)
    parser.add_argument("--seed", type=int, default=Settings.seed)
    arguments = parser.parse_args()
    train(Settings(steps=arguments.steps, seed=arguments.seed))
