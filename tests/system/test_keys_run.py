"""Learner and workers as processes that know each other by keys: joining by token, revoking in mid-run, refusals."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from learner.config import resolve
from learner.metrics import read_rows
from millrace.launch.local import train

START_S = 60.0


class Cluster:
    """Processes of one test; what each says goes to a file of its own."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.running: dict[str, subprocess.Popen[bytes]] = {}

    def start(self, name: str, *argv: str, **environment: str) -> subprocess.Popen[bytes]:
        with (self.folder / f"{name}.log").open("wb") as log:
            self.running[name] = subprocess.Popen(
                [sys.executable, "-m", *argv],
                stdout=log,
                stderr=log,
                cwd=self.folder,
                env={
                    **os.environ,
                    "PYTHONPATH": os.pathsep.join([str(Path(__file__).parents[2]), *sys.path]),
                    **environment,
                },
            )
        return self.running[name]

    def said(self, name: str) -> str:
        return (self.folder / f"{name}.log").read_text()

    def until(self, happens: Callable[[], Any], within_s: float = START_S) -> Any:
        deadline_s = time.monotonic() + within_s
        while not (found := happens()):
            assert time.monotonic() < deadline_s, {name: self.said(name)[-2000:] for name in self.running}
            time.sleep(0.05)
        return found

    def learner(self, *flags: str) -> str:
        """Start a learner on a free port of loopback; its address."""
        argv = ["CartPole-v1", "--run-dir", str(self.folder / "runs"), "--eval-episodes", "2", *flags]
        self.start("learner", "learner", *argv, "--bind", "tcp://127.0.0.1:*")
        line = self.until(lambda: next((one for one in self.said("learner").splitlines() if "millrace worker " in one), ""))
        return str(line).partition("millrace worker ")[2].split()[0]

    def updates(self) -> int:
        return sum(len(read_rows(path)) for path in self.folder.glob("runs/*/metrics.jsonl"))


@pytest.fixture
def cluster(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Cluster]:
    for variable in ("MILLRACE_KEYS", "MILLRACE_TOKEN"):
        monkeypatch.delenv(variable, raising=False)
    cluster = Cluster(tmp_path)
    yield cluster
    for process in cluster.running.values():
        process.kill()
        process.wait(10)


def test_a_revoked_worker_leaves_with_the_reason_and_the_run_goes_on_without_it(cluster: Cluster) -> None:
    keys = cluster.folder / "keys"
    address = cluster.learner("--keys", str(keys), "--steps", "1000000000")  # the test says when it is over
    assert f"--token {keys}/default.token" in cluster.said("learner")
    made = subprocess.run(
        [sys.executable, "-m", "millrace", "keys", "new", "lab", "--keys", str(keys)],
        capture_output=True,
        timeout=60,
        check=True,
    )
    assert b"lab.token" in made.stdout
    copy = cluster.folder / "copy.token"
    copy.touch(mode=0o600)
    copy.write_text((keys / "lab.token").read_text())
    revoked = cluster.start("revoked", "millrace", "worker", address, "--token", str(copy), "--name", "revoked")
    steady = cluster.start("steady", "workers", address, "--name", "steady", MILLRACE_TOKEN=str(keys / "default.token"))
    cluster.until(lambda: all(f"worker {name} (" in cluster.said("learner") for name in ("revoked", "steady")))
    cluster.until(lambda: cluster.updates() > 3)

    before, began_s = cluster.updates(), time.monotonic()
    subprocess.run([sys.executable, "-m", "millrace", "keys", "revoke", "lab", "--keys", str(keys)], timeout=60, check=True)
    assert revoked.wait(10) == 2
    assert time.monotonic() - began_s < 10
    assert "was revoked" in cluster.said("revoked").splitlines()[-1]
    cluster.until(lambda: "worker revoked was shut out: its key lab" in cluster.said("learner"))

    late = cluster.start("late", "millrace", "worker", address, "--token", str(copy), "--name", "late")
    assert late.wait(20) == 2
    assert "refused this worker's key" in cluster.said("late").splitlines()[-1]
    cluster.until(lambda: "was not let in: its key lab" in cluster.said("learner"))

    cluster.until(lambda: cluster.updates() > before + 5)
    cluster.running["learner"].terminate()
    assert cluster.running["learner"].wait(60) == 130, cluster.said("learner")
    assert steady.wait(20) == 0, cluster.said("steady")
    (run,) = (cluster.folder / "runs").iterdir()
    summary = json.loads((run / "summary.json").read_text())
    ledger = summary["ledger"]
    assert ledger["issued"] == ledger["used"] + ledger["outstanding"] + ledger["stale"] + ledger["lost"]
    for secret in (copy.read_text().strip(), (keys / "server.key").read_text().strip()):
        for path in cluster.folder.rglob("*"):
            if path.is_file() and path.suffix in {".log", ".toml", ".json", ".jsonl"}:
                assert secret not in path.read_text(), f"{path.name} holds a secret"


def test_a_worker_without_a_token_says_why_it_cannot_join(cluster: Cluster) -> None:
    address = cluster.learner("--keys", str(cluster.folder / "keys"))
    began_s = time.monotonic()
    worker = cluster.start("w", "workers", address, "--join-timeout-s", "3")
    cluster.until(lambda: "perhaps it asks for a key: give this worker --token FILE" in cluster.said("w"))
    cluster.until(lambda: "was not let in" in cluster.said("learner"))
    assert time.monotonic() - began_s < 5 + 2  # and the time that Python takes to start
    assert worker.wait(20) == 1
    assert "no learner answered for 3 s: " in cluster.said("w").splitlines()[-1]


def test_an_insecure_learner_warns_and_a_worker_of_it_runs_no_code(cluster: Cluster) -> None:
    argv = ["workers.envs.toy:Spaces-v0", "--insecure", "--bind", "tcp://0.0.0.0:*", "--advertise", "127.0.0.1"]
    cluster.start("learner", "millrace", "learner", *argv, "--run-dir", str(cluster.folder / "runs"))
    line = cluster.until(
        lambda: next((one for one in cluster.said("learner").splitlines() if "millrace worker " in one), "")
    )
    assert "is open to everybody who can reach it" in cluster.said("learner")
    address = str(line).partition("millrace worker ")[2].split()[0]
    worker = cluster.start("w", "workers", address, "--no-code", "--name", "w")
    assert worker.wait(30) == 2
    assert "imports a module, which this worker does not do" in cluster.said("w")
    cluster.until(
        lambda: "worker w left: environment workers.envs.toy:Spaces-v0 imports a module" in cluster.said("learner")
    )


def test_a_run_on_this_machine_over_sealed_tcp_learns_the_same(tmp_path: Path) -> None:
    """Keys that no file holds, made for this run; the weights are those of a run without, bit for bit."""
    policies = []
    runs: dict[str, dict[str, Any]] = {"ipc": {}, "sealed": {"transport": "tcp", "keys": str(tmp_path / "keys")}}
    for name, settings in runs.items():
        config = resolve("CartPole-v1", run_dir=str(tmp_path / name), seed=3, steps=3_000, eval_episodes=1, **settings)
        policies.append((train(config, None, lambda progress: None) / "policy.safetensors").read_bytes())
    assert policies[0] == policies[1]
    assert not (tmp_path / "keys").exists()
