"""PPO and SAC of Stable-Baselines3, TQC and CrossQ of sb3-contrib, on 16 env copies, for `benchmarks/wall_clock.py`.

Rule: it uses the library's own settings, with one gradient step for each env step. `--out FOLDER` trains a curve at niceness
19. The first line of the folder's curve.jsonl describes the run; the others are evaluations, which use env copies of their
own. The same command continues from the last checkpoint in the folder. Without `--out`, steps take `--step-s` seconds, and
the program prints a line for each update, with env steps and the time by the monotonic clock, until it is killed.
"""

from __future__ import annotations

import os

os.environ |= dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")  # before numpy

import argparse
import json
import shlex
import sys
from functools import partial
from pathlib import Path
from typing import Any

import torch
from sb3_contrib import TQC, CrossQ
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnv

from benchmarks.slow_env import StepTime
from benchmarks.train_stable_baselines3 import PrintUpdates
from benchmarks.wall_clock_programs import (
    COPIES,
    EVAL_EPISODES,
    EVAL_EVERY,
    MOST_STEPS,
    THEIR_PPO_STEPS,
    THEIR_PROGRAM,
    THEIRS,
)
from benchmarks.writing import processor

KINDS: dict[str, Any] = {"ppo": PPO, "sac": SAC, "tqc": TQC, "crossq": CrossQ}
CURVE = "curve.jsonl"
MODEL = "model.zip"
REPLAY = "replay.pkl"
OTHER_EPISODES = 1_000_000
"""the evaluations' seed, which makes them play other episodes than training"""
EVALUATIONS_OF_A_CHECKPOINT = 5


class WriteCurve(BaseCallback):
    """Evaluates the policy at intervals, and saves checkpoints from which a later process continues."""

    def __init__(self, folder: Path, env: VecEnv, every: int, episodes: int) -> None:
        super().__init__()
        self._folder = folder
        self._env = env
        self._every = every
        self._episodes = episodes
        self._evaluated = 0  # env steps of the last evaluation, in multiples of `every`
        self._saved = 0  # env steps of the last checkpoint, in multiples of `every`

    def _on_training_start(self) -> None:
        self._evaluated = self._saved = self.num_timesteps // self._every

    def _on_step(self) -> bool:
        if self.num_timesteps // self._every > self._evaluated:
            self._evaluated = self.num_timesteps // self._every
            self._env.seed(OTHER_EPISODES)
            found, _ = evaluate_policy(self.model, self._env, self._episodes, deterministic=True)
            with (self._folder / CURVE).open("a") as file:
                file.write(json.dumps({"env_steps": self.num_timesteps, "return": float(str(found))}) + "\n")
            print(f"{self._folder.name}: {self.num_timesteps:,} env steps, return {found:,.1f}", flush=True)
        return True

    def _on_rollout_start(self) -> None:  # only at this point has PPO learned from all its env steps
        if self._evaluated >= self._saved + EVALUATIONS_OF_A_CHECKPOINT:
            self._saved = self._evaluated
            save(self.model, self._folder)


def make(algo: str, env: VecEnv, seed: int, device: str, learning_starts: int | None = None) -> BaseAlgorithm:
    """Make the algorithm with the library's settings. PPO learns from 2,048 env steps at once, as with one env copy."""
    more: dict[str, Any] = {"n_steps": THEIR_PPO_STEPS} if algo == "ppo" else {"train_freq": 1, "gradient_steps": COPIES}
    if learning_starts is not None:
        more["learning_starts"] = learning_starts
    made: BaseAlgorithm = KINDS[algo]("MlpPolicy", env, seed=seed, device=device, **more)
    return made


def save(model: BaseAlgorithm, folder: Path) -> None:
    """Write a checkpoint that replaces the last one."""
    if isinstance(model, OffPolicyAlgorithm):
        model.save_replay_buffer(folder / f"new-{REPLAY}")
        (folder / f"new-{REPLAY}").replace(folder / REPLAY)
    model.save(folder / f"new-{MODEL}")
    (folder / f"new-{MODEL}").replace(folder / MODEL)


