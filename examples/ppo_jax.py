"""PPO in JAX over `millrace.RolloutService`: `pip install jax`, then `python examples/ppo_jax.py`.

Workers collect with the newest parameters; the whole update is one compiled JAX function. With `--bind tcp://0.0.0.0:5555`,
workers on other machines can join. `--save FILE` saves the state; a later start with the same file continues from it.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import millrace

Parameters = dict[str, jax.Array]
ROWS = ("obs", "action", "log_prob", "reward", "terminated", "truncated", "valid")
COLLECTING = ("rollout_steps", "workers", "envs", "lanes", "seed", "bind", "keys")


@dataclass(frozen=True)
class Settings:
    """RL Baselines3 Zoo's hyperparameters for CartPole-v1."""

    env: str = "CartPole-v1"
    steps: int = 100_000
    target: float = 475.0  # the run ends at this mean return of the last 100 training episodes
    seed: int = 1
    workers: int = 2
    envs: int = 8
    lanes: int = 4
    rollout_steps: int = 32
    epochs: int = 20
    learning_rate: float = 1e-3  # decreases to 0
    clip: float = 0.2  # decreases to 0
    gamma: float = 0.98
    lambda_: float = 0.8
    value_weight: float = 0.5
    max_grad_norm: float = 0.5
    bind: str = ""
    keys: str = ""
    save: str = ""


def mlp(parameters: Parameters, name: str, x: jax.Array) -> jax.Array:
    """Two hidden layers and a linear output."""
    for layer in (f"{name}.0", f"{name}.1"):
        x = jnp.tanh(x @ parameters[f"{layer}.weight"].T + parameters[f"{layer}.bias"])
    return x @ parameters[f"{name}.out.weight"].T + parameters[f"{name}.out.bias"]


def with_critic(actor: dict[str, np.ndarray[Any, Any]], seed: int) -> Parameters:
    """The actor's parameters, and a critic with hidden layers of the same shapes."""
    parameters = {name: jnp.array(array) for name, array in actor.items()}
    keys = iter(jax.random.split(jax.random.key(seed), 3))
    for layer, gain in (("0", 2**0.5), ("1", 2**0.5), ("out", 1.0)):
        rows, columns = actor[f"actor.{layer}.weight"].shape
        shape = (1 if layer == "out" else rows, columns)
        parameters[f"critic.{layer}.weight"] = jax.nn.initializers.orthogonal(gain)(next(keys), shape)
        parameters[f"critic.{layer}.bias"] = jnp.zeros(shape[0])
    return parameters


