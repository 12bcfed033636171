"""A learner in a bad neighbourhood, over tcp: what it learns does not depend on strangers, nor on who died when."""

from __future__ import annotations

import json
import socket
import subprocess
import sys
import time
from itertools import islice
from pathlib import Path
from typing import Any

import psutil
import zmq

from tests.fakes import fake_rollout
from tests.hostile import hostile, real
from workers.copies import copy_seeds

DEADLINE_S = 90.0
MESSAGES, STRANGERS = 30_000, 5
GROWTH_MB = 30  # in the second half: in the first the sockets' queues fill, which are bounded


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


class Cluster:
    """A learner and workers of their own, which nobody restarts."""

    def __init__(self, folder: Path, env: str, *flags: str, workers: int = 1) -> None:
        self.address, self.folder = f"tcp://127.0.0.1:{free_port()}", folder
        fixed = ["--bind", self.address, "--run-dir", str(folder), "--min-workers", str(workers), "--eval-episodes", "1"]
        command = [sys.executable, "-m", "learner", env, *fixed, *flags]
        self.said = folder.with_suffix(".log")  # a file, not a pipe that nobody reads: it would fill, and the learner wait
        with self.said.open("w") as said:
            self.learner = subprocess.Popen(command, stderr=said, stdout=subprocess.DEVNULL)
        self.workers = [
            subprocess.Popen(
                [sys.executable, "-m", "workers", self.address, "--name", f"w{n}"],
                stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL,
            )
            for n in range(workers)
        ]  # fmt: skip

    def __enter__(self) -> Cluster:
        return self

    def __exit__(self, *_: object) -> None:
        for process in (self.learner, *self.workers):
            process.kill()
            process.wait()

    def wait_until_it_learns(self) -> None:
        """Wait for the first row of metrics."""
        deadline_s = time.monotonic() + DEADLINE_S
        while not any(path.stat().st_size for path in self.folder.glob("*/metrics.jsonl")):
            assert time.monotonic() < deadline_s, self.said.read_text()[-5_000:]
            assert self.learner.poll() is None, self.said.read_text()[-5_000:]
            time.sleep(0.05)

    def result(self) -> tuple[bytes, dict[str, Any], list[dict[str, Any]]]:
        """Wait for the end; the policy, the summary and the rows of metrics."""
        assert self.learner.wait(DEADLINE_S) == 0, self.said.read_text()[-5_000:]
        (run,) = self.folder.iterdir()
        rows = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
        return (run / "policy.safetensors").read_bytes(), json.loads((run / "summary.json").read_text()), rows


def pester(cluster: Cluster) -> float:
    """Send hostile messages under names of their own while the learner learns; by how many MB it grew."""
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    strangers = []
    for n in range(STRANGERS):
        stranger = context.socket(zmq.DEALER)
        stranger.routing_id = f"stranger{n}".encode()
        stranger.linger, stranger.sndtimeo = 0, 30_000
        stranger.connect(cluster.address)
        strangers.append(stranger)
    learner, sizes = psutil.Process(cluster.learner.pid), []
    try:
        for number, frames in enumerate(islice(hostile(3, real(fake_rollout(7, 0, 1, 0, 0))), MESSAGES)):
            strangers[number % STRANGERS].send_multipart(frames)
            if number % 1_000 == 0:
                sizes.append(learner.memory_info().rss / 2**20)
    finally:
        for stranger in strangers:
            stranger.close(0)
        context.term()
    return sizes[-1] - sizes[len(sizes) // 2]


def test_what_is_learned_among_strangers_who_send_rubbish_is_the_same_to_the_bit(tmp_path: Path) -> None:
    flags = ("--steps", "80000", "--seed", "5", "--n-epochs", "4")
    with Cluster(tmp_path / "quiet", "CartPole-v1", *flags) as cluster:
        expected, _, _ = cluster.result()
    with Cluster(tmp_path / "loud", "CartPole-v1", *flags) as cluster:
        cluster.wait_until_it_learns()
        grew_mb = pester(cluster)
        found, summary, _ = cluster.result()
    assert found == expected
    assert grew_mb < GROWTH_MB
    ledger = summary["ledger"]
    assert ledger["messages_bad"] > MESSAGES / 3  # the rest was of a session that is not theirs
    assert ledger["issued"] == ledger["used"] + ledger["outstanding"] + ledger["stale"] + ledger["lost"]


def test_two_runs_in_which_the_same_ticket_kills_its_worker_are_equal_to_the_bit(tmp_path: Path) -> None:
    """And until that ticket they are equal to the run in which nobody dies: only the lane's new life is another."""
    steps, seed, deadly_update = 16, 2, 4
    doomed = copy_seeds(seed, lane=1, incarnation=0, copies=2)[1]
    after = ((deadly_update - 1) * steps + steps // 2) * 5 // 6  # of its steps: every sixth row only resets

    def learn(name: str, *more: str) -> tuple[bytes, dict[str, Any], list[dict[str, Any]]]:
        flags = [
            "--envs", "4", "--lanes", "2", "--rollout-steps", str(steps), "--steps", "800", "--seed", str(seed),
            "--worker-timeout-s", "1.5", "--heartbeat-s", "0.2", "--env-kwargs", "after", str(after), "only_seed", *more,
        ]  # fmt: skip
        with Cluster(tmp_path / name, "workers.envs.toy:Dies-v0", *flags, workers=2) as cluster:
            return cluster.result()

    undisturbed, first, second = learn("undisturbed", "-1"), learn("first", str(doomed)), learn("second", str(doomed))
    assert first[1]["ledger"]["lost"] > 0 == undisturbed[1]["ledger"]["lost"]
    assert first[0] == second[0] != undisturbed[0]

    def learned(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
        return [{name: value for name, value in row.items() if name.startswith("train/")} for row in rows]

    assert learned(first[2]) == learned(second[2])
    before, after_it = learned(undisturbed[2]), learned(first[2])
    assert before[: deadly_update - 1] == after_it[: deadly_update - 1]
    assert before[deadly_update - 1] != after_it[deadly_update - 1]
