"""Stable-Baselines3's PPO on multi-agent tasks: `python -m benchmarks.agents_stable_baselines3 TASK SEED`.

It needs `pip install stable-baselines3 supersuit mpe2 pygame-ce`. It uses 8 env copies and minibatches of 256, and otherwise
Stable-Baselines3's own settings. It prints the mean return of 100 greedy episodes, summed over all agents.
"""

from __future__ import annotations

import os

os.environ |= {"OMP_NUM_THREADS": "1", "SDL_VIDEODRIVER": "dummy"}  # before numpy

import argparse
import statistics
from importlib import import_module
from typing import Any

TASKS: dict[str, tuple[str, str, dict[str, Any], int]] = {  # module, name of the factory, its arguments, env steps
    "spread": ("mpe2.simple_spread_v3", "parallel_env", {"local_ratio": 0.5}, 150_000),
    "exit": ("benchmarks.leaving", "Exit", {}, 40_000),
}


def main() -> None:
    parser = argparse.ArgumentParser(description="Stable-Baselines3 on tasks of several agents")
    parser.add_argument("task", choices=TASKS)
    parser.add_argument("seed", type=int)
    arguments = parser.parse_args()
    supersuit = import_module("supersuit")
    sb3 = import_module("stable_baselines3")
    vec_env = import_module("stable_baselines3.common.vec_env")
    import_module("stable_baselines3.common.utils").set_random_seed(arguments.seed)  # env copies have no `seed`
    module, name, settings, steps = TASKS[arguments.task]
    make = getattr(import_module(module), name)
    env = make(**settings)
    copies = supersuit.pettingzoo_env_to_vec_env_v1(supersuit.black_death_v3(make(**settings)))
    copies = supersuit.concat_vec_envs_v1(copies, 8, num_cpus=1, base_class="stable_baselines3")
    normalized = vec_env.VecNormalize(vec_env.VecMonitor(copies))
    model = sb3.PPO("MlpPolicy", normalized, n_steps=128, batch_size=256, device="cpu")
    model.learn(steps * len(env.possible_agents))  # Stable-Baselines3 counts each agent's step
    returns = []
    for seed in range(100):
        observations, _ = env.reset(seed=1_000 + seed)
        total = 0.0
        while env.agents:
            seen = {agent: normalized.normalize_obs(observations[agent]) for agent in env.agents}
            actions = {agent: model.predict(seen[agent], deterministic=True)[0] for agent in env.agents}
            observations, rewards, *_ = env.step(actions)
            total += sum(rewards.values())
        returns.append(total)
    print(f"{arguments.task} seed {arguments.seed}: {statistics.mean(returns):.2f} ± {statistics.stdev(returns):.2f}")


if __name__ == "__main__":
    main()
