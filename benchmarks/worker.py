"""Start-up time and memory of a worker process: `python -m benchmarks.worker`.

It measures the seconds from exec to the first rollout, and the resident memory, of a real `python -m millrace.workers` over
ipc, with only a hub in place of the learner. There are two policies: an MLP, which acts in numpy without torch, and an image
policy, which needs torch. The last row is a supervisor with the MLP's worker: the seconds to the first rollout, and the
supervisor's own memory, in which shared pages are divided among the processes that share them (PSS).
"""

from __future__ import annotations

import argparse
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import psutil
from rich.console import Console
from rich.table import Table

from benchmarks.writing import write
from millrace.learner.config.layers import resolve
from millrace.learner.env_spaces import EnvSpaces
from millrace.learner.rollouts.hub import Hub, HubSettings
from millrace.learner.rollouts.lag_rule import Rounds
from millrace.learner.rollouts.rollout_dealer import RolloutDealer
from millrace.learner.rollouts.ticket_coordinator import TicketCoordinator
from millrace.learner.run_spec import run_spec
from millrace.protocol.env_spec import EnvSpec
from millrace.protocol.envs.description import read_description
from millrace.protocol.messages import Describe
from millrace.protocol.policy.layout import buffer_size, parameter_layout, total_size
from millrace.protocol.wire.learner_link import LearnerLink
from millrace.workers.copy_slots import close_described
from millrace.workers.described_copy import describe
from millrace.workers.supervise.worker_process import WorkerCommand, WorkerProcess

CASES = {
    "MLP, CartPole-v1": EnvSpec("CartPole-v1"),
    "image, 12 x 12 x 3": EnvSpec("benchmarks.random_frames:RandomFrames-v0", {"side": 12, "channels": 3}),
}


SUPERVISOR = "supervisor of the MLP's worker"


def start_one(env: EnvSpec, *, supervised: bool = False) -> tuple[float, float]:
    """The seconds from exec to the first rollout, and the memory after it in MB: a worker's RSS, or a supervisor's PSS."""
    spaces = EnvSpaces.of_description(read_description(describe(Describe(1, 1, env))))
    close_described()
    run = run_spec(resolve(env.id, lanes=1, envs=8, rollout_steps=128), env, spaces)
    acting, _ = parameter_layout(run.policy)
    with tempfile.TemporaryDirectory() as folder:
        link = LearnerLink(f"ipc://{folder}/learner")
        coordinator = TicketCoordinator(run, RolloutDealer(run.lanes, Rounds(0)), worker_timeout_s=60, first_session=1)
        hub = Hub(link, coordinator, HubSettings(no_workers_timeout_s=60, stall_timeout_s=60, max_env_failures=0))
        hub.publish(0, np.zeros(total_size(acting), np.float32), np.zeros(buffer_size(run.policy), np.float32))
        began_s = time.perf_counter()
        command = [sys.executable, "-m", "millrace.workers", link.address]
        started = (
            subprocess.Popen(command, stderr=subprocess.DEVNULL)
            if supervised
            else WorkerProcess(WorkerCommand(link.address, "w0", Path(folder) / "log"))
        )
        hub.gather()
        took_s = time.perf_counter() - began_s
        memory = psutil.Process(started.pid).memory_full_info()
        hub.drain("measured")
        started.wait(30)
        link.close(0)
    return took_s, (memory.pss if supervised else memory.rss) / 2**20


def main() -> None:
    parser = argparse.ArgumentParser(description="start-up time and memory of a worker process")
    parser.add_argument("--rounds", type=int, default=7)
    rounds = parser.parse_args().rounds
    turns = [{name: start_one(env) for name, env in CASES.items()} for _ in range(rounds)]
    for turn in turns:
        turn[SUPERVISOR] = start_one(CASES["MLP, CartPole-v1"], supervised=True)
    table = Table("policy", "to first rollout, s", "resident, MB", title=f"A worker process, medians of {rounds}")
    found = {
        name: [statistics.median(column) for column in zip(*(t[name] for t in turns), strict=True)] for name in turns[0]
    }
    for name, (seconds, megabytes) in found.items():
        table.add_row(name, f"{seconds:.2f}", f"{megabytes:.0f}")
    Console().print(table)
    write(
        "worker", {"seconds to first rollout, MB": found}, [("resident, MB", {name: mb for name, (_, mb) in found.items()})]
    )


if __name__ == "__main__":
    main()
