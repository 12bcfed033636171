"""The programs that `benchmarks/wall_clock.py` compares, and the commands that train a curve or measure a rate. Pure.

Rule: a rate is measured with the settings of the curve, except that steps take longer, nothing is evaluated, and gradient
steps begin earlier (`LEARNING_STARTS`). PPO's updates are as large as those of its preset. Two workers are enough to train a
curve, because its steps don't wait.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import NamedTuple

from millrace.learner.config.layers import resolve

COPIES = 16
ENVS = ("HalfCheetah-v5", "Hopper-v5", "Walker2d-v5")
OURS = "millrace"
THEIRS = "Stable-Baselines3"
ALGORITHMS = {OURS: ("ppo", "sac", "tqc", "crossq", "xqc"), THEIRS: ("ppo", "sac", "tqc", "crossq")}
NAMES = {"ppo": "PPO", "sac": "SAC", "tqc": "TQC", "crossq": "CrossQ", "xqc": "XQC"}
EVAL_EVERY = 10_000
EVAL_EPISODES = 20
STEPS = {"ppo": 1_000_000}
MOST_STEPS = 300_000
"""env steps of a curve, if its algorithm isn't in `STEPS`"""
LEARNING_STARTS = 512
"""env steps before the first gradient step in a run whose rate is measured"""
WARM_UP_STEPS = 768
"""env steps of such a run that aren't counted"""
THEIR_PPO_STEPS = 2048 // COPIES
"""steps of each env copy in a rollout of Stable-Baselines3's PPO"""
THEIR_PROGRAM = "benchmarks.wall_clock_stable_baselines3"


class Program(NamedTuple):
    """An algorithm in one of the two systems."""

    system: str
    algo: str

    @property
    def overlaps(self) -> bool:
        """Whether env copies step during updates."""
        return self.system == OURS and self.algo != "ppo"

    def steps_of_an_update(self, env: str) -> int:
        """Env steps between two updates."""
        if self.system == THEIRS:
            return COPIES * (THEIR_PPO_STEPS if self.algo == "ppo" else 1)
        return COPIES * _rollout_steps(self.algo, env)

    def warm_up_steps(self, env: str) -> int:
        """Number of env steps at the beginning that a rate leaves out.

        In PPO these are the steps of the first update. Other algorithms have taken some gradient steps by then.
        """
        return self.steps_of_an_update(env) if self.algo == "ppo" else WARM_UP_STEPS


PROGRAMS = tuple(Program(system, algo) for system, algorithms in ALGORITHMS.items() for algo in algorithms)


def curve_command(program: Program, env: str, seed: int, out: str) -> list[str]:
    """The command that trains a curve, whose run folder is in `out`."""
    steps = str(STEPS.get(program.algo, MOST_STEPS))
    if program.system == THEIRS:
        folder = f"{out}/{env}-sb3-{program.algo}-s{seed}"
        return ["python", "-m", THEIR_PROGRAM, env, program.algo, str(seed), "--steps", steps, "--out", folder]
    return ["nice", "-n", "19", *training(env, [program.algo], seed, steps, out)]


def training(env: str, algo: Sequence[str], seed: int, steps: str, out: str) -> list[str]:
    """The command of millrace that trains a curve. `algo`: the name of the algorithm, followed by flags of its own."""
    words = ["millrace", "train", env, "--algo", *algo, "--seed", str(seed), "--steps", steps]
    evaluations = ["--eval-every", str(EVAL_EVERY), "--eval-episodes", str(EVAL_EPISODES)]
    return [*words, "--workers", "2", *_flags(algo[0], env), *evaluations, "--run-dir", out]


def rate_command(program: Program, env: str, step_s: float, seed: int | str, threads: int, device: str) -> list[str]:
    """The command of a run whose rate is measured. The run is started in an empty folder, and stopped afterwards."""
    starts = [] if program.algo == "ppo" else ["--learning-starts", str(LEARNING_STARTS)]
    if program.system == THEIRS:
        words = [sys.executable, "-m", THEIR_PROGRAM, env, program.algo, str(seed), *starts, "--step-s", str(step_s)]
        return [*words, "--threads", str(threads), "--device", device]
    words = [sys.executable, "-m", "millrace", "train", env, "--algo", program.algo, "--seed", str(seed), *starts]
    words += ["--steps", str(10**8), "--eval-every", "0", "--eval-episodes", "1", "--run-dir", ".", "--grace-s", "4"]
    words += ["--wrappers", f"benchmarks.slow_env:StepTime(seconds={step_s})", "--workers", str(COPIES)]
    return [*words, *_flags(program.algo, env), "--torch-threads", str(threads), "--device", device]


def _flags(algo: str, env: str) -> list[str]:
    flags = ["--envs", str(COPIES), "--lanes", str(COPIES), "--rollout-steps", str(_rollout_steps(algo, env))]
    return flags if algo == "ppo" else [*flags, "--max-lag", "1"]


def _rollout_steps(algo: str, env: str) -> int:
    """Steps of each env copy in a rollout: those that leave the size of PPO's updates as in the preset, or few."""
    if algo != "ppo":
        return 4
    preset = resolve(env)
    steps: int = preset.envs * preset.algorithm.rollout_steps
    return steps // COPIES
