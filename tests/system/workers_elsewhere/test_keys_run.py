"""Learner and workers as processes with keys: joining by token, revoking during a run, refusals."""

from __future__ import annotations

import sys
import time
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.wrappers import FrameStackObservation, TransformObservation

import millrace
from millrace.launch.training import train
from millrace.learner.config.layers import resolve
from millrace.learner.run_folder.run_format import check_format
from millrace.protocol.wire import compression as packing
from tests.system.stage import preloaded
from tests.system.stage.processes import START_S, Learner, Stage, crowding
from tests.system.stage.run_folders import policy_of
from tests.system.stage.runs import accounted

ANY_PORT = "tcp://127.0.0.1:*"
CARTPOLE: dict[str, object] = {"env-kwargs": "", "rollout-steps": 32, "batch-size": 256}
JOIN_LINE = "millrace worker "


@pytest.fixture(autouse=True)
def no_keys_of_the_users_own(monkeypatch: pytest.MonkeyPatch) -> None:
    for variable in ("MILLRACE_KEYS", "MILLRACE_TOKEN"):
        monkeypatch.delenv(variable, raising=False)


def join_address(learner: Learner) -> str:
    """The address in the line that the learner prints for workers."""
    return learner.hears(JOIN_LINE, START_S).partition(JOIN_LINE)[2].split()[0]


def test_a_revoked_worker_leaves_with_the_reason_and_the_run_goes_on_without_it(
    stage: Stage, monkeypatch: pytest.MonkeyPatch
) -> None:
    keys = stage.tmp_path / "keys"
    learner = stage.learner(ANY_PORT, {**CARTPOLE, "keys": keys}, env="CartPole-v1")
    address = join_address(learner)
    assert f"--token {keys}/default.token" in learner.said()
    millrace = [sys.executable, "-m", "millrace"]
    made = preloaded.run([*millrace, "keys", "new", "lab", "--keys", str(keys)], timeout=60)
    assert "lab.token" in made.stdout
    copy = stage.tmp_path / "copy.token"
    copy.touch(mode=0o600)
    copy.write_text((keys / "lab.token").read_text())
    worker = [*millrace, "worker", address, "--token", str(copy), "--name"]
    revoked = stage.start([*worker, "revoked"], "revoked")
    with monkeypatch.context() as patch:
        patch.setenv("MILLRACE_TOKEN", str(keys / "default.token"))
        steady = stage.worker(address, "steady")
    for name in ("revoked", "steady"):
        learner.hears(rf"worker {name} \(.*\) joined", START_S)
    learner.trains()

    began_s = time.monotonic()
    assert preloaded.run([*millrace, "keys", "revoke", "lab", "--keys", str(keys)], timeout=60).returncode == 0
    assert revoked.ends() == 2
    assert time.monotonic() - began_s < 5 * crowding()
    assert "was revoked" in revoked.said().splitlines()[-1]
    learner.hears("worker revoked was refused: its key lab")

    late = stage.start([*worker, "late", "--stay"], "late")  # waiting would not heal this
    assert late.ends() == 2
    assert "refused this worker's key" in late.said().splitlines()[-1]
    learner.hears("was not let in: its key lab")

    learner.trains()
    learner.process.terminate()
    assert learner.ends() == 130, learner.said()
    assert steady.ends() == 0, steady.said()
    accounted(learner.summary(), rows=32 * 2)
    for secret in (copy.read_text().strip(), (keys / "server.key").read_text().strip()):
        for path in stage.tmp_path.rglob("*"):
            if path.is_file() and path.suffix in {".log", ".toml", ".json", ".jsonl"}:
                assert secret not in path.read_text(), f"{path.name} holds a secret"


def test_a_worker_without_a_token_says_why_it_cannot_join(stage: Stage) -> None:
    learner = stage.learner(ANY_PORT, {**CARTPOLE, "keys": stage.tmp_path / "keys"}, env="CartPole-v1")
    address = join_address(learner)
    began_s = time.monotonic()
    worker = stage.worker(address, "w", "--join-timeout-s", "3")
    worker.hears("perhaps it asks for a key: give this worker --token FILE")
    learner.hears("was not let in")
    assert time.monotonic() - began_s < (5 + 1) * crowding()  # includes the time that Python takes to start
    assert worker.ends() == 1
    assert "no learner answered for 3 s: " in worker.said().splitlines()[-1]


