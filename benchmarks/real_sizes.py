"""PPO on HalfCheetah-v5 and on Pong, compared with Stable-Baselines3's PPO: `python -m benchmarks.real_sizes`.

Rule: both systems use the same hyperparameters, environments, networks and torch threads. HalfCheetah-v5: 8 env copies, 256
steps, minibatches of 256, 10 epochs, a 64-64 network, no normalization, one torch thread. Pong: 16 env copies, 128 steps,
minibatches of 256, 4 epochs, the convolutions of Mnih et al. (2015), one torch thread for each core.

Env steps/s are measured from the second update on. The share of the arithmetic is the time that the network alone needs for
the updates, forward and backward, divided by the time of the env steps.
"""

from __future__ import annotations

import os

os.environ |= dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")  # before numpy

import argparse
import statistics
import time
from typing import Any, NamedTuple

import torch
from rich.console import Console
from rich.table import Table

from benchmarks.programs import Contender, run
from benchmarks.writing import write
from millrace.learner.algorithms.bodies.networks import ActorCriticNetwork
from millrace.protocol.specs import ActionSpec, Leaf, PolicySpec

OURS = "millrace"
OVERLAPPED = "millrace, --max-lag 1"
THEIRS = "SB3, one process"
SUBPROC = "SB3, SubprocVecEnv"
NATIVE = "millrace, --vector native"
COMMON: dict[str, Any] = {
    "algo": "ppo", "batch_size": 256, "gamma": 0.99, "gae_lambda": 0.95, "vf_coef": 0.5, "max_grad_norm": 0.5,
    "clip_range": 0.2, "ent_coef": 0.0, "learning_rate": 3e-4, "normalize_observations": False, "normalize_rewards": False,
}  # fmt: skip
WARM_UP = 1  # number of updates that aren't counted


class Size(NamedTuple):
    """One of the two environments, with its settings and contenders."""

    settings: dict[str, Any]
    contenders: dict[str, Contender]
    steps: int
    policy: PolicySpec


def sizes(cores: int) -> dict[str, Size]:
    """Both environments, by name. `cores`: number of torch threads for Pong."""
    sb3 = "benchmarks.train_stable_baselines3"
    flags = ("--lanes", "2", "--torch-threads")
    image = Leaf("", "box", (4, 84, 84), "uint8", divisor=255)
    features = Leaf("", "box", (17,), "float32")
    buttons = ActionSpec("discrete", (), "int64", (6,), (0,))
    torques = ActionSpec("box", (6,), "float32", low=(-1.0,) * 6, high=(1.0,) * 6)
    cheetah = {"env": "HalfCheetah-v5", "envs": 8, "rollout_steps": 256, "n_epochs": 10, "net": [64, 64]}
    pong = {"env": "millrace/Atari-v0", "envs": 16, "rollout_steps": 128, "n_epochs": 4, "net": []}
    return {
        "HalfCheetah-v5": Size(
            COMMON | cheetah,
            {
                OURS: Contender("millrace", flags=(*flags, "1")),
                OVERLAPPED: Contender("millrace", flags=(*flags, "1", "--max-lag", "1")),
                THEIRS: Contender(sb3, "one"),
                SUBPROC: Contender(sb3, "subproc"),
            },
            24_576,
            PolicySpec((features,), torques, net=(64, 64)),
        ),
        "Pong": Size(
            COMMON | pong,
            {
                OURS: Contender("millrace", flags=(*flags, str(cores))),
                NATIVE: Contender("millrace", flags=(*flags, str(cores), "--vector", "native")),
                f"{NATIVE} --max-lag 1": Contender(
                    "millrace", flags=(*flags, str(cores), "--vector", "native", "--max-lag", "1")
                ),
                THEIRS: Contender(sb3, "one", flags=("--threads", str(cores))),
            },
            10_240,
            PolicySpec((image,), buttons, net=()),
        ),
    }


def rate(name: str, size: Size, seed: int) -> float:
    """Env steps/s after the warm-up."""
    settings = size.settings | {"steps": size.steps, "seed": seed}
    return run(name, settings, contender=size.contenders[name]).steps_per_s(after_updates=WARM_UP)


def network_s(size: Size, threads: int, repeats: int = 8) -> float:
    """Seconds that the network alone needs, forward and backward, in the updates for one env step."""
    torch.set_num_threads(threads)
    net = ActorCriticNetwork(size.policy)
    rows = size.settings["batch_size"]
    (leaf,) = size.policy.observation
    if leaf.is_image:
        x = torch.zeros(rows, 0)
        images = [torch.randint(0, 256, (rows, *leaf.shape), dtype=torch.uint8)]
    else:
        x = torch.randn(rows, *leaf.shape)
        images = []
    found = []
    for _ in range(repeats):
        began_s = time.perf_counter()
        params, value = net.forward(x, images)
        (params.square().sum() + value.square().sum()).backward()  # type: ignore[no-untyped-call]
        found.append(time.perf_counter() - began_s)
    return float(statistics.median(found) * size.settings["n_epochs"] / rows)


def main() -> None:
    parser = argparse.ArgumentParser(description="compare PPO on HalfCheetah-v5 and Pong with Stable-Baselines3")
    parser.add_argument("--rounds", type=int, default=3, help="number of turns, each with another seed")
    parser.add_argument("--env", nargs="+", default=["HalfCheetah-v5", "Pong"], choices=["HalfCheetah-v5", "Pong"])
    arguments = parser.parse_args()
    cores = len(os.sched_getaffinity(0))
    chosen = {name: size for name, size in sizes(cores).items() if name in arguments.env}
    found: dict[tuple[str, str], list[float]] = {}
    for seed in range(1, arguments.rounds + 1):
        for env, size in chosen.items():
            for name in size.contenders if seed % 2 else reversed(size.contenders):
                found.setdefault((env, name), []).append(rate(name, size, seed))
    table = Table("", "contender", "env steps/s", "all turns", "ratio to SB3", "share of the arithmetic")
    rows = []
    for (env, name), rates in found.items():
        ratio = statistics.median(our / its for our, its in zip(rates, found[env, THEIRS], strict=True))
        share = network_s(chosen[env], cores if env == "Pong" else 1) * statistics.median(rates)
        rows.append({"env": env, "contender": name, "rates": rates, "ratio": ratio, "share": share})
        turns = ", ".join(f"{one:,.0f}" for one in rates)
        table.add_row(env, name, f"{statistics.median(rates):,.0f}", turns, f"{ratio:.2f}", f"{share:.2f}")
    Console(width=120).print(table)
    write("real_sizes", {"cores": cores, "rows": rows})


if __name__ == "__main__":
    main()
