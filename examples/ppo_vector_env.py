"""PPO in one file over a millrace vector environment: `python examples/ppo_vector_env.py`.

The loop has the style of CleanRL's single-file implementations. From millrace it uses only `make_vec`, in place of
`gymnasium.make_vec(..., vectorization_mode="async")`. One detail of gymnasium 1.x is easily missed: in NEXT_STEP mode, the
step after the end of an episode resets the env copy. The row of this step is not a transition, so the loss leaves it out
(`valid`).
"""

from __future__ import annotations

import argparse
import time
from collections import deque
from contextlib import closing
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from gymnasium.vector import VectorEnv
from gymnasium.wrappers.vector import RecordEpisodeStatistics
from torch import Tensor, nn
from torch.distributions import Categorical

import millrace


@dataclass(frozen=True)
class Settings:
    """RL Baselines3 Zoo's hyperparameters for CartPole-v1."""

    env: str = "CartPole-v1"
    workers: int = 2
    copies: int = 8
    env_steps: int = 100_000
    rollout_steps: int = 32
    epochs: int = 20
    minibatch: int = 256
    learning_rate: float = 1e-3  # decreases to 0
    clip: float = 0.2  # decreases to 0
    gamma: float = 0.98
    lambda_: float = 0.8
    value_weight: float = 0.5
    max_grad_norm: float = 0.5
    seed: int = 1


def network(inputs: int, outputs: int, last_gain: float) -> nn.Sequential:
    """A network with two hidden layers of 64 units and orthogonal initialization."""
    layers: list[nn.Module] = []
    for size_in, size_out, gain in ((inputs, 64, 2**0.5), (64, 64, 2**0.5), (64, outputs, last_gain)):
        linear = nn.Linear(size_in, size_out)
        nn.init.orthogonal_(linear.weight, gain)
        nn.init.zeros_(linear.bias)
        layers += [linear, nn.Tanh()]
    return nn.Sequential(*layers[:-1])


class Agent(nn.Module):
    """An actor and a critic."""

    def __init__(self, env: VectorEnv[Any, Any, Any]) -> None:
        super().__init__()
        inputs = int(np.prod(env.single_observation_space.shape or ()))
        self.actor = network(inputs, int(env.single_action_space.n), 0.01)  # type: ignore[attr-defined]
        self.critic = network(inputs, 1, 1.0)

    def distribution(self, obs: Tensor) -> Categorical:
        """The distribution over actions for each observation."""
        return Categorical(logits=self.actor(obs), validate_args=False)

    def value(self, obs: Tensor) -> Tensor:
        """The value of each observation: [*obs_batch]."""
        values: Tensor = self.critic(obs).squeeze(-1)
        return values


def advantages(reward: Tensor, value: Tensor, done: Tensor, terminated: Tensor, gamma: float, lambda_: float) -> Tensor:
    """Generalized advantage estimation (Schulman et al. 2016): [T, N]. `value` is [T+1, N].

    It bootstraps unless the episode terminated, and it does not accumulate across the end of an episode.
    """
    delta = reward + gamma * value[1:] * (1 - terminated) - value[:-1]
    result, next_advantage = torch.zeros_like(reward), torch.zeros_like(reward[0])
    for t in reversed(range(len(reward))):
        result[t] = next_advantage = delta[t] + gamma * lambda_ * (1 - done[t]) * next_advantage
    return result