@pytest.mark.parametrize("bind", ["tcp://0.0.0.0:*", "tcp://[::]:*"])
def test_status_of_a_run_on_this_machine_needs_nothing_but_its_folder(stage: Stage, bind: str) -> None:
    """The learner listens for other machines, with keys in the folder that it has by default."""
    home = ["env", f"HOME={stage.tmp_path}"]
    keys = stage.tmp_path / ".config" / "millrace" / "keys"
    learner = stage.learner(bind, {**CARTPOLE, "advertise": "no.such.host.invalid"}, env="CartPole-v1", before=home)
    port = join_address(learner).rpartition(":")[2]
    worker = stage.worker(f"tcp://127.0.0.1:{port}", "w", "--token", str(keys / "default.token"))
    if "[" in bind:
        worker.process.kill()
        worker = stage.worker(f"tcp://[::1]:{port}", "w6", "--token", str(keys / "default.token"))
    learner.trains()
    command = [sys.executable, "-m", "millrace", "status", str(learner.folder)]
    asked = preloaded.run(command, timeout=60)
    assert (asked.returncode, asked.stderr) == (0, "")
    assert asked.stdout.startswith("CartPole-v1: ")
    assert check_format(learner.folder).workers_elsewhere
    assert worker.alive()


def test_an_insecure_learner_warns_and_a_worker_of_it_runs_no_code(stage: Stage) -> None:
    settings = {"env-kwargs": "", "insecure": " ", "advertise": "127.0.0.1"}
    learner = stage.learner("tcp://0.0.0.0:*", settings, env="tests.support.envs.toy:Spaces-v0")
    address = join_address(learner)
    assert "is open to anyone who can reach it" in learner.said()
    worker = stage.worker(address, "w", "--no-code")
    assert worker.ends() == 2
    assert "imports a module, which this worker does not do" in worker.said()
    learner.hears("worker w was refused: environment tests.support.envs.toy:Spaces-v0 imports a module")


def test_a_run_on_this_machine_over_encrypted_tcp_learns_the_same(tmp_path: Path) -> None:
    """With keys made only for this run and not stored in a file, the weights are the same bits as without keys."""
    policies = []
    runs: dict[str, dict[str, Any]] = {"ipc": {}, "sealed": {"transport": "tcp", "keys": str(tmp_path / "keys")}}
    for name, settings in runs.items():
        config = resolve("CartPole-v1", run_dir=str(tmp_path / name), seed=3, steps=3_000, eval_episodes=1, **settings)
        policies.append((train(config, None, lambda progress: None) / "policy.safetensors").read_bytes())
    assert policies[0] == policies[1]
    assert not (tmp_path / "keys").exists()


@pytest.mark.soak
def test_packed_frame_stacks_train_the_same_policy_as_unpacked_ones(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Frames are packed over an encrypted connection, not between local processes. The weights are the same bits."""

    def stacks() -> gymnasium.Env[Any, Any]:
        frames = gymnasium.make("tests.support.envs.toy:Frames-v0")
        small = TransformObservation(frames, lambda frame: frame[:40, :40, 0], spaces.Box(0, 255, (40, 40), np.uint8))
        return FrameStackObservation(small, 4)

    settings: dict[str, Any] = {"workers": 1, "lanes": 2, "envs": 4, "rollout_steps": 60, "steps": 480, "n_epochs": 1}
    over: list[dict[str, Any]] = [{"transport": "ipc"}, {"transport": "tcp", "keys": str(tmp_path / "keys")}]
    policies, unpacked, unpack_stack = [], list[object](), packing.unpack_stack

    def unstacking(payload: Any, dtype: Any, shape: Any) -> Any:
        unpacked.append(shape)
        return unpack_stack(payload, dtype, shape)

    monkeypatch.setattr(packing, "unpack_stack", unstacking)
    for number, way in enumerate(over):
        folder = millrace.train(stacks, run_dir=str(tmp_path / f"runs{number}"), eval_episodes=1, **settings, **way).path
        policies.append(policy_of(folder))
        assert unpacked == [[61, 2, 4, 40, 40]] * 4 * number  # two updates of two lanes; none is dealt before the evaluation
    assert policies[0] == policies[1]