def advantages(batch: dict[str, jax.Array], values: jax.Array, gamma: float, lambda_: float) -> jax.Array:
    """Generalized advantage estimates [T, N]; values are [T+1, N]."""
    delta = batch["reward"] + gamma * values[1:] * ~batch["terminated"] - values[:-1]
    goes_on = batch["valid"] & ~batch["terminated"] & ~batch["truncated"]

    def step(later: jax.Array, row: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        here = row[0] + gamma * lambda_ * row[1] * later
        return here, here

    return jax.lax.scan(step, jnp.zeros_like(delta[0]), (delta * batch["valid"], goes_on), reverse=True)[1]


def loss(parameters: Parameters, batch: dict[str, jax.Array], clip: jax.Array, value_weight: float) -> jax.Array:
    """PPO's clipped loss over the valid rows."""
    obs, count = batch["obs"][:-1], batch["valid"].sum()

    def mean(array: jax.Array) -> jax.Array:
        return (array * batch["valid"]).sum() / count

    log_probs = jax.nn.log_softmax(mlp(parameters, "actor", obs))
    log_prob = jnp.take_along_axis(log_probs, batch["action"][..., None], -1)[..., 0]
    ratio = jnp.exp(jnp.where(batch["valid"], log_prob - batch["log_prob"], 0.0))
    centered = batch["advantage"] - mean(batch["advantage"])
    scaled = centered / (jnp.sqrt(mean(centered**2)) + 1e-8)
    policy_loss = -mean(jnp.minimum(ratio * scaled, jnp.clip(ratio, 1 - clip, 1 + clip) * scaled))
    return policy_loss + value_weight * mean((mlp(parameters, "critic", obs)[..., 0] - batch["target"]) ** 2)


@partial(jax.jit, static_argnames="settings")
def update(state: dict[str, Any], batch: dict[str, jax.Array], remaining: jax.Array, settings: Settings) -> dict[str, Any]:
    """One update: `epochs` steps of Adam on the whole batch. `remaining`: fraction of the run that remains."""
    values = mlp(state["parameters"], "critic", batch["obs"])[..., 0]
    advantage = advantages(batch, values, settings.gamma, settings.lambda_)
    batch = batch | {"advantage": advantage, "target": advantage + values[:-1]}

    def epoch(state: dict[str, Any], _: None) -> tuple[dict[str, Any], None]:
        gradient = jax.grad(loss)(state["parameters"], batch, settings.clip * remaining, settings.value_weight)
        norm = jnp.sqrt(sum(jnp.sum(each**2) for each in gradient.values()))
        gradient = jax.tree.map(lambda g: g * jnp.minimum(1.0, settings.max_grad_norm / norm), gradient)
        step = state["step"] + 1
        mean = jax.tree.map(lambda m, g: 0.9 * m + 0.1 * g, state["mean"], gradient)
        square = jax.tree.map(lambda v, g: 0.999 * v + 0.001 * g**2, state["square"], gradient)
        rate = settings.learning_rate * remaining * jnp.sqrt(1 - 0.999**step) / (1 - 0.9**step)
        parameters = jax.tree.map(lambda p, m, v: p - rate * m / (jnp.sqrt(v) + 1e-5), state["parameters"], mean, square)
        return {"parameters": parameters, "mean": mean, "square": square, "step": step}, None

    return jax.lax.scan(epoch, state, None, settings.epochs)[0]  # type: ignore[no-any-return]


def train(settings: Settings) -> float:
    """Train. Returns the mean return of the last 100 training episodes."""
    save = Path(settings.save) if settings.save else None
    collecting = {name: getattr(settings, name) for name in COLLECTING}
    restore = save if save and save.exists() else None
    returns: list[float] = []
    with millrace.RolloutService(settings.env, millrace.MLP(64, 64), restore=restore, **collecting) as service:
        parameters = with_critic(service.policy.named(service.policy.initial(settings.seed)), settings.seed)
        zeros = jax.tree.map(jnp.zeros_like, parameters)
        state = {"parameters": parameters, "mean": zeros, "square": zeros, "step": jnp.zeros(())}
        leaves, tree = jax.tree.flatten(state)
        if restore:
            state = jax.tree.unflatten(tree, [jnp.array(service.restored[f"leaf{i}"]) for i in range(len(leaves))])
        service.publish(state["parameters"])
        for batch in service:
            returns = (returns + [episode.reward for episode in batch.episodes])[-100:]
            mean = float(np.mean(returns)) if returns else 0.0
            remaining = jnp.array(max(0.0, 1 - service.env_steps / settings.steps))
            state = update(state, {name: getattr(batch, name) for name in ROWS}, remaining, settings)
            service.publish(state["parameters"])
            if save and service.version % 10 == 0:
                service.save(save, **{f"leaf{i}": leaf for i, leaf in enumerate(jax.tree.leaves(state))})
            if service.env_steps >= settings.steps or (len(returns) == 100 and mean >= settings.target):
                print(f"{service.env_steps:,} env steps: mean return {mean:.1f}; greedy {service.evaluate(20)}")
                return mean
    return mean


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="PPO in JAX over millrace's rollout service")
    for name in ("steps", "seed", "workers", "bind", "keys", "save"):
        parser.add_argument(f"--{name}", type=type(getattr(Settings, name)), default=getattr(Settings, name))
    train(Settings(**vars(parser.parse_args())))
