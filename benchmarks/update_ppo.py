"""A PPO minibatch update in three ways: the usual style, `PPO.step` with networks in torch, and `PPO.step` as it is.

All do the same work on the same rows (4 observations, 2 actions, actor and critic 4-64-64-·, tanh): they take the minibatch
out of the batch, normalize advantages, compute the clipped surrogate, value loss, entropy, approx_kl and clip fraction, clip
the gradient by its norm, take a step of Adam with eps 1e-5, and read the losses as numbers. The usual style uses modules,
`torch.distributions.Categorical`, `clip_grad_norm_` and torch's own Adam.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import cycle

import torch
from torch import Tensor, nn

from benchmarks.contest import Contest, passes_in_torch, repeated
from millrace.learner.algorithms.minibatches import Minibatch
from millrace.learner.algorithms.ppo import PPO
from millrace.learner.config.hyperparameters import PPOConfig
from millrace.protocol.specs import ActionSpec, Leaf, PolicySpec

POLICY = PolicySpec((Leaf("", "box", (4,), "float32"),), ActionSpec("discrete", (), "int64", (2,), (0,)))
CONFIG = PPOConfig(ent_coef=0.01)
ROWS = 4096


class UsualAgent(nn.Module):
    """Actor and critic as most programs write them."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.actor, self.critic = self._mlp(2, 0.01, width), self._mlp(1, 1.0, width)

    @staticmethod
    def _mlp(outputs: int, gain: float, width: int) -> nn.Sequential:
        layers: list[nn.Module] = []
        for inputs, units, scale in ((4, width, 2**0.5), (width, width, 2**0.5), (width, outputs, gain)):
            linear = nn.Linear(inputs, units)
            nn.init.orthogonal_(linear.weight, scale)
            nn.init.zeros_(linear.bias)
            layers += [linear, nn.Tanh()]
        return nn.Sequential(*layers[:-1])

    def evaluate(self, x: Tensor, action: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Log-probability, entropy and value, each [B]."""
        distribution = torch.distributions.Categorical(logits=self.actor(x))
        return distribution.log_prob(action), distribution.entropy(), self.critic(x).flatten()  # type: ignore[no-untyped-call]


def usual(rows: Minibatch, width: int) -> Callable[[Tensor], object]:
    """An update in the usual style. It takes the indices of its rows in the batch."""
    agent = UsualAgent(width)
    optimizer = torch.optim.Adam(agent.parameters(), lr=CONFIG.learning_rate, eps=1e-5)

    def update(index: Tensor) -> object:
        log_prob, entropy, value = agent.evaluate(rows.features[index], rows.action[index])
        advantage = rows.advantage[index]
        advantage = (advantage - advantage.mean()) / (advantage.std() + 1e-8)
        log_ratio = log_prob - rows.log_prob[index]
        ratio = log_ratio.exp()
        with torch.no_grad():
            approx_kl = ((ratio - 1) - log_ratio).mean().item()
            clip_fraction = ((ratio - 1).abs() > CONFIG.clip_range).float().mean().item()
        clipped = advantage * torch.clamp(ratio, 1 - CONFIG.clip_range, 1 + CONFIG.clip_range)
        policy_loss = -torch.min(advantage * ratio, clipped).mean()
        value_loss = nn.functional.mse_loss(rows.target[index], value)
        entropy_loss = -entropy.mean()
        loss = policy_loss + CONFIG.ent_coef * entropy_loss + CONFIG.vf_coef * value_loss
        optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        nn.utils.clip_grad_norm_(agent.parameters(), CONFIG.max_grad_norm)
        optimizer.step()
        return loss.item(), policy_loss.item(), value_loss.item(), entropy_loss.item(), approx_kl, clip_fraction

    return update


def ours(rows: Minibatch, policy: PolicySpec, graph: bool) -> Callable[[Tensor], object]:
    """An update by `PPO.step`. It takes the indices of its rows in the batch. `graph`: let networks run in torch."""
    with passes_in_torch(graph):
        algorithm = PPO(CONFIG, policy, total_steps=1, seed=0)
    return lambda index: algorithm.step(rows.select(index))


def contest(size: int, target: float | None, width: int = 64) -> Contest:
    """The contest on minibatches of `size` rows, with layers of `width` units."""
    generator = torch.Generator().manual_seed(0)

    def normal(*shape: int) -> Tensor:
        return torch.randn(shape, generator=generator)

    action = torch.randint(2, (ROWS,), generator=generator)
    rows = Minibatch(normal(ROWS, 4), (), action, -0.693 + 0.1 * normal(ROWS), normal(ROWS), normal(ROWS))
    policy = PolicySpec(POLICY.observation, POLICY.action, (width, width))
    indices = [torch.randperm(ROWS, generator=generator)[:size] for _ in range(50)]
    updates = {"peer": usual(rows, width), "graph": ours(rows, policy, True), "ours": ours(rows, policy, False)}
    repeats = max(2, 1000 // (size + 64))

    def run(update: Callable[[Tensor], object]) -> Callable[[], float]:
        order = cycle(indices)
        return lambda: repeated(lambda: update(next(order)), repeats)

    runs = {name: run(update) for name, update in updates.items()}
    return Contest(f"PPO, {width} units", size, "usual", repeats, target, runs)
