"""Speed of collecting in two processes, compared with a bare loop over the same copies: `python -m benchmarks.collect`.

`ours` is the `Collector` of `workers/collect`, as a worker runs it: a policy acts (64-64 in numpy, or convolutions in
torch), rollouts of T = 128 steps are stored with their log-probabilities, and episodes are counted. `bare` is a loop that
takes random actions, stores nothing and resets at an episode's end. There are two kinds of bare loop. `sampled`, to which
the targets refer, uses plain `gymnasium.make` and `action_space.sample()`, which is the usual way to measure. `drawn` is the
fastest loop over these copies: without gymnasium's checker, which the collector also leaves out, and with actions that were
sampled beforehand. `native` is the environment's vectorized form and `envpool` the environment in envpool; each is measured
in a bare loop and as a lane. `bfloat16` processes images in bfloat16. `no network` has a policy without a network, so it
measures storing and stepping. Contenders that aren't installed are left out.

All contenders of a case take turns, one pair of processes at a time, with one thread each. The figures are medians over the
rounds. On a machine that also does other work, use `--cpu`: it counts CPU time, which other work doesn't change.
"""

from __future__ import annotations

import os

os.environ |= dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")  # before numpy

import argparse
import itertools
import multiprocessing
import statistics
import time
from collections.abc import Callable, Iterator, Sequence
from importlib.util import find_spec
from multiprocessing.connection import Connection
from typing import Any, Literal, NamedTuple

import gymnasium
import numpy as np
import numpy.typing as npt
from rich.console import Console
from rich.table import Table

from benchmarks.writing import bars, write
from millrace.extras.envs.envpool import envpool_spec
from millrace.extras.envs.vectorized import make_native
from millrace.protocol.env_spec import EnvSpec
from millrace.protocol.envs.spaces import action_spec, observation_leaves
from millrace.protocol.errors import UsageError
from millrace.protocol.messages import Permit
from millrace.protocol.policy.distributions import distribution
from millrace.protocol.policy.layout import acting_size, buffer_size
from millrace.protocol.policy.policy import Policy, make_policy
from millrace.protocol.specs import PolicySpec, RunSpec
from millrace.protocol.wire.weight_dtypes import ActingDtype
from millrace.workers.collect.collector import Collector

PROCESSES = 2
STEPS = 128  # T, the number of steps in a rollout
CARTPOLE = EnvSpec("CartPole-v1")
FRAMES = EnvSpec("benchmarks.frames:Frames-v0")
PONG = EnvSpec("millrace.extras.envs:millrace/Atari-v0")  # names the module, because the bare loop uses gymnasium.make
BARE = ("bare, sampled", "bare, drawn")
OURS = ("ours, 2 lanes", "ours, 1 lane")
NARROW = ("ours, 1 lane, bfloat16", "native, 1 lane, bfloat16")
NATIVE = ("bare, native", "native, 1 lane")
POOL = ("bare, envpool", "envpool, 1 lane")


class Case(NamedTuple):
    """An environment to collect from, with the contenders and the targets."""

    env: EnvSpec
    copies: int
    """number of env copies in each process"""
    contenders: tuple[str, ...]
    share: float | None = None
    """target for `ours`, as a share of the rate of `bare, sampled`"""
    rate: int | None = None
    """target for `native` lanes, in env steps/s"""


CASES = (
    Case(CARTPOLE, 64, (*BARE, *OURS), share=0.85),
    Case(CARTPOLE, 8, (*BARE, *OURS), share=0.75),
    Case(EnvSpec("HalfCheetah-v5"), 8, (*BARE, *OURS, *POOL), share=0.92),
    Case(FRAMES, 16, (*BARE, *OURS, "no network, 1 lane"), share=0.9),
    Case(PONG, 16, (*BARE, *OURS, "no network, 1 lane", *NATIVE, *POOL, *NARROW), share=0.9),
    Case(CARTPOLE, 64, (*NATIVE, *POOL), rate=1_500_000),
    Case(CARTPOLE, 512, ("bare, native", "native, 4 lanes", "native, 1 lane", *POOL), rate=1_500_000),
)

Turn = Callable[[], int]  # steps the copies once or a few times, and returns the number of env steps


def bare_sampled(spec: EnvSpec, copies: int, number: int) -> Turn:
    """A bare loop with `action_space.sample()`, the usual way to measure an environment."""
    envs = [gymnasium.make(spec.id) for _ in range(copies)]
    for seed, env in enumerate(envs, start=number * copies):
        env.reset(seed=seed)
        env.action_space.seed(seed)

    def turn() -> int:
        for env in envs:
            _, _, terminated, truncated, _ = env.step(env.action_space.sample())
            if terminated or truncated:
                env.reset()
        return copies

    return turn


