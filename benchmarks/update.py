"""A PPO minibatch update, ours against the usual style: `python -m benchmarks.update`.

Ours is `PPO.step`, the code that `PPO.update` runs. Both do the same work on the same rows (4 observations, 2 actions,
actor and critic 4-64-64-·, tanh): take the minibatch out of the batch, normalise advantages, clipped surrogate, value
loss, entropy, approx_kl, clip fraction, gradient clipped by its norm, Adam with eps 1e-5, losses read as numbers. The
usual style is modules, `torch.distributions.Categorical`, `clip_grad_norm_` and Adam as it comes. One torch thread, one
process, interleaved; medians of rounds.
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
from collections.abc import Callable
from pathlib import Path

import torch
from rich.console import Console
from rich.table import Table
from torch import Tensor, nn

from learner.algorithms.actor_critic import Minibatch
from learner.algorithms.fused import MOST_ROWS
from learner.algorithms.ppo import PPO
from learner.hyperparameters import PPOConfig
from protocol.specs import ActionSpec, Leaf, PolicySpec

RESULTS = Path(__file__).parent / "results"
TARGETS = {64: 0.2, 256: 0.4, 2048: 0.65}  # rows of a minibatch -> what our time may be, as a share of the usual style's
POLICY = PolicySpec((Leaf("", "box", (4,), "float32"),), ActionSpec("discrete", (), "int64", (2,), (0,)))
CONFIG = PPOConfig(ent_coef=0.01)
ROWS = 4096


class UsualAgent(nn.Module):
    """Actor and critic as most programs have them."""

    def __init__(self) -> None:
        super().__init__()
        self.actor, self.critic = self._mlp(2, 0.01), self._mlp(1, 1.0)

    @staticmethod
    def _mlp(outputs: int, gain: float) -> nn.Sequential:
        layers: list[nn.Module] = []
        for inputs, width, scale in ((4, 64, 2**0.5), (64, 64, 2**0.5), (64, outputs, gain)):
            linear = nn.Linear(inputs, width)
            nn.init.orthogonal_(linear.weight, scale)
            nn.init.zeros_(linear.bias)
            layers += [linear, nn.Tanh()]
        return nn.Sequential(*layers[:-1])

    def evaluate(self, x: Tensor, action: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Log-probability, entropy and value, each [B]."""
        distribution = torch.distributions.Categorical(logits=self.actor(x))
        return distribution.log_prob(action), distribution.entropy(), self.critic(x).flatten()  # type: ignore[no-untyped-call]


def usual(rows: Minibatch) -> Callable[[Tensor], object]:
    """An update in the usual style on rows of a batch, by their numbers."""
    agent = UsualAgent()
    optimizer = torch.optim.Adam(agent.parameters(), lr=CONFIG.learning_rate, eps=1e-5)

    def update(index: Tensor) -> object:
        log_prob, entropy, value = agent.evaluate(rows.x[index], rows.action[index])
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
        loss.backward()
        nn.utils.clip_grad_norm_(agent.parameters(), CONFIG.max_grad_norm)
        optimizer.step()
        return loss.item(), policy_loss.item(), value_loss.item(), entropy_loss.item(), approx_kl, clip_fraction

    return update


def ours(rows: Minibatch) -> Callable[[Tensor], object]:
    """An update by `PPO.step` on rows of a batch, by their numbers."""
    algorithm = PPO(CONFIG, POLICY, total_steps=1, seed=0)
    in_numpy = rows.in_numpy()

    def update(index: Tensor) -> object:
        small = len(index) <= MOST_ROWS  # as `Parts.minibatches` chooses
        return algorithm.step(in_numpy.rows(index.numpy()) if small else rows.rows(index), CONFIG.clip_range)

    return update


def batch(generator: torch.Generator) -> Minibatch:
    def normal(*shape: int) -> Tensor:
        return torch.randn(shape, generator=generator)

    action = torch.randint(2, (ROWS,), generator=generator)
    return Minibatch(normal(ROWS, 4), (), action, -0.693 + 0.1 * normal(ROWS), normal(ROWS), normal(ROWS))


def milliseconds(update: Callable[[Tensor], object], indices: list[Tensor]) -> float:
    start = time.perf_counter()
    for index in indices:
        update(index)
    return (time.perf_counter() - start) / len(indices) * 1e3


def measure(size: int, rounds: int) -> dict[str, object]:
    """Milliseconds of an update of `size` rows: medians of interleaved rounds, and of the ratio within each round."""
    generator = torch.Generator().manual_seed(0)
    rows = batch(generator)
    updates = {"usual": usual(rows), "ours": ours(rows)}
    repeats = max(20, 20_000 // (size + 64))
    times: dict[str, list[float]] = {name: [] for name in updates}
    for turn in range(rounds + 1):
        indices = [torch.randperm(ROWS, generator=generator)[:size] for _ in range(repeats)]
        for name, update in updates.items():
            taken = milliseconds(update, indices)
            if turn:  # the first round warms up
                times[name].append(taken)
    ratios = [our / their for our, their in zip(times["ours"], times["usual"], strict=True)]
    medians = {f"{name}_ms": statistics.median(found) for name, found in times.items()}
    return {"rows": size, **medians, "ratio": statistics.median(ratios), "target": TARGETS[size], "rounds": rounds}


def main() -> None:
    parser = argparse.ArgumentParser(description="Time a PPO minibatch update against the usual style.")
    parser.add_argument("--rounds", type=int, default=15)
    rounds = parser.parse_args().rounds
    torch.set_num_threads(1)
    results = [measure(size, rounds) for size in TARGETS]
    table = Table("rows", "usual ms", "ours ms", "ratio", "target", title=f"PPO minibatch update, medians of {rounds}")
    for r in results:
        table.add_row(str(r["rows"]), *(f"{r[key]:.3f}" for key in ("usual_ms", "ours_ms", "ratio")), f"≤ {r['target']}")
    Console().print(table)
    RESULTS.mkdir(exist_ok=True)
    record = {"benchmark": "update", "torch": torch.__version__, "threads": 1, "results": results}
    (RESULTS / "update.json").write_text(json.dumps(record, indent=2) + "\n")


if __name__ == "__main__":
    main()
