"""Programs that train CartPole-v1 with the same settings: millrace's command line, and programs of other systems.

Rule: all programs get the same hyperparameters, one torch thread, and a process tree of their own with a cold start. The
first lines of each program in `benchmarks/peers` list the settings that its system lacks.
"""

from __future__ import annotations

import contextlib
import importlib.util
import json
import math
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from benchmarks.peers import install
from millrace.learner.config.layers import config_of_run
from millrace.learner.run_folder.metrics_log import read_rows

ROOT = Path(__file__).parents[1]
COMMON: dict[str, Any] = {"env": "CartPole-v1", "eval_every": 5000, "eval_episodes": 20}
ACTOR_CRITIC = COMMON | {
    "vf_coef": 0.5, "max_grad_norm": 0.5, "normalize_observations": False, "normalize_rewards": False,
}  # fmt: skip
# RL Zoo's settings for CartPole-v1 (ZOO), and settings with a large batch (LARGE). Names are those of millrace's flags.
ZOO = ACTOR_CRITIC | {
    "algo": "ppo", "envs": 8, "rollout_steps": 32, "batch_size": 256, "n_epochs": 20, "gamma": 0.98, "gae_lambda": 0.8,
    "ent_coef": 0.0, "learning_rate": 1e-3, "learning_rate_schedule": "linear", "clip_range": 0.2,
    "clip_range_schedule": "linear",
}  # fmt: skip
LARGE = ACTOR_CRITIC | {
    "algo": "ppo", "envs": 64, "rollout_steps": 128, "batch_size": 2048, "n_epochs": 4, "gamma": 0.99, "gae_lambda": 0.95,
    "ent_coef": 0.0, "learning_rate": 3e-4, "learning_rate_schedule": "constant", "clip_range": 0.2,
    "clip_range_schedule": "constant",
}  # fmt: skip
# These are also RL Zoo's settings. Its DQN has one env copy, trains after every 256 env steps, and copies the target network
# every 10 env steps. In effect, it copies the network before each update, which is after 128 gradient steps.
A2C = ACTOR_CRITIC | {
    "algo": "a2c", "envs": 8, "rollout_steps": 5, "gamma": 0.99, "gae_lambda": 1.0, "ent_coef": 0.0, "learning_rate": 7e-4,
}  # fmt: skip
DQN = COMMON | {
    "algo": "dqn", "envs": 8, "rollout_steps": 32, "gamma": 0.99, "learning_rate": 2.3e-3, "batch_size": 64,
    "gradient_steps": 128, "learning_starts": 1000, "replay_size": 100_000, "net": [256, 256],
    "target_every": 128, "double": False, "epsilon_steps": 8000, "epsilon_end": 0.04, "max_grad_norm": 10.0,
}  # fmt: skip
LEAST_S = 0.05  # minimum time between two calls to `look`
OUTPUT = "out"  # the file, in a program's folder, that contains its output
LONGEST_S = 300.0


class Contender(NamedTuple):
    """A program that takes part in the comparison."""

    module: str
    how: str = ""
    """mode of the program: its flag --how"""
    peer: str = ""
    """the system in whose virtual environment it runs; empty: this Python"""
    most_envs: int = 64
    """maximum number of env copies that it can run on this machine"""
    own: bool = False
    """whether it uses its own settings instead of the common ones"""
    flags: tuple[str, ...] = ()
    """additional flags of the program"""

    @property
    def ours(self) -> bool:
        """Whether this is millrace."""
        return self.module == "millrace"


OURS = "millrace, 2 workers"
OURS_OWN = "millrace, own preset"
OVERLAPPED = "millrace, --max-lag 1"
NATIVE = "millrace, --vector native"
ONE_NATIVE = "millrace, 1 worker, both"
DUMMY = "SB3, one process"
SUBPROC = "SB3, SubprocVecEnv"
_SB3 = "benchmarks.train_stable_baselines3"
_PEERS = "benchmarks.peers"
AS_PUFFERLIB = "millrace, as PufferLib's own"
AS_SAMPLE_FACTORY = "millrace, as Sample Factory's own"