def bare_drawn(spec: EnvSpec, copies: int, number: int) -> Turn:
    """The fastest bare loop: without gymnasium's checker, and with actions that were sampled beforehand."""
    envs = [spec.make() for _ in range(copies)]
    for seed, env in enumerate(envs, start=number * copies):
        env.reset(seed=seed)
    rows = _drawn(envs[0].action_space, copies, number)

    def turn() -> int:
        for env, action in zip(envs, next(rows), strict=True):
            _, _, terminated, truncated, _ = env.step(action)
            if terminated or truncated:
                env.reset()
        return copies

    return turn


def bare_vector(kind: str, spec: EnvSpec, copies: int, number: int) -> Turn:
    """A bare loop over a vectorized environment, with actions that were sampled beforehand.

    Steps that only reset a copy aren't counted.
    """
    if kind == "native":
        env = make_native(spec, copies)
        env.reset(seed=number)
    else:
        env = envpool_spec(spec).make(range(number * copies, (number + 1) * copies))
        env.reset()
    rows = _drawn(env.single_action_space, copies, number)

    def turn() -> int:
        _, _, terminated, truncated, _ = env.step(next(rows))
        return copies - int(np.count_nonzero(terminated | truncated))

    return turn


def _drawn(space: gymnasium.Space[Any], copies: int, number: int) -> Iterator[npt.NDArray[Any]]:
    """An endless cycle of actions [copies, *action] that were sampled beforehand."""
    space.seed(number)
    return itertools.cycle([np.array([space.sample() for _ in range(copies)]) for _ in range(500)])


class ZeroPolicy:
    """A policy without a network. The parameters of its distribution are zeros."""

    def __init__(self, spec: PolicySpec) -> None:
        self._params = distribution(spec).params_size

    def load(self, parameters: object, buffers: object) -> None:
        """Do nothing, because there are no weights."""

    def __call__(self, leaves: Sequence[npt.NDArray[Any]], state: object = None) -> npt.NDArray[np.float32]:
        """Return zeros [L, N, P]."""
        return np.zeros((*leaves[0].shape[:2], self._params), np.float32)


def ours(kind: str, lanes: int, images: ActingDtype, spec: EnvSpec, copies: int, number: int) -> Turn:
    """The collector on `lanes` lanes, among which the copies are divided.

    `images`: the dtype in which the policy processes images.
    """
    made = spec.make()
    policy_spec = PolicySpec(observation_leaves(made.observation_space), action_spec(made.action_space))
    vector: Literal["loop", "native", "envpool"] = "loop"
    match kind:
        case "native" | "envpool":
            vector = kind
    run = RunSpec(
        spec, policy_spec, rollout_steps=STEPS, copies=copies // lanes, lanes=PROCESSES * lanes, seed=1, vector=vector
    )
    policy: Policy = ZeroPolicy(policy_spec) if kind == "no network" else make_policy(policy_spec, images)
    if policy_spec.needs_torch:
        import torch

        torch.set_num_threads(1)
    collector = Collector(run, policy)
    parameters = 0.01 * np.random.default_rng(0).standard_normal(acting_size(policy_spec), np.float32)
    collector.load(parameters, np.zeros(buffer_size(policy_spec), np.float32))
    mine = range(number * lanes, (number + 1) * lanes)
    sequence = 0

    def turn() -> int:
        nonlocal sequence
        before = collector.steps
        collector.collect([Permit(0, lane, 0, sequence, sequence) for lane in mine], 0, 0, _no_pulse)
        sequence += 1
        return collector.steps - before

    return turn


def _no_pulse() -> None: ...


def _make(name: str, env: EnvSpec, copies: int, number: int) -> Turn:
    match name.split(", "):
        case "bare", "sampled":
            return bare_sampled(env, copies, number)
        case "bare", "drawn":
            return bare_drawn(env, copies, number)
        case "bare", kind:
            return bare_vector(kind, env, copies, number)
        case kind, lanes, *narrow:
            return ours(kind, int(lanes.split()[0]), "bfloat16" if narrow else "float32", env, copies, number)
    raise ValueError(name)


def _process(name: str, env: EnvSpec, copies: int, number: int, cpu: bool, pipe: Connection) -> None:
    """For each number of seconds that arrives through the pipe, step for this time and send back the rate."""
    turn = _make(name, env, copies, number)
    clock = time.process_time if cpu else time.perf_counter
    while (seconds := pipe.recv()) is not None:
        steps = 0
        start = clock()
        while (now := clock()) - start < seconds:
            steps += turn()
        pipe.send(steps / (now - start))