def restore(algo: str, env: VecEnv, seed: int, device: str, folder: Path) -> BaseAlgorithm:
    """Load the algorithm from the folder's checkpoint, and remove later evaluations from the curve."""
    model: BaseAlgorithm = KINDS[algo].load(folder / MODEL, env=env, device=device)
    if isinstance(model, OffPolicyAlgorithm) and (folder / REPLAY).exists():  # a finished run has no replay buffer
        model.load_replay_buffer(folder / REPLAY)
    model.set_random_seed(seed + model.num_timesteps)  # so that the first random numbers aren't repeated
    first, *points = (folder / CURVE).read_text().splitlines()
    kept = [point for point in points if json.loads(point)["env_steps"] <= model.num_timesteps]
    (folder / CURVE).write_text("\n".join([first, *kept]) + "\n")
    return model


def train_curve(arguments: argparse.Namespace) -> None:
    """Train with evaluations, continuing from the folder's checkpoint if there is one."""
    folder: Path = arguments.out
    folder.mkdir(parents=True, exist_ok=True)
    env = make_vec_env(
        arguments.env, COPIES, arguments.seed, vec_env_cls=DummyVecEnv if arguments.one_process else SubprocVecEnv
    )
    if (folder / MODEL).exists():
        model = restore(arguments.algo, env, arguments.seed, arguments.device, folder)
    else:
        model = make(arguments.algo, env, arguments.seed, arguments.device, arguments.learning_starts)
        words = ["python", "-m", THEIR_PROGRAM, arguments.env, arguments.algo, "S", "--steps", str(arguments.steps)]
        about = {"env": arguments.env, "system": THEIRS, "algo": arguments.algo, "seed": arguments.seed}
        about |= {"command": shlex.join(words), "processor": processor()}
        (folder / CURVE).write_text(json.dumps(about) + "\n")
    if (left := arguments.steps - model.num_timesteps) > 0:
        if model.num_timesteps and isinstance(model, OffPolicyAlgorithm) and not (folder / REPLAY).exists():
            sys.exit(f"{folder} ended after {model.num_timesteps} env steps, without its replay buffer: take another folder")
        other = make_vec_env(arguments.env, 4, OTHER_EPISODES, vec_env_cls=DummyVecEnv)
        curve = WriteCurve(folder, other, arguments.eval_every, arguments.eval_episodes)
        model.learn(left, curve, reset_num_timesteps=False)
        save(model, folder)
    (folder / REPLAY).unlink(missing_ok=True)
    env.close()


def train_for_a_rate(arguments: argparse.Namespace) -> None:
    """Train on slow env copies, and print each update."""
    env = make_vec_env(
        arguments.env,
        COPIES,
        arguments.seed,
        wrapper_class=partial(StepTime, seconds=arguments.step_s),
        vec_env_cls=SubprocVecEnv,
    )
    make(arguments.algo, env, arguments.seed, arguments.device, arguments.learning_starts).learn(10**8, PrintUpdates())


def main() -> None:
    parser = argparse.ArgumentParser(description="train one algorithm of Stable-Baselines3 or sb3-contrib on 16 env copies")
    parser.add_argument("env")
    parser.add_argument("algo", choices=KINDS)
    parser.add_argument("seed", type=int)
    parser.add_argument("--steps", type=int, default=MOST_STEPS, help="env steps of a curve")
    parser.add_argument("--out", type=Path, help="the folder of the curve, which a later start goes on from")
    parser.add_argument("--step-s", type=float, default=0.0, help="without --out: seconds of a step")
    parser.add_argument("--one-process", action="store_true", help="with --out: step all copies here; the curve is the same")
    parser.add_argument("--eval-every", type=int, default=EVAL_EVERY)
    parser.add_argument("--eval-episodes", type=int, default=EVAL_EPISODES)
    parser.add_argument("--learning-starts", type=int, help="without it, the library's")
    parser.add_argument("--threads", type=int, default=1, help="of PyTorch")
    parser.add_argument("--device", default="cpu", help="cpu or cuda")
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    if arguments.out is None:
        train_for_a_rate(arguments)
    else:
        os.nice(19)
        train_curve(arguments)


if __name__ == "__main__":
    main()