def _flags(sizes: str, more: str) -> tuple[str, ...]:
    """Flags of millrace for a peer's own settings: env copies, rollout steps, minibatch in `sizes`, the rest in `more`."""
    copies, steps, minibatch = sizes.split()
    given = f"--preset none --envs {copies} --lanes 2 --rollout-steps {steps} --batch-size {minibatch} --n-epochs 1 {more}"
    given += " --no-normalize-observations --no-normalize-rewards"
    return tuple(given.split())


CONTENDERS = {
    OURS: Contender("millrace", flags=("--lanes", "2")),
    OVERLAPPED: Contender("millrace", flags=("--lanes", "2", "--max-lag", "1")),
    NATIVE: Contender("millrace", flags=("--lanes", "2", "--vector", "native")),
    ONE_NATIVE: Contender("millrace", flags=("--lanes", "1", "--workers", "1", "--vector", "native", "--max-lag", "1")),
    AS_PUFFERLIB: Contender("millrace", own=True, flags=_flags("16 64 256", "--net 64 --shared-net")),
    AS_SAMPLE_FACTORY: Contender("millrace", own=True, flags=_flags("40 32 512", "--net 512 512 --shared-net --max-lag 1")),
    OURS_OWN: Contender("millrace", own=True),
    DUMMY: Contender(_SB3, "one"),
    SUBPROC: Contender(_SB3, "subproc", most_envs=8),  # because each env copy has a process
    "CleanRL": Contender(f"{_PEERS}.cleanrl_ppo", "", "cleanrl"),
    "Sample Factory, one process": Contender(f"{_PEERS}.sample_factory_ppo", "serial", "sample_factory"),
    "Sample Factory, 2 workers": Contender(f"{_PEERS}.sample_factory_ppo", "async", "sample_factory"),
    "Sample Factory, own settings": Contender(f"{_PEERS}.sample_factory_ppo", "own", "sample_factory", own=True),
    "PufferLib": Contender(f"{_PEERS}.pufferlib_ppo", "", "pufferlib"),
    "PufferLib, own settings": Contender(f"{_PEERS}.pufferlib_ppo", "own", "pufferlib", own=True),
    "TorchRL, 2 workers": Contender(f"{_PEERS}.torchrl_ppo", "sync", "torchrl"),
    "Tianshou": Contender(f"{_PEERS}.tianshou_ppo", "", "tianshou"),
    "RLlib, 2 runners": Contender(f"{_PEERS}.rllib_ppo", "", "rllib"),
}


class ProgramResult(NamedTuple):
    """The result of running a program."""

    solved_s: float
    """seconds from the command until the task was solved (for millrace, until the program ended); NaN if it wasn't solved"""
    updates: list[tuple[int, float]]
    """for each update, the env steps and the time in seconds at its end"""

    def steps_per_s(self, *, after_updates: int = 0, after_steps: int = 0) -> float:
        """Env steps/s between the first update after the warm-up and the last update.

        The warm-up lasts for at least this number of updates and this number of env steps.
        """
        first, began_s = next(update for update in self.updates[after_updates:] if update[0] >= after_steps)
        last, ended_s = self.updates[-1]
        return (last - first) / (ended_s - began_s)


def contenders(peers: bool = False) -> list[str]:
    """The contenders that can run here. Systems other than Stable-Baselines3 are included only if `peers`."""
    here = ["", *install.installed()] if peers else [""]
    sb3 = importlib.util.find_spec("stable_baselines3") is not None
    return [name for name, each in CONTENDERS.items() if each.peer in here and (each.module != _SB3 or sb3)]


def missing() -> list[str]:
    """The peers that are not installed."""
    return [name for name in install.PEERS if name not in install.installed()]