class Pair:
    """Two processes that run the same contender at the same time."""

    def __init__(self, name: str, copies: int, env: EnvSpec = CARTPOLE, *, cpu: bool = False) -> None:
        context = multiprocessing.get_context("spawn")
        self._pipes = []
        self._processes = []
        for number in range(PROCESSES):
            here, there = context.Pipe()
            process = context.Process(target=_process, args=(name, env, copies, number, cpu, there), daemon=True)
            process.start()
            self._pipes.append(here)
            self._processes.append(process)

    def rate(self, seconds: float) -> float:
        """Env steps/s of both processes together."""
        for pipe in self._pipes:
            pipe.send(seconds)
        return float(sum(pipe.recv() for pipe in self._pipes))

    def close(self) -> None:
        for pipe in self._pipes:
            pipe.send(None)
        for process in self._processes:
            process.join()


def collecting(case: Case, rounds: int, seconds: float, *, cpu: bool) -> list[dict[str, object]]:
    """A row for each contender of this case: its rate, and the ratios to the rates of the bare loops."""
    available = [name for name in case.contenders if "envpool" not in name or find_spec("envpool")]
    pairs = {name: Pair(name, case.copies, case.env, cpu=cpu) for name in available}
    for pair in pairs.values():
        pair.rate(0.2)  # warm up
    turns = [{name: pair.rate(seconds) for name, pair in pairs.items()} for _ in range(rounds)]
    for pair in pairs.values():
        pair.close()

    def share(name: str, of: str) -> float | None:
        return statistics.median(turn[name] / turn[of] for turn in turns) if of in pairs else None

    return [
        {
            "env": case.env.id,
            "copies_each": case.copies,
            "contender": name,
            "env_steps_per_s": round(statistics.median(turn[name] for turn in turns)),
            "share_of_sampled": share(name, "bare, sampled"),
            "share_of_drawn": share(name, "bare, drawn"),
            "share_of_native": share(name, "bare, native"),
            "share_of_envpool": share(name, "bare, envpool"),
            "target_share": case.share if name.startswith("ours") else None,
            "target_rate": case.rate if name.startswith("native") else None,
        }
        for name in available
    ]


def show(rows: list[dict[str, object]], second: str) -> Table:
    table = Table(title=f"Collecting, {PROCESSES} processes, T = {STEPS}")
    shares = ("share_of_sampled", "share_of_drawn", "share_of_native", "share_of_envpool")
    for column in (
        "",
        "copies each",
        "",
        f"env steps/{second}",
        "of sampled",
        "of drawn",
        "of native",
        "of envpool",
        "target",
    ):
        table.add_column(column, justify="left" if column == "" else "right")
    for row in rows:
        target = f"≥ {row['target_share'] or row['target_rate']:,}" if row["target_share"] or row["target_rate"] else ""
        found = ["" if row[name] is None else f"{row[name]:.2f}" for name in shares]
        env = str(row["env"]).rpartition(":")[2].rpartition("/")[2]
        about = (env, str(row["copies_each"]), str(row["contender"]))
        table.add_row(*about, f"{row['env_steps_per_s']:,}", *found, target)
    return table


def main() -> None:
    parser = argparse.ArgumentParser(description="speed of collecting in two processes, compared with a bare loop")
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--seconds", type=float, default=1.0, help="seconds of each turn")
    parser.add_argument("--cpu", action="store_true", help="count seconds of CPU time")
    parser.add_argument("--env", default="", help="run only cases whose environment id contains this")
    arguments = parser.parse_args()
    rows: list[dict[str, object]] = []
    charts = []
    for case in CASES:
        if arguments.env not in case.env.id:
            continue
        try:
            case.env.make().close()
        except UsageError as error:
            print(f"left out: {error}")
            continue
        found = collecting(case, arguments.rounds, arguments.seconds, cpu=arguments.cpu)
        rows += found
        title = f"{case.env.id.rpartition(':')[2]}, env steps/s, {case.copies} copies in each of {PROCESSES} processes"
        charts.append((title, bars(found, "contender", "env_steps_per_s")))
    Console(width=150).print(show(rows, "CPU second" if arguments.cpu else "s"))
    write("collect", {"collecting": rows, "seconds": "CPU" if arguments.cpu else "wall"}, charts)


if __name__ == "__main__":
    main()