def train(settings: Settings = Settings(), *, quiet: bool = False) -> tuple[Agent, float]:
    """Train. Returns the agent, and the mean return of its last 100 episodes."""
    s, T, N = settings, settings.rollout_steps, settings.copies
    torch.manual_seed(s.seed)
    torch.set_num_threads(1)  # more threads don't make such small networks faster
    returns: deque[float] = deque(maxlen=100)
    # Only this line is specific to millrace.
    with closing(RecordEpisodeStatistics(millrace.make_vec(s.env, N, workers=s.workers))) as env:
        agent = Agent(env)
        optimizer = torch.optim.Adam(agent.parameters(), eps=1e-5)
        shape = env.single_observation_space.shape or ()
        observed = torch.zeros(T + 1, N, *shape)
        action, log_prob = torch.zeros(T, N, dtype=torch.int64), torch.zeros(T, N)
        reward, terminated, done, valid = (torch.zeros(T, N) for _ in range(4))
        obs, _ = env.reset(seed=s.seed)
        observed[T] = torch.as_tensor(obs)
        ended = np.zeros(N, bool)
        began = time.perf_counter()
        updates = s.env_steps // (T * N)
        for update in range(updates):
            remaining = 1 - update / updates
            observed[0] = observed[T]
            with torch.no_grad():
                for t in range(T):
                    distribution = agent.distribution(observed[t])
                    action[t] = distribution.sample()  # type: ignore[no-untyped-call]
                    log_prob[t] = distribution.log_prob(action[t])  # type: ignore[no-untyped-call]
                    valid[t] = torch.as_tensor(~ended)  # this step resets a copy whose episode ended
                    obs, rewards, terminations, truncations, infos = env.step(action[t].numpy())
                    ended = terminations | truncations
                    observed[t + 1], reward[t] = torch.as_tensor(obs), torch.as_tensor(rewards)
                    terminated[t], done[t] = torch.as_tensor(terminations), torch.as_tensor(ended)
                    if "episode" in infos:
                        returns += infos["episode"]["r"][infos["_episode"]].tolist()
                value = agent.value(observed)
                advantage = advantages(reward, value, done, terminated, s.gamma, s.lambda_)
                target = advantage + value[:-1]
            rows = valid.flatten().nonzero().squeeze(-1)
            flat_obs, flat_action, flat_log_prob = observed[:T].flatten(0, 1), action.flatten(), log_prob.flatten()
            flat_advantage, flat_target = advantage.flatten(), target.flatten()
            for group in optimizer.param_groups:
                group["lr"] = remaining * s.learning_rate
            clip = remaining * s.clip
            for _ in range(s.epochs):
                for batch in rows[torch.randperm(len(rows))].split(s.minibatch):  # type: ignore[no-untyped-call]
                    new = agent.distribution(flat_obs[batch])
                    ratio = (new.log_prob(flat_action[batch]) - flat_log_prob[batch]).exp()  # type: ignore[no-untyped-call]
                    a = flat_advantage[batch]
                    a = (a - a.mean()) / (a.std(correction=0) + 1e-8)
                    actor_loss = -torch.min(ratio * a, ratio.clamp(1 - clip, 1 + clip) * a).mean()
                    critic_loss = (agent.value(flat_obs[batch]) - flat_target[batch]).square().mean()
                    optimizer.zero_grad()
                    (actor_loss + s.value_weight * critic_loss).backward()
                    nn.utils.clip_grad_norm_(agent.parameters(), s.max_grad_norm)
                    optimizer.step()
            if not quiet and (update + 1) % 20 == 0 and returns:
                steps = (update + 1) * T * N
                speed = steps / (time.perf_counter() - began)
                print(f"{steps:,} env steps | {speed:,.0f} steps/s | return {np.mean(returns):.1f}")
    return agent, float(np.mean(returns)) if returns else 0.0


def evaluate(agent: Agent, settings: Settings, episodes: int = 100) -> float:
    """The mean return of greedy episodes. Each episode is played in an env copy of its own."""
    with millrace.make_vec(settings.env, episodes, workers=settings.workers) as env, torch.no_grad():
        obs, _ = env.reset(seed=1_000_000)
        returns, running = np.zeros(episodes), np.ones(episodes, bool)
        while running.any():
            action = agent.actor(torch.as_tensor(obs)).argmax(-1).numpy()
            obs, reward, terminated, truncated, _ = env.step(action)
            returns += reward * running
            running &= ~(terminated | truncated)
    return float(returns.mean())


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="PPO over worker processes")
    for name, value in vars(Settings()).items():
        parser.add_argument(f"--{name.rstrip('_').replace('_', '-')}", dest=name, type=type(value), default=value)
    settings = Settings(**vars(parser.parse_args()))
    trained, _ = train(settings)
    print(f"greedy return {evaluate(trained, settings):.1f} over 100 episodes")