@contextlib.contextmanager
def started(command: Sequence[str], folder: Path) -> Iterator[subprocess.Popen[bytes]]:
    """A context manager that starts a program in this folder, with one thread for numpy, and its output in `OUTPUT`.

    When the context exits, the program and its child processes are killed.
    """
    threads = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
    path = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])
    with (folder / OUTPUT).open("w") as file:
        process = subprocess.Popen(
            command,
            stdout=file,
            stderr=subprocess.STDOUT,
            env=os.environ | threads | {"PYTHONPATH": path},
            cwd=folder,
            start_new_session=True,  # so that its child processes can be ended with it
        )
        try:
            yield process
        finally:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()


def run(
    name: str,
    settings: dict[str, Any],
    target: float | None = None,
    look: Callable[[int], None] = lambda pid: None,
    contender: Contender | None = None,
) -> ProgramResult:
    """Run a program to its end. Raises `RuntimeError` if it fails.

    `target`: the mean return at which the program ends. `look` is called with the process id from time to time. `contender`:
    the program, if the name isn't in `CONTENDERS`.
    """
    each = contender or CONTENDERS[name]
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        command = _ours(each, settings, target, folder) if each.ours else _theirs(each, settings, target)
        words = [str(install.python(each.peer)) if each.peer else sys.executable, "-m", each.module, *command]
        out = Path(folder) / OUTPUT
        began_s = time.monotonic()
        with started(words, Path(folder)) as process:
            while process.poll() is None and time.monotonic() - began_s < LONGEST_S:
                look(process.pid)
                try:
                    process.wait(LEAST_S)
                except subprocess.TimeoutExpired:
                    continue
            wall_s = time.monotonic() - began_s
        if process.returncode:
            raise RuntimeError(f"{name} ended with {process.returncode}: {out.read_text()[-500:]}")
        if each.ours:
            (table,) = Path(folder).rglob("metrics.jsonl")
            config = config_of_run(table.parent)
            updates = [(int(row["time/total_timesteps"]), row["time/time_elapsed"]) for row in read_rows(table)]
            early = config.steps - updates[-1][0] > 2 * config.envs * config.algorithm.rollout_steps
            return ProgramResult(wall_s if early else math.nan, updates)
        json_lines = [line for line in out.read_text().splitlines() if line.startswith(('{"env_steps"', '{"solved"'))]
        lines = [
            json.JSONDecoder().raw_decode(line)[0] for line in json_lines
        ]  # other output of the peer may follow on the same line
        solved = [line["at_s"] - began_s for line in lines if "solved" in line]  # all processes have the same clock
        return ProgramResult(
            solved[0] if solved else math.nan, [(line["env_steps"], line["at_s"]) for line in lines if "env_steps" in line]
        )


def _ours(contender: Contender, settings: dict[str, Any], target: float | None, folder: str) -> list[str]:
    named = {name: value for name, value in settings.items() if name != "env"}
    if target is None:
        named |= {"eval_every": 0, "eval_episodes": 1}
    else:
        named |= {"target_return": target}
    if contender.own:
        named = {
            name: named[name] for name in ("algo", "seed", "eval_every", "eval_episodes", "target_return") if name in named
        }
    else:
        named |= {"preset": "none"}
    flags = [word for name, value in named.items() for word in flag(name, value)]
    return ["train", settings["env"], "--run-dir", folder, *flags, *contender.flags]


def flag(name: str, value: Any) -> list[str]:
    """The words of a command line that give a setting this value."""
    name = name.replace("_", "-")
    match value:
        case bool():
            return [f"--{name}" if value else f"--no-{name}"]
        case list() | tuple():
            return [f"--{name}", *map(str, value)]
        case _:
            return [f"--{name}", "none" if value is None else str(value)]


def _theirs(contender: Contender, settings: dict[str, Any], target: float | None) -> list[str]:
    until = [] if target is None else ["--target", str(target)]
    return [json.dumps(settings), *(["--how", contender.how] if contender.how else []), *contender.flags, *until]
