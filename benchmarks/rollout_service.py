"""Compares the env steps/s of `RolloutService` with the built-in trainer's: `millrace bench service`.

All contenders collect CartPole-v1 with two processes, the same policy, seed and sizes, over ipc. The loop over the service
only publishes the same weights again. The trainer's algorithm does the same, so that the trainer's figure is the rate of
collecting. The upper limit is two collectors without any messages. The last row is the service with the same network,
written as an `OwnPolicy`. Rounds are interleaved, and a share is the median of the shares within a round.
"""

from __future__ import annotations

import argparse
import statistics
import tempfile
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

import millrace
from benchmarks.collect import CARTPOLE, PROCESSES, STEPS, Pair
from benchmarks.writing import write
from millrace.algorithms import Algorithm, Batch, PolicySpec
from millrace.policies import PolicyParameters
from millrace.protocol.arrays import Array, Floats

LANES = 4
WARM_UP_S = 1.0


class Unchanged(Algorithm):
    """An algorithm that learns nothing. It returns the same weights after each batch."""

    def __init__(self, config: Any, policy: PolicySpec, *, total_steps: int, seed: int, device: str = "cpu") -> None:
        self._weights = PolicyParameters(policy).initial(1)

    def update(self, batch: Batch, pulse: Callable[[], None]) -> dict[str, float]:
        """Do nothing."""
        return {}

    def weights(self) -> tuple[Floats, Floats]:
        """The initial weights."""
        return self._weights.copy(), np.zeros(0, np.float32)

    def state_dict(self) -> dict[str, Any]:
        """An empty state."""
        return {}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Do nothing."""


class Network:
    """The forward pass and the sampling of `MLP(64, 64)`, as a user would write them for an `OwnPolicy`."""

    def load(self, arrays: dict[str, Array]) -> None:
        """Store the arrays of the layers."""
        self.layers = [(arrays[f"{name}.weight"].T, arrays[f"{name}.bias"]) for name in ("actor.0", "actor.1", "actor.out")]

    def act(self, obs: Array, state: Array, rng: np.random.Generator) -> tuple[Array, Array, dict[str, Array]]:
        """Sample actions, and compute their log-probabilities."""
        x = obs
        for weight, bias in self.layers[:-1]:
            x = np.tanh(x @ weight + bias)
        weight, bias = self.layers[-1]
        logits = x @ weight + bias
        action = (logits - np.log(rng.standard_exponential(logits.shape, dtype=np.float32))).argmax(-1)
        shifted = logits - logits.max(-1, keepdims=True)
        log_prob = shifted[np.arange(len(action)), action] - np.log(np.exp(shifted).sum(-1))
        return action, state, {"log_prob": log_prob}


class Clock:
    """Measures env steps/s after a warm-up."""

    def __init__(self, seconds: float) -> None:
        self._seconds = seconds
        self._began_s = time.perf_counter()
        self._since = (0, 0.0)
        self.rate = 0.0
        """env steps/s; 0 until the time is over"""

    def over(self, env_steps: int) -> bool:
        """Whether the time is over. `env_steps`: the number of env steps so far."""
        now = time.perf_counter()
        if self.rate:
            return True
        if now - self._began_s < WARM_UP_S or not self._since[1]:
            self._since = env_steps, now
            return False
        steps, since_s = self._since
        if now - since_s < self._seconds:
            return False
        self.rate = (env_steps - steps) / (now - since_s)
        return True


def service(policy: Any, max_lag: int, envs: int, seconds: float) -> float:
    """Env steps/s of a loop over the service that publishes the same weights again."""
    settings: dict[str, Any] = {"workers": PROCESSES, "envs": envs, "lanes": LANES, "max_lag": max_lag, "seed": 1}
    with millrace.RolloutService("CartPole-v1", policy, rollout_steps=STEPS, **settings) as made:
        parameters = _initial()
        made.publish(parameters)
        clock = Clock(seconds)
        for _ in made:
            made.publish(parameters)
            if clock.over(made.env_steps):
                break
    return clock.rate


def trainer(max_lag: int, envs: int, seconds: float) -> float:
    """Env steps/s of the built-in training loop."""
    clock: Clock | None = None

    def watch(progress: Any) -> bool:
        nonlocal clock
        clock = clock or Clock(seconds)
        return not clock.over(progress.env_steps)

    with tempfile.TemporaryDirectory() as folder:
        millrace.train(
            "CartPole-v1", algo=Unchanged, preset="none", workers=PROCESSES, envs=envs, lanes=LANES, max_lag=max_lag, seed=1,
            rollout_steps=STEPS, steps=1_000_000_000, eval_episodes=1, run_dir=folder, callbacks=[watch], progress=False,
        )  # fmt: skip
    assert clock is not None
    return clock.rate


def _initial() -> dict[str, Array]:
    """The initial parameters of `MLP(64, 64)` for CartPole-v1, by name."""
    from millrace.protocol.envs.spaces import action_spec, observation_leaves

    made = CARTPOLE.make()
    spec = millrace.MLP(64, 64).spec(observation_leaves(made.observation_space), action_spec(made.action_space))
    parameters = PolicyParameters(spec)
    return parameters.named(parameters.initial(1))


def main() -> None:
    parser = argparse.ArgumentParser(description="env steps/s of the rollout service beside the built-in trainer's")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--seconds", type=float, default=3.0)
    parser.add_argument("--envs", type=int, default=64)
    parser.add_argument("--max-lag", type=int, default=0)
    flags = parser.parse_args()
    arrays = {name: array.shape for name, array in _initial().items()}
    mlp = millrace.MLP(64, 64)
    own = millrace.OwnPolicy("benchmarks.rollout_service:Network", arrays, {"log_prob": "float32"})
    sizes = (flags.max_lag, flags.envs, flags.seconds)
    ceiling = Pair(f"ours, {LANES // PROCESSES} lanes", flags.envs // PROCESSES)
    contenders: dict[str, Callable[[], float]] = {
        "collectors alone": partial(ceiling.rate, flags.seconds),
        "trainer": partial(trainer, *sizes),
        "service": partial(service, mlp, *sizes),
        "service, OwnPolicy": partial(service, own, *sizes),
    }
    ceiling.rate(0.2)  # warm up
    turns = [{name: rate() for name, rate in contenders.items()} for _ in range(flags.rounds)]
    ceiling.close()
    rows = [
        {
            "contender": name,
            "env_steps_per_s": round(statistics.median(turn[name] for turn in turns)),
            "share_of_trainer": statistics.median(turn[name] / turn["trainer"] for turn in turns),
            "share_of_ceiling": statistics.median(turn[name] / turn["collectors alone"] for turn in turns),
        }
        for name in contenders
    ]
    table = Table("", "env steps/s", "of the trainer", "of collectors alone")
    table.title = f"{flags.envs} env copies, max_lag {flags.max_lag}, medians of {flags.rounds}"
    for row in rows:
        shares = (f"{row[share]:.2f}" for share in ("share_of_trainer", "share_of_ceiling"))
        table.add_row(str(row["contender"]), f"{row['env_steps_per_s']:,}", *shares)
    Console().print(table)
    write(
        "service",
        {"rows": rows},
        [("env steps/s", {str(row["contender"]): float(str(row["env_steps_per_s"])) for row in rows})],
    )


if __name__ == "__main__":
    main()
